"""What depends on the past is written down as such: a lag or a swing of a signal, with its time to
be fitted."""

from __future__ import annotations

from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from greybox.discovery.workflow import discover
from greybox.model.effects_file import load_effects
from greybox.model.model import build_model
from greybox.plants.presets import x250
from greybox.residual.laws.effect_file import file_name, proposal_text, proposed
from greybox.residual.laws.lagged import DAMPING, FREQUENCIES, TIMES, follow, remembered_terms
from greybox.residual.laws.terms import Memory, Term
from scenarios.plants.outside import RelaxingDrag, SloshingMass
from scenarios.studies.discovery_outside import flights
from tests.discovery.small_world import law_of, shorten, vehicle

NAMES = (
    *(f"body_velocity.{a}" for a in "xyz"),
    *"pqr",
    *(f"attitude.{a}" for a in "wxyz"),
    "u1",
    "u2",
    "u3",
    "u4",
)
DT = 0.01


def features(n: int = 600) -> np.ndarray:
    """Slow signals of a craft, (n, 14)."""
    rng = np.random.default_rng(0)
    z = np.cumsum(rng.standard_normal((n, len(NAMES))), axis=0) * 0.02
    z[:, 6] += 1.0
    z[:, 6:10] /= np.linalg.norm(z[:, 6:10], axis=1, keepdims=True)
    z[:, 10:] = 0.6 + 0.1 * np.tanh(z[:, 10:])
    return z


def every(z: np.ndarray, *parts: slice) -> list[Term]:
    return remembered_terms(NAMES, z, vehicle(), parts or [slice(0, len(z))], DT)


@pytest.mark.parametrize("memory", [Memory(time=0.2), Memory(time=0.1, damping=0.15)])
def test_a_memory_obeys_its_equation(memory: Memory):
    """Against Euler steps a thousand times as fine."""
    signal = np.sin(np.arange(200) * 0.07) + 0.3
    fine, m, rate = 1000, 0.0, 0.0
    for s in signal[:-1]:
        for _ in range(fine):
            if memory.damping is None:
                m += DT / fine * (s - m) / memory.time
            else:
                pull = (s - m) / memory.time**2 - 2 * memory.damping * rate / memory.time
                m, rate = m + DT / fine * rate, rate + DT / fine * pull
    assert follow(signal, memory, DT)[-1] == pytest.approx(m, rel=2e-3)


def test_terms_of_every_kind_are_offered_and_each_flight_starts_at_rest():
    z = features()
    whole, parted = every(z), every(z, slice(0, 300), slice(300, 600))
    assert (
        len({t.text for t in whole})
        == len(whole)
        == 9 * (len(TIMES) + len(FREQUENCIES)) + len(TIMES)
    )
    for a, b in zip(whole, parted, strict=True):
        np.testing.assert_array_equal(a.values[:300], b.values[:300])
        assert b.values[300] == 0.0
    assert all(t.values.shape == (600,) for t in whole)


def test_the_file_of_a_remembered_law_integrates_what_the_term_says(tmp_path: Path):
    picked = [
        next(t for t in every(features()) if t.text == text)
        for text in ("velocity.x (within 0.3 s)", "up.y (swinging at 1 Hz)")
    ]
    path = tmp_path / file_name(1)
    path.write_text(proposal_text(law_of("force.x", *picked), 1), encoding="utf-8")
    (effect,) = load_effects(path)
    assert [p.name for p in effect.parameters(vehicle())] == [
        "c_1",
        "c_2",
        "time_1",
        "time_2",
        "damping_2",
    ]
    model = build_model(vehicle(), ("p", "q", "r", "ax", "ay", "az"), [effect])
    assert model.states.names[-3:] == tuple(
        f"memory.proposal_force_x.{n}" for n in ("term_1", "term_2", "term_2_rate")
    )
    x, u = ca.SX.sym("x", len(model.states)), ca.SX.sym("u", len(model.inputs))
    p = ca.SX.sym("p", len(model.parameters))
    f = ca.Function("f", [x, u, p], [ca.densify(model.f(0, x, u, p))])
    state = model.reference({})
    state[model.states.names.index("velocity.x")] = 2.0
    state[-3:] = [0.5, 0.1, -0.2]
    nominal = np.array([d.nominal for d in model.parameters])
    got = np.array(f(state, [0.5] * len(model.inputs), nominal)).ravel()[-3:]
    time = 1 / (2 * np.pi * 1.0)
    (centre,) = (float(t.code.split(" - ")[1]) if " - " in t.code else 0.0 for t in picked[1:])
    np.testing.assert_allclose(
        got,
        [(2.0 - 0.5) / 0.3, -0.2, (0.0 - centre - 0.1) / time**2 + 2 * DAMPING * 0.2 / time],
        rtol=2e-3,
    )


def test_terms_with_and_without_a_memory_share_a_file():
    z = features()
    plain = Term(text="p", code="flow.omega[0]", uses=("p",), values=z[:, 3])
    (effect,) = proposed([law_of("torque.x", plain, every(z)[0])])
    assert [p.name for p in effect.parameters(vehicle())] == ["c_1", "c_2", "time_2"]
    assert len(effect.memory(vehicle())) == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    "hidden", [RelaxingDrag(k=0.25), SloshingMass(mass=0.03)], ids=lambda e: e.name
)
def test_the_law_of_a_hidden_state_is_found_and_closes_the_gap(
    hidden: RelaxingDrag | SloshingMass, monkeypatch: pytest.MonkeyPatch
):
    shorten(monkeypatch)
    plant = x250([hidden])
    train, test = (
        flights(plant, s, 10.0, n) for n, s in {"train": (51, 52), "test": (53,)}.items()
    )
    found = discover(vehicle(), train, test)
    assert found.left is not None
    assert any(m is not None for a in found.left.laws for m in a.shapes)
    row = next(r for r in found.gap if r.group == "velocity" and r.horizon_s == 0.5)
    assert row.with_proposals is not None
    assert row.with_proposals > 0.6


def test_a_proposal_next_to_an_earlier_one_has_a_name_of_its_own():
    z = features()
    earlier = proposed([law_of("force.x", every(z)[0])])
    (later,) = proposed([law_of("force.x", every(z)[1])], [e.name for e in earlier])
    assert [e.name for e in (*earlier, later)] == ["proposal_force_x", "further_proposal_force_x"]
    assert (
        len(build_model(vehicle(), ("p", "q", "r", "ax", "ay", "az"), [*earlier, later]).effects)
        == 2
    )
