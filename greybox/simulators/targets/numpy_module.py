"""NumPy: the whole model as one module, for one craft or thousands at once."""

from __future__ import annotations

from collections.abc import Mapping

from greybox.simulators.craft import Craft
from greybox.simulators.module_text import HEAD, pieces
from greybox.simulators.python_code import NUMBERS
from greybox.simulators.words import (
    LEARNED,
    THRUST_MAP,
    TORQUE_MAP,
    Status,
    Word,
    Wording,
)

_USE = """    sim = Simulator(craft=1000)            # a thousand craft at hover; None: a single one
    x = sim.step(u)                        # u (1000, {n_u}), or ({n_u},) for all
    y = sim.measure()
    sim = Simulator(craft=1000, parameters=draws)   # every craft its own parameters
"""

_TAIL = (
    "\n\n"
    + NUMBERS
    + '''

class _Arrays:
    """Mathematics of whole batches."""

    abs, minimum, maximum, where, sign = np.abs, np.minimum, np.maximum, np.where, np.sign
    exp, log, sqrt, sin, cos, tan = np.exp, np.log, np.sqrt, np.sin, np.cos, np.tan
    log1p = np.log1p
    arcsin, arccos, arctan, arctan2 = np.arcsin, np.arccos, np.arctan, np.arctan2
    tanh, floor, ceil, copysign = np.tanh, np.floor, np.ceil, np.copysign

    @staticmethod
    def true(a):
        return np.where(a != 0, 1.0, 0.0)


def _entries(value):
    """Entries of the last axis: plain numbers of a vector, else one array per entry."""
    if value.ndim == 1:
        return value.tolist()
    return list(np.ascontiguousarray(np.moveaxis(value, -1, 0)))


def _call(function, x, window, p, w):
    x, p = np.asarray(x, dtype=float), np.asarray(p, dtype=float)
    window = np.clip(np.asarray(window, dtype=float), LOW, HIGH)
    w = np.zeros(len(NOISES)) if w is None else np.asarray(w, dtype=float)
    flat = window.reshape(*window.shape[:-2], -1)
    batch = np.broadcast_shapes(x.shape[:-1], flat.shape[:-1], p.shape[:-1], w.shape[:-1])
    m = _Arrays if batch else _Numbers
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        found = function(_entries(x), _entries(flat), _entries(p), _entries(w), m)
    out = np.empty((len(found), *batch))
    for k, value in enumerate(found):
        out[k] = value
    return np.moveaxis(out, 0, -1)


def step(x, window, p=VALUES, w=None):
    """x (..., n_x) one sample of DT later. window (..., PAST + 1 + FUTURE, n_u): commands, oldest
    first."""
    return _call(_step, x, window, p, w)


def output(x, window, p=VALUES, w=None):
    """Sensors (..., n_y) at x."""
    return _call(_output, x, window, p, w)


class Simulator:
    """Craft in flight, with the commands that are on their way. `craft`: how many (None: one)."""

    def __init__(self, craft=None, parameters=VALUES, x=START):
        self.batch = () if craft is None else (craft,)
        self.parameters = np.asarray(parameters, dtype=float)
        self.reset(x)

    def reset(self, x=START, which=None):
        """Put the craft at x (n_x,) or (craft, n_x); `which` (mask or indices): only these."""
        if which is None:
            self.x = np.broadcast_to(x, (*self.batch, len(STATES))).copy()
            shape = (*self.batch, PAST + 1 + FUTURE, len(INPUTS))
            self.window = np.broadcast_to(HOVER, shape).copy()
        else:
            self.x[which] = x
            self.window[which] = HOVER

    def step(self, u, w=None, u_next=None):
        """Hold u (n_u,) or (craft, n_u) for DT. Returns x. `u_next` is the command after it, where
        commands run linearly (FUTURE = 1); None: the same."""
        self.window[..., :-1, :] = self.window[..., 1:, :].copy()
        if FUTURE:
            self.window[..., PAST, :] = u
            self.window[..., -1, :] = u if u_next is None else u_next
        else:
            self.window[..., -1, :] = u
        self.x = step(self.x, self.window, self.parameters, w)
        return self.x

    def measure(self, w=None):
        """Sensors (OUTPUTS) under the last command."""
        return output(self.x, self.window, self.parameters, w)
'''
)


def whole(craft: Craft, simulator: str) -> tuple[Word, ...]:
    """Rows of a target that runs the model itself."""
    wording = Wording(craft, simulator)
    for name in (THRUST_MAP, TORQUE_MAP):
        wording.add(Word(effect=name, status=Status.SAID, how="the model itself"))
    for name in craft.effects:
        wording.said(name, "the model itself")
    if craft.pushes:
        wording.add(Word(effect=LEARNED, status=Status.SAID, how="states, and the argument w"))
    return wording.finish()


class NumPyModule:
    """Plain NumPy."""

    name = "numpy"
    simulator = "NumPy"
    source = "generated from the model's own expressions"

    def words(self, craft: Craft) -> tuple[Word, ...]:
        """Everything."""
        return whole(craft, self.simulator)

    def files(self, craft: Craft) -> Mapping[str, str]:
        """simulate.py."""
        parts = pieces(craft)
        use = _USE.format(**parts)
        head = HEAD.format(
            **parts,
            library="NumPy",
            needs="NumPy",
            imports="import math\n\nimport numpy as np",
            use=use,
        )
        return {"simulate.py": head + str(parts["functions"]) + _TAIL}
