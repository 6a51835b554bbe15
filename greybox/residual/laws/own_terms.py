"""Own terms: what a law may be made of that a model of the user's own lacks.

Nothing is known of such a model but its states, inputs and units. Terms are those that mechanics,
circuits and vessels are made of: a signal, its powers, its sign (dry friction) and root (outflow),
sine and cosine of an angle, and products of two signals.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from greybox.model.dynamics import Dynamics
from greybox.model.noise import without_parts
from greybox.residual.laws.terms import Term
from greybox.symbolic import FloatArray

NARROW = 0.1
"""Width of the bend of a sign or a root at zero, over the signal's RMS."""


def own_terms(dynamics: Dynamics, names: Sequence[str], z: FloatArray) -> list[Term]:
    """Terms of the signals `names`, states and inputs, with values z (N, m)."""
    places = _places(dynamics)
    units = {s.name: s.unit for s in (*dynamics.states, *dynamics.inputs)}
    moving = [(n, places[n], z[:, i]) for i, n in enumerate(names) if np.ptp(z[:, i])]
    out: list[Term] = []

    def add(text: str, code: str, uses: tuple[str, ...], values: FloatArray) -> None:
        if np.isfinite(values).all() and np.ptp(values):
            out.append(Term(text=text, code=code, uses=uses, values=np.asarray(values, float)))

    for n, s, v in moving:
        width = float(f"{NARROW * np.sqrt(np.mean(v**2)):.2g}")
        add(n, s, (n,), v)
        add(f"{n} |{n}|", f"{s} * ca.fabs({s})", (n,), v * abs(v))
        add(f"{n}^2", f"{s} ** 2", (n,), v**2)
        add(f"{n}^3", f"{s} ** 3", (n,), v**3)
        add(f"tanh({n} / {width:g})", f"ca.tanh({s} / {width})", (n,), np.tanh(v / width))
        root = f"{s} / ca.sqrt(ca.sqrt({s} ** 2 + {width} ** 2))"
        add(f"root({n})", root, (n,), v / np.sqrt(np.hypot(v, width)))
        if units[n] == "rad":
            add(f"sin({n})", f"ca.sin({s})", (n,), np.sin(v))
            add(f"cos({n})", f"ca.cos({s})", (n,), np.cos(v))
    for (a, sa, va), (b, sb, vb) in itertools.combinations(moving, 2):
        add(f"{a} {b}", f"{sa} * {sb}", (a, b), va * vb)
    return out


def _places(dynamics: Dynamics) -> dict[str, str]:
    """Signal -> how the dynamics of a model read it."""
    core = without_parts(dynamics)
    states = {n: f"x[{i}]" for i, n in enumerate(core.states.names)}
    return {n: f"u[{i}]" for i, n in enumerate(core.inputs.names)} | states
