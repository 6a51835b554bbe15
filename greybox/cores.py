"""How many processor cores this process may use: those of its affinity (taskset, cpusets of batch
systems), not all."""

from __future__ import annotations

import os

_LIMITS: list[int] = []


def cores() -> int:
    """At least one; where the system tells no affinity, all cores of the machine."""
    affinity = getattr(os, "sched_getaffinity", None)
    there = len(affinity(0)) if affinity is not None else os.cpu_count() or 1
    return min([there, *_LIMITS])


def limit_cores(most: int) -> None:
    """From now on this process uses `most` cores: others beside it use the rest."""
    _LIMITS.append(most)
