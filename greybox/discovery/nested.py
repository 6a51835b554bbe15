"""Nested: fits of any subset of the candidates on one build, each warm-started from the one before.

A smaller model is the large one with the other effects held at their null; likelihoods are therefore comparable to the
last digit, and nothing is compiled twice.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from greybox.data import Dataset
from greybox.discovery.candidates import Candidates
from greybox.discovery.screen import Score, screen
from greybox.estimation.criteria.gaussian import Gaussian
from greybox.estimation.fit import Fit, fit, noise_of
from greybox.estimation.predictors.innovation import Innovation
from greybox.estimation.problem import make_problem
from greybox.symbolic import FloatArray

BLOCK_SECONDS = 0.5
"""Length of the blocks whose scores the bootstrap multiplies: longer than what innovations are correlated over."""


@dataclass(frozen=True, kw_only=True, eq=False)
class NestedFit:
    """The fit with `effects` free, the others at their null."""

    effects: tuple[str, ...]
    fit: Fit
    parameters: int

    @property
    def loglik(self) -> float:
        """Log likelihood of all training flights."""
        return self.fit.loglik

    @property
    def bic(self) -> float:
        """-2 log L + k ln N over parameters and noise levels, N the number of samples (Schwarz 1978)."""
        return self.fit.bic

    def at_bound(self, effect: str) -> bool:
        """Whether every parameter of the effect ended at its bound (nothing was found there)."""
        own = [e for n, e in self.fit.parameters.items() if n.split(".")[0] == effect]
        return bool(own) and all(e.at_bound for e in own)


@dataclass(frozen=True, kw_only=True, eq=False)
class Nest:
    """Candidates on the training flights. `choices` are further arguments of every fit: `per_flight`, `estimate_noise`."""

    candidates: Candidates
    data: Dataset
    noise: Mapping[str, float] | None = None
    choices: Mapping[str, Any] = field(default_factory=dict)

    def refit(
        self, effects: Iterable[str], start: NestedFit | None = None, first: Mapping[str, float] | None = None
    ) -> NestedFit:
        """Fit with `effects` free, from the estimates of `start` and first estimates (of a score test) for new ones."""
        chosen = tuple(effects)
        free = [*self.candidates.core, *(p for e in chosen for p in self.candidates.parameters[e])]
        values = dict(self.candidates.null)
        declared = {d.name: d for d in self.candidates.model.parameters}
        if start is not None:
            values |= {n: e.value for n, e in start.fit.parameters.items() if n in free}
        for name, value in (first or {}).items():
            if name in free and name in declared:
                low, high = declared[name].lower, declared[name].upper
                values[name] = float(np.clip(value, low, high))
        result = fit(
            self.candidates.model, self.data, free=free, values=values, build=self.candidates.build,
            noise=self.noise if start is None else noise_of(start.fit.model),
            initialisation="noise" if start is None else "nominal", **self.choices,
        )  # fmt: skip
        return NestedFit(effects=chosen, fit=result, parameters=len(free))

    def screen(self, at: NestedFit, *, alpha: float = 0.05, draws: int = 999, seed: int = 0) -> list[Score]:
        """Score tests of every candidate that is not in `at`."""
        names = {n: p for n, p in self.candidates.parameters.items() if n not in at.effects}
        estimates = {n: e.value for n, e in at.fit.parameters.items()}
        problem = make_problem(
            self.candidates.model, self.data, predictor=Innovation(), criterion=Gaussian(), free=self.candidates.build,
            values={**self.candidates.null, **estimates}, noise=noise_of(at.fit.model), build=self.candidates.build,
            **self.choices,
        )  # fmt: skip
        found = {(u.name, u.flight): t for u, t in zip(at.fit.problem.unknowns, at.fit.theta, strict=True)}
        theta: FloatArray = np.array(
            [found.get((u.name, u.flight), self.candidates.null.get(u.name, u.start)) for u in problem.unknowns]
        )
        block = max(1, round(BLOCK_SECONDS / problem.dt))
        return screen(problem, problem.evaluate(theta, scores=block), names, alpha=alpha, draws=draws, seed=seed)

    def lean(self, at: NestedFit) -> Fit:
        """The same estimates on the model that holds only the effects that were named (what is saved and flown)."""
        small = self.candidates.model.without_effect(*(n for n in self.candidates.names if n not in at.effects))
        free = [*self.candidates.core, *(p for e in at.effects for p in self.candidates.parameters[e])]
        there = {d.name for d in small.parameters}
        choices = {**self.choices, "per_flight": [n for n in self.choices.get("per_flight", ()) if n in there]}
        return fit(
            small, self.data, free=free, values={n: e.value for n, e in at.fit.parameters.items()},
            noise=noise_of(at.fit.model), initialisation="nominal", **choices,
        )  # fmt: skip
