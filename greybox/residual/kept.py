"""What `learn` found so far, in the journal of the command around it (`greybox.journal`): Gaussian
processes by marginal likelihood, one by one, and weights by errors ahead. Posteriors are kept as in
a model file, which keeps every bit of them.

Fits of the physics and of noise levels are kept where they are solved (`greybox.estimation.solved`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields

from greybox.files import Json, Parsed
from greybox.journal import answers
from greybox.residual.open_loop_fit import OpenLoopFit
from greybox.residual.posterior import GPPosterior
from greybox.residual.training_report import TrainedGP, TrainingDocument
from greybox.residual.weight_space import read_part, written

Found = tuple[OpenLoopFit, str, Mapping[str, float]]
"""As `fit_open_loop` returns it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Trained:
    """A process and how it was trained, as plain values."""

    posterior: dict[str, Json]
    report: TrainingDocument


@dataclass(frozen=True, kw_only=True, eq=False)
class _Fitted:
    """A fit by errors ahead: its posterior as plain values, `rest` are its other fields by name."""

    posterior: dict[str, Json]
    rest: Parsed
    chosen: str
    gains: dict[str, float]


def trained_once(
    labels: Sequence[str], train: Callable[[str], TrainedGP]
) -> list[tuple[GPPosterior, TrainingDocument]]:
    """What `train` makes of every label: (posterior, how it was trained)."""
    fresh: dict[int, tuple[GPPosterior, TrainingDocument]] = {}

    def work(places: Sequence[int]) -> Iterable[tuple[int, _Trained]]:
        for place in places:
            found = train(labels[place])
            fresh[place] = found.posterior, found.report.to_dict()
            yield place, _Trained(posterior=fresh[place][0].to_dict(), report=fresh[place][1])

    kept = answers(labels, work, _Trained, (_Trained,))
    return [
        fresh[k] if k in fresh else (GPPosterior.from_dict(t.posterior), t.report)
        for k, t in enumerate(kept)
    ]


def fitted_once(fit: Callable[[], Found]) -> Found:
    """What `fit` finds."""
    fresh: list[Found] = []

    def work(_: Sequence[int]) -> Iterable[tuple[int, _Fitted]]:
        found, chosen, gains = fit()
        fresh.append((found, chosen, gains))
        values = {f.name: getattr(found, f.name) for f in fields(found)}
        told = written(values.pop("posterior"))
        yield 0, _Fitted(posterior=told, rest=values, chosen=chosen, gains=dict(gains))

    (kept,) = answers(["errors ahead"], work, _Fitted, (_Fitted,))
    if fresh:
        return fresh[0]
    return OpenLoopFit(posterior=read_part(kept.posterior), **kept.rest), kept.chosen, kept.gains
