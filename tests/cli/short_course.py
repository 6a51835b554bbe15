"""A course of two seconds beside one wall, which asks for 2 cm more than the wall allows."""

from mpc_export.mission import Course, Leg, Plane

SHORT = Course(
    start=(0.0, 0.0, 1.0, 0.0),
    wait=0.2,
    legs=(Leg(to=(0.3, 0.0, 1.0, 0.0), time=1.2, hold=0.2),),
    planes=(Plane(name="wall", normal=(1.0, 0.0, 0.0), offset=0.28, where={}),),
    tilt_max=0.8,
    command_min=0.02,
    command_max=0.98,
    lost=1.0,
)
NOT_A_COURSE = 3


class Nothing:
    """Has none of what a plant needs."""


class Blind:
    """A plant that cannot be placed."""

    def reset(self, seed):
        """Start anew."""

    def step(self, u, dt):
        """Do nothing."""

    def measure(self):
        """See nothing."""
        return {}

    def truth(self):
        """Know nothing."""
        return {"states": {}}
