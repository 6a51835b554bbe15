"""What a Dynamics shows at a prompt: its signals by name and its parameters as a table."""

from __future__ import annotations

from greybox.model.dynamics import Dynamics
from greybox.shown import Cell


def dynamics_text(dynamics: Dynamics) -> str:
    """Name, inputs, outputs, states and parameters of any Dynamics, a line each."""
    return "\n".join(
        [
            dynamics.name,
            f"  inputs: {', '.join(dynamics.inputs.names)}",
            f"  outputs: {', '.join(dynamics.outputs.names)}",
            f"  states: {', '.join(dynamics.states.names)}",
            f"  parameters: {', '.join(d.name for d in dynamics.parameters)}",
        ]
    )


def parameter_rows(dynamics: Dynamics) -> list[dict[str, Cell]]:
    """One row per parameter of any Dynamics: nominal value, unit, bounds, scope and meaning."""
    return [
        {
            "parameter": d.name,
            "nominal": d.nominal,
            "unit": d.unit,
            "lower": d.lower,
            "upper": d.upper,
            "scope": d.scope,
            "meaning": d.meaning,
        }
        for d in dynamics.parameters
    ]
