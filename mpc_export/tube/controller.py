"""TubeController: measurement in, command out. Filter, delay compensation, target, one real-time
iteration, fallback.

Timing. The filter (estimator.py) runs at every sample of the identified model. A plan is made every
`every` samples from the filter's prediction one sample ahead, with the command that will be in
force until then; its first command is applied at that sample. So the solver has one sample to
compute in, and that delay is part of the plan.

Whatever decided it, a command comes into force in one place (`_take`), within the limits of command
and rate.

What may go wrong, and what is done; `events` says what happened when:

- a solution fails (a model function is not finite, the QP is not solved: neither to the end nor,
  cut off, so far that it meets its dynamics and limits): the plan before goes on, its next command
  plus the ancillary gain on the estimate, for as long as the plan lasts; then the ancillary gain
  about the path. A plan that failed three times in a row, or is older than itself, is replaced by a
  simulation of that fallback before the next attempt;
- measurements are missing, infinite, no numbers or cannot be believed (gate.py): the filter goes on
  without them;
- the estimate itself runs away: one begun at what is measured now takes over where that explains
  the measurements far better (rival.py);
- a plane or the tilt is beyond what the plan holds: it is soft, and passed as little as may be;
- a run-time parameter is not told, or cannot be: it follows the push along the thrust (told.py);
- calls do not come: the filter predicts over the gap. A clock that jumps is not followed
  (clock.py);
- flying on is not possible: a descent is declared (descent.py).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt

from greybox.errors import ModelError
from greybox.frames import GRAVITY, numeric
from greybox.model.identified import IdentifiedModel
from greybox.symbolic import FloatArray
from mpc_export.adaptation import flight_parameters, with_flight_spread
from mpc_export.c_code import CKernel
from mpc_export.feedback import NEAR
from mpc_export.functions import ModelFunctions, model_functions
from mpc_export.standing import integrating
from mpc_export.tube.clock import Clock
from mpc_export.tube.correlation import innovations
from mpc_export.tube.descent import AWAY, HELD, SLOW, UNSURE, Descent, Watch, Way
from mpc_export.tube.estimator import Estimator, flight_filter, number
from mpc_export.tube.heading import TURN, room, turning, within
from mpc_export.tube.problem import TubeProblem
from mpc_export.tube.solver import Outcome, TubeSolver
from mpc_export.tube.stages import block
from mpc_export.tube.told import told

FAILURES = 3
"""So many failed solutions in a row, and the next starts anew."""
NEAR_STEADY = 1e-6
"""A steady state that misses its condition by less is not looked for anew."""
ROUNDING = 1e-6
"""A command that its limits move by less is as it was decided: the QP is solved to this."""
SLACK = 1e-3
"""A plan that is farther beyond a tightened limit does not hold it [m, or cosine of the tilt]."""
GIVEN = 0.7
"""Part of the hover command below which, in the mean, nothing is said of weak rotors."""
MEAN = 0.3
"""Time constant of the mean command that weak rotors are judged by [s]."""


class PathSamples(Protocol):
    """Samples of a path at n times, world [m, s, rad]."""

    @property
    def position(self) -> FloatArray:
        """(n, 3)."""
        ...

    @property
    def velocity(self) -> FloatArray:
        """(n, 3)."""
        ...

    @property
    def acceleration(self) -> FloatArray:
        """(n, 3)."""
        ...

    @property
    def yaw(self) -> FloatArray:
        """(n,)."""
        ...


class Reference(Protocol):
    """A path over time."""

    def sample(self, time: FloatArray) -> PathSamples:
        """At the times (n,) [s]."""
        ...


class Planes(Protocol):
    """Position constraints along a path."""

    def __call__(self, time: FloatArray) -> FloatArray:
        """(n, planes, 4): normal and offset at the times (n,) of the reference; zeros and 1 where
        there is none."""
        ...


@dataclass(frozen=True, kw_only=True)
class Event:
    """Something that is not as usual: time [s] and what."""

    time: float
    what: str


@dataclass(kw_only=True)
class Plan:
    """What was decided last: outcome of the solver, time at which the plan starts, states and
    commands of it."""

    time: float
    outcome: Outcome
    x: FloatArray
    u: FloatArray


@dataclass(kw_only=True)
class TubeController:
    """Flies `reference` inside `planes` with the model of a file.

    kappa: standard deviations by which every plane, the tilt (last) and the commands are tightened:
    (planes + 1,) and `kappa_u`; zeros fly the nominal plan. integrate: the filter's and the plan's
    disturbances are constant between noise (no decay), which leaves no offset under a constant
    force (Pannocchia and Rawlings 2003, AIChE J. 49(2)); else they decay as identified, which suits
    gusts. white: the learned function's error is fresh at every stage, to compare. calibrate:
    planes and tilt are tightened by as much more or less as errors of forecasts turn out
    (calibrated.py). adapt: the filter learns parameters in flight and plans use them
    (adaptation.py): those that differ between the model's training flights, and those named, with
    the standard deviation that they may be off by ({}: the former alone; None: nothing). They are
    forgotten within `memory` [s], 0: never. Where disturbances walk faster than stated, they are
    followed faster (restless.py). lost [m]: farther from the reference than this, a descent is
    declared; only for references that do not jump. The sample time of `problem` must be a multiple
    of the model's. Raises `ModelError`, `BuildError`.
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
    calibrate: bool = False
    adapt: Mapping[str, float] | None = None
    memory: float = 10.0
    lost: float = math.inf
    events: list[Event] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._blocks: dict[tuple[str, bool], list[int]] = {}
        self.every = max(1, round(self.problem.dt / self.model.sample_time))
        model = integrating(self.model) if self.integrate else self.model
        if self.adapt is not None:
            if not 0.0 <= self.memory < math.inf:
                raise ModelError(
                    "adapt: memory is a time in seconds, 0 for ever", got=f"{self.memory:g} s"
                )
            model = with_flight_spread(model, self.adapt)
        self.functions: ModelFunctions = model_functions(
            model,
            dt=self.problem.dt,
            with_=("covariance", "target"),
            runtime_parameters=() if self.adapt is None else flight_parameters(model),
            measured=False,
        )
        f = flight_filter(self.model, model, calibrate=self.calibrate, adapt=self.adapt is not None)
        self.solver = TubeSolver(
            self.functions,
            self.problem,
            kernels=self.kernels,
            white=self.white,
            estimate=self._covariance_of(f),
            fresh=innovations(f, self.every, len(self.functions.error_states)),
        )
        ends = self.problem.command_min, self.problem.command_max
        self.estimator = Estimator(
            self.model,
            f,
            self.solver.stages,
            told(self.model, self.functions, self.solver.stages.steady, ends),
            memory=None if self.adapt is None else self.memory,
            calibrate=self.calibrate,
            note=self._note,
        )
        rotors = self.model.physics.vehicle.rotors
        self._spin = np.array([float(r.spin) for r in rotors])
        self._turning = turning(np.array([r.position for r in rotors], dtype=float), self._spin)
        self._turned = self._turned_by()
        self.start()

    @property
    def filter(self) -> ModelFunctions:
        """The functions of the identified filter, at the model's sample time."""
        return self.estimator.filter

    @property
    def estimate(self) -> FloatArray:
        """The state (n_x,) at the next sample, as the filter knows it."""
        return self.estimator.x

    @property
    def p(self) -> FloatArray:
        """The parameters (n_p,) that plans use: as told and as learned in flight."""
        return self.estimator.p

    def _covariance_of(self, f: ModelFunctions) -> FloatArray:
        """P_f of the filter f at the model's sample time, in the error state of the plan; the
        history of commands is known."""
        size = len(self.functions.error_states)
        own = size - (len(self.functions.states) - self.functions.own_states)
        full = np.zeros((size, size))
        full[:own, :own] = f.noise.covariance[:own, :own]
        return full

    def start(self, x: FloatArray | None = None, time: float = 0.0) -> None:
        """Forget everything; estimate x (n_x,), default hover at the reference's place."""
        self.solver.reset()
        kappa = np.zeros(self.problem.planes + 1)
        kappa[: len(self.kappa)] = self.kappa
        self.solver.data["kappa"][:] = kappa
        self.solver.data["kappa_u"][()] = self.kappa_u
        hover, steady = (np.array(v) for v in self.solver.stages.steady)
        # no command in force before the first is known of; it keeps its limits, if hover does not
        self.u = np.clip(steady, self.problem.command_min, self.problem.command_max)
        if x is not None and not np.isfinite(x).all():
            raise ModelError("the estimate to start from must be finite", got=str(x))
        if x is None:
            first = self.reference.sample(np.array([time]))
            hover[self._rows("position")] = first.position[0]
            hover[self._rows("attitude")] = numeric("from_euler", [0.0, 0.0, float(first.yaw[0])])[
                0
            ]
            x = hover
        own = self.filter.own_states
        first_state, first_command, _ = self.filter.sampled.extended(x[:own], self._column(self.u))
        self.estimator.start(np.asarray(first_state), self.functions.parameter_values.copy())
        self.past = [
            first_command.copy() for _ in range(1 + max(self.functions.delay.values(), default=0))
        ]
        self.steady = (self._state(), self.u.copy())
        self.count = 0
        self.plan: Plan | None = None
        self.descent: Descent | None = None
        self.events.clear()
        self._watch = Watch()
        self._clock = Clock(step=self.model.sample_time, note=self._note)
        self._first: float | None = None
        self._failures = 0
        self._mean, self._weak = self.u.copy(), np.zeros(len(self.u), dtype=bool)
        self._adrift = False
        data = self.solver.data
        data["x"][:], data["u"][:] = self._state(), self.u

    def _column(self, u: FloatArray) -> FloatArray:
        """The model's own input column: commands, and identified values of what else it takes."""
        column = np.array(self.model.reference_inputs, dtype=float)
        for i, name in enumerate(self.functions.inputs.names):
            column[self.model.dynamics.inputs.names.index(name)] = u[i]
        return column

    def _state(self) -> FloatArray:
        """The plan's state: the estimate, with the history of commands at the plan's sample
        time."""
        names, own = self.functions.states.names, self.functions.own_states
        state = np.concatenate([self.estimate[:own], np.zeros(len(names) - own)])
        for i, name in enumerate(names[own:], own):
            _, command, lag = name.split(".")
            state[i] = self.past[int(lag) - 1][self.functions.inputs[command]]
        return state

    def _rows(self, name: str, error: bool = False) -> list[int]:
        """Rows of a block of the state, or of the error state; looked up once."""
        if (name, error) not in self._blocks:
            self._blocks[name, error] = block(self.functions, name, error=error)
        return self._blocks[name, error]

    # -------------------------------------------------------------------------------- every sample

    @property
    def descending(self) -> bool:
        """Whether a descent was declared."""
        return self.descent is not None

    def sample(self, time: float, measured: Mapping[str, float | None] | None) -> FloatArray:
        """The command that is in force from the next sample on, (n_u,), given the measurements at
        `time` by column.

        Whatever is measured or told, it raises nothing and the command keeps its limits. Columns
        that are left out, None or no numbers are not measured; None for all: nothing is. The
        present value of a run-time parameter stands beside them, `vbat` [V] (told.py).
        """
        # nothing that overflows on its way to being rejected is an error of the caller's
        with np.errstate(all="ignore"):
            return self._sample(number(time), measured or {})

    def _sample(self, time: float, measured: Mapping[str, float | None]) -> FloatArray:
        passed = self._clock.passed(time)
        time = self._clock.now
        nothing: dict[str, float | None] = {}
        for k in range(passed - 1, 0, -1):
            self.estimator.sees(time - k * self.model.sample_time, nothing, self.u, called=False)
        self.estimator.sees(time, measured, self.u)
        plans = self.count // self.every
        self.count += passed
        due = self.count // self.every - plans
        if due:
            for _ in range(min(due, len(self.past))):
                self.past = [self.u.copy(), *self.past[:-1]]
            self._take(time, self._decide(time + self.model.sample_time))
        return self.u.copy()

    def _take(self, time: float, u: FloatArray) -> None:
        """The one place where a command comes into force: finite, within its limits and its
        rate."""
        if not np.isfinite(u).all():
            self._note(time, "the command is not finite")
            u = self.u
        allowed = self._allowed(u, self.u)
        if np.abs(allowed - u).max() > ROUNDING:
            self._note(time, "the command is beyond its limits")
        self.u = allowed

    def _allowed(self, u: FloatArray, before: FloatArray) -> FloatArray:
        """u within its limits, and nearer to `before` where the rate asks for it: what is in force
        beyond the limits goes back as fast as it may."""
        problem = self.problem
        inside = np.clip(u, problem.command_min, problem.command_max)
        return np.asarray(np.clip(inside, before - problem.rate_max, before + problem.rate_max))

    def _note(self, time: float, what: str) -> None:
        self.events.append(Event(time=time, what=what))

    # ---------------------------------------------------------------------------------- every plan

    def _decide(self, begin: float) -> FloatArray:
        problem, data, n = self.problem, self.solver.data, self.problem.horizon
        times: FloatArray = np.asarray(begin + problem.dt * np.arange(n + 1), dtype=float)
        path = self._path(begin, times)
        self._aim(path)
        data["x0"][:] = self._state()
        data["u_before"][:] = self.u
        data["p"][: len(self.p)] = self.p
        data["ref"][:, :3], data["ref"][:, 3:6] = path.position[:n], path.velocity[:n]
        data["ref"][:, 6], data["ref"][:, 7:] = path.yaw[:n], self.steady[1]
        data["kappa_u"][()] = self._affordable()
        if self.planes is not None:
            data["plane"][:] = self.planes(
                times if self.descent is None else np.full(n + 1, self.descent.time)
            )
        if self.estimator.calibrated is not None:
            data["wider"][:] = self.estimator.calibrated.wider(
                times - begin + self.model.sample_time, data["plane"]
            )
        before = (data["x"].copy(), data["u"].copy())
        on = 1 if self._first is None else round((begin - self._first) / problem.dt)
        if self._failures >= FAILURES or on > n:
            self._anew(path)
        else:
            for _ in range(on):
                self._shift()
        data["x_end"][:] = self._along(path, -1)
        if self.descent is not None or self._adrift:
            self._give_up_yaw()
        outcome = self.solver.solve()
        if outcome.status != 0:
            data["x"][:], data["u"][:] = before
            self._failures += 1
            self._note(begin, f"no solution (status {outcome.status}, QP {outcome.qp_status})")
            return self._fallback(begin, path)
        if outcome.qp_status != 0:
            self._note(
                begin, f"a plan within its limits, but not the best (QP {outcome.qp_status})"
            )
        beyond = data["slack"][1:].max(axis=0) > SLACK
        if beyond.any():
            names = [*(f"plane {j}" for j in range(problem.planes)), "the tilt"]
            which = ", ".join(n for n, over in zip(names, beyond, strict=True) if over)
            self._note(begin, f"a limit is not held by the plan: {which}")
        if outcome.clipped > ROUNDING:
            self._note(begin, "a plan was clipped to its limits")
        self._failures, self._first = 0, begin
        self.plan = Plan(time=begin, outcome=outcome, x=data["x"].copy(), u=data["u"].copy())
        return np.asarray(data["u"][0].copy())

    def _affordable(self) -> float:
        """Standard deviations by which the commands are tightened: as many as asked for, but of the
        way from the steady command to its limits half is left to the plan. A craft that hovers near
        a limit would sink else: tightened limits must hold the steady state (Mayne, Seron and
        Rakovic 2005, Automatica 41(2))."""
        problem, data, u = self.problem, self.solver.data, self.steady[1]
        room = 0.5 * np.minimum(problem.command_max - u, u - problem.command_min)
        taken = data["backoff_u"].max(axis=0)  # by the plan before, with its standard deviations
        share = np.min(room[taken > 0] / taken[taken > 0], initial=math.inf)
        # never so few that none are left: those come back in full once there is room again
        found = max(float(data["kappa_u"][()]) * float(share), ROUNDING * self.kappa_u)
        return min(self.kappa_u, found) if math.isfinite(found) else self.kappa_u

    def _path(self, begin: float, times: FloatArray) -> PathSamples:
        """The reference, or a descent, which is declared here."""
        if self.descent is None:
            path = self.reference.sample(times)
            place = self.estimate[self._rows("position")]
            away = float(np.linalg.norm(place - path.position[0]))
            reasons = {
                "no steady command within the limits": (bool(self._weak.any()), HELD),
                "position or attitude not measured": (
                    self.estimator.pose_believed(begin) < begin - SLOW,
                    self.estimator.blind - SLOW,
                ),
                f"more than {self.lost:g} m from the path": (not away <= self.lost, AWAY),
            }
            why = self._watch(self.problem.dt, reasons)
            if why is None:
                return self._slowly_turning(path)
            weak = ", ".join(
                n for n, w in zip(self.functions.inputs.names, self._weak, strict=True) if w
            )
            self._note(begin, f"descent declared: {why}{f' ({weak})' if weak else ''}")
            velocity = self.estimate[self._rows("velocity")].copy()
            self.descent = Descent(
                time=begin, position=place.copy(), velocity=velocity, yaw=self._heading()
            )
        return self.descent.sample(times)

    def _slowly_turning(self, path: PathSamples) -> Way:
        """The path with headings no farther from the estimated one than half of the command that the
        steady one leaves turns the vehicle within HELD, or than weighs as much as UNSURE in the
        place: the rest of the command is for the place."""
        low, high, near = (
            self.problem.command_min,
            self.problem.command_max,
            near_heading(self.problem),
        )
        ends = [0.5 * self._turned * v for v in room(self.steady[1], self._turning, low, high)]
        yaw, least, most = self._heading(), min(*ends, -near), max(*ends, near)
        away = np.arctan2(np.sin(path.yaw - yaw), np.cos(path.yaw - yaw))
        return Way(
            position=path.position,
            velocity=path.velocity,
            acceleration=path.acceleration,
            yaw=yaw + np.clip(away, least, most),
        )

    def _give_up_yaw(self) -> None:
        """The heading that the plan has anyway becomes its reference, and so does its rate at the
        end."""
        data, attitude, turn = self.solver.data, self._rows("attitude"), self._rows("rate")[2]
        yaw = numeric("euler", data["x"][:, attitude])[:, 2]
        data["ref"][:, 6] = yaw[:-1]
        end = data["x_end"]
        up = numeric("rotate", end[attitude], [0.0, 0.0, 1.0])[0]
        end[attitude], end[turn] = _tilted(up, float(yaw[-1])), data["x"][-1, turn]

    def _aim(self, path: PathSamples) -> None:
        """One Newton step of the steady state that holds the reference's place under the estimated
        disturbance.

        It goes on from the step before, or from hover where that misses the condition by less:
        after a disturbance that nothing holds against, Newton's method would not find back by
        itself.
        """
        goal = np.array([*path.position[0], path.yaw[0]])
        x, u, missed = self._steadier(*self.steady, goal)
        if not missed < NEAR_STEADY:
            again = self._steadier(*self.solver.stages.steady, goal)
            if not missed < again[2]:
                x, u, _ = again
        if np.isfinite(x).all() and np.isfinite(u).all():
            low, high = self.problem.command_min, self.problem.command_max
            held = within(u, self._turning, low, high)
            self.steady = x, np.clip(u, low, high) if held is None else held[0]
            self._adrift = held is not None and held[1] != 0.0
            # what is missing in a turn is no sign of weak rotors
            needed = self._needed(u if held is None else held[0])
            most = within(needed, self._turning, low, high)
            given = math.inf if held is None or most is None else abs(held[1]) + abs(most[1])
            turn = given * abs(self._turned) + HELD * abs(self.estimate[self._rows("rate")[2]])
            self._weak = ((u > high) | (needed > high)) & (not turn <= TURN)

    def _steadier(
        self, x: FloatArray, u: FloatArray, goal: FloatArray
    ) -> tuple[FloatArray, FloatArray, float]:
        """State and command after a Newton step from (x, u), and by how much (x, u) missed."""
        x, kept = x.copy(), self._rows("disturbance")
        x[kept] = self.estimate[kept]
        new_x, new_u, missed = self.functions["target_step"](x, u, self.p, goal)
        return new_x.full().ravel(), new_u.full().ravel(), float(np.abs(missed.full()).max())

    def _heading(self) -> float:
        """As estimated [rad]."""
        return float(numeric("euler", self.estimate[self._rows("attitude")])[0][2])

    def _turned_by(self) -> float:
        """By how much the vehicle turns from hover within HELD per unit of `_turning` [rad]."""
        size, (hover, u) = 1e-3, self.solver.stages.steady
        x, more = np.array(hover), np.sqrt(np.maximum(u**2 + size * self._turning, 0.0))
        for _ in range(math.ceil(HELD / self.problem.dt)):
            x = self.functions["f_d"](x, more, self.functions.parameter_values).full().ravel()
        turned = float(numeric("euler", x[self._rows("attitude")])[0][2])
        return turned / size if math.isfinite(turned) else 0.0

    def _needed(self, u: FloatArray) -> FloatArray:
        """Steady command (n_u,) if rotors are weak by a factor, where u (n_u,) holds against what
        acts now.

        What a rotor lost is a force and a torque to the filter, which grow with its command: as
        long as less is given, less seems to be needed. With thrust as the square of the command, a
        mean m that acts like m^2 - (u^2 - hover^2) says hover m / sqrt(m^2 - (u^2 - hover^2)). A
        model whose yaw torque has no noise shares one rotor's loss among four, with their spins'
        signs: the median over the rotors is that share.
        """
        hover = self.solver.stages.steady[1]
        self._mean += self.problem.dt / (self.problem.dt + MEAN) * (self.u - self._mean)
        more = u**2 - hover**2
        if len(self._spin) == len(u) == 4:
            more -= self._spin * np.median(self._spin * more)
        given = np.maximum(self._mean, 1e-3) ** 2
        weak = hover * np.sqrt(given / np.maximum(given - more, 0.01 * given))
        # In a dive so little is given that a load would look like a rotor without thrust.
        return np.asarray(np.where(self._mean > GIVEN * hover, np.maximum(u, weak), u))

    def _along(self, path: PathSamples, k: int) -> FloatArray:
        """State at sample k of the path: thrust along its acceleration and what the steady state
        holds against gravity and disturbances; rotors and rates at rest."""
        x = self.steady[0].copy()
        up = numeric("rotate", x[self._rows("attitude")], [0.0, 0.0, 1.0])[0]
        x[self._rows("position")], x[self._rows("velocity")] = path.position[k], path.velocity[k]
        x[self._rows("attitude")] = _tilted(
            path.acceleration[k] + GRAVITY * up / max(up[2], 0.1), float(path.yaw[k])
        )
        x[self._rows("rate")] = 0.0
        return np.asarray(x)

    def _shift(self) -> None:
        """The plan before, one stage on; its last command is held."""
        x, u = self.solver.data["x"], self.solver.data["u"]
        u[:-1] = u[1:].copy()
        x[:-1] = x[1:].copy()
        x[-1] = self.functions["f_d"](x[-2], u[-1], self.p).full().ravel()

    def _anew(self, path: PathSamples) -> None:
        """A plan that owes nothing to the one before: the fallback about the path, simulated from
        the estimate."""
        data, u = self.solver.data, self.u
        x = self._state()
        for k in range(self.problem.horizon):
            u = self._corrected(x, u, self._along(path, k), self.steady[1])
            data["x"][k], data["u"][k] = x, u
            after = self.functions["f_d"](x, u, self.p).full().ravel()
            x = after if np.isfinite(after).all() else self._along(path, k + 1)
        data["x"][-1] = x

    def _fallback(self, begin: float, path: PathSamples) -> FloatArray:
        """The plan before with the ancillary gain, while it lasts; then the gain about the path."""
        x, u = self._along(path, 0), self.steady[1]
        if self.plan is not None:
            k = round((begin - self.plan.time) / self.problem.dt)
            if 0 <= k < len(self.plan.u):
                x, u = self.plan.x[k], self.plan.u[k]
        return self._corrected(self._state(), self.u, x, u)

    def _corrected(
        self, state: FloatArray, before: FloatArray, x: FloatArray, u: FloatArray
    ) -> FloatArray:
        """u and the ancillary gain on what `state` is away from x, within the limits of command and
        rate."""
        away = self.functions["boxminus"](state, x).full().ravel()
        for name, most in NEAR.items():
            rows = self._rows(name, error=True)
            away[rows] *= min(1.0, most / max(float(np.linalg.norm(away[rows])), 1e-9))
        return self._allowed(u + self.solver.stages.gain @ away, before)


def near_heading(problem: TubeProblem) -> float:
    """Error of the heading that weighs as much as UNSURE in the place [rad]."""
    return min(UNSURE * problem.weights.position / max(problem.weights.yaw, ROUNDING), math.pi)


def _tilted(up: npt.NDArray[np.float64], yaw: float) -> FloatArray:
    """Attitude (w, x, y, z) with thrust along `up` and the body's x axis toward `yaw`."""
    z = up / max(float(np.linalg.norm(up)), 1e-9)
    y = np.cross(z, [math.cos(yaw), math.sin(yaw), 0.0])
    y /= max(float(np.linalg.norm(y)), 1e-9)
    r = np.column_stack([np.cross(y, z), y, z])
    w = 0.5 * math.sqrt(max(1.0 + np.trace(r), 1e-12))
    return np.array(
        [w, *(np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]) / (4.0 * w))]
    )
