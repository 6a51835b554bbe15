"""`greybox vehicle new --from LOG`: motor order, spins and hover command of the firmware, and what
is left to measure."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from greybox.cli import main
from greybox.data.readers.recording import Recording
from greybox.errors import DataError
from greybox.model import vehicle_from_log as from_log
from greybox.model.plausibility import check_vehicle
from greybox.model.vehicle import Vehicle, read_vehicle
from tests.data.readers import writers as w

BETAFLIGHT = ("u2", "u1", "u3", "u4")
"""The recorded Crazyflie's motors in Betaflight's order: rear right, front right, rear left, front
left."""


def corners(vehicle: Vehicle) -> list[tuple[str, int]]:
    return [
        (
            ("front " if r.position[0] > 0 else "rear ")
            + ("left" if r.position[1] > 0 else "right"),
            r.spin,
        )
        for r in vehicle.rotors
    ]


def made(path: Path, **changes: object) -> tuple[Vehicle, from_log.FromLog]:
    found = from_log.vehicle_from_log(path, changes)
    return Vehicle.from_dict(tomllib.loads(found.text)), found


def betaflight(path: Path, *, reversed_motors: bool) -> Path:
    """The flight with yaw to and fro: rear right and front left speed up, and drag the body against
    their spin."""
    pytest.importorskip("orangebox")
    c = w.channels(rows=2500)
    yaw = 0.04 * np.sin(2 * np.pi * 1.5 * c["t"])
    c |= {
        f"u{i + 1}": c[name] + s * yaw
        for i, (name, s) in enumerate(zip(BETAFLIGHT, (1, -1, -1, 1), strict=True))
    }
    c["r"] = c["r"] + (-1 if reversed_motors else 1) * np.cumsum(40.0 * yaw) * 0.01
    return w.write_betaflight(path, c)


@pytest.mark.parametrize("reversed_motors", [False, True])
def test_betaflights_order_is_rear_right_first_and_yaw_tells_which_way_the_motors_turn(
    tmp_path, reversed_motors
):
    vehicle, found = made(betaflight(tmp_path / "f.bbl", reversed_motors=reversed_motors))
    sense = -1 if reversed_motors else 1
    assert corners(vehicle) == [
        ("rear right", -sense),
        ("front right", sense),
        ("rear left", sense),
        ("front left", -sense),
    ]
    assert any(f"props {'out' if reversed_motors else 'in'}" in line for line in found.known)
    assert [line.split(":")[0] for line in found.to_measure] == ["arm", "mass"]
    assert vehicle.arm_length == pytest.approx(from_log.ARM)
    assert vehicle.actuator.u_min == 0.0  # idle is 0 in the log of a flight controller


def test_what_nobody_weighed_is_marked_as_a_guess_and_believed_little(tmp_path):
    log = betaflight(tmp_path / "f.bbl", reversed_motors=False)
    guess, found = made(log)
    assert "GUESSED" in found.text
    for name in ("mass", "inertia.xx", "thrust.c2", "torque.c2"):
        assert guess.quantities[name].sigma == pytest.approx(
            0.5 * guess.quantities[name].value, rel=0.01
        ), name
    weighed, told = made(log, mass=0.042, arm=0.046)
    assert "GUESSED" not in told.text and told.to_measure == ()
    assert weighed.mass.value == 0.042 and weighed.mass.sigma < 0.01 * 0.05
    # It hovers at the commands that were flown: 0.79 to 0.90.
    assert 0.75 < (check_vehicle(weighed).figures["hover_command"] or 0.0) < 0.95


def test_px4s_parameters_give_places_in_our_axes(tmp_path):
    pytest.importorskip("pyulog")
    log = w.write_ulog(tmp_path / "f.ulg", w.channels(rows=2500))
    vehicle, found = made(log)
    assert corners(vehicle) == [
        ("front right", 1),
        ("rear right", -1),
        ("rear left", 1),
        ("front left", -1),
    ]
    assert any("CA_ROTOR" in line for line in found.known)
    assert [line.split(":")[0] for line in found.to_measure] == ["mass"]
    wider, _ = made(log, arm=2 * vehicle.arm_length)
    np.testing.assert_allclose(
        wider.rotors[0].position[:2], 2 * np.array(vehicle.rotors[0].position[:2]), rtol=1e-4
    )


def test_px4_without_rotor_parameters_has_the_order_of_its_airframe():
    def order(**parameters: float):
        recording = Recording(
            format="ulog", source="f", sha256="", streams={}, parameters=parameters
        )
        return from_log._layout("ulog", recording, None, [], "f.ulg")

    places, arm = order(MAV_TYPE=2.0, SYS_AUTOSTART=4001.0)
    assert arm is None
    assert [(x > 0, y > 0, s) for (x, y, _), s in places] == [
        (True, False, 1),
        (False, True, 1),
        (True, True, -1),
        (False, False, -1),
    ]
    plus, _ = order(MAV_TYPE=2.0, SYS_AUTOSTART=5001.0)
    assert [p[:2] for p, _ in plus] == [(0.0, -1.0), (0.0, 1.0), (1.0, 0.0), (-1.0, 0.0)]
    with pytest.raises(DataError, match="where the motors are"):
        order(MAV_TYPE=22.0, SYS_AUTOSTART=13014.0)


def test_px4s_hover_thrust_becomes_a_motor_signal():
    told = {"MPC_THR_HOVER": 0.5, "THR_MDL_FAC": 1.0}
    recording = Recording(format="ulog", source="f", sha256="", streams={}, parameters=told)
    assert from_log._hover(None, recording, []) == pytest.approx(0.5**0.5, abs=1e-3)


def test_a_crazyflie_is_the_template_with_the_hover_command_of_the_log(tmp_path):
    vehicle, found = made(w.write_crazyflie(tmp_path / "log00", w.channels(rows=2500)), mass=0.042)
    assert corners(vehicle) == [
        ("front right", 1),
        ("rear right", -1),
        ("rear left", 1),
        ("front left", -1),
    ]
    assert 0.75 < (check_vehicle(vehicle).figures["hover_command"] or 0.0) < 0.95
    assert found.to_measure == ()


def test_the_command_writes_the_file_and_says_what_to_measure(tmp_path, capsys):
    log, out = betaflight(tmp_path / "f.bbl", reversed_motors=False), tmp_path / "v.toml"
    assert main(["vehicle", "new", "--from", str(log), "--out", str(out)]) == 0
    said = capsys.readouterr().err
    assert "to measure: mass" in said and "from the log: motor order" in said
    assert read_vehicle(out).schema == "greybox.vehicle/2"
    assert check_vehicle(read_vehicle(out)).ok
    assert main(["vehicle", "new", "--from", str(log), "--template", "x"]) == 2
