"""Features: the model signals that a Gaussian process may look at, by name, as CasADi expressions of state and command.

| name | meaning | unit |
|---|---|---|
| body_velocity.x/y/z | velocity of the centre of mass in body axes | m/s |
| gravity.x/y/z | direction of gravity in body axes, R' (0, 0, -1) | - |
| phi, theta, psi | ZYX Euler angles (the layout of Ghoul et al. 2026) | rad |
| p, q, r | body rates | rad/s |
| nu1 .. nun | normalised rotor speeds, where the model has rotor states | - |
| height | position z, world | m |
| any input column | u1 .. un, vbat: the command of the sample | as declared |
| any state | by its own name | as declared |
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import casadi as ca

from greybox.errors import UnknownNameError
from greybox.frames import euler_zyx, rotation_matrix
from greybox.model.dynamics import Dynamics
from greybox.model.noise import noise_states
from greybox.symbolic import Expr, Layout, Signal


def _blocks(dynamics: Dynamics) -> dict[str, list[int]]:
    """State block ("velocity") -> places of its components in the state vector."""
    noise = noise_states(dynamics)
    out: dict[str, list[int]] = {}
    for i, name in enumerate(dynamics.states.names):
        head = name.rpartition(".")[0]
        if head and name not in noise:
            out.setdefault(head, []).append(i)
    return out


def available(dynamics: Dynamics) -> Mapping[str, str]:
    """Feature name -> unit, for everything that this model can offer."""
    blocks = _blocks(dynamics)
    out: dict[str, str] = {}
    if {"velocity", "attitude"} <= set(blocks):
        out |= {f"body_velocity.{a}": "m/s" for a in "xyz"}
    if "attitude" in blocks:
        out |= {f"gravity.{a}": "-" for a in "xyz"} | dict.fromkeys(("phi", "theta", "psi"), "rad")
    if "rate" in blocks:
        out |= dict.fromkeys("pqr", "rad/s")
    out |= {f"nu{i + 1}": "-" for i in range(len(blocks.get("rotor", ())))}
    if "position" in blocks:
        out["height"] = "m"
    out |= {s.name: s.unit for s in dynamics.inputs}
    noise = noise_states(dynamics)
    out |= {s.name: s.unit for s in dynamics.states if s.name not in noise}
    return out


def default_features(dynamics: Dynamics) -> tuple[str, ...]:
    """What forces and torques of a multirotor depend on: body velocity, rates, rotor speeds (commands, where there is no
    rotor state); of any other model the states and inputs."""
    there = available(dynamics)
    if "p" not in there or "rate" not in _blocks(dynamics):
        noise = noise_states(dynamics)
        return (*(n for n in dynamics.states.names if n not in noise), *dynamics.inputs.names)
    rotors = [n for n in there if n[:2] == "nu"] or [n for n in dynamics.inputs.names if n != "vbat"]
    return (*(n for n in there if n.split(".")[0] == "body_velocity"), "p", "q", "r", *rotors)


def feature_layout(dynamics: Dynamics, names: Sequence[str]) -> Layout:
    """Names with units. Raises `UnknownNameError` for a feature that the model does not offer."""
    there = available(dynamics)
    for n in names:
        if n not in there:
            raise UnknownNameError("feature", n, there)
    return Layout([Signal(name=n, unit=there[n]) for n in names])


def features(dynamics: Dynamics, names: Sequence[str], x: Expr, window: Expr) -> Expr:
    """The features `names` (m,) at state x (n_x) and command window (n_u x (past + 1 + future))."""
    feature_layout(dynamics, names)
    blocks = _blocks(dynamics)
    table: dict[str, Expr] = {n: x[i] for i, n in enumerate(dynamics.states.names)}
    u = window[:, dynamics.window[0]]
    table |= {n: u[i] for i, n in enumerate(dynamics.inputs.names)}
    if "attitude" in blocks:
        rotation = rotation_matrix(x[blocks["attitude"]])
        angles = euler_zyx(x[blocks["attitude"]])
        table |= {n: angles[i] for i, n in enumerate(("phi", "theta", "psi"))}
        table |= {f"gravity.{a}": -rotation[2, i] for i, a in enumerate("xyz")}
        if "velocity" in blocks:
            v = rotation.T @ x[blocks["velocity"]]
            table |= {f"body_velocity.{a}": v[i] for i, a in enumerate("xyz")}
    if "rate" in blocks:
        table |= {a: x[blocks["rate"][i]] for i, a in enumerate("pqr")}
    if "position" in blocks:
        table["height"] = x[blocks["position"][2]]
    table |= {f"nu{i + 1}": x[at] for i, at in enumerate(blocks.get("rotor", ()))}
    return ca.vertcat(*(table[n] for n in names))
