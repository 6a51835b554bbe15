"""Name: what is said of one cause, on what grounds, and what would part it from its like."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from greybox.automatic.held_ahead import HeldAhead
from greybox.discovery.certificate import UNKNOWN, Certificate, Instead
from greybox.discovery.document import Grounds, WorthRow
from greybox.discovery.evidence import Fitted, Flights
from greybox.discovery.search import Rival
from greybox.errors import GreyboxError
from greybox.estimation.result import Fit
from greybox.planning.experiment import Manoeuvres, separating_manoeuvre
from greybox.statistics.evidence import FELT
from greybox.validation.worth import Worth

Status = Literal["certified", "supported", "one of these", "trace", "impossible", "not certified"]
NAMED: tuple[Status, ...] = ("certified", "supported", "one of these")
"""What is said to be missing."""
UNTOLD = "flights need it or what acts like it: no number of it is clear of its own error"
LOG10 = float(np.log(10.0))
EXACT = 1e-3
"""Difference in log likelihood below which two structures say the same thing with other words."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Name:
    """One cause: its `status`, `certificate` and `worth` (None where no flight could tell). Of
    "one of these", `shares` are the probabilities of the sets of causes that the flights cannot
    tell apart, itself first, and `elsewhere` what each of the others makes of numbers that it moves
    beyond their errors; `unlikely`: log (odds, e-value) against what all flights refute and
    the certificate has no more; `reason`: why it has no name; `kept`: in the model without one."""

    name: str
    status: Status
    certificate: Certificate
    worth: Worth | None
    shares: Mapping[str, float] = field(default_factory=dict)
    elsewhere: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    unlikely: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    reason: str = ""
    kept: bool = False

    def to_dict(self) -> Grounds:
        """What discovery.json says of it besides its estimates."""
        w, worth = self.worth, None
        if w is not None:
            worth = WorthRow(
                share=w.share,
                group=w.group,
                horizon_s=w.horizon,
                log10_e=w.log_e / LOG10,
                seconds=w.seconds,
            )
        return {
            "name": self.name,
            "status": self.status,
            "log10_e": self.certificate.log_e / LOG10,
            "against": " + ".join(self.certificate.against) or "nothing in its place",
            "unlikely": [
                {"name": r, "log10_odds": odds / LOG10, "log10_e": e / LOG10}
                for r, (odds, e) in self.unlikely.items()
            ],
            "worth": worth,
        }


def verdict_of(said: Collection[str], unnamed: bool) -> str:
    """The first of named, ambiguous and unnamed that there is, where this was `said` of causes."""
    if "certified" in said or "supported" in said:
        return "named"
    if "one of these" in said:
        return "ambiguous"
    return "unnamed" if unnamed else "nothing_missing"


def held(name: Name) -> Name:
    """A name where a law won: no model was right before, and only an e-value holds."""
    doubted = replace(name, status="not certified", kept=True)
    return doubted if name.status == "supported" else name


def by_errors_ahead(name: str, race: HeldAhead, odd: str, bar: float) -> Name:
    """A name where no likelihood judges, by its worth to the model of a `race` that was fitted by
    errors ahead: an e-process, which needs the `bar`. `odd`: why it can be none."""
    kept, worth = race.held(name), race.worth[name]
    log_e = 0.0 if worth is None else worth.log_e
    reason = "no fit ends without it" if kept else "fitted by errors ahead, flights do without it"
    reason = "no room for it: --max-effects" if name in race.crowded_out else reason
    if kept and worth is not None:
        reason = f"it removes {max(worth.share, 0.0):.1%} of errors ahead at most, log10 e "
        reason += f"{log_e / LOG10:.1f} of {bar / LOG10:.1f}" + ": they grow with it" * worth.harms
    enough = kept and worth is not None and worth.matters and log_e >= bar
    told = Certificate(name=name, rivals={(): log_e})
    said = Name(name=name, status="supported", certificate=told, worth=worth)
    if odd and kept:
        return replace(said, status="impossible", reason=odd, kept=True)
    return said if enough else replace(said, status="not certified", reason=reason, kept=kept)


def judged(
    certificate: Certificate,
    worth: Worth | None,
    impossible: str,
    bar: float,
    alpha: float,
    alone: float | None = None,
) -> Name:
    """The status of one cause: `bar` is the log e-value that certifies it among all that were
    offered, `alone` (else the same) if no other had one, `impossible` says why it can be none."""
    alone = bar if alone is None else alone
    e, whole = certificate.rivals, certificate.whole
    alike, unlikely = certificate.unbeaten(bar, alpha)
    dropped, every = e.get((), -np.inf), whole.get((), UNKNOWN)
    status: Status
    shares = dict[str, float]()
    needed = f"log10 e {dropped / LOG10:.1f} of {bar / LOG10:.1f} that a name needs"
    if dropped < bar <= certificate.most:
        needed += f", up to {certificate.most / LOG10:.1f} were the fits behind it to arrive"
    if max(dropped, certificate.expected) < bar:
        least = max(certificate.expected, 0.0) / LOG10
        needed += f"; {least:.1f} was to be expected of flights that show so little of it"
    reason, kept = needed if dropped < bar else "", False
    foretells = worth is not None and worth.log_e >= alone and worth.matters
    if dropped < bar and not (foretells and dropped >= 0 and not alike and not impossible):
        status = "not certified"
        kept = every.log_e >= bar and not impossible
    elif impossible:
        status, reason = "impossible", impossible
    elif worth is not None and not worth.matters:
        status = "trace"
        reason = f"it is there, and removes {max(worth.share, 0.0):.1%} of the error at most"
        reason += "" if worth.seen else ", less than one reading can show"
    elif worth is not None and worth.harms:
        status, kept = "not certified", True
        reason = (
            "flights are likelier with it and errors ahead larger: it stands for something else"
        )
    elif alike:
        status = "one of these"
        shares = _shares(certificate, alike, alone + float(np.log(alpha)))
    else:
        status = "certified" if dropped >= bar else "supported"
    return Name(
        name=certificate.name,
        status=status,
        certificate=replace(certificate, rivals={r: e[r] for r in e if r not in unlikely}),
        worth=worth,
        shares=shares,
        unlikely={"+".join(r): (whole[r].odds, e[r]) for r in unlikely},
        reason=reason,
        kept=kept,
    )


def with_values_elsewhere(name: Name, fit: Fit, rivals: Sequence[Rival]) -> Name:
    """The name with what its like, where there are any, make of the numbers of `fit`."""
    found = dict[str, dict[str, float]]()
    for rival in rivals:
        known = {n: v for (n, flight), v in rival.fitted.known.items() if flight is None}
        found["+".join(rival.instead)] = {
            n: known[n]
            for n, e in fit.parameters.items()
            if n in known and abs(known[n] - e.value) > FELT * e.std
        }
    return replace(name, elsewhere={s: found[s] for s in name.shares if found.get(s)})


def unneeded(name: Name, beside: Certificate, bar: float) -> Name:
    """A name that did not hold beside laws, by the certificate that it has there."""
    e = f"log10 e {beside.log_e / LOG10:.1f} of {bar / LOG10:.1f} that a name needs"
    shown = replace(name, status="not certified", reason=f"next to the laws {e}", kept=False)
    return replace(shown, certificate=beside, shares={}, elsewhere={}, unlikely={})


def out_done(name: Name, gain: float) -> Name:
    """A name in whose place laws have a log evidence that is larger by `gain`."""
    e = f"laws in its place make the flights likelier (log10 e {gain / LOG10:.1f})"
    gone = replace(name, status="not certified", reason=e, kept=False)
    return replace(gone, shares={}, elsewhere={}, unlikely={})


def untold(name: Name, found: Fit) -> Name:
    """A name without which flights are unlikely, of whose numbers they tell none: several that bend
    into what the catalogue has not say as much of each other. Any other as it is."""
    if name.status not in NAMED or found.tells(name.name):
        return name
    return replace(name, status="not certified", reason=UNTOLD, kept=True)


def _shares(certificate: Certificate, alike: Sequence[Instead], price: float) -> dict[str, float]:
    """Probability of every set: by the evidence of all flights, which favours no side as an e-value
    does, and the log prior odds `price` against each cause that a set has more."""
    e, told = certificate.rivals, {r: w.odds for r, w in certificate.whole.items()}
    logs = np.array([0.0, *(-told.get(r, e[r]) - price * (len(r) - 1) for r in alike)])
    weights = np.exp(logs - np.logaddexp.reduce(logs))
    names = (certificate.name, *("+".join(r) for r in alike))
    return dict(zip(names, weights.tolist(), strict=True))


def separating(flights: Flights, at: Fitted, name: Name) -> Manoeuvres | None:
    """The manoeuvre that tells a set apart, as in discovery.json; None where none does."""
    fits, left = {name.name: flights.settled(at)}, at.structure - {name.name}
    for other in list(name.shares)[1:]:
        rival = flights.known(left | set(other.split("+")))
        if rival is not None and abs(rival.value.likelihood - at.value.likelihood) >= EXACT:
            fits[other] = flights.settled(rival)
    try:
        return separating_manoeuvre(fits) if len(fits) > 1 else None
    except GreyboxError:
        return None
