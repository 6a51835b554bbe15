"""Alike: what tells apart causes that the flights cannot.

Which sets of causes are alike is computed (`greybox.discovery.propose`, `certificate`): rivals come
from the joint information at the fit, with all nuisances projected out, and are alike where no
e-value parts them. Here the manoeuvre that would part them is sought.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from greybox.discovery.evidence import Fitted, Flights
from greybox.discovery.name import Name
from greybox.errors import GreyboxError
from greybox.planning.experiment import separating_manoeuvre

EXACT = 1e-3
"""Difference in log likelihood below which two structures say the same thing with other words: no
manoeuvre is sought."""


def separating(flights: Flights, at: Fitted, name: Name) -> Mapping[str, Any] | None:
    """The manoeuvre that tells a set apart, as in discovery.json; None where none does."""
    fits = {name.name: flights.settled(at)}
    left = at.structure - {name.name}
    for other in list(name.shares)[1:]:
        rival = flights.known(left | set(other.split("+")))
        if rival is not None and abs(rival.value.likelihood - at.value.likelihood) >= EXACT:
            fits[other] = flights.settled(rival)
    if len(fits) < 2:
        return None
    try:
        return separating_manoeuvre(fits)
    except GreyboxError:
        return None
