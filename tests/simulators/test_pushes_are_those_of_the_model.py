"""pushes.py: unexplained pushes are as strong, as slow and as unrelated as the model has them, and
a simulator that is given the present one flies what the model flies with it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from greybox.model.identified import IdentifiedModel
from greybox.model.noise import with_disturbance
from greybox.model.parameter import ParameterValues
from greybox.simulators.make import twin
from greybox.simulators.statement import agreement
from scenarios.foreign.plant import MissingSimulator
from scenarios.twins.written import FLYERS, Start, load
from tests.simulators.identified import START, identified, manoeuvre

PUSH = np.array([0.3, -0.2, 0.4, 0.01, -0.008, 0.005])
TIMES = {"disturbance.force.T": 0.8, "disturbance.torque.T": 0.2}


def model(values: Mapping[str, float]) -> IdentifiedModel:
    """The example craft, pushed about by a force for .8 s and a torque for .2 s."""
    plain = identified(values, gravity=9.80665)
    whole = with_disturbance(
        with_disturbance(plain.dynamics, ["force"], time=0.8), ["torque"], time=0.2
    )
    settled = ParameterValues({d.name: d.nominal for d in whole.parameters})
    return replace(
        plain,
        dynamics=whole,
        values=settled.replace(dict(plain.values)).replace(TIMES),
        process_noise=whole.noise_scale(0.01),
        weak=np.zeros(len(whole.error_states)),
        reference_state=whole.reference({}),
    )


def pushes(folder: Path, m: IdentifiedModel) -> Any:
    twin(m, ["rotorpy"], out=folder)
    (module,) = load(folder / "rotorpy", "pushes")
    return module


@pytest.mark.slow
def test_new_pushes_have_the_models_strength_and_time(tmp_path: Path) -> None:
    m = model({"motor_lag.tau": 0.05})
    module = pushes(tmp_path, m)
    level = dict(zip(m.dynamics.noises.names, m.noise_ahead, strict=True))
    flight = module.Pushes(seed=1)
    seen = np.array([np.concatenate(flight.step(0.01)) for _ in range(30_000)])
    for i, group in enumerate(("force", "torque")):
        kept = np.exp(-0.01 / TIMES[f"disturbance.{group}.T"])
        own = seen[:, 3 * i : 3 * i + 3]
        for k, axis in enumerate("xyz"):
            sigma = level[f"disturbance.{group}.{axis}"] / np.sqrt(1.0 - kept**2)
            assert own[:, k].std() == pytest.approx(sigma, rel=0.12)
            assert np.corrcoef(own[1:, k], own[:-1, k])[0, 1] == pytest.approx(kept, abs=0.005)
    start = np.array([np.concatenate(module.Pushes(seed=s).step(0.01)) for s in range(400)])
    assert start[:, 0].std() == pytest.approx(seen[:, 0].std(), rel=0.2), "it begins as it goes on"
    coarse = module.Pushes(seed=2)
    assert np.std([coarse.step(0.1)[0] for _ in range(8000)]) == pytest.approx(
        seen[:, :3].std(), rel=0.15
    )


def test_a_known_push_fades_and_none_stays_none(tmp_path: Path) -> None:
    module = pushes(tmp_path, model({"motor_lag.tau": 0.05}))
    known = module.Pushes(force=PUSH[:3], moment=PUSH[3:])
    first = known.step(0.2)
    np.testing.assert_array_equal(np.concatenate(first), PUSH)
    force, moment = known.step(0.2)
    np.testing.assert_allclose(force, PUSH[:3] * np.exp(-0.2 / 0.8))
    np.testing.assert_allclose(moment, PUSH[3:] * np.exp(-1.0))
    assert not np.any(module.Pushes().step(0.01))
    module.FORCE_WORLD, fixed = 1.0, module.Pushes(force=PUSH[:3])
    for _ in range(50):  # a quarter turn to the left in half a second
        fixed.step(0.01, rate=(0.0, 0.0, np.pi))
    seen = np.array([PUSH[1], -PUSH[0], PUSH[2]]) * np.exp(-0.5 / 0.8)
    np.testing.assert_allclose(fixed.step(0.01)[0], seen, rtol=1e-3)
    plain = twin(identified({}), ["rotorpy"])
    assert "rotorpy/pushes.py" not in plain.files and "pushes.py" not in plain.summary()


@pytest.mark.parametrize(
    "target",
    [pytest.param("rotorpy", marks=pytest.mark.slow), "mujoco", "drone-models", "pybullet"],
)
def test_a_simulator_with_the_present_push_flies_the_model(target: str, tmp_path: Path) -> None:
    m = model({"motor_lag.tau": 0.05, "rotational_damping.d_p": 0.02})
    twin(m, [target, "numpy"], out=tmp_path)
    (module,) = load(tmp_path / "numpy", "simulate")
    hover = float(module.HOVER[0])
    u = manoeuvre(hover)
    rotors = {f"rotor.{i}": hover for i in range(1, 5)}
    axes = [f"disturbance.{g}.{a}" for g in ("force", "torque") for a in "xyz"]
    moving = np.concatenate([START[b] for b in ("position", "velocity", "attitude", "rate")])
    further = {**rotors, **dict(zip(axes, PUSH, strict=True))}
    x = np.concatenate([moving, [further[n] for n in module.STATES[13:]]])
    calm = x * np.array([not n.startswith("disturbance") for n in module.STATES])
    ours, without = [], []
    for k in range(u.shape[1]):
        window = np.tile(u[:, k], (int(module.PAST) + 1, 1))
        x, calm = module.step(x, window), module.step(calm, window)
        ours.append(x[:13])
        without.append(calm[:13])
    start = Start(rotors=np.full(4, hover), push=PUSH, **START)
    rest = (tmp_path / target / "rest.py").is_file()
    try:
        theirs = FLYERS[target](
            tmp_path / target, start, u.T, np.full((5, 4), hover), 0.01, rest=rest
        )[:, :13]
    except MissingSimulator as missing:
        pytest.skip(str(missing))
    assert max(agreement(np.array(ours).T, theirs.T).values()) < 0.01
    assert agreement(np.array(ours).T, np.array(without).T)["rate"] > 0.05, "the push can be seen"
