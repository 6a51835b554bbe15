"""How strongly do clean flights in gusts speak for a steady force, which is not there?

    python -m scenarios.studies.gusts_and_forces --seeds 76 48 [--cell clean] --out DIR

Craft of the judge of names (`scenarios.foreign.naming`), two training flights and a test flight of
8 s each. Two fits of the training flights, without and with a constant force of every flight, and
the e-value of the force against none; no search. One line per seed: gain in log evidence, log10 e,
and the share of the craft's turning that the unnamed force of the fit without it does not follow.
Development seeds, below 1000.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import greybox as gb
from greybox.data.lead import without_lead_in
from greybox.discovery.cause import offer
from greybox.discovery.certificate import certificates, splits
from greybox.discovery.evidence import Flights
from greybox.discovery.options import DiscoverOptions
from greybox.discovery.search import Rival
from greybox.estimation.record import sample_time
from scenarios.foreign.naming_cells import case_of, write

NAME, SECONDS = "constant_force", 8.0
SHARE = ("disturbance.force.world", None)


def measured(cell: str, seed: int, out: Path) -> tuple[float, float, float]:
    """(gain in log evidence, log10 e, share) of one craft."""
    folder = out / f"{cell.replace(':', '_')}_{seed}"
    if not (folder / "vehicle.toml").exists():
        write(case_of(cell, seed), folder, seconds=SECONDS)
    vehicle = gb.read_vehicle(folder / "vehicle.toml")
    train, test = (
        without_lead_in(gb.read_logs(sorted(folder.glob(f"{part}*.csv")), vehicle))
        for part in ("train", "test")
    )
    options = DiscoverOptions()
    causes = offer(vehicle, train.channels, sample_time=sample_time(train))
    flights = Flights(causes=causes, data=train, options=options.of_every_fit)
    null = flights.fit(causes.base)
    force = flights.fit(causes.base | {NAME}, [null.known])
    bar = float(np.log(len(causes.effects) / options.alpha))
    rivals = {NAME: [Rival(instead=(), fitted=null)]}
    certificate = certificates(force, rivals, splits(flights, test), bar)[NAME]
    gain = force.log_evidence - null.log_evidence
    return gain, certificate.log_e / float(np.log(10)), null.known[SHARE]


def main(argv: Sequence[str] | None = None) -> int:
    """Print one line per seed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="+", required=True)
    parser.add_argument("--cell", default="clean")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args(argv)
    for seed in options.seeds:
        gain, log10_e, share = measured(options.cell, seed, options.out)
        print(f"{seed:5d}  gain {gain:7.2f}  log10 e {log10_e:7.2f}  share {share:.2f}", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
