"""An exported filter learns the parameters of a flight while it flies: is it what the batch fit of
that flight finds?

    python -m scenarios.studies.adaptive_flight MODEL.json VEHICLE.toml LOG... [--seconds 10]
    [--memory 0]

MODEL is a file of `greybox fit` with per-flight parameters, LOG flights that it was not fitted to.
Each is exported as `greybox export MODEL.json --with adapt` does it; the C is compiled and flown
once over the first seconds of each flight, beside the batch estimate (maximum a posteriori, as
`greybox validate --adapt`) from the same seconds, the same filter and the same prior.
"""

from __future__ import annotations

import argparse
import ctypes
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from greybox.data import Flight
from greybox.data.logs import read_logs
from greybox.errors import DataError
from greybox.estimation.filtering import Filter
from greybox.estimation.record import Record, make_record
from greybox.model.identified import IdentifiedModel
from greybox.model.vehicle import read_vehicle
from greybox.validation.adapt import adapt_to_flight
from mpc_export.bundle import ExportBundle, write_bundle
from mpc_export.verify import CLibrary, build

Array = npt.NDArray[np.float64]
SHARE = 0.02
"""Of the batch's value: how near the one in flight shall be."""


class InFlight:
    """The compiled adapt_step of a bundle, as a function of arrays."""

    def __init__(self, bundle: ExportBundle, folder: Path) -> None:
        self.manifest = bundle.manifest
        self.library = CLibrary(
            build(bundle.folder, bundle.manifest, ["cc"], folder), bundle.manifest
        )
        self.entry: Mapping[str, Any] = next(
            f for f in bundle.manifest["functions"] if f["name"] == "adapt_step"
        )
        self.last: list[list[float]] = []

    def __call__(self, *arguments: Array) -> list[Array]:
        """x, u, p, y, there, V, memory -> x_next, p_next, V_next, e, y_hat."""
        self.last = [np.ravel(a, order="F").tolist() for a in arguments]
        found = self.library.call(self.entry, self.last)
        shapes = [(r["rows"], r["columns"]) for r in self.entry["results"]]
        return [np.reshape(v, s, order="F") for v, s in zip(found, shapes, strict=True)]

    def microseconds(self, calls: int = 2000) -> float:
        """CPU of one call at the last arguments, the arrays made before."""
        m, real, pointer = self.manifest, self.library.real, ctypes.POINTER(self.library.real)
        assert m["c"] is not None
        sizes = m["c"]["functions"]["adapt_step"]
        given = [(real * max(len(a), 1))(*a) for a in self.last]
        results = [(real * (r["rows"] * r["columns"]))() for r in self.entry["results"]]
        arg = (pointer * sizes["sz_arg"])(*(ctypes.cast(a, pointer) for a in given))
        res = (pointer * sizes["sz_res"])(*(ctypes.cast(r, pointer) for r in results))
        iw, w = (self.library.integer * max(sizes["sz_iw"], 1))(), (real * max(sizes["sz_w"], 1))()
        code = getattr(self.library.library, f"{m['name']}_adapt_step")
        began = time.process_time()
        for _ in range(calls):
            code(arg, res, iw, w, 0)
        return 1e6 * (time.process_time() - began) / calls


def flown(
    step: InFlight, bundle: ExportBundle, record: Record, memory: float
) -> tuple[Array, Array]:
    """Adapted parameters (n_a,) and their standard errors after one pass over a record."""
    f, segment = bundle.functions, record.segment
    u = np.column_stack([segment.channels[n] for n in f.inputs.names])
    x = np.concatenate([record.x0, f.reference[0][len(record.x0) :]])
    for i, name in enumerate(f.states.names[len(record.x0) :], len(record.x0)):
        x[i] = u[0, f.inputs[name.split(".")[1]]]
    p = f.parameter_values.copy()
    v = f.adapted.covariance.copy()
    known = {f.parameters[n]: segment.channels[n] for n in f.sampled.exogenous}
    for k in range(record.n):
        for row, column in known.items():
            p[row] = column[k] if np.isfinite(column[k]) else p[row]
        y, there = np.nan_to_num(record.outputs[k]), (record.mask[k] != 0).astype(float)
        x, p, v = step(x, u[k], p, y, there, v, np.array([memory]))[:3]
        x, p = x.ravel(), p.ravel()
    return p[list(f.adapted.rows)], np.sqrt(np.diag(v))[: len(f.adapted.rows)]


def first(flight: Flight, seconds: float) -> Flight:
    """The first seconds of a flight. Raises `DataError` where its samples begin later."""
    begin = float(flight.segments[0].t[0])
    part = flight.between(begin, begin + seconds - 1e-9)
    if part is None:
        raise DataError(f"no samples in the first {seconds:g} s", where=f"flight {flight.name}")
    return part


def summary(rows: Sequence[tuple[float, float, float]]) -> str:
    """Rows of (difference over the batch's value, over its standard error, value over standard
    error) in a sentence."""
    far = [known for share, _, known in rows if share > SHARE]
    text = (
        f"{len(rows) - len(far)} of {len(rows)} within {SHARE:.0%} of the batch's value, "
        f"{sum(error <= 0.1 for _, error, _ in rows)} within 0.1 standard errors of it, all within "
        f"{max(error for _, error, _ in rows):.2f}"
    )
    if not far:
        return text
    better = sum(known > max(far) for _, _, known in rows)
    return (
        f"{text}; beyond {SHARE:.0%} no value is more than {max(far):.2f} standard errors from zero, "
        f"and {better} values are"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Export, compile, fly, compare, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("model", metavar="MODEL.json")
    parser.add_argument("vehicle", metavar="VEHICLE.toml")
    parser.add_argument("logs", nargs="+", metavar="LOG")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument(
        "--memory", type=float, default=0.0, help="seconds after which the filter forgets; 0: never"
    )
    options = parser.parse_args(arguments)
    model = IdentifiedModel.load(options.model)
    data = read_logs(options.logs, read_vehicle(options.vehicle))
    own = Filter(model)
    with tempfile.TemporaryDirectory() as name:
        place = Path(name) / "craft"
        bundle = write_bundle(model, place, targets=("c",), with_=("adapt",), even_so=True)
        step = InFlight(bundle, Path(name))
        names = [bundle.functions.parameters.names[i] for i in bundle.functions.adapted.rows]
        head = ("batch", "+-", "in flight", "+-", "apart %", "in +-")
        print(
            f"{'flight':28s}{'parameter':26s}"
            + "".join(f"{h:>{w}s}" for h, w in zip(head, (11, 10, 11, 10, 9, 7)))
        )
        rows: list[tuple[float, float, float]] = []
        for flight in data.flights:
            part = first(flight, options.seconds)
            batch = adapt_to_flight(model, flight, options.seconds, riccati=own.riccati)
            value, std = flown(
                step, bundle, make_record(own.engine, part.segments[0]), options.memory
            )
            for n, a, s in zip(names, value, std, strict=True):
                there, spread = batch.values[n], batch.std[n]
                rows.append((abs(a / there - 1), abs(a - there) / spread, abs(there) / spread))
                apart = f"{100 * rows[-1][0]:9.2f}{rows[-1][1]:7.2f}"
                print(
                    f"{flight.name[:27]:28s}{n:26s}{there:11.4g}{spread:10.2g}{a:11.4g}{s:10.2g}{apart}"
                )
        print(f"\n{summary(rows)}")
        sizes = bundle.functions.sizes
        print(
            f"\n{step.microseconds():.1f} us of CPU a step (cc -O1): {sizes['n_d']} error states, "
            f"{sizes['n_e']} "
            f"innovations, {len(names)} parameters, {sizes['n_a'] - len(names)} errors of the start"
        )


if __name__ == "__main__":
    main()
