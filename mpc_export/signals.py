"""What the signals of a model are outside of it: which rotor a command drives, and how a column was
made of what the logs hold. Manifest, header and READMEs say it of every signal that goes in or
out."""

from __future__ import annotations

from dataclasses import replace

from greybox.data.readers.recipes import recipes
from greybox.model.dynamics import Dynamics
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import physics_of
from greybox.symbolic import Layout
from mpc_export.model_parts import Exportable


def told(layout: Layout, model: Exportable, dynamics: Dynamics) -> Layout:
    """The same signals, whose meaning ends with the rotor they drive and their recipe."""
    made, known = _recipes(model, dynamics), _rotors(dynamics)
    return Layout(
        [
            replace(s, meaning=_joined(s.meaning, known.get(s.name, ""), made.get(s.name, "")))
            for s in layout
        ]
    )


def _recipes(model: Exportable, dynamics: Dynamics) -> dict[str, str]:
    """Those of the training flights; where nobody said what they had, what its vehicle says."""
    if not isinstance(model, IdentifiedModel):
        return {}
    if model.recipes is not None:
        return {name: f"in the logs {text}" for name, text in model.recipes.items()}
    physics = physics_of(dynamics)
    sources = () if physics is None else physics.vehicle.columns.sources.values()
    made = {name: text for source in sources for name, text in recipes(source).items()}
    return {name: f"its vehicle says: in logs {text}" for name, text in made.items()}


def _joined(*texts: str) -> str:
    return "; ".join(text for text in texts if text)


def _rotors(dynamics: Dynamics) -> dict[str, str]:
    """Command -> place and spin of its rotor."""
    physics = physics_of(dynamics)
    if physics is None:
        return {}
    rotors = physics.vehicle.rotors
    return {
        name: f"rotor {abs(x):.3g} m {'forward' if x >= 0 else 'back'}, {abs(y):.3g} m "
        f"{'left' if y >= 0 else 'right'}, "
        f"{'counter-clockwise' if rotor.spin > 0 else 'clockwise'} seen from above"
        for name, rotor in zip(physics.inputs.names, rotors, strict=False)
        for x, y in [rotor.position[:2]]
    }
