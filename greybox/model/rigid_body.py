"""RigidBody: from rotor speeds to accelerations, with the effects of the stages body, thrust and
wrench.

Newton-Euler equations of the centre of mass, quaternion attitude:

    dp/dt = v,   m dv/dt = R(q) F - m g e_z,   dq/dt = q * (0, omega)/2,   J domega/dt = M - omega x
    J omega F = sum_i T_i e_z + effects,   M = sum_i (r_i x T_i e_z - s_i Q_i e_z) + effects,   T_i,
    Q_i = c0 + c1 nu + c2 nu^2

(Mahony, Kumar and Corke 2012, IEEE RAM 19(3), eq. 1-4; Stevens, Lewis and Johnson 2015, ch. 1.)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from greybox.frames import quat_derivative, rotation_matrix
from greybox.model.flow import Flow
from greybox.model.rotors import Rotors
from greybox.model.staged_effects import StagedEffects
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr

PUSHES = ("force", "torque", "turn")
"""What process noise pushes, three components each: [N] and [N m] in body axes, [rad/s] of the
attitude kinematics."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Body:
    """Mass [kg], inertia (3, 3) about the centre of mass [kg m^2] and that centre (3, 1) [m] in
    body axes."""

    mass: Expr
    inertia: Expr
    center_of_mass: Expr
    inertia_is_diagonal: bool


@dataclass(frozen=True, kw_only=True)
class RigidBody:
    """The body of a model and what its rotors and effects do to it.

    States come as blocks: position [m], velocity [m/s] (world), attitude (w, x, y, z), rate [rad/s]
    (body), memory. Noise w has the components of `PUSHES`, then what pushes drifting memories.
    """

    staged: StagedEffects
    rotors: Rotors

    def accelerations(
        self,
        x: Mapping[str, Expr],
        nu: Expr,
        nu_rate: Expr,
        u: Expr,
        values: Mapping[str, Expr],
        w: Expr,
    ) -> tuple[Expr, Expr, Flow]:
        """(specific force [m/s^2], angular acceleration [rad/s^2], flow) in body axes."""
        nothing_known = Flow(vehicle=self.staged.vehicle, vbat=self.staged.voltage(u))
        body = self._mass_and_inertia(nothing_known, values)
        flow = self._flow(nothing_known, body, x, nu, nu_rate, values)
        thrust, torque = self._rotor_forces(flow, x, values)
        force, moment = self._wrench(flow, thrust, torque, x, values, w)
        gyroscopic = ca.cross(x["rate"], body.inertia @ x["rate"])
        if body.inertia_is_diagonal:
            alpha = (moment - gyroscopic) / ca.diag(body.inertia)
        else:
            alpha = ca.inv(body.inertia) @ (moment - gyroscopic)
        return force / body.mass, alpha, replace(flow, angular_acceleration=alpha)

    def _mass_and_inertia(self, flow: Flow, values: Mapping[str, Expr]) -> _Body:
        """The body with what the effects of its stage add."""
        staged = self.staged
        mass = values["mass"]
        kind = type(mass) if isinstance(mass, ca.SX | ca.MX) else ca.DM
        inertia = kind(ca.DM(np.asarray(staged.vehicle.inertia)))
        for i, a in enumerate(("xx", "yy", "zz")):
            inertia[i, i] = values[f"inertia.{a}"]
        com = ca.vertcat(*(values[f"center_of_mass.{a}"] for a in "xyz"))
        diagonal = _is_diagonal(staged.vehicle)
        for e in staged.of("body"):
            slots = e.apply(flow, staged.own(e, values))
            diagonal = diagonal and "inertia_increment" not in slots
            mass = mass * slots.get("mass_factor", 1.0)
            inertia = inertia + slots.get("inertia_increment", 0.0)
            com = com + slots.get("center_of_mass", 0.0)
        return _Body(mass=mass, inertia=inertia, center_of_mass=com, inertia_is_diagonal=diagonal)

    def _flow(
        self,
        flow: Flow,
        body: _Body,
        x: Mapping[str, Expr],
        nu: Expr,
        nu_rate: Expr,
        values: Mapping[str, Expr],
    ) -> Flow:
        """What the effects on thrust and wrench may look at, with the baseline thrust."""
        staged = self.staged
        vehicle = staged.vehicle
        rotation = rotation_matrix(x["attitude"])
        if self.rotors.have_lag:
            # At tau = 0 the jumps of the command are no rates: effects see what they see without
            # a lag.
            nu_rate = ca.if_else(self.rotors.lag(values) > 0, nu_rate, 0)
        wind = rotation.T @ staged.early("wind", values) if staged.has("wind") else ca.DM.zeros(3)
        return replace(
            flow,
            nu=nu,
            nu_rate=nu_rate,
            rotor_speed=vehicle.omega_scale * nu,
            thrust=_polynomial(nu, [values.get(f"thrust.c{k}", 0.0) for k in range(3)]),
            velocity=rotation.T @ x["velocity"],
            velocity_world=x["velocity"],
            omega=x["rate"],
            wind=wind,
            rotation=rotation,
            quaternion=x["attitude"],
            position=x["position"],
            arms=ca.horzcat(
                *(ca.DM(list(r.position)) - body.center_of_mass for r in vehicle.rotors)
            ),
            mass=body.mass,
            center_of_mass=body.center_of_mass,
        )

    def _rotor_forces(
        self, flow: Flow, x: Mapping[str, Expr], values: Mapping[str, Expr]
    ) -> tuple[Expr, Expr]:
        """(thrust [N], torque [N m]) of every rotor (n_rotor, 1) with the effects of their stage."""
        staged, thrust = self.staged, flow.thrust
        torque = _polynomial(flow.nu, [values.get(f"torque.c{k}", 0.0) for k in range(3)])
        increment: Expr = 0.0
        for e in staged.of("thrust"):
            slots = e.apply(staged.with_memory(e, flow, x), staged.own(e, values))
            thrust = thrust * slots.get("thrust_factor", 1.0)
            torque = torque * slots.get("torque_factor", 1.0)
            increment = increment + slots.get("thrust_increment", 0.0)
        return thrust + increment, torque

    def _wrench(
        self,
        flow: Flow,
        thrust: Expr,
        torque: Expr,
        x: Mapping[str, Expr],
        values: Mapping[str, Expr],
        w: Expr,
    ) -> tuple[Expr, Expr]:
        """(force [N], moment about the centre of mass [N m]) of rotors, noise and the effects of
        their stage."""
        staged, n, arms = self.staged, self.rotors.count, flow.arms
        spin = [r.spin for r in staged.vehicle.rotors]
        force = ca.vertcat(0, 0, ca.sum1(thrust)) + w[0:3]
        moment = w[3:6] + ca.vertcat(
            sum(arms[1, i] * thrust[i] for i in range(n)),
            -sum(arms[0, i] * thrust[i] for i in range(n)),
            -sum(spin[i] * torque[i] for i in range(n)),
        )
        for e in staged.of("wrench"):
            slots = e.apply(staged.with_memory(e, flow, x), staged.own(e, values))
            force = force + slots.get("force", 0.0)
            moment = moment + slots.get("moment", 0.0)
            if "hub_force" in slots:
                hub = slots["hub_force"]
                force = force + ca.sum2(hub)
                moment = moment + sum(ca.cross(arms[:, i], hub[:, i]) for i in range(n))
        return force, moment

    def rates(
        self,
        x: Mapping[str, Expr],
        nu: Expr,
        nu_rate: Expr,
        u: Expr,
        values: Mapping[str, Expr],
        w: Expr,
    ) -> dict[str, Expr]:
        """dx/dt of every block [block unit / s]."""
        force, alpha, flow = self.accelerations(x, nu, nu_rate, u, values, w)
        return {
            "position": x["velocity"],
            "velocity": flow.rotation @ force + self.gravity,
            "attitude": quat_derivative(x["attitude"], x["rate"] + w[6:9]),
            "rate": alpha,
            **self.staged.changes(flow, x, values, w[9:]),
        }

    @property
    def gravity(self) -> Expr:
        """Acceleration of a free fall, world axes [m/s^2]."""
        return ca.DM([0, 0, -self.staged.vehicle.gravity])


def _polynomial(nu: Expr, c: Sequence[Expr]) -> Expr:
    return c[0] + nu * (c[1] + nu * c[2])


def _is_diagonal(vehicle: Vehicle) -> bool:
    j = np.asarray(vehicle.inertia)
    return bool(np.allclose(j, np.diag(np.diag(j))))
