"""forecast_step and calibrate_step: how wide the predicted errors really are, learned in flight, by
output and horizon.

    forecast_step    keeps COLUMNS forecasts under way, begun `every` samples apart; each goes on by f_d under the commands
                     that are really given. At every horizon its error is what is measured less what
                     it says.
    calibrate_step   missed = |E| > z(level) scale sigma,    log scale = own + common,
                     own+ = own + step (missed - (1 - level)),
                     common+ = common + 5 step (mean missed of the sensor's axes - (1 - level))

It is the online quantile of adaptive conformal inference (Gibbs and Candes 2021, NeurIPS 34) on log
|E| / sigma: no distribution is assumed, and one wild error counts no more than any that missed. The
scale that counts for an error is the one in force when its forecast began (delays: Angelopoulos,
Candes and Tibshirani 2023, NeurIPS 36), so the coverage is that of intervals as they were stated,
of what is measured every time; else of those stated as many measurements before.

What makes errors larger, gusts or a worse pose, mostly comes on all axes of a sensor together. Their
mean tells so with a third of the noise, and may be followed by larger steps; one axis that grows
alone takes its neighbours along, up to BURST, until their own part has come down. `common` is a
scorecaster in the sense of the second paper: whatever it says within 1 / BURST and BURST, sums of
(missed - (1 - level)) are differences of an axis's `own`, hence, whatever happens, from the start

    | share missed in T errors - (1 - level) |  <=  (log WIDEST + log BURST + (delay + 1) step) / (step T)

as long as the gain stays and |E| / (z sigma) lies between 1 / WIDEST and WIDEST. Beyond, an error is
missed; below, it is covered: the scale has ends, so that memory and the way back are bounded. A
sensor of one axis has no `common`, and no log BURST. A horizon of j times `every` sees each
disturbance j times; its step is gain / sqrt(j), between the delay of a small step and the noise of
a large one. With errors that are Gaussian as stated the mean width is 1 % above nominal at the
default gain, 3 to 4 % with three axes that err independently.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from greybox.symbolic import Expr, FloatArray, Layout, Signal
from mpc_export.semidefinite import half

LEVEL, GAIN = 0.95, 0.05
"""What a controller asks for by default: the share of errors that intervals hold, and the step of
log scale by sample."""
SPACING = 0.05
"""Time between two forecasts [s], to the nearest sample."""
MULTIPLES = (1, 2, 5, 10)
"""Horizons as multiples of that time, besides the next sample."""
COLUMNS = MULTIPLES[-1]
WIDEST = 100.0
"""Largest scale, and the inverse of the smallest."""
BURST = 10.0
"""The same of the part that axes have in common. With 3, of the errors three to six seconds after
gusts of 2 m/s more (six development flights of `scenarios.studies.shocks`) 91 % were held, with 10
there were 94 %."""
TOGETHER = 5.0
"""Step of that part in units of an axis's own. The scale of three axes then varies by about 1.7
times as much as one alone does."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Calibration:
    """Horizons of `calibrate_step` and the spread that the model states for them.

    `every` samples a forecast begins; `multiples` (n_h,) of it are the horizons, 0 for the next
    sample; `sigma` (n_e, n_h) are standard deviations of the errors at the model's reference point,
    in flight under known commands; `axes` are its rows that belong to one sensor and have a part of
    their scale in common.
    """

    every: int = 1
    multiples: tuple[int, ...] = ()
    sigma: FloatArray
    dt: float = 0.0
    axes: tuple[tuple[int, ...], ...] = ()

    @property
    def samples(self) -> tuple[int, ...]:
        """Horizons [samples]."""
        return tuple(max(1, k * self.every) for k in self.multiples)

    @property
    def horizons(self) -> Layout:
        """Horizons by name."""
        return Layout(
            [
                Signal(name=f"{n}_samples", unit="s", meaning=f"{n * self.dt:g} s ahead")
                for n in self.samples
            ]
        )

    @property
    def delays(self) -> tuple[int, ...]:
        """Updates between the beginning of a forecast and its error, by horizon."""
        return tuple(max(k - 1, 0) for k in self.multiples)

    @property
    def first(self) -> tuple[int, ...]:
        """Columns of theta that hold the scale in force, by horizon: own and common part stand
        before each, those in force at earlier updates follow."""
        return tuple(int(n) for n in np.cumsum([2, *(d + 3 for d in self.delays[:-1])]))

    @property
    def remembered(self) -> int:
        """Columns of theta."""
        return 3 * len(self.delays) + sum(self.delays)

    def start(self) -> dict[str, FloatArray]:
        """clock and theta before the first sample, where F (n_x, COLUMNS) is anything finite."""
        return {"clock": np.zeros(1), "theta": np.zeros((len(self.sigma), self.remembered))}


UNCALIBRATED = Calibration(sigma=np.zeros((0, 0)))


def calibration(
    functions: Mapping[str, ca.Function], stated: Stated, sensors: Sequence[str], dt: float
) -> Calibration:
    """Horizons at this sample time, and sigma from the covariance that the model states. `sensors`:
    that of every innovation; empty where nobody knows what outputs share."""
    every = max(1, round(SPACING / dt))
    multiples = (0, *(k for k in MULTIPLES if k * every > 1))
    made = Calibration(every=every, multiples=multiples, sigma=np.zeros((0, 0)), dt=dt)
    spread = stated.errors(functions, max(made.samples))
    rows = [[i for i, s in enumerate(sensors) if s == one] for one in dict.fromkeys(sensors)]
    return replace(
        made,
        sigma=spread[:, [n - 1 for n in made.samples]],
        axes=tuple(tuple(r) for r in rows if len(r) > 1),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Stated:
    """What a model says of its errors at a point (x, u, p): covariance P (n_d, n_d) of the filter's
    prediction, process Q (n_d, n_d), innovation S (n_e, n_e), `theta` (n_theta, n_theta) of the
    uncertain parameters."""

    point: tuple[FloatArray, FloatArray, FloatArray]
    predicted: FloatArray
    process: FloatArray
    innovation: FloatArray
    theta: FloatArray

    def errors(self, functions: Mapping[str, ca.Function], longest: int) -> FloatArray:
        """Standard deviations (n_e, longest) of what is measured 1, 2, ... samples after the last
        measurement that was used. Errors of the learned part and of the parameters stay as they
        are, those of states and sensors are fresh."""
        a = functions["f_d_jac"](*self.point)[1].full()
        constant = [np.zeros((len(a), 0))]
        if "gp_variance" in functions and "gp_features" in functions:
            z = functions["gp_features"](*self.point)[0]
            deviation = np.sqrt(
                np.maximum(functions["gp_variance"](z, self.point[2]).full().ravel(), 0.0)
            )
            constant.append(functions["B_d"](*self.point).full() * deviation)
        if "P_theta" in functions:
            constant.append(functions["P_theta"](*self.point).full() @ half(self.theta))
        push = np.hstack(constant)
        p, b, out = self.predicted, np.zeros_like(push), []
        for _ in range(longest):
            out.append(np.sqrt(np.maximum(np.diag(self._measured(functions, p, b)), 0.0)))
            p, b = a @ p @ a.T + self.process, a @ b + push
        return np.array(out).T

    def _measured(
        self, functions: Mapping[str, ca.Function], p: FloatArray, b: FloatArray
    ) -> FloatArray:
        """Covariance (n_e, n_e) of a measurement, where the state's is p + b b'."""
        if "output_consider" in functions:
            return np.asarray(functions["output_consider"](*self.point, p, b).full())
        if "output_covariance" in functions:
            return np.asarray(functions["output_covariance"](*self.point, p).full())
        c = functions["h_jac"](*self.point)[1].full()
        sensor = np.maximum(np.diag(self.innovation - c @ self.predicted @ c.T), 0.0)
        return np.asarray(c @ (p + b @ b.T) @ c.T + np.diag(sensor))


def forecast_function(
    functions: Mapping[str, ca.Function],
    formed: tuple[ca.Function, ca.Function],
    own: Calibration,
) -> ca.Function:
    """forecast_step(x, x_next, u, p, y, there, F, clock) -> F_next, clock_next, E, seen.

    `formed` map (y, y_hat, x) to e, and (there, y) to which of e count.

    x is the filter's state before the sample's measurement y, x_next after it and one sample on. F
    (n_x, COLUMNS): forecasts under way. E, seen (n_e, n_h): errors at the horizons, and whether
    each is one.
    """
    innovation, counted = formed
    step, out = functions["f_d"], functions["h"]
    x, u, p = (ca.MX.sym(n, step.numel_in(n)) for n in ("x", "u", "p"))
    x_next, y = ca.MX.sym("x_next", x.numel()), ca.MX.sym("y", innovation.numel_in(0))
    there, clock = ca.MX.sym("there", innovation.numel_out(0)), ca.MX.sym("clock")
    given = ca.MX.sym("F", x.numel(), COLUMNS)
    # what has not begun yet may be anything, such as a quaternion of no length
    under_way = ca.horzcat(
        *(ca.if_else(clock > k * own.every, given[:, k], x) for k in range(COLUMNS))
    )
    due = ca.fmod(clock, own.every) == 0
    on = ca.if_else(counted(there, y) != 0, 1.0, 0.0)
    errors, seen = [], []
    for k in own.multiples:
        at = x if k == 0 else under_way[:, k - 1]
        found = innovation(y, out(at, u, p), at)
        # as many forecasts have come so far as began before
        valid = on * (1.0 if k == 0 else ca.logic_and(due, clock >= k * own.every))
        errors.append(ca.if_else(valid != 0, found, 0.0))
        seen.append(valid)
    moved = [step(under_way[:, k], u, p) for k in range(COLUMNS)]
    begun = ca.horzcat(x_next, *moved[:-1])
    after = ca.if_else(due, begun, ca.horzcat(*moved))
    # counts on, and once all forecasts are under way the same period over and over
    longest = own.every * COLUMNS
    later = clock + 1 - longest * (clock + 1 >= 2 * longest)
    results = [after, later, ca.horzcat(*errors), ca.horzcat(*seen)]
    return ca.Function(
        "forecast_step",
        [x, x_next, u, p, y, there, given, clock],
        [ca.densify(r) for r in results],
        ["x", "x_next", "u", "p", "y", "there", "F", "clock"],
        ["F_next", "clock_next", "E", "seen"],
    )


def calibrate_function(own: Calibration) -> ca.Function:
    """calibrate_step(theta, E, seen, sigma, level, gain) -> theta_next, scale.

    theta (n_e, n_l): by horizon the own and the common part of the logarithm of the scale, the one
    in force and those of the updates before. scale (n_e, n_h): by how much wider the errors are
    than sigma (n_e, n_h) says, so that z(level) scale sigma holds `level` of them.
    """
    n_e, n_h = own.sigma.shape
    theta = ca.SX.sym("theta", n_e, own.remembered)
    error, seen, sigma = (ca.SX.sym(n, n_e, n_h) for n in ("E", "seen", "sigma"))
    level, gain = ca.SX.sym("level"), ca.SX.sym("gain")
    z, widest, burst = normal_half_width(level), math.log(WIDEST), ca.SX.zeros(n_e)
    burst[[i for rows in own.axes for i in rows]] = math.log(BURST)
    columns, scales = [], []
    for h, (k, delay, at) in enumerate(zip(own.multiples, own.delays, own.first, strict=True)):
        step = gain / math.sqrt(max(k, 1))
        end = widest + burst + (delay + 1) * step
        stated = z * ca.exp(theta[:, at + delay]) * sigma[:, h]
        # written so that an error that is no number is one that missed
        more = 1.0 - (ca.fabs(error[:, h]) <= stated) - (1.0 - level)
        alone = _within(theta[:, at - 2] + step * more, end)
        common = _within(theta[:, at - 1] + _together(more, seen[:, h], own.axes, step), burst)
        in_force = _within(alone + common, widest)
        there = ca.repmat(seen[:, h] != 0, 1, delay + 3)
        after = ca.horzcat(alone, common, in_force, theta[:, at : at + delay])
        columns.append(ca.if_else(there, after, theta[:, at - 2 : at + delay + 1]))
        scales.append(ca.exp(columns[-1][:, 2]))
    results = [ca.densify(ca.horzcat(*columns)), ca.densify(ca.horzcat(*scales))]
    return ca.Function(
        "calibrate_step",
        [theta, error, seen, sigma, level, gain],
        ca.cse(results),
        ["theta", "E", "seen", "sigma", "level", "gain"],
        ["theta_next", "scale"],
    )


def _within(value: ca.SX, end: float | ca.SX) -> ca.SX:
    return ca.fmax(ca.fmin(value, end), -end)


def _together(more: ca.SX, seen: ca.SX, axes: Sequence[Sequence[int]], step: ca.SX) -> ca.SX:
    """(n_e, 1): what the common part moves by, `more` (n_e, 1) having missed than should; a mean
    of two axes is followed half as far as one of three."""
    out = ca.SX.zeros(more.numel())
    for rows in map(list, axes):
        valid = ca.if_else(seen[rows] != 0, 1.0, 0.0)
        count = ca.sum1(valid)
        share = ca.fmin(ca.fmax(0.5 * (count - 1.0), 0.0), 1.0)
        mean = ca.sum1(valid * more[rows]) / ca.fmax(count, 1.0)
        out[rows] = TOGETHER * step * share * mean
    return out


def normal_half_width(level: Expr) -> Expr:
    """z with P(|N(0, 1)| <= z) = level, to 1e-7 for levels up to 0.9999: a closed start (Winitzki
    2008), then Newton."""
    inside = ca.log(1.0 - level * level)
    half = 2.0 / (math.pi * 0.147) + 0.5 * inside
    z = ca.sqrt(2.0 * (ca.sqrt(half * half - inside / 0.147) - half))
    for _ in range(2):
        density = math.sqrt(2.0 / math.pi) * ca.exp(-0.5 * z * z)
        z = z - (ca.erf(z / math.sqrt(2.0)) - level) / density
    return z
