"""Further: more flights multiply the evidence of names that were found before.

New flights D judge the structure S that a search ended with against R without a name, and against
that name's strongest rival: E = p(D | S, what was known) / p(D | R, what was known) / regret, of R
the posterior of S given that the name is nothing: of a linear model what R would have learned. Both
integrate what they share. The product of such e-values is one (Grunwald, de Heide and Koolen 2024).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from threadpoolctl import threadpool_limits

from greybox.data import Dataset
from greybox.data.fingerprint import of_one_flight
from greybox.data.lead import without_lead_in
from greybox.discovery.cause import offer, sensor_cause
from greybox.discovery.certificate import regret
from greybox.discovery.document import DiscoveryDocument, NamedRow, UnnamedRow
from greybox.discovery.evidence import Fitted, Flights
from greybox.discovery.name import LOG10, verdict_of
from greybox.errors import DataError
from greybox.estimation.record import sample_time
from greybox.estimation.start import Key
from greybox.model.effect import Effect
from greybox.model.identified import IdentifiedModel
from greybox.model.known import known_numbers, since
from greybox.model.noise import sensor_parts
from greybox.model.noise_free import with_sensor_noise
from greybox.statistics.betting import bar_of_several
from greybox.validation.validate import verdict_on


@threadpool_limits.wrap(limits=1)
def further(
    content: DiscoveryDocument, model: IdentifiedModel, data: Dataset, own: Iterable[Effect] = ()
) -> DiscoveryDocument:
    """The `content` of discovery.json with the evidence of new flights `data` multiplied to that of
    its names; for them it counts only where `model`, the one beside it, foretells all new flights.
    `own` are effects besides the catalogue.

    Raises `DataError` for flights that took part or no names, `ModelError`, `FitError`.
    """
    _demand_new(content, model, data)
    flights, told = _told(model, data, own)
    told_now = [_log_e(flights, told, effect, model) / LOG10 for effect in content["effects"]]
    if unlike := _unlike(content, model, data):
        told_now = [min(new, 0.0) for new in told_now]
    alone = content.get("alone_log10_e", content["bar_log10_e"])
    totals = [e["log10_e"] + new for e, new in zip(content["effects"], told_now, strict=True)]
    bar = bar_of_several([LOG10 * t for t in totals], LOG10 * alone) / LOG10
    effects: list[NamedRow] = []
    for effect, new, total in zip(content["effects"], told_now, totals, strict=True):
        enough = total >= bar
        status = "certified" if enough else effect["status"]
        if not enough and (status == "certified" or total < 0.0):
            status = "not certified"
        effects.append({**effect, "log10_e": total, "status": status, "further": new})
    kept = [e for e in effects if e["status"] != "not certified"]
    sets = {"one of these"} if content["ambiguous"] else set[str]()
    lost = [_unnamed(e, bar) for e in effects if e["status"] == "not certified"]
    return {
        **content,
        "bar_log10_e": bar,
        "effects": kept,
        "not_certified": [*content["not_certified"], *lost],
        "tested_on": [*content["tested_on"], *data.names],
        "line": unlike + _line(kept, content["line"]),
        "warnings": content["warnings"] + [unlike] * bool(unlike),
        "verdict": verdict_of({e["status"] for e in kept} | sets, bool(content["unnamed"])),
    }


def _demand_new(content: DiscoveryDocument, model: IdentifiedModel, data: Dataset) -> None:
    """Raise `DataError` for a search without an end or names, or flights that took part in it."""
    taken = {*content["trained_on"], *content["tested_on"]} & set(data.names)
    taken |= {f.name for f in data if of_one_flight(f.known_by, model.trained_samples)}
    if twice := sorted(taken):
        raise DataError(
            f"{', '.join(twice)} took part in the search already",
            expected="flights that did not",
            fix="give new flights, under names of their own",
        )
    if content["verdict"] == "stopped":
        raise DataError(
            "the search was stopped before its end",
            expected="names that it certified",
            fix=f"go on with it first: {content.get('command', 'greybox discover')}",
        )
    if content.get("by_errors_ahead") or not content["effects"]:
        said = "no name to go on with: none has an e-value by likelihood"
        raise DataError(said, fix="greybox discover with all flights")


def _told(model: IdentifiedModel, data: Dataset, own: Iterable[Effect]) -> tuple[Flights, Fitted]:
    """The new flights, and the structure of `model` fitted to them from what is known."""
    causes = offer(
        model.physics.vehicle,
        data.channels,
        own=own,
        sample_time=sample_time(data),
        noncausal=data.noncausal,
        known=replace(since(model), effects=()),
        kinematic_noise=model.physics.kinematic_noise,
    )
    parts = [sensor_cause(p, causes.model) for p in sensor_parts(model.dynamics)]
    causes = causes.with_cause(*parts)
    there = (*model.effects, *(p.name for p in parts))
    structure = frozenset(there) & causes.offered.keys()
    noisy = with_sensor_noise(data, model.physics.vehicle)[0]
    flights = Flights(causes=causes, data=without_lead_in(noisy))
    start: dict[Key, float] = {(n, None): float(v) for n, v in model.values.items()}
    return flights, flights.fit(structure, [start])


def _unlike(content: DiscoveryDocument, model: IdentifiedModel, data: Dataset) -> str:
    """That the model foretold the flights of the search, and some of these it does not; else empty.
    Nobody believes a structure with or without a name then."""
    adapt = content["settings"].get("adapt")
    seen = [verdict_on(model, Dataset(flights=(flight,)), adapt) for flight in data]
    said = "; ".join(f"{', '.join(v.flights)}: {v.line}" for v in seen if v and v.refused)
    if not said or (model.verdict and model.verdict.refused):
        return ""
    return f"ANOTHER CRAFT OR AIR, which counts against names only ({said}; discover --from). "


def _unnamed(effect: NamedRow, bar: float) -> UnnamedRow:
    return {
        "name": effect["name"],
        "status": effect["status"],
        "log10_e": effect["log10_e"],
        "against": effect["against"],
        "worth": effect["worth"],
        "further": effect["further"],
        "reason": f"with further flights log10 e {effect['log10_e']:.1f} of {bar:.1f}",
    }


def _log_e(flights: Flights, told: Fitted, effect: NamedRow, model: IdentifiedModel) -> float:
    """The log e-value of a name by flights that the structure `told` with it was fitted to."""
    causes, name, left = flights.causes, effect["name"], told.structure - {effect["name"]}
    nulls = {n: null for n, (null, _) in causes.offered[name].prior.items()}
    bare = replace(causes, known=known_numbers(model, given={**nulls, **since(model).held}))
    rival = replace(flights, causes=bare, _known={}).fit(left, [told.known])
    logs = [told.log_evidence - rival.log_evidence - told.may_gain - rival.may_gain]
    instead = frozenset(str(effect["against"]).split(" + "))
    if instead <= set(causes.effects):
        rival = flights.fit(left | instead, [told.known])
        keys = [(u.name, u.flight) for u in rival.space.unknowns if u.name.split(".")[0] in instead]
        paid = regret(None, rival, keys) if keys and rival.value.valid else 0.0
        logs.append(told.log_evidence - rival.log_evidence - paid - told.may_gain - rival.may_gain)
    return min(logs)


def _line(kept: Iterable[NamedRow], before: str) -> str:
    """The names now, and what was said `before` of the model and of what has no name."""
    said = "; ".join(f"{e['name']} (log10 e {e['log10_e']:.1f})" for e in kept)
    now, mark = f"MISSING: {said}" if said else "no name holds on the further flights", ". Before: "
    return now + mark + before.split(mark)[-1]
