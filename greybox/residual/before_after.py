"""A model judged before and after something was learned: it has to be no worse than it was."""

from __future__ import annotations

from collections.abc import Callable

from greybox.data import Dataset
from greybox.errors import GreyboxError
from greybox.model.identified import IdentifiedModel
from greybox.model.verdict import Verdict
from greybox.residual.document import HALVES, BeforeAfter, LearnDocument
from greybox.validation.against import against
from greybox.validation.gap import readings
from greybox.validation.options import HorizonChoices
from greybox.validation.result import Validation
from greybox.validation.validate import validate


def judge_both(
    content: LearnDocument,
    models: tuple[IdentifiedModel, IdentifiedModel],
    judged: Dataset,
    *,
    base: str,
    horizons: HorizonChoices | None = None,
    adapt: float | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> Verdict | None:
    """Verdict of the second of `models` (before and after) on the flights `judged`, not usable
    where it is worse than the first, whose file is `base`; None where it cannot be judged.

    `content` gets both validations, the comparison and the verdict, and as warnings what failed.
    """
    validation: BeforeAfter = {}
    content["validation"] = validation
    seen: list[Validation] = []
    for label, model in zip(HALVES, models):
        say(f"validate {label}")
        try:
            seen.append(validate(model, judged, **(horizons or {}), adapt=adapt))
            validation[label] = seen[-1].to_dict()
        except GreyboxError as error:
            content["warnings"].append(f"no validation {label}: {error}")
    verdict = None
    if HALVES[-1] in validation:
        verdict = seen[-1].verdict
        content["warnings"] += seen[-1].too_narrow()
    if verdict is not None and len(seen) == len(HALVES) and seen[0].verdict is not None:
        beside = against(seen[0], seen[1], readings(models[0]))
        document = beside.to_dict(f"the physics alone ({base})")
        content["against_physics"] = document
        if content["null"]:
            document["line"] = f"nothing was learned; {document['line']}"
        else:
            verdict = beside.judged(verdict, base)
    content["verdict"] = None if verdict is None else verdict.to_dict()
    return verdict
