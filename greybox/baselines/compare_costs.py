"""How long the methods of a comparison will take, before they start.

Typical seconds of CPU, measured on the NanoBench flights at 100 Hz. Networks end early or late, and
machines differ: a factor of two either way is usual.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from greybox.progress import about


@dataclass(frozen=True, kw_only=True)
class Typical:
    """Seconds of a method: `start`, `candidate` for every one that is tried, `each` for 1000 rows
    to train on and `judged` for 1000 rows to judge."""

    start: float = 1.0
    candidate: float = 0.0
    each: float = 0.0
    judged: float = 0.0

    def seconds(self, train: int, test: int, budget: int) -> float:
        """With so many rows to train on and to judge, and candidates."""
        rows = self.each * train + self.judged * test
        return self.start + self.candidate * budget + rows / 1000


FIT = Typical(start=77.0, each=4.0)
"""The fit of the nonlinear model, which the first method that needs it waits for."""
ON_PHYSICS = ("nonlinear", "physics")
"""How the names of methods begin that need the nonlinear model."""
TYPICAL: Mapping[str, Typical] = {
    "persistence": Typical(),
    "linear SISO PEM": Typical(start=2.5, each=0.2),
    "linear MIMO PEM": Typical(start=2.5, each=0.3),
    "nonlinear PEM": Typical(),
    "nonlinear PEM + GP": Typical(start=5.0, each=1.1, judged=0.8),
    "linear PEM + GP": Typical(start=10.0, candidate=10.0),
    "nonlinear PEM + output GP": Typical(start=10.0, candidate=10.0, judged=8.6),
    "GP alone": Typical(start=4.0, candidate=4.0, each=0.1, judged=1.9),
    "LSTM": Typical(candidate=18.0),
    "TCN": Typical(candidate=25.0),
    "physics + MLP": Typical(candidate=1.0),
    "physics + LSTM": Typical(candidate=4.0),
}
"""Networks take about as many steps on few flights as on many."""


def expected(
    methods: Sequence[str], *, train: int, test: int, budget: int, fitted: bool
) -> dict[str, float | None]:
    """Seconds of each of `methods` in order, with so many rows to train on and to judge; None where
    nothing is known (more learners). The nonlinear model may be `fitted` already."""
    out: dict[str, float | None] = {}
    for name in methods:
        typical = TYPICAL.get(name)
        found = None if typical is None else typical.seconds(train, test, budget)
        if name.startswith(ON_PHYSICS) and not fitted:
            fitted, found = True, (found or 0.0) + FIT.seconds(train, test, budget)
        out[name] = found
    return out


def expectation(seconds: Mapping[str, float | None]) -> str:
    """The expected `seconds` by method as a line."""
    known = {n: s for n, s in seconds.items() if s is not None}
    parts = [f"{n} {'not known' if s is None else about(s)}" for n, s in seconds.items()]
    whole = about(sum(known.values()))
    return f"CPU that is usual for this: {', '.join(parts)}; in all {whole}"
