"""Realistic sensors: does discover still tell physics from what only sensors do?

    python -m scenarios.studies.discovery_sensors [--cells all:clean low_pass:clean all:motor_lag
    ...] [--seeds 1 2]
        [--vehicle x250] [--out F.jsonl] [--summary]

A cell is INGREDIENTS:EFFECT: what the sensors do to the log (scenarios.plants.realistic_sensors;
"all", "none", or ingredients joined by +) and the hidden effect ("clean" hides nothing). Vehicle,
flights, sizes and wrong nominal values are those of discovery_grid; logs go through CSV files,
checks and conditioning, as a user's do. Seeds below 1000 were looked at while the code was written;
results that are quoted come from seeds of 1000 and more. One line is written per cell as soon as it
is done; a study that was stopped goes on where it was.

    physics    names of the stages command, rotor, thrust, body and wrench that are not hidden
    sensor     names of the sensor stage that are neither hidden nor put there by the ingredients
    right      no false physics, nothing unnamed, and the hidden effect has its name (or is in a group)
"""

from __future__ import annotations

import argparse
import tempfile
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from greybox.data import Dataset
from greybox.data.checks import check_logs
from greybox.data.logs import read_logs
from greybox.discovery.result import Discovery
from greybox.discovery.workflow import discover
from greybox.excitation.injection import rich_excitation
from greybox.excitation.waypoints import RandomWaypoints
from greybox.files import append_json_line
from greybox.model.effects import CATALOGUE
from greybox.plants.flight_log import fly, member, write_log
from greybox.plants.presets import NANO, X250, controller_for
from scenarios.plants.realistic_sensors import INGREDIENTS, REALISTIC, Realism, realistic
from scenarios.studies.discovery_cells import MAKERS, cases, vehicle_of
from scenarios.studies.rows import open_ended, read_rows, wilson

EXPECTED = {
    "pose_delay": {"pose_delay"},
    "jitter": {"pose_delay"},
    "low_pass": {"sensor_delay"},
    "drift": {"gyro_bias"},
}
"""Names of the sensor stage that an ingredient makes true."""
SAMPLE = 0.01
"""Sample time of the logs [s]."""
SINGLES = tuple(c for c in cases(X250) if c != "clean")


def realism_of(ingredients: str) -> Realism:
    """The set that a cell's first part names."""
    if ingredients == "all":
        return REALISTIC
    return REALISTIC.only(*(() if ingredients == "none" else ingredients.split("+")))


def logs(
    folder: Path, plant: Any, realism: Realism, seeds: Sequence[int], seconds: float, name: str
) -> list[Path]:
    """One CSV per seed, without rotor speeds, as the sensors of `realism` would have kept it."""
    log = fly(
        plant,
        controller_for(plant),
        RandomWaypoints(),
        rich_excitation(),
        seconds,
        seed=list(seeds),
        warm_up=1.0,
    )
    paths = []
    for i, seed in enumerate(seeds):
        kept = realistic(member(log, i), plant.sensors, realism, seed)
        paths.append(write_log(folder / f"{name}{i}.csv", kept, drop=["omega"]))
    return paths


def run(
    vehicle: str, ingredients: str, effect: str, seed: int, seconds: float = 16.0
) -> dict[str, Any]:
    """One cell as plain values."""
    frame = {"x250": X250, "nano": NANO}[vehicle]
    plant = MAKERS[vehicle](cases(frame)[effect])
    realism = realism_of(ingredients)
    first = 1000 * seed
    with tempfile.TemporaryDirectory() as folder:
        train = logs(Path(folder), plant, realism, (first + 1, first + 2), seconds, "train")
        test = logs(Path(folder), plant, realism, (first + 101,), seconds, "test")
        file = vehicle_of(plant)
        data: list[Dataset] = [read_logs(paths, file) for paths in (train, test)]
        found = discover(file, data[0], data[1], faults=check_logs([*train, *test], file))
    content = found.to_dict()
    row = {
        "vehicle": vehicle,
        "ingredients": ingredients,
        "effect": effect,
        "seed": seed,
        "verdict": found.verdict,
        "effects": {
            e["name"]: {n: [p["value"], p["std"]] for n, p in e["parameters"].items()}
            for e in content["effects"]
        },
        "log10_e": {e["name"]: e["log10_e"] for e in content["effects"]},
        "groups": [[c["name"] for c in a["candidates"]] for a in content["ambiguous"]],
        "alternatives": {
            e["name"]: e["alternatives"] for e in content["effects"] if e["alternatives"]
        },
        "truth": {k: float(v) for e in plant.effects for k, v in e.parameters().items()},
        "sensors": content.get("sensors", []),
        "unnamed": [u["proposal"] for u in content["unnamed"]],
        "deficiency": content["deficiency"],
        "faults": content["faults"],
        "warnings": content["warnings"],
        "seconds": found.seconds,
    }
    return row | judge(row, found)


def judge(row: dict[str, Any], found: Discovery | None = None) -> dict[str, Any]:
    """What is false in a row, and whether it is right."""
    stage = {e.name: e.stage for e in CATALOGUE}
    truth = set() if row["effect"] == "clean" else {row["effect"]}
    on = realism_of(row["ingredients"]).switched_on
    allowed = truth.union(*(EXPECTED.get(i, set()) for i in on))
    names = set(row["effects"])
    for name, said in row.get("alternatives", {}).items():
        for words in (set(w.split("+")) for w in said):
            # All sensors late alike: late commands are the same thing.
            if name not in allowed and words <= allowed and words & truth and _alike(row, name):
                names = names - {name} | words
    groups = [{n for c in g for n in c.split("+")} for g in row["groups"]]
    wrong = {n for n in names if n not in allowed}
    for g in groups:
        if not g & allowed:
            wrong |= g
    physics = sorted(n for n in wrong if stage.get(n) != "sensor")
    sensor = sorted(n for n in wrong if stage.get(n) == "sensor")
    named = truth <= names.union(*groups)
    right = not physics and not row["unnamed"] and named and row["verdict"] != "bad_data"
    return {"physics": physics, "sensor": sensor, "named": named, "right": right}


def _alike(row: dict[str, Any], name: str) -> bool:
    """Whether the late pose of the ingredients and the hidden delay are as long as what was found,
    within ten per cent."""
    realism = realism_of(row["ingredients"])
    pose = realism.pose_delay + 0.5 * realism.jitter * SAMPLE
    hidden, found = next(iter(row["truth"].values())), next(iter(row["effects"][name].values()))[0]
    return all(abs(d - hidden) < 0.1 * hidden for d in (pose, found))


def summary(rows: Sequence[dict[str, Any]]) -> str:
    """Rates per set of ingredients, clean logs and single effects apart."""
    cells: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for r in rows:
        kind = "clean" if r["effect"] == "clean" else "single"
        cells[(r["ingredients"], kind)].append(r | judge(r))
    lines = [
        f"{'sensors':14s} {'logs':7s} {'n':>4s} {'right':>22s} {'false physics':>22s} "
        f"{'unnamed':>22s}  false sensor"
    ]
    for (ingredients, kind), members in sorted(cells.items()):
        n = len(members)
        counts = [
            sum(bool(r["right"]) for r in members),
            sum(bool(r["physics"]) for r in members),
            sum(bool(r["unnamed"]) for r in members),
        ]
        text = " ".join(
            f"{k / n:7.1%} [{wilson(k, n)[0]:5.1%},{wilson(k, n)[1]:6.1%}]" for k in counts
        )
        lines.append(
            f"{ingredients:14s} {kind:7s} {n:4d} {text}  {sum(bool(r['sensor']) for r in members)}"
        )
    return "\n".join(lines)


def line(row: dict[str, Any]) -> str:
    """A row for the terminal."""
    said = [
        *row["effects"],
        *(" or ".join(g) for g in row["groups"]),
        *(f"[{u}]" for u in row["unnamed"]),
    ]
    models = sorted({f"{s['kind']} {s['channel']}" for s in row["sensors"] if s["kind"] != "white"})
    return (
        f"{row['vehicle']} {row['seed']} {row['ingredients']}:{row['effect']}  "
        f"{'right' if row['right'] else 'WRONG'}  {', '.join(said) or row['verdict']}; "
        f"{'; '.join(models)}; {row['faults']} ({row['seconds']:.0f} s)"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Run what is not in the file yet, then print the table."""
    parser = argparse.ArgumentParser(description="Discovery on logs of realistic sensors.")
    every = [f"{i}:clean" for i in ("none", *INGREDIENTS, "all")] + [f"all:{e}" for e in SINGLES]
    parser.add_argument("--cells", nargs="+", default=every)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--vehicle", choices=tuple(MAKERS), default="x250")
    parser.add_argument("--out", default="discovery_sensors.jsonl")
    parser.add_argument(
        "--summary", action="store_true", help="only print the table of what is there"
    )
    options = parser.parse_args(arguments)
    path = Path(options.out)
    if not options.summary:
        open_ended(path, parser)
    rows = read_rows(path)
    done = {(r["vehicle"], r["ingredients"], r["effect"], r["seed"]) for r in rows}
    for seed in () if options.summary else options.seeds:
        for cell in options.cells:
            ingredients, effect = cell.split(":")
            if (options.vehicle, ingredients, effect, seed) in done:
                continue
            row = run(options.vehicle, ingredients, effect, seed)
            rows.append(row)
            append_json_line(path, row)
            print(line(row), flush=True)
    print(summary(rows))


if __name__ == "__main__":
    main()
