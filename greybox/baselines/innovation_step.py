"""One step of a predictor in innovation form as CasADi functions, with what a learned part adds.

A learned mean g(z) of e(t) moves the state as a measured e would. The slopes along the path are
taken about the state that follows.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from greybox.baselines.predictor_features import column_of, error_of, uses_errors
from greybox.residual import features as model_features
from greybox.residual.weight_space import Candidate
from greybox.symbolic import Expr, FloatArray, IntArray

if TYPE_CHECKING:
    from greybox.baselines.base_predictor import BasePredictor


class InnovationSteps:
    """The functions of `base`, each built once; all take (x, window, given features, last errors,
    p, shift of the outputs)."""

    def __init__(self, base: BasePredictor) -> None:
        self.base = base
        past, future = base.dynamics.window
        self.width = past + 1 + future
        self._built: dict[object, tuple[ca.Function, Candidate | None]] = {}

    def windows(self, inputs: FloatArray, rows: IntArray) -> FloatArray:
        """Command windows (m, width n_u) that begin at `rows` (m,) of a run's inputs."""
        return inputs[rows[:, None] + np.arange(self.width)].reshape(len(rows), -1)

    def features(self, names: tuple[str, ...]) -> ca.Function:
        """-> z (n_z,)."""
        if names not in self._built:
            self._built[names] = self._features(names), None
        return self._built[names][0]

    def step(self, posterior: Candidate | None) -> ca.Function:
        """-> mean (n_o,), variance and mean of what `posterior` adds, next state, slopes of the
        mean and of the next state (and what was added, where it looks at last errors)."""
        if id(posterior) not in self._built:
            # The posterior is kept with its function, so that its id stays its own.
            self._built[id(posterior)] = self._step(posterior), posterior
        return self._built[id(posterior)][0]

    def _arguments(self, names: Sequence[str]) -> list[Expr]:
        d, n_o = self.base.dynamics, len(self.base.outputs)
        return [
            ca.MX.sym("x", len(d.states)),
            ca.MX.sym("U", len(d.inputs) * self.width),
            ca.MX.sym("given", sum(column_of(n) is not None for n in names)),
            ca.MX.sym("last", n_o),
            ca.MX.sym("p", self.base.n_p),
            ca.MX.sym("shift", n_o),
        ]

    def _predicted(
        self, names: Sequence[str], arguments: Sequence[Expr], error: Expr
    ) -> tuple[Expr, Expr, Expr]:
        """(mean (n_o,), features z, next state) from a state that is moved by `error`; beside the
        model's own it moves the last errors, where features look at them."""
        d = self.base.dynamics
        state, flat, given, last, values, shift = arguments
        n_d = len(d.error_states)
        own = [n for n in names if column_of(n) is None and error_of(n) is None]
        moved = _plus(self.base)(state, error[:n_d])
        columns = ca.reshape(flat, len(d.inputs), self.width)
        mean, told, following = self._plain(own)(moved, columns, values)
        last = last + error[n_d:] if uses_errors(names) else last
        return mean + shift, self._joined(names, told, shift, given, last), following

    def _features(self, names: tuple[str, ...]) -> ca.Function:
        arguments = self._arguments(names)
        count = len(self.base.dynamics.error_states) + len(self.base.outputs) * uses_errors(names)
        _, z, _ = self._predicted(names, arguments, ca.MX(ca.DM.zeros(count)))
        return ca.Function("features", arguments, [ca.densify(z)])

    def _step(self, posterior: Candidate | None) -> ca.Function:
        base, d, n_o = self.base, self.base.dynamics, len(self.base.outputs)
        names = () if posterior is None else tuple(posterior.inputs.names)
        arguments, uses = self._arguments(names), uses_errors(names)
        error = ca.MX.sym("d", len(d.error_states) + n_o * uses)
        reference = ca.MX.sym("reference", len(d.states))
        mean, z, following = self._predicted(names, arguments, error)
        push, spread = ca.MX.zeros(n_o), ca.MX.zeros(n_o)
        if posterior is not None:
            both = posterior.expressions(z, ("mean", "variance"))
            push, spread = both["mean"], both["variance"]
        following = _plus(base)(following, base.gain[0][:, base.rows] @ push)
        mean = mean + push
        away = _minus(base)(following, reference)
        moved_on = ca.vertcat(away, push) if uses else away
        around = ca.Function(
            "around",
            [error, reference, *arguments],
            [mean, spread, push, following, ca.jacobian(mean, error), ca.jacobian(moved_on, error)],
        )
        still, state = ca.DM.zeros(error.numel()), arguments[0]
        at = around(still, state, *arguments)[3]
        out = around(still, at, *arguments)
        return ca.Function("step", arguments, [ca.densify(ca.vertcat(*(ca.vec(v) for v in out)))])

    def _plain(self, own: Sequence[str]) -> ca.Function:
        """(x, window, p) -> outputs, the features `own` that need nothing else, next state."""
        base, d = self.base, self.base.dynamics
        x, p = ca.SX.sym("x", len(d.states)), ca.SX.sym("p", base.n_p)
        numbers = base.numbers(p)
        window = ca.SX.sym("U", len(d.inputs), self.width)
        quiet = ca.DM.zeros(len(d.noises))
        y = d.output(0, x, window, numbers, quiet, base.dt)[[d.outputs[n] for n in base.outputs]]
        table = {n: y[i] for i, n in enumerate(base.outputs)}
        inner = [n for n in own if n in model_features.available(d)]
        found = model_features.features(d, inner, x, window) if inner else ca.SX(0, 1)
        table |= {n: found[i] for i, n in enumerate(inner)}
        after = d.step(0, x, window, numbers, quiet, base.dt)
        seen = ca.vertcat(*(table[n] for n in own)) if own else ca.SX(0, 1)
        return ca.Function("plain", [x, window, p], [y, seen, after])

    def _joined(
        self, names: Sequence[str], told: Expr, shift: Expr, given: Expr, last: Expr
    ) -> Expr:
        """The features z (n_z,) in their order: the last errors, columns of the log `given`, and
        what the model has `told`."""
        outputs = self.base.outputs
        parts, i, j = [], 0, 0
        for n in names:
            of = error_of(n)
            if of is not None:
                parts.append(last[outputs.index(of)])
            elif column_of(n) is not None:
                parts.append(given[j])
                j += 1
            else:
                parts.append(told[i] + shift[outputs.index(n)] if n in outputs else told[i])
                i += 1
        return ca.vertcat(*parts) if parts else ca.MX(0, 1)


def _plus(base: BasePredictor) -> ca.Function:
    """(x, d) -> x boxplus d."""
    d = base.dynamics
    x, step = ca.SX.sym("x", len(d.states)), ca.SX.sym("d", len(d.error_states))
    return ca.Function("plus", [x, step], [d.boxplus(x, step)])


def _minus(base: BasePredictor) -> ca.Function:
    """(x2, x) -> x2 boxminus x."""
    d = base.dynamics
    x, other = ca.SX.sym("x", len(d.states)), ca.SX.sym("x2", len(d.states))
    return ca.Function("minus", [other, x], [d.boxminus(other, x)])
