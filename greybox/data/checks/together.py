"""What is a flight's fault and what the craft's: one way for every check of several flights.

A flight is judged alone first: its columns, units and frames may be its own. Where the answer is
sure it is said of that flight, which then tells nothing of the others. What is left is judged
together, which shows what no single flight can; a flight that differs from the rest is named.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

One = TypeVar("One")
Said = TypeVar("Said")


@dataclass(frozen=True, kw_only=True)
class Told(Generic[Said]):
    """What is said of `flights`, which were judged together. `others` is the number of flights of
    which nothing is said, alone or together."""

    said: Said
    flights: tuple[str, ...]
    others: int = 0

    @property
    def against(self) -> str:
        """What the other flights say to it, as the end of a message; empty where there are none."""
        return f"; {self.others} other flight(s) do not show it" if self.others else ""


def alone_and_together(
    flights: Mapping[str, One],
    judge: Callable[[Sequence[One]], Said | None],
    *,
    claim: Callable[[Said], Hashable],
    sure: Callable[[Said], bool] = lambda said: True,
) -> list[Told[Said]]:
    """What `judge` (None: nothing is wrong) says of every flight alone, and of those together of
    which nothing `sure` is said alone. Flights that alone say the same `claim` are told it once,
    from all of them."""
    alone = {name: judge([one]) for name, one in flights.items()}
    faulty = {n: s for n, s in alone.items() if s is not None and sure(s)}
    rest = tuple(n for n in flights if n not in faulty)
    of_rest = judge([flights[n] for n in rest]) if len(rest) > 1 else None
    odd = {n: s for n in rest if (s := alone[n]) is not None}
    if of_rest is not None and (sure(of_rest) or not 0 < len(odd) < len(rest)):
        told, others = [Told(said=of_rest, flights=rest)], 0
    else:
        others = len(rest) - len(odd)
        told = [Told(said=s, flights=(n,), others=others) for n, s in odd.items()]
    groups: dict[Hashable, list[str]] = {}
    for name, said in faulty.items():
        groups.setdefault(claim(said), []).append(name)
    for what, names in groups.items():
        of_all = judge([flights[n] for n in names]) if len(names) > 1 else None
        if of_all is not None and claim(of_all) == what:
            told.append(Told(said=of_all, flights=tuple(names), others=others))
        else:
            told += [Told(said=faulty[n], flights=(n,), others=others) for n in names]
    return told
