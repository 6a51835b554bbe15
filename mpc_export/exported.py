"""Exported: a model as its consumers see it: named CasADi functions, the order of everything, and
typical numbers.

    model = load("my_bundle")                 # from a bundle: casadi and numpy, nothing else
    x_next = model["f_d"](x, u, p)

This file and the consumers beside it (acados.py, do_mpc.py, ...) import neither greybox nor
mpc_export: a bundle carries them in python/consumers/.
"""

from __future__ import annotations

import importlib.util
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from mpc_export.functions import ModelFunctions

Array = npt.NDArray[np.float64]
Expr = Any
"""A CasADi expression or numbers: CasADi has no type for both."""
HISTORY = "history."


@dataclass(frozen=True, kw_only=True, eq=False)
class Exported:
    """Functions by name (the table of docs/bundle.md) and what belongs to them; all orders are
    those of the functions.

    `states` are the model's own (`own_states` of them) and then the command history
    `history.<input>.<samples ago>`. `parameter_values` (n_p,) are the identified values of p,
    (`reference_state`, `reference_inputs`) a typical point, `lower` and `upper` (n_u,) the bounds
    of the commands (infinite where there is none), the scales typical sizes.
    """

    name: str
    dt: float
    functions: Mapping[str, ca.Function]
    states: tuple[str, ...]
    error_states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    parameters: tuple[str, ...]
    units: Mapping[str, str]
    own_states: int
    parameter_values: Array
    reference_state: Array
    reference_inputs: Array
    lower: Array
    upper: Array
    state_scale: Array
    input_scale: Array

    def __getitem__(self, name: str) -> ca.Function:
        if name not in self.functions:
            raise ValueError(
                f"{self.name} has no function {name}; it has {', '.join(self.functions)}"
            )
        return self.functions[name]

    def __contains__(self, name: str) -> bool:
        return name in self.functions

    def with_history(self, own: Expr, u: Expr) -> Expr:
        """The state (n_x) whose own part is `own` and whose commands have all been `u` for long."""
        past = [
            self.inputs.index(n.removeprefix(HISTORY).rpartition(".")[0])
            for n in self.states[self.own_states :]
        ]
        return ca.vertcat(own, *(u[i] for i in past))


def of(functions: ModelFunctions, name: str) -> Exported:
    """The consumer's view of a `mpc_export.functions.ModelFunctions`."""
    layouts = (functions.states, functions.inputs, functions.outputs, functions.parameters)
    return Exported(
        name=name,
        dt=functions.dt,
        functions=dict(functions.functions),
        states=tuple(functions.states.names),
        error_states=tuple(functions.error_states.names),
        inputs=tuple(functions.inputs.names),
        outputs=tuple(functions.outputs.names),
        parameters=tuple(functions.parameters.names),
        units={s.name: s.unit for layout in layouts for s in layout},
        own_states=functions.own_states,
        parameter_values=functions.parameter_values,
        reference_state=functions.reference[0],
        reference_inputs=functions.reference[1],
        lower=functions.bounds[0],
        upper=functions.bounds[1],
        state_scale=functions.scales[0],
        input_scale=functions.scales[1],
    )


def load(bundle: str | Path, names: Iterable[str] | None = None) -> Exported:
    """The model of a bundle, rebuilt by the interpreter inside it; `names` limits it to some
    functions.

    Raises `FileNotFoundError` for a folder that is no bundle.
    """
    folder = Path(bundle)
    manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
    spec = importlib.util.spec_from_file_location(
        "greybox_rebuild", folder / "python" / "rebuild.py"
    )
    if spec is None or spec.loader is None:
        raise FileNotFoundError(f"{folder}: no python/rebuild.py")
    rebuild = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(rebuild)

    def column(table: str, key: str, missing: float = math.nan) -> Array:
        return np.array(
            [missing if row[key] is None else row[key] for row in manifest[table]], dtype=float
        )

    def named(table: str) -> tuple[str, ...]:
        return tuple(row["name"] for row in manifest[table])

    tables = ("states", "inputs", "outputs", "parameters")
    return Exported(
        name=manifest["name"],
        dt=float(manifest["sample_time"]),
        functions=rebuild.load(folder / "python", names),
        states=named("states"),
        error_states=named("error_states"),
        inputs=named("inputs"),
        outputs=named("outputs"),
        parameters=named("parameters"),
        units={row["name"]: row["unit"] for t in tables for row in manifest[t]},
        own_states=int(manifest["sizes"]["own_states"]),
        parameter_values=column("parameters", "value"),
        reference_state=column("states", "reference"),
        reference_inputs=column("inputs", "reference"),
        lower=column("inputs", "lower", -math.inf),
        upper=column("inputs", "upper", math.inf),
        state_scale=column("states", "scale"),
        input_scale=column("inputs", "scale"),
    )
