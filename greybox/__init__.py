"""Grey-box identification of small multirotors: physics by the prediction error method, with honest
error bars.

README.md has the scripting interface in twelve lines. The public names stand in `__init__.pyi`, and
in `__all__` and `dir(greybox)`; everything is loaded on first use, so that `import greybox` is
quick.
"""

from __future__ import annotations

import ast
import importlib
import pkgutil
import sys
import warnings

from greybox.distribution import VERSION


def _declared() -> dict[str, str]:
    """Public name -> the module that holds it, from the imports of the stub."""
    stub = pkgutil.get_data(__name__, "__init__.pyi") or b""
    imports = (node for node in ast.parse(stub).body if isinstance(node, ast.ImportFrom))
    return {a.name: str(node.module) for node in imports for a in node.names}


_PUBLIC = _declared()
__version__ = VERSION
__all__ = sorted(_PUBLIC)

_MOVED = {
    "Dataset": "greybox.data",
    "Fit": "greybox.estimation.fit",
    "Flight": "greybox.data",
    "GreyboxError": "greybox.errors",
    "IdentifiedModel": "greybox.model.identified",
    "Layout": "greybox.symbolic",
    "Parameter": "greybox.model.parameter",
    "ParameterValues": "greybox.model.parameter",
    "PhysicsModel": "greybox.model.model",
    "Segment": "greybox.data",
    "Signal": "greybox.symbolic",
    "StateSpaceModel": "greybox.model.dynamics",
    "Vehicle": "greybox.model.vehicle",
    "check_vehicle": "greybox.model.plausibility",
    "fit_report": "greybox.report.fit_report",
    "inspect_log": "greybox.data.inspection",
    "load_effects": "greybox.model.effects_file",
    "load_model": "greybox.residual.files",
    "read_log": "greybox.data.logs",
    "save_model": "greybox.residual.files",
    "vehicle_findings": "greybox.model.plausibility",
}
"""Names that were public before 0.1.0; they go with 0.2.0."""


def __getattr__(name: str) -> object:
    if name in _PUBLIC:
        module = _PUBLIC[name]
        if module == __name__:
            value: object = importlib.import_module(f"{__name__}.{name}")
        else:
            value = getattr(importlib.import_module(module), name)
    elif name in _MOVED:
        module = _MOVED[name]
        warnings.warn(
            f"greybox.{name} goes with 0.2.0; use: from {module} import {name}",
            DeprecationWarning,
            stacklevel=2,
        )
        value = getattr(importlib.import_module(module), name)
    else:
        raise AttributeError(
            f"module 'greybox' has no attribute '{name}'", name=name, obj=sys.modules[__name__]
        )
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
