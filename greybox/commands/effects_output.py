"""What `greybox effects` prints and writes: the catalogue for a terminal, as JSON, and as the page
docs/effects.md."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator

from greybox.commands.effect_stages import STAGES
from greybox.files import Json
from greybox.model.effect import Effect
from greybox.model.effects import CATALOGUE
from greybox.model.example import example_vehicle
from greybox.model.parameter import Parameter

SCHEMA = "greybox.effects/1"


def catalogue(effects: tuple[Effect, ...] = CATALOGUE) -> dict[str, Json]:
    """Plain values of the declarations (schema "greybox.effects/1"). A bound that is not there is
    null."""
    return {"schema": SCHEMA, "effects": [_plain(e) for e in effects]}


def _plain(effect: Effect) -> dict[str, Json]:
    return {
        "name": effect.name,
        "stage": effect.stage,
        "summary": effect.summary,
        "formula": effect.formula,
        "parameters": [
            {
                "name": f"{effect.name}.{p.name}",
                "unit": p.unit,
                "null": p.null,
                "lower": low,
                "upper": high,
                "scope": p.scope,
                "meaning": p.meaning,
            }
            for p, low, high in _rows(effect)
        ],
        "needs": {
            "columns": list(effect.needs.columns),
            "vehicle": list(effect.needs.vehicle),
            "sensors": list(effect.needs.sensors),
            "other_sensors": list(effect.needs.other_sensors),
            "effects": list(effect.needs.effects),
        },
        "tags": sorted(effect.tags),
        "validity": effect.validity,
        "references": list(effect.references),
    }


def text(effects: tuple[Effect, ...]) -> str:
    """The effects by stage, for a terminal."""
    lines: list[str] = []
    for stage, meaning in STAGES.items():
        members = [e for e in effects if e.stage == stage]
        if not members:
            continue
        lines += [f"{stage.upper()}: {meaning}", ""]
        for e in members:
            lines += [f"  {e.name}: {e.summary}", f"    {e.formula}"]
            lines += [f"    {p.name} [{p.unit}]  {p.meaning}{_limits(p, *b)}" for p, *b in _rows(e)]
            if needs := _needs(e):
                lines.append(f"    needs {needs}")
            for reference in e.references:
                lines += textwrap.wrap(
                    reference, 100, initial_indent="    - ", subsequent_indent="      "
                )
            lines.append("")
    return "\n".join(lines).rstrip()


def markdown() -> str:
    """The page docs/effects.md."""
    return "\n".join(_page()) + "\n"


def _page() -> Iterator[str]:
    yield "# Effects"
    yield ""
    yield (
        "Physics that the rigid body with rotors does not have by itself and that a fit can add by "
        "name (`--effects a,b`). Every effect lives in one stage, is absent at its null, and "
        "combines with others in a way that does not depend on the order in which they are listed. "
        "Generated from the declarations by `python -m greybox.commands.effects --markdown`; "
        "`greybox effects` prints the same with the sources of each. Per rad/s of the rotors "
        "becomes per nu where the vehicle file has no speed_max. Effects of your own: "
        "[own_effect.md](own_effect.md)."
    )
    for stage, meaning in STAGES.items():
        members = [e for e in CATALOGUE if e.stage == stage]
        if not members:
            continue
        yield ""
        yield f"## Stage {stage}"
        yield ""
        yield meaning[0].upper() + meaning[1:] + "."
        yield ""
        yield "| effect | what it is | formula | parameters | needs | valid |"
        yield "|---|---|---|---|---|---|"
        for e in members:
            parameters = ", ".join(f"`{p.name}` [{p.unit}]{_limits(p, *b)}" for p, *b in _rows(e))
            cells = (
                f"`{e.name}`",
                e.summary,
                f"`{e.formula}`",
                parameters,
                _needs(e) or "-",
                e.validity,
            )
            yield "| " + " | ".join(c.replace("|", "\\|") for c in cells) + " |"


def _rows(effect: Effect) -> list[tuple[Parameter, float | None, float | None]]:
    """(declaration, lower, upper); a bound that is not there, or that depends on the vehicle, is
    None."""

    def fixed(a: float, b: float) -> float | None:
        return a if math.isfinite(a) and a == b else None

    pairs = zip(
        effect.parameters(example_vehicle()), effect.parameters(example_vehicle(2.0)), strict=True
    )
    return [(p, fixed(p.lower, other.lower), fixed(p.upper, other.upper)) for p, other in pairs]


def _limits(p: Parameter, lower: float | None, upper: float | None) -> str:
    """Bounds and scope, where there are any; a null other than zero."""
    parts = []
    if lower is not None and upper is not None:
        parts.append(f"{lower:g} to {upper:g}")
    elif lower is not None:
        parts.append(f"at least {lower:g}")
    elif upper is not None:
        parts.append(f"at most {upper:g}")
    elif math.isfinite(p.lower) or math.isfinite(p.upper):
        parts.append("bounded by the vehicle's size")
    if p.null:
        parts.append(f"null {p.null:g}")
    if p.scope == "flight":
        parts.append("per flight")
    return f" ({', '.join(parts)})" if parts else ""


def _needs(effect: Effect) -> str:
    needs = effect.needs
    parts = [f"column {c}" for c in needs.columns] + [
        f"{fact} in the vehicle file" for fact in needs.vehicle
    ]
    parts += [
        f"sensor {' or '.join(group)}" for group in (needs.sensors, needs.other_sensors) if group
    ]
    if needs.effects:
        others, last = ", ".join(needs.effects[:-1]), needs.effects[-1]
        parts.append("felt only with " + (f"{others} or {last}" if others else last))
    return ", ".join(parts)
