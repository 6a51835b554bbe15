"""The predictor of a model: the one place that asks of which kind a model is."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from greybox.baselines.base_predictor import Base, BasePredictor
from greybox.baselines.decoupled import Terms, combined
from greybox.baselines.filter_predictor import FilterPredictor
from greybox.baselines.linear_predictor import LinearPredictor
from greybox.files import Parsed
from greybox.model.effect import Effect
from greybox.model.identified import IdentifiedModel
from greybox.model.linear import LinearModel

LINEAR_SCHEMAS = ("greybox.linear_model/1", "greybox.linear_models/1")


def as_predictor(
    model: Base | Sequence[LinearModel] | BasePredictor,
    *,
    outputs: Sequence[str] = (),
    channels: Mapping[str, Terms] | None = None,
    adapt: float | None = None,
    train_seconds: float = 0.0,
) -> BasePredictor:
    """A model, or decoupled linear models as one, under its predictor; `channels` are those of
    `LinearPredictor`. Raises `ModelError`, `UnknownNameError`."""
    if isinstance(model, BasePredictor):
        return model
    if isinstance(model, IdentifiedModel):
        return FilterPredictor(
            model=model, outputs=tuple(outputs), adapt=adapt, train_seconds=train_seconds
        )
    several = [model] if isinstance(model, LinearModel) else model
    whole, terms = combined(several, channels or {})
    return LinearPredictor(
        model=whole,
        outputs=tuple(outputs),
        channels=terms,
        adapt=adapt,
        train_seconds=train_seconds,
    )


def from_dict(body: Parsed, *, where: str, effects: Iterable[Effect] = ()) -> BasePredictor:
    """What `BasePredictor.to_dict` wrote; `effects` are those that are not in the catalogue. Raises
    `FileFormatError`, `KeyError` and the like."""
    linear = body["base"]["schema"] in LINEAR_SCHEMAS
    model: Base = (
        LinearModel.from_dict(body["base"], where=where)
        if linear
        else IdentifiedModel.from_dict(body["base"], where=where, effects=effects)
    )
    return as_predictor(
        model,
        outputs=tuple(body["outputs"]),
        channels={
            n: tuple((float(w), c) for w, c in terms) for n, terms in body["channels"].items()
        },
        adapt=body["adapt"],
        train_seconds=float(body["base_seconds"]),
    )
