"""A logger that loses rows loses commands: the motor lag is found as from the whole log, and no
command delay appears."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.data import RawLog
from greybox.data.conditioning import condition
from greybox.data.dataset import Dataset
from greybox.estimation.fit import fit
from greybox.estimation.options import FitOptions
from greybox.model.model import build_model
from greybox.model.vehicle import read_vehicle
from scenarios.foreign.draw import draw, plant_of
from scenarios.foreign.flights import TRAIN, fly_plan
from scenarios.foreign.stranger import vehicle_text

EFFECTS = ("motor_lag", "command_delay", "rotor_drag", "axial_inflow")
LOST = 0.01


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """The true lag; (value, error) of lag and delay from the whole flight and from the one with lost
    rows."""
    craft = replace(draw(21, "plants"), gusts=False, realism=None)
    log = dict(fly_plan(plant_of(craft), craft.craft, TRAIN[0], 21, duration=12.0))
    t = log.pop("t")
    channels = {k: v for k, v in log.items() if not k.startswith("omega")}
    kept = np.random.default_rng(0).random(t.size) >= LOST
    kept[[0, -1]] = True
    path = tmp_path_factory.mktemp("craft") / "vehicle.toml"
    path.write_text(vehicle_text(craft.craft.airframe, craft.knowledge, craft.sensors))
    vehicle = read_vehicle(path)
    out = [craft.craft.lag]
    for rows in (np.ones_like(kept), kept):
        raw = RawLog(
            t=t[rows],
            channels={k: v[rows] for k, v in channels.items()},
            extra={},
            rows=np.flatnonzero(rows),
            flight="f",
            source="made",
            sha256="",
        )
        data = Dataset(flights=(condition(raw, vehicle, trim=False),))
        model = build_model(vehicle, data.channels, EFFECTS)
        fitted = fit(model, data, FitOptions(disturbance=("force", "torque")))
        assert fitted.diagnostics.status.converged
        p = fitted.estimates.parameters
        out.append({n: (p[n].value, p[n].std) for n in ("motor_lag.tau", "command_delay.d")})
    return out


def test_the_lag_is_that_of_the_craft(found):
    lag, *fits = found
    for one in fits:
        value, error = one["motor_lag.tau"]
        assert abs(value - lag) < 4 * error, one
        assert error < 0.01 * lag


def test_no_delay_appears(found):
    for one in found[1:]:
        value, error = one["command_delay.d"]
        assert value == 0.0 or value < 4 * error, one
