"""Samples side by side in vector lanes, and linearisations with a fixed point: the same numbers as the plain way."""

from __future__ import annotations

import tempfile
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from greybox.estimation import lanes
from greybox.estimation.build import build, compiler
from greybox.estimation.gain import Linearisation, linearisation_at
from greybox.model.model import PhysicsModel
from greybox.model.sensors import SENSORS
from greybox.model.vehicle import read_vehicle
from greybox.plants.presets import X250
from greybox.plants.quadrotor import Quadrotor
from greybox.plants.vehicle_file import write_vehicle


@pytest.mark.skipif(compiler() is None, reason="no C compiler here")
def test_lanes_are_the_scalar_function_of_each_sample():
    import ctypes

    x, u = ca.SX.sym("x", 3), ca.SX.sym("u")
    rows = ca.vertcat(
        ca.if_else(x[0] <= u, ca.exp(-x[1]), ca.atan2(x[2], x[0])), ca.fmax(x[0], 0.3) ** 2, 2.5, ca.sqrt(1 + x[1] ** 2),
        ca.if_else(ca.logic_not(x[1] < 0), x[2] / x[0], -u), ca.sin(x[0]) * ca.cos(u) - ca.fabs(x[2]), x[1] ** 3,
    )  # fmt: skip
    f = ca.Function("f", [x, u], [rows])
    generator = ca.CodeGenerator("f.c", {"with_header": False})
    generator.add(f)
    path = build([("f.c", lanes.PRELUDE + generator.dump(), lanes.FLAGS)], rewrite={"f.c": lanes.rewrite})
    rng = np.random.default_rng(0)
    xs, us = rng.normal(size=(lanes.LANES, 3)), rng.normal(size=lanes.LANES)
    out = np.zeros((7, lanes.LANES))
    pointers = [v.ctypes.data for v in xs] + [us[i:].ctypes.data for i in range(lanes.LANES)]
    arguments = (ctypes.c_void_p * len(pointers))(*pointers)
    ctypes.CDLL(str(path)).f(arguments, (ctypes.c_void_p * 1)(out.ctypes.data), None, None, 0)
    for i in range(lanes.LANES):
        np.testing.assert_allclose(out[:, i], f(xs[i], us[i]).full().ravel(), rtol=1e-14, atol=1e-15)


def test_lanes_refuse_a_line_that_they_do_not_know():
    text = "static int casadi_f0(int a) {\n  casadi_error(1);\n  return 0;\n}\n"
    with pytest.raises(ValueError, match="casadi_error"):
        lanes.rewrite(text)


def test_a_fixed_point_gives_the_same_linearisation():
    with tempfile.TemporaryDirectory() as folder:
        vehicle = read_vehicle(write_vehicle(Path(folder) / "v.toml", Quadrotor(X250)))
    model = PhysicsModel(vehicle=vehicle, sensors=SENSORS[:5]).with_effect("motor_lag", "rotor_drag")
    active = ("inertia.xx", "thrust.c2", "motor_lag.tau", "rotor_drag.k_x")
    x = model.reference({f"u{i}": 0.5 + 0.01 * i for i in range(1, 5)})
    special = linearisation_at(model, active, x, model.reference({f"u{i}": 1.5 for i in range(1, 5)}))
    assert linearisation_at(model, active, x, model.reference({f"u{i}": 1.5 for i in range(1, 5)})) is special
    p = np.array([q.nominal + 0.1 * q.scale for q in model.parameters])
    window = np.full((len(model.inputs), 1), 0.55)
    for plain, quick in zip(Linearisation(model, active)(x, window, p, 0.01), special(x, window, p, 0.01)):
        for a, b in zip(plain, quick):
            np.testing.assert_allclose(b, a, rtol=1e-12, atol=1e-12 * max(np.abs(a).max(), 1e-300))
