"""What a discovery.json says, and whether it is right: the file of any version of the search.

A cause is *named* when it stands in `effects` (and its `status` is not trace), *in a set* when it
is one of the `candidates` of an `ambiguous` entry or an alternative of a named one, a *trace* when
it stands in `traces`. Per log:

    right    all that is hidden has its name, nothing else has one
    set      all that is hidden has its name or stands in a set; every set holds something hidden
    part     some of several hidden effects, nothing false
    silent   no name and no set
    extra    all that is hidden, and something that is not
    wrong    something that is not hidden, and not all that is
    refused  bad data
    failed   no result, or one that says it was stopped

Clean flights: right is any answer without a name. Outside the catalogue: right is an unnamed cause
on an axis that the effect acts on, or a name of its family; `elsewhere` an unnamed cause on other
axes only. What is true of the sensors (a pose that is late) may be named and need not be.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

VERDICTS = (
    *("right", "set", "part", "silent", "elsewhere", "extra", "wrong", "refused", "failed"),
)
AHEAD = 0.5
"""Horizon [s] at which the share of the gap that was closed is taken."""


@dataclass(frozen=True, kw_only=True)
class Said:
    """A discovery.json in short.

    effects: name -> parameter -> value, of what is named; errors: the same with standard errors;
    denied: stated numbers that the flights deny; sets: every set as its candidates, a
    candidate as the effects that it joins; evidence: cause (or set, joined by "|") -> log10 of its
    e-value, of all that were put to a test; tests: whether the search has e-values at all; base:
    effects that the search's base model estimates by itself.
    """

    verdict: str
    effects: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    errors: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    denied: Sequence[str] = ()
    status: Mapping[str, str] = field(default_factory=dict)
    sets: Sequence[Sequence[frozenset[str]]] = ()
    traces: Sequence[str] = ()
    unnamed: Sequence[str] = ()
    base: Sequence[str] = ()
    faults: Sequence[str] = ()
    evidence: Mapping[str, float] = field(default_factory=dict)
    tests: bool = False
    closed: float | None = None

    @classmethod
    def read(cls, path: Path) -> Said:
        """The file. Raises OSError and ValueError where it is missing or no result."""
        return cls.of(json.loads(path.read_text(encoding="utf-8")))

    @classmethod
    def of(cls, content: Mapping[str, Any]) -> Said:
        """The content of a file. Raises ValueError for another kind of file."""
        if not str(content.get("schema", "")).startswith("greybox.discovery/"):
            raise ValueError(f"not a discovery.json: schema {content.get('schema')!r}")
        named = [e for e in content["effects"] if e.get("status") != "trace"]
        sets = [[_joined(c["name"]) for c in a["candidates"]] for a in content["ambiguous"]]
        alike = {e["name"]: e.get("alternatives") or () for e in named}
        sure = [e for e in named if not alike[e["name"]]]
        sets += [[_joined(n), *map(_joined, others)] for n, others in alike.items() if others]
        traces = [_name(t) for t in content.get("traces", ())]
        traces += [e["name"] for e in content["effects"] if e.get("status") == "trace"]
        return cls(
            verdict=str(content["verdict"]),
            effects={e["name"]: _numbers(e, "value") for e in sure},
            errors={e["name"]: _numbers(e, "std") for e in sure},
            denied=list(content.get("denied", ())),
            status={e["name"]: str(e.get("status", "named")) for e in named},
            sets=sets,
            traces=traces,
            unnamed=[str(u["channel"]) for u in content.get("unnamed", ())],
            base=[_name(b) for b in content.get("base", ())],
            faults=list(content.get("faults", ())),
            evidence=_evidence(content),
            tests="bar_log10_e" in content or "candidates" in content,
            closed=_closed(content),
        )

    @property
    def named(self) -> set[str]:
        """Names without a doubt."""
        return set(self.effects)

    @property
    def offered(self) -> set[str]:
        """Names in sets."""
        return {n for some in self.sets for candidate in some for n in candidate}

    @property
    def largest(self) -> float | None:
        """log10 of the largest e-value of anything that was put to a test, 0 where nothing was;
        None for a search without e-values."""
        if not self.tests and not self.evidence:
            return None
        return max(self.evidence.values(), default=0.0)


def _numbers(effect: Mapping[str, Any], what: str) -> dict[str, float]:
    return {p: v[what] for p, v in effect["parameters"].items() if v.get(what) is not None}


def _name(entry: Any) -> str:
    return str(entry["name"] if isinstance(entry, Mapping) else entry)


def _joined(name: str) -> frozenset[str]:
    return frozenset(name.split("+"))


def _evidence(content: Mapping[str, Any]) -> dict[str, float]:
    """log10 of the e-values of all causes that the file tells of."""
    found: dict[str, float] = {}
    entries: Iterable[Any] = (
        *content.get("candidates", ()),
        *content["effects"],
        *content.get("traces", ()),
        *content.get("not_certified", ()),
        *content["ambiguous"],
    )
    for entry in entries:
        value = entry.get("log10_e") if isinstance(entry, Mapping) else None
        if value is not None and math.isfinite(value):
            name = entry.get("name") or "|".join(c["name"] for c in entry["candidates"])
            found[name] = max(float(value), found.get(name, -math.inf))
    return found


def _closed(content: Mapping[str, Any]) -> float | None:
    """Share of the gap half a second ahead that what was delivered closed (names, and laws where
    any were written), in the group with the largest gap."""
    gap = content.get("gap", ())
    rows = [r for r in gap if r["horizon_s"] == AHEAD and r["closed"] is not None]
    row = max(rows, key=lambda r: r["before"] / (r["floor"] or r["before"]), default=None)
    if row is None:
        return None
    lawful = row.get("with_proposals") if content.get("model_with_laws") else None
    return float(row["closed"] if lawful is None else lawful)


def judge(said: Said | None, hidden: Sequence[str], true: Sequence[str] = ()) -> str:
    """One of VERDICTS for a log of the catalogue, clean logs (nothing hidden) included.

    true: names that may but need not be said, because the sensors are so.
    """
    if said is None or said.verdict == "stopped":
        return "failed"
    if said.verdict == "bad_data":
        return "refused"
    wanted, allowed = set(hidden), set(hidden) | set(true)
    false = bool(said.named - allowed)
    false = false or any(not any(c & allowed for c in some) for some in said.sets)
    if not wanted:
        return "wrong" if false else "right"
    covered = (said.named | said.offered | set(said.base)) & wanted
    if false:
        return "extra" if covered == wanted else "wrong"
    if covered == wanted:
        return "right" if wanted <= said.named | set(said.base) else "set"
    return "part" if covered else "silent"


def judge_outside(
    said: Said | None, axes: Sequence[str], family: Sequence[str], true: Sequence[str] = ()
) -> str:
    """The same for an effect outside the catalogue that acts on `axes`."""
    if said is None or said.verdict == "stopped":
        return "failed"
    if said.verdict == "bad_data":
        return "refused"
    kin, allowed = set(family), set(family) | set(true)
    if said.named - allowed or any(not any(c & allowed for c in s) for s in said.sets):
        return "wrong"
    if set(said.unnamed) & set(axes) or (said.named | said.offered) & kin:
        return "right"
    return "elsewhere" if said.unnamed else "silent"


def speed_error(said: Said, truth: Mapping[str, float]) -> float | None:
    """Relative error of the named wind's speed; None where wind has no name."""
    found = said.effects.get("steady_wind")
    if found is None:
        return None
    true = math.hypot(*(truth[f"steady_wind.w_{axis}"] for axis in "xyz"))
    return math.hypot(*(found.get(f"w_{axis}", 0.0) for axis in "xyz")) / true - 1.0
