"""A model of the user's own: from the Python program that builds it, and to and from a model file.

A program is code: it runs with the rights of whoever names it. A model file holds no code but the
equations themselves, operation by operation (`greybox.model.expressions`), so that what was fitted
once is read again without the program.
"""

from __future__ import annotations

import hashlib
import math
import sys
from dataclasses import asdict
from pathlib import Path
from types import ModuleType

import casadi as ca

from greybox.errors import FileFormatError, GreyboxError, ModelError, UnknownNameError
from greybox.files import Json, Parsed
from greybox.model.dynamics import Called, StateSpaceModel
from greybox.model.effect_check import failed
from greybox.model.expressions import read_function, write_function
from greybox.model.parameter import Parameter
from greybox.symbolic import Expr, Layout, Signal

LAYOUTS = ("states", "inputs", "outputs")
PARTS = ("dynamics", "measurement")
OPTIONAL = ("initial", "initial_sigma", "sensor_sigma")


def load_own_model(program: str) -> StateSpaceModel:
    """The model that `program`, "own.py:build", makes: a function without arguments that returns a
    `StateSpaceModel`, or such a model itself. The file is run.

    Raises `ModelError` (no such file or name, what the program raises, another result),
    `UnknownNameError`.
    """
    made = run_program(program)
    path, _, name = program.rpartition(":")
    if not isinstance(made, StateSpaceModel):
        if not callable(made):
            raise ModelError(
                f"{name} is not a function", where=path, expected="one that returns the model"
            )
        try:
            made = made()
        except GreyboxError as error:
            raise ModelError(f"{name}(): {error}", where=path) from None
        except Exception as error:
            raise failed(f"{name}()", error, path) from error
    if not isinstance(made, StateSpaceModel):
        raise ModelError(
            f"{name}() returns a {type(made).__name__}",
            where=path,
            expected="a greybox.model.dynamics.StateSpaceModel",
            fix="see docs/own_model.md",
        )
    return made


def run_program(program: str) -> object:
    """What "FILE.py:NAME" names after the file was run. Raises `ModelError`, `UnknownNameError`."""
    path, _, name = program.rpartition(":")
    if not path or not name.isidentifier():
        raise ModelError(
            "no function named",
            where=program,
            expected="FILE.py:FUNCTION",
            fix="--model-file own.py:build",
        )
    module = _module(path)
    made: object = vars(module).get(name)
    if made is None:
        known = [k for k, v in vars(module).items() if callable(v) and not k.startswith("_")]
        raise UnknownNameError("name", name, known, where=path)
    return made


def _module(path: str) -> ModuleType:
    """The program as a module; the same text is run once."""
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise ModelError("no such model program", where=path, fix="check the path") from None
    except (OSError, UnicodeDecodeError) as error:
        reason = (isinstance(error, OSError) and error.strerror) or "not a text file"
        raise ModelError(f"cannot read: {reason}", where=path, fix="name a Python file") from None
    name = f"greybox_model_{hashlib.sha256(text.encode()).hexdigest()[:16]}"
    if name in sys.modules:
        return sys.modules[name]
    module = ModuleType(name)
    module.__file__ = path
    sys.modules[name] = module  # classes look for their module while they are made
    try:
        exec(compile(text, path, "exec"), module.__dict__)
    except SyntaxError as error:
        del sys.modules[name]
        raise ModelError(f"not valid Python: {error.msg}", where=f"{path}:{error.lineno}") from None
    except Exception as error:
        del sys.modules[name]
        raise failed("running the file", error, path) from error
    return module


def own_to_dict(model: StateSpaceModel) -> dict[str, Json]:
    """Declarations and equations of the model as plain values."""
    t, x, u, p = _symbols(model)
    equations = (model.f(t, x, u, p), model.h(t, x, u, p))
    return {
        "name": model.name,
        **{part: [vars(s) for s in getattr(model, part)] for part in LAYOUTS},
        "parameters": [_plain(d) for d in model.parameters],
        **{
            part: write_function(ca.Function(part, [t, x, u, p], [value]))
            for part, value in zip(PARTS, equations, strict=True)
        },
        "noise_states": list(model.noises.names),
        "discrete": model.discrete,
        "substeps": model.substeps,
        **{k: dict(v) if (v := getattr(model, k)) is not None else None for k in OPTIONAL},
    }


def _symbols(model: StateSpaceModel) -> tuple[Expr, Expr, Expr, Expr]:
    return (
        ca.SX.sym("t"),
        ca.SX.sym("x", len(model.states)),
        ca.SX.sym("u", len(model.inputs)),
        ca.SX.sym("p", len(model.parameters)),
    )


def _plain(declaration: Parameter) -> dict[str, Json]:
    """Without what is not finite, which JSON does not have and is the default."""
    return {
        k: v for k, v in asdict(declaration).items() if not isinstance(v, float) or math.isfinite(v)
    }


def own_from_dict(data: Parsed, *, where: str = "model") -> StateSpaceModel:
    """The model of a file. Raises `FileFormatError` for what `own_to_dict` did not write."""
    try:
        parameters = tuple(Parameter(**d) for d in data["parameters"])
        layouts = {part: Layout([Signal(**s) for s in data[part]]) for part in LAYOUTS}
        functions = {part: read_function(part, data[part]) for part in PARTS}
        for part, size in (("dynamics", "states"), ("measurement", "outputs")):
            shapes = [functions[part].numel_in(i) for i in range(functions[part].n_in())]
            wanted = [1, len(layouts["states"]), len(layouts["inputs"]), len(parameters)]
            if shapes != wanted or functions[part].numel_out(0) != len(layouts[size]):
                raise ValueError(f"{part} takes {shapes}, expected {wanted}")
        order = tuple(d.name for d in parameters)
        return StateSpaceModel(
            name=str(data["name"]),
            states=layouts["states"],
            inputs=layouts["inputs"],
            outputs=layouts["outputs"],
            parameters=parameters,
            dynamics=Called(functions["dynamics"], order),
            measurement=Called(functions["measurement"], order),
            noise_states=tuple(data["noise_states"]),
            discrete=bool(data["discrete"]),
            substeps=int(data["substeps"]),
            initial=_numbers(data["initial"]),
            initial_sigma=_numbers(data["initial_sigma"]),
            sensor_sigma=_numbers(data["sensor_sigma"]),
        )
    except (KeyError, TypeError, ValueError, IndexError, RuntimeError) as error:
        if isinstance(error, GreyboxError) and not isinstance(error, ModelError):
            raise
        raise FileFormatError(
            f"incomplete or wrong ({error})", where=where, fix="write the file again"
        ) from None


def _numbers(values: Parsed | None) -> dict[str, float] | None:
    return None if values is None else {str(k): float(v) for k, v in values.items()}


def same_model(one: StateSpaceModel, other: StateSpaceModel) -> bool:
    """Whether two models have the same declarations and equations."""
    return own_to_dict(one) == own_to_dict(other)
