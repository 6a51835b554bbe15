"""Between a command and the speed that a rotor settles at stand a curve and a battery: what carries
the craft is another number as a command than as a speed."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from greybox.estimation.simulate import simulate
from greybox.model.vehicle import Vehicle
from greybox.model.vehicle_template import vehicle_text
from greybox.simulators.change import Change
from greybox.simulators.craft import Craft
from greybox.simulators.data_sheet import model_of
from greybox.simulators.make import twin
from greybox.simulators.size import size_of
from greybox.simulators.targets.ardupilot import thrust_of_command
from scenarios.twins.written import load
from tests.simulators.identified import identified

CURVED = {"thrust_curve.f": 0.4, "command_delay.d": 0.02, "motor_lag.tau": 0.03}


@pytest.mark.parametrize("start", [None, 0.3])
def test_rotors_stay_where_they_are_until_a_command_arrives(
    start: float | None, tmp_path: Path
) -> None:
    twin(identified(CURVED), ["rotorpy"], out=tmp_path)
    (commands,) = load(tmp_path / "rotorpy", "commands")
    rotors = commands.Rotors() if start is None else commands.Rotors(start)
    for _ in range(2):  # as long as a command takes
        speeds = rotors.speeds(np.ones(4), 0.01)
        np.testing.assert_allclose(speeds, commands.HOVER if start is None else start, rtol=1e-12)
    assert (rotors.speeds(np.ones(4), 0.01) > speeds + 0.01).all()
    assert commands.normalised_speed(commands.HOVER_COMMAND) == pytest.approx(commands.HOVER)


def test_a_law_that_is_equal_at_the_command_of_hover_changes_no_thrust_there() -> None:
    craft = Craft.of(identified(CURVED))
    c1, c2 = thrust_of_command(craft)
    maps = {"thrust.c0": 0.0, "thrust.c1": c1, "thrust.c2": c2}
    found = size_of(craft, Change(values=maps, without=("thrust_curve",)))
    assert np.abs(found.thrust).max() < 1e-9


@pytest.mark.parametrize("changes", [{"effects.thrust_curve.f": 0.4}, {"thrust.c1": 12.0}])
def test_the_calm_flight_of_a_data_sheet_is_about_its_hover(changes: dict[str, float]) -> None:
    linear = {"thrust.c2": 0.0} if "thrust.c1" in changes else {}
    text = vehicle_text("racer250", changes | linear) + "\n[effects.battery_sag]\nc_V = 0.5\n"
    vehicle = Vehicle.from_dict(tomllib.loads(text))
    model = model_of(vehicle)
    hover = Craft.of(model).hover_command
    assert model.domain["u1"] == pytest.approx((0.8 * hover, 1.2 * hover))
    inputs = dict(zip(model.dynamics.inputs.names, model.reference_inputs, strict=True))
    assert inputs["vbat"] == vehicle.nominal_voltage
    run = simulate(model, np.tile(model.reference_inputs, (100, 1)), use_compiler=False)
    velocity = run.states[:, model.dynamics.states.names.index("velocity.z")]
    assert abs(velocity[-1] - velocity[-11]) < 1e-6, "it is carried under them"
