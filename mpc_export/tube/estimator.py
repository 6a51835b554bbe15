"""Estimator: what the tube controller knows of the flight, and how a measurement changes it.

The identified filter predicts and corrects; around it stand what it believes (gate.py), what may
take its place (rival.py), what it learns in flight (adaptation.py, restless.py, told.py) and how
far its forecasts err (calibrated.py).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from greybox.model.identified import IdentifiedModel
from greybox.symbolic import FloatArray
from mpc_export.adaptation import UNBOUNDED, authority, starting_as
from mpc_export.functions import ModelFunctions, model_functions
from mpc_export.tube.calibrated import Calibrated
from mpc_export.tube.descent import longest_without_pose
from mpc_export.tube.gate import Gate, plausible
from mpc_export.tube.native import native
from mpc_export.tube.restless import Restless
from mpc_export.tube.rival import CLEARLY, Known, Rival, likelier
from mpc_export.tube.stages import Stages, block
from mpc_export.tube.told import PUSH, Telling, Told, heaviest

MEASURED = {
    "position": ("x", "y", "z"),
    "velocity": ("vx", "vy", "vz"),
    "attitude": ("qw", "qx", "qy", "qz"),
    "rate": ("p", "q", "r"),
}
"""Blocks of the state that sensors give, and their columns."""


def flight_filter(
    model: IdentifiedModel, flown: IdentifiedModel, *, calibrate: bool, adapt: bool
) -> ModelFunctions:
    """The filter of `flown`, which is `model` as it is flown: with steady disturbances, parameters
    that it is unsure of. With what is needed to `calibrate` tightening and to `adapt` in flight."""
    wanted = ["filter", *(["calibrate"] if calibrate else []), *(["adapt"] if adapt else [])]
    found: ModelFunctions = model_functions(flown, with_=wanted)
    if not adapt:
        return found
    start = starting_as(found.adapted, model, found.noise.covariance)
    return replace(found, adapted=start)


class Estimator:
    """State x (n_x,) and parameters p (n_p,) at the next sample, and what may change them.

    `memory` [s] after which parameters are forgotten, 0: never; None: none are learned. `note` gets
    time [s] and what is not as usual.
    """

    def __init__(
        self,
        model: IdentifiedModel,
        f: ModelFunctions,
        stages: Stages,
        told: tuple[Told, ...],
        *,
        memory: float | None,
        calibrate: bool,
        note: Callable[[float, str], None],
    ) -> None:
        self.filter, self._note = f, note
        self._memory, self._sample_time = memory or 0.0, model.sample_time
        self._steady, self._free = stages.steady[0], list(stages.free)
        noise = dict(zip(f.error_states.names, np.diag(f.noise.filtered), strict=True))
        pushes = {
            at: f"d_{name.removeprefix('error.')}"
            for at, name in enumerate(f.adapted.names)
            if name.startswith("error.disturbance.")
        }
        self._pushes = list(pushes)
        self._walk = np.array([noise[n] for n in pushes.values()])
        self.restless = Restless(f, [f.error_states.names.index(n) for n in pushes.values()])
        self._learned = list(f.adapted.rows)
        self._step = native(f["filter_step"])
        self._adapt = None if memory is None else native(f["adapt_step"])
        self.calibrated = Calibrated(f) if calibrate else None
        self.columns = f.outputs.names
        groups = model.dynamics.innovation_columns
        self._present = [[self.columns.index(c) for c in names] for names in groups]
        self.gate = Gate(groups, f.noise.innovation)
        self.blind = longest_without_pose(f, groups)
        pose = ("x, y, z", "qw, qx, qy, qz")
        self.pose = [(k, rows) for k, (name, rows) in enumerate(self.gate.sensors) if name in pose]
        most = authority(model)
        self.most = np.array([most.get(f.states.names[i], UNBOUNDED) for i in self._free])
        self.told, self._heaviest = Telling(told, f), heaviest(model)

    def start(self, x: FloatArray, p: FloatArray) -> None:
        """Forget everything; x (n_x,) and p (n_p,) are believed."""
        self.x, self.p = x, p
        self.told.start()
        self._unsure = self.filter.adapted.covariance.copy()
        self._steps = self.restless.start()
        self.gate.start()
        if self.calibrated is not None:
            self.calibrated.start()
        self._rivals, self._denied = (Rival(), Rival()), False
        self._heavy = False
        # when a pose was last believed; infinity before the first sample
        self._seen = [math.inf] * len(self.pose)

    def pose_believed(self, otherwise: float) -> float:
        """Time at which the sensor of the pose that is longest missing was believed last [s];
        `otherwise` where none measures it."""
        return min(self._seen, default=otherwise)

    def filtered(
        self, estimate: FloatArray, u: FloatArray, measured: Mapping[str, float | None]
    ) -> tuple[FloatArray, bool]:
        """The identified filter's estimate one sample after `estimate` under u, and whether
        anything was measured.

        Everything that is finite is believed.
        """
        y, there = self._there(measured)
        return self._step(estimate, u, self.p, y, there)[0].ravel(), bool(there.any())

    def _there(self, measured: Mapping[str, float | None]) -> tuple[FloatArray, FloatArray]:
        """(Values, zero where there are none (n_y,); which innovations they give (n_e,))."""
        y = plausible(self.columns, np.array([number(measured.get(c)) for c in self.columns]))
        there = np.array([float(np.isfinite(y[rows]).all()) for rows in self._present])
        return np.nan_to_num(y), there

    def sees(
        self,
        time: float,
        measured: Mapping[str, float | None],
        u: FloatArray,
        called: bool = True,
    ) -> None:
        """One sample on under u, given what is measured and told at `time`; `called`: whether
        something should have been."""
        self._hear(time, measured)
        y, there = self._there(measured)
        before = Known(self.x, self.p[self._learned], self._unsure, self._steps)
        after, innovation, expected = self._filtered(before, u, y, there)
        share, believed = self.gate(innovation, there), there
        if (share < 1.0).any():
            moved, believed = self._believed(time, share, y, there, expected)
            after, _, _ = self._filtered(before, u, moved, believed)
        if called and not there.any():
            self._note(time, "no measurement")
        for j, (k, rows) in enumerate(self.pose):
            if (there[rows].all() and share[k] > 0.0) or math.isinf(self._seen[j]):
                self._seen[j] = time
        if np.isfinite(after.x).all():
            if self.calibrated is not None:
                self.calibrated.sees(self.x, after.x, u, self.p, y, believed)
            self._know(after)
        else:
            self._note(time, "the filter's estimate is not finite")
        self._challenge(time, before, u, y, there, innovation, bool((share == 0.0).any()))

    def _hear(self, time: float, measured: Mapping[str, float | None]) -> None:
        """What is told of run-time parameters, and what the push along the thrust says of them."""
        given = {one.name: number(measured.get(one.name)) for one in self.told.own}
        self.p, self.x = self.p.copy(), self.x.copy()
        for what in self.told.sees(self._sample_time, given, self.p, self.x):
            self._note(time, what)
        names = self.filter.states.names
        heavy = PUSH in names and self.x[names.index(PUSH)] < self._heaviest
        if heavy and not self._heavy:
            self._note(time, "pushed down by a third of the weight: a load, or thrust is lost")
        self._heavy = heavy

    def _filtered(
        self, known: Known, u: FloatArray, y: FloatArray, there: FloatArray
    ) -> tuple[Known, FloatArray, FloatArray]:
        """(What is known at the next sample, innovation, expected measurement). Parameters and
        covariance stay where the filter's are not finite."""
        p = self.p.copy()
        p[self._learned] = known.theta
        if self._adapt is None:
            after, e, y_hat = self._step(known.x, u, p, y, there)
        else:
            after, learned, spread, e, y_hat = self._adapt(
                known.x, u, p, y, there, known.unsure, self._memory
            )
            theta, unsure = learned.ravel()[self._learned], spread
            steps = self.restless.sees(known.steps, np.where(there > 0.0, e.ravel(), 0.0))
            unsure[self._pushes, self._pushes] += self.restless.more(steps) * self._walk
            if np.isfinite(theta).all() and np.isfinite(unsure).all():
                known = Known(known.x, theta, unsure, steps)
        return known._replace(x=after.ravel()), e.ravel(), y_hat.ravel()

    def _know(self, known: Known) -> None:
        self.x, self._unsure, self._steps = known.x, known.unsure, known.steps
        self.p = self.p.copy()
        self.p[self._learned] = known.theta

    def _challenge(
        self,
        time: float,
        before: Known,
        u: FloatArray,
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
                after, off, _ = self._filtered(rival.known, u, y, there)
                rival.goes_on(after, surprise - self.gate.surprise(off, there))
        posed = all(there[rows].all() for _, rows in self.pose)
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
                rival.begins(self._filtered(begin, u, y, there)[0])
        rival = likelier(*self._rivals)
        if rival.believed:
            assert rival.known is not None
            self._note(time, "the filter starts anew")
            self._know(rival.known)
            self.gate.start()
            self._rivals, self._denied = (Rival(), Rival()), False
            if self.calibrated is not None:
                self.calibrated.anew()
            self._seen = [time] * len(self.pose)

    def _measured(self, before: Known, y: FloatArray, there: FloatArray, pushed: bool) -> Known:
        """What the measurements of one sample say, `pushed` as `before` is if rotors could hold
        against it; at rest where they say nothing. As unsure as the start of a flight, and of the
        push as well as before."""
        own = self.filter.own_states
        state = np.array(self._steady[:own])
        free = self._free
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
                state[block(self.filter, name)] = y[at] / (
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


def number(value: object) -> float:
    """As a number; NaN for what is none: None, text, an array."""
    try:
        return float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return math.nan
