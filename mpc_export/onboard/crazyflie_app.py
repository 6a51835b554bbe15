"""An out-of-tree app for the Crazyflie: the firmware's controller "out of tree" is the bundle's
pilot.

Written from the published interface of crazyflie-firmware: the app layer and its Kbuild
(docs/userguides/app_layer.md), stabilizer_types.h (state in m, m/s and a unit quaternion; sensors
in deg/s and g) and the power distribution, which takes four numbers from 0 to 1. The world is the
firmware's own (z up), body axes are FLU; the legacy attitude in degrees, whose pitch is inverted,
is read nowhere but for the heading that is wanted.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

from greybox.errors import ModelError
from greybox.files import write_atomic
from greybox.frames import GRAVITY
from mpc_export.c_text import broken
from mpc_export.onboard.flight import OnBoard

if TYPE_CHECKING:
    from mpc_export.manifest import TargetPart


TARGET = "crazyflie-app"
LOOP = 1000.0
"""Calls of a controller per second."""
DEGREE = math.pi / 180.0
STATE = {
    "x": "position.x",
    "y": "position.y",
    "z": "position.z",
    "vx": "velocity.x",
    "vy": "velocity.y",
    "vz": "velocity.z",
    "qw": "attitudeQuaternion.w",
    "qx": "attitudeQuaternion.x",
    "qy": "attitudeQuaternion.y",
    "qz": "attitudeQuaternion.z",
}


def write(board: OnBoard, folder: Path) -> TargetPart:
    """The app in folder/crazyflie. Raises `ModelError` for a model that a Crazyflie cannot fly, and
    for C in double: the Cortex-M4F emulates it in software, too slowly."""
    if board.real != "float":
        raise ModelError(
            f"the target {TARGET} computes in single precision", got=board.real, fix="--float"
        )
    board.demand(TARGET, rotors=4, unit=True)
    f = board.functions
    calls = round(f.dt * LOOP)
    if len(f.inputs) != 4 or calls < 1 or abs(calls / LOOP - f.dt) > 1e-9:
        raise ModelError(
            f"the target {TARGET} is for four motors and whole milliseconds",
            got=f"{len(f.inputs)} commands, {f.dt:g} s",
            fix="--dt 0.01",
        )
    degree, g = board.number(DEGREE), board.number(GRAVITY)
    known = {column: f"state->{own}" for column, own in STATE.items()}
    known |= {column: f"sensors->gyro.{axis} * {degree}" for column, axis in zip("pqr", "xyz")}
    known |= {f"a{axis}": f"sensors->acc.{axis} * {g}" for axis in "xyz"}
    battery = board.battery
    place, log = folder / "crazyflie", board.name[:9].lower()
    words = {
        "calls": str(calls),
        "dt": f"{f.dt:g}",
        "degree": degree,
        "measured": board.measured(known),
        "log": log,
        "battery_header": "" if battery is None else '#include "pm.h"\n',
        "battery_line": ""
        if battery is None
        else "The battery's voltage is that of the firmware's power management.\n",
        "battery": ""
        if battery is None
        else f"      {board.name}_flight_parameter(&flight, {battery}, pmGetBatteryVoltage());\n",
        "logged": "\n".join(
            f"LOG_ADD(LOG_FLOAT, {n}, &predicted[{i}])" for i, n in enumerate(f.outputs.names)
        ),
        "atan2": "atan2f",
    }
    units = [f"{board.name}{end}" for end in ("", "_model", "_flight")]
    for unit in units:
        # one file of the bundle each: nothing is copied
        write_atomic(place / "src" / f"unit_{unit}.c", f'#include "../../c/{unit}.c"\n')
    objects = [f"{board.name}_app.o", *(f"unit_{unit}.o" for unit in units)]
    app = broken(board.text("crazyflie/app.c", **words))
    write_atomic(place / "src" / f"{board.name}_app.c", app)
    write_atomic(place / "src" / "Kbuild", "".join(f"obj-y += {o}\n" for o in objects))
    write_atomic(place / "Kbuild", "obj-y += src/\n")
    write_atomic(place / "Makefile", board.text("crazyflie/Makefile"))
    write_atomic(place / "app-config", board.text("crazyflie/app-config"))
    write_atomic(place / "README.md", board.text("crazyflie/README.md", **words))
    return {"folder": "crazyflie", "every_calls": calls}
