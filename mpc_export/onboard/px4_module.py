"""A PX4 module: uORB topics in, the bundle's pilot, actuator_motors out.

Written from what PX4 publishes: modules on a work queue (docs.px4.io, "Module Template", "External
Modules") and the messages VehicleAttitude, VehicleAngularVelocity, SensorCombined,
VehicleLocalPosition, TrajectorySetpoint, VehicleControlMode and ActuatorMotors. PX4's world is NED,
its body FRD; the model's are ENU and FLU. `frames.hpp` is the one place where they meet.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from greybox.files import write_atomic
from mpc_export.onboard.flight import OnBoard

if TYPE_CHECKING:
    from mpc_export.manifest import TargetPart


TARGET = "px4-module"
ROTORS = 12


DOUBLE = """

This bundle computes in double, which some flight controllers emulate or do slowly: export it with `--float`."""


def write(board: OnBoard, folder: Path) -> TargetPart:
    """The module in folder/px4. Raises `ModelError` for a model that PX4's motors cannot fly."""
    board.demand(TARGET, rotors=ROTORS, unit=True)
    f = board.functions
    known: dict[str, str] = {}
    there: dict[str, str] = {}
    for names, own in (
        (("x", "y", "z"), "place"),
        (("vx", "vy", "vz"), "speed"),
        (("qw", "qx", "qy", "qz"), "q"),
        (("p", "q", "r"), "rate"),
        (("ax", "ay", "az"), "force"),
    ):
        known |= {n: f"{own}[{i}]" for i, n in enumerate(names)}
        there |= dict.fromkeys(names, f"seen_{own}")
    name = board.name
    words = {
        "Class": "".join(part.capitalize() for part in name.split("_")) + "Module",
        "micros": str(round(1e6 * f.dt)),
        "measured": board.measured(known, there).replace("\n  ", "\n\t").replace("  y", "\ty", 1),
        "root": board.number(0.5**0.5),
        "quarter": board.number(1.5707963267948966),
        **_battery(board),
        "precision": DOUBLE if board.real == "double" else "",
    }
    place = folder / "px4" / "src" / "modules" / name
    for unit in (name, f"{name}_model", f"{name}_flight"):
        # one file of the bundle each: nothing is copied
        write_atomic(place / f"unit_{unit}.c", f'#include "../../../../c/{unit}.c"\n')
    for path, text in {
        place / "frames.hpp": "px4/frames.hpp",
        place / f"{words['Class']}.hpp": "px4/module.hpp",
        place / f"{words['Class']}.cpp": "px4/module.cpp",
        place / "CMakeLists.txt": "px4/CMakeLists.txt",
        place / "Kconfig": "px4/Kconfig",
        place / "module.yaml": "px4/module.yaml",
        folder / "px4" / "src" / "CMakeLists.txt": "px4/external.cmake",
        folder / "px4" / "README.md": "px4/README.md",
    }.items():
        write_atomic(path, board.text(text, **words))
    return {
        "folder": "px4",
        "interval_us": round(1e6 * f.dt),
        "note": f"u = idle + (1 - idle) control of actuator_motors, idle = {name.upper()}_IDLE: "
        "set it as px4/README.md says",
    }


def _battery(board: OnBoard) -> dict[str, str]:
    """What the templates say of the battery: nothing for a model without one."""
    battery = board.battery
    if battery is None:
        return dict.fromkeys(("battery_header", "battery_row", "battery_member", "battery"), "")
    return {
        "battery_header": "#include <uORB/topics/battery_status.h>",
        "battery_row": f"| battery_status | in | its voltage. {board.said_of_volts()} |\n",
        "battery_member": "	uORB::Subscription _battery_sub{ORB_ID(battery_status)};\n",
        "battery": f"""
	battery_status_s battery{{}};

	if (_battery_sub.update(&battery)) {{
		{board.name}_flight_parameter(&_flight, {battery}, battery.voltage_v);
	}}
""",
    }
