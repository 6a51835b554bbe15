"""Name: what is said of one cause of the final structure, and on what grounds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from greybox.discovery.certificate import Certificate
from greybox.discovery.evidence import Fitted, Flights
from greybox.discovery.worth import Worth
from greybox.model.parameter import Parameter

Status = Literal["certified", "supported", "one of these", "trace", "impossible", "not certified"]
LOG10 = float(np.log(10.0))


@dataclass(frozen=True, kw_only=True, eq=False)
class Name:
    """One cause: its `status`, `certificate` and `worth` (None where no flight could tell). Of
    "one of these", `shares` are the probabilities of the sets of causes that the flights cannot
    tell apart, itself first; `reason` says why it has no name; `kept`: it is in the model without
    one."""

    name: str
    status: Status
    certificate: Certificate
    worth: Worth | None
    shares: Mapping[str, float] = field(default_factory=dict)
    reason: str = ""
    kept: bool = False

    def to_dict(self) -> dict[str, Any]:
        """What discovery.json says of it besides its estimates."""
        w = self.worth
        return {
            "name": self.name,
            "status": self.status,
            "log10_e": self.certificate.log_e / LOG10,
            "against": " + ".join(self.certificate.against) or "nothing in its place",
            "worth": None
            if w is None
            else {
                "share": w.share,
                "group": w.group,
                "horizon_s": w.horizon,
                "log10_e": w.log_e / LOG10,
                "seconds": w.seconds,
            },
        }


def judged(
    certificate: Certificate, worth: Worth | None, impossible: str, bar: float, alpha: float
) -> Name:
    """The status of one cause: `bar` is the log e-value that certifies a name among all that were
    offered, `impossible` says why it can be none."""
    name = certificate.name
    alike = certificate.alike(bar)
    dropped = certificate.rivals.get((), -np.inf)
    status: Status
    reason, shares = "", dict[str, float]()
    if dropped < bar:
        foretells = worth is not None and worth.log_e >= bar and worth.matters
        status = "supported" if dropped >= 0 and foretells and not alike else "not certified"
        reason = f"log10 e {dropped / LOG10:.1f} of {bar / LOG10:.1f} that a name needs"
    elif impossible:
        status, reason = "impossible", impossible
    elif worth is not None and not worth.matters:
        status = "trace"
        reason = f"it is there, and removes {max(worth.share, 0.0):.1%} of the error at most"
        reason += "" if worth.seen else ", less than one reading can show"
    elif alike:
        status = "one of these"
        shares = _shares(certificate, alike, bar + float(np.log(alpha)))
    else:
        status = "certified"
    return Name(
        name=name,
        status=status,
        certificate=certificate,
        worth=worth,
        shares=shares,
        reason=reason,
    )


def unneeded(name: Name, beside: Certificate, bar: float) -> Name:
    """A name that did not hold beside laws, by the certificate that it has there."""
    reason = (
        f"next to the laws of what has no name its log10 e is {beside.log_e / LOG10:.1f} of "
        f"{bar / LOG10:.1f} that a name needs"
    )
    return replace(
        name, status="not certified", certificate=beside, shares={}, reason=reason, kept=True
    )


def _shares(
    certificate: Certificate, alike: Sequence[tuple[str, ...]], price: float
) -> dict[str, float]:
    """Probability of every set: by the evidence of the flights that taught, which favours no side
    as an e-value does, and the log prior odds `price` against each cause that a set has more."""
    told = certificate.evidence
    own = [told.get(r, -certificate.rivals[r]) - price * (len(r) - 1) for r in alike]
    logs = np.array([0.0, *own])
    weights = np.exp(logs - np.logaddexp.reduce(logs))
    names = (certificate.name, *("+".join(r) for r in alike))
    return dict(zip(names, weights.tolist(), strict=True))


def impossible(at: Fitted, flights: Flights, name: str) -> str:
    """Why a cause of the structure `at` can be no name; empty where it can. An estimate at its
    bound stands in for something else, and one beyond what any craft has is a fault of the data."""
    cause = flights.causes.offered[name]
    declared: dict[str, Parameter] = {d.name: d for d in at.problem.dynamics.parameters}
    bent = []
    for u, value, held in zip(at.problem.unknowns, at.theta, at.held, strict=True):
        if u.name not in cause.parameters:
            continue
        null = cause.prior[u.name][0]
        own = declared[u.name]
        if abs(value - null) > own.possible:
            size = f"{value:.3g} {own.unit}".rstrip()
            return (
                f"{u.name} = {size}, and no craft has more than {own.possible:.3g}: a fault of the "
                "data (axes, frames, units) is likelier; run greybox check"
            )
        if held and value != null:
            bent.append(u.name)
    if bent:
        return f"{', '.join(sorted(set(bent)))} ran to a bound: it stands in for something else"
    return ""
