"""Where a log has rotor speeds they may drive the model or be measured; both recover the physics
without bias."""

from __future__ import annotations

import numpy as np
import pytest

from greybox import build_model, dataset_from_arrays, fit
from greybox.data import Dataset
from greybox.excitation.injection import rich_excitation
from greybox.excitation.waypoints import RandomWaypoints
from greybox.plants.effects.rotor_speed_delay import RotorSpeedDelay
from greybox.plants.flight_log import fly
from greybox.plants.presets import controller_for
from greybox.plants.quadrotor import Quadrotor
from greybox.validation.sanity import sanity_of
from scenarios.studies.recovery import plant
from tests.simulated import truth, vehicle


def test_speed_input_and_speed_output_recover_the_same_physics() -> None:
    true_plant = plant()
    log = dict(
        fly(
            true_plant,
            controller_for(true_plant),
            RandomWaypoints(),
            rich_excitation(),
            8.0,
            seed=5,
        )
    )
    t = log.pop("t")
    data = dataset_from_arrays(t, log, name="run")
    as_output = build_model(
        vehicle(), data.channels, ["motor_lag", "command_delay", "rotor_drag", "rotational_damping"]
    )
    assert {"omega1", "omega2", "omega3", "omega4"} <= set(as_output.outputs.names)
    as_input = build_model(
        vehicle(), data.channels, ["rotor_drag", "rotational_damping"], input="speed"
    )
    assert as_input.inputs.names == ("omega1", "omega2", "omega3", "omega4")
    for model in (as_output, as_input):
        result = fit(model, data, initialisation="noise")
        assert result.converged
        for name, estimate in result.parameters.items():
            assert abs(estimate.value - truth()[name]) < 4.5 * estimate.std, (model.input, name)


def test_a_fit_finds_how_late_speeds_were_logged() -> None:
    true_plant = plant()
    log = dict(
        fly(
            true_plant,
            controller_for(true_plant),
            RandomWaypoints(),
            rich_excitation(),
            8.0,
            seed=5,
        )
    )
    t = log.pop("t")
    for n in ("u1", "u2", "u3", "u4"):
        del log[n]
    for n in ("omega1", "omega2", "omega3", "omega4"):
        log[n] = np.interp(t - 0.017, t, log[n])
    data = dataset_from_arrays(t, log, name="run")
    model = build_model(
        vehicle(), data.channels, ["command_delay", "rotor_drag", "rotational_damping"]
    )
    result = fit(model, data, initialisation="noise")
    assert result.converged
    # In the mean over a step rotors that follow a held command are ahead of the straight line
    # between its ends, by dt^2 / (12 tau).
    ahead = data.flights[0].dt ** 2 / (12 * truth()["motor_lag.tau"])
    delay = result.parameters["command_delay.d"]
    assert abs(delay.value + 0.017 + ahead) < 3 * delay.std
    assert delay.std < 3e-4
    assert result.model.effective_lag is not None
    assert "rotor speeds are logged 17." in result.model.effective_lag.line
    for name in ("inertia.xx", "inertia.yy", "thrust.c2"):
        estimate = result.parameters[name]
        assert abs(estimate.value / truth()[name] - 1) < 0.02, name
    # Nothing that a command would need is advised, and nothing about the delay is impossible.
    said = sanity_of(result).findings
    assert not any("motor_lag" in f.attempt for f in said)
    assert not any("command_delay.d" in f.parameters for f in said)


def late_log(late: float, seed: int) -> dict[str, np.ndarray]:
    """A flight with commands, and speeds that are logged `late` [s]."""
    base = plant()
    true_plant = Quadrotor(
        base.airframe,
        [*base.effects, RotorSpeedDelay(d=late)],
        sensors=base.sensors,
        process=base.process,
        sample_time=base.sample_time,
        substep=base.substep,
    )
    reference, pushed = RandomWaypoints(), rich_excitation()
    return dict(fly(true_plant, controller_for(true_plant), reference, pushed, 8.0, seed=seed))


@pytest.mark.parametrize(
    "late", [0.014, *(pytest.param(s, marks=pytest.mark.slow) for s in (0.0, 0.005, 0.03))]
)
def test_speeds_beside_commands_may_be_late(late: float) -> None:
    """Nothing that a late sensor has not moves the delay of the commands and the lag of the
    motors; left out, all of it counts as delay of the commands."""
    log = late_log(late, seed=5)
    log["omega2"][::40] = np.nan
    data = dataset_from_arrays(log.pop("t"), log, name="run")
    effects = ["motor_lag", "command_delay", "rotor_drag", "rotational_damping"]
    result = fit(build_model(vehicle(), data.channels, [*effects, "rotor_speed_delay"]), data)
    assert result.converged
    true = truth() | {"rotor_speed_delay.d": late}
    for name, estimate in result.parameters.items():
        assert abs(estimate.value - true[name]) < 4.5 * estimate.std, name
    assert result["rotor_speed_delay.d"].std < 5e-4
    if late == 0.014:
        without = fit(build_model(vehicle(), data.channels, effects), data)
        assert without["command_delay.d"].value > true["command_delay.d"] + 0.5 * late


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seeds", "without"),
    [
        ((5,), ("x", "y", "z", "vx", "vy", "vz", "qw", "qx", "qy", "qz")),
        ((5, 6), ()),
    ],
    ids=["one flight of an IMU", "two flights with their pose"],
)
def test_the_plain_fit_takes_late_speeds_of_a_wrong_scale_as_they_are(
    seeds: tuple[int, ...], without: tuple[str, ...]
) -> None:
    logs = [late_log(0.014, seed) for seed in seeds]
    scales = {1: 0.05, 2: 0.05, 3: 0.05, 4: -0.03}
    for log in logs:
        for i, s in scales.items():
            log[f"omega{i}"] = (1 + s) * log[f"omega{i}"]
        for name in without:
            log.pop(name, None)
    flights = [dataset_from_arrays(g.pop("t"), g, name=f"run{i}") for i, g in enumerate(logs)]
    result = fit(vehicle(), Dataset(flights=tuple(f.flights[0] for f in flights)))
    shown = {"rotor_speed_delay.d": 0.014}
    shown |= {f"rotor_speed_scale.s_{i}": s for i, s in scales.items()}
    true = truth() | shown
    for name in ("command_delay.d", "motor_lag.tau", "thrust.c2", *shown):
        estimate = result[name]
        assert abs(estimate.value - true[name]) < 3 * estimate.std, name


def test_a_vehicle_that_knows_its_lag_may_still_be_driven_by_measured_speed() -> None:
    from dataclasses import replace

    from greybox.model.vehicle_parts import Quantity

    known = replace(vehicle(), effects={"motor_lag": {"tau": Quantity(value=0.05)}})
    columns = ["p", "q", "r", "omega1", "omega2", "omega3", "omega4"]
    assert build_model(known, columns, input="speed").effects == ()
    assert [e.name for e in build_model(known, [*columns, "u1", "u2", "u3", "u4"]).effects] == [
        "motor_lag"
    ]
