"""Do mujoco.sysid and AeroID find better models of the same flights, in how much time?

    python -m benchmarks.sysid_peers nanobench [--train FLIGHT ...] [--fitted MODEL.json]
        [--out F.json]
    python -m benchmarks.sysid_peers craft --seeds FIRST LAST [--simulator rotorpy mujoco]
        [--folder DIR] [--out F.json]
    python -m benchmarks.sysid_peers craft --kept benchmarks/results/sysid_peers.json

`nanobench`: nine real flights to fit, or those that --train names, five to judge. `craft`: drawn
craft with known truth (`scenarios.foreign.draw`), three flights to fit, two to judge, with ideal
and real sensors, gusts on and off. `greybox fit` runs as typed, with nothing but vehicle file and
flights. The peers (`sysid_mujoco`, `sysid_aeroid`; --peers chooses) get the numbers of the same
file; the true mass of a drawn craft is told to them, not to greybox. Without --peers names only our
rows are made, and those of the peers in F.json stay. Free are a gain per rotor, the
drag torque, the lag, damping of motion and rotation and the moments of inertia. They fit half a
second from measured states, each signal scaled by what it changes in that time. Everybody then
predicts from the same instants and the same measured pose, velocity and rates. In one row our
discrepancy states are forgotten at the start, because peers have none.

Shown: RMSE ahead, and for drawn craft how many moments of inertia and lags lie inside their 95 %
intervals. CPU seconds are of whole processes on one thread.
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import argparse  # noqa: E402
import json  # noqa: E402
import tempfile  # noqa: E402
import time  # noqa: E402
from collections.abc import Iterable, Mapping, Sequence  # noqa: E402
from dataclasses import replace  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

import numpy as np  # noqa: E402

from benchmarks.sysid_aeroid import AeroidPeer  # noqa: E402
from benchmarks.sysid_mujoco import MuJoCoPeer  # noqa: E402
from benchmarks.sysid_windows import (  # noqa: E402
    COMPARED,
    JUDGED,
    MEMORY,
    Errors,
    instants,
    squared,
    windows_of,
)
from greybox.data import Dataset  # noqa: E402
from greybox.data.logs import read_logs  # noqa: E402
from greybox.estimation.filtering import Filter  # noqa: E402
from greybox.examples import NANOBENCH_TEST, NANOBENCH_TRAIN, flight_paths, vehicle_path  # noqa: E402
from greybox.files import write_json  # noqa: E402
from greybox.model.identified import IdentifiedModel  # noqa: E402
from greybox.model.vehicle import Vehicle, read_vehicle  # noqa: E402
from greybox.validation.adapt import adapt_to_flight  # noqa: E402
from greybox.validation.groups import GROUPS, error_vectors  # noqa: E402
from greybox.validation.open_loop import GroupReader, IntArray, predict_from  # noqa: E402
from scenarios.foreign.campaign import DEVIATIONS, deviations, fit_plainly, seconds_of_children  # noqa: E402
from scenarios.foreign.draw import SIMULATORS, draw, truth_of, write  # noqa: E402

AHEAD, ADAPT, SPACING = 1.0, 5.0, 0.1
"""Length of a prediction, start of the judged part of a flight, time between judged instants [s]."""
LEARNED, LEARNED_SPACING = 0.5, 2.0
"""Length of what peers learn from and time between its instants [s]: their time grows with their
number."""
SHOWN = (0.1, 0.5, 1.0)
PEERS = {"mujoco.sysid": MuJoCoPeer, "AeroID": AeroidPeer}
Row = dict[str, Any]


def ours(
    model: IdentifiedModel, data: Dataset, origins: Mapping[str, IntArray]
) -> dict[str, Errors]:
    """Our errors from the same instants and measured states, with the filter's discrepancy and
    without."""
    runner, reader = Filter(model), GroupReader(model)
    pushes = reader.state_rows("disturbance")
    rows: dict[str, list[Errors]] = {"greybox": [], "greybox, pushes forgotten": []}
    for flight in data:
        segment, k = flight.segments[0], origins[flight.name]
        own = adapt_to_flight(model, flight, ADAPT, riccati=runner.riccati)
        filtered = runner.run(
            segment.without(flight.noncausal),
            p=model.parameter_vector(own.values),
            x0=own.x0,
            x0_sigma=own.x0_sigma,
        )
        steps, references = (
            round(AHEAD / flight.dt),
            {g: segment.matrix(GROUPS[g].columns) for g in JUDGED},
        )
        forgotten = filtered.states.copy()
        forgotten[:, pushes] = 0.0
        for label, run in zip(rows, (filtered, replace(filtered, states=forgotten)), strict=True):
            told = predict_from(
                runner.engine,
                reader,
                run,
                k,
                steps=steps,
                measured_start=True,
                references=references,
            )
            ahead = k[:, None] + np.arange(1, steps + 1)
            rows[label].append(
                {
                    g: np.square(error_vectors(g, told[g], references[g][ahead])).sum(axis=-1)
                    for g in JUDGED
                }
            )
    return {
        label: {g: np.concatenate([e[g] for e in each]) for g in JUDGED}
        for label, each in rows.items()
    }


def fitted(
    vehicle: Path, train: Sequence[Path], test: Sequence[Path], folder: Path, cold: bool = False
) -> float:
    """`greybox fit` as typed, into folder/fit; its CPU seconds. `cold`: nothing compiled yet."""
    before = seconds_of_children()
    with tempfile.TemporaryDirectory() as empty:
        folder.mkdir(parents=True, exist_ok=True)
        fit_plainly(
            vehicle,
            train,
            test,
            folder,
            (),
            {**os.environ, "GREYBOX_CACHE": empty} if cold else None,
        )
    return seconds_of_children() - before


def judged(
    vehicle: Vehicle,
    train: Dataset,
    test: Dataset,
    model: IdentifiedModel,
    chosen: Sequence[str],
    mass: float | None = None,
) -> list[Row]:
    """One row per method: RMSE of each group at `SHOWN`; of the peers their CPU seconds and
    estimates, too."""
    dt = next(iter(test)).dt
    origins = instants(test, ADAPT, SPACING, AHEAD)
    seen = windows_of(test, vehicle, origins, AHEAD)
    learned = windows_of(train, vehicle, instants(train, MEMORY, LEARNED_SPACING, LEARNED), LEARNED)
    still = np.stack([np.repeat(w.measured[:1], len(w.measured) - 1, axis=0) for w in seen])
    found: list[tuple[str, Errors, Row]] = [("last value", squared(still, seen), {})]
    found += [(label, errors, {}) for label, errors in ours(model, test, origins).items()]
    for label in chosen:
        begin = time.process_time()
        peer = PEERS[label](vehicle, dt, mass)
        peer.fit(learned)
        about = {"cpu": time.process_time() - begin, "estimates": peer.estimates()}
        found.append((label, squared(peer.predict(seen), seen), about))
    rows = []
    for label, errors, about in found:
        rmse = {
            f"{g} {h:g} s": float(np.sqrt(errors[g][:, round(h / dt) - 1].mean()))
            for g in JUDGED
            for h in SHOWN
        }
        rows.append({"method": label, **rmse, **about})
    return rows


def nanobench(
    work: Path, names: Sequence[str], chosen: Sequence[str], cold: bool, model: Path | None
) -> list[Row]:
    """Rows of all methods, fitted to the flights `names`; ours with CPU seconds, or `model` as it
    is. `cold`: once more with nothing compiled yet."""
    vehicle = read_vehicle(vehicle_path("nanobench"))
    paths = {p.name.split(".")[0]: p for p in map(Path, flight_paths("nanobench"))}
    data = read_logs(list(paths.values()), vehicle)
    flights = [[paths[n] for n in some] for some in (names, NANOBENCH_TEST)]
    spent = {}
    if model is None:
        for label in ("cpu cold", "cpu") if cold else ("cpu",):
            folder = work / label.replace(" ", "_")
            spent[label] = fitted(
                vehicle_path("nanobench"), *flights, folder, cold=label == "cpu cold"
            )
        model = work / "cpu" / "fit" / "model.json"
    own = IdentifiedModel.load(model)
    rows = judged(vehicle, data.select(names), data.select(NANOBENCH_TEST), own, chosen)
    return [row | (spent if row["method"] == "greybox" else {}) for row in rows]


def craft(
    seeds: Sequence[int], simulators: Sequence[str], folder: Path, chosen: Sequence[str]
) -> list[Row]:
    """Rows of all methods for every seed, the simulators in turn, with deviations from the truth in
    standard errors, and relative ones."""
    rows = []
    for k, seed in enumerate(seeds):
        drawn = draw(seed, simulators[k % len(simulators)] if simulators else None)
        place = folder / str(seed)
        write(drawn, place)
        truth, vehicle = truth_of(drawn)["parameters"], read_vehicle(place / "vehicle.toml")
        train, test = (sorted(place.glob(f"{kind}*.csv")) for kind in ("train", "test"))
        cpu = fitted(place / "vehicle.toml", train, test, place)
        told = json.loads((place / "fit" / "fit.json").read_text())["parameters"]
        about = {
            "seed": seed,
            "simulator": drawn.simulator,
            "gusts": drawn.gusts,
            "sensors": "ideal" if drawn.realism is None else "real",
        }
        own = {"cpu": cpu, "estimates": {n: told[n] for n in COMPARED if n in told}}
        model = IdentifiedModel.load(place / "fit" / "model.json")
        dt = model.sample_time
        data = [read_logs(some, vehicle, rate=1.0 / dt) for some in (train, test)]
        for row in judged(vehicle, data[0], data[1], model, chosen, mass=truth["mass"]):
            more = own if row["method"] == "greybox" else {}
            estimates = {**row, **more}.get("estimates", {})
            z, off = deviations(estimates, truth)
            rows.append({**about, **row, **more, "off": {n: (z[n], off[n]) for n in off}})
            print(json.dumps(rows[-1]), flush=True)
    return rows


def with_kept(rows: Sequence[Row], path: Path) -> list[Row]:
    """`rows` and what stands in the file, if there is one, of other craft and other methods."""
    kept = json.loads(path.read_text())["rows"] if path.exists() else []
    made = {(r.get("seed"), r["method"]) for r in rows}
    return [*rows, *(r for r in kept if (r.get("seed"), r["method"]) not in made)]


def deviating(rows: Iterable[Row]) -> list[tuple[float, float]]:
    """Deviations from the truth in standard errors, and relative ones, of all numbers of `rows`."""
    return [(z, d) for r in rows for z, d in r.get("off", {}).values()]


def summary(rows: Sequence[Row]) -> str:
    """One line per method: RMSE, a mean over craft where there are several (their geometric mean),
    intervals that hold, CPU seconds."""
    keys = [f"{g} {h:g} s" for g in JUDGED for h in SHOWN]
    lines = [f"{'':28s}" + "".join(f"{k:>16s}" for k in keys)]
    for method in dict.fromkeys(r["method"] for r in rows):
        own = [r for r in rows if r["method"] == method]
        line = f"{method:28s}" + "".join(
            f"{np.exp(np.mean([np.log(r[k]) for r in own])):16.4g}" for k in keys
        )
        line += "  " + ", ".join(
            f"{sum(abs(z) <= DEVIATIONS for z, _ in off)} of {len(off)} inside {where}"
            for where, off in (
                ("in all", deviating(own)),
                ("in gusts", deviating(r for r in own if r.get("gusts"))),
            )
            if off
        )
        if off := deviating(own):
            line += f", median error {100 * np.median([abs(d) for _, d in off]):.2f} %"
        for k in ("cpu", "cpu cold"):
            spent = [r[k] for r in own if k in r]
            line += f"  {k} {np.median(spent):.0f} s" if spent else ""
        lines.append(line)
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Fit, compare, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("part", choices=("nanobench", "craft"))
    parser.add_argument("--peers", nargs="*", choices=tuple(PEERS), default=tuple(PEERS))
    parser.add_argument(
        "--train",
        nargs="+",
        default=NANOBENCH_TRAIN,
        metavar="FLIGHT",
        help="flights that are fitted",
    )
    parser.add_argument(
        "--fitted", type=Path, metavar="MODEL.json", help="our model of these flights"
    )
    parser.add_argument("--cold", action="store_true", help="fit once more, nothing compiled yet")
    parser.add_argument("--seeds", type=int, nargs=2, default=(1, 6), metavar=("FIRST", "LAST"))
    parser.add_argument(
        "--simulator",
        nargs="+",
        choices=SIMULATORS,
        default=(),
        help="who flies the craft, in turn (default: as drawn)",
    )
    parser.add_argument("--kept", type=Path, metavar="F.json", help="show rows that were written")
    parser.add_argument(
        "--folder", type=Path, help="where fits and drawn craft are kept (a temporary folder)"
    )
    parser.add_argument("--out", type=Path, metavar="F.json")
    options = parser.parse_args(arguments)
    if options.kept:
        print(summary(json.loads(options.kept.read_text())["rows"]))
        return
    with tempfile.TemporaryDirectory() as temporary:
        work = options.folder or Path(temporary)
        if options.part == "nanobench":
            rows = nanobench(work, options.train, options.peers, options.cold, options.fitted)
        else:
            first, last = options.seeds
            rows = craft(range(first, last + 1), options.simulator, work, options.peers)
        print(summary(rows))
    if options.out:
        write_json(options.out, {"part": options.part, "rows": with_kept(rows, options.out)})


if __name__ == "__main__":
    main()
