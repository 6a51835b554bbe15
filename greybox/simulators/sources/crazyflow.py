"""crazyflow and drone-models: first-principles parameters in TOML."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import numpy.typing as npt

from greybox.errors import VehicleError
from greybox.files import Parsed, read_toml
from greybox.simulators.sources.found import Found, used
from greybox.simulators.targets.rotorpy import GRAVITY
from greybox.symbolic import FloatArray

LARGEST = 2**20
PER_MINUTE = 60.0 / (2.0 * math.pi)
NEEDED = ("mass", "J", "L", "mixing_matrix", "rpm2thrust", "rpm2torque")


def tables(path: Path) -> dict[str, Parsed]:
    """The sections of a file that have rpm2thrust. Raises `VehicleError` for what is no TOML."""
    data = read_toml(path, what="file of parameters", error=VehicleError, largest=LARGEST)
    return {k: v for k, v in data.items() if isinstance(v, dict) and "rpm2thrust" in v}


def read(path: Path, section: str | None = None) -> Found:
    """The craft of a `section`, which may be left out where there is one. Raises `VehicleError`."""
    found, where = tables(path), str(path)
    if section is None and len(found) == 1:
        section = next(iter(found))
    if section not in found:
        raise VehicleError(
            "which craft?",
            where=where,
            expected=f"--set section=NAME with one of {', '.join(found)}",
        )
    p = found[section]
    if missing := [k for k in NEEDED if k not in p]:
        raise VehicleError(f"no {', '.join(missing)}", where=f"{where} [{section}]")
    try:
        return _craft(section, p)
    except (TypeError, ValueError) as error:
        raise VehicleError(f"wrong numbers: {error}", where=f"{where} [{section}]") from None


def _craft(name: str, p: Parsed) -> Found:
    mixing = np.array(p["mixing_matrix"], dtype=float)
    arms = np.stack([-mixing[1], mixing[0], 0 * mixing[0]], axis=1) * np.array(p["L"])[..., None]
    count = mixing.shape[1]
    thrust, strength = _curve(p["rpm2thrust"], count)
    torque, _ = _curve(p["rpm2torque"], count)
    mass = float(p["mass"])
    gravity = float(-np.array(p.get("gravity_vec", [0.0, 0.0, -GRAVITY]))[2])
    speed = _full_speed(thrust, float(p.get("thrust_max", 2.0 * mass * gravity / count)))
    powers = (speed * PER_MINUTE) ** np.arange(3.0)
    base = Found(
        name=name,
        mass=mass,
        gravity=gravity,
        inertia=np.array(p["J"], dtype=float),
        hubs=arms,
        spins=-np.sign(mixing[2]),
        thrust=tuple((thrust * powers).tolist()),
        torque=tuple((torque * powers).tolist()),
        speed_max=speed,
    )
    drag = -np.diag(np.array(p.get("drag_matrix", np.zeros((3, 3))), dtype=float))
    effects = {
        **_lag(p.get("rotor_dyn_coef", [0.0] * 4), 2.0 * base.hover_nu * speed * PER_MINUTE),
        "rotor_gyroscopic.J_r": float(p.get("prop_inertia", 0.0)),
        **{f"rotor_asymmetry.delta_{i}": float(s - 1) for i, s in enumerate(strength[:-1], 1)},
        **{f"linear_drag.d_{a}": float(v) for a, v in zip("xyz", drag, strict=True)},
    }
    fields = {k: getattr(base, k) for k in base.__dataclass_fields__}
    return Found(
        **{**fields, "effects": used(effects), "to_measure": ("mass: weigh it ready to fly",)}
    )


def _lag(coefficients: npt.ArrayLike, twice: float) -> dict[str, float]:
    """Lag of rotors at the speed that hovers, `twice` that [rpm]: the shares of damping that grow
    with speed, rising and falling, become their mean."""
    own, squares, own_down, squares_down = (float(v) for v in np.ravel(coefficients))
    rates = own + twice * squares, own_down + twice * squares_down
    rise, fall = (1.0 / v if v > 0 else 0.0 for v in rates)
    return {
        "motor_lag.tau": 0.5 * (rise + fall),
        "motor_lag_asymmetry.a": (fall - rise) / (fall + rise) if rise + fall else 0.0,
        "motor_lag_speed.s": 0.5 * twice * (squares * rise + squares_down * fall),
    }


def _curve(value: npt.ArrayLike, count: int) -> tuple[FloatArray, FloatArray]:
    """(powers of rpm (3,), strength of each rotor (count,)) of a curve or one per motor."""
    c = np.array(value, dtype=float)
    if c.ndim == 1:
        return c, np.ones(count)
    c = c if c.shape == (count, 3) else c.T
    mean = c.mean(axis=0)
    return mean, c[:, 2] / mean[2]


def _full_speed(thrust: FloatArray, largest: float) -> float:
    """Rotor speed [rad/s] at the largest thrust of one rotor [N]: nu = 1."""
    c0, c1, c2 = (float(v) for v in thrust)
    need = largest - c0
    rpm = (math.sqrt(c1 * c1 + 4.0 * c2 * need) - c1) / (2.0 * c2) if c2 else need / c1
    return rpm / PER_MINUTE
