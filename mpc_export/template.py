"""Texts that are mostly the same: files of mpc_export/templates with places @name@ for what
changes."""

from __future__ import annotations

import re
from importlib import resources

_PLACE = re.compile(r"@([A-Za-z_][A-Za-z_0-9]*)@")


def places_in(template: str) -> frozenset[str]:
    """Names of the places of a template."""
    return frozenset(_PLACE.findall(_text(template)))


def filled(template: str, **places: str | int) -> str:
    """The template with every place filled; what CMake fills (@CMAKE_...@) stays. Raises `KeyError`
    for a place that is not given, `ValueError` for one too many."""
    if unused := sorted(set(places) - places_in(template)):
        raise ValueError(f"{template} has no place for {', '.join(unused)}")

    def told(place: re.Match[str]) -> str:
        return place[0] if place[1].startswith("CMAKE_") else str(places[place[1]])

    return _PLACE.sub(told, _text(template))


def _text(template: str) -> str:
    return resources.files("mpc_export").joinpath("templates", template).read_text(encoding="utf-8")
