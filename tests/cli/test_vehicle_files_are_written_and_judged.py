"""`greybox vehicle`: templates become files that the reader takes, and slips of unit, sign or
layout are found by name."""

from __future__ import annotations

import io
import json
import re
import tomllib
from dataclasses import replace
from importlib.resources import files

import jsonschema
import numpy as np
import pytest

from greybox.cli import main
from greybox.commands import vehicle as command
from greybox.commands.vehicle_lines import vehicle_lines
from greybox.errors import GreyboxError
from greybox.examples import vehicle_path
from greybox.files import dump_json
from greybox.model.plausibility import check_vehicle, vehicle_findings
from greybox.model.vehicle import Vehicle, read_vehicle
from greybox.model.vehicle_parts import Quantity
from greybox.model.vehicle_template import TEMPLATES, template_text, vehicle_text

SCHEMA = json.loads(files("greybox").joinpath("schemas/vehicle_check.json").read_text())


def changed(template: str = "x", **changes: object) -> Vehicle:
    """A template with raw keys of its file replaced; dots are written as two underscores."""
    data = tomllib.loads(template_text(template))
    for key, value in changes.items():
        *path, last = key.split("__")
        table = data
        for part in path:
            table = table.setdefault(part, {})
        table[last] = value
    return Vehicle.from_dict(data)


@pytest.mark.parametrize("name", TEMPLATES)
def test_every_template_is_read_and_plausible(name):
    report = check_vehicle(Vehicle.from_dict(tomllib.loads(template_text(name))))
    assert report.verdict == "plausible", report.summary()
    assert set(command.TEMPLATES) == set(TEMPLATES)


@pytest.mark.parametrize("name", TEMPLATES)
def test_the_title_of_a_file_holds_no_number_that_a_setting_changes(name):
    title = vehicle_text(name, {"mass": 0.6, "arm": 0.13}).splitlines()[0]
    assert title.startswith("# ")
    assert not re.search(r"\d (kg|g|mm|cm|m)\b", title), title


def test_half_the_mass_at_twice_the_arm_is_another_craft():
    half = tomllib.loads(vehicle_text("plus", {"mass": 0.25, "arm": 0.25}))
    whole = tomllib.loads(template_text("plus"))
    np.testing.assert_allclose(half["inertia"], 2 * np.array(whole["inertia"]), rtol=1e-5)
    thrust, torque = (
        half["actuator"][k][2] / whole["actuator"][k][2] for k in ("thrust", "torque")
    )
    assert (thrust, torque) == pytest.approx((0.5, 1.0), rel=1e-5)


@pytest.mark.parametrize("name", TEMPLATES)
def test_gravity_is_the_standard_one_and_says_what_simulators_have(name):
    """Of 9.81 in a simulator .003 m/s^2 are left, as a force without a name."""
    (line,) = [row for row in vehicle_text(name, {}).splitlines() if row.startswith("gravity")]
    assert line.startswith("gravity = 9.80665  # m/s^2") and "simulators have 9.81" in line


@pytest.mark.parametrize("name", ["nanobench", "arpl_crazyflie"])
def test_shipped_real_craft_are_not_called_impossible(name):
    assert check_vehicle(read_vehicle(vehicle_path(name))).ok


def test_the_crazyflies_maps_are_the_thesis_numbers():
    vehicle = Vehicle.from_dict(tomllib.loads(template_text("crazyflie")))
    command = np.array([10000.0, 40000.0, 65535.0])
    stated = 2.130295e-11 * command**2 + 1.032633e-6 * command + 5.484560e-4
    thrust = sum(q.value * (command / 65535) ** k for k, q in enumerate(vehicle.actuator.thrust))
    torque = sum(q.value * (command / 65535) ** k for k, q in enumerate(vehicle.actuator.torque))
    np.testing.assert_allclose(thrust, stated, rtol=1e-6)
    np.testing.assert_allclose(torque, 0.005964552 * stated + 1.563383e-5, rtol=1e-5)


SLIPS = {
    "mass in grams": ({"mass": 500.0}, "mass", "grams"),
    "arms in millimetres": (
        {
            "rotor": [
                {"position": [88 * x, 88 * y, 0.0], "spin": -x * y}
                for x, y in ((1, -1), (-1, -1), (-1, 1), (1, 1))
            ]
        },
        "rotor.position",
        "millimetres",
    ),
    "arms in centimetres": (
        {
            "rotor": [
                {"position": [8.8 * x, 8.8 * y, 0.0], "spin": -x * y}
                for x, y in ((1, -1), (-1, -1), (-1, 1), (1, 1))
            ]
        },
        "rotor.position",
        "centimetres",
    ),
    "inertia in g m^2": (
        {"inertia": np.diag([1.875, 1.875, 3.359]).tolist()},
        "inertia.xx",
        "g m^2",
    ),
    "inertia in g cm^2": (
        {"inertia": np.diag([18750.0, 18750.0, 33590.0]).tolist()},
        "inertia.xx",
        "g cm^2",
    ),
    "thrust in gram-force": (
        {"actuator__thrust": [0.0, 0.0, 500.0]},
        "actuator.thrust",
        "gram-force",
    ),
    "thrust per (rad/s)^2": (
        {"actuator__thrust": [0.0, 0.0, 1.2e-6], "actuator__speed_max": 2500.0},
        "actuator.thrust",
        "per (rad/s)^2",
    ),
    "thrust per rpm^2": (
        {"actuator__thrust": [0.0, 0.0, 1.3e-8], "actuator__speed_max": 2500.0},
        "actuator.thrust",
        "per rpm^2",
    ),
    "too weak": ({"actuator__thrust": [0.0, 0.0, 1.0]}, "actuator.thrust", "thrust of one rotor"),
    "negative torque": ({"actuator__torque": [0.0, 0.0, -0.07]}, "actuator.torque", "spin"),
    "no torque map": ({"actuator__torque": [0.0, 0.0, 0.0]}, "rotor", "torque map"),
    "rpm": ({"actuator__speed_max": 24000.0}, "actuator.speed_max", "rpm"),
    "lag in ms": ({"effects__motor_lag": {"tau": 40.0}}, "effects.motor_lag.tau", "milliseconds"),
    "falling thrust": ({"actuator__thrust": [0.0, 20.0, -14.0]}, "actuator.thrust", "order"),
    "lifts off at u_min": ({"actuator__u_min": 0.7}, "actuator", "u_min"),
}


@pytest.mark.parametrize("slip", SLIPS)
def test_a_slip_blocks_and_its_fix_says_what_it_was(slip):
    changes, where, words = SLIPS[slip]
    report = check_vehicle(changed(**changes))
    found = [f for f in report.findings if f.severity == "blocking" and f.where == where]
    assert found and words in found[0].fix, report.summary()
    assert not report.ok


@pytest.mark.parametrize(("thrust", "top"), [(1, 1000.0), (1, None), (2, 1000.0)])
def test_thrust_in_proportion_to_a_rotor_speed_gets_a_warning(thrust, top):
    """Effects that feel rotor speed are fitted wrongly then: J_r by a quarter, 23 sigma."""
    speed = {} if top is None else {"actuator__speed_max": top}
    report = check_vehicle(
        changed(actuator__thrust=[9.0 * (k == thrust) for k in range(3)], **speed)
    )
    told = [f for f in report.findings if "which speed_max takes for rotor speed" in f.message]
    assert [f.severity for f in told] == ["warning"] * (thrust == 1 and top is not None)


def test_spins_that_leave_no_yaw_are_found():
    rotors = tomllib.loads(template_text("x"))["rotor"]
    for spins in ((1, 1, 1, 1), (1, 1, -1, -1), (1, -1, -1, 1)):
        mixed = [{**r, "spin": s} for r, s in zip(rotors, spins, strict=True)]
        report = check_vehicle(changed(rotor=mixed))
        assert any(f.where == "rotor" and "yaw" in f.message for f in report.findings), spins


@pytest.mark.parametrize("template", ["x", "plus"])
@pytest.mark.parametrize("wrong", range(4))
def test_one_wrong_spin_leaves_no_level_hover_and_its_rotor_is_named(template, wrong):
    rotors = tomllib.loads(template_text(template))["rotor"]
    rotors[wrong]["spin"] *= -1
    # Neither a thrust at rest nor a negative one makes it a craft that hovers.
    for idle in (0.0, 0.1, -0.1):
        report = check_vehicle(changed(template, rotor=rotors, actuator__thrust=[idle, 0.0, 2.5]))
        (found,) = [f for f in report.findings if f.severity == "blocking"]
        assert found.where == "rotor.spin" and "level hover" in found.message
        assert str(wrong + 1) in found.fix, found.fix


def test_craft_that_lift_with_every_rotor_hover_level_however_many_they_have():
    def ring(n: int, spins: tuple[int, ...], first: float = 0.0, z: float = 0.0) -> list[object]:
        at = first + 2 * np.pi * np.arange(n) / n
        places = np.column_stack([0.18 * np.cos(at), 0.18 * np.sin(at), np.full(n, z)])
        return [{"position": p.tolist(), "spin": s} for p, s in zip(places, spins, strict=True)]

    six = ring(6, (1, -1) * 3)
    eight = ring(8, (1, -1) * 4, np.pi / 8)
    coaxial = [*ring(4, (1, -1, 1, -1)), *ring(4, (-1, 1, -1, 1), z=-0.05)]
    wide = [
        {"position": [x, y, 0.0], "spin": s}
        for x, y, s in ((0.1, 0.16, -1), (0.1, -0.16, 1), (-0.12, 0.1, 1), (-0.12, -0.1, -1))
    ]
    for rotors in (six, eight, coaxial, wide):
        assert not [f for f in check_vehicle(changed(rotor=rotors)).findings if "hover" in f.line()]


def test_a_level_hover_of_very_unequal_thrusts_is_a_warning():
    report = check_vehicle(changed(center_of_mass=[0.0, 0.085, 0.0]))
    (found,) = [f for f in report.findings if "unequal" in f.message]
    assert found.severity == "warning" and report.ok
    assert not [
        f
        for f in check_vehicle(changed(center_of_mass=[0.0, 0.02, 0.0])).findings
        if "unequal" in f.message
    ]


def test_a_centre_of_mass_outside_the_rotors_cannot_hover():
    report = check_vehicle(changed(center_of_mass=[0.2, 0.0, 0.0]))
    assert any("cannot hover level" in f.message for f in report.findings)


def test_hover_and_thrust_come_from_the_models_own_equations():
    plain = check_vehicle(changed()).figures["hover_command"]
    assert plain == pytest.approx(0.5, abs=1e-3)
    curved = check_vehicle(changed(effects__thrust_curve={"f": 0.5})).figures["hover_command"]
    # (1 - f) u + f u^2 = 0.5
    assert curved == pytest.approx(np.sqrt(0.25 + 1.0) - 0.5, abs=1e-3)


def test_warnings_for_what_is_unusual_but_possible():
    report = check_vehicle(
        changed(inertia=np.diag([1.875e-3, 1.875e-3, 3.9e-3]).tolist(), noise__gyro=1.0)
    )
    assert report.verdict == "warnings"
    assert {"inertia", "noise.gyro"} <= {f.where for f in report.findings}
    exact = changed(
        schema="greybox.vehicle/1",
        mass=0.5,
        inertia_sigma=[0.0] * 3,
        actuator__thrust_sigma=[0.0] * 3,
        actuator__torque_sigma=[0.0] * 3,
    )
    assert any(
        f.where == "sigma" and f.severity == "warning" for f in check_vehicle(exact).findings
    )


def test_every_command_that_reads_a_vehicle_file_says_what_it_believes_and_what_no_craft_has():
    heavy = changed(mass=500.0)
    lines = vehicle_lines(heavy)
    assert (
        lines[0] == "believed by default, because the vehicle file gives no sigma: mass 1%, arm 2%"
    )
    assert any(
        line.startswith("vehicle file: blocking: mass: ") and "grams" in line for line in lines
    )
    assert vehicle_findings(heavy)[0].where == "mass"
    assert vehicle_lines(changed()) == [] == vehicle_lines(changed(schema="greybox.vehicle/1"))


def test_a_users_own_effect_is_passed_over():
    own = replace(changed(), effects={"my_own": {"k": Quantity(value=1.0)}})
    assert all(f.severity == "info" for f in vehicle_findings(own))


def test_the_check_prints_and_stores_what_is_believed(tmp_path, capsys):
    path = tmp_path / "v.toml"
    path.write_text(template_text("x").replace("value = 0.5, sigma = 0.005", "value = 0.5"))
    assert main(["vehicle", "check", str(path)]) == 0
    assert "mass 0.5 +- 0.005 kg (default, 1%)" in capsys.readouterr().out
    assert main(["vehicle", "check", str(path), "--json", "-"]) == 0
    content = json.loads(capsys.readouterr().out)
    jsonschema.validate(content, SCHEMA)
    assert {"quantity": "mass", "value": 0.5, "sigma": 0.005, "why": "default"} in content[
        "beliefs"
    ]


@pytest.mark.filterwarnings("ignore::greybox.errors.OldFormWarning")
def test_the_checks_json_stands_alone_also_for_columns_in_the_form_of_before(tmp_path, capsys):
    path = tmp_path / "v.toml"
    path.write_text(template_text("x") + '\n[columns]\nt = "time"\np = "gyro_x"\n')
    assert main(["vehicle", "check", str(path)]) == 0
    assert "[columns] by group" in capsys.readouterr().out
    assert main(["vehicle", "check", str(path), "--json", "-"]) == 0
    jsonschema.validate(json.loads(capsys.readouterr().out), SCHEMA)


def test_sizes_scale_the_generic_templates():
    small = Vehicle.from_dict(
        tomllib.loads(vehicle_text("plus", {"mass": 0.03, "arm": 0.046, "hover": 0.7}))
    )
    report = check_vehicle(small)
    assert report.verdict == "plausible", report.summary()
    assert report.figures["hover_command"] == pytest.approx(0.7, abs=1e-3)
    assert small.inertia[0][0] == pytest.approx(0.24 * 0.03 * 0.046**2, rel=1e-5)
    assert small.mass.sigma == pytest.approx(0.0003)


def test_a_changed_number_loses_its_source_and_the_others_keep_theirs():
    lines = vehicle_text(
        "crazyflie", {"mass": 0.034, "thrust.c2.sigma": 0.01, "noise.velocity": 0.02}
    ).splitlines()
    (mass,) = [line for line in lines if line.startswith("mass =")]
    (noise,) = [line for line in lines if line.startswith("velocity =")]
    assert mass.endswith("# kg, given") and noise.endswith("# given")
    assert any(line.startswith("inertia =") and "[1]" in line for line in lines)


def test_command_writes_checks_and_answers_by_exit_code(tmp_path, capsys):
    out = tmp_path / "deep" / "v.toml"
    new = [
        "vehicle",
        "new",
        "--template",
        "x",
        "--set",
        "mass=0.8",
        "name=my craft",
        "--out",
        str(out),
    ]
    assert main(new) == 0
    assert read_vehicle(out).name == "my craft"
    assert main(new) == 2  # never over an existing file
    assert "--force" in capsys.readouterr().err
    assert main(["vehicle", "check", str(out), "--json", "-"]) == 0
    jsonschema.validate(json.loads(capsys.readouterr().out), SCHEMA)
    out.write_text(out.read_text().replace("value = 0.8", "value = 800"))
    target = tmp_path / "check.json"
    assert main(["vehicle", "check", str(out), "--json", str(target)]) == 1
    result = json.loads(target.read_text())
    jsonschema.validate(result, SCHEMA)
    assert result["verdict"] == "implausible"
    assert "grams" in capsys.readouterr().out
    assert main(["vehicle", "new", "--template", "plus"]) == 0
    assert tomllib.loads(capsys.readouterr().out)["name"] == "quadrotor in plus"


def test_a_dash_is_standard_output_and_no_file(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        assert main(["vehicle", "new", "--template", "x", "--out", "-"]) == 0
        assert tomllib.loads(capsys.readouterr().out)["name"] == "quadrotor in X"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        (["--template", "crazyfly"], "crazyflie"),
        (["--template", "x", "--set", "mass"], "KEY=VALUE"),
        (["--template", "x", "--set", "mass=heavy"], "above zero"),
        (["--template", "x", "--set", "hover=1.5"], "command range"),
        (["--template", "x", "--set", "thrust.c3=1"], "thrust.c2"),
        (["--template", "x", "--set", "noise.giro=1"], "gyro"),
        (["--template", "x", "--set", "inertia.xx=1"], "no body has"),
        ([], "--template"),
    ],
)
def test_bad_input_is_one_line(extra, words, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("sys.stdin", io.StringIO())
    out = tmp_path / "v.toml"
    assert main(["vehicle", "new", *extra, "--out", str(out)]) == 2
    error = capsys.readouterr().err.strip()
    assert words in error and "\n" not in error
    assert not out.exists()


def test_a_file_that_is_no_vehicle_file_is_exit_code_two(tmp_path, capsys):
    bad = tmp_path / "v.toml"
    bad.write_text("mass = 1")
    assert main(["vehicle", "check", str(bad)]) == 2
    assert "schema" in capsys.readouterr().err


def test_questions_keep_defaults_and_ask_again_for_a_number(capsys):
    replies = iter(["plus", "", "heavy", "0.7", "", "0.2", "", "", ""])
    name, answers = command.ask(lambda _: next(replies))
    assert (name, answers) == ("plus", {"mass": 0.7, "arm": 0.2})
    assert "a number is needed" in capsys.readouterr().out
    assert (
        check_vehicle(Vehicle.from_dict(tomllib.loads(vehicle_text(name, answers)))).verdict
        == "plausible"
    )


def test_answers_that_end_early_are_one_line(tmp_path, capsys, monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.setattr("sys.stdin", Terminal("x\n"))
    assert main(["vehicle", "new", "--out", str(tmp_path / "v.toml")]) == 2
    assert "ended before" in capsys.readouterr().err
    monkeypatch.setattr("sys.stdin", Terminal("plus\n\n0.7\n\n\n\n\n\n"))
    assert main(["vehicle", "new", "--out", str(tmp_path / "v.toml")]) == 0
    assert read_vehicle(tmp_path / "v.toml").mass.value == 0.7


def test_any_number_is_judged_and_none_crashes_the_check():
    rng = np.random.default_rng(5)
    outcomes = set()
    for _ in range(120):
        data = tomllib.loads(template_text(TEMPLATES[rng.integers(len(TEMPLATES))]))
        for place in (
            "mass",
            "gravity",
            "u_max",
            "rotor_radius",
            "speed_max",
            "thrust",
            "torque",
            "center_of_mass",
        ):
            if rng.random() < 0.3:
                size = rng.choice([0.0, -1.0, 1e-300, 1e300, 10.0 ** rng.uniform(-8, 8)])
                table = (
                    data["actuator"]
                    if place in ("u_max", "rotor_radius", "speed_max", "thrust", "torque")
                    else data
                )
                table[place] = (
                    [0.0, float(size), 0.1]
                    if place in ("thrust", "torque", "center_of_mass")
                    else float(size)
                )
        try:
            report = check_vehicle(Vehicle.from_dict(data))
        except GreyboxError:
            outcomes.add("refused")
            continue
        jsonschema.validate(json.loads(dump_json(report.to_dict())), SCHEMA)
        outcomes.add(report.verdict)
    assert outcomes >= {"refused", "implausible", "plausible"}


def test_check_names_the_parameter_that_an_effect_does_not_have_and_the_file(tmp_path, capsys):
    path = tmp_path / "v.toml"
    text, lag = template_text("x"), "[effects.motor_lag]"
    assert lag in text
    path.write_text(text.replace(lag, f"{lag}\ntua = 0.04"))
    assert main(["vehicle", "check", str(path)]) == 2
    assert f"{path}: effects.motor_lag: unknown parameter" in (said := capsys.readouterr().err)
    assert "'tua'" in said and "did you mean tau" in said
