"""sensors.toml: what the sensors of the model add to the truth, for any simulator."""

from __future__ import annotations

import math
from collections.abc import Mapping

from greybox.data.channel import group_names
from greybox.model.clock import CLOCKS
from greybox.model.noise import sensor_parts
from greybox.model.sensors import SENSORS
from greybox.simulators.craft import Craft

GROUPS: Mapping[str, tuple[tuple[str, ...], str]] = {
    "gyro": (("p", "q", "r"), "rad/s"),
    "accelerometer": (("ax", "ay", "az"), "m/s^2"),
    "attitude": (("attitude.x", "attitude.y", "attitude.z"), "rad"),
    "position": (("position.x", "position.y", "position.z"), "m"),
    "velocity": (("velocity.x", "velocity.y", "velocity.z"), "m/s"),
}
"""Sensor -> its innovation channels and their unit, where no rotor has its own."""


_MEANS = {
    "coloured": ", T in s: first-order Gauss-Markov",
    "line": ", T in s, frequency in Hz: narrow band",
    "drift": " after one second: random walk",
    "low_pass": " of white noise in front of the filter, T in s, cutoff in Hz",
    "delay": ", as the filter of the model has it",
}


def groups(craft: Craft) -> dict[str, tuple[tuple[str, ...], str]]:
    """`GROUPS`, and the rotor speeds of this craft."""
    return {**GROUPS, "rotor_speed": (group_names("rotor_speed", craft.count), "rad/s")}


def density(craft: Craft, sensor: str) -> float | None:
    """White noise as a density, unit/sqrt(Hz): the mean over the axes of sigma sqrt(dt)."""
    sigma = craft.noise(groups(craft)[sensor][0])
    if sigma is None:
        return None
    return float(math.sqrt((sigma**2).mean()) * math.sqrt(craft.sample_time))


def coloured_parts(craft: Craft, sensor: str) -> dict[str, dict[str, float]]:
    """Kind of a sensor's noise that is correlated in time -> its numbers: coloured and line (sigma,
    T [s], frequency [Hz]), drift (sigma after a second), low_pass (T, cutoff [Hz], sigma in front).
    Sigmas are root mean squares over the axes, in the sensor's unit."""
    model = craft.source
    level = dict(zip(model.dynamics.noises.names, model.process_noise.tolist(), strict=True))
    found = {}
    for part in sensor_parts(model.dynamics):
        if part.sensor == sensor:
            own = [v for n, v in level.items() if n.startswith(f"{part.name}.{part.copies[0]}.")]
            size = math.sqrt(sum(v * v for v in own) / max(1, len(own)))
            numbers = part.described(size, model.values, model.sample_time)
            found[part.kind] = {k: float(v) for k, v in numbers.items()}
    return found


def sensor_text(craft: Craft, spread: Mapping[str, tuple[float, float]]) -> str:
    """The file: per sensor white noise per sample and as a density, bias with its spread from
    flight to flight, scale, misalignment and delay of the model's sensor effects, and noise that is
    correlated in time."""
    lines = [
        f"# Sensors of {craft.name}, as identified. Standard deviations; body axes FLU, world ENU.",
        f"sample_time = {craft.sample_time!r}  # s",
    ]
    for sensor, (names, unit) in groups(craft).items():
        sigma = craft.noise(names)
        if sigma is None:
            continue
        lines += ["", f"[{sensor}]"]
        lines.append(f"white = {[float(v) for v in sigma]}  # {unit}, per sample")
        lines.append(f"density = {density(craft, sensor)!r}  # {unit}/sqrt(Hz), mean over the axes")
        lines += _effect_lines(craft, sensor, spread)
        for kind, numbers in coloured_parts(craft, sensor).items():
            lines.append(f"[{sensor}.{kind}]  # sigma in {unit}{_MEANS[kind]}")
            lines += [f"{k} = {v!r}" for k, v in numbers.items()]
    return "\n".join(lines) + "\n"


def _effect_lines(
    craft: Craft, sensor: str, spread: Mapping[str, tuple[float, float]]
) -> list[str]:
    """Numbers of the sensor's effects, with the spread between flights where there is one."""
    lines = []
    late = next(CLOCKS[s.clock].delay for s in SENSORS if s.name == sensor)
    delays = [n for n, e in craft.effects.items() if late in e.early]
    turned = "mocap_misalignment" if sensor == "attitude" else "imu_misalignment"
    effects = {f"{sensor}_bias": "bias", f"{sensor}_scale": "scale"}
    effects |= dict.fromkeys(delays, "delay")
    if sensor in ("gyro", "accelerometer", "attitude"):
        effects[turned] = "misalignment"
    if sensor == "accelerometer":
        effects["accelerometer_lever_arm"] = "lever_arm"
    for name, key in effects.items():
        effect = craft.effects.get(name)
        if effect is None:
            continue
        rows = effect.parameters(craft.physics.vehicle)
        full = [f"{name}.{d.name}" for d in rows]
        numbers = [craft.values[n] for n in full]
        lines.append(f"{key} = {numbers}  # {rows[0].unit}")
        if any(n in spread for n in full):
            between = [spread[n][1] if n in spread else 0.0 for n in full]
            lines.append(f"{key}_between_flights = {between}  # {rows[0].unit}")
    return lines
