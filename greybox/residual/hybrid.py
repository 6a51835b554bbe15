"""HybridModel: a Dynamics plus a learned push, x+ = f(x, u, w + g(z(x, u))), g the mean of a
Gaussian process.

The Gaussian process gives the discrepancy of the physics as force [N] and torque [N m] in body axes
and enters where the process noise of the same name enters; it is evaluated at the sample and held
over the step. Its variance does not move the mean; it is offered as `learned_errors` to
everything that propagates uncertainty.

(Ghoul, Bousserhane and Boufeldja 2026, IJCAS 24(8), phase 3, in the form that a controller can use:
x+ = f(x, u) + B_d (g(z) + w); Hewing, Kabzan and Zeilinger 2020, IEEE TCST 28(6), eq. 4.)
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from greybox.errors import ModelError, UnknownNameError
from greybox.files import Json, checksum
from greybox.model.dynamics import Dynamics
from greybox.model.identified import SCHEMA, IdentifiedModel, library_versions
from greybox.model.layer import LearnedErrors, LearnedPush
from greybox.residual.errors_together import errors_at
from greybox.residual.feature_posterior import FeaturePosterior
from greybox.residual.features import feature_function, features, reach
from greybox.residual.posterior import GPPosterior
from greybox.residual.weight_space import called, written
from greybox.symbolic import Expr, FloatArray, evaluate


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class HybridModel(LearnedPush):
    """`inner` with the mean of `posterior` added to the process-noise channels that its outputs are
    named after.

    The posterior's inputs are features by name (`greybox.residual.features`). Everything else is
    `inner`'s: states, parameters, noises, charts. Raises `UnknownNameError` for an output that is
    no noise channel of `inner`, and for a feature that it does not offer; `ModelError` for a unit
    that differs.
    """

    inner: Dynamics
    posterior: GPPosterior | FeaturePosterior

    def __post_init__(self) -> None:
        for signal in self.posterior.outputs:
            if signal.name not in self.inner.noises:
                raise UnknownNameError(
                    "channel of a learned push", signal.name, self.inner.noises.names
                )
            unit = self.inner.noises.signals[self.inner.noises[signal.name]].unit
            if signal.unit != unit:
                raise ModelError(
                    f"learned {signal.name} in another unit", expected=unit, got=signal.unit
                )
        x = ca.SX.sym("x", len(self.inner.states))
        window = ca.SX.sym("u", len(self.inner.inputs), sum(self.window) + 1)
        features(self.inner, self.posterior.inputs.names, x, window)

    @property
    def base(self) -> Dynamics:
        """The model that the push was learned for."""
        return self.inner

    def on(self, base: Dynamics) -> HybridModel:
        """The same push on another model."""
        return replace(self, inner=base)

    @property
    def window(self) -> tuple[int, int]:
        """(past, future) commands that the inner model or its learned part looks at."""
        past, future = self.inner.window
        return max(past, reach(self.posterior.inputs.names)), future

    @property
    def name(self) -> str:
        """Name of the inner model and what was learned."""
        return f"{self.inner.name} + {called(self.posterior)}"

    def file_of(self, model: IdentifiedModel) -> dict[str, Json]:
        """The model file of the inner model and the posterior beside it, with a checksum."""
        body: dict[str, Json] = {
            "schema": SCHEMA,
            "kind": "hybrid",
            "name": model.name,
            "base": replace(model, dynamics=self.inner).to_dict(),
            **written(self.posterior),
        }
        return {**body, "versions": library_versions(), "checksum": checksum(body)}

    @cached_property
    def learned_rows(self) -> tuple[int, ...]:
        """Place of every learned output in the process noise w."""
        return tuple(self.inner.noises[n] for n in self.posterior.outputs.names)

    def learned_inputs(self, x: Expr, window: Expr) -> Expr:
        """z(x, u), the features that the Gaussian process looks at."""
        return features(self.inner, self.posterior.inputs.names, x, window)

    def learned_mean(self, x: Expr, window: Expr) -> Expr:
        """Learned push (n_out), in the units of its noise channels."""
        return self.posterior.mean(self.learned_inputs(x, window))

    def learned_variance(self, x: Expr, window: Expr) -> Expr:
        """Variance of the learned push (n_out) without the noise of its training data; 0 for
        outputs that are off.

        What an output that was not learned leaves is in the disturbance states and the process
        noise.
        """
        on = ca.DM([float(v) for v in self.posterior.active])
        return on * self.posterior.variance(self.learned_inputs(x, window))

    def learned_errors(self, states: FloatArray, windows: FloatArray) -> LearnedErrors:
        """Errors of the learned push at states (m, n_x) with command windows (m, n_u k), of this
        model or of layers on it."""
        look = self._look
        own = [np.ascontiguousarray(states[:, : look.numel_in(0)])]
        own.append(np.ascontiguousarray(windows[:, windows.shape[1] - look.numel_in(1) :]))
        return errors_at(self.posterior, evaluate(look, *own))

    @cached_property
    def _look(self) -> ca.Function:
        return feature_function(self, self.posterior.inputs.names)

    @cached_property
    def _spread(self) -> Expr:
        spread = ca.DM(len(self.inner.noises), len(self.learned_rows))
        for j, i in enumerate(self.learned_rows):
            spread[i, j] = 1.0
        return spread

    def _push(self, x: Expr, window: Expr, w: Expr = None) -> Expr:
        push = self._spread @ self.learned_mean(x, window)
        return push if w is None else w + push

    def _held(self, u: Expr) -> Expr:
        return ca.repmat(u, 1, sum(self.window) + 1)

    def f(self, t: Expr, x: Expr, u: Expr, p: Expr, w: Expr = None) -> Expr:
        """dx/dt under the learned push."""
        return self.inner.f(t, x, u, p, self._push(x, self._held(u), w))

    def h(self, t: Expr, x: Expr, u: Expr, p: Expr, w: Expr = None) -> Expr:
        """Noise-free outputs; the learned force reaches the accelerometer."""
        return self.inner.h(t, x, u, p, self._push(x, self._held(u), w))

    def step(self, t: Expr, x: Expr, window: Expr, p: Expr, w: Expr, dt: Expr) -> Expr:
        """One sample with the learned push held over it."""
        push = self._push(x, window, w)
        return super().step(t, x, window, p, push, dt)

    def output(
        self,
        t: Expr,
        x: Expr,
        window: Expr,
        p: Expr,
        w: Expr,
        dt: Expr,
        lasting: Expr = None,
    ) -> Expr:
        """Outputs see the learned push as they see the process noise of its channel."""
        push = self._push(x, window, w)
        return super().output(t, x, window, p, push, dt, lasting)
