"""Grey-box identification of small multirotors: physics by the prediction error method, with honest error bars.

README.md has the scripting interface in twelve lines. Everything is loaded on first use: `import greybox` is quick.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

_PUBLIC = {
    "read_log": "greybox.data.logs",
    "read_logs": "greybox.data.logs",
    "inspect_log": "greybox.data.inspection",
    "Dataset": "greybox.data",
    "Flight": "greybox.data",
    "Segment": "greybox.data",
    "dataset_from_arrays": "greybox.data",
    "check": "greybox.data.checks",
    "read_vehicle": "greybox.model.vehicle",
    "Vehicle": "greybox.model.vehicle",
    "check_vehicle": "greybox.model.plausibility",
    "vehicle_findings": "greybox.model.plausibility",
    "build_model": "greybox.model.model",
    "load_effects": "greybox.model.effects_file",
    "PhysicsModel": "greybox.model.model",
    "StateSpaceModel": "greybox.model.dynamics",
    "Parameter": "greybox.model.parameter",
    "ParameterValues": "greybox.model.parameter",
    "Layout": "greybox.symbolic",
    "Signal": "greybox.symbolic",
    "IdentifiedModel": "greybox.model.identified",
    "load": "greybox.commands.front_door",
    "load_model": "greybox.residual.files",
    "save_model": "greybox.residual.files",
    "learn": "greybox.residual.learn",
    "from_gpytorch": "greybox.residual.from_gpytorch",
    "discover": "greybox.discovery.workflow",
    "plan": "greybox.planning.plan",
    "fit": "greybox.automatic",
    "Fit": "greybox.estimation.fit",
    "validate": "greybox.validation.validate",
    "fit_linear": "greybox.estimation.linear.fit",
    "profile": "greybox.commands.front_door",
    "compare": "greybox.commands.front_door",
    "frf": "greybox.commands.front_door",
    "export": "greybox.commands.front_door",
    "identify": "greybox.commands.chain.front_door",
    "fit_report": "greybox.report.fit_report",
    "twin": "greybox.simulators.make",
    "GreyboxError": "greybox.errors",
    "examples": "greybox.examples",
}

__all__ = [
    "Dataset",
    "Fit",
    "Flight",
    "GreyboxError",
    "IdentifiedModel",
    "Layout",
    "Parameter",
    "ParameterValues",
    "PhysicsModel",
    "Segment",
    "Signal",
    "StateSpaceModel",
    "Vehicle",
    "build_model",
    "check",
    "check_vehicle",
    "compare",
    "dataset_from_arrays",
    "discover",
    "examples",
    "export",
    "fit",
    "fit_linear",
    "fit_report",
    "frf",
    "from_gpytorch",
    "identify",
    "inspect_log",
    "learn",
    "load",
    "load_effects",
    "load_model",
    "plan",
    "profile",
    "read_log",
    "read_logs",
    "read_vehicle",
    "save_model",
    "twin",
    "validate",
    "vehicle_findings",
]

if TYPE_CHECKING:
    from greybox import examples
    from greybox.automatic import fit
    from greybox.commands.chain.front_door import identify
    from greybox.commands.front_door import compare, export, frf, load, profile
    from greybox.data import Dataset, Flight, Segment, dataset_from_arrays
    from greybox.data.checks import check
    from greybox.data.inspection import inspect_log
    from greybox.data.logs import read_log, read_logs
    from greybox.discovery.workflow import discover
    from greybox.errors import GreyboxError
    from greybox.estimation.fit import Fit
    from greybox.estimation.linear.fit import fit_linear
    from greybox.model.dynamics import StateSpaceModel
    from greybox.model.effects_file import load_effects
    from greybox.model.identified import IdentifiedModel
    from greybox.model.model import PhysicsModel, build_model
    from greybox.model.parameter import Parameter, ParameterValues
    from greybox.model.plausibility import check_vehicle, vehicle_findings
    from greybox.model.vehicle import Vehicle, read_vehicle
    from greybox.planning.plan import plan
    from greybox.report.fit_report import fit_report
    from greybox.residual.files import load_model, save_model
    from greybox.residual.from_gpytorch import from_gpytorch
    from greybox.residual.learn import learn
    from greybox.simulators.make import twin
    from greybox.symbolic import Layout, Signal
    from greybox.validation.validate import validate


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        module = importlib.import_module(_PUBLIC[name])
        value = module if module.__name__ == f"greybox.{name}" else getattr(module, name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'greybox' has no attribute '{name}'")


def __dir__() -> list[str]:
    return [*globals(), *_PUBLIC]
