"""`greybox inspect` shows, judges, advises and converts; its other commands take the same logs as
they come."""

from __future__ import annotations

import json
from dataclasses import replace
from importlib import resources
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from greybox.cli import main
from greybox.data.logs import read_log, read_table
from greybox.data.readers.mapping import LogMapping
from greybox.examples import flight_path, vehicle_path
from tests.data.readers import writers as w

VEHICLE = str(vehicle_path("nanobench"))
SCHEMA = json.loads(resources.files("greybox.schemas").joinpath("inspect.json").read_text())


def inspected(capsys: pytest.CaptureFixture[str], *arguments: str, code: int = 0) -> dict:
    assert main(["inspect", *arguments, "--json", "-"]) == code
    content = json.loads(capsys.readouterr().out)
    jsonschema.validate(content, SCHEMA)
    return content


def test_a_px4_log_is_described_judged_and_converted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pyulog")
    log = str(w.write_ulog(tmp_path / "flight.ulg", w.channels(rows=400)))
    out = tmp_path / "flight.csv.gz"
    assert main(["inspect", log, "--out", str(out)]) == 0
    said = capsys.readouterr().out
    for part in (
        "PX4 ULog",
        "sensor_combined",
        "100 Hz",
        "FRD",
        "rotor_speed",
        "DSHOT",
        "SDLOG_PROFILE",
        "spin = -1",
    ):
        assert part in said
    content = inspected(capsys, log)
    assert content["uses"]["rotation"] and content["uses"]["translation"]
    assert [m["group"] for m in content["missing"]] == ["rotor_speed"]
    assert content["format"] == "ulog"
    # The canonical file is the log, to the last digit.
    first, second = read_table(log), read_table(out)
    np.testing.assert_array_equal(first.t, second.t)
    assert list(first.channels) == list(second.channels)
    for name in first.channels:
        np.testing.assert_array_equal(first.channels[name], second.channels[name])


def test_what_a_log_lacks_takes_its_effects_away(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("orangebox")
    log = str(w.write_betaflight(tmp_path / "f.bbl", w.channels(rows=300)))
    content = inspected(capsys, log)
    assert content["effects"]["lacking"]["ground_effect"] == ["sensor position"]
    assert "battery_sag" in content["effects"]["possible"]
    advice = {m["group"]: m["advice"] for m in content["missing"]}
    assert "dshot_bidir" in advice["rotor_speed"]
    assert {"attitude", "position", "velocity"} <= set(advice)
    with_facts = inspected(capsys, log, "--vehicle", VEHICLE)
    assert "battery_sag" in with_facts["effects"]["possible"]


def test_rotor_speeds_without_commands_take_what_shapes_a_command_away(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    t = np.arange(200) / 100
    names = ["t", *(f"omega{i}" for i in range(1, 5)), *"pqr", "ax", "ay", "az"]
    rows = np.column_stack([t, *([np.full_like(t, 1500.0)] * 4), *([np.sin(t)] * 6)])
    log = tmp_path / "speeds.csv"
    np.savetxt(log, rows, delimiter=",", header=",".join(names), comments="")
    found = inspected(capsys, str(log))["effects"]
    for name in ("command_saturation", "thrust_curve", "motor_lag"):
        assert found["lacking"][name][0] == "commands"
    assert {"command_delay", "rotor_asymmetry"} <= set(found["possible"])


def test_a_table_of_unknown_columns_is_shown_and_asks_for_a_mapping(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = w.write_csv(tmp_path / "own.csv", w.own_columns(w.channels(rows=300)))
    content = inspected(capsys, str(log), code=1)
    assert "gyr_x" in content["streams"][0]["fields"]
    assert "mapping file" in content["problem"]
    named = tmp_path / "map.toml"
    named.write_text(w.OWN_MAPPING)
    content = inspected(capsys, str(log), "--mapping", str(named))
    assert content["problem"] is None
    assert content["uses"]["rotation"]


def test_a_vehicle_file_names_the_columns_of_its_tables(capsys: pytest.CaptureFixture[str]) -> None:
    content = inspected(
        capsys, str(flight_path("nanobench", "B2_circle_fast_rep1")), "--vehicle", VEHICLE
    )
    origin = {c["group"]: c["from"] for c in content["channels"]}
    assert "motor_motor_m1" in origin["command"]
    assert content["rows"] == 2200


def test_a_log_without_commands_cannot_be_fitted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    c = w.channels(rows=300)
    log = w.write_csv(tmp_path / "f.csv", {k: c[k] for k in ("t", "p", "q", "r")})
    content = inspected(capsys, str(log), code=1)
    assert not content["uses"]["fit"]
    assert content["missing"][0]["group"] == "command"


def test_nothing_is_written_where_there_is_nothing_to_write(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "f.csv"
    log.write_text("a,b\n1,2\n3,4\n")
    assert main(["inspect", str(log), "--out", str(tmp_path / "out.csv")]) == 2
    assert "nothing to write" in capsys.readouterr().err
    assert not (tmp_path / "out.csv").exists()


def test_check_takes_a_px4_log_and_finds_the_fault_of_the_flight(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A gyro in FLU where PX4's is FRD, as a wrongly rotated board logs it, is found through the
    reader."""
    pytest.importorskip("pyulog")
    c = w.channels(rows=1500)
    good = w.write_ulog(tmp_path / "good.ulg", c)
    wrong = w.write_ulog(tmp_path / "wrong.ulg", {**c, "q": -c["q"], "r": -c["r"]})
    assert main(["check", "--vehicle", VEHICLE, str(good)]) == 0
    capsys.readouterr()
    assert main(["check", "--vehicle", VEHICLE, str(wrong)]) == 1
    assert "q" in capsys.readouterr().out


def test_the_conditioned_flight_is_that_of_the_csv_log(tmp_path: Path) -> None:
    """After clock, gaps and trimming, too, the way through PX4's format changes nothing but the
    last digits."""
    pytest.importorskip("pyulog")
    c = w.channels(start=0, rows=2500)
    one = read_log(w.write_ulog(tmp_path / "f.ulg", c, slow_every=1), w.vehicle())
    plain = replace(w.vehicle(), columns=LogMapping())
    two = read_log(w.write_csv(tmp_path / "f.csv", c), plain)
    assert [s.n for s in one.segments] == [s.n for s in two.segments]
    for a, b in zip(one.segments, two.segments, strict=True):
        np.testing.assert_allclose(a.t, b.t, atol=1e-5)
        for name in ("u1", "u4", "p", "q", "r", "ax", "az", "x", "z", "vx", "vz"):
            np.testing.assert_allclose(a.channels[name], b.channels[name], atol=2e-5, err_msg=name)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "wrong schema"),
        (
            'schema = "greybox.mapping/1"\n[rate]\nfields = ["a"]',
            "rate: 1 fields; expected 3: p, q, r",
        ),
        ('schema = "greybox.mapping/1"\n[rat]\n', "unknown key 'rat'"),
        (
            'schema = "greybox.mapping/1"\n[rate]\nfields = ["a", "b", "c"]\nunit = "deg"',
            "unknown unit 'deg'",
        ),
        (
            'schema = "greybox.mapping/1"\n[rate]\nfields = ["a", "b", "c"]\nframe = "NEU"',
            "unknown frame 'NEU'",
        ),
        ('schema = "greybox.mapping/1"\n[rate]\nfields = ["a", "b", "c"]', "unknown field 'a'"),
        (
            'schema = "greybox.mapping/1"\n[rate]\nstream = "x"\nfields = ["a", "b", "c"]',
            "unknown stream 'x'",
        ),
        (
            'schema = "greybox.mapping/1"\n[command]\nfields = ["pwm1"]\nlimits = [2, 1]',
            "expected low < high",
        ),
        ('schema = "greybox.mapping/1"\n[time]\nunit = "min"', "unknown unit 'min'"),
        ('schema = "greybox.mapping/1"\n[time]\nfield = "tme"', "unknown column 'tme'"),
        (
            'schema = "greybox.mapping/1"\nclock = "c"\n[rate]\nfields = ["gyr_x", "gyr_y", '
            '"gyr_z"]',
            "unknown stream 'c'",
        ),
        ('schema = "greybox.mapping/1"\n[rate]\nunit = 3', "no fields"),
        (
            'schema = "greybox.mapping/1"\n[rate]\nfields = ["gyr_x", "gyr_y", "gyr_z"]\nscale = '
            "nan",
            "finite number",
        ),
        ("schema = ", "not valid TOML"),
    ],
)
def test_a_bad_mapping_file_is_one_line(
    text: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = w.write_csv(tmp_path / "own.csv", w.own_columns(w.channels(rows=30)))
    named = tmp_path / "map.toml"
    named.write_text(text)
    assert main(["check", "--vehicle", VEHICLE, "--mapping", str(named), str(log)]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


def test_fit_says_before_any_work_what_inspect_says_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    moving = ("p", "q", "r", "vx", "vy", "vz")
    still = {n: 1e-3 * np.sin(v) if n in moving else v for n, v in w.channels(rows=600).items()}
    log = str(w.write_csv(tmp_path / "stands.csv", still))
    inspected(capsys, log, code=1)

    def stopped(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("greybox.commands.fit.fit_with", stopped)
    bare = tmp_path / "V.toml"
    bare.write_text(Path(VEHICLE).read_text().split("[columns.")[0])
    assert (
        main(
            [
                "fit",
                "--vehicle",
                str(bare),
                "--train",
                log,
                "--manual",
                "--out",
                str(tmp_path / "fit"),
            ]
        )
        == 130
    )
    assert (
        "stands.csv not usable: on the ground: motors run, but the gyro shows no motion"
        in capsys.readouterr().err
    )
