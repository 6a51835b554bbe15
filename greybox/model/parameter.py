"""Parameter: the declaration of a number of the model. ParameterValues: numbers under those names.
Never mixed up."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

from greybox.errors import ModelError, UnknownNameError

Scope = Literal["shared", "flight"]


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """Declaration of one scalar parameter. It never holds an estimate; free or fixed is a choice of
    the fit call.

    `nominal` is the value where nothing else is said, `null` the value that removes the effect
    (None where there is no such value), `sigma` the standard deviation of the prior around
    `nominal` (0 = exact, inf = no prior). `scale` is the size of a typical change (for conditioning
    and for random starts), `possible` the largest distance from `null` that a craft can have: more
    is a fault of the data, not a property of the vehicle (and three sigma where nothing else is
    believed). `origin` is the value at which the factor that it stands for vanishes; None: what
    cannot be negative is a factor of its own.
    """

    name: str
    unit: str
    nominal: float
    lower: float = -math.inf
    upper: float = math.inf
    null: float | None = None
    sigma: float = math.inf
    scale: float = 1.0
    possible: float = math.inf
    origin: float | None = None
    scope: Scope = "shared"
    meaning: str = ""

    def __post_init__(self) -> None:
        if not self.lower <= self.nominal <= self.upper:
            raise ModelError(
                f"parameter {self.name}: nominal {self.nominal:g} is outside its bounds",
                expected=f"{self.lower:g} .. {self.upper:g}",
            )
        if not self.scale > 0 or not math.isfinite(self.scale):
            raise ModelError(
                f"parameter {self.name}: scale must be positive and finite", got=f"{self.scale:g}"
            )
        if not self.sigma >= 0:
            raise ModelError(
                f"parameter {self.name}: sigma must not be negative", got=f"{self.sigma:g}"
            )

    def excess(self, value: float) -> float:
        """How much farther a value is from the null than a craft can have it, in its unit:
        negative where one can, minus infinity where there is no null."""
        return -math.inf if self.null is None else abs(value - self.null) - self.possible

    @property
    def believed(self) -> tuple[float, float]:
        """(mean, standard deviation) of the prior. Without a sigma it is what craft can have at
        most, as three sigma: an offset that is believed to be anything takes what is known of the
        thrust."""
        if self.null is None or not math.isinf(self.sigma) or math.isinf(self.possible):
            return self.nominal, self.sigma
        return self.null, self.possible / 3.0


class ParameterValues(Mapping[str, float]):
    """Names -> numbers, immutable. `replace({name: value})` gives a changed copy; a wrong name is
    an error with near names.

    >>> values = ParameterValues({"mass": 0.03, "motor_lag.tau": 0.04})
    >>> values.replace({"mass": 0.035})["mass"], values["mass"]
    (0.035, 0.03)
    """

    __slots__ = ("_values",)

    def __init__(self, values: Mapping[str, float] | Iterable[tuple[str, float]]) -> None:
        self._values = {k: float(v) for k, v in dict(values).items()}

    def __getitem__(self, name: str) -> float:
        try:
            return self._values[name]
        except KeyError:
            raise UnknownNameError("parameter", name, self._values) from None

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __contains__(self, name: object) -> bool:
        return name in self._values

    def replace(self, changes: Mapping[str, float]) -> ParameterValues:
        """A copy with `changes` applied. Raises `UnknownNameError` for a name that is not there."""
        for name in changes:
            self[name]
        return ParameterValues({**self._values, **changes})

    def __repr__(self) -> str:
        return "ParameterValues(" + ", ".join(f"{k}={v:.6g}" for k, v in self._values.items()) + ")"


def nominal_values(parameters: Iterable[Parameter]) -> ParameterValues:
    """The nominal value of every declared parameter."""
    return ParameterValues({p.name: p.nominal for p in parameters})
