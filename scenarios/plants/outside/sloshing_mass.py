"""A liquid that sloshes: its surface swings as a pendulum below the centre of mass and pulls on the
vehicle."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from greybox.plants.effects.base import Body, PlantEffect
from greybox.plants.vectors import Number, Vector, apply_transposed


@dataclass(frozen=True, kw_only=True)
class SloshingMass(PlantEffect):
    """The liquid, `mass` [kg], swings sideways by (a, b) [m] in body axes at `frequency` [Hz] with
    damping ratio `damping`, driven by the tilt of gravity and by drag-like coupling to the
    velocity; it pushes with mass (2 pi f)^2 (a, b) at `arm` [m] below the centre of mass.

        a'' = -2 zeta w a' - w^2 a + g_x - k v_x,   F = mass w^2 (a, b, 0),   tau = (0, 0, -arm) x F
    """

    name: ClassVar[str] = "sloshing_mass"
    hidden: ClassVar[int] = 4
    mass: Number = 0.0
    frequency: Number = 1.2
    damping: Number = 0.08
    arm: Number = 0.02
    coupling: Number = 1.0

    def _pull(self, body: Body) -> Vector:
        a, b, _, _ = body.hidden[self.name]
        stiffness = self.mass * (6.283185307179586 * self.frequency) ** 2
        return (stiffness * a, stiffness * b, 0.0)

    def body_force(self, body: Body) -> Vector:
        """Pull of the liquid [N]."""
        return self._pull(body)

    def body_moment(self, body: Body) -> Vector:
        """Its moment about the centre of mass [N m]."""
        fx, fy, _ = self._pull(body)
        return (self.arm * fy, -self.arm * fx, 0.0)

    def hidden_rate(self, body: Body) -> list[Number]:
        """Pendulum along body x and y."""
        a, b, da, db = body.hidden[self.name]
        w = 6.283185307179586 * self.frequency
        down = apply_transposed(body.rotation, (0.0, 0.0, -9.81))
        vx, vy, _ = body.airspeed
        drive = (down[0] - self.coupling * vx, down[1] - self.coupling * vy)
        return [
            da,
            db,
            drive[0] - 2 * self.damping * w * da - w * w * a,
            drive[1] - 2 * self.damping * w * db - w * w * b,
        ]
