"""Body rates of real Crazyflies from motor commands by linear models, judged on flights that the
fit never saw.

    python -m scenarios.studies.linear_flights [--set nanobench|arpl_crazyflie] [--form siso|mimo]
    [--out F.json]

`siso` drives each rate by its own mix of the four commands (roll = -u1 - u2 + u3 + u4 and so on),
`mimo` all three rates by all four commands. Order by BIC with cross-validation, delays by `--delay`
(auto). NanoBench: nine flights train, five test. ARPL: every log is held out once, fitted on the
other two, at 100 Hz. On a test flight the state and the output offset are adapted on the first 5 s,
which are not scored. Errors are the root mean square of the vector norm over the three axes, from
every origin h samples ahead, and of the free run from the fifth second on; persistence holds the
last value. One line of this study is, on the command line,

    greybox linear --vehicle greybox/examples/nanobench/vehicle.toml --rate 100 --adapt 5 --siso
    --delay auto \
      --inputs 'roll=-u1-u2+u3+u4,pitch=-u1+u2+u3-u4,yaw=-u1+u2-u3+u4' --outputs p,q,r --train
      <nine> --test <five>
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from greybox.examples import flight_paths, nanobench_split, vehicle_path
from greybox.files import write_json
from greybox.linear.fit import LinearFit, Options, Settings, fit_linear
from greybox.linear.logs import Logs, parse_channels, read_records
from greybox.linear.prediction import adapt, k_step, simulate
from greybox.linear.records import Record, delayed
from greybox.model.matrices import spectral_radius
from greybox.model.vehicle import read_vehicle
from greybox.symbolic import FloatArray

MIXES = "roll=-u1-u2+u3+u4,pitch=-u1+u2+u3-u4,yaw=-u1+u2-u3+u4"
INPUTS = {"siso": MIXES, "mimo": "u1,u2,u3,u4"}
OUTPUTS = "p,q,r"
HORIZONS = (1, 10, 50)
"""In samples of 10 ms."""
ADAPT = 5.0
"""Seconds of a test flight on which state and offset are fitted."""


@dataclass
class Pool:
    """Sums of squared errors of model and persistence per axis (3,), by horizon (0 = free run), and
    how many samples."""

    error: dict[int, FloatArray] = field(default_factory=dict)
    still: dict[int, FloatArray] = field(default_factory=dict)
    count: dict[int, int] = field(default_factory=dict)

    def add(self, horizon: int, error: FloatArray, still: FloatArray) -> None:
        """Errors (N, 3) of model and of persistence; rows with NaN are left out."""
        good = np.isfinite(error).all(axis=1) & np.isfinite(still).all(axis=1)
        for sums, values in ((self.error, error), (self.still, still)):
            sums[horizon] = sums.get(horizon, np.zeros(3)) + (values[good] ** 2).sum(axis=0)
        self.count[horizon] = self.count.get(horizon, 0) + int(good.sum())

    def rows(self) -> list[dict[str, Any]]:
        """Root mean squares: per axis and of the vector norm."""
        return [
            {
                "horizon": h,
                "axes": np.sqrt(self.error[h] / self.count[h]).tolist(),
                "norm": float(np.sqrt(self.error[h].sum() / self.count[h])),
                "persistence": float(np.sqrt(self.still[h].sum() / self.count[h])),
                "samples": self.count[h],
            }
            for h in sorted(self.error)
        ]


def splits(set_name: str) -> list[tuple[list[Path], list[Path]]]:
    """Pairs of training and test logs."""
    if set_name == "nanobench":
        return [nanobench_split()]
    paths = flight_paths(set_name)
    return [([q for q in paths if q != p], [p]) for p in paths]


def read(paths: Sequence[Path], form: str, set_name: str, bridge: int) -> Logs:
    """Records of some logs at 100 Hz, the airborne part."""
    vehicle = read_vehicle(vehicle_path(set_name))
    inputs, outputs = parse_channels(INPUTS[form], "inputs"), parse_channels(OUTPUTS, "outputs")
    return read_records(
        [str(p) for p in paths], inputs, outputs, vehicle, rate=100.0, bridge=bridge
    )


def groups(form: str) -> list[tuple[list[int], list[int]]]:
    """Columns of u and y of each model."""
    return [([i], [i]) for i in range(3)] if form == "siso" else [([0, 1, 2, 3], [0, 1, 2])]


def identify(logs: Logs, form: str, order: int | str, delays: list[int] | str) -> list[LinearFit]:
    """One fit per group of channels."""
    out = []
    options = Options(methods=("ssarx", "pbsid"), settings=Settings())
    for columns, rows in groups(form):
        records = [Record(u=r.u[:, columns], y=r.y[:, rows], name=r.name) for r in logs.records]
        given = delays if isinstance(delays, str) else delays[: len(columns)]
        names = ["roll", "pitch", "yaw"] if form == "siso" else ["u1", "u2", "u3", "u4"]
        out.append(
            fit_linear(
                records,
                order,
                dt=logs.dt,
                inputs=[names[i] for i in columns],
                outputs=["pqr"[i] for i in rows],
                delays=given,
                options=options,
                cross_validate=order == "auto",
                largest=8,
            )
        )
    return out


def judge(fits: Sequence[LinearFit], form: str, records: Sequence[Record], pool: Pool) -> None:
    """Add the errors on test records to the pool."""
    for record in records:
        dt = fits[0].model.dt
        if len(record) * dt < ADAPT + 3.0:
            continue
        parts: dict[int, list[FloatArray]] = {h: [] for h in (*HORIZONS, 0)}
        for (columns, rows), fit in zip(groups(form), fits):
            own = Record(u=record.u[:, columns], y=record.y[:, rows], name=record.name)
            known = adapt(fit.model, own, ADAPT)
            for ahead in k_step(fit.model, own, HORIZONS, x0=known.x0, offset=known.offset):
                parts[ahead.horizon].append(ahead.measured - ahead.predicted)
            if spectral_radius(fit.model.matrices.a) < 1.0:
                cut = max(fit.model.delays, default=0)
                y = (
                    simulate(fit.model, own.u, x0=known.x0)[cut:]
                    + known.offset
                    - fit.model.output_offset
                )
                parts[0].append(delayed(own, fit.model.delays).y - y)
        for h, errors in parts.items():
            if len(errors) < len(fits):
                continue
            end = min(len(e) for e in errors)
            total = np.hstack([e[len(e) - end :] for e in errors])
            y = record.y[len(record) - end :]
            first = max(round(ADAPT / dt) - (len(record) - end), 0)
            still = y[first:] - (
                y[first] if h == 0 else record.y[len(record) - end - h : len(record) - h][first:]
            )
            pool.add(h, total[first:], still)


def run(
    set_name: str, form: str, order: int | str = "auto", delays: list[int] | str = "auto"
) -> dict[str, Any]:
    """Fit and judge all splits of a set; plain values."""
    pool, models = Pool(), []
    for train, test in splits(set_name):
        fits = identify(read(train, form, set_name, 0), form, order, delays)
        judge(fits, form, read(test, form, set_name, 50).records, pool)
        for f in fits:
            choice = f.order_choice
            models.append(
                {
                    "outputs": list(f.model.outputs.names),
                    "order": f.order,
                    "delays": list(f.model.delays),
                    "samples": f.samples,
                    "converged": f.converged,
                    "standard_errors": f.errors,
                    "reasons": [] if choice is None else list(choice.reasons),
                }
            )
    return {"set": set_name, "form": form, "models": models, "rows": pool.rows()}


def shown(result: dict[str, Any]) -> str:
    """A table for the terminal."""
    lines = [f"{result['set']} {result['form']}"]
    for m in result["models"]:
        lines.append(
            f"  {','.join(m['outputs'])}: order {m['order']}, delays {m['delays']}, {m['samples']} "
            "samples"
        )
        lines += [f"    {r}" for r in m["reasons"]]
    for r in result["rows"]:
        name = f"{r['horizon']} samples" if r["horizon"] else "free run"
        axes = " ".join(f"{v:.3f}" for v in r["axes"])
        lines.append(
            f"  {name:>10}: {r['norm']:.3f} rad/s ({axes}), persistence {r['persistence']:.3f}, n "
            f"{r['samples']}"
        )
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Fit, judge, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--set", nargs="+", default=["nanobench", "arpl_crazyflie"])
    parser.add_argument("--form", nargs="+", default=["siso", "mimo"], choices=["siso", "mimo"])
    parser.add_argument("--order", default="auto")
    parser.add_argument("--delay", default="auto", help="samples for every input, or auto")
    parser.add_argument("--out", default=None)
    arguments = parser.parse_args(argv)
    order = arguments.order if arguments.order == "auto" else int(arguments.order)
    delays = "auto" if arguments.delay == "auto" else [int(arguments.delay)] * 4
    results = []
    for set_name in arguments.set:
        for form in arguments.form:
            results.append(run(set_name, form, order, delays))
            print(shown(results[-1]), flush=True)
    if arguments.out:
        write_json(arguments.out, {"results": results})
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
