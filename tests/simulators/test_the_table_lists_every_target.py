"""The command offers exactly the targets there are, every target has its own name, and each of the
files that they write parses in its own format."""

from __future__ import annotations

import json
import re
import tomllib
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from importlib import resources
from itertools import pairwise
from pathlib import Path

import jsonschema
import pytest

import greybox as gb
from greybox.commands.twin import NAMES
from greybox.errors import DataError
from greybox.files import OutputError
from greybox.model.example import example_vehicle
from greybox.simulators.craft import Craft
from greybox.simulators.matrix import LEGEND, TOGETHER
from greybox.simulators.targets import TARGETS
from greybox.simulators.words import Word, Wording
from tests.simulators.identified import AERODYNAMICS, identified

NAME = "né \"<Craft> & \\ 'x' 7\""


def test_the_command_offers_every_target() -> None:
    assert tuple(t.name for t in TARGETS) == NAMES
    assert all(t.simulator and t.source for t in TARGETS)


class Own:
    """A target that no catalogue has."""

    name, simulator, source = "own", "Own", "nothing"

    def words(self, craft: Craft) -> tuple[Word, ...]:
        return Wording(craft, self.simulator).finish()

    def files(self, craft: Craft) -> dict[str, str]:
        return {"mass.txt": f"{craft.mass:g}"}


def test_a_target_of_ones_own_stands_beside_those_of_the_catalogue() -> None:
    model = identified({"motor_lag.tau": 0.05})
    made = gb.twin(model, [Own(), "px4"])
    assert [s.target for s in made.statements] == ["own", "px4"]
    assert {"own/mass.txt", "own/LOST.txt", "own/sensors.toml"} <= set(made.files)
    assert "motor_lag" in made.files["own/LOST.txt"]
    with pytest.raises(DataError, match="own twice"):
        gb.twin(model, [Own(), Own()])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("twin")
    model = identified({"motor_lag.tau": 0.05}, replace(example_vehicle(), name=NAME))
    made = gb.twin(model, out=out)
    assert {s.target for s in made.statements} == set(NAMES)
    return out


def test_every_file_parses_whatever_the_craft_is_called(folder: Path) -> None:
    parsed = 0
    for path in sorted(folder.rglob("*")):
        if path.suffix in (".xml", ".sdf", ".urdf"):
            ElementTree.parse(path)
        elif path.suffix == ".toml":
            tomllib.loads(path.read_text())
        elif path.suffix == ".py":
            compile(path.read_text(), str(path), "exec")
        elif path.suffix == ".json":
            json.loads(path.read_text())
        else:
            continue
        parsed += 1
    assert parsed > 15


def test_every_number_of_a_yaml_file_is_read_as_a_number(folder: Path) -> None:
    yaml = pytest.importorskip("yaml")
    read = [yaml.safe_load(p.read_text()) for p in sorted(folder.rglob("*.yaml"))]
    assert len(read) == 2

    def leaves(value: object) -> list[object]:
        if isinstance(value, dict):
            value = list(value.values())
        return [x for v in value for x in leaves(v)] if isinstance(value, list) else [value]

    for value in (x for r in read for x in leaves(r)):
        assert isinstance(value, float | int), value


def test_the_statement_is_as_its_schema_says(folder: Path) -> None:
    schema = json.loads(resources.files("greybox.schemas").joinpath("twin.json").read_text())
    jsonschema.validate(json.loads((folder / "twin.json").read_text()), schema)


@pytest.mark.slow
def test_the_table_of_effects_is_what_every_target_writes(tmp_path: Path) -> None:
    """Status and size of every cell are those of the target's own LOST.txt, and no row of it is
    left out."""
    values = {
        **AERODYNAMICS,
        "rotational_damping.d_p": 0.01,
        "thrust.c1": 0.5,
        "gyro_bias.b_x": 0.01,
    }
    made = gb.twin(
        identified({k: v for k, v in values.items() if k != "steady_wind.w_y"}), out=tmp_path
    )
    shown = made.summary().split("goes astray by it:\n")[1].split("\n\n")
    cells: dict[str, dict[str, str]] = {}
    for block in shown:
        head, *rows = block.splitlines()
        starts = [m.start() for m in re.finditer(r"\S+", head)]
        names = head.split()[1:]
        for row in (r for r in rows if r != LEGEND):
            parts = [row[a:b].strip() for a, b in pairwise([*starts, None])]
            for name, cell in zip(names, parts[1:], strict=True):
                cells.setdefault(name, {})[parts[0]] = cell
    assert tuple(cells) == NAMES
    # The level of the thrust is written in the numbers of the thrust.
    effects = {e.split(".")[0] for e in values} - {"thrust", "thrust_level"}
    for name, own in cells.items():
        written = (tmp_path / name / "LOST.txt").read_text()
        assert effects <= set(own), name
        # what the file has no row for is said
        rows = re.findall(r"^  (\S.*?) +(said|folded|lost) (.*)$", written, flags=re.MULTILINE)
        assert {e for e, _, _ in rows} <= set(own)
        assert {e for e, cell in own.items() if not cell.startswith(("said", "all"))} - {
            e for e, _, _ in rows
        } <= {TOGETHER}
        for effect, status, text in rows:
            astray = re.search(r"after 0.5 s (\S+) mm", text)
            said, *number = own[effect].split()
            assert said == status, (name, effect)
            if astray:
                assert float(number[0]) == pytest.approx(float(astray[1]), rel=0.05), (name, effect)
            else:
                assert not number or float(number[0]) < 0.05


def test_files_that_exist_stay_unless_forced(tmp_path: Path) -> None:
    folder, model = tmp_path, identified({"motor_lag.tau": 0.06})
    gb.twin(identified({"motor_lag.tau": 0.05}), ["rotorpy"], out=folder)
    before = (folder / "rotorpy" / "vehicle.py").read_text()
    with pytest.raises(OutputError, match="exist"):
        gb.twin(model, ["rotorpy"], out=folder)
    assert (folder / "rotorpy" / "vehicle.py").read_text() == before
    gb.twin(model, ["rotorpy"], out=folder, force=True)
    assert (folder / "rotorpy" / "vehicle.py").read_text() != before


def test_a_link_to_an_empty_folder_is_written_through(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / ".DS_Store").write_bytes(b"\0")
    (tmp_path / "link").symlink_to("there")
    gb.twin(identified({"motor_lag.tau": 0.05}), ["rotorpy"], out=tmp_path / "link")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "there" / "twin.json").is_file()
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("years of work")
    (tmp_path / "other").symlink_to("full")
    with pytest.raises(OutputError, match="a link to a folder with files"):
        gb.twin(identified({"motor_lag.tau": 0.05}), ["rotorpy"], out=tmp_path / "other")


def test_a_name_becomes_an_identifier() -> None:
    assert Craft.of(identified({}, replace(example_vehicle(), name=NAME))).name.isidentifier()


def test_a_battery_is_sized_by_every_target_that_says_it_in_another_way() -> None:
    model = identified({"battery_sag.c_V": 0.7, "motor_lag.tau": 0.05})
    made = gb.twin(model)
    sizes = {
        s.target: r.size
        for s in made.statements
        for r in s.rows
        if r.word.effect == "battery_sag" and r.word.status.value != "said"
    }
    assert {"rotorpy", "crazyflow", "gazebo", "px4", "ardupilot"} <= set(sizes)
    for target, size in sizes.items():
        assert size is not None and max(map(abs, size.thrust)) > 0.02, target


@pytest.mark.parametrize(
    ("target", "own"), [("pybullet", "world_rotor_drag"), ("gazebo", "rotor_drag")]
)
def test_a_drag_that_becomes_another_is_flown_once_and_all_of_it_stands_in_its_row(
    target: str, own: str
) -> None:
    """Drag of the rotors that stood in for a linear drag stayed beside what the rotors' became."""
    drag = {"linear_drag.d_x": 0.03, "linear_drag.d_y": 0.06, "linear_drag.d_z": 0.2}
    (statement,) = gb.twin(identified(drag), [target]).statements
    assert set(statement.spoken.effects) == {own}
    (row,) = (r for r in statement.rows if r.word.effect.endswith(("drag", "inflow")))
    assert row.size is not None and statement.whole is not None
    assert row.size.force == pytest.approx(statement.whole.force, rel=0.2)
    (beside,) = gb.twin(identified({**drag, "rotor_drag.k_x": 1e-5}), [target]).statements
    assert set(beside.spoken.effects) == {own}
    assert "in the row of linear_drag" in {r.word.effect: r.text for r in beside.rows}["rotor_drag"]


def test_a_linear_drag_alone_is_of_no_rotor_speed() -> None:
    (statement,) = gb.twin(identified({"linear_drag.d_x": 0.03}), ["px4"]).statements
    (row,) = (r for r in statement.rows if r.word.effect == "linear_drag")
    assert row.word.status.value == "folded" and "at hover speed" not in row.text
