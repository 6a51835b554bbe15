"""NAME_flight.h and .c: `pilot_step` with its memory, for whatever autopilot calls it, and a bench
that reads a recording.

A target hands over measurements in the model's columns, units and frames (world ENU, body FLU, SI),
and takes commands. What is not measured is said per column. No malloc, no stdio, and no command
beyond its limits. A sample that fails is predicted without measurements; what no measurement can be
is refused, and the filter starts again from a pose when that lasts.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from greybox.errors import ModelError
from greybox.files import write_atomic
from greybox.symbolic import FloatArray
from mpc_export.c_text import broken
from mpc_export.feedback import NEAR
from mpc_export.functions import ModelFunctions
from mpc_export.model_parts import readings
from mpc_export.readme import plain
from mpc_export.standing import PREFIX
from mpc_export.template import filled, places_in

LASTING = 2.0
"""Seconds after which the pilot says what does not pass."""
BATTERY = "vbat"
BITS = (
    f"1 where for {LASTING:g} s the goal was farther than {NEAR['position']:g} m or the speed "
    f"above {NEAR['velocity']:g} m/s, more than the feedback corrects at a time, and 2 where for "
    "as long a command stood at a limit"
)
"""What the bits of a flight mean."""


@dataclass(frozen=True, kw_only=True, eq=False)
class OnBoard:
    """What a target is written from: functions with the group "pilot", the bundle's name, "double"
    or "float".

    `said` are the target's own words in its files: @KEY@ is replaced.
    """

    functions: ModelFunctions
    name: str
    real: str
    said: Mapping[str, str] = field(default_factory=dict)

    def text(self, template: str, **said: str) -> str:
        """The template of that name with the bundle's words in it."""
        words = (
            {
                "NAME": self.name,
                "UPPER": self.name.upper(),
                "real": f"{self.name}_real",
                "leans": self._leans(),
                "bits": BITS,
                "check": self._check(),
                "commands": self._commands(),
            }
            | dict(self.said)
            | said
        )
        own = places_in(template)
        return filled(template, **{k: v for k, v in words.items() if k in own})

    def _commands(self) -> str:
        """A table of what the commands are, from what the model knows of its rotors and logs."""
        f = self.functions
        lower, upper = f.bounds
        rows = [
            f"| {plain(s.name)} | {low:g} to {high:g} | {plain(s.meaning)} |"
            for s, low, high in zip(f.inputs, lower, upper, strict=True)
        ]
        return "\n".join(["| command | from | what it is |", "|---|---|---|", *rows])

    def _check(self) -> str:
        """How to hold the predictions against a flight that somebody else flew."""
        f, n = self.functions, self.name
        acted = [*f.inputs.names, *f.sampled.exogenous]
        return "\n".join(
            [
                "## The check before the first flight",
                "",
                "Fly large motions about every axis with another controller and write one line a "
                f"sample, nan where nothing was measured: {' '.join(f.outputs.names)}, "
                f"then {' '.join(acted)} as they were given from this sample to the next, "
                f"{f.dt:g} s a sample, with the meaning that "
                "`../README.md` states. Without the commands that flew it is no check.",
                "",
                "```sh",
                "mkdir -p ../build && cd ../build",
                f"cc -std=c99 -O2 -o bench ../c/{n}_bench.c ../c/{n}_flight.c ../c/{n}_model.c "
                f"../c/{n}.c -lm",
                "./bench < flight.csv > predicted.txt",
                "```",
                "",
                "It says of every innovation how many times as large it was as the model states: "
                "about 1 on the craft that was fitted, several times more for motors in another order, "
                "another range of commands, other units or axes. A calm flight looks right with any "
                "order of motors: where two commands exchanged, or one at its mean, look no worse, it "
                "says so and ends with code 2.",
            ]
        )

    def _leans(self) -> str:
        """What the feedback does against forces and torques that stay."""
        there = {n.split(".")[1] for n in self.functions.states.names if n.startswith(PREFIX)}
        known = [kind for kind in ("force", "torque") if kind in there]
        unknown = [kind for kind in ("force", "torque") if kind not in there]
        said = f" that leans against the {' and '.join(known)} it estimates" if known else ""
        missed = f"; nothing holds against a lasting {' or '.join(unknown)}" if unknown else ""
        return said + missed

    def said_of_volts(self) -> str:
        """What is believed of the battery where nobody tells."""
        f = self.functions
        return (
            "Without it every sample takes the mean of the training flights, "
            f"{f.parameter_values[f.parameters[BATTERY]]:.4g} V, and a battery that is lower "
            "reads as a push downwards."
        )

    @property
    def battery(self) -> int | None:
        """Row of p of the battery's voltage, where the model has one."""
        p = self.functions.parameters
        return p[BATTERY] if BATTERY in p.names else None

    def number(self, value: float) -> str:
        """A number as a literal of the bundle's precision: firmware refuses doubles in float
        code."""
        return f"{float(value)!r}{'f' if self.real == 'float' else ''}"

    def array(self, name: str, values: FloatArray) -> str:
        """A constant array, column by column."""
        flat = [self.number(v) for v in np.ravel(values, order="F")] or [self.number(0.0)]
        return f"static const {self.name}_real {name}[{len(flat)}] = {{{', '.join(flat)}}};"

    def measured(self, known: Mapping[str, str], there: Mapping[str, str] | None = None) -> str:
        """C that fills y and there from what a target knows by column; a column that it does not
        know is not there."""
        lines = []
        for i, column in enumerate(self.functions.outputs.names):
            if column in known:
                lines += [
                    f"y[{i}] = {known[column]};  /* {column} */",
                    f"there[{i}] = {(there or {}).get(column, '1')};",
                ]
        return "\n".join(f"  {line}" for line in lines)

    def demand(self, target: str, *, rotors: int, unit: bool) -> None:
        """Raises `ModelError` for more commands than `rotors`, or commands that run beyond 0 to 1
        where they must not."""
        lower, upper = self.functions.bounds
        if len(lower) > rotors or (unit and not ((lower >= 0.0).all() and (upper <= 1.0).all())):
            raise ModelError(
                f"the target {target} is for a model with commands from 0 to 1",
                expected=f"at most {rotors} of them",
                got=f"{', '.join(self.functions.inputs.names)}, {lower.tolist()} to "
                f"{upper.tolist()}",
                fix="fit on what the autopilot sends to the motors, or leave the target out",
            )


POSE = {
    **{axis: f"position.{axis}" for axis in "xyz"},
    **{f"q{axis}": f"attitude.{axis}" for axis in "wxyz"},
}
MOTION = {
    **{f"v{axis}": f"velocity.{axis}" for axis in "xyz"},
    **{column: f"rate.{axis}" for column, axis in zip("pqr", "xyz")},
}
"""States that measured columns are, as they stand: a pose, and what else a start takes over."""


def _starts(f: ModelFunctions) -> dict[str, str]:
    """Words of flight.c: where a start from measurements takes its states from."""
    whole = all(column in f.outputs.names for column in POSE)
    known = (POSE if whole else {}) | MOTION
    pairs = [(f.outputs[c], f.states[s]) for c, s in known.items() if c in f.outputs.names]
    return {
        "pose": str(len(POSE) if whole else 0),
        "starts": str(len(pairs)),
        "start_from": "".join(f"{{{column}, {state}}}, " for column, state in pairs),
    }


def _bounds(board: OnBoard) -> dict[str, str]:
    """Words of flight.h and .c: what they say is judged by."""
    f = board.functions
    return {
        "position": board.number(NEAR["position"]),
        "velocity": board.number(NEAR["velocity"]),
        "near_position": f"{NEAR['position']:g}",
        "near_velocity": f"{NEAR['velocity']:g}",
        "lasting": str(max(1, round(LASTING / f.dt))),
        "filter": "follow_step" if "follow_step" in f.functions else "filter_step",
    }


def _lengths(board: OnBoard) -> str:
    """C that takes away a reading that is too short or too long."""
    out = ""
    for read in readings(board.functions.sampled.dynamics):
        square = " + ".join(f"y[{i}] * y[{i}]" for i in read.columns)
        there = " && ".join(f"given[{i}]" for i in read.columns)
        low, high = (board.number(v**2) for v in (read.shortest, read.longest))
        gone = " = ".join(f"kept[{i}]" for i in read.columns)
        out += (
            f"  if ({there}) {{\n"
            f"    const {board.name}_real square = {square};\n"
            f"    if (square < {low} || square > {high}) {{\n"
            f"      {gone} = 0;\n"
            "      bad = 1;\n"
            "    }\n"
            "  }\n"
        )
    return out


def _bench(f: ModelFunctions) -> dict[str, str]:
    """Words of bench.c: what acts on the model besides its commands, and how errors are named."""
    given = [n for n in f.parameters.names if n in f.sampled.exogenous]
    told = "".join(f"\n       {n} [{f.parameters.units[f.parameters[n]]}]" for n in given)
    whole = _starts(f)["pose"] != "0"
    return {
        "n_u": str(len(f.inputs)),
        "given": told,
        "n_given": str(len(given)),
        "given_rows": "".join(f"{f.parameters[n]}, " for n in given),
        "innovations": ", ".join(
            f'"{n} [{unit}]"' for n, unit in zip(f.innovations.names, f.innovations.units)
        ),
        "commanded": ", ".join(f'"{n}"' for n in f.inputs.names),
        "nowhere": "nan" if whole else "0",
    }


def write_flight(board: OnBoard, folder: Path) -> None:
    """NAME_flight.h, .c and NAME_bench.c beside the generated C in `folder`."""
    f = board.functions
    kinds = f.sampled.dynamics.innovation_columns
    rows = [", ".join(str(int(c in own)) for c in f.outputs.names) for own in kinds]
    lower, upper = f.bounds
    single = board.real == "float"
    words = {
        "hover": "\n".join(
            [
                board.array("hover_x", f.pilot.x),
                board.array("hover_u", np.clip(f.pilot.u, lower, upper)),
            ]
        ),
        "spread": board.array("spread", np.sqrt(np.diag(f.noise.innovation))),
        **_starts(f),
        **_bounds(board),
        "lengths": _lengths(board),
        "columns": ",\n".join(f"  {{{row}}}" for row in rows),
        "parameters": f"  memcpy(f->p, {board.name}_p_identified, sizeof "
        f"{board.name}_p_identified);"
        if len(f.parameters)
        else "  f->p[0] = 0;",
        "cos": "cosf" if single else "cos",
        "sin": "sinf" if single else "sin",
        "atan2": "atan2f" if single else "atan2",
        "half": board.number(0.5),
        "n_y": str(len(f.outputs)),
        "outputs": " ".join(f.outputs.names),
        "inputs": " ".join(f.inputs.names),
        **_bench(f),
    }
    for end, template in (
        ("flight.h", "flight/flight.h"),
        ("flight.c", "flight/flight.c"),
        ("bench.c", "flight/bench.c"),
    ):
        write_atomic(folder / f"{board.name}_{end}", broken(board.text(template, **words)))
