"""A fitted model of the user's own as the machine that is controlled, and one run of a controller
on it as a row of plain values."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NotRequired, Protocol

import numpy as np
import numpy.typing as npt

from greybox.files import to_plain
from greybox.model.identified import IdentifiedModel
from greybox.report.mpc_documents import Answered, ByOutput, RunTrace
from greybox.symbolic import FloatArray
from mpc_export.mission.flight import PlantError, load_plant
from mpc_export.mission.model_plant import DrawnModel
from mpc_export.outputs.controller import OutputController

NEAR = 0.02
"""A limit that the next sample of a plan comes closer to than this share of the output's typical
size is touched."""


class Machine(Protocol):
    """What is controlled; u (n_u,) is the command that begins now, outputs are by name."""

    def reset(self, seed: int = 0) -> None:
        """Begin a run."""

    def step(self, u: npt.ArrayLike, dt: float | None = None) -> None:
        """Hold the command for dt seconds."""

    def measure(self, u: npt.ArrayLike) -> Mapping[str, float]:
        """Outputs with noise."""
        ...

    def truth(self, u: npt.ArrayLike) -> Mapping[str, float]:
        """The same without noise."""
        ...


class Run(Answered, ByOutput):
    """One run, as `run` explains it."""

    seed: int
    beyond: int
    samples: int
    touched: int
    failures: int
    trace: NotRequired[RunTrace]


class ModelMachine(DrawnModel):
    """The model itself: parameters and the error of its learned part drawn for every run, noise as
    identified. What its structure misses it cannot show."""

    def reset(self, seed: int = 0) -> None:
        """At the typical point of the training data."""
        x, u = self.functions.reference
        self.begin(seed, x, u)
        self._error = self._rng.standard_normal(len(self._channels))
        self._draw()

    def step(self, u: npt.ArrayLike, dt: float | None = None) -> None:
        """Hold the command u (n_u,) for one sample."""
        self.moved(u, dt)
        self._draw()

    def measure(self, u: npt.ArrayLike) -> dict[str, float]:
        """Outputs now by name, with noise, under the command u that begins now."""
        clean = self.truth(u)
        return {n: v + float(e) for (n, v), e in zip(clean.items(), self._noise, strict=True)}

    def truth(self, u: npt.ArrayLike) -> dict[str, float]:
        """The same without noise."""
        return self.seen(np.asarray(u, dtype=float), np.zeros(len(self._levels)))


@dataclass(frozen=True, kw_only=True)
class Asked:
    """What a run asks for: `held` maps outputs to the values that they are held at one after the
    other, `limits` outputs to (lower, upper), `ranges` every input to (lower, upper), in `seconds`
    altogether (None: as `OwnCampaign` finds fit)."""

    held: Mapping[str, tuple[float, ...]]
    limits: Mapping[str, tuple[float, float]]
    ranges: Mapping[str, tuple[float, float]]
    seconds: float | None = None

    def goals(self, names: tuple[str, ...], samples: int) -> FloatArray:
        """(samples, n_y) What every output is held at; zero where nothing is asked."""
        out = np.zeros((samples, len(names)))
        for name, values in self.held.items():
            turn = np.arange(samples) * len(values) // samples
            out[:, names.index(name)] = np.array(values)[turn]
        return out

    def settled(self, name: str, samples: int) -> npt.NDArray[np.bool_]:
        """(samples,) The later half of the time that a value is held."""
        return np.asarray(np.arange(samples) * len(self.held[name]) % samples >= samples // 2)


def machine_of(plant: str | None, model: IdentifiedModel) -> Machine:
    """What is controlled: the plant that `module:attribute` names, or the model itself. Raises
    `PlantError`."""
    if plant is None:
        return ModelMachine(model)
    return load_plant(plant)


def run(
    controller: OutputController, machine: Machine, asked: Asked, seed: int, *, watch: bool = False
) -> Run:
    """One run. Keys: seed, beyond (samples with a true output beyond its limit or not finite, after
    they were all inside), samples, excess
    (largest, in units of the output), rmse and settled (of held outputs against what was asked, all
    the time and in the later half of the time that a value is held), touched
    (limits that plans touch), solve_ms, failures, and with `watch` a trace. Raises `PlantError` for
    a machine that does not measure the outputs."""
    f, dt = controller.functions, controller.functions.dt
    names = f.outputs.names
    assert asked.seconds is not None
    samples = round(asked.seconds / dt)
    goals = asked.goals(names, samples)
    near = NEAR * f.scales[2]
    lower, upper = controller.outputs.lower, controller.outputs.upper
    machine.reset(seed)
    controller.start()
    u = controller.u
    true, commands, plans, spent, touched = [], [], [], [], 0
    for k in range(samples):
        seen, now = (_values(found, names) for found in (machine.measure(u), machine.truth(u)))
        true.append(now)
        commands.append(u)
        began = time.perf_counter()
        after = controller.answer(seen, goals[min(k + 1, samples - 1)])
        spent.append(1e3 * (time.perf_counter() - began))
        touched += int((controller.margins() < near).sum())
        assert controller.plan is not None
        plans.append((controller.plan.y[0], controller.plan.sigma[0]))
        machine.step(u, dt)
        u = after
    y = np.array(true)
    row: dict[str, object] = {
        "seed": seed,
        "samples": samples,
        **_beyond(y, lower, upper, names, asked),
        **_away(y - goals, names, asked),
        "touched": touched,
        "solve_ms": np.round(spent, 2),
        "failures": controller.failures,
    }
    if watch:
        row["trace"] = {
            "step": dt,
            "outputs": y,
            "commands": np.array(commands),
            "asked": goals,
            "planned": np.array([v for v, _ in plans]),
            "sigma": np.array([s for _, s in plans]),
        }
    found: Run = to_plain(row)
    return found


def _beyond(
    y: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    names: tuple[str, ...],
    asked: Asked,
) -> dict[str, object]:
    """In how many samples, and how far at most, true outputs y (n, n_y) were beyond a limit; a run
    that begins beyond one counts from when it is inside."""
    over = np.maximum(np.maximum(y - upper, lower - y), 0.0)
    inside = ((over == 0) & np.isfinite(y)).all(axis=1)
    begun = int(inside.argmax())
    over[:begun], inside[:begun] = 0.0, True
    most = over.max(axis=0)[[names.index(n) for n in asked.limits]]
    return {"beyond": int((~inside).sum()), "excess": dict(zip(asked.limits, most))}


def _away(error: FloatArray, names: tuple[str, ...], asked: Asked) -> dict[str, object]:
    """Root mean squares of the errors (n, n_y) of held outputs, at all times and once settled."""
    of = dict(zip(names, error.T, strict=True))
    return {
        "rmse": {n: float(np.sqrt(np.mean(of[n] ** 2))) for n in asked.held},
        "settled": {
            n: float(np.sqrt(np.mean(of[n][asked.settled(n, len(error))] ** 2))) for n in asked.held
        },
    }


def _values(found: Mapping[str, float], names: tuple[str, ...]) -> FloatArray:
    try:
        return np.array([float(found[n]) for n in names])
    except (KeyError, TypeError, ValueError) as error:
        raise PlantError(
            "measure(u) and truth(u) give the outputs of the model by name",
            expected=", ".join(names),
            got=f"{type(error).__name__}: {error}",
        ) from None
