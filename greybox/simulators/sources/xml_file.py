"""Reading XML of simulators: numbers and elements, with one clear line where they are not there."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from greybox.errors import VehicleError
from greybox.files import read_limited
from greybox.symbolic import FloatArray

LARGEST = 2**22
"""Bytes of a file that is read. A document type declaration, which could grow, is refused."""


def root_of(path: Path) -> ElementTree.Element:
    """Raises `VehicleError` for what is not XML."""
    text = read_limited(path, LARGEST)
    if b"<!DOCTYPE" in text or b"<!ENTITY" in text:
        raise VehicleError("a document type declaration", where=str(path), fix="remove it")
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise VehicleError(f"not valid XML: {error}", where=str(path)) from None


def numbers(text: str | None, count: int, where: str) -> FloatArray:
    """`count` numbers. Raises `VehicleError`."""
    try:
        found = np.array([float(v) for v in str(text or "").split()])
    except ValueError:
        found = np.zeros(0)
    if len(found) != count or not np.isfinite(found).all():
        raise VehicleError(
            "wrong numbers", where=where, expected=f"{count} numbers", got=repr(text)
        )
    return found


def number(
    element: ElementTree.Element, tag: str, where: str, default: float | None = None
) -> float:
    """The number in a child. Raises `VehicleError` where it is missing and has no default."""
    text = element.findtext(tag)
    if text is None and default is not None:
        return default
    return float(numbers(text, 1, f"{where}: <{tag}>")[0])


def attribute(
    element: ElementTree.Element, name: str, where: str, default: float | None = None
) -> float:
    """The number in an attribute. Raises `VehicleError` where it is missing and has no default."""
    text = element.attrib.get(name)
    if text is None and default is not None:
        return default
    return float(numbers(text, 1, f"{where}: {name}=")[0])
