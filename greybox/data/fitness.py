"""Whether a log can be fitted at all: armed, in the air, fast enough, with commands of rotors.

Said first by `greybox inspect`, for a log of any format, from the channels alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np

from greybox.data.channel import command_names, rotor_speed_names
from greybox.data.raw import RawLog

ROTORS = (0.02, 0.08)
"""Time [s] in which the fastest and the slowest rotors of small craft answer a command."""
SLOWEST = 1.0 / ROTORS[1]
"""Samples per second [Hz] of commands and of the fastest sensor up to which every rotor has answered
within a row: nothing shows how, and the turns in between are not known."""
ROUND = 0.05
"""Share by which a rate may miss a round number."""
DISARMED = 0.02
"""Share of the range that no command ever passes: the motors do not turn."""
GROUNDED = 0.1
"""Mean command that is passed for less than a twentieth of the time: idling motors lift nothing."""
STILL = 0.02
"""Body rate [rad/s RMS] of a craft that stands ..."""
SLOW = 0.3
"""... and change of velocity [m/s] that it passes for less than a twentieth of the time: an
estimate wanders."""
MEASURED = ("rate", "specific_force", "attitude", "position", "velocity")


def unfit(raw: RawLog, rates: Mapping[str, float]) -> Iterator[str]:
    """Why no model can be fitted to this log; nothing where one can. `rates` [Hz] by channel
    group."""
    names = command_names(raw.channels)
    sensors = [rates[g] for g in MEASURED if g in rates]
    if not names:
        if "rotor_speed" not in rates:
            yield "no commands of rotors and no rotor speeds"
            return
        seen = [raw.channels[n] for n in rotor_speed_names(raw.channels)]
        if not any((v[np.isfinite(v)] > 0).any() for v in seen):
            yield "disarmed: no motor ever turns"
        elif _stands(raw):
            yield "on the ground: motors run, but the gyro shows no motion"
        if rates["rotor_speed"] <= SLOWEST:
            yield (
                f"too slow: rotor speeds come at {rates['rotor_speed']:.3g} Hz, a fit needs "
                f"more than {SLOWEST:g} Hz"
            )
    else:
        u = np.column_stack([raw.channels[n] for n in names])
        u = u[np.isfinite(u).all(axis=1)]
        if not u.size or float(u.max()) <= DISARMED:
            yield "disarmed: no motor ever turns"
        elif float(np.percentile(u.mean(axis=1), 95)) < GROUNDED:
            yield (
                f"on the ground: the commands hardly pass {GROUNDED:g}, idling motors lift nothing"
            )
        elif _stands(raw):
            yield "on the ground: motors run, but the gyro shows no motion"
        if max(rates.get("command", math.inf), rates.get("rotor_speed", 0.0)) <= SLOWEST:
            yield (
                f"too slow: commands come at {rates['command']:.3g} Hz, a fit needs more "
                f"than {SLOWEST:g} Hz"
            )
    if not sensors:
        yield "no gyro, accelerometer, attitude, position or velocity"
    elif max(sensors) <= SLOWEST:
        yield (
            f"too slow: the fastest sensor comes at {max(sensors):.3g} Hz, a fit needs "
            f"more than {SLOWEST:g} Hz"
        )


def untold(rates: Mapping[str, float]) -> Iterator[str]:
    """What a log that can be fitted is too slow to tell; nothing of one with rows as quick as the
    fastest rotors. `rates` [Hz] by channel group."""
    driven = [rates[g] for g in ("command", "rotor_speed") if g in rates]
    sensors = [rates[g] for g in MEASURED if g in rates]
    if not (driven and sensors):
        return
    rate = min(max(driven), max(sensors))
    if SLOWEST < rate < (1.0 - ROUND) / ROTORS[0]:
        yield (
            f"rows come every {1e3 / rate:.0f} ms: rotors that answer within that (they take "
            f"{1e3 * ROTORS[0]:.0f} to {1e3 * ROTORS[1]:.0f} ms) show lag and delay only together"
        )


def unscaled(raw: RawLog) -> Iterator[str]:
    """That commands still need their range, where most are none of 0 to 1."""
    names = command_names(raw.channels)
    u = np.concatenate([raw.channels[n] for n in names]) if names else np.zeros(0)
    u = u[np.isfinite(u)]
    if u.size and not 0.0 <= float(np.median(u)) <= 1.0:
        yield (
            f"commands go from {u.min():.4g} to {u.max():.4g}: say what is u = 0 and u = 1, "
            "limits = [low, high] of [command] in a mapping file, or u_min and u_max of the vehicle "
            "file"
        )


def _stands(raw: RawLog) -> bool:
    if not all(n in raw.channels for n in "pqr"):
        return False
    if all(n in raw.channels for n in ("vx", "vy", "vz")):
        velocity = np.column_stack([raw.channels[n] for n in ("vx", "vy", "vz")])
        velocity = velocity[np.isfinite(velocity).all(axis=1)]
        change = (
            np.sqrt(((velocity - np.median(velocity, axis=0)) ** 2).sum(axis=1))
            if velocity.size
            else np.zeros(1)
        )
        if float(np.percentile(change, 95)) > SLOW:
            # a simulated hover turns less than a real one shakes; a drifting estimate is no motion
            return False
    rate = np.column_stack([raw.channels[n] for n in "pqr"])
    rate = rate[np.isfinite(rate).all(axis=1)]
    return bool(
        rate.size
        and float(np.sqrt(((rate - np.median(rate, axis=0)) ** 2).sum(axis=1).mean())) < STILL
    )
