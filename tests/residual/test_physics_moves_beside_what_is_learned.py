"""A fit lets its parameters explain what the model lacks. Refitted beside what is learned they come
nearer to the truth, with errors that hold it; where nothing is hidden they stay."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from greybox.data import Dataset, dataset_from_arrays
from greybox.estimation.fit import fit
from greybox.model.dynamics import StateSpaceModel
from greybox.model.identified import IdentifiedModel
from greybox.model.parameter import Parameter
from greybox.residual.beside import better
from greybox.residual.files import load_model, save_model
from greybox.residual.hybrid import HybridModel
from greybox.residual.learn import Learned, learn
from greybox.residual.open_loop_fit import OpenLoopFit
from greybox.symbolic import Layout, Signal
from mpc_export.bundle import write_bundle
from mpc_export.verify import main as verify

DT, THRUST, LAG, DRAG = 0.02, 1.0, 0.12, 0.35


def cart() -> StateSpaceModel:
    """Thrust per mass with a lag; the air is unknown to it."""
    return StateSpaceModel(
        name="cart",
        states=Layout([Signal(name="speed", unit="m/s"), Signal(name="push", unit="m/s^2")]),
        inputs=Layout([Signal(name="u", unit="m/s^2")]),
        outputs=Layout([Signal(name="v", unit="m/s")]),
        parameters=(
            Parameter(name="thrust", unit="-", nominal=0.9, sigma=0.5),
            Parameter(name="lag", unit="s", nominal=0.1, sigma=0.1, lower=0.02, upper=1.0),
        ),
        dynamics=lambda t, x, u, p: [p["thrust"] * x[1], (u - x[1]) / p["lag"]],
        measurement=lambda t, x, u, p: [x[0]],
        noise_states=("speed",),
    )


def drives(count: int, seed: int, hidden: float, seconds: float = 16.0) -> Dataset:
    """Flights of the true cart, with air drag -hidden v |v|."""
    rng = np.random.default_rng(seed)
    n, fine, whole = round(seconds / DT), 40, None
    t = DT * np.arange(n)
    for i in range(count):
        phase = rng.uniform(0, 2 * np.pi, 4)
        u = sum(
            a * np.sin(2 * np.pi * t / s + f)
            for a, s, f in zip((2.0, 1.5, 1.5, 1.0), (5.0, 2.3, 1.1, 0.6), phase)
        )
        v, push, rows = 0.0, 0.0, np.empty(n)
        for k in range(n):
            rows[k] = v
            for _ in range(fine):
                v += DT / fine * (THRUST * push - hidden * v * abs(v))
                push += DT / fine * (u[k] - push) / LAG
            v += 0.002 * rng.standard_normal()
        seen = {"u": u, "v": rows + 0.01 * rng.standard_normal(n)}
        one = dataset_from_arrays(t, seen, name=f"drive{i}")
        whole = one if whole is None else whole + one
    assert whole is not None
    return whole


@cache
def case(hidden: float) -> tuple[IdentifiedModel, Learned]:
    train = drives(4, 1, hidden)
    first = fit(cart(), train, disturbance=("speed",)).model
    return first, learn(first, train, features=("speed",), points=6, refit=True)


def test_the_thrust_comes_nearer_to_the_truth_and_its_error_holds_it():
    first, result = case(DRAG)
    assert result.refitted
    model = result.model
    for name, truth in (("thrust", THRUST), ("lag", LAG)):
        off = abs(model.values[name] - truth)
        assert off < 3 * model.standard_errors[name]
    assert abs(first.values["thrust"] - THRUST) > 3 * first.standard_errors["thrust"]
    assert abs(model.values["thrust"] - THRUST) < 0.3 * abs(first.values["thrust"] - THRUST)


def test_where_nothing_is_hidden_the_physics_stays():
    first, result = case(0.0)
    assert result.null
    assert not result.refitted
    assert result.to_dict()["refit"] == []
    assert "the physics was not refitted" in result.summary()
    assert dict(result.model.values) == dict(first.values)


def test_the_refitted_model_is_saved_whole(tmp_path):
    _, result = case(DRAG)
    again = load_model(save_model(result.model, tmp_path / "hybrid.json"))
    assert isinstance(again.dynamics, HybridModel)
    assert dict(again.values) == dict(result.model.values)
    assert again.standard_errors == result.model.standard_errors


def test_its_export_computes_in_c_what_the_model_does(tmp_path, capsys):
    _, result = case(DRAG)
    write_bundle(result.model, tmp_path / "cart")
    assert verify([str(tmp_path / "cart")]) == 0, capsys.readouterr().err


def test_the_same_flights_give_the_same_physics():
    first, result = case(DRAG)
    again = learn(first, drives(4, 1, DRAG), features=("speed",), points=6, refit=True)
    assert dict(again.model.values) == pytest.approx(dict(result.model.values), rel=1e-10)


def test_it_says_what_moved():
    first, result = case(DRAG)
    moved = {row["name"]: row for row in result.to_dict()["refit"]}
    assert moved["thrust"]["before"] == first.values["thrust"]
    assert moved["thrust"]["after"] == result.model.values["thrust"]
    assert f"thrust {first.values['thrust']:.5g} -> " in result.summary()


def test_left_out_flights_decide():
    found = case(DRAG)[1].fit

    def changed(*factors: float) -> OpenLoopFit:
        return replace(
            found, unseen={f: np.resize(factors, e.size) * e for f, e in found.unseen.items()}
        )

    assert not better(found, found)
    assert better(changed(0.9), found)
    assert not better(changed(0.99), found)
    assert not better(changed(1.1), found)


def test_it_is_done_on_request_only():
    first, asked = case(DRAG)
    result = learn(first, drives(4, 1, DRAG), features=("speed",), points=6)
    assert result.refitted is None
    assert "refit" not in result.to_dict()
    assert "refitted" not in result.summary()
    assert dict(result.model.values) == dict(asked.base.values)


def test_what_was_given_stays():
    first, _ = case(DRAG)
    given = replace(first, covariance_names=(), covariance=np.zeros((0, 0)))
    result = learn(given, drives(4, 1, DRAG), features=("speed",), points=6, refit=True)
    assert not result.refitted
    assert dict(result.model.values) == dict(first.values)
