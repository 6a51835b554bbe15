"""The craft that controllers fly over courses (mpc_export.mission), with its gusts."""

from scenarios.courses.craft import GUSTS, vehicle

__all__ = ["GUSTS", "vehicle"]
