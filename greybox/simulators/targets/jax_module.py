"""JAX: the whole model as pure functions for jit, vmap, scan and grad."""

from __future__ import annotations

from collections.abc import Mapping

from greybox.simulators.craft import Craft
from greybox.simulators.module_text import HEAD, pieces
from greybox.simulators.targets.numpy_module import whole
from greybox.simulators.words import Word

_USE = """    x, window = START, WINDOW
    x, window = advance(x, window, u)                # one craft, one sample; jit, vmap, grad it
    many = jax.jit(jax.vmap(advance, in_axes=(0, 0, 0, 0)))   # a batch, each with its parameters
    xs = jax.jit(rollout)(START, commands)           # commands (steps, {n_u}) -> (steps, {n_x})

JAX computes in single precision unless jax.config.update("jax_enable_x64", True) comes first.
"""

_TAIL = '''

class _Functions:
    """Mathematics of JAX."""

    abs, minimum, maximum, where, sign = jnp.abs, jnp.minimum, jnp.maximum, jnp.where, jnp.sign
    exp, log, sqrt, sin, cos, tan = jnp.exp, jnp.log, jnp.sqrt, jnp.sin, jnp.cos, jnp.tan
    log1p = jnp.log1p
    arcsin, arccos, arctan, arctan2 = jnp.arcsin, jnp.arccos, jnp.arctan, jnp.arctan2
    tanh, floor, ceil, copysign = jnp.tanh, jnp.floor, jnp.ceil, jnp.copysign

    @staticmethod
    def true(a):
        return jnp.where(a != 0, 1.0, 0.0)


WINDOW = np.broadcast_to(HOVER, (PAST + 1 + FUTURE, len(INPUTS)))
CALM = np.zeros(len(NOISES))


def _commands(window):
    return jnp.ravel(jnp.clip(jnp.asarray(window), LOW, HIGH))


def step(x, window, p=VALUES, w=CALM):
    """x (n_x,) one sample of DT later. window (PAST + 1 + FUTURE, n_u): commands, oldest first."""
    x, p, w = jnp.asarray(x), jnp.asarray(p), jnp.asarray(w)
    return jnp.stack(_step(x, _commands(window), p, w, _Functions))


def output(x, window, p=VALUES, w=CALM):
    """Sensors (n_y,) at x."""
    x, p, w = jnp.asarray(x), jnp.asarray(p), jnp.asarray(w)
    return jnp.stack(_output(x, _commands(window), p, w, _Functions))


def advance(x, window, u, p=VALUES, w=CALM):
    """(x, window) after u (n_u,) was held for DT; where commands run linearly u is the one that
    comes next."""
    window = jnp.concatenate([jnp.asarray(window)[1:], jnp.asarray(u)[None]])
    return step(x, window, p, w), window


def rollout(x, commands, p=VALUES, window=WINDOW):
    """States (steps, n_x) under commands (steps, n_u), without noise."""
    def one(carry, u):
        x, window = advance(*carry, u, p)
        return (x, window), x

    start = (jnp.asarray(x), jnp.asarray(window, dtype=jnp.asarray(x).dtype))
    return jax.lax.scan(one, start, jnp.asarray(commands))[1]
'''


class JaxModule:
    """JAX."""

    name = "jax"
    simulator = "JAX"
    source = "generated from the model's own expressions"

    def words(self, craft: Craft) -> tuple[Word, ...]:
        """Everything."""
        return whole(craft, self.simulator)

    def files(self, craft: Craft) -> Mapping[str, str]:
        """simulate_jax.py."""
        parts = pieces(craft)
        imports = "import jax\nimport jax.numpy as jnp\nimport numpy as np"
        head = HEAD.format(
            **parts, library="JAX", needs="JAX", imports=imports, use=_USE.format(**parts)
        )
        return {"simulate_jax.py": head + str(parts["functions"]) + _TAIL}
