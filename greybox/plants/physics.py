"""Newton-Euler equations of a rigid body with n rotors and whatever effects act on it, written from
first principles.

State: position and velocity of the centre of mass (world), attitude quaternion (body to world),
body rates, then the hidden states of effects. Rotor speeds are not part of it: between command
changes they are known in closed form.
"""

from __future__ import annotations

from greybox.plants.airframe import Airframe
from greybox.plants.effects.base import Body, Hub, PlantEffect, hooks
from greybox.plants.vectors import (
    ZERO,
    Number,
    Vector,
    add,
    apply,
    apply_transposed,
    cross,
    inverse_symmetric,
    rotation,
    subtract,
)

CORE = 13
"""Length of the rigid-body state: x, y, z, vx, vy, vz, qw, qx, qy, qz, p, q, r."""


class Physics:
    """Forces, moments and accelerations of one airframe with its effects."""

    def __init__(self, airframe: Airframe, effects: tuple[PlantEffect, ...]) -> None:
        self.airframe = airframe
        self.gravity = airframe.gravity
        self.mass: Number = airframe.mass
        moments, products = airframe.inertia, airframe.products
        center = airframe.center_of_mass
        imu, tracked = airframe.imu_position, ZERO
        for effect in effects:
            self.mass = self.mass * effect.mass_factor()
            change = effect.inertia_change()
            moments, products = add(moments, change[0]), add(products, change[1])
            center = add(center, effect.center_of_mass_shift())
            imu = add(imu, effect.imu_shift())
            tracked = add(tracked, effect.pose_shift())
        xx, yy, zz = moments
        xy, xz, yz = products
        self.inertia = (xx, xy, xz, xy, yy, yz, xz, yz, zz)
        self.inverse_inertia = inverse_symmetric(xx, yy, zz, xy, xz, yz)
        self.tracked = subtract(tracked, center)
        """Point whose position is measured, seen from the centre of mass [m]."""
        self.imu = subtract(imu, center)
        """IMU seen from the centre of mass [m]."""
        self.arms = [subtract(rotor.position, center) for rotor in airframe.rotors]
        self.spins = [rotor.spin for rotor in airframe.rotors]
        self.scale = airframe.speed_max if airframe.speed_max is not None else 1.0
        self._thrust_factors = hooks(effects, "thrust_factor")
        self._torque_factors = hooks(effects, "torque_factor")
        self._thrust_increments = hooks(effects, "thrust_increment")
        self._hub_forces = hooks(effects, "hub_force")
        self._hub_moments = hooks(effects, "hub_moment")
        self._body_forces = hooks(effects, "body_force")
        self._body_moments = hooks(effects, "body_moment")
        self._winds = hooks(effects, "wind")
        self._slices: list[tuple[PlantEffect, slice]] = []
        start = CORE
        for effect in effects:
            if effect.hidden:
                self._slices.append((effect, slice(start, start + effect.hidden)))
                start += effect.hidden
        self.size = start
        per_rotor = (self._thrust_factors, self._torque_factors, self._thrust_increments)
        self._any_hub = any((*per_rotor, self._hub_forces, self._hub_moments))
        self._any_effect = bool(
            self._any_hub or self._body_forces or self._body_moments or self._winds or self._slices
        )

    def _see(
        self,
        time: Number,
        state: list[Number],
        nu: list[Number],
        nu_rate: list[Number],
        voltage: Number,
    ) -> Body:
        body = Body()
        body.time = time
        body.position = (state[0], state[1], state[2])
        body.velocity = (state[3], state[4], state[5])
        body.attitude = (state[6], state[7], state[8], state[9])
        body.rates = (state[10], state[11], state[12])
        body.rotation = rotation(body.attitude)
        body.nu = nu
        body.nu_rate = nu_rate
        body.voltage = voltage
        body.hidden = {effect.name: state[where] for effect, where in self._slices}
        wind = body.wind = body.airspeed = ZERO
        for hook in self._winds:
            wind = add(wind, hook(body))
        body.wind = wind
        if self._any_effect:  # nobody else looks
            body.speed = [self.scale * n for n in nu]
            body.speed_rate = [self.scale * n for n in nu_rate]
            body.airspeed = apply_transposed(body.rotation, subtract(body.velocity, wind))
        return body

    def _rotor_wrench(self, body: Body, force: Vector, moment: Vector) -> tuple[Vector, Vector]:
        """Add thrust, drag torque and hub effects of all rotors to force and moment."""
        fx, fy, fz = force
        mx, my, mz = moment
        p, q, r = body.rates
        va, vb, vc = body.airspeed
        t0, t1, t2 = self.airframe.thrust
        q0, q1, q2 = self.airframe.torque
        for i, arm in enumerate(self.arms):
            nu = body.nu[i]
            rx, ry, rz = arm
            thrust = t0 + nu * (t1 + nu * t2)
            torque = q0 + nu * (q1 + nu * q2)
            if self._any_hub:
                airspeed = (va + q * rz - r * ry, vb + r * rx - p * rz, vc + p * ry - q * rx)
                hub = Hub(i, self.spins[i], arm, airspeed, nu, body.speed[i], thrust, torque, body)
                for hook in self._thrust_factors:
                    thrust = thrust * hook(hub)
                for hook in self._torque_factors:
                    torque = torque * hook(hub)
                for hook in self._thrust_increments:
                    thrust = thrust + hook(hub)
                for hook in self._hub_forces:
                    hx, hy, hz = hook(hub)
                    fx, fy, fz = fx + hx, fy + hy, fz + hz
                    mx, my, mz = (
                        mx + ry * hz - rz * hy,
                        my + rz * hx - rx * hz,
                        mz + rx * hy - ry * hx,
                    )
                for hook in self._hub_moments:
                    hx, hy, hz = hook(hub)
                    mx, my, mz = mx + hx, my + hy, mz + hz
            fz = fz + thrust
            mx = mx + ry * thrust
            my = my - rx * thrust
            mz = mz - self.spins[i] * torque
        return (fx, fy, fz), (mx, my, mz)

    def accelerations(
        self,
        time: Number,
        state: list[Number],
        nu: list[Number],
        nu_rate: list[Number],
        voltage: Number,
        push: Vector,
        twist: Vector,
    ) -> tuple[Body, Vector, Vector]:
        """The vehicle as effects see it, its specific force (force but gravity over mass, body
        [m/s^2]) and domega/dt.

        push [N] and twist [N m] are the disturbance force and torque on the body.
        """
        body = self._see(time, state, nu, nu_rate, voltage)
        force, moment = self._rotor_wrench(body, push, twist)
        for hook in self._body_forces:
            force = add(force, hook(body))
        for hook in self._body_moments:
            moment = add(moment, hook(body))
        momentum = apply(self.inertia, body.rates)
        turning = apply(self.inverse_inertia, subtract(moment, cross(body.rates, momentum)))
        return body, (force[0] / self.mass, force[1] / self.mass, force[2] / self.mass), turning

    def derivative(
        self,
        time: Number,
        state: list[Number],
        nu: list[Number],
        nu_rate: list[Number],
        voltage: Number,
        push: Vector,
        twist: Vector,
    ) -> list[Number]:
        """Time derivative of the state, same length."""
        body, specific, turning = self.accelerations(time, state, nu, nu_rate, voltage, push, twist)
        ax, ay, az = apply(body.rotation, specific)
        w, x, y, z = body.attitude
        p, q, r = body.rates
        rate = [
            state[3],
            state[4],
            state[5],
            ax,
            ay,
            az - self.gravity,
            -0.5 * (x * p + y * q + z * r),
            0.5 * (w * p + y * r - z * q),
            0.5 * (w * q - x * r + z * p),
            0.5 * (w * r + x * q - y * p),
            turning[0],
            turning[1],
            turning[2],
        ]
        for effect, _ in self._slices:
            rate.extend(effect.hidden_rate(body))
        return rate
