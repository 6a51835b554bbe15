"""The target `tube` of an export: the library of a controller of its own, with its self-test and
README."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from greybox.errors import ModelError
from greybox.files import write_atomic
from greybox.model.identified import IdentifiedModel
from mpc_export.c_code import Real, single_precision
from mpc_export.c_text import broken
from mpc_export.functions import ModelFunctions
from mpc_export.tube.controller import TubeController
from mpc_export.tube.in_process import TubeInC
from mpc_export.tube.library import Still, braced, filled_with, flight, matrix, write_library
from mpc_export.tube.problem import TubeProblem
from mpc_export.tube.stopping import stopping
from mpc_export.tube.told import PRESENT
from mpc_export.tube.trusted import TRUSTED

if TYPE_CHECKING:
    from mpc_export.manifest import TargetPart

AGREE: dict[Real, float] = {"double": 1e-5, "float": 1e-3}
"""Largest difference of commands from Python's in the self-test."""
SAMPLES = 60
"""Samples of the self-test."""
SAID = {
    False: ("tube MPC", "Python's", "the one before with the ancillary gain"),
    True: (
        "linear tube MPC",
        "those in double",
        "what was found, clipped to its limits, or the gain about the path",
    ),
}
"""Of the README: what it is, whose commands it is compared with, what flies without a plan."""
FAR = (
    f"\n`{{}}_TUBE_FAR_FROM_HOVER` says when tilt, speed and rate take the prediction more than {TRUSTED:g}\n"
    "standard deviation of the tube away from the model's own: then limits are not kept as stated.\n"
)
"""Of the README of the linear tube."""
KNOWN = (
    "\nRun-time parameters ({told}): `{name}_tube_parameter(i, value)` tells the present value, as\n"
    f"often as it is measured. {PRESENT:g} s after the last, `{{upper}}_TUBE_NOT_TOLD` is said and the value follows\n"
    "the push along the thrust, so that hover holds while a battery empties. A value with which the model\n"
    "cannot hover is not taken (`{upper}_TUBE_REFUSED`); beyond the training range it is (`{upper}_TUBE_UNTRAINED`).\n"
)
"""Of the README of a model with run-time parameters."""
STEP, KAPPA = 0.02, 2.81
"""Of the target: sample time of the plan, to whole samples of the model [s]; standard deviations of
the tube (10 % a flight that touches 40 limits)."""
LONGER_STEP = 0.05
"""Sample time of a plan of the linear tube [s]: five stages reach a quarter of a second."""
HORIZONS, CHIPS = {False: 10, True: 5}, {False: "Cortex-M7", True: "Cortex-M4F"}
"""Stages of the plan of the target tube, and of the linear one: as many as these chips carry. What
stopping takes is said where it is more (stopping.py)."""


@dataclass(frozen=True, kw_only=True)
class Planning:
    """What is chosen of the target: stages of the plan (None: `HORIZONS`), attempts at it in one
    step, and whether it is the linear tube."""

    horizon: int | None = None
    attempts: int = 1
    linear: bool = False

    @property
    def stages(self) -> int:
        """Stages of the plan."""
        return HORIZONS[self.linear] if self.horizon is None else self.horizon


PLANNING = Planning()


def pilot_of(functions: ModelFunctions, plan: Planning) -> TubeController:
    """The controller that the target exports: limits five hundredths of their range inside those of
    the model's commands, back-offs of KAPPA standard deviations. Raises `ModelError`."""
    model = functions.model
    lower, upper = functions.bounds
    if not isinstance(model, IdentifiedModel):
        raise ModelError("the target tube is for a model of an aircraft", got=functions.name)
    if not (len(lower) and np.isfinite(lower).all() and np.isfinite(upper).all()):
        raise ModelError(
            f"{functions.name} has commands without limits",
            fix="speed_max of the actuator in the vehicle file",
        )
    if plan.linear and plan.attempts > 1:
        raise ModelError(
            "the linear tube has one attempt at a plan",
            got=f"{plan.attempts} attempts",
            fix="leave --attempts out, or export the other tube by itself",
        )
    low, high = float(lower.max()), float(upper.min())
    step = LONGER_STEP if plan.linear else STEP
    problem = TubeProblem(
        dt=model.sample_time * max(1, round(step / model.sample_time)),
        horizon=plan.stages,
        planes=2 if plan.linear else 4,
        attempts=plan.attempts,
        command_min=low + 0.05 * (high - low),
        command_max=high - 0.05 * (high - low),
        rate_max=0.25 * (high - low),
    )
    return TubeController(
        model=model,
        problem=problem,
        reference=Still((0.0, 0.0, 0.0, 0.0)),
        kappa=[KAPPA] * (problem.planes + 1),
    )


def write_target_tube(
    functions: ModelFunctions, folder: Path, name: str, real: Real, plan: Planning
) -> TargetPart:
    """The library in folder/tube, or tube_linear. Returns what the manifest says of it."""
    own = "tube_linear" if plan.linear else "tube"
    pilot = pilot_of(functions, plan)
    write_tube(pilot, folder / own, name=name, real=real, linear=plan.linear)
    said, stops = too_short(pilot, plan), stopping(pilot)
    return {
        "folder": own,
        "horizon": plan.stages,
        "stops_from": None if stops is None else stops.speed,
        **({"note": said} if said else {}),
        **({} if plan.linear else {"attempts": plan.attempts}),
        "selftest": f"{own}/{name}_tube_selftest.c",
    }


def too_short(pilot: TubeController, plan: Planning) -> str:
    """What there is to say of a plan that cannot stop from the speed of the training; "" of one that
    can."""
    stops = stopping(pilot)
    if stops is None or stops.trained is None or stops.speed >= stops.trained:
        return ""
    stages, most = stops.needed(stops.trained, pilot.problem.dt), HORIZONS[plan.linear]
    return (
        f"{'tube-linear' if plan.linear else 'tube'}: {stops.seconds:.2g} s are too short to stop at "
        f"a plane from the trained {stops.trained:.2g} m/s: --horizon {stages} (a "
        f"{CHIPS[plan.linear]} carries {most}), or no faster than {stops.speed:.2g} m/s"
    )


def write_tube(
    pilot: TubeController, folder: Path, *, name: str, real: Real = "float", linear: bool = False
) -> tuple[Path, ...]:
    """Write the library of `pilot` into `folder`, with its README; returns its C files, the
    self-test last. linear: the linear tube (linear.py).

    Raises `ModelError` for a controller that calibrates, adapts or has no planes: those stay on a
    desktop.
    """
    files, words = write_library(pilot, folder, name=name, real=real, linear=linear)
    words |= {"samples": str(SAMPLES), "tolerance": repr(AGREE[real])}
    words |= dict(zip(("kind", "whose", "instead"), SAID[linear], strict=True))
    words["range"] = FAR.format(name.upper()) if linear else ""
    words["known"] = (
        KNOWN.format(**words, name=name, upper=name.upper()) if pilot.estimator.told.own else ""
    )
    stops = stopping(pilot)
    words["stops"] = "a speed that nothing says" if stops is None else f"{stops.speed:.2g} m/s"
    selftest = folder / f"{name}_tube_selftest.c"
    write_atomic(selftest, _selftest(pilot, words, real, linear))
    write_atomic(folder / "README.md", filled_with("tube/README.md", words))
    return *files, selftest


def _selftest(pilot: TubeController, words: Mapping[str, str], real: Real, linear: bool) -> str:
    kept = pilot.reference, pilot.planes
    place = (0.1, -0.2, 1.0, 0.3)
    pilot.reference, pilot.planes = Still(place), None
    try:
        if linear:
            # Python has no other: the commands are those in double
            with tempfile.TemporaryDirectory() as folder:
                library = TubeInC(pilot, Path(folder), real="double", linear=True)
                flown = flight(pilot, SAMPLES, flown=library)
        else:
            flown = flight(pilot, SAMPLES)
        pilot.start()
    finally:
        pilot.reference, pilot.planes = kept
    numbers = f"static const {real}"
    missing = matrix(flown["measured"]).replace("nan", "NAN")
    told = braced([*(one.reference for one in pilot.estimator.told.own), 0.0])
    data = [
        f"{numbers} place[4] = {braced(place)}, goal[4] = {braced(place)};",
        f"{numbers} lowest = {words['low']}, highest = {words['high']}, rate = {words['rate']};",
        f"{numbers} told[{words['UPPER']}_TUBE_N_P + 1] = {told};",
        f"{numbers} measured[SAMPLES][NY] = {missing};",
        f"{numbers} wanted[SAMPLES][NU] = {matrix(flown['commands'])};",
    ]
    text = filled_with("tube/selftest.c", {**words, "data": "\n".join(data)})
    return broken(single_precision(text) if real == "float" else text)
