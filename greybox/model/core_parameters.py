"""Core parameters: what the vehicle file says of mass, inertia, centre of mass, thrust and torque, as declarations."""

from __future__ import annotations

import math

from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle


def core_parameters(vehicle: Vehicle) -> tuple[Parameter, ...]:
    """Declarations of mass, inertia, centre of mass, thrust and torque maps from the vehicle file.

    A prior's bounds are four standard deviations to either side (positive quantities stay above a fifth of their
    value), so that a large missing effect cannot drag them away.
    """

    def declare(
        name: str, unit: str, value: float, sigma: float, meaning: str, *, positive: bool, size: float
    ) -> Parameter:
        lower, upper = -math.inf, math.inf
        if sigma > 0 and math.isfinite(sigma):
            lower, upper = value - 4 * sigma, value + 4 * sigma
        if positive:
            lower = max(lower, 0.2 * value)
        scale = sigma if 0 < sigma < math.inf else (abs(value) or size)
        return Parameter(
            name=name, unit=unit, nominal=value, lower=lower, upper=upper, sigma=sigma, scale=scale, meaning=meaning
        )

    m = vehicle.mass
    out = [declare("mass", "kg", m.value, m.sigma, "mass", positive=True, size=m.value)]
    for i, a in enumerate(("xx", "yy", "zz")):
        j = float(vehicle.inertia[i][i])
        out.append(
            declare(
                f"inertia.{a}", "kg m^2", j, float(vehicle.inertia_sigma[i]), f"moment of inertia {a}",
                positive=True, size=j,
            )
        )  # fmt: skip
    for i, a in enumerate("xyz"):
        c = vehicle.center_of_mass[i]
        out.append(
            declare(
                f"center_of_mass.{a}", "m", c.value, c.sigma, f"centre of mass {a}",
                positive=False, size=vehicle.arm_length,
            )
        )  # fmt: skip
    for kind, unit, triple in (("thrust", "N", vehicle.actuator.thrust), ("torque", "N m", vehicle.actuator.torque)):
        size = max(abs(q.value) for q in triple) or 1.0
        for k, q in enumerate(triple):
            out.append(
                declare(
                    f"{kind}.c{k}", unit, q.value, q.sigma, f"{kind} per rotor, power {k} of nu",
                    positive=False, size=size,
                )
            )  # fmt: skip
    return tuple(out)
