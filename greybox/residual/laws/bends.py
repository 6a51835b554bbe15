"""Bends: what a change of a number that a fit had does to the innovations, and which force and
torque would do the same to the motion.

A law that a number of the model could have brought about is none. Next to the terms of laws stand
therefore the exact sensitivities of the innovations, with what was believed of the numbers: the
step that a fit would take beside a law (Gauss-Newton) is estimated with it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from greybox.errors import FitError
from greybox.estimation.engine import Engine, engine_for
from greybox.estimation.filtering import Filtered
from greybox.estimation.gain import Linearisation
from greybox.estimation.result import Estimate
from greybox.model.dynamics import Dynamics
from greybox.symbolic import FloatArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Bends:
    """The `numbers` of a fit that a model has, and the `engine` that carries their
    sensitivities."""

    engine: Engine
    numbers: tuple[Estimate, ...]

    @staticmethod
    def of(dynamics: Dynamics, fitted: Mapping[str, Estimate]) -> Bends:
        """Those of the `fitted` numbers that `dynamics` has."""
        names = tuple(d.name for d in dynamics.parameters if d.name in fitted)
        return Bends(
            engine=engine_for(dynamics, names), numbers=tuple(fitted[name] for name in names)
        )

    def __len__(self) -> int:
        return len(self.numbers)

    def beliefs(self) -> Iterator[tuple[int, float, float]]:
        """Of every number that had a prior: its place, how far it is above the mean, and the
        standard deviation."""
        for i, e in enumerate(self.numbers):
            if e.prior and 0 < e.prior[1] < np.inf:
                yield i, e.value - e.prior[0], e.prior[1]

    def innovations(
        self, run: Filtered, part: slice, before: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Sensitivities (n, n_e, len) of the innovations in a part of a filtered segment, and those
        (n_d, len) of the state after it; `before` it. The gain stays as it is. Raises `FitError`."""
        samples, around = run.record.samples, self.engine.past + self.engine.future
        seen = self.engine.run(
            x0=run.states[part.start],
            gains=run.gains.tables()[0],
            pattern=run.gains.pattern[part],
            p=run.p,
            s0=before,
            want=frozenset({"sensitivity"}),
            inputs=samples["inputs"][part.start : part.stop + around],
            outputs=samples["outputs"][part],
            mask=samples["mask"][part],
            dt=samples["dt"],
        )
        if seen.sensitivity is None or seen.end_sensitivity is None:
            raise FitError("the engine returned no sensitivities")
        return seen.sensitivity, seen.end_sensitivity

    def wrenches(
        self, run: Filtered, part: slice, lin: Linearisation, places: Sequence[int]
    ) -> FloatArray:
        """What a change of every number adds to the force and torque whose noise channels are
        `places`, (n, len(places), len): what moves the state over one step as it does. Raises
        `FitError`."""
        rows = np.arange(part.start, part.stop)
        ones = np.ones(len(rows), dtype=int)
        still = np.zeros((len(rows), self.engine.nd, len(self)))
        moved = self.engine.windows(
            starts=run.states[rows],
            rows=rows,
            lengths=ones,
            tails=ones,
            p=run.p,
            s0=still,
            **run.record.samples,
        ).end_sensitivity
        if moved is None:
            raise FitError("the engine returned no sensitivities")
        width, record = self.engine.past + self.engine.future + 1, run.record
        out = np.zeros((len(rows), len(places), len(self)))
        for j, k in enumerate(rows):
            window = record.inputs[k : k + width].T
            _, through, _, _ = lin.values(run.states[k], window, run.p, record.dt)
            out[j] = np.linalg.lstsq(through[:, places], moved[j], rcond=None)[0]
        return out
