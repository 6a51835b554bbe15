"""rest.py: what a simulator folds or loses, as a force and a moment that are applied from outside.

Every simulator takes an external wrench. The difference between our model and what the simulator
says of it is generated from the model's own expressions, so that both together fly the model.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from greybox.simulators.craft import Craft
from greybox.simulators.python_code import NUMBERS, python_source
from greybox.simulators.wrench import ARGUMENTS, wrench_function

FELT = 1e-12
"""Force over weight, or moment over weight times a metre, below which nothing is left out."""
_TEXT = '''"""What {simulator} leaves out of {title}: written by greybox twin, needs NumPy only.

    force, moment = rest(attitude, velocity, position, rate, nu)
    world_force, world_moment = in_world(attitude, force, moment)

Apply it at the centre of mass in every step. What was learned of these is in it; effects with a
memory, unexplained pushes, lags and sensors are not.
"""

import math

import numpy as np


{numbers}

{source}

def rest(attitude, velocity, position, rate, nu, nu_rate=None):
    """Force [N] and moment [N m], body axes. attitude (w, x, y, z), body to world; velocity and
    position of the centre of mass, world; rate, body; nu (n,): rotor speeds, 1 is full speed."""
    nu_rate = np.zeros(len(nu)) if nu_rate is None else nu_rate
    given = (attitude, velocity, position, rate, nu, nu_rate)
    found = _rest(*(np.asarray(a, dtype=float).tolist() for a in given), _Numbers)
    return np.array(found[:3]), np.array(found[3:])


def in_world(attitude, force, moment):
    """The same in world axes."""
    w, x, y, z = attitude
    turn = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])
    return turn @ force, turn @ moment
'''


def rest_text(craft: Craft, spoken: Craft, simulator: str) -> str | None:
    """The module for `craft`, of which the simulator flies `spoken`; None where no force and no
    moment is left out."""
    function = _rest_function(craft, spoken)
    if not _is_felt(craft, function):
        return None
    return _TEXT.format(
        simulator=simulator,
        title=craft.title.replace("\\", "/").replace('"""', "'"),
        numbers=NUMBERS,
        source=python_source(function, "_rest", ARGUMENTS),
    )


def _rest_function(craft: Craft, spoken: Craft) -> ca.Function:
    n = craft.count
    given = [ca.SX.sym(a, k) for a, k in zip(ARGUMENTS, (4, 3, 3, 3, n, n), strict=True)]
    whole, said = wrench_function(craft, learned=True)(*given), wrench_function(spoken)(*given)
    w, x, y, z = ca.vertsplit(given[0])
    down = ca.vertcat(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))
    weight = -craft.mass * (craft.gravity - spoken.gravity) * down
    out = ca.densify(whole - said + ca.vertcat(weight, ca.SX.zeros(3)))
    return ca.Function("rest", given, [out], {"cse": True})


def _is_felt(craft: Craft, function: ca.Function) -> bool:
    random = np.random.default_rng(0)
    n, count = craft.count, 64
    q = random.standard_normal((4, count))
    points = [q / np.linalg.norm(q, axis=0), *random.standard_normal((3, 3, count))]
    speeds = craft.hover_nu * (1.0 + 0.1 * random.standard_normal((n, count)))
    found = np.asarray(function(*points, speeds, random.standard_normal((n, count))), dtype=float)
    return bool(np.abs(found).max() > FELT * craft.mass * craft.gravity)
