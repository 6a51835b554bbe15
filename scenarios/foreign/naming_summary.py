"""The tables of the judge of names: shares per set with exact 95 % intervals, and every false name.

Power means that the oracle of `scenarios.foreign.power` can see what is hidden; a log for which it
makes no statement counts as one with power.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from statistics import median
from typing import Any

from scenarios.foreign.campaign import share
from scenarios.foreign.naming_cells import REAL

Row = dict[str, Any]
CERTAIN = math.log10(20.0)
"""log10 of the e-value whose inverse is 0.05."""
NEAR = 0.15
"""Largest relative error of a wind's speed that counts as right."""
NORMAL_95 = 1.96
FALSE = ("wrong", "extra")
SPLITS = ("simulator", "sensors", "gusts", "file")


def kind_of(row: Row) -> str:
    """The set that a row belongs to."""
    return str(row["asked"]).split(":")[0]


def shows(row: Row) -> bool:
    """Whether what is hidden can be seen, as far as the oracle says."""
    return row.get("power") is not False


def _of(rows: Iterable[Row], *kinds: str) -> list[Row]:
    return [r for r in rows if kind_of(r) in kinds]


def _count(rows: Sequence[Row], test: Callable[[Row], bool]) -> str:
    return share(sum(map(test, rows)), len(rows))


def _good(row: Row) -> bool:
    return row["judged"] in ("right", "set")


def _false(row: Row) -> bool:
    return row["judged"] in FALSE


def _ended(row: Row) -> bool:
    return row["judged"] != "failed"


def clean_lines(rows: Sequence[Row]) -> list[str]:
    """False names on clean flights, and the calibration of E."""
    some = [r for r in _of(rows, "clean") if _ended(r)]
    if not some:
        return []
    out = [
        f"clean: a false name {_count(some, _false)}; refused as bad data "
        f"{_count(some, lambda r: r['judged'] == 'refused')}; "
        f"with a trace {_count(some, lambda r: bool(r.get('traces')))}; "
        f"called unnamed {_count(some, lambda r: bool(r.get('unnamed')))}"
    ]
    for key in SPLITS:
        for value in sorted({str(r[key]) for r in some}):
            part = [r for r in some if str(r[key]) == value]
            out.append(f"  {key} {value}: a false name {_count(part, _false)}")
    told = [r for r in some if r.get("log10_e") and false_evidence(r) is not None]
    if told:
        large = _count(told, lambda r: (false_evidence(r) or 0.0) >= CERTAIN)
        out.append(f"calibration: the largest E of what is not there is 20 or more: {large}")
    return out


def false_evidence(row: Row) -> float | None:
    """log10 of the largest e-value of what is not there, in a clean log; None where none was put to
    a test. A pose that is late, and the like, is there where the sensors are real."""
    true = set(REAL) if row["sensors"] == "real" else set()
    told = row["log10_e"].items()
    return max((e for n, e in told if not set(n.split("|")) & true), default=None)


def single_lines(rows: Sequence[Row], kind: str) -> list[str]:
    """One effect: right or in its set where the log shows it."""
    some = _of(rows, kind)
    if not some:
        return []
    seen, unseen = [r for r in some if shows(r)], [r for r in some if not shows(r)]
    sizes = [len(s) for r in seen if _good(r) for s in r["sets"]] + [
        1 for r in seen if r["judged"] == "right"
    ]
    size = f"; median size of a set {median(sizes):g}" if sizes else ""
    out = [
        f"{kind}: right or in its set, with power {_count(seen, _good)}; right "
        f"{_count(seen, lambda r: r['judged'] == 'right')}; wrong {_count(seen, _false)}{size}"
    ]
    if any(stage(r) == TRACE for r in seen if not _good(r)):
        told = _count(seen, lambda r: _good(r) or stage(r) == TRACE)
        out.append(f"  the same with what was said to be there and worth nothing: {told}")
    if missed := [stage(r) for r in seen if not _good(r)]:
        counts = ", ".join(f"{missed.count(s)} {s}" for s in dict.fromkeys(missed))
        out.append(f"  what hides and was missed with power: {counts}")
    if unseen:
        out.append(f"  without power: a false name {_count(unseen, _false)}")
    return out


TRACE = "certain, and worth nothing (a trace)"


def stage(row: Row) -> str:
    """How far what hides came in a log that is not right: an e-value is there of what the search
    took up."""
    hidden = set(row["hidden"])
    if not hidden - {*row.get("traces", ()), *row.get("names", ())}:
        return TRACE
    if row["judged"] in ("refused", "failed"):
        return str(row["judged"])
    if not hidden - {n for name in row.get("log10_e", ()) for n in name.split("|")}:
        return "taken up, its e-value too small"
    return "not taken up"


def several_lines(rows: Sequence[Row]) -> list[str]:
    """Two to five effects: all and nothing else, and recall."""
    some = _of(rows, "pair", "five")
    if not some:
        return []
    seen = [r for r in some if shows(r)]
    out = [f"two to five: all and nothing else, with power {_count(seen, _good)}"]
    hit = told = wanted = 0
    for row in some:
        able = set(row["hidden"]) & able_of(row)
        said = {n for s in row.get("sets", ()) for c in s for n in c.split("+")}
        said |= set(row.get("names", ())) | set(row.get("in_base", ()))
        wanted, hit = wanted + len(able), hit + len(able & said)
        told += len(able & (said | set(row.get("traces", ()))))
    out.append(f"  recall of effects with power {share(hit, wanted)}")
    if told > hit:
        more = share(told, wanted)
        out.append(f"  the same with what was said to be there and worth nothing: {more}")
    return [*out, f"  a false name beside them {_count(some, _false)}"]


def able_of(row: Row) -> set[str]:
    """Effects of a row that its log shows."""
    able: dict[str, bool] = row.get("able") or {}
    return {n for n in row["hidden"] if able.get(n, True)}


def outside_lines(rows: Sequence[Row]) -> list[str]:
    """Effects outside the catalogue."""
    some = _of(rows, "outside")
    if not some:
        return []
    seen = [r for r in some if shows(r)]
    closed = [r["closed"] for r in seen if r.get("closed") is not None]
    gap = f"; gap closed {median(closed):.2f} (median of {len(closed)})" if closed else ""
    right = _count(seen, lambda r: r["judged"] == "right")
    return [f"outside: right axis or kind, with power {right}; wrong {_count(some, _false)}{gap}"]


def wind_lines(rows: Sequence[Row]) -> list[str]:
    """Wind with drag and inflow."""
    some = _of(rows, "wind")
    if not some:
        return []
    errors = [r["speed_error"] for r in some if r.get("speed_error") is not None]
    near = share(sum(abs(e) <= NEAR for e in errors), len(some))
    named = share(len(errors), len(some))
    return [f"wind: named {named}; speed within 15 % {near}; a false name {_count(some, _false)}"]


def number_lines(rows: Sequence[Row]) -> list[str]:
    """Numbers of right names against the truth, and stated numbers that were denied."""
    told = [r for r in rows if "errors" in r]
    pairs: list[tuple[float, float, float]] = []
    for row in told:
        for name, values in row["names"].items():
            for p, value in values.items():
                true, error = row["truth"].get(f"{name}.{p}"), row["errors"][name].get(p)
                pairs += [(value, true, error)] if true and error and error > 0 else []
    if not pairs:
        return []
    inside = sum(abs(value - true) <= NORMAL_95 * error for value, true, error in pairs)
    off = sum(abs(value / true - 1) > NEAR for value, true, _ in pairs)
    denied = share(sum(bool(r["denied"]) for r in told), len(told))
    return [
        f"numbers of right names: 95 % intervals hold {share(inside, len(pairs))}; more than "
        f"{100 * NEAR:.0f} % off {share(off, len(pairs))}; stated numbers are denied in {denied}"
    ]


def power_lines(rows: Sequence[Row]) -> list[str]:
    """Evidence against the number of flights."""
    out = []
    for flights in sorted({r["flights"] for r in _of(rows, "power")}):
        some = [r for r in _of(rows, "power") if r["flights"] == flights]
        told = [true_evidence(r) for r in some if r.get("largest_log10_e") is not None]
        level = f"; log10 E of the true cause {median(told):.1f} (median)" if told else ""
        out.append(f"power, {flights} flights: named {_count(some, _good)}{level}")
    return out


def true_evidence(row: Row) -> float:
    """log10 of the largest e-value of a hidden cause or a set that holds one; 0 where none was put
    to a test."""
    hidden = set(row["hidden"])
    return max((e for n, e in row["log10_e"].items() if set(n.split("|")) & hidden), default=0.0)


def time_lines(rows: Sequence[Row]) -> list[str]:
    """CPU time of a search."""
    out = []
    for kind in ("clean", "single", "pair", "five", "wind", "outside", "imu"):
        spent = sorted(r["seconds"] for r in _of(rows, kind) if _ended(r))
        if spent:
            out.append(
                f"CPU time, {kind}: {median(spent):.0f} s (median), {spent[-1]:.0f} s (longest)"
            )
    lost = [r for r in rows if not _ended(r)]
    return [*out, *([f"no result: {len(lost)} of {len(rows)}"] if lost else [])]


def false_names(rows: Sequence[Row]) -> list[str]:
    """One line per log with a name that is false."""
    out = []
    for row in rows:
        if _false(row):
            said = ", ".join([*row["names"], *("|".join(s) for s in row["sets"])])
            hidden = "+".join(row["hidden"]) or "nothing"
            out.append(
                f"- {row['cell']} {row['seed']} ({row['simulator']}, "
                f"{'gusts' if row['gusts'] else 'still'}, {row['sensors']}, {row['file']}): "
                f"{hidden} hidden, said {said}"
            )
    return ["every false name:", *out] if out else []


def summary(rows: Sequence[Row]) -> str:
    """All tables."""
    rows = sorted(rows, key=lambda r: (r["asked"], r["seed"]))
    lines = [
        *clean_lines(rows),
        *single_lines(rows, "single"),
        *several_lines(rows),
        *outside_lines(rows),
        *single_lines(rows, "imu"),
        *wind_lines(rows),
        *number_lines(rows),
        *power_lines(rows),
        *time_lines(rows),
        *false_names(rows),
    ]
    return "\n".join(lines)
