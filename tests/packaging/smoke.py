"""What a stranger does with an installed greybox: run by its environment's Python, in an empty
folder, outside the tree.

python smoke.py README.md WRITERS.py: the twelve lines of the README, every command that needs
nothing but shipped data, logs of every format. Exits with an error at the first thing that does not
work. Needs nothing but what was installed.
"""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import sys
from pathlib import Path

import greybox
from greybox.examples import flight_path, vehicle_path

BIN = Path(sys.executable).parent
SET = "arpl_crazyflie"
VEHICLE, TRAIN, TEST = (
    str(vehicle_path(SET)),
    str(flight_path(SET, "log15")),
    str(flight_path(SET, "log16")),
)


def run(*arguments: str, program: str = "greybox", code: int = 0) -> str:
    """Standard output of a command that must end with this exit code."""
    done = subprocess.run(
        [str(BIN / program), *arguments], capture_output=True, text=True, check=False, timeout=1800
    )
    if done.returncode != code or "Traceback" in done.stderr:
        sys.exit(
            f"{program} {' '.join(arguments)}: exit code "
            f"{done.returncode}\n{done.stdout}\n{done.stderr}"
        )
    return done.stdout


def readme(page: Path) -> None:
    """The Python of the README."""
    block = re.search(
        r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    )
    assert block is not None
    exec(compile(block[1], str(page), "exec"), {})
    assert json.loads(Path("fit/fit.json").read_text())["schema"] == "greybox.fit/1"


def commands() -> None:
    """One run of every command that takes seconds; `learn`, `compare` (PyTorch) and `mpc` are too
    long or optional."""
    assert re.fullmatch(r"greybox \d+\.\d+\.\d+\S*\n", run("--version"))
    run("--help")
    for template in ("crazyflie", "duckiedrone", "plus", "racer250", "x"):
        run("vehicle", "new", "--template", template, "--out", f"{template}.toml")
        run("vehicle", "check", f"{template}.toml")
    run("inspect", TRAIN, "--vehicle", VEHICLE)
    run("check", TRAIN, "--vehicle", VEHICLE)
    run(
        "fit",
        "--manual",
        "--vehicle",
        VEHICLE,
        "--rate",
        "200",
        "--effects",
        "motor_lag,command_delay",
        "--train",
        TRAIN,
        "--test",
        TEST,
        "--out",
        "fitted",
        code=1,
    )
    # Without disturbances this model loses to the last value on the other log, which is said and
    # has to be overruled.
    assert run("validate", "fitted/model.json", "--log", TEST, code=1).startswith("NOT USABLE")
    run("export", "fitted/model.json", "--out", "craft", "--no-cache", code=1)
    run(
        "linear",
        "--train",
        TRAIN,
        "--vehicle",
        VEHICLE,
        "--rate",
        "100",
        "--inputs",
        "roll=u3+u4-u1-u2,pitch=u2+u3-u1-u4",
        "--outputs",
        "p,q",
        "--order",
        "4",
        "--out",
        "lin",
    )
    run("plan", "--vehicle", "x.toml", "--flights", "1", "--seconds", "10", "--out", "plan")
    run("export", "fitted/model.json", "--out", "craft", "--no-cache", "--even-so")
    run("-m", "mpc_export.verify", "craft", program="python")
    run("effects")
    run("examples")
    run("examples", SET, "--out", "flights of my own")
    assert (Path("flights of my own") / "LICENSE").stat().st_size > 100
    run("effects", "--json", "-")
    run("cite", "fitted/model.json")
    run("completion", "bash")
    assert "greybox works here" in run("selftest")
    run("demo", "--out", "demo")
    assert (Path("demo") / "missing_effect" / "report.html").stat().st_size > 100
    for kind in ("report.html", "fit.json", "validate.json"):
        assert (Path("fitted") / kind).stat().st_size > 100, kind


def formats(writers: Path) -> None:
    """A log of every format is inspected and can be fitted."""
    spec = importlib.util.spec_from_file_location("writers", writers)
    assert spec is not None
    assert spec.loader is not None
    w = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(w)
    truth = w.channels(rows=400)
    Path("map.toml").write_text(w.ROS_MAPPING)
    own = ["--mapping", "map.toml"]
    logs = {
        "f.ulg": (w.write_ulog, []),
        "log00": (w.write_crazyflie, []),
        "f.bbl": (w.write_betaflight, []),
        "f.parquet": (w.write_parquet, []),
        "f.mat": (w.write_mat, []),
        "f.csv": (w.write_csv, []),
        "f.bag": (lambda p, c: w.write_ros(p, c, kind="bag"), own),
        "sqlite": (lambda p, c: w.write_ros(p, c, kind="sqlite"), own),
        "mcap": (lambda p, c: w.write_ros(p, c, kind="mcap"), own),
    }
    for name, (write, extra) in logs.items():
        run("inspect", str(write(Path(name), truth)), *extra)


if __name__ == "__main__":
    if importlib.util.find_spec("scenarios") is not None:
        sys.exit("an installed greybox brings a package scenarios, which is of the checkout")
    if Path(sys.prefix) not in Path(greybox.__file__).parents:
        sys.exit(f"{greybox.__file__} is not in {sys.prefix}")
    readme(Path(sys.argv[1]))
    commands()
    formats(Path(sys.argv[2]))
    print("all of it works")
