"""A tag is a fact that code relies on: dissipative, workless, zero-at-rest,
linear-in-parameters."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from specimen import at_random, crooked

from greybox.model.clock import DELAYS
from greybox.model.effect import Flow
from greybox.model.effects import CATALOGUE

LAGS = {"lag", "lag_asymmetry", "lag_speed", "lag_second"}


def random_flow(rng) -> Flow:
    """Every signal that an effect may look at, as numbers, consistent where it must be."""
    vehicle = crooked()
    n = len(vehicle.rotors)
    q = rng.normal(size=4)
    q /= np.linalg.norm(q)
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation *= np.sign(np.linalg.det(rotation))
    nu = rng.uniform(0.2, 0.9, size=n)
    velocity = 4 * rng.normal(size=3)
    com = np.array([q.value for q in vehicle.center_of_mass])
    arms = np.array([r.position for r in vehicle.rotors]).T - com[:, None]
    numbers = {
        "command": rng.uniform(0.2, 0.9, size=n),
        "nu": nu,
        "nu_rate": rng.normal(size=n),
        "rotor_speed": vehicle.omega_scale * nu,
        "thrust": 4 * nu**2,
        "vbat": rng.uniform(3.3, 4.1),
        "velocity": velocity,
        "velocity_world": rotation @ velocity,
        "wind": np.zeros(3),
        "omega": 3 * rng.normal(size=3),
        "angular_acceleration": 9 * rng.normal(size=3),
        "acceleration_world": 3 * rng.normal(size=3),
        "rotation": rotation,
        "quaternion": q,
        "position": rng.normal(size=3) + np.array([0.0, 0.0, 3.0]),
        "center_of_mass": com,
        "arms": arms,
        "mass": 0.5,
    }
    sizes = {
        "gyro": 3,
        "accelerometer": 3,
        "attitude": 4,
        "position": 3,
        "velocity": 3,
        "rotor_speed": n,
    }
    measured = {name: ca.DM(rng.normal(size=size)) for name, size in sizes.items()}
    return Flow(vehicle=vehicle, **{k: ca.DM(v) for k, v in numbers.items()}, measured=measured)


def own_values(effect, rng):
    return {k.split(".", 1)[1]: ca.DM(v) for k, v in at_random(effect, crooked(), rng).items()}


def wrench(slots, arms):
    """(force, moment) about the centre of mass of what a thrust or wrench effect adds, in NumPy."""
    force = np.zeros(3) + np.ravel(ca.DM(slots.get("force", np.zeros(3))).full())
    moment = np.zeros(3) + np.ravel(ca.DM(slots.get("moment", np.zeros(3))).full())
    hubs = np.zeros((arms.shape[1], 3))
    if "hub_force" in slots:
        hubs = hubs + ca.DM(slots["hub_force"]).full().T
    if "thrust_increment" in slots:
        hubs[:, 2] += ca.DM(slots["thrust_increment"]).full().ravel()
    if hubs.any():
        force = force + hubs.sum(axis=0)
        moment = moment + np.cross(arms.full().T, hubs).sum(axis=0)
    return force, moment


def power(slots, flow):
    """Mechanical power that the wrench puts into the body [W]."""
    force, moment = wrench(slots, flow.arms)
    return float(force @ flow.velocity.full().ravel() + moment @ flow.omega.full().ravel())


def tagged(tag):
    found = [e for e in CATALOGUE if tag in e.tags]
    return pytest.mark.parametrize("effect", [pytest.param(e, id=e.name) for e in found])


@tagged("dissipative")
def test_dissipative_effects_never_put_power_into_the_body(effect):
    rng = np.random.default_rng(4)
    assert all(p.lower >= 0 for p in effect.parameters(crooked())), (
        "dissipation is promised for nonnegative parameters"
    )
    taken = []
    for _ in range(200):
        flow = random_flow(rng)
        taken.append(power(effect.apply(flow, own_values(effect, rng)), flow))
    assert max(taken) <= 1e-12
    assert min(taken) < -1e-6, "it does take power"


@tagged("workless")
def test_workless_effects_do_no_work(effect):
    rng = np.random.default_rng(5)
    for _ in range(50):
        flow = random_flow(rng)
        slots = effect.apply(flow, own_values(effect, rng))
        force, moment = wrench(slots, flow.arms)
        size = np.linalg.norm(force) + np.linalg.norm(moment)
        assert size > 0
        assert abs(power(slots, flow)) <= 1e-12 * size


@tagged("zero-at-rest")
def test_zero_at_rest_effects_leave_a_hovering_body_alone(effect):
    rng = np.random.default_rng(6)
    for _ in range(20):
        flow = random_flow(rng)
        own = own_values(effect, rng)
        moving = wrench(effect.apply(flow, own), flow.arms)
        rest = {k: ca.DM.zeros(3) for k in ("velocity", "velocity_world", "omega")}
        still = wrench(effect.apply(replace(flow, **rest), own), flow.arms)
        assert np.abs(np.concatenate(still)).max() == 0.0
        assert np.abs(np.concatenate(moving)).max() > 0.0


@tagged("linear-in-parameters")
def test_linear_effects_have_no_curvature_in_their_parameters(effect):
    rng = np.random.default_rng(7)
    names = [p.name for p in effect.parameters(crooked())]
    p = ca.SX.sym("p", len(names))
    flow = random_flow(rng)
    slots = effect.apply(flow, {n: p[i] for i, n in enumerate(names)})
    stacked = ca.vertcat(*(ca.vec(ca.SX(v)) for v in slots.values()))
    slope = ca.jacobian(stacked, p)
    assert slope.nnz() > 0
    curvature = ca.Function("c", [p], [ca.jacobian(ca.vec(slope), p)])
    for _ in range(3):
        assert np.abs(curvature(rng.normal(size=len(names))).full()).max() == 0.0


def test_rotor_acceleration_is_claimed_exactly_where_it_is_felt():
    rng = np.random.default_rng(9)
    for effect in CATALOGUE:
        flow = random_flow(rng)
        speeding = ca.SX.sym("nu_rate", flow.nu_rate.shape[0])
        slots = effect.apply(replace(flow, nu_rate=speeding), own_values(effect, rng))
        felt = any(ca.depends_on(ca.vec(ca.SX(v)), speeding) for v in slots.values())
        assert felt == ("rotor-acceleration" in effect.tags), effect.name


def test_linearity_is_claimed_wherever_it_holds():
    rng = np.random.default_rng(8)
    missed = []
    for effect in CATALOGUE:
        names = [p.name for p in effect.parameters(crooked())]
        p = ca.SX.sym("p", len(names))
        slots = effect.apply(random_flow(rng), {n: p[i] for i, n in enumerate(names)})
        bent = any(not ca.is_linear(ca.vec(ca.SX(v)), p) for v in slots.values())
        trivial = set(slots) <= {"delay"} | LAGS | DELAYS
        if not bent and not trivial and "linear-in-parameters" not in effect.tags:
            missed.append(effect.name)
    assert not missed, f"say linear-in-parameters for {missed}"
