"""greybox twin MODEL.json --out DIR: an identified model as files of the simulators that people
use, with what each of them folds or loses."""

from __future__ import annotations

import argparse
import sys
from typing import Any

NAMES = (
    "numpy",
    "jax",
    "rotorpy",
    "mujoco",
    "crazyflow",
    "drone-models",
    "pybullet",
    "gazebo",
    "px4",
    "isaac",
)


def add(commands: Any) -> None:
    """Add the subcommand."""
    p = commands.add_parser(
        "twin",
        help="write a fitted model as files of simulators",
        description="Write a fitted model as files of simulators, and say of every effect whether "
        "the simulator says it, folds it into something else, or loses it, with the size of what "
        "is lost over the training flights. Existing files are kept unless --force is given. Exit "
        "code 0: done, 1: refused, as the model is not usable, 2: bad input.",
    )
    p.add_argument("model", metavar="MODEL.json", help="model file of fit, discover or learn")
    p.add_argument("--out", required=True, metavar="DIR", help="folder to write to")
    p.add_argument(
        "--target",
        default="",
        metavar="T,...",
        help=f"some of {', '.join(NAMES)} (default: all that can express the craft)",
    )
    p.add_argument("--force", action="store_true", help="write over existing files")
    p.add_argument(
        "--effects-file",
        nargs="+",
        default=[],
        metavar="E.py",
        help="effects of your own in the model",
    )
    p.add_argument(
        "--even-so", action="store_true", help="go on although the model was judged not usable"
    )
    p.add_argument("--json", metavar="FILE", help="write the statement; - for standard output")
    p.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Read, judge, write, say what is left out. Returns 0, or 1 where the model is not usable."""
    from greybox.commands.judgement import gate
    from greybox.errors import UnknownNameError
    from greybox.files import dump_json, read_json, write_json
    from greybox.model.effects_file import load_effects
    from greybox.residual.files import load_model
    from greybox.twin.make import twin

    names = tuple(n.strip() for n in arguments.target.split(",") if n.strip())
    for name in names:
        if name not in NAMES:
            raise UnknownNameError("target", name, NAMES)
    own = [e for path in arguments.effects_file for e in load_effects(path)]
    model = load_model(arguments.model, effects=own)
    judged = gate(read_json(arguments.model), arguments.model, even_so=arguments.even_so)
    judged.say("twin")
    if not judged.open:
        return 1
    made = twin(model, names, out=arguments.out, force=arguments.force)
    if arguments.json == "-":
        sys.stdout.write(dump_json(made.to_dict()))
        return 0
    print(made.summary())
    print(f"\nwritten: {len(made.files) + 1} files in {arguments.out}")
    if arguments.json:
        write_json(arguments.json, made.to_dict())
    return 0
