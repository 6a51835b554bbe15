"""Left: what the unnamed force and torque still hold, and whether it can be written down.

An axis of the Gauss-Markov states whose state the flights need next to all names holds something:
how large, how long it lasts and, where terms of a small library (greybox.residual.laws.terms)
explain it on flights that were left out, the law: an effect file, in the race as any other cause.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from greybox.discovery.evidence import Fitted, Flights
from greybox.discovery.rules import RULES
from greybox.errors import FitError, GreyboxError
from greybox.estimation.fit import Fit
from greybox.estimation.state_taken_away import lost_without
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import physics_of
from greybox.model.noise import disturbances
from greybox.residual.discrepancy import discrepancy
from greybox.residual.laws.axis import Axis
from greybox.residual.laws.effect_file import Law, file_name, proposal_text, proposed, with_laws
from greybox.residual.laws.found import AxisLaw, is_law, laws_of
from greybox.residual.laws.responses import library
from greybox.residual.laws.terms import wanted_features
from greybox.residual.laws.without_memory import without_memory


@dataclass(frozen=True, kw_only=True, eq=False)
class Left:
    """All axes, and the structure with the laws that won; `taken`: names that no law may have;
    `doubts`: why laws that were found are not written."""

    axes: tuple[Axis, ...]
    written: Fitted | None = None
    taken: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()
    law_file: Callable[[Law, int, Collection[str]], str] = proposal_text

    def lawful(self, settled: Fit) -> IdentifiedModel:
        """The model of `written`, once `settled`; a vehicle's reads laws from files beside it."""
        if physics_of(settled.model.dynamics) is None:
            return settled.model
        return with_laws(settled.model, proposed(self.laws, self.taken))

    @property
    def files(self) -> dict[str, str]:
        """File name -> text, one for every law."""
        return {file_name(n): self.law_file(x, n, self.taken) for n, x in enumerate(self.laws, 1)}

    @property
    def unnamed(self) -> tuple[Axis, ...]:
        """Axes that clearly hold something."""
        return tuple(a for a in self.axes if a.needed)

    @property
    def laws(self) -> tuple[Axis, ...]:
        """Those with a law, which won."""
        return tuple(a for a in self.unnamed if a.lawful) if self.written is not None else ()


def axis_gains(at: Fitted, bar: float) -> dict[str, tuple[float, bool]]:
    """Axis -> (log likelihood lost without its state, whether that is clear and worth anything)."""
    least = -0.5 * np.log1p(-RULES.trace) * sum(r.n for r in at.problem.records)
    return {axis: (lost, lost > max(bar, least)) for axis, lost in lost_without(at).items()}


def left_over(
    flights: Flights,
    at: Fitted,
    settled: Fit,
    bar: float,
    seed: int,
    *,
    holds: Callable[[Fitted], bool] | None = None,
) -> Left:
    """What the discrepancy of the structure `at`, whose whole result is `settled`, holds. `holds`
    says whether a structure with laws foretells flights that judge; without it none are sought."""
    gains = axis_gains(at, bar)
    model, data = settled.model, flights.data
    names = wanted_features(model.dynamics)
    lasts = {d.group: float(model.values[f"{d.name}.T"]) for d in disturbances(model.dynamics)}
    try:
        seen = discrepancy(model, data, names, block=1)  # means would hide what is fast
    except FitError:
        return Left(axes=())
    found: dict[str, AxisLaw] = {}
    wanted = [a for a, (_, needed) in gains.items() if needed]
    if wanted and holds:
        with contextlib.suppress(GreyboxError):
            plain = without_memory(settled, data)
            offered = library(plain, model, data, names, wanted, settled.parameters)
            found = laws_of(offered, sum(f.n for f in data.flights), seed)
    axes = tuple(
        Axis(
            channel=c.name,
            unit=c.unit,
            rms=float(np.sqrt(np.mean(seen.y[:, j] ** 2))),
            gain=gains[c.name][0],
            needed=gains[c.name][1],
            lasts=lasts[c.name.split(".")[0]],
            lawful=is_law(found.get(c.name, AxisLaw()), RULES.law),
            **found.get(c.name, AxisLaw()),
        )
        for j, c in enumerate(seen.outputs)
    )
    lawful = [a for a in axes if a.needed and a.lawful]
    for kind in ("", "torque", "force"):  # all laws, else those of one kind
        some = [a for a in lawful if a.channel.startswith(kind)]
        if holds and some and (not kind or len(some) < len(lawful)):
            kept = tuple(replace(a, lawful=a.lawful and a in some) for a in axes)
            if (raced := _raced(flights, at, kept, some, bar, holds)).written is not None:
                return raced
    return Left(axes=axes)


def _raced(
    flights: Flights,
    at: Fitted,
    axes: tuple[Axis, ...],
    lawful: Sequence[Axis],
    bar: float,
    holds: Callable[[Fitted], bool],
) -> Left:
    """The laws against the structure without them: they stay where evidence says so, and hold."""
    offered, physics = flights.causes, physics_of(flights.causes.model)
    taken = offered.effects if physics is None else tuple(e.name for e in physics.effects)
    try:
        causes = offered.of_laws(lawful, taken)
        flights.causes = offered.with_cause(*causes)
        flights.forget({c.name for c in causes})
        start = dict(at.known)
        for cause, law in zip(causes, lawful, strict=True):
            start |= {(f"{cause.name}.c_{i}", None): c for i, c in enumerate(law.terms.values(), 1)}
        (written,) = flights.contest([(at.structure | {c.name for c in causes}, [start])], at)
        least = at.log_evidence + bar
        written = flights.arrived(written) if written.log_evidence >= least else written
        won = written.log_evidence >= least and holds(written)
    except GreyboxError:
        won = False
    if not won:
        flights.causes = offered
        return Left(axes=axes)
    values = {k[0]: v for k, v in written.known.items()}
    by_axis = {a.channel: a.refitted(c.name, values) for a, c in zip(lawful, causes, strict=True)}
    now = tuple(by_axis.get(a.channel, a) for a in axes)
    return Left(axes=now, written=written, taken=taken, law_file=offered.law_file)
