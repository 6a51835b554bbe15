"""What the arguments of public functions are: one guard, which says what came instead and the usual
fix."""

from __future__ import annotations

import functools
import importlib
import inspect
import math
import numbers
import os
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, ParamSpec, Protocol, TypeVar, runtime_checkable

from greybox.errors import DataError, GreyboxError, ModelError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

P = ParamSpec("P")
R = TypeVar("R")
LONGEST_VALUE = 60
"""Characters of a value that a message shows."""


@runtime_checkable
class Named(Protocol):
    """Values by name: a mapping, or a frame or series of pandas."""

    def items(self) -> Iterable[tuple[Hashable, object]]:
        """(name, value) of each."""
        ...

    def __iter__(self) -> Iterator[Hashable]: ...

    def __len__(self) -> int: ...


@runtime_checkable
class _Framed(Protocol):
    """A frame or series of pandas."""

    @property
    def iloc(self) -> object:
        """Rows by number."""


@dataclass(frozen=True, kw_only=True)
class Kind:
    """What an argument is, in words, and whether a value is that. `read` names the function
    (module:function) that reads one from a path, which then is as good."""

    words: str
    fits: Callable[[Any], bool]
    fix: str = ""
    error: type[GreyboxError] = DataError
    read: str = ""

    def taken(self, name: str, value: object) -> object:
        """The value, read from its file where it is a path. Raises `GreyboxError` for what it is
        not."""
        value = scalar(value)
        if self.read and isinstance(value, str | os.PathLike):
            module, function = self.read.split(":")
            return getattr(importlib.import_module(module), function)(value)
        if not self.fits(value):
            raise self.error(f"{name} takes {self.words}", got=shown(value), fix=self.fix or None)
        return value


@dataclass(frozen=True, kw_only=True)
class Several(Kind):
    """An iterable of what `fits`, `count` of them where it is said; a single text is none, as its
    letters would be taken for it."""

    one_is_enough: bool = False
    count: int | None = None

    def taken(self, name: str, value: object) -> object:
        """The elements as a tuple."""
        value = scalar(value)
        if self.one_is_enough and self.fits(value):
            return (value,)
        single = isinstance(value, str | bytes | os.PathLike | numbers.Number)
        fix = self.fix
        if isinstance(value, str) and self.fits(value):
            fix = fix or f"{name}={[word.strip() for word in value.split(',')]}"
        elif single:
            fix = fix or f"{name}=[{value}]"
        # The columns of a data frame, or the names of what has values, are no list that anybody
        # meant: fixed={"mass": 0.03} held another mass.
        if single or not isinstance(value, Iterable) or isinstance(value, Mapping | _Framed):
            raise self.error(f"{name} takes {self.words}", got=shown(value), fix=fix or None)
        elements = tuple(scalar(element) for element in value)
        for element in elements:
            if not self.fits(element):
                raise self.error(
                    f"{name} takes {self.words}", got=f"{shown(element)} in it", fix=fix or None
                )
        if self.count not in (None, len(elements)):
            raise self.error(f"{name} takes {self.words}", got=f"{len(elements)} of them")
        return elements


@runtime_checkable
class _OneNumber(Protocol):
    """An array of NumPy or PyTorch, which may have no dimension."""

    ndim: int

    def item(self) -> object:
        """Its only element as it is in Python."""


def scalar(value: object) -> object:
    """The number that an array without dimensions holds; anything else as it is."""
    if isinstance(value, numbers.Number) or not isinstance(value, _OneNumber):
        return value
    return value.item() if value.ndim == 0 else value


@dataclass(frozen=True, kw_only=True)
class ByName(Kind):
    """Values by name, as a dict of their own."""

    def taken(self, name: str, value: object) -> object:
        """The names with their values."""
        if isinstance(value, Named):
            value = {n: scalar(v) for n, v in value.items()}
        return super().taken(name, value)


def shown(value: object) -> str:
    """A plain value as it is, of anything else its class."""
    plain = isinstance(value, str | numbers.Number | bytes)
    text = repr(value)
    return text if plain and len(text) <= LONGEST_VALUE else type(value).__name__


def has(*attributes: str) -> Callable[[object], bool]:
    """Whether an object has these attributes; no class is one."""
    return lambda value: not isinstance(value, type) and all(hasattr(value, a) for a in attributes)


def is_a(name: str) -> Callable[[object], bool]:
    """Whether an object is of the class of this name, which need not be loaded to know it."""
    return lambda value: name in {c.__name__ for c in type(value).__mro__}


def is_path(value: object) -> bool:
    """Whether it may name a file."""
    return isinstance(value, str | os.PathLike)


def is_number(value: object) -> bool:
    """Whether it is a finite real number."""
    return isinstance(value, numbers.Real) and not isinstance(value, bool) and math.isfinite(value)


def is_flag(value: object) -> bool:
    """Whether it is true or false, of Python or of NumPy."""
    return isinstance(value, bool) or type(value).__name__ in ("bool", "bool_")


def is_whole(value: object) -> bool:
    """Whether it is a whole number, of Python or of NumPy."""
    return isinstance(value, numbers.Integral) and not isinstance(value, bool)


def are_numbers(value: object) -> bool:
    """Whether it holds numbers by name."""
    return isinstance(value, Named) and all(
        isinstance(n, str) and is_number(v) for n, v in value.items()
    )


VEHICLE = Kind(
    words="a vehicle, or the path of its file",
    fits=has("rotors", "actuator", "columns"),
    fix="greybox.read_vehicle('V.toml')",
    error=ModelError,
    read="greybox.model.vehicle:read_vehicle",
)
SEARCHED = Kind(
    words="a vehicle, the path of its file, or a StateSpaceModel",
    fits=lambda v: VEHICLE.fits(v) or is_a("StateSpaceModel")(v),
    fix=VEHICLE.fix,
    error=ModelError,
    read=VEHICLE.read,
)
SUBJECT = Kind(
    words="a vehicle, the path of its file, or a model that is not fitted",
    fits=lambda v: VEHICLE.fits(v) or has("states", "parameters", "step")(v),
    fix="greybox.read_vehicle('V.toml'), greybox.build_model(...), StateSpaceModel(...); of an "
    "IdentifiedModel its .physics",
    error=ModelError,
    read="greybox.model.vehicle:read_vehicle",
)
MODEL = Kind(
    words="a model of fit, discover or learn, or the path of its file",
    fits=has("dynamics", "sample_time", "reference_state"),
    fix="greybox.load('model.json'), fit(...).model; a linear model is judged by its own fit and "
    "learned from by greybox.baselines.output_residual.fit_output_residual",
    error=ModelError,
    read="greybox.residual.files:load_model",
)
FIT = Kind(
    words="a Fit",
    fits=has("problem", "theta", "settings"),
    fix="what greybox.fit returns, not its model",
    error=ModelError,
)
FLIGHTS = Kind(
    words="flights: a Dataset or a Flight",
    fits=has("segments", "channels"),
    fix="greybox.read_logs(paths, vehicle), greybox.dataset_from_arrays(t, channels)",
)
LOGS = Kind(
    words="flights (a Dataset, a Flight) or raw logs",
    fits=lambda v: (
        FLIGHTS.fits(v)
        or (
            isinstance(v, Iterable)
            and not is_path(v)
            and all(has("flight", "rows", "channels")(log) for log in v)
        )
    ),
    fix="greybox.read_logs(paths, vehicle), read_table(path) of each log",
)
EXECUTOR = Kind(
    words="an executor", fits=has("submit"), fix="concurrent.futures.ProcessPoolExecutor(2)"
)
RECORDS = Several(
    words="a list of Records",
    fits=has("u", "y"),
    fix="[Record(u=u, y=y)] of greybox.linear.records",
)
SEGMENT = Kind(
    words="a Segment", fits=has("column", "matrix", "dt"), fix="data.flights[0].segments[0]"
)
PATH = Kind(words="a path", fits=is_path)
PATHS = Several(
    words="a list of paths",
    fits=is_path,
    fix="arrays and data frames: greybox.dataset_from_arrays(t, channels)",
    one_is_enough=True,
)
LOG = Kind(words="a path, or a Recording", fits=lambda v: is_path(v) or is_a("Recording")(v))
LOG_FILES = Several(words=PATHS.words, fits=LOG.fits, fix=PATHS.fix, one_is_enough=True)
NAMES = Several(words="a list of names", fits=lambda v: isinstance(v, str), error=GreyboxError)
SIMULATORS = Several(
    words="a list of names, or of targets of your own",
    fits=lambda v: isinstance(v, str) or has("words", "files")(v),
    error=GreyboxError,
)
EFFECTS = Several(
    words="a list of effects, by name or as they are",
    fits=lambda v: isinstance(v, str) or has("name", "parameters")(v),
    error=ModelError,
)
OWN_EFFECTS = Several(
    words="a list of effects of your own, as they are",
    fits=has("name", "parameters"),
    fix="greybox.model.effects_file.load_effects('E.py'); those of the catalogue are offered "
    "without being named",
    error=ModelError,
)
OWN_SENSORS = Several(
    words="a list of sensors of your own, as they are",
    fits=has("name", "clock", "summary"),
    error=ModelError,
)
MAPPING = Kind(
    words="the path of a mapping file, or a LogMapping",
    fits=lambda v: is_path(v) or is_a("LogMapping")(v),
)
CHANNELS = Kind(
    words="channels by name: {'p': values, ...}, or a data frame",
    fits=lambda v: isinstance(v, Named) and len(v) > 0 and all(isinstance(n, str) for n in v),
    fix="dataset_from_arrays(t, {'u1': u1, 'p': p})",
)
INPUT = Kind(
    words='"command" or "speed"',
    fits=lambda v: isinstance(v, str) and v in ("command", "speed"),
    error=ModelError,
)
FUNCTION = Kind(words="a function", fits=callable)
FAULTS = Kind(words="a CheckReport", fits=has("ok", "findings"), fix="greybox.check(data, vehicle)")
RESPONDING = Kind(
    words="a fitted model: of fit, discover or linear",
    fits=has("sample_time", "dynamics"),
    fix="greybox.load('model.json')",
    error=ModelError,
)
TEXT = Kind(words="a text", fits=lambda v: isinstance(v, str))
NUMBERS = Several(words="a list of numbers", fits=is_number)
VALUES = ByName(words="names with numbers: {'mass': 0.03}", fits=are_numbers, error=GreyboxError)
WHOLE = Kind(words="a whole number", fits=is_whole, error=GreyboxError)
FLAG = Kind(words="True or False", fits=is_flag, error=GreyboxError)
WHOLES = Several(words="a list of whole numbers", fits=is_whole, error=GreyboxError)
COUNT = Kind(words="a whole number above zero", fits=lambda v: is_whole(v) and v > 0)
NATURAL = Kind(words="a whole number from 0 on", fits=lambda v: is_whole(v) and v >= 0)
NUMBER = Kind(words="a number", fits=is_number)
POSITIVE = Kind(words="a number above zero", fits=lambda v: is_number(v) and v > 0)
NOT_NEGATIVE = Kind(words="a number, zero or above", fits=lambda v: is_number(v) and v >= 0)
SHARE = Kind(words="a number between 0 and 1", fits=lambda v: is_number(v) and 0 < v < 1)


def numbers_of(count: int) -> Kind:
    """What takes `count` numbers."""
    return Several(words=f"{count} numbers", fits=is_number, count=count)


def takes(**kinds: Kind) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorator of a function whose arguments are of these kinds. None passes where it is the
    default, or declared."""

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        parameters = inspect.signature(function).parameters
        open_ones = {
            n
            for n in kinds
            if n not in parameters
            or parameters[n].default is None
            or str(parameters[n].annotation).endswith("| None")
        }
        names = list(parameters)

        def taken(name: str, value: object) -> object:
            if name not in kinds or (value is None and name in open_ones):
                return value
            return kinds[name].taken(name, value)

        @functools.wraps(function)
        def guarded(*args: P.args, **kwargs: P.kwargs) -> R:
            known = [taken(n, v) for n, v in zip(names, args, strict=False)]
            said: Mapping[str, Any] = {n: taken(n, v) for n, v in kwargs.items()}
            return function(*known, *args[len(known) :], **said)  # type: ignore[arg-type]

        return guarded

    return decorate


def _is_real(value: object) -> bool:
    """Whether it is a real number; its record says of which range."""
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


BY_TYPE: Mapping[str, Kind] = {
    "bool": FLAG,
    "int": WHOLE,
    "float": Kind(words="a number", fits=_is_real, error=GreyboxError),
    "str": Kind(words="a text", fits=TEXT.fits, error=GreyboxError),
    "tuple[str, ...]": NAMES,
    "tuple[int, ...]": WHOLES,
    "tuple[float, ...]": NUMBERS,
    "Mapping[str, float]": VALUES,
    "tuple[Effect, ...]": OWN_EFFECTS,
    "IdentifiedModel": MODEL,
    "Effort": Kind(
        words="an Effort", fits=is_a("Effort"), fix="greybox.discovery.rules.Effort(tried=6)"
    ),
}
"""What a field of a record takes, by its declared type."""
BY_NAME = {"seed": NATURAL, "adapt": NOT_NEGATIVE}
"""The same of fields that mean one thing in every record."""


def taken_fields(record: DataclassInstance, **kinds: Kind) -> None:
    """For the `__post_init__` of a frozen record of options: every field holds what it is declared
    as, or one of `kinds`; None stands for an empty container. Raises `GreyboxError`."""
    for f in fields(record):
        declared = str(f.type).removesuffix(" | None")
        kind = {**BY_TYPE, **BY_NAME, **kinds}
        value = getattr(record, f.name)
        if value is None and callable(f.default_factory):
            value = f.default_factory()
        own = kind.get(f.name) or kind.get(declared)  # a field of a subclass may be anything
        if own is not None and not (value is None and declared != f.type):
            value = own.taken(f.name, value)
        object.__setattr__(record, f.name, value)
