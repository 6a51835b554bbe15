"""TubeController: measurement in, command out. Filter, delay compensation, target, one real-time
iteration, fallback.

Timing. The filter runs at every sample of the identified model. A plan is made every `every`
samples from the filter's prediction one sample ahead, with the command that will be in force until
then; its first command is applied at that sample. So the solver has one sample to compute in, and
that delay is part of the plan.

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
- calls do not come: the filter predicts over the gap. A clock that jumps back or by more than LATE
  is not followed: one sample has passed;
- flying on is not possible: a descent is declared (descent.py).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from greybox.errors import ModelError
from greybox.frames import GRAVITY, numeric
from greybox.model.identified import IdentifiedModel
from greybox.symbolic import FloatArray
from mpc_export.adaptation import UNBOUNDED, authority, flight_parameters, starting_as
from mpc_export.c_code import CKernel
from mpc_export.feedback import NEAR
from mpc_export.functions import ModelFunctions, model_functions
from mpc_export.standing import integrating
from mpc_export.tube.calibrated import Calibrated
from mpc_export.tube.correlation import innovations
from mpc_export.tube.descent import (
    AWAY,
    HELD,
    SLOW,
    UNSURE,
    Descent,
    Watch,
    Way,
    longest_without_pose,
)
from mpc_export.tube.gate import Gate, plausible
from mpc_export.tube.heading import TURN, room, turning, within
from mpc_export.tube.native import native
from mpc_export.tube.problem import TubeProblem
from mpc_export.tube.restless import Restless
from mpc_export.tube.rival import CLEARLY, Known, Rival, likelier
from mpc_export.tube.solver import Outcome, TubeSolver
from mpc_export.tube.stages import block
from mpc_export.tube.told import PUSH, Telling, heaviest, told

LATE = 0.25
"""A longer pause between two calls is a fault of the clock [s]."""
EARLY = 0.25
"""A call counts for another sample when it comes no more than this share of one too early for
it."""
FAILURES = 3
"""So many failed solutions in a row, and the next starts anew."""
MEASURED = {
    "position": ("x", "y", "z"),
    "velocity": ("vx", "vy", "vz"),
    "attitude": ("qw", "qx", "qy", "qz"),
    "rate": ("p", "q", "r"),
}
"""Blocks of the state that sensors give, and their columns."""
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
            model = _uncertain(model, self.adapt)
        self.functions: ModelFunctions = model_functions(
            model,
            dt=self.problem.dt,
            with_=("covariance", "target"),
            runtime_parameters=() if self.adapt is None else flight_parameters(model),
            measured=False,
        )
        self._make_filter(model)
        self.solver = TubeSolver(
            self.functions,
            self.problem,
            kernels=self.kernels,
            white=self.white,
            estimate=self._filter_covariance(),
            fresh=innovations(self.filter, self.every, len(self.functions.error_states)),
        )
        most, names = authority(model), self.filter.states.names
        self.most = np.array([most.get(names[i], UNBOUNDED) for i in self.solver.stages.free])
        rotors = self.model.physics.vehicle.rotors
        self._spin = np.array([float(r.spin) for r in rotors])
        self._turning = turning(np.array([r.position for r in rotors], dtype=float), self._spin)
        self._turned = self._turned_by()
        ends = self.problem.command_min, self.problem.command_max
        self.told = Telling(
            told(self.model, self.functions, self.solver.stages.steady, ends), self.filter
        )
        self._heaviest = heaviest(self.model)
        self.start()

    def _make_filter(self, model: IdentifiedModel) -> None:
        """The filter with its gate, and what it adapts, follows and calibrates."""
        wanted = [
            "filter",
            *(["calibrate"] if self.calibrate else []),
            *(["adapt"] if self.adapt is not None else []),
        ]
        self.filter: ModelFunctions = model_functions(model, with_=wanted)
        if self.adapt is not None:
            start = starting_as(self.filter.adapted, self.model, self.filter.noise.covariance)
            self.filter = replace(self.filter, adapted=start)
        noise = dict(
            zip(self.filter.error_states.names, np.diag(self.filter.noise.filtered), strict=True)
        )
        pushes = {
            at: f"d_{name.removeprefix('error.')}"
            for at, name in enumerate(self.filter.adapted.names)
            if name.startswith("error.disturbance.")
        }
        self._pushes = list(pushes)
        self._walk = np.array([noise[n] for n in pushes.values()])
        self.restless = Restless(
            self.filter, [self.filter.error_states.names.index(n) for n in pushes.values()]
        )
        self._learned = list(self.filter.adapted.rows)
        self._step = native(self.filter["filter_step"])
        self._adapt = native(self.filter["adapt_step"]) if self.adapt is not None else None
        self.calibrated = Calibrated(self.filter) if self.calibrate else None
        self.columns = self.filter.outputs.names
        groups = self.model.dynamics.innovation_columns
        self._present = [[self.columns.index(c) for c in names] for names in groups]
        self.gate = Gate(groups, self.filter.noise.innovation)
        self.blind = longest_without_pose(self.filter, groups)
        pose = ("x, y, z", "qw, qx, qy, qz")
        self._pose = [(k, rows) for k, (name, rows) in enumerate(self.gate.sensors) if name in pose]

    def _filter_covariance(self) -> FloatArray:
        """P_f of the filter at the model's sample time, in the error state of the plan; the history
        of commands is known."""
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
        self.estimate = np.asarray(first_state)
        self.past = [
            first_command.copy() for _ in range(1 + max(self.functions.delay.values(), default=0))
        ]
        self.steady = (self._state(), self.u.copy())
        self.p = self.functions.parameter_values.copy()
        self.told.start()
        self._unsure = self.filter.adapted.covariance.copy()
        self._steps = self.restless.start()
        self.count = 0
        self.plan: Plan | None = None
        self.descent: Descent | None = None
        self.events.clear()
        self.gate.start()
        if self.calibrated is not None:
            self.calibrated.start()
        self._rivals, self._denied = (Rival(), Rival()), False
        self._watch = Watch()
        self._told: float | None = None
        self._ahead = self._phase = 0.0
        self._first: float | None = None
        self._failures = 0
        self._mean, self._weak = self.u.copy(), np.zeros(len(self.u), dtype=bool)
        self._adrift = self._heavy = False
        self._seen = [math.inf] * len(
            self._pose
        )  # when a pose was last believed; infinity before the first sample
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
            return self._sample(_number(time), measured or {})

    def _sample(self, time: float, measured: Mapping[str, float | None]) -> FloatArray:
        passed = self._passed(time)
        assert self._told is not None
        time = self._told - self._ahead
        nothing: dict[str, float | None] = {}
        for k in range(passed - 1, 0, -1):
            self._see(time - k * self.model.sample_time, nothing, called=False)
        self._see(time, measured)
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

    def _passed(self, time: float) -> int:
        """Samples since the call before: 1, more where calls did not come. A clock that jumps is
        put right."""
        step = self.model.sample_time
        if self._told is None:
            self._told = time - step if math.isfinite(time) else 0.0
        gone = time - self._told
        if not -1e-9 <= gone <= LATE:
            if math.isfinite(gone):
                self._ahead += gone - step
                self._told = time
            else:
                self._told += step
            self._phase = 0.0
            self._note(self._told - self._ahead, "the clock jumps")
            return 1
        self._told = time
        # early and late calls even out: what is left of a sample counts at the next call
        self._phase += gone / step
        passed = max(1, int(self._phase + EARLY))
        self._phase = min(max(self._phase - passed, -1.0), 1.0)
        if passed > 1:
            self._note(time - self._ahead, "calls did not come")
        return passed

    def filtered(
        self, estimate: FloatArray, u: FloatArray, measured: Mapping[str, float | None]
    ) -> tuple[FloatArray, bool]:
        """The identified filter's estimate one sample after `estimate` under u, and whether
        anything was measured.

        Everything that is finite is believed.
        """
        y, there = self._there(measured)
        return self._step(estimate, u, self.p, y, there)[0].full().ravel(), bool(there.any())

    def _there(self, measured: Mapping[str, float | None]) -> tuple[FloatArray, FloatArray]:
        """(Values, zero where there are none (n_y,); which innovations they give (n_e,))."""
        y = plausible(self.columns, np.array([_number(measured.get(c)) for c in self.columns]))
        there = np.array([float(np.isfinite(y[rows]).all()) for rows in self._present])
        return np.nan_to_num(y), there

    def _see(self, time: float, measured: Mapping[str, float | None], called: bool = True) -> None:
        self._hear(time, measured)
        y, there = self._there(measured)
        before = Known(self.estimate, self.p[self._learned], self._unsure, self._steps)
        after, innovation, expected = self._filtered(before, y, there)
        share, believed = self.gate(innovation, there), there
        if (share < 1.0).any():
            moved, believed = self._believed(time, share, y, there, expected)
            after, _, _ = self._filtered(before, moved, believed)
        if called and not there.any():
            self._note(time, "no measurement")
        for j, (k, rows) in enumerate(self._pose):
            if (there[rows].all() and share[k] > 0.0) or math.isinf(self._seen[j]):
                self._seen[j] = time
        if np.isfinite(after.x).all():
            if self.calibrated is not None:
                self.calibrated.sees(self.estimate, after.x, self.u, self.p, y, believed)
            self._know(after)
        else:
            self._note(time, "the filter's estimate is not finite")
        self._challenge(time, before, y, there, innovation, bool((share == 0.0).any()))

    def _hear(self, time: float, measured: Mapping[str, float | None]) -> None:
        """What is told of run-time parameters, and what the push along the thrust says of them."""
        given = {one.name: _number(measured.get(one.name)) for one in self.told.own}
        self.p, self.estimate = self.p.copy(), self.estimate.copy()
        for what in self.told.sees(self.model.sample_time, given, self.p, self.estimate):
            self._note(time, what)
        names = self.filter.states.names
        heavy = PUSH in names and self.estimate[names.index(PUSH)] < self._heaviest
        if heavy and not self._heavy:
            self._note(time, "pushed down by a third of the weight: a load, or thrust is lost")
        self._heavy = heavy

    def _filtered(
        self, known: Known, y: FloatArray, there: FloatArray
    ) -> tuple[Known, FloatArray, FloatArray]:
        """(What is known at the next sample, innovation, expected measurement). Parameters and
        covariance stay where the filter's are not finite."""
        p = self.p.copy()
        p[self._learned] = known.theta
        if self._adapt is None:
            after, e, y_hat = self._step(known.x, self.u, p, y, there)
        else:
            after, learned, spread, e, y_hat = self._adapt(
                known.x, self.u, p, y, there, known.unsure, self.memory
            )
            theta, unsure = learned.full().ravel()[self._learned], spread.full()
            steps = self.restless.sees(known.steps, np.where(there > 0.0, e.full().ravel(), 0.0))
            unsure[self._pushes, self._pushes] += self.restless.more(steps) * self._walk
            if np.isfinite(theta).all() and np.isfinite(unsure).all():
                known = Known(known.x, theta, unsure, steps)
        return known._replace(x=after.full().ravel()), e.full().ravel(), y_hat.full().ravel()

    def _know(self, known: Known) -> None:
        self.estimate, self._unsure, self._steps = known.x, known.unsure, known.steps
        self.p = self.p.copy()
        self.p[self._learned] = known.theta

    def _challenge(
        self,
        time: float,
        before: Known,
        y: FloatArray,
        there: FloatArray,
        innovation: FloatArray,
        denied: bool,
    ) -> None:
        """Let an estimate that is begun at what is measured take over where it explains the
        measurements far better. before: what was known before this sample; denied: whether a
        sensor was not believed at all."""
        surprise = self.gate.surprise(innovation, there)
        for rival in self._rivals:
            if rival.known is not None:
                after, off, _ = self._filtered(rival.known, y, there)
                rival.goes_on(after, surprise - self.gate.surprise(off, there))
        posed = all(there[rows].all() for _, rows in self._pose)
        calm = posed and surprise < CLEARLY and not self.gate.wide.any()
        self._denied = denied or (self._denied and not calm)
        if (
            self._denied
            and surprise >= CLEARLY
            and posed
            and all(r.known is None for r in self._rivals)
        ):
            for rival, pushed in zip(self._rivals, (True, False), strict=True):
                begin = self._measured(before, y, there, pushed)
                rival.begins(self._filtered(begin, y, there)[0])
        rival = likelier(*self._rivals)
        if rival.believed:
            assert rival.known is not None
            self._note(time, "the filter starts anew")
            self._know(rival.known)
            self.gate.start()
            self._rivals, self._denied = (Rival(), Rival()), False
            if self.calibrated is not None:
                self.calibrated.anew()
            self._seen = [time] * len(self._pose)

    def _measured(self, before: Known, y: FloatArray, there: FloatArray, pushed: bool) -> Known:
        """What the measurements of one sample say, `pushed` as `before` is if rotors could hold
        against it; at rest where they say nothing. As unsure as the start of a flight, and of the
        push as well as before."""
        own = self.filter.own_states
        state = np.array(self.solver.stages.steady[0][:own])
        free = list(self.solver.stages.free)
        kept = [*range(len(self._learned))]
        unsure = self.filter.adapted.covariance.copy()
        unsure[np.ix_(kept, kept)] = before.unsure[np.ix_(kept, kept)]
        if pushed and (np.abs(before.x[free]) < self.most).all():
            state[free] = before.x[free]
            pushes = np.ix_(self._pushes, self._pushes)
            unsure[pushes] += before.unsure[pushes]
        for name, columns in MEASURED.items():
            at = [self.columns.index(c) for c in columns if c in self.columns]
            given = [there[i] > 0.0 for i, rows in enumerate(self._present) if set(rows) & set(at)]
            if len(at) == len(columns) and given and all(given):
                state[self._rows(name)] = y[at] / (
                    np.linalg.norm(y[at]) if name == "attitude" else 1.0
                )
        x = np.concatenate([state, before.x[own:]])
        return Known(x, before.theta, unsure, self.restless.start())

    def _believed(
        self, time: float, share: FloatArray, y: FloatArray, there: FloatArray, y_hat: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """y and `there` with every sensor moved toward what was expected, so that `share` of its
        innovation is left."""
        y, there = y.copy(), there.copy()
        for part, (name, at) in zip(share, self.gate.sensors, strict=True):
            if part == 0.0:
                self._note(time, f"not believed: {name}")
                there[at] = 0.0
            elif part < 1.0:
                self._note(time, f"doubted: {name}")
                rows = self._present[at[0]]
                # a quaternion and its negative are one attitude
                sign = -1.0 if len(rows) == 4 and y[rows] @ y_hat[rows] < 0 else 1.0
                y[rows] = y_hat[rows] + part * (sign * y[rows] - y_hat[rows])
        return y, there

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
        if self.calibrated is not None:
            data["wider"][:] = self.calibrated.wider(
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
                    min(self._seen, default=begin) < begin - SLOW,
                    self.blind - SLOW,
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


def _uncertain(model: IdentifiedModel, spread: Mapping[str, float]) -> IdentifiedModel:
    """The model with these standard deviations of parameters from flight to flight. Raises
    `ModelError`."""
    for name, sigma in spread.items():
        if name not in model.values:
            raise ModelError(
                f"adapt: the model has no parameter {name}",
                expected=", ".join(sorted(model.values)),
            )
        if not (math.isfinite(sigma) and sigma > 0):
            raise ModelError(
                f"adapt: {name} needs a standard deviation above zero", got=f"{sigma:g}"
            )
    # what they are off by is learned with them, and no error of the others any more
    covariance, names = model.covariance.copy(), model.covariance_names
    for name in spread:
        sigma, by = model.considered.get(name, (0.0, {}))
        moves = np.array([by.get(n, 0.0) for n in names])
        covariance -= sigma**2 * np.outer(moves, moves)
    return replace(
        model,
        covariance=covariance,
        flight_spread={
            **model.flight_spread,
            **{n: (model.values[n], s) for n, s in spread.items()},
        },
        considered={n: v for n, v in model.considered.items() if n not in spread},
    )


def _number(value: object) -> float:
    """As a number; NaN for what is none: None, text, an array."""
    try:
        return float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return math.nan


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
