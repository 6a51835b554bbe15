"""An identified model as the plant: for a real vehicle, of which no independent simulation exists.

    x+ = f(x, u; theta) boxplus (d, w),   y = h(x, u) + v,   w ~ N(0, Q), v ~ N(0, R) as identified

theta is drawn for every flight from the covariance of the fit. d, the slow force and torque that
act on the vehicle, is either the identified Gauss-Markov process, or resampled from real flights:
the disturbances that the smoother finds in them, drawn as whole blocks of `BLOCK` seconds, so that
gusts keep their shape (moving block bootstrap, Kuensch 1989, Annals of Statistics 17(3)). A loop
that is closed on its own model says what noise, disturbances and parameter errors of the identified
size do to a controller; it cannot show what the model's structure misses.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence

import casadi as ca
import numpy as np
import numpy.typing as npt

from greybox.data import Dataset
from greybox.errors import ModelError
from greybox.estimation.filtering import Filter
from greybox.estimation.smoothing import smooth
from greybox.files import Json
from greybox.frames import numeric
from greybox.model.identified import IdentifiedModel
from greybox.symbolic import FloatArray
from mpc_export.functions import model_functions
from mpc_export.noise import parameter_covariance
from mpc_export.semidefinite import half
from mpc_export.tube.native import Native, native

BLOCK = 1.0
"""Length of the blocks that disturbances are resampled in [s]."""
FADE = 0.1
"""Time over which one block goes over into the next [s]."""
FAR = 2.5
"""Parameters are drawn within this many standard deviations."""
_NAMES = {
    "position": ("x", "y", "z"),
    "velocity": ("vx", "vy", "vz"),
    "attitude": ("qw", "qx", "qy", "qz"),
    "rate": ("p", "q", "r"),
}


def real_disturbances(model: IdentifiedModel, data: Dataset) -> list[FloatArray]:
    """Smoothed disturbance states (n, 6 or fewer) [N, N m] of every segment that is longer than
    four blocks.

    A block is left out at either end, where a vehicle takes off or lands and the smoother knows
    least. Raises `ModelError` for a model without disturbance states and for flights that are too
    short.
    """
    rows = [i for i, n in enumerate(model.dynamics.states.names) if n.startswith("disturbance.")]
    if not rows:
        raise ModelError(
            "the model has no disturbance states that flights could be asked for",
            got=model.name,
            fix="fit with --disturbance force,torque, or fly without --log",
        )
    edge = round(BLOCK / model.sample_time)
    long = [segment for flight in data for segment in flight.segments if segment.n > 4 * edge]
    if not long:
        raise ModelError(
            "no flight is long enough to resample", expected=f"more than {4 * BLOCK:g} s"
        )
    runner = Filter(model)
    return [smooth(runner, runner.run(segment)).states[edge:-edge, rows] for segment in long]


class DrawnModel:
    """What plants made of a fitted model share: its parameters are drawn from their covariance and
    its noise from the identified levels, flight by flight. The learned function is mean(z) + sd(z)
    `_error`; zero where nobody draws it. `groups` are functions that are wanted besides."""

    def __init__(self, model: IdentifiedModel, groups: Sequence[str] = ()) -> None:
        names, covariance = parameter_covariance(model)
        self.model = model
        self.sample_time = model.sample_time
        self.functions = f = model_functions(model, with_=groups, runtime_parameters=names)
        x, u, p, w = f.sampled.symbols()
        self._step = native(
            ca.Function("plant_step", [x, u, p, w], [ca.densify(f.sampled.step(x, u, p, w))])
        )
        self._output = native(
            ca.Function("plant_output", [x, u, p, w], [ca.densify(f.sampled.output(x, u, p, w))])
        )
        self._learned = self._learned_push()
        self._at = [f.parameters[n] for n in names]
        self._spread = half(covariance)
        bounds = {d.name: (d.lower, d.upper) for d in model.dynamics.parameters}
        self._bounds = np.array([bounds[n] for n in names], dtype=float).reshape(-1, 2)
        # As the tube allows for: what it tunes against must push as hard.
        self._levels = np.array(model.noise_ahead, dtype=float)

    def _learned_push(self) -> Native | None:
        """(x, u, p) -> mean and standard deviation (n_g) of the learned part in its noise channels,
        or None."""
        f = self.functions
        self._channels = [self.model.dynamics.noises[s.name] for s in f.learned]
        self._error = np.zeros(len(self._channels))
        if not self._channels:
            return None
        x, u, p = (ca.MX.sym(n, f.sizes[f"n_{n}"]) for n in "xup")
        z = f["gp_features_raw"](x, u, p)[0]
        deviation = ca.sqrt(ca.fmax(f["gp_variance"](z, p), 0.0))
        return native(
            ca.Function(
                "plant_learned", [x, u, p], [ca.densify(f["gp_mean"](z, p)), ca.densify(deviation)]
            )
        )

    def _pushes(self, u: FloatArray, noise: FloatArray) -> FloatArray:
        """`noise` (n_w,) and what the learned part adds to it."""
        w = np.array(noise)
        if self._learned is not None:
            mean, deviation = (v.ravel() for v in self._learned(self._x, u, self._p))
            w[self._channels] += mean + deviation * self._error
        return w

    def begin(self, seed: int, x: FloatArray, u: FloatArray) -> None:
        """At the state x (n_x,) under the command u (n_u,), with the parameters of this seed."""
        self._rng = np.random.default_rng([seed, 7])
        self._x, self._u, self.time = np.array(x, float), np.array(u, float), 0.0
        self._p = self.functions.parameter_values.copy()
        if self._at:
            drawn = self._p[self._at] + self._spread @ np.clip(
                self._rng.standard_normal(len(self._at)), -FAR, FAR
            )
            self._p[self._at] = np.clip(drawn, *self._bounds.T)

    def _draw(self) -> None:
        self._w = self._rng.standard_normal(len(self._levels)) * self._levels
        self._noise = (
            self._rng.standard_normal(len(self.model.sensor_noise)) * self.model.sensor_noise
        )

    def moved(self, u: npt.ArrayLike, dt: float | None) -> None:
        """Hold the command u (n,) for one sample. Raises `ModelError` for another length than the
        model's sample."""
        if dt is not None and abs(dt - self.sample_time) > 1e-9:
            raise ModelError("an identified model steps at its own sample time", got=f"{dt:g} s")
        self._u = np.asarray(u, dtype=float)
        push = self._pushes(self._u, self._w)
        self._x = self._step(self._x, self._u, self._p, push)[0].ravel()
        self.time += self.sample_time

    def seen(self, u: FloatArray, noise: FloatArray) -> dict[str, float]:
        """Outputs by name under the command u and the process noise (n_w,), without that of the
        sensors."""
        y = self._output(self._x, u, self._p, self._pushes(u, noise))[0].ravel()
        return dict(zip(self.functions.outputs.names, y.tolist(), strict=True))

    def values(self) -> dict[str, float]:
        """The parameters of this flight."""
        return dict(zip(self.functions.parameters.names, self._p.tolist(), strict=True))


class ModelPlant(DrawnModel):
    """The model of a file, flown: `reset`, `step`, `measure`, `states`, `truth`, as any other
    plant.

    disturbances: segments (n, k) of what `real_disturbances` found; None: the identified process.
    Raises `ModelError` for a model without a steady hover.
    """

    def __init__(
        self, model: IdentifiedModel, disturbances: Sequence[FloatArray] | None = None
    ) -> None:
        super().__init__(model, ("target",))
        self.disturbances = disturbances
        self._slow = [
            i for i, n in enumerate(self.functions.states.names) if n.startswith("disturbance.")
        ]
        if disturbances is not None:
            self._levels[[n.startswith("disturbance.") for n in model.dynamics.noises.names]] = 0.0
        self._hover = self._steady()
        self.reset(0)

    def _steady(self) -> tuple[FloatArray, FloatArray]:
        f = self.functions
        x, u = (np.array(v, dtype=float) for v in f.reference)
        for i, n in enumerate(f.states.names):
            if n.startswith(("disturbance.", "position.", "velocity.", "rate.", "attitude.")):
                x[i] = float(n == "attitude.w")
        for _ in range(30):
            x, u, away = (
                v.full().ravel()
                for v in f["target_step"](x, u, f.parameter_values, np.zeros(len(f.targets)))
            )
            if away[0] < 1e-9:
                return x, u
        raise ModelError("the model has no steady hover", got=f"condition missed by {away[0]:.2g}")

    def reset(self, seed: int = 0, *, position: Sequence[float] = (0.0, 0.0, 1.0)) -> None:
        """Hover at `position` [m], with parameters and disturbances of this seed."""
        x, u = (v.copy() for v in self._hover)
        x[[self.functions.states[f"position.{a}"] for a in "xyz"]] = position
        self.begin(seed, x, u)
        self._queue = np.zeros((0, len(self._slow)))
        self._next_disturbance()
        self._draw()

    def _next_disturbance(self) -> None:
        if self.disturbances is None:
            return
        fade, length = (round(v / self.sample_time) for v in (FADE, BLOCK))
        if len(self._queue) <= fade:
            sizes = np.array([len(s) - length - fade for s in self.disturbances])
            which = int(self._rng.choice(len(sizes), p=sizes / sizes.sum()))
            begin = int(self._rng.integers(sizes[which]))
            fresh = self.disturbances[which][begin : begin + length + fade].copy()
            old = self._queue if len(self._queue) else fresh[:fade]
            # Weights whose squares add up to one keep the variance where two independent blocks
            # meet.
            turn = 0.5 * np.pi * (np.arange(len(old)) + 1.0)[:, None] / (len(old) + 1.0)
            fresh[: len(old)] = (
                np.cos(turn) * old + np.sin(turn) * fresh[: len(old)] if len(self._queue) else old
            )
            self._queue = fresh
        self._x[self._slow] = self._queue[0]
        self._queue = self._queue[1:]

    def step(self, u: npt.ArrayLike, dt: float | None = None) -> None:
        """Hold the command u (n,) for one sample. Raises `ModelError` for another length than the
        model's sample."""
        self.moved(u, dt)
        self._next_disturbance()
        self._draw()

    def measure(self, u: npt.ArrayLike | None = None) -> dict[str, float]:
        """Measurements now by column, with noise; u: the command that begins now (default: the one
        before)."""
        command = self._u if u is None else np.asarray(u, dtype=float)
        out = self._noisy(self.seen(command, self._w))
        names = self.functions.parameters.names
        return {
            "t": self.time,
            **({"vbat": float(self._p[names.index("vbat")])} if "vbat" in names else {}),
            **out,
        }

    def _noisy(self, clean: dict[str, float]) -> dict[str, float]:
        """Measurements with sensor noise, one number per innovation of the model."""
        out, turn = dict(clean), np.zeros(3)
        dynamics = self.model.dynamics
        for name, columns, e in zip(
            dynamics.innovations.names, dynamics.innovation_columns, self._noise, strict=True
        ):
            if name.startswith("attitude."):
                turn["xyz".index(name[-1])] = e
            else:
                # a vector's innovations belong to all of its columns, in their order
                out[columns["xyz".index(name[-1])] if len(columns) == 3 else columns[0]] += float(e)
        quaternion = _NAMES["attitude"]
        if all(c in out for c in quaternion):
            turned = numeric("multiply", [out[c] for c in quaternion], numeric("exp", turn)[0])[0]
            out |= dict(zip(quaternion, map(float, turned), strict=True))
        return out

    def states(self) -> dict[str, float]:
        """True state now by the columns of a log: centre of mass, attitude, rates."""
        at = self.functions.states
        found: dict[str, float] = {}
        for block, columns in _NAMES.items():
            axes = "wxyz" if block == "attitude" else "xyz"
            found |= {
                c: float(self._x[at[f"{block}.{a}"]]) for c, a in zip(columns, axes, strict=True)
            }
        return found

    def truth(self) -> dict[str, Json]:
        """What a log does not say: `parameters` of this flight, `effects`, `states`."""
        return {
            "parameters": self.values(),
            "effects": list(self.model.effects),
            "states": self.states(),
        }


class RehearsedPlant(ModelPlant):
    """`ModelPlant` of a hybrid with an error of the learned part that stays the same over a flight.

    The learned function g(z) is mean(z) + sd(z) e, e ~ N(0, I) drawn once a flight: the consider
    states of the tube, simulated. Back-offs are rehearsed on it.
    """

    def reset(self, seed: int = 0, *, position: Sequence[float] = (0.0, 0.0, 1.0)) -> None:
        """Hover at `position` [m], with parameters, learned error and disturbances of this seed."""
        super().reset(seed, position=position)
        self._error = self._rng.standard_normal(len(self._channels))

    def copied(self) -> RehearsedPlant:
        """A copy that flies on by itself, with the draws that this one would have had; compiled
        functions are shared."""
        other = copy.copy(self)
        other._rng = copy.deepcopy(self._rng)
        return other
