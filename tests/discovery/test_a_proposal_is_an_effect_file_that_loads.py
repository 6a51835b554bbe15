"""What discover proposes is a file that --effects-file takes: it loads, passes the check of all
effects and says the law."""

from __future__ import annotations

from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from greybox.model.effect import Flow
from greybox.model.effects_file import load_effects
from greybox.model.model import build_model
from greybox.residual.laws.effect_file import file_name, proposal_text, proposed
from greybox.residual.laws.terms import Term, terms, wanted_features
from tests.discovery.small_world import flown, law_of, vehicle

NAMES = (
    *(f"body_velocity.{a}" for a in "xyz"),
    *"pqr",
    *(f"attitude.{a}" for a in "wxyz"),
    *(f"position.{a}" for a in "xyz"),
    "vbat",
    "u1",
    "u2",
    "u3",
    "u4",
)


def features(n: int = 50) -> np.ndarray:
    """Random signals of a craft in fast flight, (n, 18)."""
    rng = np.random.default_rng(0)
    z = rng.standard_normal((n, len(NAMES)))
    z[:, 6:10] /= np.linalg.norm(z[:, 6:10], axis=1, keepdims=True)
    z[:, 12] = 1.5 + 0.3 * z[:, 12]
    z[:, 13] = 11.0
    z[:, 14:] = 0.6 + 0.1 * np.tanh(z[:, 14:])
    return z


def every(channel: str) -> list[Term]:
    return terms(channel, NAMES, features(), vehicle())


@pytest.mark.parametrize("channel", ["force.x", "torque.z"])
def test_the_file_loads_and_returns_the_law_on_its_axis(channel: str, tmp_path: Path):
    library = every(channel)
    picked = [
        next(t for t in library if t.text == name)
        for name in ("velocity.x |velocity.x|", "north.y", "p q")
    ]
    path = tmp_path / file_name(1)
    path.write_text(proposal_text(law_of(channel, *picked), 1), encoding="utf-8")
    (effect,) = load_effects(path)
    assert effect.name == f"proposal_{channel.replace('.', '_')}"
    assert [p.null for p in effect.parameters(vehicle())] == [0.0, 0.0, 0.0]
    assert "90 %" in path.read_text()
    flow = Flow(
        vehicle=vehicle(),
        velocity=ca.DM([2.0, 0.0, 0.0]),
        omega=ca.DM([3.0, 0.5, 0.0]),
        rotation=ca.DM.eye(3),
    )
    out = effect.apply(flow, {"c_1": 0.1, "c_2": 10.0, "c_3": 100.0})
    (slot,) = out
    expected = np.zeros(3)
    expected["xyz".index(channel[-1])] = 0.1 * 4 + 10.0 * 1 + 100.0 * 1.5
    assert slot == ("force" if channel.startswith("force") else "moment")
    np.testing.assert_allclose(np.array(ca.DM(out[slot])).ravel(), expected)


@pytest.mark.parametrize("channel", ["force.z", "torque.x"])
def test_every_term_of_the_library_makes_a_valid_effect_with_the_same_numbers(channel: str):
    z, library = features(), every(channel)
    rows = {n: z[3, i] for i, n in enumerate(NAMES)}
    w, x, y, s = (rows[f"attitude.{a}"] for a in "wxyz")
    turn = np.array(
        [
            [1 - 2 * (y * y + s * s), 2 * (x * y - w * s), 2 * (x * s + w * y)],
            [2 * (x * y + w * s), 1 - 2 * (x * x + s * s), 2 * (y * s - w * x)],
            [2 * (x * s - w * y), 2 * (y * s + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    flow = Flow(
        vehicle=vehicle(),
        velocity=ca.DM([rows[f"body_velocity.{a}"] for a in "xyz"]),
        rotation=ca.DM(turn),
        omega=ca.DM([rows[a] for a in "pqr"]),
        position=ca.DM([rows[f"position.{a}"] for a in "xyz"]),
        vbat=ca.DM(11.0),
        nu=ca.DM([rows[f"u{i}"] for i in range(1, 5)]),
    )
    for t in library:
        code = t.code.format(**t.shape.numbers) if t.shape else t.code
        assert float(eval(code, {"ca": ca, "flow": flow})) == pytest.approx(
            t.values[3], rel=1e-9, abs=1e-12
        ), t.text
    assert len({t.text for t in library}) == len(library)
    assert len(proposed([law_of(channel, *library[:3])])) == 1


def test_a_law_of_the_voltage_asks_for_its_column():
    battery = next(t for t in every("force.z") if t.text == "vbat")
    (effect,) = proposed([law_of("force.z", battery)])
    assert effect.needs.columns == ("vbat",)


def test_the_features_are_those_that_the_model_offers():
    names = wanted_features(build_model(vehicle(), flown(seconds=4.0).channels))
    assert {"p", "position.z", "attitude.w", "u1"} <= set(names)
    assert "vbat" not in names  # no effect of this model looks at the voltage
