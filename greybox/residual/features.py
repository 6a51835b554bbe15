"""Features: the model signals that a Gaussian process may look at, by name, as CasADi expressions
of state and command.

| name | meaning | unit |
|---|---|---|
| body_velocity.x/y/z | velocity of the centre of mass in body axes | m/s |
| gravity.x/y/z | direction of gravity in body axes, R' (0, 0, -1) | - |
| heading.x/y | horizontal direction of the x axis of the body, in the world | - |
| phi, theta, psi | ZYX Euler angles (the layout of Ghoul et al. 2026) | rad |
| p, q, r | body rates | rad/s |
| nu1 .. nun | normalised rotor speeds, where the model has rotor states | - |
| height | position z, world | m |
| any input column | u1 .. un, vbat: the command of the sample | as declared |
| any state | by its own name | as declared |
| u1[t-3] | an input column three samples ago | as declared |
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import casadi as ca

from greybox.errors import ModelError, UnknownNameError
from greybox.frames import euler_zyx, rotation_matrix
from greybox.model.dynamics import Dynamics
from greybox.model.noise import noise_states
from greybox.symbolic import Expr, Layout, Signal

_LAGGED = re.compile(r"(.+)\[t(?:-([1-9][0-9]*))?\]")


def lag_of(name: str) -> tuple[str, int]:
    """("u1", 3) of "u1[t-3]", ("u1", 0) of "u1" and "u1[t]"."""
    found = _LAGGED.fullmatch(name)
    return (found[1], int(found[2] or 0)) if found else (name, 0)


def reach(names: Sequence[str]) -> int:
    """How many samples back the features look at commands."""
    return max((lag_of(n)[1] for n in names), default=0)


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
        out |= {f"gravity.{a}": "-" for a in "xyz"} | {f"heading.{a}": "-" for a in "xy"}
        out |= dict.fromkeys(("phi", "theta", "psi"), "rad")
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
    """What forces and torques of a multirotor depend on: body velocity, rates, rotor speeds
    (commands, where there is no rotor state); of any other model the states and inputs."""
    there = available(dynamics)
    if "p" not in there or "rate" not in _blocks(dynamics):
        noise = noise_states(dynamics)
        return (*(n for n in dynamics.states.names if n not in noise), *dynamics.inputs.names)
    rotors = [n for n in there if n[:2] == "nu"] or [
        n for n in dynamics.inputs.names if n != "vbat"
    ]
    return (*(n for n in there if n.split(".")[0] == "body_velocity"), "p", "q", "r", *rotors)


def with_lags(dynamics: Dynamics, names: Sequence[str], lags: int) -> tuple[str, ...]:
    """The features `names`, then the commands of this sample and of `lags` samples before it."""
    commands = [n for n in dynamics.inputs.names if n != "vbat"]
    past = (f"{n}[t-{lag}]" for lag in range(1, lags + 1) for n in commands)
    return tuple(dict.fromkeys((*names, *commands, *past)))


def feature_layout(dynamics: Dynamics, names: Sequence[str]) -> Layout:
    """Names with units. Raises `UnknownNameError` for a feature that the model does not offer."""
    there = available(dynamics)
    units = dict(there) | {n: there[lag_of(n)[0]] for n in names if lag_of(n)[0] in dynamics.inputs}
    for n in names:
        if n not in units:
            raise UnknownNameError("feature", n, there)
    return Layout([Signal(name=n, unit=units[n]) for n in names])


def features(dynamics: Dynamics, names: Sequence[str], x: Expr, window: Expr) -> Expr:
    """The features `names` (m,) at state x (n_x) and command window (n_u x (past + 1 + future)),
    whose past may be longer than that of the model. Raises `UnknownNameError`, `ModelError` where a
    feature looks further back than that."""
    feature_layout(dynamics, names)
    blocks = _blocks(dynamics)
    table: dict[str, Expr] = {n: x[i] for i, n in enumerate(dynamics.states.names)}
    now, place = (
        window.shape[1] - 1 - dynamics.window[1],
        {n: i for i, n in enumerate(dynamics.inputs.names)},
    )
    table |= {n: window[i, now] for n, i in place.items()}
    lagged = {n: lag_of(n) for n in names if n not in table and lag_of(n)[0] in place}
    if (far := reach(tuple(lagged))) > now:
        raise ModelError(
            "features look further back than the command window",
            expected=f"{far} earlier samples",
            got=f"{now}",
        )
    table |= {n: window[place[of], now - lag] for n, (of, lag) in lagged.items()}
    if "attitude" in blocks:
        rotation = rotation_matrix(x[blocks["attitude"]])
        angles = euler_zyx(x[blocks["attitude"]])
        table |= {n: angles[i] for i, n in enumerate(("phi", "theta", "psi"))}
        table |= {f"gravity.{a}": -rotation[2, i] for i, a in enumerate("xyz")}
        table |= {f"heading.{a}": rotation[i, 0] for i, a in enumerate("xy")}
        if "velocity" in blocks:
            v = rotation.T @ x[blocks["velocity"]]
            table |= {f"body_velocity.{a}": v[i] for i, a in enumerate("xyz")}
    if "rate" in blocks:
        table |= {a: x[blocks["rate"][i]] for i, a in enumerate("pqr")}
    if "position" in blocks:
        table["height"] = x[blocks["position"][2]]
    table |= {f"nu{i + 1}": x[at] for i, at in enumerate(blocks.get("rotor", ()))}
    return ca.vertcat(*(table[n] for n in names))


def feature_function(dynamics: Dynamics, names: Sequence[str]) -> ca.Function:
    """CasADi function (x, command window) -> features, for many samples."""
    past, future = dynamics.window
    x = ca.SX.sym("x", len(dynamics.states))
    window = ca.SX.sym("U", len(dynamics.inputs), past + 1 + future)
    return ca.Function("z", [x, window], [ca.densify(features(dynamics, names, x, window))])
