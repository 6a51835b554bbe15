"""JSBSim: an aircraft of external forces, and a planet that stands still.

JSBSim's own rotor is a helicopter's (blade elements behind an engine and a governor) and its
propeller a table over advance ratio: neither has a small rotor's map. So every rotor is a force and
a moment that are functions of its speed, which follows fcs/nu-cmdN by a lag filter, and drag and
damping are functions of the airspeed and the rates (Berndt 2004, AIAA 2004-4923; FGExternalForce,
FGMassBalance). Lengths of the structural frame: x aft, y right, z up.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from greybox.simulators.command_text import command_text, say_commands
from greybox.simulators.craft import Craft
from greybox.simulators.laws import drag_of, fold_drag
from greybox.simulators.words import THRUST_MAP, TORQUE_MAP, Status, Word, Wording
from greybox.symbolic import FloatArray

POUND, FOOT = 4.4482216152605, 0.3048
"""Force in N and length in m of the units that functions are in."""
SHORTEST_LAG = 1e-4
RADIUS = 6.4e6
"""Of the planet [m]."""

_XML = """<?xml version="1.0"?>
<fdm_config name="{name}" version="2.0" release="ALPHA">
  <!-- Written by greybox twin. fcs/nu-cmd1.. are rotor speeds, 1 is full speed (commands.py makes
       them of commands). Load planet.xml first: gravity is {gravity} m/s^2 there.{wind} -->
  <fileheader><author>greybox</author><description>{name}</description></fileheader>
  <metrics>
    <wingarea unit="M2">1</wingarea><wingspan unit="M">1</wingspan><chord unit="M">1</chord>
    <location name="AERORP" unit="M">{com}</location>
    <location name="EYEPOINT" unit="M">{com}</location>
    <location name="VRP" unit="M">{com}</location>
  </metrics>
  <mass_balance>
    <ixx unit="KG*M2">{xx}</ixx><iyy unit="KG*M2">{yy}</iyy><izz unit="KG*M2">{zz}</izz>
    <ixy unit="KG*M2">{xy}</ixy><ixz unit="KG*M2">{xz}</ixz><iyz unit="KG*M2">{yz}</iyz>
    <emptywt unit="KG">{mass}</emptywt>
    <location name="CG" unit="M">{com}</location>
  </mass_balance>
  <ground_reactions/>
  <propulsion/>
  <flight_control name="rotors">
    <channel name="rotors">
{filters}
    </channel>
  </flight_control>
  <aerodynamics>
    <axis name="DRAG"/><axis name="SIDE"/><axis name="LIFT"/>
    <axis name="ROLL"/><axis name="PITCH"/><axis name="YAW"/>
  </aerodynamics>
  <external_reactions>
{forces}
  </external_reactions>
</fdm_config>
"""
_PLANET = """<?xml version="1.0"?>
<planet name="still">
  <semimajor_axis unit="M">{radius}</semimajor_axis>
  <semiminor_axis unit="M">{radius}</semiminor_axis>
  <rotation_rate unit="RAD/SEC">0.0</rotation_rate>
  <GM unit="M3/SEC2">{gm}</GM>
  <J2>0.0</J2>
</planet>
"""


class JSBSim:
    """JSBSim 1.3."""

    name = "jsbsim"
    simulator = "JSBSim"
    source = "Berndt 2004, AIAA 2004-4923; JSBSim, models/FGExternalForce, FGMassBalance"

    def words(self, craft: Craft) -> tuple[Word, ...]:
        """Rotors and damping as they are, one linear drag of the body."""
        w = Wording(craft, self.simulator)
        for name in (THRUST_MAP, TORQUE_MAP):
            w.add(Word(effect=name, status=Status.SAID, how="functions of fcs/nuN"))
        say_commands(w)
        w.said("motor_lag", "lag_filter").folded_lag_mean()
        w.said("rotor_asymmetry", "functions of each rotor")
        for name in ("center_of_mass_offset", "products_of_inertia", "payload_mass"):
            w.said(name, "in mass_balance")
        w.said("rotational_damping", "functions of the rates")
        w.said("steady_wind", "atmosphere/wind-*-fps")
        fold_drag(w, "functions of the airspeed", wind=True)
        return w.finish()

    def files(self, craft: Craft) -> Mapping[str, str]:
        """aircraft/NAME/NAME.xml, planet.xml and commands.py."""
        return {
            f"aircraft/{craft.name}/{craft.name}.xml": _aircraft(craft),
            "planet.xml": _PLANET.format(radius=RADIUS, gm=repr(craft.gravity * RADIUS**2)),
            "commands.py": command_text(craft),
        }


def _aircraft(craft: Craft) -> str:
    tau = max(craft.get("motor_lag.tau"), SHORTEST_LAG)
    j, forces, filters = craft.inertia, [], []
    for i in range(1, craft.count + 1):
        filters.append(
            "      <lag_filter "
            f'name="fcs/nu{i}"><input>fcs/nu-cmd{i}</input><c1>{1.0 / tau!r}</c1></lag_filter>'
        )
        strength, hub = float(craft.strength[i - 1]), craft.hubs[i - 1]
        spin = float(craft.spins[i - 1])
        curve = _polynomial(f"fcs/nu{i}", craft.thrust * strength / POUND)
        turn = _polynomial(f"fcs/nu{i}", craft.torque * strength * spin / (POUND * FOOT))
        forces.append(_reaction("force", f"thrust{i}", curve, hub, (0, 0, -1)))
        forces.append(_reaction("moment", f"torque{i}", turn, None, (0, 0, 1)))
    drag, damping = drag_of(craft), craft.vector("rotational_damping.d_", "pqr")
    for k, (axis, speed, rate) in enumerate(zip("xyz", "uvw", "pqr", strict=True)):
        along = tuple(int(m == k) for m in range(3))
        if drag[k]:
            law = _linear(f"velocities/{speed}-aero-fps", -float(drag[k]) * FOOT / POUND)
            forces.append(_reaction("force", f"drag-{axis}", law, craft.center_of_mass, along))
        if damping[k]:
            law = _linear(f"velocities/{rate}-rad_sec", -float(damping[k]) / (POUND * FOOT))
            forces.append(_reaction("moment", f"damping-{axis}", law, None, along))
    wind = craft.vector("steady_wind.w_") / FOOT  # north is our y
    blows = (
        f"\n       Wind: atmosphere/wind-north-fps {float(wind[1])!r}, wind-east-fps "
        f"{float(wind[0])!r}, wind-down-fps {float(-wind[2])!r}."
    )
    return _XML.format(
        name=craft.name,
        gravity=repr(craft.gravity),
        wind=blows if wind.any() else "",
        com=_place(craft.center_of_mass),
        mass=repr(craft.mass),
        xx=repr(float(j[0, 0])),
        yy=repr(float(j[1, 1])),
        zz=repr(float(j[2, 2])),
        # the signs that FGMassBalance takes by default (negated_crossproduct_inertia)
        xy=repr(float(j[0, 1])),
        xz=repr(float(-j[0, 2])),
        yz=repr(float(-j[1, 2])),
        filters="\n".join(filters),
        forces="\n".join(forces),
    )


def _place(at: FloatArray) -> str:
    x, y, z = (float(v) for v in at)
    return f"<x>{-x!r}</x><y>{-y!r}</y><z>{z!r}</z>"


def _polynomial(variable: str, c: FloatArray) -> str:
    c0, c1, c2 = (float(v) for v in c)
    v = f"<property>{variable}</property>"
    square = f"<product><value>{c2!r}</value>{v}{v}</product>"
    return f"<sum><value>{c0!r}</value><product><value>{c1!r}</value>{v}</product>{square}</sum>"


def _linear(variable: str, gain: float) -> str:
    return f"<product><value>{gain!r}</value><property>{variable}</property></product>"


def _reaction(kind: str, name: str, law: str, at: FloatArray | None, along: Sequence[int]) -> str:
    place = "" if at is None else f'\n      <location unit="M">{_place(np.asarray(at))}</location>'
    x, y, z = along
    return (
        f'    <{kind} name="{name}" frame="BODY">\n      <function>{law}</function>{place}\n'
        f"      <direction><x>{x}</x><y>{y}</y><z>{z}</z></direction>\n    </{kind}>"
    )
