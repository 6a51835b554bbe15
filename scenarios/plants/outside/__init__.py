"""Effects that no catalogue has, and relatives of catalogued ones with another law: what must not
get a wrong name."""

from __future__ import annotations

from scenarios.plants.outside.magnet import Magnet
from scenarios.plants.outside.other_forms import (
    ExponentialGround,
    HystereticDamping,
    PowerDrag,
    QuadraticDamping,
    RelaxingDrag,
)
from scenarios.plants.outside.sloshing_mass import SloshingMass
from scenarios.plants.outside.tether import Tether
from scenarios.plants.outside.thrust_gap import ThrustGap
from scenarios.plants.outside.unseen import (
    AirOutlet,
    LooseArm,
    MunkMoment,
    PlateInWake,
    ReturningWake,
)
from scenarios.plants.outside.wall import Wall
from scenarios.plants.outside.warm_motors import WarmMotors

__all__ = [
    "AirOutlet",
    "ExponentialGround",
    "HystereticDamping",
    "LooseArm",
    "Magnet",
    "MunkMoment",
    "PlateInWake",
    "PowerDrag",
    "QuadraticDamping",
    "RelaxingDrag",
    "ReturningWake",
    "SloshingMass",
    "Tether",
    "ThrustGap",
    "Wall",
    "WarmMotors",
]
