"""Excitation designs, one file each: signals for mixer inputs and setpoints, and reference paths."""

from scenarios.excitation.chirp import Chirp
from scenarios.excitation.circle import Circle
from scenarios.excitation.combine import Total, Windowed
from scenarios.excitation.doublets import Doublets
from scenarios.excitation.figure_eight import FigureEight
from scenarios.excitation.hover import Hover
from scenarios.excitation.injection import Excitation, rich_excitation
from scenarios.excitation.lemniscate import Lemniscate
from scenarios.excitation.multichirp import Multichirp
from scenarios.excitation.multisine import Multisine
from scenarios.excitation.random_steps import RandomSteps
from scenarios.excitation.rotor_forces import RotorForces
from scenarios.excitation.signal import Signal
from scenarios.excitation.three_two_one_one import ThreeTwoOneOne
from scenarios.excitation.trajectory import Reference, Trajectory
from scenarios.excitation.waypoints import RandomWaypoints

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
