"""A delay that is no whole number of samples is called what it is, and the start of a log, whose earlier commands nobody
knows, is no evidence for rotors that lag."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

import greybox.discovery.candidates
from greybox.data import Dataset
from greybox.discovery.candidates import candidates
from greybox.discovery.lead import led
from greybox.discovery.name import next_addition, prune
from greybox.discovery.nested import Nest, NestedFit
from greybox.discovery.workflow import discover
from greybox.estimation.engine import engine_for
from greybox.estimation.record import make_record
from greybox.model.effects import CATALOGUE
from greybox.model.model import build_model
from scenarios.plants.effects import CommandDelay, MotorLag, PlantEffect, PoseDelay, SensorDelay
from tests.discovery.small_world import flown, vehicle

TIMING = ("motor_lag", "command_delay", "sensor_delay", "pose_delay")


@pytest.fixture(scope="module", autouse=True)
def timing() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(greybox.discovery.candidates, "CATALOGUE", tuple(e for e in CATALOGUE if e.name in TIMING))
        yield


@pytest.mark.parametrize("hidden", [CommandDelay(d=0.013), SensorDelay(d=0.013), PoseDelay(d=0.004)])
def test_a_delay_of_a_fraction_of_a_sample(hidden: PlantEffect):
    found = discover(vehicle(), flown(hidden, seconds=6.0), flown(hidden, seeds=(11,), name="test"))
    ((name, parameters),) = [(e["name"], e["parameters"]) for e in found.effects()]
    assert name == hidden.name
    assert not any(a.rivals for a in found.additions)
    d = parameters["d"]
    assert abs(d["value"] - next(iter(hidden.parameters().values()))) < 4 * d["std"] < 4e-4


def test_all_sensors_late_alike_are_late_commands_in_other_words():
    hidden = (SensorDelay(d=0.013), PoseDelay(d=0.013))
    found = discover(vehicle(), flown(*hidden, seconds=6.0), flown(*hidden, seeds=(11,), name="test"))
    (effect,) = found.effects()
    assert effect["name"] == "command_delay"
    assert effect["parameters"]["d"]["value"] == pytest.approx(0.013, abs=4e-4)
    assert effect["alternatives"] == ["sensor_delay+pose_delay"]
    assert "the same thing in these logs: sensor_delay and pose_delay alike" in found.summary()


@pytest.mark.parametrize("first", ["sensor_delay", "pose_delay"])
@pytest.mark.parametrize("hidden", [(CommandDelay(d=0.02),), (CommandDelay(d=0.02), PoseDelay(d=0.015))])
def test_late_sensors_that_were_named_first_do_not_hide_late_commands(hidden: tuple[PlantEffect, ...], first: str):
    """Late gyro and accelerometer next to a pose that is as late, or later, shift the clock and nothing else."""
    nest, at = begun(flown(*hidden, seconds=6.0), first)
    found = next_addition(nest, at, nest.screen(at, alpha=0.05, seed=0), 0.05)
    assert found is not None
    assert not found.rivals
    last, kept, _ = prune(nest, found.after, [found], single=True)
    assert set(last.effects) - {first} == {e.name for e in hidden} - {first}
    for effect in hidden:
        d = last.fit.parameters[f"{effect.name}.d"]
        assert d.value == pytest.approx(next(iter(effect.parameters().values())), abs=2e-4)
    assert all(set(a.effects) <= set(last.effects) for a in kept)


@pytest.mark.parametrize("hidden", [(SensorDelay(d=0.013),), (SensorDelay(d=0.013), CommandDelay(d=0.01))])
def test_late_commands_that_were_named_first_do_not_hide_a_late_imu(hidden: tuple[PlantEffect, ...]):
    """Late commands and a pose that is early by as much are a late IMU: one name, and no group."""
    nest, at = begun(flown(*hidden, seconds=6.0), "command_delay")
    found = next_addition(nest, at, nest.screen(at, alpha=0.05, seed=0), 0.05)
    assert found is not None
    assert not found.rivals
    assert found.effects == ("sensor_delay",)
    last, _, _ = prune(nest, found.after, [replace(found, effects=("command_delay", "sensor_delay"))], single=True)
    assert set(last.effects) == {e.name for e in hidden}
    for effect in hidden:
        d = last.fit.parameters[f"{effect.name}.d"]
        assert d.value == pytest.approx(next(iter(effect.parameters().values())), abs=3e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hidden", "group", "kept"),
    [
        ((CommandDelay(d=0.01), PoseDelay(d=0.015)), {"command_delay", "sensor_delay"}, ("pose_delay", (0.015, 0.025))),
        ((SensorDelay(d=0.01), PoseDelay(d=0.025)), {"command_delay", "sensor_delay"}, ("pose_delay", (0.015, 0.025))),
        ((SensorDelay(d=0.02), PoseDelay(d=0.008)), {"command_delay", "pose_delay"}, ("sensor_delay", (0.012, 0.02))),
    ],
)
def test_what_takes_two_delays_to_say_is_said_two_ways(
    hidden: tuple[PlantEffect, ...], group: set[str], kept: tuple[str, tuple[float, ...]]
):
    """Each way has its size of the delay that both need: one is estimated, the other in the warning."""
    found = discover(vehicle(), flown(*hidden, seconds=6.0), flown(*hidden, seeds=(11,), name="test"))
    ((effect,), (ambiguous,)) = found.effects(), found.to_dict()["ambiguous"]
    assert {c["name"]: c["weight"] for c in ambiguous["candidates"]} == dict.fromkeys(group, 0.5)
    assert ambiguous["separating_manoeuvre"] is None
    name, sizes = kept
    assert effect["name"] == name
    assert min(abs(effect["parameters"]["d"]["value"] - s) for s in sizes) < 4e-4
    (said,) = [w for w in found.warnings if "no log tells these apart" in w]
    told = float(said.split(f"next to a {name} of ")[1].split(" ms")[0]) / 1e3
    assert sorted([told, effect["parameters"]["d"]["value"]]) == pytest.approx(sorted(sizes), abs=5e-4)


def test_a_lag_that_came_with_late_commands_keeps_its_name_and_its_step():
    hidden = (MotorLag(tau=0.04), CommandDelay(d=0.012), PoseDelay(d=0.02))
    found = discover(vehicle(), flown(*hidden, seconds=8.0), flown(*hidden, seeds=(11,), name="test"))
    content = found.to_dict()
    assert {e["name"] for e in content["effects"]} == {"motor_lag", "pose_delay"}
    (group,) = content["ambiguous"]
    assert {c["name"] for c in group["candidates"]} == {"command_delay", "sensor_delay"}
    steps = {s["step"]: s["added"] for s in content["steps"]}
    assert sorted(steps) == list(range(1, len(steps) + 1))
    for effect in content["effects"]:
        assert effect["name"] in steps[effect["step"]]
    assert sorted(n for added in steps.values() for n in added) == ["command_delay", "motor_lag", "pose_delay"]


def begun(data: Dataset, first: str) -> tuple[Nest, NestedFit]:
    """A search in which the delay of some sensors has its name already."""
    offered = candidates(vehicle(), data.channels, sample_time=0.01)
    nest = Nest(candidates=offered, data=led(data))
    return nest, nest.refit((first,), start=nest.refit(()), first={(f"{first}.d", None): 0.015})


def test_commands_before_a_cut_are_used():
    (segment,) = next(iter(flown(CommandDelay(d=0.013)))).segments
    model = build_model(vehicle(), segment.names, [e for e in CATALOGUE if e.name == "command_delay"], sample_time=0.01)
    engine = engine_for(model, ())
    whole, cut = (make_record(engine, s).inputs for s in (segment, segment.rows(50, segment.n)))
    assert engine.past > 0
    assert np.array_equal(whole[50:], cut)
