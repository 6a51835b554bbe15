"""ExportBundle: one folder that holds everything a controller needs of a model, and nothing of
greybox.

    manifest.json     what it is: signal order, units, frames, sample time, bounds, values, covariance, sizes, checksums
    README.md         ordering tables and the two lines that build and run the self-test
    c/                generated functions, readable wrapper, self-test, CMakeLists.txt, pkg-config file, C++ example
    python/           rebuild.py with functions.json and functions.npz: the CasADi functions from numbers alone
    casadi/           the same as .casadi files, for this CasADi version: a convenience
    golden/           one CSV per function: arguments and results
    LICENSES/         of everything inside

A bundle is written beside its place and then moved there (mpc_export/place.py). The same model with
the same options comes from a cache (mpc_export/bundle_cache.py).
"""

from __future__ import annotations

import functools
import json
import os
import re
import shlex
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path, PurePosixPath
from typing import Unpack

import casadi as ca

from greybox.errors import FileFormatError, ModelError, solvable
from greybox.estimation.options import says_choices
from greybox.files import (
    Parsed,
    checksum,
    empty,
    file_sha256,
    read_json,
    to_plain,
    write_atomic,
    write_json,
)
from greybox.model.identified import IdentifiedModel, library_versions
from greybox.model.linear import LinearModel
from greybox.model.verdict import demand_usable
from greybox.residual.array_file import packed
from greybox.shown import Cell, Shown
from mpc_export.bundle_cache import fetch, keep, key_of
from mpc_export.c_code import write_c
from mpc_export.c_kernels import kernels_of
from mpc_export.c_model import CModel
from mpc_export.c_names import check_name, check_prefix, name_of_folder
from mpc_export.functions import ModelFunctions, model_functions
from mpc_export.golden import Golden, golden_vectors
from mpc_export.manifest import SCHEMA, Manifest, PortRow, Written, manifest_of
from mpc_export.options import ExportChoices, ExportOptions
from mpc_export.place import beside, check_place, move
from mpc_export.points import Reduction, with_points
from mpc_export.predictors import Fitted, PredictorModel, predictor_model
from mpc_export.readme import licences, readme
from mpc_export.tape import write_tape
from mpc_export.targets import TARGETS, write_target
from mpc_export.tube.target import Planning

GOLDEN_POINTS = 12


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class ExportBundle(Shown):
    """A bundle on disk; `source` builds the functions of the model that it was written from."""

    folder: Path
    manifest: Manifest
    source: Callable[[], ModelFunctions] | None = None
    cached: bool = False

    @functools.cached_property
    def functions(self) -> ModelFunctions:
        """The model's functions and numbers. Raises `ModelError` for a bundle that was loaded: its
        model is not at hand."""
        if self.source is None:
            raise ModelError(
                f"{self.folder} was loaded, its model is not at hand",
                fix="use rebuild() and manifest",
            )
        return self.source()

    def _shown_text(self) -> str:
        """Name and folder, then its functions."""
        functions = [str(f["name"]) for f in self.manifest["functions"]]
        first = f"{self.name}: bundle of {len(functions)} functions in {self.folder}"
        return "\n".join(
            [first, f"  {', '.join(functions)}", f"  {len(self.manifest['files'])} files"]
        )

    def _shown_rows(self) -> list[dict[str, Cell]]:
        """One row per function: what it takes and gives, with sizes."""

        def ports(given: Sequence[PortRow]) -> str:
            return ", ".join(f"{p['name']} ({p['rows']}, {p['columns']})" for p in given)

        return [
            {
                "function": f["name"],
                "arguments": ports(f["arguments"]),
                "results": ports(f["results"]),
            }
            for f in self.manifest["functions"]
        ]

    @property
    def name(self) -> str:
        """Prefix of everything in C."""
        return str(self.manifest["name"])

    @staticmethod
    def load(folder: str | os.PathLike[str]) -> ExportBundle:
        """Read a bundle and check that its files are whole and inside it. Raises
        `FileFormatError`."""
        where = Path(folder)
        if (where / "manifest.json").exists() and not (where / "manifest.json").is_file():
            raise FileFormatError(
                "not a file", where=str(where / "manifest.json"), fix="export again"
            )
        manifest = read_json(where / "manifest.json", schema=SCHEMA)
        if manifest.get("checksum") != checksum(
            {k: v for k, v in manifest.items() if k != "checksum"}
        ):
            raise FileFormatError(
                "the checksum does not fit", where=str(where / "manifest.json"), fix="export again"
            )
        _check_manifest(manifest, str(where / "manifest.json"))
        inside = where.resolve()
        for name, digest in manifest["files"].items():
            path = where / name
            try:
                if not path.resolve().is_relative_to(inside):
                    raise FileFormatError(
                        "leads out of the bundle", where=str(path), fix="export again"
                    )
                whole = path.is_file() and file_sha256(path) == digest
            except (OSError, ValueError, RuntimeError):  # no name for a file, a loop of links
                whole = False
            if not whole:
                raise FileFormatError(
                    "missing or changed", where=str(path), fix="export again, with --force"
                )
        return ExportBundle(folder=where, manifest=manifest)

    def rebuild(self, names: Iterable[str] | None = None) -> dict[str, ca.Function]:
        """The CasADi functions by name, from the bundle's own numbers. The code is this package's,
        not the bundle's.

        Raises `FileFormatError` where the numbers are no functions or are larger than `rebuild.py`
        allows.
        """
        from mpc_export.rebuild.rebuild import load

        try:
            return load(self.folder / "python", names)
        except Exception as error:  # CasADi says a wrong tape with errors of all kinds
            raise FileFormatError(
                f"cannot be rebuilt ({type(error).__name__}: {error})",
                where=str(self.folder / "python"),
                fix="export again",
            ) from None


def _check_manifest(manifest: Parsed, where: str) -> None:
    """Raises `FileFormatError` where what becomes a path or a C symbol is not one."""
    try:
        check_prefix(manifest["name"])
        for function in manifest["functions"]:
            if not isinstance(function["name"], str) or not re.fullmatch(
                r"[A-Za-z]\w*", function["name"], re.ASCII
            ):
                raise TypeError(f"{function['name']!r} is no name of a function")
        for name, digest in manifest["files"].items():
            path = PurePosixPath(name)
            if (
                path.is_absolute()
                or ".." in path.parts
                or "\\" in name
                or "\0" in name
                or not isinstance(digest, str)
            ):
                raise FileFormatError(
                    f"{name!r} is not a file of the bundle", where=where, fix="export again"
                )
    except (KeyError, TypeError, AttributeError, ModelError) as error:
        raise FileFormatError(
            f"incomplete or wrong ({error})", where=where, fix="export again"
        ) from None


@says_choices(ExportOptions)
@solvable("export")
def write_bundle(
    model: Fitted | PredictorModel,
    folder: str | os.PathLike[str],
    options: ExportOptions | None = None,
    **choices: Unpack[ExportChoices],
) -> ExportBundle:
    """Export anything fitted to `folder` (mpc_export/predictors.py says of what kinds).

    The choices are keywords, fields of `ExportOptions` with its defaults, or `options` as a whole.
    They are those of `model_functions` and of the command line.

    `name` is the prefix in C (default: the folder's name, or NAME_model where that is taken),
    `points` projects the learned part on that many support points first, `horizon` are the stages
    of the target tube, `attempts` how many a step may make at its plan. Raises `ModelError` (a name
    that is no C identifier, see `model_functions`, or a model that was judged not usable, unless
    `even_so`), `UnknownNameError` (a target), `OutputError` (a
    folder that is not a bundle, one with changed or foreign files unless `force`, or one that
    cannot be written).
    """
    place, o = _place_of(folder), ExportOptions.of(options, choices)
    if isinstance(model, IdentifiedModel):
        demand_usable(model.verdict, model.name, even_so=o.even_so)
    name = name_of_folder(place.resolve().name) if o.name is None else check_name(o.name)
    o = o.completed()
    check_place(place, force=o.force)
    shaping: list[object] = [name, *o.shaping]
    if not isinstance(model, (IdentifiedModel, LinearModel)):
        model, o = predictor_model(model, dt=o.dt, name=name), replace(o, dt=None)
    key = None
    if o.use_cache and not isinstance(model, PredictorModel):
        key = key_of(model, shaping)
    if key is not None and fetch(key, place, ExportBundle.load, force=o.force):
        again = model if o.points is None else with_points(model, o.points)[0]
        made = read_json(place / "manifest.json")
        return ExportBundle(
            folder=place, manifest=made, cached=True, source=lambda: _functions(again, o)
        )
    reduction: Reduction | None = None
    if o.points is not None:
        model, reduction = with_points(model, o.points)
    functions = _functions(model, o)
    golden = golden_vectors(functions, GOLDEN_POINTS)
    with beside(place) as part:
        written = _write_parts(functions, golden, part, name, o)
        manifest = manifest_of(functions, golden, written, name=name, real=o.real, groups=o.with_)
        manifest["reduction"] = reduction
        write_atomic(part / "README.md", readme(manifest))
        manifest["files"] = {
            p.relative_to(part).as_posix(): file_sha256(p)
            for p in sorted(part.rglob("*"))
            if p.is_file()
        }
        manifest = to_plain(manifest)
        write_json(part / "manifest.json", {**manifest, "checksum": checksum(manifest)})
        if key is not None:
            keep(key, part)
        move(part, place, force=o.force)
    return ExportBundle(
        folder=place, manifest=read_json(place / "manifest.json"), source=lambda: functions
    )


def _place_of(folder: str | os.PathLike[str]) -> Path:
    """The path without ".."; whole where the place holds the working folder, as no relative path
    outlives its replacement; of a link to an empty folder, the folder."""
    if os.path.islink(folder) and os.path.isdir(folder) and empty(Path(folder)):
        folder = os.path.realpath(folder)
    whole = Path(os.path.abspath(folder))
    return whole if Path.cwd().is_relative_to(whole) else Path(os.path.normpath(folder))


def _functions(model: Fitted | PredictorModel, o: ExportOptions) -> ModelFunctions:
    return model_functions(model, dt=o.dt, with_=o.with_, runtime_parameters=o.runtime_parameters)


def _write_parts(
    functions: ModelFunctions, golden: list[Golden], part: Path, name: str, o: ExportOptions
) -> Written:
    """Writes everything but the manifest and the README."""
    tape, arrays = write_tape(functions.functions.values())
    write_atomic(part / "python" / "functions.json", json.dumps(tape, separators=(",", ":")) + "\n")
    write_atomic(part / "python" / "functions.npz", packed(arrays, compressed=True))
    interpreter = (
        resources.files("mpc_export.rebuild").joinpath("rebuild.py").read_text(encoding="utf-8")
    )
    write_atomic(part / "python" / "rebuild.py", interpreter)
    for g in golden:
        write_atomic(part / "golden" / f"{g.name}.csv", g.csv())
    for file, text in licences("c" in o.targets or "fmu" in o.targets).items():
        write_atomic(part / "LICENSES" / file, text)
    c, abi = None, None
    if "c" in o.targets:
        kernels = kernels_of(functions)
        source = write_c(
            list(functions.functions.values()),
            part / "c",
            prefix=name,
            real=o.real,
            kernels=kernels,
        )
        wrapper = CModel(functions, source, library_versions()["greybox"], golden)
        wrapper.write(part / "c")
        c, abi = (source, wrapper.work), wrapper.abi
    if "casadi" in o.targets:
        (part / "casadi").mkdir()
        for n, f in functions.functions.items():
            f.save(str(part / "casadi" / f"{n}.casadi"))
    plan = Planning(horizon=o.horizon, attempts=o.attempts)
    targets = {
        target: write_target(target, functions, part, name, o.real, plan)
        for target in o.targets
        if target in TARGETS
    }
    return Written(c=c, targets=targets, abi=abi)


def describe(bundle: ExportBundle) -> str:
    """A few lines for the terminal."""
    m = bundle.manifest
    sizes = m["sizes"]
    lines = [
        f"{bundle.folder}: {m['model']['name']}, {m['sample_time']:g} s a sample"
        + (" (from the cache)" if bundle.cached else ""),
        f"  states {sizes['n_x']} (error states {sizes['n_d']}), commands {sizes['n_u']}, outputs "
        f"{sizes['n_y']}, run-time parameters {sizes['n_p']}",
        f"  functions: {', '.join(f['name'] for f in m['functions'])}",
    ]
    if m["c"]:
        lines.append(
            f"  C: {m['c']['real']}, {m['c']['source_bytes'] / 1e3:.0f} kB of source, work "
            f"{m['c']['work_bytes']} bytes; python -m mpc_export.verify {shlex.quote(str(bundle.folder))}"
        )
    if m["reduction"]:
        cost = m["reduction"]
        worst = max(cost["mean_error"], default=0.0)
        lines.append(
            f"  {cost['points']} of {cost['of']} support points: the learned mean moved by at most "
            f"{worst:.2g} of its spread"
        )
    notes = [*m["notes"], *(t["note"] for t in m["targets_written"].values() if "note" in t)]
    lines += [f"  note: {n}" for n in notes]
    return "\n".join(lines)
