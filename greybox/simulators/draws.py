"""Draws: craft as uncertain as the identification left them, for domain randomisation.

Three sources: the joint posterior of the shared parameters, the spread of per-flight parameters
between the training flights, and what remains unexplained, which is not a number of the craft but a
push in flight (`pushes` has its level and time).

Every draw is a body that can be: the posterior is cut to positive inertia that obeys the triangle
inequality, by drawing again what is none, which keeps all correlations. (Drawing the log-Cholesky
factor of the second moments instead, after Rucker and Wensing 2022, IEEE RA-L 7(2), also gives
bodies only. But the covariance has to be carried over linearly, and a flat craft, whose second
moment along z is as uncertain as it is large, then comes out several times too wide.) Other
parameters that cannot be negative are drawn in their logarithm where that is nearly the same (sigma
below half of the value), the rest as they are, cut at their bounds.
"""

from __future__ import annotations

import io
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from greybox.errors import DataError
from greybox.model.identified import IdentifiedModel
from greybox.model.parameter import Parameter
from greybox.simulators.command_text import EFFECTS as COMMANDS
from greybox.simulators.craft import Craft, of_a_body
from greybox.simulators.laws import linear_drag
from greybox.simulators.principal_axes import principal_axes
from greybox.simulators.targets.crazyflow import PER_MINUTE, SHORTEST_LAG
from greybox.simulators.targets.mujoco import tangent, yaw_ratio
from greybox.simulators.words import square_at_hover
from greybox.symbolic import BoolArray, FloatArray

MOMENTS = ("inertia.xx", "inertia.yy", "inertia.zz")
RELATIVE = 0.5
"""Sigma over value below which a parameter that cannot be negative is drawn in its logarithm."""
ROUNDS = 200
"""How often draws that are no body are drawn again."""
IN_MJX = ("motor_lag", "rotor_asymmetry")
"""Effects of rotors that MuJoCo's model has arrays for."""
MOST_DRAWS = 1_000_000


@dataclass(frozen=True, kw_only=True, eq=False)
class Draws:
    """`values` (n, n_p), one craft per row, columns `names` (all parameters of the model, order of
    simulate.py). `drawn` names those that vary; what the fit held is held."""

    craft: Craft
    names: tuple[str, ...]
    values: FloatArray
    drawn: tuple[str, ...]
    seed: int

    def __len__(self) -> int:
        return len(self.values)

    def column(self, name: str) -> FloatArray:
        """Values (n,) of one parameter."""
        return np.asarray(self.values[:, self.names.index(name)])

    def one(self, i: int) -> Craft:
        """The craft of a row."""
        row = dict(zip(self.names, self.values[i].tolist(), strict=True))
        own = {n: row.get(n, v) for n, v in self.craft.values.items()}
        return replace(self.craft, values=own)

    def files(self) -> dict[str, str | bytes]:
        """draws.npz (everything, for simulate.py) and ranges.toml; the same draws under the names
        of other simulators: mjx.npz (fields of MuJoCo's model), isaac.npz (arguments of rigid body
        views, and of Pegasus), and for a craft with even rotors and no gyroscopic torque
        crazyflow.npz."""
        every = [self.one(i) for i in range(len(self))]
        files: dict[str, str | bytes] = {
            "draws/draws.npz": _npz({"names": np.array(self.names), "values": self.values}),
            "draws/ranges.toml": self.ranges(),
        }
        files["draws/mjx.npz"] = _npz(_mjx(every))
        files["draws/isaac.npz"] = _npz(_isaac(every, self.craft.strength))
        if not self._apart:
            files["draws/crazyflow.npz"] = _npz(_crazyflow(every))
        return files

    @property
    def _apart(self) -> tuple[str, ...]:
        """Effects that crazyflow's arrays cannot have one per craft."""
        return tuple(e for e in ("rotor_asymmetry", "rotor_gyroscopic") if e in self._effects)

    @property
    def _effects(self) -> tuple[str, ...]:
        """Effects of which a draw has any parameter that does not switch it off."""
        return tuple(
            e.name
            for e in self.craft.physics.effects
            if any(
                (self.column(f"{e.name}.{d.name}") != d.null).any()
                for d in e.parameters(self.craft.physics.vehicle)
                if f"{e.name}.{d.name}" in self.names
            )
        )

    @property
    def notes(self) -> tuple[str, ...]:
        """What files of simulators lack that draws.npz has, one line per file."""
        stage = {e.name: e.stage for e in self.craft.physics.effects}
        lost = [
            n
            for n in self._effects
            if n not in IN_MJX and stage[n] in ("rotor", "thrust", "wrench") and n not in COMMANDS
        ]
        notes = []
        if lost:
            what = f"draws/mjx.npz is without {', '.join(lost)}"
            notes.append(f"{what}: arrays of MJX have no place for them, nor for callback.py")
        if self._apart:
            what = f"no draws/crazyflow.npz: its arrays cannot say {' or '.join(self._apart)}"
            notes.append(what)
        return tuple(notes)

    def ranges(self) -> str:
        """TOML of the central 95 % of every parameter that varies: a box for simulators that take
        nothing else; it forgets the correlations."""
        lines = [
            f"# Central 95 % of {len(self)} draws (seed {self.seed}) of {self.craft.name}; the box",
            "# forgets the correlations, draws.npz has them.",
        ]
        units = {d.name: d.unit for d in self.craft.source.dynamics.parameters}
        for name in self.drawn:
            v = self.column(name)
            low, high = np.quantile(v, (0.025, 0.975))
            lines += [
                f'["{name}"]',
                f"low = {float(low)!r}",
                f"high = {float(high)!r}",
                f"mean = {float(v.mean())!r}",
                f"standard_deviation = {float(v.std())!r}",
                f'unit = "{units[name]}"',
            ]
        return "\n".join(lines) + "\n"

    def summary(self) -> str:
        """One line per parameter that varies."""
        lines = [f"{len(self)} draws, seed {self.seed}:"]
        for name in self.drawn:
            v = self.column(name)
            mean = float(v.mean())
            share = f" ({100 * float(v.std()) / abs(mean):.1f} %)" if mean else ""
            lines.append(f"  {name:28} {mean:.4g} +- {float(v.std()):.2g}{share}")
        return "\n".join(lines)


def draw(model: IdentifiedModel, count: int, seed: int = 0) -> Draws:
    """`count` craft. Raises `DataError` for no number of draws or a negative seed, `ModelError` as `Craft.of`."""
    if not 1 <= count <= MOST_DRAWS:
        raise DataError("number of draws", expected=f"1 .. {MOST_DRAWS}", got=str(count))
    if seed < 0:
        raise DataError("seed of the draws", expected="a whole number from 0", got=str(seed))
    craft = Craft.of(model)
    declared = {d.name: d for d in model.dynamics.parameters}
    names = tuple(declared)
    random = np.random.default_rng(seed)
    (of_flights,) = random.spawn(1)  # so that shared parameters are drawn alike with and without
    mean = np.array([float(model.values[n]) for n in names])
    values = np.tile(mean, (count, 1))
    shared = [n for n in model.covariance_names if n in declared]
    between = [n for n, (_, s) in model.flight_spread.items() if s > 0 and math.isfinite(s)]
    drawn = (*shared, *between)
    root, sigma = np.zeros((0, 0)), np.zeros(0)
    if shared:
        picked = [list(model.covariance_names).index(n) for n in shared]
        covariance = model.covariance[np.ix_(picked, picked)]
        root, sigma = _root(covariance), np.sqrt(np.diag(covariance))
    turned = any(n in MOMENTS or n.startswith("products_of_inertia.") for n in drawn)
    again = np.arange(count)
    for _ in range(ROUNDS):
        steps = random.standard_normal((len(again), len(shared))) @ root.T
        for k, name in enumerate(shared):
            at = names.index(name)
            values[again, at] = _moved(declared[name], mean[at], sigma[k], steps[:, k])
        for name in between:
            centre, spread = model.flight_spread[name]
            step = spread * of_flights.standard_normal(len(again))
            values[again, names.index(name)] = _moved(declared[name], centre, spread, step)
        again = again[~_bodies(craft, names, values[again])] if turned else again[:0]
        if not len(again):
            break
    else:
        raise DataError(
            f"{craft.title}: hardly any inertia within the fit's covariance and the spread between "
            "flights is that of a body",
            fix="fit with a prior on the inertia",
        )
    return Draws(craft=craft, names=names, values=values, drawn=drawn, seed=seed)


def _root(covariance: FloatArray) -> FloatArray:
    """A matrix R with R R' the covariance, singular ones included."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return np.asarray(scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))


def _moved(d: Parameter, mean: float, sigma: float, step: FloatArray) -> FloatArray:
    """Values (n,) of a parameter moved by `step` (n,), inside its bounds."""
    if d.name in MOMENTS:
        return np.asarray(mean + step)
    if d.lower >= 0.0 and mean > 0.0 and sigma < RELATIVE * mean:
        return np.asarray(np.minimum(mean * np.exp(step / mean), d.upper))
    return np.asarray(np.clip(mean + step, d.lower, d.upper))


def _bodies(craft: Craft, names: tuple[str, ...], values: FloatArray) -> BoolArray:
    """Which rows (n,) have an inertia that is positive and obeys the triangle inequality."""
    j = np.tile(craft.inertia, (len(values), 1, 1))
    for i, name in enumerate(MOMENTS):
        j[:, i, i] = values[:, names.index(name)]
    for name, i, k in (("Jxy", 0, 1), ("Jxz", 0, 2), ("Jyz", 1, 2)):
        full = f"products_of_inertia.{name}"
        if full in names:
            j[:, i, k] += values[:, names.index(full)] - craft.get(full)
            j[:, k, i] = j[:, i, k]
    return of_a_body(np.linalg.eigvalsh(j))


# ---------------------------------------------------------------- under the names of simulators


def _npz(arrays: Mapping[str, FloatArray]) -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]
    return stream.getvalue()


def _mjx(every: list[Craft]) -> dict[str, FloatArray]:
    """Fields of MjModel, one row per craft, for `model.replace(**fields)` under vmap: the world and
    the craft are bodies 0 and 1. Without callback.py, as MJX flies."""
    n = every[0].count
    axes = [principal_axes(c.inertia) for c in every]
    strength = np.array([c.strength for c in every])
    slope, offset, largest = (
        np.array(v)[:, None] * strength for v in zip(*(tangent(c) for c in every), strict=True)
    )
    lag = np.array([max(c.get("motor_lag.tau"), SHORTEST_LAG) for c in every])

    def numbers(*first: FloatArray, size: int = 10) -> FloatArray:
        """(draws, n, size): the first numbers (draws,) or (draws, n), the rest zero."""
        out = np.zeros((len(every), n, size))
        for k, value in enumerate(first):
            out[..., k] = value if value.ndim == 2 else value[:, None]
        return out

    def bodies(value: FloatArray, world: FloatArray) -> FloatArray:
        return np.stack([np.broadcast_to(world, value.shape), value], axis=1)

    mass = np.array([c.mass for c in every])
    ratio = np.array([yaw_ratio(c) for c in every])
    one, zero = np.ones(len(every)), np.zeros(len(every))
    return {
        "body_mass": bodies(mass, np.zeros(1)),
        "body_subtreemass": bodies(mass, mass),
        "body_ipos": bodies(np.array([c.center_of_mass for c in every]), np.zeros(3)),
        "body_inertia": bodies(np.array([m for m, _ in axes]), np.zeros(3)),
        "body_iquat": bodies(np.array([q for _, q in axes]), np.array([1.0, 0.0, 0.0, 0.0])),
        "actuator_gear": numbers(zero, zero, one, zero, zero, ratio, size=6),
        "actuator_dynprm": numbers(lag),
        "actuator_gainprm": numbers(slope),
        "actuator_biasprm": numbers(offset),
        "actuator_forcerange": numbers(zero, largest, size=2),
    }


def _isaac(every: list[Craft], carried: FloatArray) -> dict[str, FloatArray]:
    """Masses (n, 1), inertia about the centre of mass in body axes (n, 9), centre of mass from the
    body's origin (n, 3) with the axes of the body (w, x, y, z); and Pegasus' thrust curve and
    linear drag. `carried`: strength (n,) of the rotors that commands.py scales speeds by."""
    square = 1.0 / every[0].speed_max**2
    factor = square * np.array([c.strength for c in every]) / carried
    thrust, torque = (
        np.array([[square_at_hover(getattr(c, key), c.hover_nu)] for c in every])
        for key in ("thrust", "torque")
    )
    return {
        "masses": np.array([[c.mass] for c in every]),
        "inertias": np.array([c.inertia.ravel() for c in every]),
        "com_positions": np.array([c.center_of_mass for c in every]),
        "com_orientations": np.tile([1.0, 0.0, 0.0, 0.0], (len(every), 1)),
        "rotor_constant": thrust * factor,
        "rolling_moment_coefficient": torque * factor,
        "drag": np.array([linear_drag(c) for c in every]),
    }


def _crazyflow(every: list[Craft]) -> dict[str, FloatArray]:
    """Arguments of first_principles.dynamics, one row per craft."""
    first = every[0]
    scale = first.speed_max * PER_MINUTE
    powers = scale ** -np.arange(3.0)
    j = np.array([c.inertia for c in every])
    lags = np.maximum(np.array([c.lags for c in every]), SHORTEST_LAG)
    zero = np.zeros(len(every))
    length = float(np.abs(first.arms[:, :2]).max())
    arms = np.array([c.arms for c in every])
    spins = np.tile(-first.spins, (len(every), 1))
    return {
        "mass": np.array([c.mass for c in every]),
        "J": j,
        "J_inv": np.linalg.inv(j),
        "rpm2thrust": np.array([c.thrust for c in every]) * powers,
        "rpm2torque": np.array([c.torque for c in every]) * powers,
        "rotor_dyn_coef": np.stack([1 / lags[:, 0], zero, 1 / lags[:, 1], zero], axis=1),
        "drag_matrix": np.array([np.diag(-linear_drag(c)) for c in every]),
        "mixing_matrix": np.stack([arms[..., 1] / length, -arms[..., 0] / length, spins], axis=1),
        "L": np.full(len(every), length),
    }
