"""A ROS 2 package (ament_cmake): nav_msgs/Odometry and sensor_msgs/Imu in, the bundle's pilot,
commands and predictions out.

Frames are those of REP 103 and REP 105: world ENU, body FLU, SI units; the twist of an Odometry is
in body axes. A second node, in Python, flies the tube controller of greybox with the model file.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from greybox.errors import ModelError
from greybox.files import write_atomic
from mpc_export.onboard.flight import OnBoard

if TYPE_CHECKING:
    from mpc_export.manifest import TargetPart


TARGET = "ros2"
ROTORS = 64


def write(board: OnBoard, folder: Path) -> TargetPart:
    """The package in folder/ros2. Raises `ModelError` for a name that ROS refuses."""
    board.demand(TARGET, rotors=ROTORS, unit=False)
    if board.name != board.name.lower() or "__" in board.name or board.name.endswith("_"):
        raise ModelError(
            "a ROS 2 package has small letters, digits and single underscores",
            got=board.name,
            fix="--name",
        )
    f, real = board.functions, f"{board.name}_real"
    known: dict[str, str] = {}
    there: dict[str, str] = {}
    for names, own, seen in (
        (("x", "y", "z"), "place_", "seen_place_"),
        (("vx", "vy", "vz"), "speed_", "seen_place_"),
        (("qw", "qx", "qy", "qz"), "q_", "seen_place_"),
        (("p", "q", "r"), "rate_", "seen_rate_"),
        (("ax", "ay", "az"), "force_", "seen_force_"),
    ):
        known |= {n: f"static_cast<{real}>({own}[{i}])" for i, n in enumerate(names)}
        there |= dict.fromkeys(names, seen)
    words = {
        "Class": "".join(part.capitalize() for part in board.name.split("_")) + "Node",
        "nanos": str(round(1e9 * f.dt)),
        "measured": board.measured(known, there)
        .replace("  y[", "    y[")
        .replace("  there[", "    there["),
        **_battery(board, real),
        "stopped": ", ".join(board.number(0.0) for _ in f.inputs),
        "inputs": " ".join(f.inputs.names),
        "outputs": " ".join(f.outputs.names),
        "dt": f"{f.dt:g}",
        "units": ", ".join(dict.fromkeys(f.inputs.units)),
    }
    place = folder / "ros2"
    for path, text in {
        place / "src" / f"{board.name}_node.cpp": "ros2/node.cpp",
        place / "scripts" / "tube_node.py": "ros2/tube_node.py.in",
        place / "CMakeLists.txt": "ros2/CMakeLists.txt",
        place / "package.xml": "ros2/package.xml",
        place / "README.md": "ros2/README.md",
    }.items():
        write_atomic(path, board.text(text, **words))
    return {"folder": "ros2", "period_ns": round(1e9 * f.dt)}


def _battery(board: OnBoard, real: str) -> dict[str, str]:
    """What the node has for the battery's voltage; nothing where the model asks for none."""
    if board.battery is None:
        parts = ("", "_header", "_subscription", "_row", "_member")
        return dict.fromkeys((f"battery{part}" for part in parts), "")
    kind = "sensor_msgs::msg::BatteryState"
    said = board.said_of_volts()
    row, volts = board.battery, f"static_cast<{real}>(volts_)"
    return {
        "battery": f"    {board.name}_flight_parameter(&flight_, {row}, {volts});\n",
        "battery_header": "#include <sensor_msgs/msg/battery_state.hpp>\n",
        "battery_subscription": f"""\
    battery_ = create_subscription<{kind}>(
        "battery", sensors, [this]({kind}::ConstSharedPtr m) {{ volts_ = m->voltage; }});
""",
        "battery_row": f"| battery | sensor_msgs/BatteryState | in: its voltage. {said} |\n",
        "battery_member": f"""\
  rclcpp::Subscription<{kind}>::SharedPtr battery_;
  double volts_ = 0;
""",
    }
