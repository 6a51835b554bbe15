"""Claim: discover names what a model of the user's own lacks. Its effects are parameters with a
null; what none of them is gets a law of states and inputs, as a program that builds the model with
it; a model that lacks nothing is said to.

The motor is simulated in NumPy, independently, with a dry friction of 50 rad/s^2.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from greybox.data import Dataset, dataset_from_arrays
from greybox.discovery import workflow
from greybox.discovery.result import Discovery
from greybox.discovery.workflow import discover
from greybox.errors import ModelError, UnknownNameError
from greybox.estimation.fit import Fit
from greybox.model.dynamics import StateSpaceModel
from greybox.model.identified import IdentifiedModel
from greybox.model.own_effect import declared_effects, with_terms, without_effects
from greybox.model.own_model import load_own_model
from greybox.model.parameter import Parameter
from greybox.residual.laws.axis import Axis
from greybox.residual.laws.own_file import own_law_text
from greybox.symbolic import Expr
from tests import motor

FAN = Parameter(name="fan", unit="N m s^2", nominal=0.0, null=0.0, lower=0.0, scale=1e-6)
DRY = Parameter(name="dry.c", unit="N m", nominal=0.0, null=0.0, lower=0.0, scale=0.01)
WIDTH = Parameter(name="dry.width", unit="rad/s", nominal=1.0, lower=0.5, upper=2.0, scale=0.3)


def candidates(*more: Parameter) -> StateSpaceModel:
    """The motor without its friction, with further parameters of a friction and of a fan."""
    plain = motor.model()

    def dynamics(t: Expr, x: Expr, u: Expr, p: Mapping[str, Expr]) -> list[Expr]:
        held = p["b"] * x[1]
        if DRY in more:
            held += p["dry.c"] * ca.tanh(x[1] / p["dry.width"])
        if FAN in more:
            held += p["fan"] * x[1] * ca.fabs(x[1])
        return [
            (u[0] - p["R"] * x[0] - p["k"] * x[1]) / p["L"],
            (p["k"] * x[0] - held) / p["J"],
        ]

    own = tuple(d for d in plain.parameters if d.name != "c")
    return replace(plain, parameters=(*own, *more), dynamics=dynamics)


@functools.cache
def records() -> tuple[Dataset, Dataset]:
    """Two to search in, one that judges."""
    made = [motor.record(n=800, torque_noise=0.0005, seed=s, name=f"run {s}") for s in (0, 1, 2)]
    return made[0] + made[1], made[2]


def searched(model: StateSpaceModel) -> Discovery:
    return discover(model, *records())


def test_an_effect_is_the_parameters_of_a_name_of_which_one_has_a_null() -> None:
    model = candidates(DRY, WIDTH, FAN)
    assert declared_effects(model) == {"dry": (DRY, WIDTH), "fan": (FAN,)}
    bare = without_effects(model, ["dry", "fan"])
    assert [d.name for d in bare.parameters] == ["R", "L", "k", "J", "b"]
    x, u = ca.DM([1.0, 20.0]), ca.DM([3.0])
    p = [1.2, 0.02, 0.05, 2e-4, 1e-4]
    whole = model.f(0, x, u, ca.DM([*p, 0.0, 1.0, 0.0]))
    assert np.array_equal(np.asarray(whole), np.asarray(bare.f(0, x, u, ca.DM(p))))
    with pytest.raises(UnknownNameError, match="effect 'fans'"):
        without_effects(model, ["fans"])
    with pytest.raises(ModelError, match="parameter fan is there already"):
        with_terms(model, [FAN], lambda t, x, u, p: {})
    with pytest.raises(UnknownNameError, match="state 'speeds'"):
        with_terms(bare, [FAN], lambda t, x, u, p: {"speeds": p["fan"] * x[1]})


def test_the_friction_that_is_there_is_named_and_the_fan_that_is_not_there_is_not() -> None:
    found = searched(candidates(DRY, WIDTH, FAN))
    assert found.verdict == "named" and [n.name for n in found.said("certified")] == ["dry"]
    (dry,) = found.effects()
    value = dry["parameters"]["c"]
    assert abs(value["value"] - motor.TRUTH["c"]) < 4 * value["std"]
    assert dry["stage"] == "own" and dry["worth"]["group"] in ("speed", "current")
    assert "fan" not in [d.name for d in found.model.dynamics.parameters]
    assert all(r.after < r.before for r in found.gap if r.horizon_s)


def test_what_a_short_judge_cannot_certify_and_all_flights_ask_for_stays_without_a_name() -> None:
    train, _ = records()
    judge = motor.record(n=24, torque_noise=0.0005, seed=5, name="short")
    found = discover(candidates(DRY, WIDTH, FAN), train, judge)
    (dry,) = found.said("not certified")
    assert dry.name == "dry" and dry.kept and not found.effects()
    assert "dry.c" in found.model.values
    (row,) = found.to_dict()["not_certified"]
    assert row["in_model"] is True
    size = f"c = {found.model.values['dry.c']:.4g} +- "
    assert f"not certified, in the model: dry ({size}" in found.summary()
    assert "in the model, not certified: dry" in found.line and "NOTHING" not in found.line


def test_what_has_no_name_is_a_law_in_a_program_that_builds_the_model(tmp_path: Path) -> None:
    found = searched(candidates())
    assert found.verdict == "unnamed" and found.lawful is not None
    assert found.left is not None
    (law,) = found.left.laws
    assert law.channel == "speed" and law.depends_on == ("speed",)
    (text,) = law.terms
    assert text.startswith("tanh(speed") and -60 < law.terms[text] < -45
    ahead = [r.with_proposals for r in found.gap if r.horizon_s]
    assert all(share is not None and share > 0.4 for share in ahead), ahead
    assert "(use model_with_laws.json, in Python .lawful)" in found.line
    (tmp_path / "proposal_2.py").write_text("# a law of an earlier search")
    assert found.save(tmp_path) == tmp_path
    written = {"discovery.json", "model.json", "model_with_laws.json", "proposal_1.py"}
    assert {p.name for p in tmp_path.iterdir()} == written | {"proposal_2.py.old"}
    kept = IdentifiedModel.load(tmp_path / "model_with_laws.json")
    assert kept.values == found.lawful.values
    built = load_own_model(f"{tmp_path}/proposal_1.py:build")
    assert list(declared_effects(built)) == ["proposal_speed"]
    lawful = IdentifiedModel.load(found.lawful.save(tmp_path / "lawful.json"))
    assert isinstance(lawful.core, StateSpaceModel)
    names = [d.name for d in lawful.core.parameters]
    assert names == [d.name for d in built.parameters]
    x, u, p = ca.DM([1.0, 20.0]), ca.DM([3.0]), ca.DM([lawful.values[n] for n in names])
    ours, theirs = built.f(0, x, u, p), lawful.core.f(0, x, u, p)
    assert np.allclose(np.asarray(ours), np.asarray(theirs), rtol=1e-12)
    json.dumps(found.to_dict())


def test_numbers_are_held_against_their_model_with_its_laws(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Without the laws they had bent."""
    asked = list[Fit]()

    def denied(fit: Fit, _stated: Collection[str]) -> tuple[str, ...]:
        asked.append(fit)
        return ()

    monkeypatch.setattr(workflow, "denied", denied)
    found = searched(candidates())
    assert found.lawful is not None
    assert [f.model.values for f in asked] == [found.lawful.values]


def test_a_model_that_lacks_nothing_is_said_to() -> None:
    plain = motor.model()

    def dynamics(t: Expr, x: Expr, u: Expr, p: Mapping[str, Expr]) -> list[Expr]:
        held = p["b"] * x[1] + p["c"] * ca.tanh(x[1]) + p["fan"] * x[1] * ca.fabs(x[1])
        return [
            (u[0] - p["R"] * x[0] - p["k"] * x[1]) / p["L"],
            (p["k"] * x[0] - held) / p["J"],
        ]

    found = searched(replace(plain, parameters=(*plain.parameters, FAN), dynamics=dynamics))
    assert found.verdict == "nothing_missing" and not found.names
    assert found.minimum_detectable["fan"]["fan"] > 0


@pytest.mark.slow
def test_a_model_that_was_identified_offers_laws_alone() -> None:
    """Its numbers are known with their errors: none of them is a candidate any more."""
    test = records()[1]
    known = searched(candidates(DRY, WIDTH)).model
    assert isinstance(known.core, StateSpaceModel)
    again = discover(known.core, test, since=known)
    assert again.verdict == "nothing_missing" and not again.names


def test_what_own_models_do_not_have_is_refused_in_one_line() -> None:
    with pytest.raises(ModelError, match="a parameter with a null") as caught:
        discover(candidates(), *records(), kinematic_noise=True)
    assert "\n" not in str(caught.value)
    with pytest.raises(ModelError, match=r"no process noise .* noise_states") as caught:
        discover(replace(candidates(), noise_states=()), *records())
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("unit", ['"+str(print("run"))+"', 'rad/"s', "m\\n", '"""'])
def test_a_unit_of_a_file_never_becomes_code(unit: str, capsys: pytest.CaptureFixture[str]):
    law = Axis(
        channel="speed",
        unit=unit,
        rms=1.0,
        gain=10.0,
        lasts=1.0,
        needed=True,
        terms={"speed": 1.0},
        codes=("x[0]",),
    )
    with pytest.raises(ModelError, match="cannot stand in a program"):
        own_law_text(law, 1)
    assert capsys.readouterr().out == ""


@functools.cache
def geared(seed: int, play: float) -> Dataset:
    """The motor drives a second mass through a gear with play [rad], of which no state is told."""
    rng, fine = np.random.default_rng(seed), 40
    u = np.repeat(rng.uniform(-6, 6, 20), 50)
    h, (i, w, load, twist) = 0.005 / fine, (0.0, 0.0, 0.0, 0.0)
    rows = []
    for volt in u:
        rows.append((i + 0.05 * rng.standard_normal(), w + 1.0 * rng.standard_normal()))
        for _ in range(fine):
            beyond = twist - np.clip(twist, -play, play)
            torque = 30.0 * beyond + 0.02 * (w - load) * (beyond != 0.0)
            i += h * (volt - 1.2 * i - 0.05 * w) / 0.02
            w += h * (0.05 * i - 1e-4 * w - torque) / 1e-4
            load += h * (torque - 1e-4 * load) / 2e-4
            twist += h * (w - load)
    current, speed = np.array(rows).T
    t = 0.005 * np.arange(u.size)
    channels = {"u": u, "current": current, "speed": speed}
    return dataset_from_arrays(t, channels, name=f"{seed}")


@pytest.mark.parametrize("play", [0.0, 0.3])
def test_what_has_states_of_its_own_is_not_nothing(play: float) -> None:
    """No law of the states tells the play of a gear, nor does a push that lasts."""
    train = geared(1, play) + geared(2, play)
    found = discover(candidates(), train, geared(3, play), per_flight=())
    assert found.fit is not None
    white = play == 0.0
    assert found.line.startswith("NOTHING MISSING") == white
    assert (found.verdict == "nothing_missing") == white
    assert ("NOT WHITE" in found.line) != white
    assert any("one-step errors are not white" in w for w in found.fit.warnings) != white
