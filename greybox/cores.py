"""How many processor cores this process may use: those of its affinity (taskset, cpusets of batch
systems), not all."""

from __future__ import annotations

import os


def cores() -> int:
    """At least one; where the system tells no affinity, all cores of the machine."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity is not None else os.cpu_count() or 1
