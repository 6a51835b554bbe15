"""Words: what a search found, for people. It says what `greybox.discovery.result` has."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from greybox.discovery.cause import LEVELS
from greybox.discovery.document import Estimate, LeftRow, WorthRow
from greybox.discovery.evidence import Fitted
from greybox.discovery.name import LOG10, NAMED, Name
from greybox.discovery.own_cause import memory_of
from greybox.estimation.result import Fit
from greybox.model.layer import own_parameters
from greybox.residual.laws.effect_file import WITH_LAWS
from greybox.shown import Cell
from greybox.statistics.evidence import FELT
from greybox.validation.gap import closing, doubt

if TYPE_CHECKING:
    from greybox.discovery.result import Discovery

SAYS = {
    "bad_data": "the data have faults that block the search",
    "stopped": "the search was stopped before its end: what it had found until then is not judged",
    "named": "missing effects were found and named",
    "ambiguous": "something is missing; these data cannot say which of several effects",
    "unnamed": "something is left that no effect on offer explains",
    "nothing_missing": "nothing is missing at the power of these data",
}
UNLIKE = " (the flights that judge deny it: they are not like the others, as in another wind)"


def first_line(found: Discovery) -> str:
    """What a pilot wants to know, in one line."""
    if found.verdict in ("bad_data", "stopped"):
        more = f"; {found.so_far}" if found.so_far else ""
        return f"{found.verdict.replace('_', ' ').upper()}: {SAYS[found.verdict]}{more}"
    names = [e["name"] for e in found.effects()]
    if len(names) == 1:  # numbers of several stand below
        names = [_in_words(e["name"], e["parameters"]) for e in found.effects()]
    for a in found.ambiguous():
        names.append("one of " + " / ".join(c["name"] for c in a["candidates"]))
    lawful = [u["channel"] for u in found.unnamed() if u["file"]]
    names += [f"laws without a name, of {', '.join(lawful)} (use {WITH_LAWS}, in Python .lawful)"][
        : len(lawful)
    ]
    held = dict.fromkeys(u["channel"].split(".")[0] for u in found.unnamed() if not u["file"])
    doubted = [n for n in found.said("not certified") if n.kept]
    denied = [n for n in doubted if n.certificate.rivals.get((), 0.0) <= -found.bar]
    kept = ", ".join(n.name + UNLIKE * (n in denied) for n in doubted)
    traces = ", ".join(n.name for n in found.said("trace") if n.kept)
    rough = f"{v.sentence}. " if (v := found.model_verdict) and v.refused else doubt(found.gap)
    memory = memory_of(found.fit)
    ends = [f.status for f in (found.fit, found.left and found.left.written) if f]
    rough += "NOT CONVERGED, every number may move: " * any(not s.converged for s in ends)
    rough += f"AGAINST THE FILE: {'; '.join(found.denied)}. " * bool(found.denied)
    rough += "DOUBTFUL, beside an impossible offset of a sensor: " * bool(found.faults)
    rough += "BY ERRORS AHEAD, as likelihood is no judge here: " * found.ahead
    lack = "MISSING" + ", new or from the start" * bool(found.settings.get("since"))
    what = f"{lack}: {'; '.join(names)}" if names else "nothing is missing that has a name"
    what += f"; in the model, not certified: {kept}" * bool(kept)
    what += f"; in the model, a trace alone: {traces}" * bool(traces)
    if held:
        return f"{rough}{what}; without a name: {', '.join(held)}"
    if names or kept or traces:
        return f"{rough}{what}; {memory or 'nothing clear is left'}"
    least = found.minimum_detectable
    seen = ", ".join(f"{n} {next(iter(least[n].values())):.2g}" for n in list(least)[:3])
    size = f" (would have been named from {seen} on at the latest, ...)" * bool(seen)
    return f"{rough}{f'nothing has a name, but {memory}' if memory else 'NOTHING MISSING'}{size}"


def in_words(found: Discovery) -> str:
    """The verdict in words, most important first."""
    lines = [found.line, *(f"  fault: {f}" for f in found.faults)]
    if found.fit is None:
        return "\n".join([*lines, *(f"warning: {w}" for w in found.warnings)])
    for e in found.effects():
        told = f"{e['status']}, log10 e {e['log10_e']:.1f}{_worth(e['worth'])}"
        lines.append(f"  {_in_words(e['name'], e['parameters'])}: {told}")
        odds = "    rather than {name}: log10 odds {log10_odds:.1f}, log10 e {log10_e:.1f}"
        lines += [odds.format(**u) for u in e["unlikely"]]
        laws = {} if found.lawful is None else found.lawful.values
        its = [(n, f"{e['name']}.{n}") for n in e["parameters"]]
        said = ", ".join(f"{n} = {laws[k]:.4g}" for n, k in its if k in laws)
        lines += [f"    with the laws: {said}"] if said else []
    for a in found.ambiguous():
        own = _in_words(a["candidates"][0]["name"], a["parameters"])
        rows = [own, *(c["name"] for c in a["candidates"][1:])]
        shares = (f", {c['weight']:.0%}" for c in a["candidates"])
        lines.append("  one of " + " / ".join(map("".join, zip(rows, shares, strict=True))))
        for c in a["candidates"]:
            moved = ", ".join(f"{k} = {v:.4g}" for k, v in c.get("elsewhere", {}).items())
            lines += [f"    with {c['name']}: {moved}"] * bool(moved)
        if fly := a["separating_manoeuvre"]:
            size = f", {fly['amplitude']:g} {fly['unit']}" if fly["unit"] else ""
            apart = f"to tell them apart, {fly['text']}{size}"
            never = "no manoeuvre that was tried tells all of them apart"
            lines.append(f"    {never if fly['seconds_to_bic_10'] is None else apart}")
    lines += [f"  {t['status']}: {t['name']}, {t['reason']}" for t in found.traces()]
    for n in found.said("not certified"):
        own = _in_words(n.name, found.numbers_of(n.name)) if n.kept else n.name
        lines.append(f"  not certified{', in the model' * n.kept}: {own}: {n.reason}")
    if found.base:
        drift = ", noise between attitude and gyro" * bool(found.settings.get("kinematic_noise"))
        base = (_in_words(n, found.numbers_of(n)) if n in LEVELS else n for n in found.base)
        lines.append(f"  in every model: {', '.join(base)}{drift}")
    for kind in dict.fromkeys(s["kind"] for s in found.sensors if s["kind"] != "white"):
        channels = [s["channel"] for s in found.sensors if s["kind"] == kind]
        lines.append(f"  sensors: {kind} in {', '.join(channels)}")
    if held := [f"{u['channel']} {_size(u)}" for u in found.unnamed() if not u["proposal"]]:
        lines.append(f"  without a name: {', '.join(held)}")
    for u in (u for u in found.unnamed() if u["proposal"]):
        law = f"{u['proposal']} ({u['share']:.0%} of it)"
        lines.append(f"  unnamed: {u['channel']}, {_size(u)}: {law}")
    lines += closing(found.gap)
    lines += [f"  cannot be judged: {n} ({why})" for n, why in found.unjudged.items()]
    return "\n".join([*lines, *(f"warning: {w}" for w in found.warnings)])


def _in_words(name: str, parameters: Mapping[str, Estimate]) -> str:
    numbers = ", ".join(
        f"{n} = {v['value']:.4g}" + (f" +- {v['std']:.2g}" if v["std"] else "") + f" {v['unit']}"
        for n, v in parameters.items()
    )
    return f"{name} ({numbers})"


def _worth(w: WorthRow | None) -> str:
    if w is None:
        return ""
    ahead = f"{w['horizon_s']:g} s" if w["horizon_s"] else "one sample"
    return f", removes {w['share']:.0%} of the squared error of {w['group']} {ahead} ahead"


def _size(axis: LeftRow) -> str:
    return f"{axis['rms']:.2g} {axis['unit']} that lasts {axis['lasts_s']:.2g} s"


def with_size(name: Name, fit: Fit) -> Name:
    """A trace with its numbers in `fit`, which the final model has not."""
    if name.status != "trace":
        return name
    sizes = (
        f"{n.split('.', 1)[-1]} = {e.value:.2g} +- {e.std:.2g} {e.unit}".rstrip()
        for n, e in fit.of_effect(name.name).items()
        if np.isfinite(e.std)
    )
    return replace(name, reason=": ".join(part for part in (", ".join(sizes), name.reason) if part))


def stays(name: Name, moved: Sequence[str]) -> Name:
    """A trace that stays in the model, for these numbers would move without it, or errors grow."""
    why = f"without it other numbers move ({', '.join(moved)})"
    why = why if moved else "errors grow without it"
    return replace(name, kept=True, reason=f"{name.reason}; in the model: {why}")


def moved_names(names: Sequence[Name], whole: Fit, bare: Fitted) -> list[str]:
    """Numbers of the craft and of names that are elsewhere in the structure `bare` than in the
    `whole`, beyond their errors."""
    gone = {n.name for n in names if n.status not in NAMED and not n.kept}
    own, known = own_parameters(whole.model.dynamics), bare.known
    return [
        n
        for n, e in whole.parameters.items()
        if n in own and n.split(".")[0] not in gone
        if abs(known.get((n, None), e.value) - e.value) > FELT * e.std
    ]


def so_far(added: Sequence[str], names: Sequence[Name] | None) -> str:
    """What a search knows that stands where causes were `added`, and what it has not done; `names`
    are what was said of them."""
    taken = f"taken up so far, not certified: {', '.join(added) or 'nothing'}"
    rest = "what is left, the gap"
    if names is None:
        return f"{taken}; not done: further steps, certificates, {rest}"
    said = ", ".join(f"{n.name} {n.status}" for n in names) or "no name"
    return f"so far, what laws may still change: {said}; not done: {rest}"


def rows_of(names: Sequence[Name]) -> list[dict[str, Cell]]:
    """One row per cause that was judged, against leaving it out."""
    return [
        {
            "cause": n.name,
            "status": n.status,
            "log10 e": n.certificate.rivals.get((), float("nan")) / LOG10,
            "removes": None if n.worth is None else n.worth.share,
            "of": None if n.worth is None else n.worth.group,
            "horizon [s]": None if n.worth is None else n.worth.horizon,
            "reason": n.reason,
        }
        for n in names
    ]
