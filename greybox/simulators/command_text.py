"""commands.py: the way from commands to rotor speeds, as a module of NumPy that goes with a file.

Simulators take rotor speeds; command map, battery, uneven rotors and delay come before them and are
the same for all that a Python program drives.
"""

from __future__ import annotations

from greybox.simulators.change import Change
from greybox.simulators.craft import Craft
from greybox.simulators.words import Wording

EFFECTS = ("command_delay", "command_saturation", "thrust_curve", "battery_sag")

_TEXT = '''"""From commands to rotor speeds of {title}: written by greybox twin, needs NumPy only.

    speeds = normalised_speed(u)              # nu, 1 is full speed; u is 0 .. 1 per rotor
    speeds = normalised_speed(u, voltage)     # of a battery at that voltage [V]
    line = DelayLine(); line.pieces(u, dt)    # what reaches the motors in the next dt seconds
"""

import numpy as np

DELAY = {delay!r}                # s, of a command on its way to the motors
U_MIN, U_MAX = {low!r}, {high!r}  # commands at which motors saturate
CURVE = {curve!r}                # f of (1 - f) u + f u^2
VOLTAGE_GAIN = {gain!r}          # c_V of 1 + c_V (V - V0) / V0
NOMINAL_VOLTAGE = {nominal!r}    # V0 [V]
SPEED_MAX = {speed!r}            # rad/s at nu = 1{unknown}
RPM_MAX = SPEED_MAX * 60.0 / (2.0 * np.pi)
STRENGTH = np.array({strength})  # thrust and torque of each rotor against their mean
LAGS = {up!r}, {down!r}          # s, of rotors that speed up and slow down
HOVER = {hover!r}                # nu that carries the weight
HOVER_COMMAND = {command!r}        # u that makes it, at the nominal voltage


def normalised_speed(u, voltage=None):
    """Speeds nu (..., n) that rotors settle at for commands u (..., n), which U_MIN and U_MAX
    limit, and a battery voltage [V] (None: the nominal one)."""
    u = np.clip(np.asarray(u, dtype=float), U_MIN, U_MAX)
    nu = (1.0 - CURVE) * u + CURVE * u * u
    if voltage is not None and NOMINAL_VOLTAGE:
        sag = VOLTAGE_GAIN * (np.asarray(voltage) - NOMINAL_VOLTAGE) / NOMINAL_VOLTAGE
        nu = nu * (1.0 + sag)
    return nu


def command_of(nu):
    """Commands u (..., n) for which rotors settle at speeds nu (..., n), at the nominal voltage."""
    nu = np.asarray(nu, dtype=float)
    return 2.0 * nu / (1.0 - CURVE + np.sqrt((1.0 - CURVE) ** 2 + 4.0 * CURVE * nu))


class DelayLine:
    """Commands on their way: exact for commands that are held from one call to the next."""

    def __init__(self, first=HOVER_COMMAND):
        self._sent = [(-np.inf, first)]
        self._time = 0.0

    def pieces(self, u, dt):
        """[(seconds, command)] that reach the motors during the next `dt` [s], if u is sent now."""
        self._sent.append((self._time, u))
        end = self._time + dt
        pieces = []
        for k, (sent, command) in enumerate(self._sent):
            until = self._sent[k + 1][0] + DELAY if k + 1 < len(self._sent) else np.inf
            duration = min(until, end) - max(sent + DELAY, self._time)
            if duration > 1e-9:
                pieces.append((duration, command))
        self._time = end
        while len(self._sent) > 1 and self._sent[1][0] + DELAY <= end + 1e-9:
            del self._sent[0]
        return pieces


class Rotors:
    """Delay, lag and strength of the rotors, for simulators whose rotors follow at once."""

    def __init__(self, nu=HOVER):
        self.nu = np.full(len(STRENGTH), nu)
        self._line = DelayLine(command_of(self.nu))

    def speeds(self, u, dt, voltage=None):
        """Mean speeds nu (n,) over the next `dt` [s] if u (n,) is sent now, scaled so that equal
        thrust maps give the thrust of uneven rotors. Call it once per simulator step."""
        mean = np.zeros_like(self.nu)
        for seconds, held in self._line.pieces(u, dt):
            gap = self.nu - normalised_speed(held, voltage)
            lag = np.maximum(np.where(gap > 0, LAGS[1], LAGS[0]), 1e-9)
            left = np.exp(-seconds / lag)
            goal = self.nu - gap
            mean += seconds / dt * goal + gap * lag / dt * (1.0 - left)
            self.nu = goal + gap * left
        return mean * np.sqrt(STRENGTH)
'''


def command_text(craft: Craft) -> str:
    """The module for this craft."""
    low, high = craft.command_range
    return _TEXT.format(
        title=craft.title.replace("\\", "/").replace('"""', "'"),
        delay=craft.get("command_delay.d"),
        low=low,
        high=high,
        curve=craft.get("thrust_curve.f"),
        # simulators lose the battery, so that the craft as they say it has none
        gain=float(craft.source.values.get("battery_sag.c_V", 0.0)),
        nominal=craft.nominal_voltage,
        speed=craft.speed_max,
        unknown="" if craft.speed_known else ", counted so: the vehicle file has no speed_max",
        hover=craft.hover_nu,
        command=craft.hover_command,
        strength=craft.strength.tolist(),
        up=craft.lags[0],
        down=craft.lags[1],
    )


def say_commands(wording: Wording) -> None:
    """Rows of what commands.py carries."""
    for name in ("command_delay", "command_saturation", "thrust_curve"):
        wording.said(name, "commands.py")
    wording.folded(
        "battery_sag",
        "commands.py scales the speeds by the voltage that you give; without one it is nominal",
        Change(without=("battery_sag",)),
    )
