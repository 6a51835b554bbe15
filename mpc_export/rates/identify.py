"""The models of `greybox mpc rates` from training flights: a linear one, and the same with a
process on its residual."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from greybox.baselines.linear_predictor import LinearPredictor
from greybox.baselines.output_residual import OutputHybrid, fit_output_residual
from greybox.data import Segment, dataset_from_arrays
from greybox.files import read_json, write_json
from greybox.linear.fit import fit_linear
from greybox.linear.records import Record
from greybox.model.vehicle import Vehicle, read_vehicle
from greybox.plants.flight_log import write_log
from greybox.plants.vehicle_file import write_vehicle
from greybox.symbolic import FloatArray
from mpc_export.mission.campaign import make_folder
from mpc_export.rates.craft import (
    CHANNELS,
    DT,
    FLIGHTS,
    OUTPUTS,
    PLANT,
    SECONDS,
    training_log,
    vehicle,
)

ORDER = 6
"""Two states an axis: the rate, and the lag of its motors."""
POINTS = 40
ERRORS = {"inertia": 1.1, "thrust.c2": 0.92, "torque.c2": 1.1}
"""What the vehicle file of the PID loops gets wrong, as in the obstacle course."""


def identify(out: Path, say: Callable[[str], None]) -> OutputHybrid:
    """The hybrid in `out`/hybrid.json, from an earlier run where it was made the same way; training
    flights and vehicle file stand beside it."""
    settings = {
        "schema": "greybox.study/1",
        "seconds": SECONDS,
        "flights": FLIGHTS,
        "order": ORDER,
        "points": POINTS,
        "plant": PLANT,
        "errors": ERRORS,
        "channels": {n: [list(t) for t in terms] for n, terms in CHANNELS.items()},
    }
    done, file = out / "identified.json", out / "hybrid.json"
    if all(f.exists() for f in (done, file, out / "vehicle.toml")) and read_json(done) == settings:
        return OutputHybrid.load(file)
    make_folder(out)
    write_vehicle(out / "vehicle.toml", vehicle(), errors=ERRORS)
    say(f"flying {FLIGHTS} training flights of {SECONDS:g} s")
    logs = [training_log(i) for i in range(FLIGHTS)]
    for i, log in enumerate(logs):
        write_log(out / f"training{i + 1}.csv", log)
    hybrid = fitted(logs, say)
    hybrid.save(file)
    write_json(done, settings)
    return hybrid


def fitted(logs: Sequence[Mapping[str, FloatArray]], say: Callable[[str], None]) -> OutputHybrid:
    """A linear model of p, q, r, and a Gaussian process on what it leaves; `logs` are columns of
    flights, `t` among them."""
    say(f"a linear model of order {ORDER} of p, q, r")
    records = [
        Record(
            u=np.column_stack([sum(w * log[c] for w, c in terms) for terms in CHANNELS.values()]),
            y=np.column_stack([log[c] for c in OUTPUTS]),
            name=f"training{i + 1}",
        )
        for i, log in enumerate(logs)
    ]
    linear = fit_linear(
        records, ORDER, dt=DT, inputs=list(CHANNELS), outputs=list(OUTPUTS), name="rates"
    ).model
    say(f"a Gaussian process of {POINTS} points on what it leaves")
    base = LinearPredictor(model=linear, outputs=OUTPUTS, channels=CHANNELS)
    return fit_output_residual(base, segments_of_logs(logs), points=POINTS, seed=0)


def segments_of_logs(logs: Sequence[Mapping[str, FloatArray]]) -> list[Segment]:
    """Flights as segments, named training1 and so on."""
    data = [
        dataset_from_arrays(
            log["t"], {n: v for n, v in log.items() if n != "t"}, name=f"training{i + 1}"
        )
        for i, log in enumerate(logs)
    ]
    return [s for d in data for flight in d for s in flight.segments]


def vehicle_card(out: Path) -> Vehicle:
    """The vehicle file that `identify` wrote."""
    return read_vehicle(out / "vehicle.toml")
