"""The budget of errors finds the cause that was hidden, on a flight that a model with a torque of
its own made."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.data import Dataset, Flight, Segment
from greybox.estimation.engine import engine_for
from greybox.model.identified import IdentifiedModel
from greybox.model.noise import with_disturbance
from greybox.model.parameter import ParameterValues
from scenarios.studies.error_budget import ADAPT, listed, regressed, regression, run, short
from tests.validation.test_validate_judges_causally import COLUMNS, DT, make_model

N = round((ADAPT + 2.5) / DT)


def pushed_model() -> IdentifiedModel:
    """A craft whose filter carries pushes that fade within 0.2 s."""
    plain = make_model()
    dynamics = with_disturbance(plain.dynamics, ("force", "torque"), time=0.2)
    declared = {d.name: d.nominal for d in dynamics.parameters}
    return replace(
        plain,
        dynamics=dynamics,
        values=ParameterValues({**declared, **dict(plain.values)}),
        process_noise=np.repeat([1e-4, 1e-8, 1e-4, 1e-6], 3),
        sensor_noise=np.repeat([1e-3, 1e-3, 1e-3, 5e-2], 3),
        weak=np.full(len(dynamics.error_states), 100.0),
        reference_state=dynamics.reference({f"u{i}": 0.849 for i in range(1, 5)}),
    )


def flown(model: IdentifiedModel, name: str, size: float) -> Flight:
    """A flight under a roll torque that swings once in 0.8 s, with an amplitude of `size` N m."""
    engine = engine_for(model.dynamics, (), use_compiler=False)
    u = np.full((N, 4), 0.849)
    at = model.dynamics.states["disturbance.torque.x"]
    x, _ = model.dynamics.initial_state({})
    outputs, states = [], []
    for k in range(N):
        x[at] = size * np.sin(2 * np.pi * k * DT / 0.8)
        y, after = engine.rollout(
            starts=x[None],
            rows=np.array([k]),
            horizon=2,
            inputs=engine.padded_inputs(np.vstack([u, u[:2]])),
            p=model.parameter_vector(),
            dt=DT,
            want_states=True,
        )
        assert after is not None
        outputs.append(y[0, 0])
        states.append(x.copy())
        x = after[0, 1].copy()
    velocity = [model.dynamics.states[f"velocity.{a}"] for a in "xyz"]
    channels = dict(zip(COLUMNS, np.array(outputs).T, strict=True))
    channels |= dict(zip(("vx", "vy", "vz"), np.array(states)[:, velocity].T, strict=True))
    channels |= {f"u{i + 1}": u[:, i] for i in range(4)}
    segment = Segment(t=DT * np.arange(N), channels=channels, flight=name)
    return Flight(name=name, segments=(segment,), noncausal=frozenset({"vx", "vy", "vz"}))


@pytest.fixture(scope="module")
def errors() -> dict[str, dict[str, float]]:
    """Label -> group -> RMSE half a second ahead."""
    model = pushed_model()
    flights = Dataset(flights=(flown(model, "f", 2e-6),))
    rows = run(model, flights, flights, 5, [model])
    assert "the model  " in listed({k: r.table() for k, r in rows.items()}, DT)
    return {
        label: {g: float(e.rmse[49]) for g, e in row.table().groups.items()}
        for label, row in rows.items()
    }


def test_rotation_is_mended_by_the_torque_that_was_hidden_and_not_by_force(
    errors: dict[str, dict[str, float]],
) -> None:
    plain = errors["the model"]
    for g in ("rotation", "rate"):
        assert errors["torque throughout"][g] < 0.1 * plain[g]
        assert errors["force throughout"][g] > 0.9 * plain[g]
        assert errors["start: pose and rates"][g] > 0.5 * plain[g]
        assert errors["smoothed"][g] < 0.1 * plain[g]
    assert errors["torque, mean ahead"]["rate"] < 0.5 * plain["rate"]
    for g in plain:  # nothing of this craft belongs to a flight, and its form is right
        assert errors["thrust of each motor"][g] == pytest.approx(plain[g], rel=0.1)
        (same,) = (e for label, e in errors.items() if label.startswith("refitted, "))
        assert same[g] == pytest.approx(plain[g], rel=0.1)


def test_three_digits_are_shown() -> None:
    assert [short(v) for v in (0.000412, 0.0501, 0.5034, 1.234)] == [
        ".0004",
        ".0501",
        ".503",
        "1.23",
    ]


def test_regression_finds_a_linear_law() -> None:
    x = np.random.default_rng(0).normal(size=(20_000, 3))
    law = np.array([[1.0, 0.0], [0.0, -2.0], [0.5, 0.0]])
    found = regression(x, x @ law)
    np.testing.assert_allclose(
        regressed(x[:50], found), x[:50] @ law / 1.1, atol=0.05
    )  # the ridge shrinks by a tenth
