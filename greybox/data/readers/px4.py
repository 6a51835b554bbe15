"""What PX4's uORB topics are: which fields of which topic are which channels, over the versions of
PX4.

PX4's body axes are FRD and its world NED. References: uORB messages and parameters at docs.px4.io;
parameter THR_MDL_FAC for the map from thrust to motor signal; PX4-Autopilot
src/modules/logger/logged_topics.cpp for what is logged how often, src/lib/mixer_module (outputs go
from their least value, not from none, to their largest), src/drivers/dshot/DShot.cpp,
src/modules/simulation/gz_bridge/GZMixingInterfaceESC.cpp (v1.14 to v1.16).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from greybox.data.raw import FloatArray
from greybox.data.readers.recording import Source, Stream

MOTOR_FUNCTION = 101
"""Output function (PWM_MAIN_FUNCi and the like) of motor 1 in PX4."""

DSHOT = range(-8, -2)
"""Values of PWM_MAIN_TIMi and the like that are DShot, with -8 to -6 in both directions."""
GAZEBO = "SIM_GZ_EC"
"""Outputs to Gazebo, which are rotor speeds [rad/s]."""
VTOL = range(19, 26)
"""MAV_TYPE of craft that also fly on wings (MAVLink): among their outputs stand servos."""

QUATERNION = ("q[0]", "q[1]", "q[2]", "q[3]")


def rotors_of(
    parameters: Mapping[str, float],
) -> tuple[tuple[tuple[float, float, float], int], ...]:
    """Positions [m, FLU] and spins from CA_ROTORi_PX, PY, PZ (FRD) and KM (positive:
    counter-clockwise)."""
    count = int(parameters.get("CA_ROTOR_COUNT", 0))
    out = []
    for i in range(min(max(count, 0), 12)):
        x, y, z, k = (
            parameters.get(f"CA_ROTOR{i}_{p}", math.nan) for p in ("PX", "PY", "PZ", "KM")
        )
        if not math.isfinite(x + y + k):
            return ()
        out.append(((x, -y, -z if math.isfinite(z) and z else 0.0), 1 if k > 0 else -1))
    return tuple(out)


def signal_of_thrust(factor: float) -> Callable[[FloatArray], FloatArray]:
    """Motor signal s of the thrust setpoint T: T = factor s^2 + (1 - factor) s, as PX4's
    THR_MDL_FAC defines it."""

    def convert(thrust: FloatArray) -> FloatArray:
        rest = 1.0 - factor
        root = (-rest + np.sqrt(rest**2 + 4.0 * factor * np.maximum(thrust, 0.0))) / (2.0 * factor)
        return np.asarray(np.where(thrust > 0, root, thrust))

    return convert


def idle_of(parameters: Mapping[str, float]) -> float:
    """Share of the full motor signal that a running motor gets at a command of zero: of Gazebo's
    speeds, and of DShot. 0 for PWM, of which nobody says what an ESC takes for none."""
    for i in range(1, 17):
        if is_motor(parameters.get(f"{GAZEBO}_FUNC{i}", 0.0)):
            low, high = (parameters.get(f"{GAZEBO}_{end}{i}", 0.0) for end in ("MIN", "MAX"))
            return low / high if 0.0 < low < high else 0.0
    least = parameters.get("DSHOT_MIN", 0.0)
    for bus in ("PWM_MAIN", "PWM_AUX"):
        # A timer of outputs that drive no motor says nothing of the motors.
        motors = any(is_motor(parameters.get(f"{bus}_FUNC{i}", 0.0)) for i in range(1, 17))
        dshot = any(parameters.get(f"{bus}_TIM{k}", 0.0) in DSHOT for k in range(16))
        if motors and dshot and 0.0 < least < 1.0:
            return least
    return 0.0


def is_motor(function: float) -> bool:
    """Whether an output function is that of a motor."""
    return MOTOR_FUNCTION <= function < MOTOR_FUNCTION + 12


def motor_signal(factor: float, idle: float) -> Callable[[FloatArray], FloatArray] | None:
    """Motor signal of the thrust setpoints (N, K): that of THR_MDL_FAC, which begins at the idle.
    All motors at zero are stopped. None where it is the setpoint itself."""
    if not factor and not idle:
        return None
    shaped = signal_of_thrust(factor) if factor else np.asarray

    def convert(thrust: FloatArray) -> FloatArray:
        signal = np.asarray(shaped(thrust))
        runs = (thrust >= 0.0) & (thrust > 0.0).any(axis=-1, keepdims=True)
        return np.asarray(np.where(runs, idle + (1.0 - idle) * signal, signal))

    return convert


def _stopped(low: FloatArray, high: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Outputs low..high (K,) to 0..1; below `low` (disarmed) is 0."""
    return lambda values: np.asarray(np.maximum((values - low) / (high - low), 0.0))


ATTITUDES = {
    "vehicle_attitude": "PX4's estimate",
    "vehicle_mocap_odometry": "external pose",
    "vehicle_visual_odometry": "external pose",
    "att_pos_mocap": "external pose",
    "vehicle_vision_attitude": "external pose",
    "vehicle_attitude_groundtruth": "simulator",
}
"""Topics with an attitude, in order of preference, and where it comes from."""


def sources_of(
    streams: Mapping[str, Stream], parameters: Mapping[str, float], factor: float, rotors: int
) -> Iterator[Source]:
    """All sources of a PX4 log, in order of preference per group.

    `parameters` are PX4's, `factor` its THR_MDL_FAC, `rotors` their number where it is known, else
    0.
    """
    yield from _commands(streams, parameters, factor, rotors)
    if not any(is_motor(parameters.get(f"{GAZEBO}_FUNC{i}", 0.0)) for i in range(1, 17)):
        # In Gazebo esc_status repeats what was commanded, in rad/s.
        yield from _speeds(streams)
    for name, stream in streams.items():
        if stream.kind == "battery_status":
            for key in ("voltage_v", "voltage_filtered_v"):
                yield Source(group="battery", stream=name, fields=(key,), unit="V")
    for topic, note in ATTITUDES.items():
        yield Source(group="attitude", stream=topic, fields=QUATERNION, frame="FRD/NED", note=note)
    yield from _integrals(streams)
    yield from _filtered(streams)
    yield from _places(streams)
    for topic in ("trajectory_setpoint", "vehicle_local_position_setpoint"):
        for fields in (("position[0]", "position[1]", "position[2]"), ("x", "y", "z")):
            yield Source(group="setpoint", stream=topic, fields=fields, frame="NED")


def _places(streams: Mapping[str, Stream]) -> Iterator[Source]:
    """Position and velocity: PX4's estimate, external poses, the simulator's."""
    local = "vehicle_local_position"
    poses = (
        ("vehicle_mocap_odometry", "external pose"),
        ("vehicle_visual_odometry", "external pose"),
    )
    yield Source(
        group="position", stream=local, fields=("x", "y", "z"), frame="NED", note="PX4's estimate"
    )
    yield Source(
        group="velocity",
        stream=local,
        fields=("vx", "vy", "vz"),
        frame="NED",
        note="PX4's estimate",
    )
    for topic, note in (*poses, ("att_pos_mocap", "external pose")):
        for fields in (("position[0]", "position[1]", "position[2]"), ("x", "y", "z")):
            yield Source(group="position", stream=topic, fields=fields, frame="NED", note=note)
    for topic, note in poses:
        frame = _velocity_frame(streams.get(topic))
        for fields in (("velocity[0]", "velocity[1]", "velocity[2]"), ("vx", "vy", "vz")):
            yield Source(group="velocity", stream=topic, fields=fields, frame=frame, note=note)
    truth = "vehicle_local_position_groundtruth"
    yield Source(
        group="position", stream=truth, fields=("x", "y", "z"), frame="NED", note="simulator"
    )
    yield Source(
        group="velocity", stream=truth, fields=("vx", "vy", "vz"), frame="NED", note="simulator"
    )


def _velocity_frame(stream: Stream | None) -> str:
    """Frame of an odometry message's velocity: 3 is body FRD in `velocity_frame`, everything else
    is taken as NED."""
    if stream is not None and "velocity_frame" in stream.fields:
        return "FRD" if float(np.median(stream.fields["velocity_frame"])) == 3.0 else "NED"
    return "NED"


def _half_interval(span: FloatArray | None) -> float:
    """Half of the time [s] over which a sample is a mean: microseconds, or seconds in old logs; 0
    where it is not known."""
    if span is None or not span.size:
        return 0.0
    middle = float(np.median(span))
    seconds = middle if middle < 1.0 else 1e-6 * middle
    return 0.5 * seconds if 0.0 < seconds < 0.05 else 0.0


def _integrals(streams: Mapping[str, Stream]) -> Iterator[Source]:
    """Gyro and accelerometer as means over the time before the stamp."""
    combined = streams.get("sensor_combined")
    delay = {}
    for group, key in (
        ("rate", "gyro_integral_dt"),
        ("specific_force", "accelerometer_integral_dt"),
    ):
        delay[group] = _half_interval(combined.fields.get(key) if combined else None)
    gyro = ("gyro_rad[0]", "gyro_rad[1]", "gyro_rad[2]")
    force = ("accelerometer_m_s2[0]", "accelerometer_m_s2[1]", "accelerometer_m_s2[2]")
    yield Source(
        group="rate", stream="sensor_combined", fields=gyro, frame="FRD", delay=delay["rate"]
    )
    # Both sensors share the stamps of the message, and nearly always the interval: one delay keeps
    # them in one row.
    yield Source(
        group="specific_force",
        stream="sensor_combined",
        fields=force,
        frame="FRD",
        delay=delay["rate"],
    )
    imus = [n for n, s in streams.items() if s.kind == "vehicle_imu"]
    for name in imus:
        for group, part in (("rate", "angle"), ("specific_force", "velocity")):
            yield Source(
                group=group,
                stream=name,
                fields=tuple(f"delta_{part}[{axis}] / dt" for axis in range(3)),
                frame="FRD",
                delay=_half_interval(streams[name].fields.get(f"delta_{part}_dt")),
            )


def _filtered(streams: Mapping[str, Stream]) -> Iterator[Source]:
    """Gyro and accelerometer behind a low-pass, which adds a delay, and raw ones."""
    filtered = "low-pass filtered by PX4"
    yield Source(
        group="rate",
        stream="vehicle_angular_velocity",
        fields=("xyz[0]", "xyz[1]", "xyz[2]"),
        frame="FRD",
        note=filtered,
    )
    yield Source(
        group="specific_force",
        stream="vehicle_acceleration",
        fields=("xyz[0]", "xyz[1]", "xyz[2]"),
        frame="FRD",
        note=filtered,
    )
    for name, stream in streams.items():
        if stream.kind in ("sensor_gyro", "sensor_accel"):
            group = "rate" if stream.kind == "sensor_gyro" else "specific_force"
            yield Source(
                group=group, stream=name, fields=("x", "y", "z"), frame="FRD", note="one raw sensor"
            )
    yield Source(
        group="rate",
        stream="vehicle_attitude",
        fields=("rollspeed", "pitchspeed", "yawspeed"),
        frame="FRD",
        note="PX4's estimate",
    )


def _commands(
    streams: Mapping[str, Stream], parameters: Mapping[str, float], factor: float, rotors: int
) -> Iterator[Source]:
    """actuator_motors (thrust before THR_MDL_FAC) since PX4 1.13; actuator_outputs (what the driver
    sends) always."""
    motors = streams.get("actuator_motors")
    if motors is not None:
        used = tuple(
            key
            for i in range(12)
            if (key := f"control[{i}]") in motors.fields and np.isfinite(motors.fields[key]).any()
        )
        if used:
            idle = idle_of(parameters)
            said = [f"THR_MDL_FAC = {factor:g}"] if factor else []
            said += [f"idle {idle:.3f}"] if idle else []
            yield Source(
                group="command",
                stream="actuator_motors",
                fields=used[:rotors] if rotors else used,
                convert=motor_signal(factor, idle),
                note=", ".join(said),
            )
    found = []
    for name, stream in streams.items():
        if stream.kind in ("actuator_outputs", "actuator_outputs_debug"):
            for source, moving in _outputs(name, stream, parameters, rotors):
                found.append((moving, source))
    for _, source in sorted(found, key=lambda pair: -pair[0]):
        yield source


def _outputs(
    name: str, stream: Stream, parameters: Mapping[str, float], rotors: int
) -> Iterator[tuple[Source, float]]:
    """The motor outputs of one instance, and how much they move (of several instances the one that
    moves drives)."""
    bus, places = _motor_outputs(parameters)
    if not places and servos_among(parameters):
        return
    if not places:
        count = rotors or {2.0: 4, 13.0: 6, 14.0: 8}.get(parameters.get("MAV_TYPE", 0.0), 0)
        moving = [
            i
            for i in range(16)
            if f"output[{i}]" in stream.fields and np.ptp(stream.fields[f"output[{i}]"]) > 0
        ]
        places = tuple(range(count)) if count else tuple(moving)
    used = tuple(f"output[{i}]" for i in places)
    if not used or any(f not in stream.fields for f in used):
        return
    values = np.column_stack([stream.fields[f] for f in used])
    if not np.isfinite(values).any():
        return
    top, spread = float(np.nanmax(values)), float(np.nanmean(np.nanstd(values, axis=0)))
    if top <= 1.5:
        yield Source(group="command", stream=name, fields=used), spread
    elif bus == GAZEBO or (800.0 < top <= 2500.0 and float(np.nanmin(values)) >= 500.0):
        low, high = _ends(bus, places, parameters)
        what, unit = ("speed", "rad/s") if bus == GAZEBO else ("PWM", "us")
        ends = dict.fromkeys(zip(low.tolist(), high.tolist(), strict=True))
        yield (
            Source(
                group="command",
                stream=name,
                fields=used,
                convert=_stopped(low, high),
                note=f"{what} {', '.join(f'{a:g}..{b:g}' for a, b in ends)} {unit}",
            ),
            float(np.nanmean(np.nanstd(values, axis=0) / (high - low))),
        )


def _ends(
    bus: str, places: Sequence[int], parameters: Mapping[str, float]
) -> tuple[FloatArray, FloatArray]:
    """Values (K,) of none and of full motor signal of the outputs at `places` of a bus: shortest and
    longest pulse [us], or 0 and the largest speed [rad/s] in Gazebo; those of its first where one
    has none. Older versions have one range of all outputs; where they have one each besides, -1
    there stands for that."""

    def of(end: str, place: int, usual: float) -> float:
        own, first = f"{bus}_{end}{place + 1}", f"{bus}_{end}1"
        names = (own if own in parameters else first, f"{bus}_{end}", f"PWM_{end}")
        return next((v for n in names if (v := parameters.get(n, 0.0)) > 0.0), usual)

    if bus == GAZEBO:
        return np.zeros(len(places)), np.array(
            [parameters.get(f"{bus}_MAX{i + 1}", 0.0) or 1000.0 for i in places]
        )
    low, high = (
        np.array([of(end, i, usual) for i in places])
        for end, usual in (("MIN", 1000.0), ("MAX", 2000.0))
    )
    sound = high > low
    return np.where(sound, low, 1000.0), np.where(sound, high, 2000.0)


def servos_among(parameters: Mapping[str, float]) -> bool:
    """Whether servos stand among the outputs, so that without output functions no rotor is
    known."""
    return int(parameters.get("MAV_TYPE", 0)) in VTOL


def _motor_outputs(parameters: Mapping[str, float]) -> tuple[str, tuple[int, ...]]:
    """(bus, indices of its outputs that drive motors 1, 2, ...) by the function parameters of the
    main or auxiliary outputs; the main ones and no index where these do not tell."""
    for bus in ("PWM_MAIN", "PWM_AUX", GAZEBO, "UAVCAN_EC"):
        places: dict[int, int] = {}
        for i in range(16):
            function = int(parameters.get(f"{bus}_FUNC{i + 1}", 0))
            if is_motor(function):
                places.setdefault(function - MOTOR_FUNCTION, i)
        if places and sorted(places) == list(range(len(places))):
            return bus, tuple(places[k] for k in range(len(places)))
    return "PWM_MAIN", ()


def _speeds(streams: Mapping[str, Stream]) -> Iterator[Source]:
    """Rotor speeds of esc_status, in motor order where the ESCs say which motor they drive."""
    stream = streams.get("esc_status")
    if stream is None:
        return
    places: dict[int, str] = {}
    for i in range(8):
        speed = stream.fields.get(f"esc[{i}].esc_rpm")
        if speed is None or not np.isfinite(speed).any() or not (speed != 0).any():
            continue
        function = stream.fields.get(f"esc[{i}].actuator_function")
        motor = (
            int(np.median(function)) - MOTOR_FUNCTION
            if function is not None and function.size
            else i
        )
        places.setdefault(motor if 0 <= motor < 12 else i, f"esc[{i}].esc_rpm")
    if places and sorted(places) == list(range(len(places))):
        fields = tuple(places[k] for k in range(len(places)))
        yield Source(
            group="rotor_speed", stream="esc_status", fields=fields, unit="rpm", convert=np.abs
        )
