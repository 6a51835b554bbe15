"""Physics refitted with the weights of the learned part as unknowns beside it.

A fit that knows of no push lets its parameters explain what they can of it; what is learned then
explains what they left, and both stay wrong together. Here they are unknowns of one prediction
error fit: the parameters under the priors of their declaration, the whitened weights under
N(0, 1/lambda), lambda the strength that left-out flights chose. What both could explain is the
physics', for it costs the weights; that the weights might take it over is in the standard errors
(Kennedy and O'Hagan 2001, J. R. Statist. Soc. B 63(3)). The weights are wanted for this alone: they
are fitted again by errors ahead, and the left-out ones of these decide whether the physics moves.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from greybox.data import Dataset
from greybox.estimation.fit import Fit, fit, noise_of
from greybox.estimation.solvers.levenberg_marquardt import ARRIVED, LevenbergMarquardt
from greybox.model.identified import IdentifiedModel
from greybox.model.parameter import ParameterValues
from greybox.residual.features import features
from greybox.residual.open_loop_fit import OpenLoopFit, Progress, WeightedHybrid
from greybox.residual.strengths import harmless, worth
from greybox.residual.weight_space import Candidate, factors, members_of, weighted
from greybox.symbolic import Expr


@dataclass(frozen=True, kw_only=True, eq=False)
class WhitenedHybrid(WeightedHybrid):
    """A hybrid whose whitened weights are parameters: one prior suits all of an output."""

    def _weighted(self, x: Expr, window: Expr, p: Expr) -> Expr:
        z = features(self.inner, self.posterior.inputs.names, x, window)
        theta, m = p[len(self.inner.parameters) :], self.posterior.points
        plain = [
            ca.DM(np.linalg.inv(f).T) @ theta[j * m : (j + 1) * m]
            for j, f in enumerate(factors(self.posterior))
        ]
        return weighted(self.posterior, z, ca.vertcat(*plain) if plain else theta)


def refit_beside(
    model: IdentifiedModel,
    candidate: Candidate,
    strengths: Mapping[str, float],
    train: Dataset,
    say: Progress,
) -> IdentifiedModel | None:
    """`model` (with disturbance states, without a learned part) with its estimates and process
    noise as found beside the weights of `candidate`, whose priors have these `strengths` by output.

    What has no standard error was given, and stays. None where nothing is left to refit, or where
    the search does not arrive.
    """
    shared, own = model.covariance_names, tuple(model.flight_spread)
    if not shared:
        return None
    text, solver = "the physics beside the learned part", LevenbergMarquardt(tolerance=ARRIVED)
    say(text, 0.0)
    sigma = {
        f"gp.{n}.{i}": (0.0, 1 / np.sqrt(s * members_of(candidate)))
        for n, s in strengths.items()
        for i in range(candidate.points)
        if np.isfinite(s)
    }
    found = fit(
        WhitenedHybrid(inner=model.dynamics, posterior=candidate),
        train,
        initialisation="nominal",
        solver=solver,
        free=(*shared, *own, *sigma),
        fixed=tuple(model.considered),
        considered=tuple(model.considered),
        per_flight=own,
        values=dict(model.values),
        priors=sigma,
        noise=noise_of(model),
        estimate_noise="process",
        progress=lambda k, _cost, _left: say(text, k / solver.max_iterations),
    )
    return _physics(model, found) if found.diagnostics.status.converged else None


def _physics(model: IdentifiedModel, found: Fit) -> IdentifiedModel:
    """`model` with what was found of it.

    What the weights might take over is an error of the numbers, not of predictions: the weights go
    along with it.
    """
    names, whole = found.model.covariance_names, found.model.covariance
    at = np.array([n in model.values for n in names])
    across = whole[np.ix_(at, ~at)]
    shared = across @ np.linalg.solve(whole[np.ix_(~at, ~at)], across.T)
    own = [n for n, mine in zip(names, at, strict=True) if mine]
    moved = {
        n: (s, {k: v for k, v in by.items() if k in model.values})
        for n, (s, by) in found.model.considered.items()
    }
    return replace(
        model,
        values=ParameterValues({n: found.model.values[n] for n in model.values}),
        covariance_names=tuple(own),
        covariance=whole[np.ix_(at, at)] - shared,
        form_covariance=model.form_among(own) + shared,
        considered=moved,
        per_flight=found.model.per_flight,
        flight_spread=found.model.flight_spread,
        process_noise=found.model.process_noise,
        weak=found.model.weak,
        reference_state=found.model.reference_state,
    )


def better(after: OpenLoopFit, before: OpenLoopFit) -> bool:
    """Whether the errors ahead of left-out flights are lower by more than chance and a trace, and
    those of no channel group higher. Both fits weigh errors alike."""
    if not after.unseen:
        return False
    cost = np.array(list(before.unseen.values()))
    saved = cost - np.array([after.unseen[f] for f in before.unseen])
    return harmless(saved, cost.sum(axis=0)) and worth(saved, cost)
