"""PX4: a parameter file of QGroundControl with the SIH_ parameters of the simulated quadrotor."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from greybox.errors import VehicleError
from greybox.files import read_limited
from greybox.simulators.sources.found import Found, used
from greybox.simulators.targets.px4 import PLACES

LARGEST = 2**21
NEEDED = (
    "SIH_MASS",
    "SIH_IXX",
    "SIH_IYY",
    "SIH_IZZ",
    "SIH_T_MAX",
    "SIH_Q_MAX",
    "SIH_L_ROLL",
    "SIH_L_PITCH",
)


def parameters(path: Path) -> dict[str, float]:
    """Name -> value of a .params file. Raises `VehicleError` for a line that is none."""
    out = {}
    for k, line in enumerate(
        read_limited(path, LARGEST).decode("utf-8", "replace").splitlines(), 1
    ):
        if not line.strip() or line.startswith("#"):
            continue
        cells = line.split("\t") if "\t" in line else line.split()
        try:
            out[cells[2]] = float(cells[3])
        except (IndexError, ValueError):
            raise VehicleError(
                "not a parameter",
                where=f"{path}:{k}",
                expected="vehicle, component, name, value, type",
                got=repr(line[:60]),
            ) from None
    return out


def read(path: Path) -> Found:
    """Raises `VehicleError` for a file without the SIH parameters."""
    p = parameters(path)
    if missing := [k for k in NEEDED if k not in p]:
        raise VehicleError(f"no {', '.join(missing)}", where=str(path))
    xy, xz, yz = (p.get(f"SIH_{k}", 0.0) for k in ("IXY", "IXZ", "IYZ"))
    # FRD to FLU: products with y or z alone change their sign.
    j = np.array(
        [
            [p["SIH_IXX"], -xy, -xz],
            [-xy, p["SIH_IYY"], yz],
            [-xz, yz, p["SIH_IZZ"]],
        ]
    )
    hubs = np.array([[x * p["SIH_L_PITCH"], y * p["SIH_L_ROLL"], 0.0] for x, y, _ in PLACES])
    base = Found(
        name=path.stem,
        mass=p["SIH_MASS"],
        inertia=j,
        hubs=hubs,
        spins=np.array([s for _, _, s in PLACES]),
        thrust=(0.0, p["SIH_T_MAX"], 0.0),
        torque=(0.0, p["SIH_Q_MAX"], 0.0),
    )
    effects = {
        "motor_lag.tau": p.get("SIH_T_TAU", 0.0),
        **{f"rotational_damping.d_{a}": p.get("SIH_KDW", 0.0) for a in "pqr"},
        **{f"linear_drag.d_{a}": p.get("SIH_KDV", 0.0) for a in "xyz"},
    }
    fields = {k: getattr(base, k) for k in base.__dataclass_fields__}
    measure = (
        "thrust is linear in the command here (thrust.c1): measure the real map",
        "mass: weigh it",
    )
    return Found(**{**fields, "effects": used(effects), "to_measure": measure})
