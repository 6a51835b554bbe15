"""simulate.py: the whole model, learned part and pushes included, as a module of NumPy or JAX."""

from __future__ import annotations

import casadi as ca
import numpy as np

from greybox.model.dynamics import Dynamics
from greybox.model.layer import Layer, with_physics
from greybox.model.parameter import Parameter
from greybox.residual.drawn_push import DrawnPush
from greybox.residual.hybrid import HybridModel
from greybox.simulators.craft import Craft
from greybox.simulators.python_code import python_source
from greybox.simulators.size import start_state

HEAD = '''"""{title} in {library}: written by greybox twin, needs {needs} only.

{use}
A step lasts DT = {dt:g} s. x (..., {n_x}): STATES, SI units, world ENU, body FLU, quaternion
(w, x, y, z) body to world. u (..., {n_u}): INPUTS. p ({n_p},) or (..., {n_p}): PARAMETERS, one
row per craft for randomised ones. w (..., {n_w}): NOISES, zero for a calm flight, NOISE * standard
normals for one that is pushed about as the real one was. Sensors: OUTPUTS, without
noise. A window holds the last {past} commands, the present one{later}. Commands beyond LOW .. HIGH,
the range in the vehicle file, are taken as these.
"""

{imports}

DT = {dt!r}
PAST, FUTURE = {past}, {future}
STATES = {states}
INPUTS = {inputs}
OUTPUTS = {outputs}
PARAMETERS = {parameters}
VALUES = np.array({values})
NOISES = {noises}
NOISE = np.array({noise})
START = np.array({start})  # level, at rest, rotors at hover speed
HOVER = np.array({hover})  # command that holds it there
LOW, HIGH = np.array({low}, dtype=float), np.array({high}, dtype=float)


'''


def pieces(craft: Craft) -> dict[str, object]:
    """The parts of the text that NumPy and JAX share: values of `HEAD`, and `functions`."""
    dynamics = _whole(craft)
    past, future = dynamics.window
    model = craft.source
    start = np.zeros(len(dynamics.states))
    blocks = {
        "position": np.zeros(3),
        "velocity": np.zeros(3),
        "attitude": np.array([1.0, 0.0, 0.0, 0.0]),
        "rate": np.zeros(3),
    }
    hover = [craft.hover_command] * craft.count
    hover += [craft.nominal_voltage or 1.0] * (len(dynamics.inputs) - craft.count)
    own = start_state(craft, blocks)
    start[: len(own)] = own
    level = dict(zip(model.dynamics.noises.names, model.process_noise.tolist(), strict=True))
    return {
        "title": craft.name,
        "dt": craft.sample_time,
        "past": past,
        "future": future,
        "later": " and the one after it" if future else "",
        "n_x": len(dynamics.states),
        "n_u": len(dynamics.inputs),
        "n_p": len(dynamics.parameters),
        "n_w": len(dynamics.noises),
        "states": repr(dynamics.states.names),
        "inputs": repr(dynamics.inputs.names),
        "outputs": repr(dynamics.outputs.names),
        "parameters": repr(tuple(d.name for d in dynamics.parameters)),
        "values": repr([_value(craft, d) for d in dynamics.parameters]),
        "noises": repr(dynamics.noises.names),
        "noise": repr([level.get(n, 0.0) for n in dynamics.noises.names]),
        "start": repr(start.tolist()),
        "hover": repr(hover),
        "low": _ends(craft, dynamics, 0),
        "high": _ends(craft, dynamics, 1),
        "functions": _functions(dynamics, craft.sample_time),
    }


def _ends(craft: Craft, dynamics: Dynamics, side: int) -> str:
    """Lower (0) or upper (1) ends of the inputs as a list of Python; of a voltage there is none."""
    ends = [repr(float(craft.stated_range[side]))] * craft.count
    ends += [("-np.inf", "np.inf")[side]] * (len(dynamics.inputs) - craft.count)
    return f"[{', '.join(ends)}]"


def _value(craft: Craft, d: Parameter) -> float:
    """Of the craft, of its source (what is no number of a craft), or a learned weight's own."""
    of_source = craft.source.values.get(d.name, d.nominal)
    return float(craft.values.get(d.name, of_source))


def _whole(craft: Craft) -> Dynamics:
    """The craft's physics under the pushes and learned parts of its source, learned weights as
    parameters."""
    dynamics = craft.source.dynamics
    if not isinstance(dynamics, Layer):
        return craft.physics
    whole = with_physics(dynamics, lambda _: craft.physics)
    return DrawnPush(hybrid=whole) if isinstance(whole, HybridModel) else whole


def _functions(dynamics: Dynamics, dt: float) -> str:
    past, future = dynamics.window
    x, p = ca.SX.sym("x", len(dynamics.states)), ca.SX.sym("p", len(dynamics.parameters))
    u = ca.SX.sym("u", len(dynamics.inputs), past + 1 + future)
    w = ca.SX.sym("w", len(dynamics.noises))
    step = ca.densify(dynamics.step(0.0, x, u, p, w, dt))
    output = ca.densify(dynamics.output(0.0, x, u, p, w, dt))
    arguments = ("x", "u", "p", "w")
    return "\n\n".join(
        python_source(
            ca.Function(f"model{name}", [x, u, p, w], [value], {"cse": True}), name, arguments
        )
        for name, value in (("_step", step), ("_output", output))
    )
