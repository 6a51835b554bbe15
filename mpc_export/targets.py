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
"""

from __future__ import annotations

from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Literal, cast

from greybox.errors import ModelError, UnknownNameError
from greybox.files import write_atomic
from mpc_export.acados import explicit_difference
from mpc_export.exported import of
from mpc_export.fmu import write_fmu
from mpc_export.functions import ModelFunctions
from mpc_export.onboard import crazyflie_app, px4_module, ros2
from mpc_export.onboard.flight import OnBoard, write_flight
from mpc_export.tube.target import PLANNING, Planning, write_target_tube

if TYPE_CHECKING:
    from mpc_export.manifest import TargetPart


COMMON = ("exported", "hover")
MODULES = {
    "acados": "acados",
    "do-mpc": "do_mpc",
    "rockit": "rockit",
    "l4acados": "l4acados",
    "fmu": "",
}
EXAMPLES = {
    "acados": "acados_hover",
    "do-mpc": "do_mpc_hover",
    "rockit": "rockit_hover",
    "l4acados": "l4acados_hover",
    "fmu": "fmu_simulate",
}
ONBOARD = {own.TARGET: own.write for own in (crazyflie_app, px4_module, ros2)}
NEEDS = {"l4acados": ("nominal",)} | dict.fromkeys(ONBOARD, ("pilot",))
"""Groups of functions that a target cannot do without."""
TUBES = {"tube": False, "tube-linear": True}
"""Which of them is linear."""
NAMES = (*EXAMPLES, *ONBOARD, *TUBES)
PACKAGE = (
    '"""What this bundle\'s model looks like to controllers; see the scripts in examples/."""\n'
)


def write_target(
    target: str,
    functions: ModelFunctions,
    folder: Path,
    name: str,
    real: Literal["double", "float"] = "double",
    plan: Planning = PLANNING,
) -> TargetPart:
    """Add a target to the bundle in `folder`; `name` is the bundle's, `real` the precision of its
    C, `plan` what is chosen of the tube. Returns what the manifest says of it.

    Raises `UnknownNameError`, and `ModelError` for a model that the target cannot take.
    """
    if target not in NAMES:
        raise UnknownNameError("export target", target, NAMES)
    if target in ONBOARD:
        board = OnBoard(functions=functions, name=name, real=real)
        write_flight(board, folder / "c")
        return ONBOARD[target](board, folder)
    if target in TUBES:
        plan = replace(plan, linear=TUBES[target])
        return cast("TargetPart", write_target_tube(functions, folder, name, real, plan))
    model = of(functions, name)
    said: TargetPart = {"example": f"examples/{EXAMPLES[target]}.py"}
    if target == "fmu":
        said.update(write_fmu(model, folder / "fmu" / f"{name}.fmu"))
    if target == "l4acados" and "f_d_nominal" not in model:
        raise ModelError(
            "the target l4acados is for a model with a learned part",
            fix="leave it out, or export --with nominal",
        )
    if target == "acados" and "f" in model:
        said["f_expl_difference"] = explicit_difference(model)
    consumers = folder / "python" / "consumers"
    write_atomic(consumers / "__init__.py", PACKAGE)
    for module in (*COMMON, MODULES[target]):
        if module:
            write_atomic(consumers / f"{module}.py", _text("mpc_export", module))
    write_atomic(
        folder / "examples" / f"{EXAMPLES[target]}.py",
        _text("mpc_export.examples", EXAMPLES[target]),
    )
    return said


def _text(package: str, module: str) -> str:
    return resources.files(package).joinpath(f"{module}.py").read_text(encoding="utf-8")
