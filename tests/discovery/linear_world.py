"""A linear Gaussian world of known answers: y = X_n b + X_c theta + e, b shared by all structures
with a flat prior, theta of every cause normal about nothing. What discovery computes by Laplace is
exact here."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from greybox.discovery.cause import Cause
from greybox.discovery.certificate import Split
from greybox.discovery.evidence import Fitted, Flights, Structure
from greybox.discovery.propose import Scores
from greybox.discovery.rules import EFFORT
from greybox.estimation.laplace import log_evidence
from greybox.estimation.problem import Problem, Value
from greybox.estimation.start import Key
from greybox.estimation.status import Code, Status
from greybox.estimation.unknown import Unknown

Array = npt.NDArray[np.float64]
SIGMA = 1.0
"""Standard deviation of the prior of every cause."""
NUISANCES = 6


@dataclass(eq=False)
class World:
    """`columns` (n, k) of every cause, `shared` (n, NUISANCES), readings `y` (n,) with unit
    noise."""

    columns: Mapping[str, Array]
    shared: Array
    y: Array
    flat: bool = False
    lower: float = -np.inf
    kept: dict[Structure, Fitted] = field(default_factory=dict)
    effort: Any = EFFORT
    say: Any = print
    asked: list[float] = field(default_factory=list)
    """Of every fit within what it would do."""

    @property
    def causes(self) -> Any:
        """As `Causes`, as far as it is looked at."""
        offered = {n: cause(n, c.shape[1]) for n, c in self.columns.items()}
        return SimpleNamespace(
            offered=offered,
            effects=tuple(offered),
            base=frozenset(),
            with_cause=lambda *_: self.causes,
            prior_of=lambda n: None if n.split(".")[0] not in offered else (0.0, SIGMA),
        )

    @causes.setter
    def causes(self, new: Any) -> None:
        """None joins."""

    def known(self, structure: Structure) -> Fitted | None:
        """A fit that was done."""
        return self.kept.get(structure)

    def contest(
        self, asked: Sequence[tuple[Iterable[str], Sequence[Any]]], than: Fitted
    ) -> list[Fitted]:
        """Every structure at its optimum."""
        return [self.fit(s) for s, _ in asked]

    def fits(
        self, asked: Sequence[tuple[Iterable[str], Sequence[Any]]], within: Sequence[float]
    ) -> list[Fitted]:
        """Every structure at its optimum."""
        return [self.fit(s, t, within=w) for (s, t), w in zip(asked, within, strict=True)]

    def fit(
        self,
        structure: Iterable[str],
        starts: Sequence[Any] = (),
        *,
        within: float = 0.0,
    ) -> Fitted:
        """The optimum in closed form."""
        chosen = frozenset(structure)
        self.asked.append(within)
        if chosen in self.kept:
            return self.kept[chosen]
        x, unknowns = self.shared, [unknown(f"b_{i}", np.inf) for i in range(self.shared.shape[1])]
        for n in sorted(chosen):
            x = np.column_stack([x, self.columns[n]])
            sigma = np.inf if self.flat else SIGMA
            unknowns += [
                unknown(p, sigma, self.lower) for p in parameters(n, self.columns[n].shape[1])
            ]
        prior = np.array([0.0 if np.isinf(u.sigma) else u.sigma**-2 for u in unknowns])
        h = x.T @ x
        theta = np.linalg.lstsq(h + np.diag(prior), x.T @ self.y, rcond=None)[0]
        theta = np.maximum(theta, [u.lower for u in unknowns])

        def evaluate(at: Array) -> Value:
            off = self.y - x @ at
            likelihood = 0.5 * float(off @ off) + 0.5 * len(off) * np.log(2 * np.pi)
            return Value(
                cost=likelihood + 0.5 * float(prior @ at**2),
                likelihood=likelihood,
                gradient=-x.T @ off + prior * at,
                hessian=h + np.diag(prior),
                data_hessian=h,
            )

        value = evaluate(theta)
        problem = cast(
            Problem,
            SimpleNamespace(
                n=len(unknowns),
                unknowns=tuple(unknowns),
                scale=np.ones(len(unknowns)),
                lower=np.array([u.lower for u in unknowns]),
                upper=np.array([u.upper for u in unknowns]),
                index={(u.name, u.flight): i for i, u in enumerate(unknowns)},
                evaluate=evaluate,
            ),
        )
        done = Status(code=Code.CONVERGED, iterations=1, evaluations=1, decrement=0.0)
        self.kept[chosen] = Fitted(
            structure=chosen,
            space=problem,
            set_up=lambda: problem,
            theta=theta,
            value=value,
            status=done,
            log_evidence=log_evidence(problem, theta, value),
        )
        return self.kept[chosen]


def cause(name: str, size: int) -> Cause:
    own = parameters(name, size)
    return Cause(name=name, kind="effect", parameters=own, prior=dict.fromkeys(own, (0.0, SIGMA)))


def parameters(name: str, size: int) -> tuple[str, ...]:
    return tuple(f"{name}.k_{i}" for i in range(size))


def unknown(name: str, sigma: float, lower: float = -np.inf) -> Unknown:
    return Unknown(
        name=name,
        kind="parameter",
        flight=None,
        start=0.0,
        lower=lower,
        upper=np.inf,
        mean=0.0,
        sigma=sigma,
        scale=1.0,
        unit="",
    )


def drawn(seed: int, truth: Mapping[str, Array], samples: int = 60) -> tuple[World, World]:
    """Two worlds of the same law, to teach and to judge: causes a (one parameter), b (nearly a) and
    c (three)."""
    rng = np.random.default_rng(seed)
    worlds = []
    for _ in range(2):
        a = rng.standard_normal((samples, 1))
        columns = {
            "a": a,
            "b": 0.8 * a + 0.6 * rng.standard_normal((samples, 1)),
            "c": rng.standard_normal((samples, 3)),
        }
        shared = rng.standard_normal((samples, NUISANCES))
        y = shared @ np.linspace(-2, 2, NUISANCES) + rng.standard_normal(samples)
        for name, size in truth.items():
            y = y + columns[name] @ np.atleast_1d(size)
        worlds.append(World(columns=columns, shared=shared, y=y))
    return worlds[0], worlds[1]


def joined(one: World, other: World, flat: bool = False) -> World:
    return World(
        columns={n: np.concatenate([c, other.columns[n]]) for n, c in one.columns.items()},
        shared=np.concatenate([one.shared, other.shared]),
        y=np.concatenate([one.y, other.y]),
        flat=flat,
    )


def split(one: World, other: World) -> Split:
    """`one` taught, `other` judges."""
    judge = World(columns=other.columns, shared=other.shared, y=other.y, flat=True)
    first, judging, both = (cast(Flights, w) for w in (one, judge, joined(one, other)))
    return Split(first=first, judge=judging, both=both)


def key(name: str) -> Key:
    return name, None


def scores(world: World, present: Sequence[str] = ()) -> Scores:
    """What `scored` finds, in closed form."""
    at = world.fit(present)
    absent = [n for n in world.columns if n not in present]
    names = [*absent, *present]
    x = np.column_stack([world.columns[n] for n in names])
    out = world.shared @ np.linalg.pinv(world.shared)
    own = np.column_stack([world.shared, *(world.columns[n] for n in sorted(present))])
    left = x - out @ x
    y = world.y - own @ at.theta
    places, k = {}, 0
    for n in names:
        places[n] = tuple(range(k, k + world.columns[n].shape[1]))
        k += world.columns[n].shape[1]
    keys = [key(p) for n in names for p in parameters(n, world.columns[n].shape[1])]
    value = np.array([at.known.get(q, 0.0) for q in keys])
    return Scores(
        at=at,
        keys=tuple(keys),
        score=-left.T @ y + value / SIGMA**2,
        information=left.T @ left,
        sigma=np.full(k, SIGMA),
        null=np.zeros(k),
        value=value,
        lower=np.full(k, -np.inf),
        upper=np.full(k, np.inf),
        places=places,
        absent=tuple(absent),
    )
