"""Targets of an export besides C and CasADi: what each adds to a bundle.

    python/consumers/   exported.py, hover.py and the file of each target: casadi, numpy and the target's package
    examples/           one script per target that runs with the bundle and that package alone
    fmu/                NAME.fmu
    tube/               the tube MPC as one C library: mpc_export/tube/target.py
    crazyflie/, px4/, ros2/   code around c/ that an autopilot builds: mpc_export/onboard

| target | needs | example |
|---|---|---|
| acados | acados (its wheel will do), a C compiler | acados_hover.py |
| do-mpc | do-mpc | do_mpc_hover.py |
| rockit | rockit-meco | rockit_hover.py |
| l4acados | nothing more; the group "nominal" | l4acados_hover.py |
| fmu | to simulate: fmpy | fmu_simulate.py |
| tube | nothing more; a model of an aircraft | tube/NAME_tube_selftest.c |
| crazyflie-app, px4-module, ros2 | the target "c", the group "pilot", the autopilot's sources | c/NAME_bench.c |

A new one is an entry of `TARGETS`, and its name in greybox/commands/export.py.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Protocol

from greybox.errors import ModelError, UnknownNameError
from greybox.files import write_atomic
from mpc_export.acados import explicit_difference
from mpc_export.exported import Exported, of
from mpc_export.fmu import write_fmu
from mpc_export.functions import ModelFunctions
from mpc_export.onboard import crazyflie_app, px4_module, ros2
from mpc_export.onboard.flight import OnBoard, write_flight
from mpc_export.tube.target import PLANNING, Planning, write_target_tube

if TYPE_CHECKING:
    from mpc_export.manifest import TargetPart

COMMON = ("exported", "hover")
"""Modules that every consumer takes."""
PACKAGE = (
    '"""What this bundle\'s model looks like to controllers; see the scripts in examples/."""\n'
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    """What a target is written from: `name` is the bundle's, `real` the precision of its C, `plan`
    what is chosen of the tube."""

    functions: ModelFunctions
    name: str
    real: Literal["double", "float"] = "double"
    plan: Planning = PLANNING


class Target(Protocol):
    """What can be added to a bundle."""

    @property
    def needs(self) -> tuple[str, ...]:
        """Groups of functions that it cannot do without."""

    @property
    def around_c(self) -> bool:
        """Whether it builds around the target "c"."""

    def write(self, part: Part, folder: Path) -> TargetPart:
        """Add it to the bundle in `folder`; what the manifest says of it. Raises `ModelError` for a
        model that it cannot take."""
        ...


More = Callable[[Exported, str, Path], "TargetPart"]


@dataclass(frozen=True, kw_only=True)
class Consumer:
    """A package that computes with the functions: a script of mpc_export/examples, a `module` of
    mpc_export where it takes one, and what it adds besides to (model, name, folder)."""

    example: str
    module: str = ""
    needs: tuple[str, ...] = ()
    more: More = lambda _model, _name, _folder: {}
    around_c: bool = False

    def write(self, part: Part, folder: Path) -> TargetPart:
        """python/consumers, examples and what `more` adds."""
        said = self.more(of(part.functions, part.name), part.name, folder)
        consumers = folder / "python" / "consumers"
        write_atomic(consumers / "__init__.py", PACKAGE)
        for module in filter(None, (*COMMON, self.module)):
            write_atomic(consumers / f"{module}.py", _text("mpc_export", module))
        example = f"examples/{self.example}.py"
        write_atomic(folder / example, _text("mpc_export.examples", self.example))
        return {"example": example, **said}


@dataclass(frozen=True, kw_only=True)
class Autopilot:
    """Code around c/ that an autopilot builds, by the function of mpc_export/onboard that writes
    it."""

    around: Callable[[OnBoard, Path], TargetPart]
    needs: tuple[str, ...] = ("pilot",)
    around_c: bool = True

    def write(self, part: Part, folder: Path) -> TargetPart:
        """The pilot with its memory in c/, and what is around it."""
        board = OnBoard(functions=part.functions, name=part.name, real=part.real)
        write_flight(board, folder / "c")
        return self.around(board, folder)


@dataclass(frozen=True, kw_only=True)
class Tube:
    """The tube MPC as one C library."""

    linear: bool
    needs: tuple[str, ...] = ()
    around_c: bool = False

    def write(self, part: Part, folder: Path) -> TargetPart:
        """The folder tube, or tube_linear."""
        plan = replace(part.plan, linear=self.linear)
        return write_target_tube(part.functions, folder, part.name, part.real, plan)


def _delay(model: Exported, _name: str, _folder: Path) -> TargetPart:
    return {"f_expl_difference": explicit_difference(model)} if "f" in model else {}


def _fmu(model: Exported, name: str, folder: Path) -> TargetPart:
    return write_fmu(model, folder / "fmu" / f"{name}.fmu")


def _learned(model: Exported, _name: str, _folder: Path) -> TargetPart:
    if "f_d_nominal" not in model:
        raise ModelError(
            "the target l4acados is for a model with a learned part",
            fix="leave it out, or export --with nominal",
        )
    return {}


CONSUMERS: Mapping[str, Consumer] = {
    "acados": Consumer(example="acados_hover", module="acados", more=_delay),
    "do-mpc": Consumer(example="do_mpc_hover", module="do_mpc"),
    "rockit": Consumer(example="rockit_hover", module="rockit"),
    "l4acados": Consumer(
        example="l4acados_hover", module="l4acados", needs=("nominal",), more=_learned
    ),
    "fmu": Consumer(example="fmu_simulate", more=_fmu),
}
ONBOARD: Mapping[str, Autopilot] = {
    own.TARGET: Autopilot(around=own.write) for own in (crazyflie_app, px4_module, ros2)
}
TUBES: Mapping[str, Tube] = {"tube": Tube(linear=False), "tube-linear": Tube(linear=True)}
TARGETS: Mapping[str, Target] = {**CONSUMERS, **ONBOARD, **TUBES}


def write_target(
    target: str,
    functions: ModelFunctions,
    folder: Path,
    name: str,
    real: Literal["double", "float"] = "double",
    plan: Planning = PLANNING,
) -> TargetPart:
    """Add a target to the bundle in `folder`; the rest as in `Part`. Returns what the manifest says
    of it.

    Raises `UnknownNameError`, and `ModelError` for a model that the target cannot take.
    """
    if target not in TARGETS:
        raise UnknownNameError("export target", target, TARGETS)
    part = Part(functions=functions, name=name, real=real, plan=plan)
    return TARGETS[target].write(part, folder)


def _text(package: str, module: str) -> str:
    return resources.files(package).joinpath(f"{module}.py").read_text(encoding="utf-8")
