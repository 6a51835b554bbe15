"""Which of the models that a chain made comes out: all of them are judged on the same flights."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from greybox.commands.chain.request import SoFar
from greybox.files import read_json
from greybox.model.verdict import Verdict
from greybox.validation.usefulness import LEFT_OUT

MARGIN = 0.02
"""Share by which the errors of a larger model must be smaller before it replaces the smaller one.
Of ours: below it two fits of the same flights differ by the end of their iterations."""


@dataclass(frozen=True, kw_only=True)
class Choice:
    """A model file, what it was judged to be (None: not judged), and why it was chosen. Choices are
    made on pieces of the training flights; test flights, where there are any, only judge."""

    model: Path
    verdict: Verdict | None
    why: str

    @property
    def refused(self) -> bool:
        """Whether nobody should build on it unasked."""
        return self.verdict is not None and self.verdict.refused


def verdict_of(content: Mapping[str, object]) -> Verdict | None:
    """The verdict of a result file, None where nothing was judged. Raises what `from_dict`
    raises."""
    found = content.get("verdict")
    return Verdict.from_dict(found) if isinstance(found, Mapping) else None


def left_out_verdict(content: Mapping[str, object]) -> Verdict | None:
    """The verdict of a fit.json on pieces that were left out, None where there are none."""
    found = content.get("left_out", content.get("verdict"))
    verdict = Verdict.from_dict(found) if isinstance(found, Mapping) else None
    return verdict if verdict is not None and verdict.judged_on == LEFT_OUT else None


def relative_error(verdict: Verdict) -> float:
    """Mean over the groups that move of the error over that of holding the last value; infinite for
    predictions that diverge, 1 where nothing moves."""
    ratios = [g.error / g.last_value for g in verdict.groups if not g.calm and g.last_value > 0]
    return sum(ratios) / len(ratios) if ratios else 1.0


def better(new: Verdict | None, old: Verdict | None) -> bool:
    """Whether `new` replaces `old`, which is the smaller model."""
    if new is None or old is None:
        return old is None and new is not None and not new.refused
    if new.refused != old.refused:
        return old.refused
    return relative_error(new) < (1 - MARGIN) * relative_error(old)


def best_physics(so_far: SoFar) -> Choice | None:
    """The automatic fit, or the one with what discover found where that foretells better."""
    if not so_far.ran("fit"):
        return None
    folder = so_far.folders["fit"]
    content = read_json(folder / "fit.json")
    first = Choice(
        model=folder / "model.json", verdict=verdict_of(content), why="the automatic fit"
    )
    if not so_far.ran("refit"):
        return first
    folder = so_far.folders["refit"]
    again = read_json(folder / "fit.json")
    if not better(left_out_verdict(again), left_out_verdict(content)):
        why = "the automatic fit: what discover names does not make it better"
        return Choice(model=first.model, verdict=first.verdict, why=why)
    return Choice(
        model=folder / "model.json",
        verdict=verdict_of(again),
        why="the fit with the effects that discover names",
    )


def best(so_far: SoFar) -> Choice | None:
    """The hybrid where the flight that it did not learn from shows it to be better, else the
    physics."""
    physics = best_physics(so_far)
    if physics is None or not so_far.ran("learn"):
        return physics
    folder = so_far.folders["learn"]
    content = read_json(folder / "learn.json")
    before, after = (
        verdict_of(content.get("validation", {}).get(k, {})) for k in ("before", "after")
    )
    if content.get("null") is True:
        said = "nothing was worth learning"
    elif len(so_far.request.train) < 2:
        said = "no second flight to choose on; the learned part stays beside it"
    elif not better(after, before):
        said = "the learned part does not make it better"
    else:
        why = f"{physics.why}, with the learned part"
        return Choice(model=folder / "hybrid.json", verdict=after, why=why)
    return replace(physics, why=f"{physics.why}; {said}")
