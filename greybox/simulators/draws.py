"""Draws: craft as uncertain as the identification left them, for domain randomisation.

Four sources: the joint posterior of the shared parameters, the spread of per-flight parameters
between the training flights, the posterior of what was learned (`greybox.residual.drawn_push`), and
what remains unexplained, which is not a number of the craft but a push in flight (`pushes` has its
level and time).

Every draw is a craft that can be: parameters are drawn in coordinates of which every point is a
body (`greybox.simulators.coordinates`). What no coordinates keep is drawn again, which keeps all
correlations: inertia of which only a part varies, thrust that falls while the command rises, rotors
that cannot hover.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from greybox.errors import DataError
from greybox.model.identified import IdentifiedModel
from greybox.residual.array_file import packed
from greybox.residual.drawn_push import DrawnPush
from greybox.residual.hybrid import HybridModel
from greybox.simulators.command_text import EFFECTS as COMMANDS
from greybox.simulators.coordinates import MOMENTS, PLACES, PRODUCTS, Coordinates
from greybox.simulators.craft import SHORTEST_LAG, Craft, of_a_body
from greybox.simulators.laws import drag_at_hover
from greybox.simulators.principal_axes import principal_axes
from greybox.simulators.targets.crazyflow import PER_MINUTE
from greybox.simulators.targets.mujoco import tangent, yaw_ratio
from greybox.simulators.words import square_at_hover
from greybox.symbolic import BoolArray, FloatArray

LIFT = ("mass", "payload_mass.mu", "thrust.c0", "thrust.c1", "thrust.c2")
"""What says at which rotor speed a craft hovers."""
ROUNDS = 200
"""How often draws that can be no craft are drawn again."""
IN_MJX = ("motor_lag", "rotor_asymmetry")
"""Effects of rotors that MuJoCo's model has arrays for."""
MOST_DRAWS = 1_000_000
SHIFT = 0.1
"""Distance of a mean from the identified value, over the standard deviation, above which it is
said."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Draws:
    """`values` (n, n_p), one craft per row, columns `names` (all parameters of the model, order of
    simulate.py). `drawn` names those that vary; what the fit held is held. `levels` (n, n_w): how
    strongly each is pushed about, standard deviations per step of the process noise, and `pushes`
    in words, where flights were counted. `learned`: how far drawn learned pushes lie apart."""

    craft: Craft
    names: tuple[str, ...]
    values: FloatArray
    drawn: tuple[str, ...]
    seed: int
    levels: FloatArray
    learned: tuple[str, ...] = ()
    pushes: str = ""

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
            "draws/draws.npz": packed(
                {"names": np.array(self.names), "values": self.values, "noise": self.levels},
                compressed=True,
            ),
            "draws/ranges.toml": self.ranges(),
        }
        files["draws/mjx.npz"] = packed(_mjx(every), compressed=True)
        files["draws/isaac.npz"] = packed(_isaac(every, self.craft.strength), compressed=True)
        if not self._apart:
            files["draws/crazyflow.npz"] = packed(_crazyflow(every), compressed=True)
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

    def _shift(self, name: str) -> str:
        """In words, where the draws' mean is off by more than chance (3 standard errors) and
        SHIFT."""
        v, identified = self.column(name), float(self.craft.source.values[name])
        away = float(v.mean()) - identified
        sigma = float(v.std())
        if abs(away) <= max(SHIFT, 3.0 / math.sqrt(len(v))) * sigma:
            return ""
        side = "above" if away > 0 else "below"
        return (
            f", {abs(away) / sigma:.1f} sigma {side} the identified {identified:.4g}: cut to "
            "what can be"
        )

    def summary(self) -> str:
        """One line per parameter that varies; with how far its mean is from the identified value,
        where bounds of what a body can be move it."""
        lines = [f"{len(self)} draws, seed {self.seed}:"]
        for name in self.drawn:
            v = self.column(name)
            mean = float(v.mean())
            share = f" ({100 * float(v.std()) / abs(mean):.1f} %)" if mean else ""
            lines.append(
                f"  {name:28} {mean:.4g} +- {float(v.std()):.2g}{share}{self._shift(name)}"
            )
        lines += [*self.learned, *([self.pushes] if self.pushes else [])]
        return "\n".join(lines)


def draw(model: IdentifiedModel, count: int, seed: int = 0) -> Draws:
    """`count` craft. Raises `DataError` for no number of draws, a negative seed, or a fit of which
    hardly any draw can be a craft; `ModelError` as `Craft.of`."""
    if not 1 <= count <= MOST_DRAWS:
        raise DataError("number of draws", expected=f"1 .. {MOST_DRAWS}", got=str(count))
    if seed < 0:
        raise DataError("seed of the draws", expected="a whole number from 0", got=str(seed))
    craft = Craft.of(model)
    declared = {d.name: d for d in model.dynamics.parameters}
    names = tuple(declared)
    random = np.random.default_rng(seed)
    (of_flights,) = random.spawn(1)  # so that shared parameters are drawn alike with and without
    values = np.tile([float(model.values[n]) for n in names], (count, 1))
    shared, between = _uncertain(model)
    drawn = (*shared, *between)
    mean, covariance = _joint(model, shared, between)
    chosen = Coordinates.of(craft, declared, drawn, mean, covariance)
    root = _root(chosen.covariance)
    columns = np.array([names.index(n) for n in drawn], dtype=int)
    again = np.arange(count)
    for _ in range(ROUNDS):
        normals = [
            r.standard_normal((len(again), len(n)))
            for r, n in ((random, shared), (of_flights, between))
        ]
        values[np.ix_(again, columns)] = chosen.values(np.hstack(normals) @ root.T)
        again = again[~_can_be(craft, names, drawn, values[again])]
        if not len(again):
            break
    else:
        raise DataError(
            f"{craft.title}: hardly any craft within the fit's covariance and the spread between "
            "flights has the inertia of a body and thrust that rises with the command",
            fix="fit with priors on inertia and thrust",
        )
    learned: tuple[str, ...] = ()
    if isinstance(model.dynamics, HybridModel):
        push = DrawnPush(hybrid=model.dynamics)
        weights = push.draw(count, np.random.default_rng([seed, 5]))
        values, names = np.hstack([values, weights]), tuple(d.name for d in push.parameters)
        learned = _learned(model.dynamics, push.spread(weights))
    return Draws(
        craft=craft,
        names=names,
        values=values,
        drawn=drawn,
        seed=seed,
        levels=np.tile(model.process_noise, (count, 1)),
        learned=learned,
    )


def _uncertain(model: IdentifiedModel) -> tuple[list[str], list[str]]:
    """Parameters that flights share, known or held within an error, and those of every flight."""
    declared = {d.name for d in model.dynamics.parameters}
    shared = [n for n in model.joint_covariance[0] if n in declared]
    spread = model.flight_spread.items()
    return shared, [n for n, (_, s) in spread if s > 0 and math.isfinite(s)]


def _joint(
    model: IdentifiedModel, shared: list[str], between: list[str]
) -> tuple[FloatArray, FloatArray]:
    """Mean (d,) and covariance (d, d): the posterior, and beside it the spread between flights;
    what a held parameter is off by moves both."""
    known, joint = model.joint_covariance
    at = np.array([known.index(n) for n in shared], dtype=int)
    spread = [model.flight_spread[n] for n in between]
    held = [sigma for sigma, _ in model.considered.values()]
    # how far one standard error of every held parameter moves each one; itself, by just that
    moved = [
        [s * (float(n == h) + by.get(n, 0.0)) for h, (s, by) in model.considered.items()]
        for n in (*shared, *between)
    ]
    moves = np.array(moved).reshape(len(moved), len(held))
    covariance = moves @ moves.T
    covariance[: len(at), : len(at)] = joint[np.ix_(at, at)]
    covariance[len(at) :, len(at) :] += np.diag([s**2 for _, s in spread])
    mean = [*(float(model.values[n]) for n in shared), *(m for m, _ in spread)]
    return np.array(mean), covariance


def _learned(hybrid: HybridModel, sizes: FloatArray) -> tuple[str, ...]:
    """How far drawn pushes lie apart, one line per output that was learned."""
    both = zip(hybrid.posterior.outputs, sizes.tolist(), strict=True)
    return tuple(f"  learned {s.name:20} +- {v:.2g} {s.unit}" for s, v in both if v)


def _root(covariance: FloatArray) -> FloatArray:
    """A matrix R with R R' the covariance, singular ones included, and block by block where that
    is; of one that is not quite a covariance, without its negative part."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return np.asarray(scale[:, None] * (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def _can_be(
    craft: Craft, names: tuple[str, ...], drawn: tuple[str, ...], values: FloatArray
) -> BoolArray:
    """Which rows (n,) have the inertia of a body, and thrust that rises with the command and
    reaches the weight, as the estimate's does."""
    good = np.ones(len(values), dtype=bool)
    if any(n in (*MOMENTS, *PRODUCTS) for n in drawn):
        j = np.tile(craft.inertia, (len(values), 1, 1))
        for i, name in enumerate(MOMENTS):
            j[:, i, i] = values[:, names.index(name)]
        for name, (i, k) in zip(PRODUCTS, PLACES, strict=True):
            if name in names:
                j[:, i, k] += values[:, names.index(name)] - craft.get(name)
                j[:, k, i] = j[:, i, k]
        good &= of_a_body(np.asarray(np.linalg.eigvalsh(j)))
    if any(n in LIFT for n in drawn) and _rises(craft, {})[0]:
        good &= _rises(craft, {n: values[:, names.index(n)] for n in LIFT if n in names})
    return good


def _rises(craft: Craft, columns: Mapping[str, FloatArray]) -> BoolArray:
    """Whether thrust rises over the command range and reaches the weight (n,), with other numbers
    of `LIFT` in `columns` (n,) each; (1,) without."""
    mass, payload, c0, c1, c2 = (columns.get(n, np.array([craft.get(n)])) for n in LIFT)
    f = craft.get("thrust_curve.f")
    low, high = ((1.0 - f) * u + f * u * u for u in craft.command_range)
    need = mass * (1.0 + payload) * craft.gravity / craft.count - c0
    rises = (c1 + 2.0 * c2 * low >= 0.0) & (c1 + 2.0 * c2 * high > 0.0)
    return np.asarray(rises & (need > 0.0) & (c1 * c1 + 4.0 * c2 * need >= 0.0))


# ---------------------------------------------------------------- under the names of simulators


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


def _isaac(every: list[Craft], command_strength: FloatArray) -> dict[str, FloatArray]:
    """Masses (n, 1), inertia about the centre of mass in body axes (n, 9), centre of mass from the
    body's origin (n, 3) with the axes of the body (w, x, y, z); and Pegasus' thrust curve and
    linear drag. `command_strength`: that (n,) of the rotors by which commands.py scales speeds."""
    square = 1.0 / every[0].speed_max ** 2
    factor = square * np.array([c.strength for c in every]) / command_strength
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
        "drag": np.array([drag_at_hover(c) for c in every]),
    }


def _crazyflow(every: list[Craft]) -> dict[str, FloatArray]:
    """Arguments of first_principles.dynamics, one row per craft."""
    first = every[0]
    scale = first.speed_max * PER_MINUTE
    powers = scale ** -np.arange(3.0)
    j = np.array([c.inertia for c in every])
    rates = np.array([c.rates(SHORTEST_LAG) for c in every])
    length = float(np.abs(first.arms[:, :2]).max())
    arms = np.array([c.arms for c in every])
    spins = np.tile(-first.spins, (len(every), 1))
    return {
        "mass": np.array([c.mass for c in every]),
        "J": j,
        "J_inv": np.linalg.inv(j),
        "rpm2thrust": np.array([c.thrust for c in every]) * powers,
        "rpm2torque": np.array([c.torque for c in every]) * powers,
        "rotor_dyn_coef": rates * powers[[0, 1, 0, 1]],
        "drag_matrix": np.array([np.diag(-drag_at_hover(c)) for c in every]),
        "mixing_matrix": np.stack([arms[..., 1] / length, -arms[..., 0] / length, spins], axis=1),
        "L": np.full(len(every), length),
    }
