"""Terms with a memory: what a law may be made of that depends on the past, signals that follow
those of the flight.

A wake that trails the vehicle, a motor that grows warm, a friction that yields, a load that swings:
the force of today is a signal of a while ago. To first order such a signal is d m/dt = (s - m)/T,
to second order it swings, m'' = (s - m)/T^2 - 2 zeta m'/T, with T = 1/(2 pi f). Times stand on a
coarse grid here; the proposal's refit frees them. Velocities, rates, tilt and the rotors'
collective are followed, each about its mean, so that a memory of zero is rest.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.signal

from greybox.model.vehicle import Vehicle
from greybox.residual.laws.terms import Memory, Term, signals
from greybox.symbolic import FloatArray

TIMES = (0.1, 0.3, 1.0, 3.0)
"""Time constants of what follows [s]: neighbours are alike enough for the refit to move to what
lies between."""
FREQUENCIES = (0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0)
"""Of what swings [Hz]."""
DAMPING = 0.15
"""Damping ratio of what swings."""
FOLLOWED = ("velocity", "rate", "tilt", "collective")
SWINGING = ("velocity", "rate", "tilt")


def remembered_terms(
    names: Sequence[str], z: FloatArray, vehicle: Vehicle, parts: Sequence[slice], dt: float
) -> list[Term]:
    """Terms with a memory from the features `names` with values z (N, m), whose `parts` are flown
    one by one at `dt` [s]."""
    out: list[Term] = []
    for s in signals(names, z, vehicle):
        mean = float(f"{s.values.mean():.4g}") if s.kind in ("tilt", "collective") else 0.0
        memories = [Memory(time=t) for t in TIMES if s.kind in FOLLOWED]
        if s.kind in SWINGING:
            memories += [Memory(time=1 / (2 * np.pi * f), damping=DAMPING) for f in FREQUENCIES]
        for memory in memories if np.ptp(s.values) else ():
            values = np.concatenate([follow(s.values[part] - mean, memory, dt) for part in parts])
            code = f"{s.code} - {mean}" if mean else s.code
            out.append(
                Term(
                    text=f"{s.name} ({memory})",
                    code=code,
                    uses=(s.name,),
                    values=values,
                    shape=memory,
                )
            )
    return out


def follow(signal: FloatArray, memory: Memory, dt: float) -> FloatArray:
    """What a memory keeps of a signal (n,) that is held over each `dt` [s], from rest at zero;
    exact."""
    if memory.damping is None:
        system = [1.0], [memory.time, 1.0]
    else:
        system = [1.0], [memory.time**2, 2 * memory.damping * memory.time, 1.0]
    b, a, _ = scipy.signal.cont2discrete(system, dt, method="zoh")
    return np.asarray(scipy.signal.lfilter(np.ravel(b), a, signal))
