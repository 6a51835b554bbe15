"""Does MuJoCo's own system identification (mujoco.sysid) find better models of the same flights, in
how much time?

    python -m benchmarks.sysid_peers nanobench [--train FLIGHT ...] [--out F.json]
    python -m benchmarks.sysid_peers craft --seeds FIRST LAST --folder DIR [--out F.json]

`nanobench`: nine real flights to fit, or those that --train names, five to judge. `greybox fit`
runs as typed, with nothing but vehicle file and flights. mujoco.sysid gets the same file as MJCF:
four motors with a first-order lag, ctrl = the file's thrust. Free are a gain per rotor, the drag
torque, the lag, damping of the free joint and the second moments of a box. It fits half a second
from measured states, each signal scaled by what it changes in that time. Everybody then predicts
from the same instants and the same measured pose, velocity and rates. In one row our discrepancy
states are forgotten at the start, because mujoco.sysid has none. It needs `pip install
'mujoco[sysid]'`.

`craft`: drawn craft with known truth (`scenarios.foreign.draw`), with ideal and real sensors, gusts
on and off. The true mass is told to mujoco.sysid, not to greybox. Shown: how many moments of
inertia and lags lie inside their 95 % intervals.

CPU seconds are of whole processes on one thread.
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import argparse  # noqa: E402
import json  # noqa: E402
import tempfile  # noqa: E402
import time  # noqa: E402
from collections.abc import Callable, Mapping, Sequence  # noqa: E402
from dataclasses import dataclass, replace  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

import numpy as np  # noqa: E402

from greybox.data import Dataset  # noqa: E402
from greybox.data.logs import read_logs  # noqa: E402
from greybox.estimation.filtering import Filter  # noqa: E402
from greybox.examples import NANOBENCH_TEST, NANOBENCH_TRAIN, flight_paths, vehicle_path  # noqa: E402
from greybox.files import write_json  # noqa: E402
from greybox.model.identified import IdentifiedModel  # noqa: E402
from greybox.model.vehicle import Vehicle, read_vehicle  # noqa: E402
from greybox.symbolic import FloatArray  # noqa: E402
from greybox.validation.adapt import adapt_to_flight  # noqa: E402
from greybox.validation.groups import GROUPS, error_vectors  # noqa: E402
from greybox.validation.open_loop import GroupReader, IntArray, predict_from  # noqa: E402
from scenarios.foreign.campaign import DEVIATIONS, deviations, fit_plainly, seconds_of_children  # noqa: E402
from scenarios.foreign.draw import draw, truth_of, write  # noqa: E402

SECONDS, ADAPT, SPACING, LEARNED = 0.5, 5.0, 0.1, 2.0
"""Length of a prediction, start of the judged part of a flight, time between judged instants and
between those that mujoco.sysid learns from [s]: its time grows with their number."""
SHOWN = (0.1, 0.5)
JUDGED = ("position", "velocity", "rotation", "rate")
START_LAG, MEMORY = 0.04, 0.5
"""Motor lag that mujoco.sysid starts from, and how much of the commands before an instant its
rotors remember [s]."""
REFITS, SAME = 5, 0.005
"""How often mujoco.sysid fits again at most, and the relative change of the lag that needs no
further fit."""
BOX = np.ones((3, 3)) - np.eye(3)
"""Moments of inertia of second moments of mass: any of these that are positive belong to a body."""
COMPARED = ("motor_lag.tau", "inertia.xx", "inertia.yy", "inertia.zz")
"""Parameters of drawn craft that both estimate."""
Errors = dict[str, FloatArray]
"""Group -> squared norms of errors (instants, steps)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Window:
    """Half a second of a flight: measured states (H + 1, 13) of position, quaternion, world
    velocity and body rates, thrusts that were commanded (H + 1, 4) [N] by the vehicle file, and
    those of the time before (m, 4)."""

    measured: FloatArray
    commanded: FloatArray
    before: FloatArray


def numbers(vehicle: Vehicle) -> dict[str, float]:
    """What the file says: mass, moments of inertia, thrust and torque maps."""
    return {name: q.value for name, q in vehicle.quantities.items()}


def groups_at(states: FloatArray) -> dict[str, FloatArray]:
    """Group -> values of states (..., 13)."""
    return {
        "position": states[..., :3],
        "rotation": states[..., 3:7],
        "velocity": states[..., 7:10],
        "rate": states[..., 10:],
    }


def difference(states: FloatArray, reference: FloatArray) -> FloatArray:
    """Errors (..., 12) of states (..., 13): position, velocity, rotation vector, rate."""
    told, seen = groups_at(states), groups_at(reference)
    return np.concatenate([error_vectors(g, told[g], seen[g]) for g in JUDGED], axis=-1)


def windows_of(data: Dataset, vehicle: Vehicle, origins: Mapping[str, IntArray]) -> list[Window]:
    """The windows that begin at `origins` of each flight's first segment and miss no sample."""
    values, found = numbers(vehicle), []
    for flight in data:
        segment, steps = flight.segments[0], round(SECONDS / flight.dt)
        states = np.hstack(
            [
                segment.matrix(GROUPS[g].columns)
                for g in ("position", "rotation", "velocity", "rate")
            ]
        )
        u = segment.matrix([f"u{i + 1}" for i in range(len(vehicle.rotors))])
        thrust = sum(values[f"thrust.c{k}"] * u**k for k in range(3))
        memory = round(MEMORY / flight.dt)
        for k in origins[flight.name]:
            measured = states[k : k + steps + 1].copy()
            if np.isfinite(measured).all():
                q = measured[:, 3:7]
                q *= np.where(q @ q[0] < 0.0, -1.0, 1.0)[:, None]
                found.append(
                    Window(
                        measured=measured,
                        commanded=thrust[k : k + steps + 1],
                        before=thrust[k - memory : k],
                    )
                )
    return found


def instants(data: Dataset, first: float, spacing: float) -> dict[str, IntArray]:
    """Flight -> samples from `first` [s] on, every `spacing`, whose window lies inside its first
    segment and is complete."""
    out = {}
    for flight in data:
        segment, steps = flight.segments[0], round(SECONDS / flight.dt)
        columns = [c for g in JUDGED for c in GROUPS[g].columns]
        there = np.isfinite(segment.matrix(columns)).all(axis=1)
        k = np.arange(
            round(first / flight.dt), segment.n - steps - 1, max(1, round(spacing / flight.dt))
        )
        out[flight.name] = k[[bool(there[i : i + steps + 1].all()) for i in k]]
    return out


class Peer:
    """A quadrotor in MJCF whose numbers mujoco.sysid fits."""

    def __init__(self, vehicle: Vehicle, dt: float, mass: float | None = None) -> None:
        import mujoco

        self.dt, self.count = dt, len(vehicle.rotors)
        self.values = numbers(vehicle)
        self.values["mass"] = mass or self.values["mass"]
        self.spec = mujoco.MjSpec.from_string(self._mjcf(vehicle))
        self.params = self._parameters()
        self.covariance = np.zeros((0, 0))

    def _mjcf(self, vehicle: Vehicle) -> str:
        v = self.values
        arm = np.abs([r.position for r in vehicle.rotors]).max()
        ratio = sum(v[f"torque.c{k}"] for k in range(3)) / sum(v[f"thrust.c{k}"] for k in range(3))
        sites = "".join(
            f'<site name="r{i}" pos="{" ".join(map(str, r.position))}"/>'
            for i, r in enumerate(vehicle.rotors)
        )
        motors = "".join(
            f'<general name="m{i}" site="r{i}" dyntype="filter" dynprm="{START_LAG}" gainprm="1" '
            'biastype="none" '
            f'gear="0 0 1 0 0 {-r.spin * ratio}"/>'
            for i, r in enumerate(vehicle.rotors)
        )
        moments = " ".join(str(v[f"inertia.{a}{a}"]) for a in "xyz")
        return (
            f'<mujoco><option integrator="RK4" timestep="{self.dt}" gravity="0 0 '
            f'{-float(vehicle.gravity)}" '
            'density="1.2" viscosity="1.8e-5"/><worldbody><body name="craft"><freejoint '
            'name="free"/>'
            f'<inertial pos="0 0 0" mass="{v["mass"]}" diaginertia="{moments}"/>'
            f'<geom type="box" size="{arm} {arm} {0.3 * arm}" contype="0" '
            f'conaffinity="0"/>{sites}</body></worldbody>'
            f"<actuator>{motors}</actuator></mujoco>"
        )

    def _parameters(self) -> Any:
        from mujoco import sysid

        model, found, rotors = self.spec.compile(), sysid.ParameterDict(), range(self.count)

        def add(
            name: str, value: Any, low: float, high: float, modifier: Callable[[Any, Any], None]
        ) -> None:
            start = np.atleast_1d(np.asarray(value, dtype=float))
            found.add(sysid.Parameter(name, start, low * start, high * start, modifier=modifier))

        def gain(spec: Any, p: Any) -> None:
            for i in rotors:
                spec.actuator(f"m{i}").gainprm[0] = p.value[i]

        def lag(spec: Any, p: Any) -> None:
            for i in rotors:
                spec.actuator(f"m{i}").dynprm[0] = p.value[0]

        def torque(spec: Any, p: Any) -> None:
            for i in rotors:
                gear = spec.actuator(f"m{i}").gear
                gear[5] = np.sign(gear[5]) * p.value[0]

        def moments(spec: Any, p: Any) -> None:
            spec.body("craft").inertia[:] = BOX @ p.value

        add("gain", np.ones(self.count), 0.3, 3.0, gain)
        add("lag", START_LAG, 0.1, 5.0, lag)
        add("torque", abs(model.actuator_gear[0, 5]), 0.2, 5.0, torque)
        # of the free joint, [N s/m] and [N m s/rad]; a damping of 1/s is where it starts from
        v = self.values
        add(
            "damping",
            [v["mass"], v["inertia.xx"], v["inertia.zz"]],
            0.0,
            50.0,
            lambda _spec, _p: None,
        )
        about = np.array([self.values[f"inertia.{a}{a}"] for a in "xyz"])
        add("inertia", np.linalg.solve(BOX, about), 0.1, 5.0, moments)
        return found

    def model(self, params: Any = None, spec: Any = None) -> Any:
        """The compiled model at these values, or the present ones."""
        from mujoco import sysid

        values = params or self.params
        model = sysid.apply_param_modifiers(values, spec or self.spec)
        along, around, yaw = values["damping"].value
        model.dof_damping[:] = [along] * 3 + [around] * 2 + [yaw]
        return model

    def starts(self, windows: Sequence[Window]) -> list[FloatArray]:
        """Initial states, rotors included: the commands of before through the lag."""
        from mujoco import sysid

        model = self.model()
        keep = np.exp(-self.dt / float(self.params["lag"].value[0]))
        out = []
        for w in windows:
            act = w.before[0].copy()
            for command in w.before[1:]:
                act = keep * act + (1.0 - keep) * command
            out.append(sysid.create_initial_state(model, w.measured[0, :7], w.measured[0, 7:], act))
        return out

    def fit(self, windows: Sequence[Window]) -> None:
        """Least squares over all windows, again until the rotors start by the lag that is found."""
        from mujoco import sysid

        moved = np.concatenate([difference(w.measured[:1], w.measured[1:]) for w in windows])
        scale, steps = np.sqrt(np.mean(moved**2, axis=0)), len(windows[0].measured)
        times = self.dt * np.arange(steps)
        state = sysid.SignalType.MjStateQPos, sysid.SignalType.MjStateQVel
        layout = [("craft_qpos", 7, state[0]), ("craft_qvel", 6, state[1])]

        def errors(
            _p: Any, told: Any, seen: Any, _m: Any, _all: bool, *, state: Any, **_: Any
        ) -> tuple[Any, Any, Any]:
            return difference(state[:, 1:14], seen.data[1:]) / scale, told, told

        for _ in range(REFITS):
            before = float(self.params["lag"].value[0])
            sequence = sysid.ModelSequences(
                "craft",
                self.spec,
                [str(i) for i in range(len(windows))],
                self.starts(windows),
                [sysid.TimeSeries(times, w.commanded) for w in windows],
                [sysid.TimeSeries.from_custom_map(times, w.measured, layout) for w in windows],
                allow_missing_sensors=True,
            )
            residual = sysid.build_residual_fn(
                models_sequences=[sequence],
                build_model=self.model,
                modify_residual=errors,
                n_threads=1,
                resample_true=False,
            )
            self.params, result = sysid.optimize(self.params, residual, verbose=False, max_iters=40)
            if abs(float(self.params["lag"].value[0]) / before - 1.0) < SAME:
                break
        at_end = [np.ravel(r) for r in residual(self.params.as_vector(), self.params)[0]]
        self.covariance = np.asarray(sysid.calculate_intervals(at_end, np.asarray(result.jac))[0])

    def estimates(self) -> dict[str, dict[str, float]]:
        """Lag and moments of inertia of a box: value and std, as a table of a fit.json."""
        names = [n for n, p in self.params.items() for _ in range(p.size)]
        lag, box = names.index("lag"), [i for i, n in enumerate(names) if n == "inertia"]
        found = self.params.as_vector()
        moments = BOX @ found[box]
        spread = np.sqrt(np.diag(BOX @ self.covariance[np.ix_(box, box)] @ BOX.T))
        values = (float(found[lag]), *moments.tolist())
        errors = (float(self.covariance[lag, lag]) ** 0.5, *spread.tolist())
        return {n: {"value": v, "std": e} for n, v, e in zip(COMPARED, values, errors, strict=True)}

    def predict(self, windows: Sequence[Window]) -> FloatArray:
        """States (windows, H, 13)."""
        import mujoco
        from mujoco import rollout

        model = self.model()
        control = np.stack([w.commanded[:-1] for w in windows])
        states, _ = rollout.rollout(
            model, mujoco.MjData(model), np.stack(self.starts(windows)), control
        )
        return np.asarray(states[:, :, 1:14])


def squared(predicted: FloatArray, windows: Sequence[Window]) -> Errors:
    """Squared error norms of predicted states (windows, H, 13)."""
    seen = np.stack([w.measured[1:] for w in windows])
    told, real = groups_at(predicted), groups_at(seen)
    return {g: np.square(error_vectors(g, told[g], real[g])).sum(axis=-1) for g in JUDGED}


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
            round(SECONDS / flight.dt),
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


def nanobench(work: Path, names: Sequence[str] = NANOBENCH_TRAIN) -> list[dict[str, Any]]:
    """One row per method, fitted to the flights `names`: RMSE of each group at `SHOWN`, CPU
    seconds."""
    vehicle = read_vehicle(vehicle_path("nanobench"))
    paths = {p.name.split(".")[0]: p for p in map(Path, flight_paths("nanobench"))}
    data = read_logs(list(paths.values()), vehicle)
    train, test, dt = data.select(names), data.select(NANOBENCH_TEST), next(iter(data)).dt
    origins = instants(test, ADAPT, SPACING)
    judged = windows_of(test, vehicle, origins)
    still = np.stack([np.repeat(w.measured[:1], len(w.measured) - 1, axis=0) for w in judged])
    found: dict[str, tuple[Errors, dict[str, float]]] = {"last value": (squared(still, judged), {})}
    flights = [[paths[n] for n in some] for some in (names, NANOBENCH_TEST)]
    seconds = {
        f"cpu_{k}": fitted(vehicle_path("nanobench"), *flights, work / k, cold=k == "cold")
        for k in ("cold", "warm")
    }
    for label, errors in ours(
        IdentifiedModel.load(work / "warm" / "fit" / "model.json"), test, origins
    ).items():
        found[label] = errors, seconds
    learned = windows_of(train, vehicle, instants(train, MEMORY, LEARNED))
    begin = time.process_time()
    peer = Peer(vehicle, dt)
    peer.fit(learned)
    cpu = time.process_time() - begin
    found["mujoco.sysid"] = squared(peer.predict(judged), judged), {"cpu_warm": cpu}
    print(*(f"{n} {p.value}" for n, p in peer.params.items()), flush=True)
    rows = []
    for label, (errors, cpu) in found.items():
        rmse = {
            f"{g} {h:g} s": float(np.sqrt(errors[g][:, round(h / dt) - 1].mean()))
            for g in JUDGED
            for h in SHOWN
        }
        rows.append({"method": label, **rmse, **cpu})
    return rows


def craft(seeds: Sequence[int], folder: Path) -> list[dict[str, Any]]:
    """One row per seed and method: deviations from the truth in standard errors, and relative
    ones."""
    rows = []
    for seed in seeds:
        drawn = draw(seed)
        place = folder / str(seed)
        write(drawn, place)
        truth, vehicle = truth_of(drawn)["parameters"], read_vehicle(place / "vehicle.toml")
        train, test = (sorted(place.glob(f"{kind}*.csv")) for kind in ("train", "test"))
        cpu = fitted(place / "vehicle.toml", train, test, place)
        told = json.loads((place / "fit" / "fit.json").read_text())["parameters"]
        about = {
            "seed": seed,
            "gusts": drawn.gusts,
            "sensors": "ideal" if drawn.realism is None else "real",
        }
        rows.append({**about, "method": "greybox", "cpu": cpu, "off": _off(told, truth)})
        data = read_logs(train, vehicle)
        begin = time.process_time()
        peer = Peer(vehicle, next(iter(data)).dt, mass=truth["mass"])
        peer.fit(windows_of(data, vehicle, instants(data, MEMORY, LEARNED)))
        cpu = time.process_time() - begin
        rows.append(
            {**about, "method": "mujoco.sysid", "cpu": cpu, "off": _off(peer.estimates(), truth)}
        )
        print(*(json.dumps(r) for r in rows[-2:]), sep="\n", flush=True)
    return rows


def _off(
    told: Mapping[str, Mapping[str, Any]], truth: Mapping[str, float]
) -> dict[str, tuple[float, float]]:
    """Name -> (deviation in standard errors, relative deviation) of those of `COMPARED` that were
    estimated."""
    z, off = deviations({n: told[n] for n in COMPARED if n in told}, truth)
    return {n: (z[n], off[n]) for n in off}


def main(arguments: Sequence[str] | None = None) -> None:
    """Fit, compare, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("part", choices=("nanobench", "craft"))
    parser.add_argument(
        "--train",
        nargs="+",
        default=NANOBENCH_TRAIN,
        metavar="FLIGHT",
        help="flights that are fitted",
    )
    parser.add_argument("--seeds", type=int, nargs=2, default=(1, 6), metavar=("FIRST", "LAST"))
    parser.add_argument(
        "--folder", type=Path, help="where fits and drawn craft are kept (a temporary folder)"
    )
    parser.add_argument("--out", type=Path, metavar="F.json")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as temporary:
        work = options.folder or Path(temporary)
        if options.part == "nanobench":
            rows = nanobench(work, options.train)
            for row in rows:
                print(
                    f"{row['method']:28s}"
                    + "  ".join(f"{k} {v:.4g}" for k, v in row.items() if k != "method")
                )
        else:
            first, last = options.seeds
            rows = craft(range(first, last + 1), work)
            for method in dict.fromkeys(r["method"] for r in rows):
                off = [o for r in rows if r["method"] == method for o in r["off"].values()]
                inside = sum(abs(z) <= DEVIATIONS for z, _ in off)
                cpu = np.median([r["cpu"] for r in rows if r["method"] == method])
                print(
                    f"{method}: {inside} of {len(off)} inside, median error "
                    f"{100 * np.median([abs(d) for _, d in off]):.2f} %, {cpu:.1f} s of CPU"
                )
    if options.out:
        write_json(options.out, {"part": options.part, "rows": rows})


if __name__ == "__main__":
    main()
