"""Planning: which flights to fly so that the parameters become known, within limits, before
anything has flown."""

from greybox.planning.plan import plan
from greybox.planning.result import Plan

__all__ = ["Plan", "plan"]
