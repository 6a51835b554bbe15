"""TubeController: measurement in, command out. Filter, delay compensation, target, one real-time iteration, fallback.

Timing. The filter runs at every sample of the identified model. A plan is made every `every` samples from the
filter's prediction one sample ahead, with the command that will be in force until then; its first command is applied at
that sample. So the solver has one sample to compute in, and that delay is part of the plan.

Fallback. Where a solution fails (a model function is not finite, the QP breaks down), the plan before goes on: its next
command plus the ancillary gain on the estimate, for as long as the plan lasts; then the ancillary gain about hover.
`events` says what happened when.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from greybox.frames import numeric
from greybox.model.identified import IdentifiedModel
from greybox.symbolic import FloatArray
from mpc_export.c_code import CKernel
from mpc_export.functions import ModelFunctions, model_functions
from mpc_export.tube.correlation import innovations
from mpc_export.tube.native import native
from mpc_export.tube.problem import TubeProblem
from mpc_export.tube.solver import Outcome, TubeSolver
from mpc_export.tube.stages import block

FOREVER = 1e6
"""Time constant [s] of a disturbance that is as good as constant."""
GRAVITY = 9.80665
"""Weighs the steady tilt against the acceleration of the path [m/s^2]."""


class Reference(Protocol):
    """A path over time: position, velocity, acceleration (n, 3), world; yaw (n,)."""

    def sample(self, time: FloatArray) -> Any:
        """At the times (n,) [s]."""
        ...


class Planes(Protocol):
    """Position constraints along a path."""

    def __call__(self, time: FloatArray) -> FloatArray:
        """(n, planes, 4): normal and offset at the times (n,) of the reference; zeros and 1 where there is none."""
        ...


@dataclass(frozen=True, kw_only=True)
class Event:
    """Something that is not as usual: time [s] and what."""

    time: float
    what: str


@dataclass(kw_only=True)
class Plan:
    """What was decided last: outcome of the solver, time at which the plan starts, states and commands of it."""

    time: float
    outcome: Outcome
    x: FloatArray
    u: FloatArray


@dataclass(kw_only=True)
class TubeController:
    """Flies `reference` inside `planes` with the model of a file.

    kappa: standard deviations by which every plane, the tilt (last) and the commands are tightened: (planes + 1,) and
    `kappa_u`; zeros fly the nominal plan. integrate: the filter's and the plan's disturbances are constant between noise
    (no decay), which leaves no offset under a constant force (Pannocchia and Rawlings 2003, AIChE J. 49(2)); else
    they decay as identified, which suits gusts. white: the learned function's error is fresh at every stage, to compare.
    The sample time of `problem` must be a multiple of the model's. Raises `ModelError`, `BuildError`.
    """

    model: IdentifiedModel
    problem: TubeProblem
    reference: Reference
    planes: Planes | None = None
    kappa: Sequence[float] = ()
    kappa_u: float = 0.0
    integrate: bool = True
    kernels: Sequence[CKernel] = ()
    white: bool = False
    events: list[Event] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.every = max(1, round(self.problem.dt / self.model.sample_time))
        model = _integrating(self.model) if self.integrate else self.model
        self.functions: ModelFunctions = model_functions(model, dt=self.problem.dt, with_=("covariance", "target"))
        self.filter: ModelFunctions = model_functions(model, with_=("filter",))
        self.solver = TubeSolver(
            self.functions, self.problem, kernels=self.kernels, white=self.white, estimate=self._filter_covariance(),
            fresh=innovations(self.filter, self.every, len(self.functions.error_states)),
        )  # fmt: skip
        self._step = native(self.filter["filter_step"])
        self.columns = self.filter.outputs.names
        self._present = [[self.columns.index(c) for c in names] for names in self.model.dynamics.innovation_columns]
        self.start()

    def _filter_covariance(self) -> FloatArray:
        """P_f of the filter at the model's sample time, in the error state of the plan; the history of commands is known."""
        size = len(self.functions.error_states)
        own = size - (len(self.functions.states) - self.functions.own_states)
        full = np.zeros((size, size))
        full[:own, :own] = self.filter.noise.covariance[:own, :own]
        return full

    def start(self, x: FloatArray | None = None, time: float = 0.0) -> None:
        """Forget everything; estimate x (n_x,), default hover at the reference's place."""
        self.solver.reset()
        kappa = np.zeros(self.problem.planes + 1)
        kappa[: len(self.kappa)] = self.kappa
        self.solver.data["kappa"][:] = kappa
        self.solver.data["kappa_u"][()] = self.kappa_u
        hover, self.u = (np.array(v) for v in self.solver.stages.steady)
        if x is None:
            first = self.reference.sample(np.array([time]))
            hover[self._rows("position")] = first.position[0]
            hover[self._rows("attitude")] = numeric("from_euler", [0.0, 0.0, float(first.yaw[0])])[0]
            x = hover
        own = self.filter.own_states
        first_state, first_command, _ = self.filter.sampled.extended(x[:own], self._column(self.u))
        self.estimate = np.asarray(first_state)
        self.past = [first_command.copy() for _ in range(1 + max(self.functions.delay.values(), default=0))]
        self.steady = (self._state(), self.u.copy())
        self.p = self.functions.parameter_values.copy()
        self.count = 0
        self.plan: Plan | None = None
        self.events.clear()
        data = self.solver.data
        data["x"][:], data["u"][:] = self._state(), self.u

    def _column(self, u: FloatArray) -> FloatArray:
        """The model's own input column: commands, and identified values of what else it takes."""
        column = np.array(self.model.reference_inputs, dtype=float)
        for i, name in enumerate(self.functions.inputs.names):
            column[self.model.dynamics.inputs.names.index(name)] = u[i]
        return column

    def _state(self) -> FloatArray:
        """The plan's state: the estimate, with the history of commands at the plan's sample time."""
        names, own = self.functions.states.names, self.functions.own_states
        state = np.concatenate([self.estimate[:own], np.zeros(len(names) - own)])
        for i, name in enumerate(names[own:], own):
            _, command, lag = name.split(".")
            state[i] = self.past[int(lag) - 1][self.functions.inputs[command]]
        return state

    def _rows(self, name: str) -> list[int]:
        return block(self.functions, name)

    # ------------------------------------------------------------------------------------------------ every sample

    def sample(self, time: float, measured: Mapping[str, float]) -> FloatArray:
        """The command that is in force from the next sample on, (n_u,), given the measurements at `time` by column."""
        self._see(time, measured)
        self.count += 1
        if self.count % self.every == 0:
            self.past = [self.u.copy(), *self.past[:-1]]
            self.u = self._decide(time + self.model.sample_time)
        return self.u

    def filtered(self, estimate: FloatArray, u: FloatArray, measured: Mapping[str, float]) -> tuple[FloatArray, bool]:
        """The identified filter's estimate one sample after `estimate` under u, and whether anything was measured."""
        y = np.array([float(measured.get(c, math.nan)) for c in self.columns])
        there = np.array([float(np.isfinite(y[rows]).all()) for rows in self._present])
        found = self._step(estimate, u, self.p, np.nan_to_num(y), there)[0].full().ravel()
        return found, bool(there.any())

    def _see(self, time: float, measured: Mapping[str, float]) -> None:
        for i, name in enumerate(self.functions.parameters.names):
            value = measured.get(name, math.nan)
            if math.isfinite(value):
                self.p[i] = value
        found, measured_any = self.filtered(self.estimate, self.u, measured)
        if not measured_any:
            self._note(time, "no measurement")
        if np.isfinite(found).all():
            self.estimate = found
        else:
            self._note(time, "the filter's estimate is not finite")

    def _note(self, time: float, what: str) -> None:
        self.events.append(Event(time=time, what=what))

    # ------------------------------------------------------------------------------------------------ every plan

    def _decide(self, begin: float) -> FloatArray:
        problem, data, n = self.problem, self.solver.data, self.problem.horizon
        times: FloatArray = np.asarray(begin + problem.dt * np.arange(n + 1), dtype=float)
        path = self.reference.sample(times)
        self._aim(path)
        data["x0"][:] = self._state()
        data["u_before"][:] = self.u
        data["p"][: len(self.p)] = self.p
        data["ref"][:, :3], data["ref"][:, 3:6] = path.position[:n], path.velocity[:n]
        data["ref"][:, 6], data["ref"][:, 7:] = path.yaw[:n], self.steady[1]
        data["x_end"][:] = self._end(path)
        if self.planes is not None:
            data["plane"][:] = self.planes(times)
        before = (data["x"].copy(), data["u"].copy())
        self._shift()
        outcome = self.solver.solve()
        if outcome.status != 0:
            data["x"][:], data["u"][:] = before
            self._note(begin, f"no solution (status {outcome.status}, QP {outcome.qp_status})")
            return self._fallback(begin)
        self.plan = Plan(time=begin, outcome=outcome, x=data["x"].copy(), u=data["u"].copy())
        return np.asarray(data["u"][0].copy())

    def _aim(self, path: Any) -> None:
        """One Newton step of the steady state that holds the reference's place under the estimated disturbance."""
        x, u = self.steady
        x = x.copy()
        kept = self._rows("disturbance")
        x[kept] = self.estimate[kept]
        goal = np.array([*path.position[0], path.yaw[0]])
        new_x, new_u, _ = self.functions["target_step"](x, u, self.p, goal)
        x, u = new_x.full().ravel(), new_u.full().ravel()
        if np.isfinite(x).all() and np.isfinite(u).all():
            self.steady = x, np.clip(u, self.problem.command_min, self.problem.command_max)

    def _end(self, path: Any) -> FloatArray:
        """Reference of the last stage: on the path, thrust along its acceleration and what the steady state holds against
        gravity and disturbances; rotors and rates at rest."""
        x = self.steady[0].copy()
        up = numeric("rotate", x[self._rows("attitude")], [0.0, 0.0, 1.0])[0]
        x[self._rows("position")], x[self._rows("velocity")] = path.position[-1], path.velocity[-1]
        x[self._rows("attitude")] = _tilted(path.acceleration[-1] + GRAVITY * up / max(up[2], 0.1), float(path.yaw[-1]))
        x[self._rows("rate")] = 0.0
        return np.asarray(x)

    def _shift(self) -> None:
        """The plan before, one stage on; its last command is held."""
        x, u = self.solver.data["x"], self.solver.data["u"]
        u[:-1] = u[1:].copy()
        x[:-1] = x[1:].copy()
        x[-1] = self.functions["f_d"](x[-2], u[-1], self.p).full().ravel()

    def _fallback(self, begin: float) -> FloatArray:
        stages = self.solver.stages
        x, u = self.steady
        if self.plan is not None:
            k = round((begin - self.plan.time) / self.problem.dt)
            if 0 <= k < len(self.plan.u):
                x, u = self.plan.x[k], self.plan.u[k]
        away = self.functions["boxminus"](self._state(), x).full().ravel()
        limited = np.clip(u + stages.gain @ away, self.u - self.problem.rate_max, self.u + self.problem.rate_max)
        return np.asarray(np.clip(limited, self.problem.command_min, self.problem.command_max))


def _integrating(model: IdentifiedModel) -> IdentifiedModel:
    """The model with disturbances that do not decay; the noise that drives them stays."""
    return model.with_values({n: FOREVER for n in model.values if n.startswith("disturbance.") and n.endswith(".T")})


def _tilted(up: npt.NDArray[np.float64], yaw: float) -> FloatArray:
    """Attitude (w, x, y, z) with thrust along `up` and the body's x axis toward `yaw`."""
    z = up / np.linalg.norm(up)
    y = np.cross(z, [math.cos(yaw), math.sin(yaw), 0.0])
    y /= np.linalg.norm(y)
    r = np.column_stack([np.cross(y, z), y, z])
    w = 0.5 * math.sqrt(max(1.0 + np.trace(r), 1e-12))
    return np.array([w, *(np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]) / (4.0 * w))])
