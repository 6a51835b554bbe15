"""`--from` a model of another craft: its effects are a prior, scaled to this craft, which its own
flight corrects."""

from __future__ import annotations

import json
import shlex
from dataclasses import replace

import numpy as np
import pytest

import greybox as gb
from greybox.automatic.borrow import decide_with_source
from greybox.automatic.facts import facts_of
from greybox.automatic.fit import prepare
from greybox.automatic.like import grown, lasting, like
from greybox.automatic.setting import Given
from greybox.cli import main
from greybox.model.identified import IdentifiedModel
from greybox.model.noise import with_disturbance
from greybox.model.parameter import nominal_values
from greybox.model.vehicle import Vehicle
from greybox.model.vehicle_parts import Quantity
from greybox.plants.flight_log import write_log
from greybox.plants.vehicle_file import write_vehicle
from tests.automatic.craft import flown, plant, raw, vehicle

COLUMNS = ("t", "u1", "u2", "u3", "u4", "p", "q", "r")
EFFECTS = ["motor_lag", "command_delay", "gyro_bias", "rotational_damping"]
DAMPING = 6e-5


@pytest.fixture(scope="module")
def source() -> IdentifiedModel:
    """A model of the nano quadrotor with lag, delay and damping as they are, biases per flight."""
    physics = gb.build_model(vehicle(), COLUMNS, EFFECTS, sample_time=0.01)
    dynamics = with_disturbance(physics, ("torque",), time=0.5)
    known = {"motor_lag.tau": 0.05, "command_delay.d": 0.012} | {
        f"rotational_damping.d_{axis}": size * DAMPING
        for axis, size in (("p", 1.0), ("q", 1.0), ("r", 0.5))
    }
    return IdentifiedModel(
        dynamics=dynamics,
        values=nominal_values(dynamics.parameters).replace(known),
        covariance_names=("rotational_damping.d_p",),
        covariance=np.array([[(0.1 * DAMPING) ** 2]]),
        flight_spread={f"gyro_bias.b_{axis}": (0.0, 0.001) for axis in "xyz"},
        process_noise=dynamics.noise_scale(0.01),
        sensor_noise=dynamics.sensor_scale(),
        weak=np.ones(len(dynamics.error_states)),
        reference_state=dynamics.reference({}),
        reference_inputs=np.full(len(dynamics.inputs), 0.5),
        sample_time=0.01,
    )


def larger(mass: float, length: float) -> Vehicle:
    """The same craft with other mass and arms."""
    own = vehicle()
    rotors = tuple(replace(r, position=tuple(length * x for x in r.position)) for r in own.rotors)
    return replace(own, mass=Quantity(value=mass * own.mass.value), rotors=rotors)


@pytest.mark.parametrize(
    ("unit", "factor"),
    [
        ("s", 1.0),
        ("rad", 1.0),
        ("m/s", 1.0),
        ("-", 1.0),
        ("N", 8.0),
        ("kg/rad", 4.0),
        ("kg m/rad", 16.0),
        ("N m s", 64.0),
        ("N s^2/m^2", 2.0),
        ("kg m^2", 128.0),
    ],
)
def test_sizes_with_a_mass_grow_as_those_of_a_craft_that_flies_alike(unit, factor):
    """Eight times the mass, four times the length: half as quick, time doubles."""
    assert grown(unit, larger(8.0, 4.0), vehicle()) == pytest.approx(factor)


def test_effects_are_believed_within_half_their_size_and_the_file_goes_first(source):
    own = larger(2.0, 1.0)
    said = replace(own, effects={"motor_lag": {"tau": Quantity(value=0.03, sigma=0.01)}})
    prepared = prepare(said, [raw(flown((3,), 2.0)[0], "c")])
    facts = facts_of(prepared.data, said, prepared.report)
    found = like(said, source, facts)
    assert found.effects["motor_lag"] == said.effects["motor_lag"]
    assert set(found.effects) == {"motor_lag", "command_delay", "rotational_damping"}
    damping = found.effects["rotational_damping"]["d_p"]
    assert damping.value == pytest.approx(2.0 * DAMPING)
    assert damping.sigma == pytest.approx(np.hypot(0.5, 0.1) * damping.value)
    assert lasting(source, ("force", "torque")) == {"disturbance.torque.T": (0.5, 0.25)}


@pytest.mark.parametrize(("damping", "taken"), [(DAMPING, True), (0.0, False)])
def test_what_a_craft_does_not_have_is_not_borrowed(source, damping, taken):
    own = replace(vehicle(), effects={n: {} for n in ("motor_lag", "command_delay")})
    strong = {f"rotational_damping.d_{a}": 20 * DAMPING for a in "pqr"} if not taken else {}
    other = replace(source, values={**source.values, **strong})
    short = {k: v for k, v in flown((3,), 3.0, damping)[0].items() if k in COLUMNS}
    prepared = prepare(own, [raw(short, "c")])
    facts = facts_of(prepared.data, own, prepared.report)
    said: list[str] = []
    craft, decided = decide_with_source(
        own, prepared.data, facts, Given(source=other), say=said.append
    )
    assert ("rotational_damping" in craft.effects) == taken
    (choice,) = [d.choice for d in decided.decisions if d.option == "--from"]
    assert choice == ("rotational_damping" if taken else "nothing")
    assert any("without what" in line for line in said)


@pytest.mark.slow
def test_a_few_seconds_correct_it_and_the_explicit_command_repeats(source, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    source.save("source.json")
    short = {k: v for k, v in flown((3,), 3.0, DAMPING)[0].items() if k in COLUMNS}
    write_log(tmp_path / "c.csv", short)
    write_vehicle(tmp_path / "v.toml", plant(), sigma={"inertia": 0.2, "thrust.c2": 0.2})
    plain = ["fit", "--vehicle", "v.toml", "--train", "c.csv"]
    assert main([*plain, "--from", "source.json", "--out", "fit"]) in (0, 1)
    first = json.loads((tmp_path / "fit" / "fit.json").read_text())
    assert first["parameters"]["rotational_damping.d_p"]["value"] == pytest.approx(DAMPING, rel=0.2)
    words = shlex.split(first["explicit"]["command"])
    assert words[words.index("--from") + 1] == "source.json"
    assert main([*words[1:], "--out", "again"]) in (0, 1)
    again = json.loads((tmp_path / "again" / "fit.json").read_text())
    assert again["parameters"] == first["parameters"]
    assert again["cost"] == first["cost"]
    known = {"gb": gb, "data": gb.read_logs(["c.csv"], gb.read_vehicle("v.toml"))}
    exec(first["explicit"]["python"], known)
    assert known["result"].cost == first["cost"]["negative_log_posterior"]


def test_a_model_of_ones_own_takes_no_effects_of_a_craft(tmp_path, capsys):
    given = ["fit", "--model-file", "own.py:build", "--from", "m.json", "--train", "a.csv"]
    assert main(given) == 2
    said = capsys.readouterr().err
    assert "--from" in said and "--vehicle" in said
