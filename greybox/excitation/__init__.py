"""Excitation designs, one file each: signals for mixer inputs and setpoints, and reference
paths."""

from greybox.excitation.chirp import Chirp
from greybox.excitation.circle import Circle
from greybox.excitation.combine import Total, Windowed
from greybox.excitation.doublets import Doublets
from greybox.excitation.figure_eight import FigureEight
from greybox.excitation.hover import Hover
from greybox.excitation.injection import Excitation, rich_excitation
from greybox.excitation.lemniscate import Lemniscate
from greybox.excitation.multichirp import Multichirp
from greybox.excitation.multisine import Multisine
from greybox.excitation.random_steps import RandomSteps
from greybox.excitation.rotor_forces import RotorForces
from greybox.excitation.signal import Signal
from greybox.excitation.three_two_one_one import ThreeTwoOneOne
from greybox.excitation.trajectory import Reference, Trajectory
from greybox.excitation.waypoints import RandomWaypoints

__all__ = [
    "Chirp",
    "Circle",
    "Doublets",
    "Excitation",
    "FigureEight",
    "Hover",
    "Lemniscate",
    "Multichirp",
    "Multisine",
    "RandomSteps",
    "RandomWaypoints",
    "Reference",
    "RotorForces",
    "Signal",
    "ThreeTwoOneOne",
    "Total",
    "Trajectory",
    "Windowed",
    "rich_excitation",
]
