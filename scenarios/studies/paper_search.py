"""Searches of black boxes: the best of some trainings with settings drawn from a grid, by the error
on validation flights."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from greybox.baselines.lstm import LSTMModel
from greybox.baselines.lstm_train import SPACE as LSTM_SPACE
from greybox.baselines.lstm_train import LSTMSettings, train_lstm
from greybox.baselines.narx import SPACE as NARX_SPACE
from greybox.baselines.narx import NARXModel, fit_narx
from greybox.baselines.regressors import Choice, Data, Point, Space, segments_of
from greybox.errors import DataError

Model = TypeVar("Model", LSTMModel, NARXModel)
Said = dict[str, Choice]


def _best(
    space: Space,
    budget: int,
    seed: int,
    trained: Callable[[int, Point], tuple[Model, float, Said]],
    progress: Callable[[str], None] | None,
) -> Model:
    """The best of `budget` points of a grid, drawn without repetition. `trained` makes of a
    candidate's number and point its model, its error on validation flights and what else is said of
    it. Raises `DataError` for a budget of none, and where no error is finite."""
    if budget < 1:
        raise DataError(f"a search of {budget} candidates", expected="at least 1")
    grid = [dict(zip(space, values)) for values in itertools.product(*space.values())]
    best: Model | None = None
    lowest, seconds, tried = float("inf"), 0.0, list[Said]()
    for number, k in enumerate(np.random.default_rng(seed).permutation(len(grid))[:budget]):
        model, error, said = trained(number, grid[k])
        seconds += model.train_seconds
        tried.append({**grid[k], "validation": error, **said})
        if progress:
            progress(f"candidate {number + 1} of {budget}: {tried[-1]}")
        if error < lowest:
            best, lowest = model, error
    if best is None:
        raise DataError(
            "no candidate of the search predicts the validation data",
            fix="validate on longer segments",
        )
    return replace(best, train_seconds=seconds, report={**best.report, "search": tried})


def search_lstm(
    train: Data,
    validation: Data,
    *,
    outputs: Sequence[str],
    inputs: Sequence[str],
    budget: int = 6,
    newest: int = 1,
    epochs: int = 200,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> LSTMModel:
    """The best of `budget` trainings with settings drawn from `LSTM_SPACE` without repetition, by
    validation error.

    `train_seconds` is that of all of them together; `report["search"]` lists every candidate with
    its error. Raises `DataError` for a budget of none, and data without a complete past.
    """

    def trained(number: int, drawn: Point) -> tuple[LSTMModel, float, Said]:
        point = dict(drawn)
        window = point.pop("window")
        settings = LSTMSettings(n_a=window, n_b=window, newest=newest, epochs=epochs, **point)
        model = train_lstm(
            train,
            validation,
            outputs=outputs,
            inputs=inputs,
            settings=settings,
            seed=seed + number,
            progress=progress,
        )
        return model, model.report["validation"], {"epochs": model.report["epochs"]}

    return _best(LSTM_SPACE, budget, seed, trained, progress)


def search_narx(
    train: Data,
    validation: Data,
    *,
    outputs: Sequence[str],
    inputs: Sequence[str],
    budget: int = 6,
    newest: int = 1,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> NARXModel:
    """The best of `budget` models with settings drawn from `NARX_SPACE` without repetition, by
    validation error.

    The error is the mean over outputs of the squared one-step error in units of the training
    variance, as for the LSTM. `train_seconds` is that of all candidates; `report["search"]` lists
    them. Raises `DataError` for a budget of none.
    """
    spread = np.nanvar(
        np.concatenate([s.matrix(tuple(outputs)) for s in segments_of(train)]), axis=0
    )

    def trained(_: int, drawn: Point) -> tuple[NARXModel, float, Said]:
        point = dict(drawn)
        lags = point.pop("lags")
        model = fit_narx(
            train,
            outputs=outputs,
            inputs=inputs,
            n_a=lags,
            n_b=lags,
            newest=newest,
            seed=seed,
            **point,
        )
        errors = [
            (model.lags.measured(s) - model.one_step(s)[0]) ** 2 for s in segments_of(validation)
        ]
        each = np.nanmean(np.concatenate(errors), axis=0)
        return model, float(np.mean(each / np.where(spread > 0, spread, 1.0))), {}

    return _best(NARX_SPACE, budget, seed, trained, progress)
