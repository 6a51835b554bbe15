"""Typed reading of a TOML table: every getter checks, and an error names the file and the key."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

from greybox.errors import UnknownNameError, VehicleError

_ABSENT = object()


def describe(value: object) -> str:
    """A value as it is shown in an error: type and text, short."""
    kinds = {str: "the text", bool: "the boolean", list: "the array", dict: "the table"}
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # Python refuses to print numbers of thousands of digits
        text = "that cannot be shown"
    return f"{kinds.get(type(value), 'the value')} {text if len(text) <= 60 else text[:57] + '...'}"


class TomlTable:
    """A table of a TOML file with its place, for typed access.

    All getters raise `VehicleError` (missing key, wrong type, not finite) with file and key in the
    message.
    """

    def __init__(self, value: object, *, file: str, path: str = "") -> None:
        self.file, self.path = file, path
        if not isinstance(value, Mapping):
            raise self.error("", "a table is needed here", got=describe(value))
        self.value: Mapping[str, object] = value

    def place(self, key: str) -> str:
        """File and dotted key."""
        dotted = ".".join(part for part in (self.path, key) if part)
        return f"{self.file}: {dotted}" if dotted else self.file

    def error(self, key: str, message: str, **details: str | None) -> VehicleError:
        """A `VehicleError` at `key`."""
        return VehicleError(message, where=self.place(key), **details)

    def __contains__(self, key: str) -> bool:
        return key in self.value

    def known(self, keys: Iterable[str]) -> None:
        """Demand that every key is one of `keys`. Raises `UnknownNameError` with the nearest
        names."""
        allowed = tuple(keys)
        for key in self.value:
            if key not in allowed:
                raise UnknownNameError("key", key, allowed, where=self.place(""))

    def get(self, key: str, default: object = _ABSENT) -> object:
        """The raw value; `VehicleError` where it is missing and there is no default."""
        if key in self.value:
            return self.value[key]
        if default is _ABSENT:
            raise self.error(
                key,
                "missing",
                fix=f"add the key '{key}'" + (f" to [{self.path}]" if self.path else ""),
            )
        return default

    def number(
        self,
        key: str,
        default: object = _ABSENT,
        *,
        positive: bool = False,
        minimum: float | None = None,
    ) -> float:
        """A finite number."""
        value = self.checked_number(key, self.get(key, default))
        if positive and not value > 0:
            raise self.error(
                key,
                "must be positive",
                got=f"{value:g}",
                fix="give it in SI units, greater than zero",
            )
        if minimum is not None and value < minimum:
            raise self.error(
                key, f"must be at least {minimum:g}", got=f"{value:g}", fix="check sign and unit"
            )
        return value

    def checked_number(self, key: str, value: object) -> float:
        """`value`, which stands at `key`, as a finite float."""
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise self.error(
                key, "a number is needed here", got=describe(value), fix="write it without quotes"
            )
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if not math.isfinite(number):
            raise self.error(
                key,
                "not finite",
                expected="a finite number",
                got=str(number),
                fix="give a real value",
            )
        return number

    def text(self, key: str, default: object = _ABSENT) -> str:
        """A text."""
        value = self.get(key, default)
        if not isinstance(value, str):
            raise self.error(
                key, "a text is needed here", got=describe(value), fix="put it in quotes"
            )
        if not value.isprintable():
            # it is printed, and written into pages, C and build files
            raise self.error(
                key,
                "a text on one line, without control characters, is needed here",
                got=repr(value)[:80],
            )
        return value

    def choice(self, key: str, choices: tuple[str, ...], default: str) -> str:
        """One of a few texts."""
        value = self.text(key, default)
        if value not in choices:
            raise UnknownNameError("value", value, choices, where=self.place(key))
        return value

    def array(self, key: str, length: int | None, default: object = _ABSENT) -> list[object]:
        """An array, of `length` entries unless None."""
        value = self.get(key, default)
        wanted = "an array" if length is None else f"an array of {length}"
        if not isinstance(value, (list, tuple)):
            raise self.error(
                key,
                "not an array",
                expected=wanted,
                got=describe(value),
                fix="write it as [a, b, ...]",
            )
        if length is not None and len(value) != length:
            raise self.error(
                key, f"{len(value)} entries", expected=wanted, fix="give one number per component"
            )
        return list(value)

    def numbers(self, key: str, length: int, default: object = _ABSENT) -> tuple[float, ...]:
        """An array of finite numbers."""
        values = self.array(key, length, default)
        return tuple(self.checked_number(f"{key}[{i}]", v) for i, v in enumerate(values))

    def table(self, key: str, default: object = _ABSENT) -> TomlTable:
        """A sub-table."""
        return TomlTable(
            self.get(key, default), file=self.file, path=f"{self.path}.{key}" if self.path else key
        )
