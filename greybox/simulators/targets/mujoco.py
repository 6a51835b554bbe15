"""MuJoCo: the craft as MJCF, and a module of callbacks for what MJCF cannot say.

In model.xml a control is the speed nu that a rotor shall reach, its activation the speed that it
has (`dyntype="filter"`, the lag), its force the tangent of the thrust map at hover. callback.py
adds the rest of the force and moment of our model, generated from its own expressions. Without it
(MJX, the viewer) the craft flies near hover and feels no air.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from greybox.simulators.command_text import command_text, say_commands
from greybox.simulators.craft import SHORTEST_LAG, Craft
from greybox.simulators.python_code import NUMBERS, python_source
from greybox.simulators.words import THRUST_MAP, TORQUE_MAP, Status, Word, Wording
from greybox.simulators.wrench import ARGUMENTS, wrench_function
from greybox.symbolic import FloatArray

TIMESTEP = 0.002
"""Of the written model [s]."""

_XML = """<mujoco model="{name}">
  <!-- Written by greybox twin. ctrl: rotor speed nu (commands.py makes it of a command); the full
       force comes with callback.py. -->
  <compiler angle="radian" autolimits="true"/>
  <option integrator="RK4" timestep="{timestep}" gravity="0 0 {gravity}"/>
  <worldbody>
    <light pos="0 0 5"/>
    <body name="craft">
      <freejoint name="root"/>
      <inertial pos="{com}" mass="{mass}" fullinertia="{inertia}"/>
      <geom type="cylinder" size="{radius} {height}" contype="0" conaffinity="0" mass="0"/>
      {sites}
      <site name="imu" pos="{imu}"/>
    </body>
  </worldbody>
  <actuator>
    {actuators}
  </actuator>
  <sensor>
    <!-- noise: standard deviation of a sample; MuJoCo shows it and does not add it -->
    <gyro site="imu"{gyro}/>
    <accelerometer site="imu"{accelerometer}/>
    <framepos objtype="site" objname="imu"{position}/>
    <framequat objtype="site" objname="imu"{attitude}/>
  </sensor>
</mujoco>
"""

_CALLBACK = '''"""What model.xml cannot say of {name}: by greybox twin, needs MuJoCo and NumPy.

    model = mujoco.MjModel.from_xml_path("model.xml"); data = mujoco.MjData(model)
    callback.attach(); callback.hover(model, data)
    data.ctrl[:] = normalised_speed(u); mujoco.mj_step(model, data)
"""

import math

import mujoco
import numpy as np

from commands import HOVER

COUNT = {count}
COM = np.array({com})  # m, centre of mass from the body origin
LAGS = {up!r}, {down!r}  # s, of rotors that speed up and slow down
SLOPE, OFFSET, LARGEST = {slope!r}, {offset!r}, {largest!r}  # N: what an actuator gives
ARMS = np.array({arms})  # m, hubs from the centre of mass
RATIO = np.array({ratio})  # N m of yaw per N of an actuator


{numbers}

{wrench}

def passive(model, data):
    """Add to the passive forces what the actuators do not give."""
    w, x, y, z = data.qpos[3:7]
    R = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])
    rate, nu = data.qvel[3:6], data.act[:COUNT]
    position = data.qpos[:3] + R @ COM
    velocity = data.qvel[:3] + R @ np.cross(rate, COM)
    gap = data.ctrl[:COUNT] - nu
    change = gap / np.where(gap > 0, LAGS[0], LAGS[1])
    args = (data.qpos[3:7], velocity, position, rate, nu, change)
    found = np.array(_wrench(*(a.tolist() for a in args), _Numbers))
    given = np.clip(OFFSET + SLOPE * nu, 0.0, LARGEST)
    force = found[:3] - (0.0, 0.0, given.sum())
    moment = found[3:] - (ARMS[:, 1] @ given, -ARMS[:, 0] @ given, RATIO @ given)
    data.qfrc_passive[:3] += R @ force
    data.qfrc_passive[3:6] += moment + np.cross(COM, force)


def attach():
    """Let every model of this process feel the callback (MuJoCo has one for all)."""
    mujoco.set_mjcb_passive(passive)


def detach():
    """Take the callback away."""
    mujoco.set_mjcb_passive(None)


def hover(model, data):
    """Rotors at hover speed, held there."""
    data.act[:COUNT] = HOVER
    data.ctrl[:COUNT] = HOVER
'''


class MuJoCo:
    """MuJoCo 3 and 4."""

    name = "mujoco"
    simulator = "MuJoCo"
    source = "MuJoCo documentation, XML reference (actuator/general) and mjcb_passive"

    def words(self, craft: Craft) -> tuple[Word, ...]:
        """Everything that moves the body and remembers nothing."""
        w = Wording(craft, self.simulator)
        w.add(Word(effect=THRUST_MAP, status=Status.SAID, how="tangent, callback.py the rest"))
        w.add(Word(effect=TORQUE_MAP, status=Status.SAID, how="tangent, callback.py the rest"))
        say_commands(w)
        w.said("motor_lag", 'dyntype="filter"')
        w.folded_lag_mean()
        for name, effect in craft.effects.items():
            if effect.memory(craft.physics.vehicle):
                w.lost(name, "it remembers; callback.py does not")
            elif effect.stage in ("body", "thrust", "wrench"):
                w.said(name, "callback.py" if effect.stage != "body" else "inertial, callback.py")
        return w.finish()

    def files(self, craft: Craft) -> Mapping[str, str]:
        """model.xml, callback.py and commands.py."""
        return {
            "model.xml": _model(craft),
            "callback.py": _callback(craft),
            "commands.py": command_text(craft),
        }


def tangent(craft: Craft) -> tuple[float, float, float]:
    """(slope, offset, largest) [N]: what an actuator gives at nu, between 0 and the largest."""
    _, c1, c2 = craft.thrust
    nu = craft.hover_nu
    slope = float(c1 + 2.0 * c2 * nu)
    hover = craft.mass * craft.gravity / craft.count
    return slope, hover - slope * nu, max(slope + hover - slope * nu, hover)


def yaw_ratio(craft: Craft) -> FloatArray:
    """Yaw moment per thrust at hover (n,) [m]."""
    _, q1, q2 = craft.torque
    nu = craft.hover_nu
    return -craft.spins * float(q1 + 2.0 * q2 * nu) / tangent(craft)[0]


def _model(craft: Craft) -> str:
    slope, offset, largest = tangent(craft)
    tau = max(craft.get("motor_lag.tau"), SHORTEST_LAG)
    j = craft.inertia
    ratio = yaw_ratio(craft)
    sites = "\n      ".join(
        f'<site name="rotor{i}" pos="{_text(hub)}"/>' for i, hub in enumerate(craft.hubs, 1)
    )
    actuators = "\n    ".join(
        f'<general name="rotor{i}" site="rotor{i}" gear="0 0 1 0 0 {float(ratio[i - 1])!r}" '
        f'dyntype="filter" dynprm="{tau!r}" gainprm="{slope!r}" biastype="affine" '
        f'biasprm="{offset!r} 0 0" forcerange="0 {largest!r}"/>'
        for i in range(1, craft.count + 1)
    )
    arm = float(np.abs(craft.hubs[:, :2]).max())
    return _XML.format(
        name=craft.name,
        timestep=TIMESTEP,
        gravity=repr(-craft.gravity),
        com=_text(craft.center_of_mass),
        mass=repr(craft.mass),
        inertia=_text([j[0, 0], j[1, 1], j[2, 2], j[0, 1], j[0, 2], j[1, 2]]),
        radius=repr(arm),
        height=repr(0.2 * arm),
        sites=sites,
        imu=_text(craft.physics.vehicle.imu_position),
        actuators=actuators,
        gyro=_noise(craft, ("p", "q", "r")),
        accelerometer=_noise(craft, ("ax", "ay", "az")),
        position=_noise(craft, ("position.x", "position.y", "position.z")),
        attitude=_noise(craft, ("attitude.x", "attitude.y", "attitude.z")),
    )


def _noise(craft: Craft, names: tuple[str, ...]) -> str:
    sigma = craft.noise(names)
    return "" if sigma is None else f' noise="{float(np.sqrt(np.mean(sigma**2)))!r}"'


def _callback(craft: Craft) -> str:
    slope, offset, largest = tangent(craft)
    up, down = (max(v, SHORTEST_LAG) for v in craft.lags)
    return _CALLBACK.format(
        numbers=NUMBERS,
        name=craft.name,
        count=craft.count,
        com=craft.center_of_mass.tolist(),
        up=up,
        down=down,
        slope=slope,
        offset=offset,
        largest=largest,
        arms=craft.arms.tolist(),
        ratio=yaw_ratio(craft).tolist(),
        wrench=python_source(wrench_function(craft), "_wrench", ARGUMENTS),
    )


def _text(values: FloatArray | tuple[float, ...] | list[float]) -> str:
    return " ".join(repr(float(v)) for v in values)
