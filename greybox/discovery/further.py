"""Further: more flights multiply the evidence of names that were found before.

New flights D judge the structure S that a search ended with, its posterior as the prior, against
the structure without a name and against that name's strongest rival, both fitted to D at their
worst; of what was known each number's own error counts, not how the errors go together (universal
inference, see `greybox.discovery.certificate`):

    E = p(D | S, what was known) / sup p(D | R, theta).

E-values of flights that are independent given the model multiply, and the product is an e-value
(Grunwald, de Heide and Koolen 2024, JRSS B 86(5)), so that flights may be added until the answer is
clear.
"""

from __future__ import annotations

from collections.abc import Iterable

from threadpoolctl import threadpool_limits

from greybox.data import Dataset
from greybox.data.lead import without_lead_in
from greybox.discovery.cause import offer, sensor_cause
from greybox.discovery.document import DiscoveryDocument, NamedRow, UnnamedRow
from greybox.discovery.evidence import Flights, Structure
from greybox.discovery.name import LOG10
from greybox.errors import DataError
from greybox.estimation.record import sample_time
from greybox.estimation.start import Key
from greybox.model.effect import Effect
from greybox.model.identified import IdentifiedModel
from greybox.model.known import Known, since
from greybox.model.noise import sensor_parts
from greybox.statistics.betting import bar_of_several


@threadpool_limits.wrap(limits=1)
def further(
    content: DiscoveryDocument, model: IdentifiedModel, data: Dataset, own: Iterable[Effect] = ()
) -> DiscoveryDocument:
    """The `content` of discovery.json with the evidence of new flights `data` multiplied to that of
    its names; `model` is the one beside it, `own` are effects besides the catalogue.

    Raises `DataError` where a flight judged already or nothing has a name, `ModelError`,
    `FitError`.
    """
    taken = {*content["trained_on"], *content["tested_on"]}
    if twice := sorted(taken & set(data.names)):
        raise DataError(
            f"{', '.join(twice)} took part in the search already",
            expected="flights that did not",
            fix="give new flights (a flight is known by its name)",
        )
    names = [e["name"] for e in content["effects"]]
    if not names:
        raise DataError("no name to go on with", fix="greybox discover with all flights")
    known = since(model)
    vehicle = model.physics.vehicle
    causes = offer(
        vehicle,
        data.channels,
        own=own,
        sample_time=sample_time(data),
        noncausal=data.noncausal,
        known=Known(effects=(), prior=known.prior, input=known.input),
        kinematic_noise=model.physics.kinematic_noise,
    )
    parts = [sensor_cause(p, causes.model) for p in sensor_parts(model.dynamics)]
    causes = causes.with_cause(*parts)
    structure = frozenset(
        n for n in (*model.effects, *(p.name for p in parts)) if n in causes.offered
    )
    flights = Flights(causes=causes, data=without_lead_in(data))
    start: dict[Key, float] = {(n, None): float(v) for n, v in model.values.items()}
    told = flights.fit(structure, [start])
    flat = flights.on(flights.data, flat=True)
    told_now: list[float] = []
    for effect in content["effects"]:
        rivals = _rivals(structure, effect, causes.effects)
        worst = [flat.fit(r, [told.known, start]) for r in rivals]
        against = min(f.value.likelihood - f.may_gain for f in worst)
        told_now.append((told.log_evidence - told.may_gain + against) / LOG10)
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
    lost: list[UnnamedRow] = [
        {
            "name": e["name"],
            "status": e["status"],
            "log10_e": e["log10_e"],
            "against": e["against"],
            "worth": e["worth"],
            "further": e["further"],
            "reason": f"with further flights log10 e {e['log10_e']:.1f} of {bar:.1f}",
        }
        for e in effects
        if e["status"] == "not certified"
    ]
    return {
        **content,
        "bar_log10_e": bar,
        "effects": kept,
        "not_certified": [*content["not_certified"], *lost],
        "tested_on": [*content["tested_on"], *data.names],
        "line": _line(kept),
        "verdict": _verdict(content, kept),
    }


def _rivals(structure: Structure, effect: NamedRow, offered: Iterable[str]) -> list[Structure]:
    """The structures that do without a name: dropped, or its strongest rival in its place."""
    left = structure - {effect["name"]}
    instead = frozenset(str(effect["against"]).split(" + "))
    return [left, left | instead] if instead <= set(offered) else [left]


def _verdict(content: DiscoveryDocument, kept: Iterable[NamedRow]) -> str:
    """As of a search: the first of named, ambiguous and unnamed that there is."""
    if any(e["status"] in ("certified", "supported") for e in kept):
        return "named"
    if content["ambiguous"]:
        return "ambiguous"
    return "unnamed" if content["unnamed"] else "nothing_missing"


def _line(kept: Iterable[NamedRow]) -> str:
    said = [f"{e['name']} (log10 e {e['log10_e']:.1f})" for e in kept]
    return "MISSING: " + "; ".join(said) if said else "no name holds on the further flights"
