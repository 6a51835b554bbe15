"""What `greybox selftest` tries: each check has a name and a function that returns what it found or
raises; `Missing` is an optional part that is not there."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import importlib
import io
import platform
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from greybox.data.readers import FORMATS, LogFormat, read_columns
from greybox.distribution import NAME, install_line, other_greybox
from greybox.errors import GreyboxError, MissingExtraError

if TYPE_CHECKING:
    from greybox.estimation.fit import Fit
    from greybox.symbolic import FloatArray

DISTANCE = 4.0
"""An estimate may be so many of its standard errors from the truth."""


class _Found(Exception):
    """What a check found, with the usual fix."""

    def __init__(self, message: str, *, fix: str) -> None:
        super().__init__(message)
        self.fix = fix


class Missing(_Found):
    """An optional part is not installed."""


class Broken(_Found):
    """A part is there and does not do what it should."""


@dataclass
class Bench:
    """What the checks share: a folder that goes away, and the fit, once there is one."""

    folder: Path
    fit: Fit | None = None

    @classmethod
    @contextlib.contextmanager
    def open(cls) -> Iterator[Bench]:
        """A bench in a temporary folder."""
        with tempfile.TemporaryDirectory(prefix="greybox-selftest-") as folder:
            yield cls(folder=Path(folder))

    def fitted(self) -> Fit:
        """The fit. Raises `Broken` where it failed."""
        if self.fit is None:
            raise Broken("not tried, as the fit failed", fix="mend the fit first")
        return self.fit


@dataclass(frozen=True)
class Check:
    """One part: its name, and what tries it."""

    name: str
    run: Callable[[Bench], str]


def outcome(check: Check, bench: Bench) -> tuple[str, str, str]:
    """("works", "missing" or "broken", what was found, the usual fix or "")."""
    try:
        return "works", check.run(bench), ""
    except Missing as error:
        return "missing", str(error), error.fix
    except Broken as error:
        return "broken", str(error), error.fix
    except GreyboxError as error:
        return "broken", str(error), ""
    except Exception as error:  # whatever a library does when it is broken is what is looked for
        text = " ".join(str(error).split())[:200]
        fix = f"pip install --force-reinstall {NAME}"
        return "broken", f"{type(error).__name__}: {text}", fix


def packages(_: Bench) -> str:
    """Versions, and that no other greybox is in the same folder."""
    if (other := other_greybox()) is not None:
        raise Broken(
            f"another package called greybox ({other}) is installed into the same folder",
            fix=f"pip uninstall greybox && pip install --force-reinstall {NAME}",
        )
    names = ("numpy", "scipy", "casadi", "control", "matplotlib")
    versions = ", ".join(f"{n} {metadata.version(n)}" for n in names)
    return (
        f"Python {platform.python_version()}, {platform.system()} {platform.machine()}, {versions}"
    )


def casadi(_: Bench) -> str:
    """A derivative that CasADi makes, against the one that is known."""
    import casadi as ca

    x = ca.SX.sym("x")
    derivative = ca.Function("d", [x], [ca.jacobian(ca.sin(x) * ca.exp(x), x)])
    got, want = float(derivative(0.7)), float((np.sin(0.7) + np.cos(0.7)) * np.exp(0.7))
    if abs(got - want) > 1e-14:
        raise Broken(
            f"d/dx sin(x) exp(x) at 0.7 is {want:.15g}, CasADi says {got:.15g}",
            fix="pip install --force-reinstall casadi",
        )
    return "a derivative is right to 1e-14"


def cache(_: Bench) -> str:
    """A folder that keeps compiled models."""
    from greybox.estimation.cache import cache_root, is_kept

    root = cache_root()
    if not is_kept():
        raise Missing(
            f"compiled models are not kept from run to run ({root} goes with this process)",
            fix="set GREYBOX_CACHE to a folder of your own",
        )
    return f"compiled models are kept in {root}"


def compiler(_: Bench) -> str:
    """A C function is compiled, loaded and called."""
    from greybox.estimation.build import DRIVER_FLAGS, build, version
    from greybox.estimation.build import compiler as found

    cc = found()
    if cc is None:
        raise Missing(
            "no C compiler: fits run in CasADi's VM, several times slower",
            fix=f"{install_line('compiler')}, or install gcc or clang",
        )
    text = "#include <math.h>\ndouble greybox_selftest(double x) { return hypot(x, 4.0); }\n"
    called = ctypes.CDLL(str(build([("selftest.c", text, DRIVER_FLAGS)]))).greybox_selftest
    called.restype, called.argtypes = ctypes.c_double, [ctypes.c_double]
    if (got := called(3.0)) != 5.0:
        raise Broken(
            f"hypot(3, 4) is 5, the compiled one says {got:g}", fix="another compiler in CC"
        )
    where = "wheel ziglang" if "ziglang" in cc else cc[0]
    return f"{version(cc)} ({where})"


def fit(bench: Bench) -> str:
    """Eight simulated seconds by equations that are not those of the model; the truth is known."""
    from greybox.commands.missing_effect import ERRORS, SIGMA
    from greybox.data import dataset_from_arrays
    from greybox.estimation.fit import fit as run
    from greybox.excitation.injection import rich_excitation
    from greybox.excitation.waypoints import RandomWaypoints
    from greybox.model.model import build_model
    from greybox.model.vehicle import read_vehicle
    from greybox.plants.flight_log import fly
    from greybox.plants.presets import controller_for, x250
    from greybox.plants.vehicle_file import write_vehicle

    plant = x250()
    log = fly(
        plant, controller_for(plant), RandomWaypoints(), rich_excitation(), 8.0, seed=1, warm_up=1.0
    )
    path = write_vehicle(bench.folder / "vehicle.toml", plant, sigma=SIGMA, errors=ERRORS)
    vehicle = read_vehicle(path)
    data = dataset_from_arrays(
        log["t"], {n: v for n, v in log.items() if n != "t" and not n.startswith("omega")}
    )
    found = run(build_model(vehicle, data.channels), data)
    truth, worst = plant.truth()["parameters"], 0.0
    for name, estimate in found.parameters.items():
        off = abs(estimate.value - truth[name]) / estimate.std
        worst = max(worst, off)
        if not off <= DISTANCE:
            raise Broken(
                f"{name} is {truth[name]:g}, the fit says {estimate.value:g} +- {estimate.std:g}",
                fix=f"pip install --force-reinstall {NAME}; if it stays, please report this line",
            )
    bench.fit = found
    how = "compiled" if found.problem.engine.compiled else "in CasADi's VM"
    count = len(found.parameters)
    return f"{count} unknowns of a simulated flight within {worst:.1f} standard errors, {how}"


def page(bench: Bench) -> str:
    """The page of that fit."""
    from greybox.report.fit_report import fit_report

    return f"{len(fit_report(bench.fitted().to_dict())) / 1024:.0f} kB of HTML with figures"


def export(bench: Bench) -> str:
    """The fitted model as C and CasADi, against its golden vectors."""
    from greybox.estimation.build import compiler as found
    from mpc_export.bundle import write_bundle
    from mpc_export.verify import verify

    folder = write_bundle(bench.fitted().model, bench.folder / "craft").folder
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        good = verify(folder, with_c=found() is not None)
    if not good:
        raise Broken(
            "what is exported differs from the model: " + " ".join(said.getvalue().split())[-200:],
            fix="please report this line",
        )
    how = "C and CasADi" if found() is not None else "CasADi (no compiler for the C)"
    return f"the exported {how} give the model's numbers"


def examples(_: Bench) -> str:
    """The shipped flights are those that were shipped, and can be read."""
    from greybox.data.logs import read_log
    from greybox.examples import SETS, flight_paths, sound, vehicle_path
    from greybox.model.vehicle import read_vehicle

    count = sum(len(sound(name)) for name in SETS)
    name = next(iter(SETS))
    read_log(flight_paths(name)[0], read_vehicle(vehicle_path(name)))
    return f"{count} files whole, a flight read"


def torch(_: Bench) -> str:
    """A Gaussian process is trained on a sine, polished by PyTorch, and evaluated between its
    points."""
    from greybox.residual.train import check_extra, train_gp
    from greybox.symbolic import Layout, Signal

    try:
        check_extra()
    except MissingExtraError:
        raise Missing("networks of greybox compare need it", fix=install_line("gp")) from None
    x = np.linspace(-3.0, 3.0, 60)[:, None]
    trained = train_gp(
        x,
        np.sin(x),
        inputs=Layout([Signal(name="x", unit="1")]),
        outputs=Layout([Signal(name="y", unit="1")]),
        points=12,
        hold_out=0.0,
        polish=True,
    )
    at = np.array([[-1.23], [0.4], [2.1]])
    mean, _variance = trained.posterior.evaluate(at)
    if (gap := float(np.max(np.abs(mean - np.sin(at))))) > 0.01:
        raise Broken(f"a GP on a sine misses it by {gap:.2g}", fix=install_line("gp"))
    return f"PyTorch {metadata.version('torch')}: a GP follows a sine to {gap:.1g}"


def reader(one: LogFormat, bench: Bench) -> str:
    """The libraries of a log format are there; a file is written and read where that can be
    done."""
    for library in one.libraries:
        try:
            importlib.import_module(library)
        except ImportError as error:
            name = (error.name or library).split(".")[0]
            raise Missing(
                f"{one.title} needs the library {name}", fix=install_line("logs")
            ) from None
    if one.name not in WRITERS:
        there = " and ".join(one.libraries)
        return f"{one.title}: {f'{there} can be imported' if there else 'needs no further library'}"
    path = bench.folder / f"log{one.endings[0]}"
    speed = 1.25 * np.arange(5.0)
    WRITERS[one.name](path, {"t": 0.01 * np.arange(5.0), "vx": speed})
    table = read_columns(path)
    if not np.array_equal(table.columns["vx"], speed):
        raise Broken(f"{one.title}: numbers come back changed", fix=install_line("logs"))
    return f"{one.title}: numbers come back as written"


def _csv(path: Path, columns: Mapping[str, FloatArray]) -> None:
    np.savetxt(
        path,
        np.column_stack(list(columns.values())),
        delimiter=",",
        header=",".join(columns),
        comments="",
    )


def _mat(path: Path, columns: Mapping[str, FloatArray]) -> None:
    from scipy.io import savemat

    savemat(path, dict(columns))


def _parquet(path: Path, columns: Mapping[str, FloatArray]) -> None:
    from pyarrow import parquet, table

    parquet.write_table(table(dict(columns)), path)


WRITERS: Mapping[str, Callable[[Path, Mapping[str, FloatArray]], None]] = {
    "csv": _csv,
    "matlab": _mat,
    "parquet": _parquet,
}
"""Log formats that a few lines write."""

CHECKS: tuple[Check, ...] = (
    Check("packages", packages),
    Check("CasADi", casadi),
    Check("cache", cache),
    Check("compiler", compiler),
    Check("fit", fit),
    Check("page", page),
    Check("export", export),
    Check("examples", examples),
    *(Check(f"log {one.name}", functools.partial(reader, one)) for one in FORMATS),
    Check("PyTorch", torch),
)
