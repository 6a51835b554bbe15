"""How many steps of 10 ms does a twin fly in a second of CPU, one craft and a thousand, beside
others?

    python -m benchmarks.twin_speed [MODEL.json] [--out F.json]

Runs what is installed: the written NumPy and JAX modules, RotorPy (one craft and its batch for
torch), drone-models and crazyflow's first-principles rates (one Runge-Kutta step per 10 ms, in
NumPy and in JAX). CPU time of one thread, the best of three runs, compilation apart. Without MODEL:
the example craft.
"""

from __future__ import annotations

import os

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[name] = "1"
os.environ.setdefault(
    "XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
)
os.environ.setdefault("SCIPY_ARRAY_API", "1")

import argparse  # noqa: E402
import datetime  # noqa: E402
import importlib.metadata  # noqa: E402
import platform  # noqa: E402
import tempfile  # noqa: E402
import time  # noqa: E402
import tomllib  # noqa: E402
from collections.abc import Callable, Iterator, Sequence  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

import numpy as np  # noqa: E402

from greybox.files import write_json  # noqa: E402
from greybox.simulators.make import twin  # noqa: E402
from scenarios.twins.written import load  # noqa: E402

DT, MANY, BUDGET, RUNS = 0.01, 1000, 1.0, 3
Step = Callable[[], Any]
PACKAGES = ("numpy", "jax", "torch", "rotorpy", "drone-models", "crazyflow")


def rate(step: Step, craft: int) -> float:
    """Craft-steps per second of CPU: the best of `RUNS` runs of about `BUDGET` seconds in all."""
    step()
    begin = time.process_time()
    step()
    count = max(1, int(BUDGET / RUNS / max(time.process_time() - begin, 1e-6)))
    best = 0.0
    for _ in range(RUNS):
        begin = time.process_time()
        for _ in range(count):
            step()
        best = max(best, count * craft / (time.process_time() - begin))
    return best


def ours(folder: Path) -> Iterator[tuple[str, int, Step]]:
    """simulate.py."""
    (module,) = load(folder / "numpy", "simulate")
    for n in (1, MANY):
        sim = module.Simulator(craft=None if n == 1 else n)
        yield "greybox, NumPy", n, lambda sim=sim: sim.step(module.HOVER)


def ours_in_jax(folder: Path) -> Iterator[tuple[str, int, Step]]:
    """simulate_jax.py, compiled."""
    import jax

    (module,) = load(folder / "jax", "simulate_jax")
    for n in (1, MANY):
        run = jax.jit(jax.vmap(module.advance, in_axes=(0, 0, 0)))
        x, window, u = (
            np.tile(v, (n, *[1] * np.ndim(v))) for v in (module.START, module.WINDOW, module.HOVER)
        )
        yield "greybox, JAX", n, lambda run=run, a=(x, window, u): jax.block_until_ready(run(*a))


def rotorpy(folder: Path) -> Iterator[tuple[str, int, Step]]:
    """RotorPy's Multirotor with the written numbers."""
    from rotorpy.vehicles.multirotor import Multirotor

    (vehicle,) = load(folder / "rotorpy", "vehicle")
    craft, state = Multirotor(vehicle.quad_params, vehicle.initial_state()), vehicle.initial_state()
    control = {"cmd_motor_speeds": state["rotor_speeds"]}
    yield "RotorPy", 1, lambda: craft.step(state, control, DT)


def rotorpy_batch(folder: Path) -> Iterator[tuple[str, int, Step]]:
    """Its batch on torch."""
    import roma  # noqa: F401  (its batch needs both)
    import torch
    import torchdiffeq  # noqa: F401
    from rotorpy.vehicles.multirotor import BatchedMultirotor, BatchedMultirotorParams

    torch.set_num_threads(1)
    (vehicle,) = load(folder / "rotorpy", "vehicle")
    device = torch.device("cpu")
    one = vehicle.initial_state()
    state = {k: torch.tensor(np.tile(v, (MANY, 1)), dtype=torch.double) for k, v in one.items()}
    params = BatchedMultirotorParams([vehicle.quad_params] * MANY, MANY, device)
    craft = BatchedMultirotor(params, MANY, state, device=device)
    control = {"cmd_motor_speeds": state["rotor_speeds"]}
    yield "RotorPy, torch batch", MANY, lambda: craft.step(state, control, DT)


def first_principles(folder: Path, package: str, jit: bool) -> Iterator[tuple[str, int, Step]]:
    """Rates of drone-models or crazyflow by Runge-Kutta."""
    from scenarios.twins.written import _KEYS, _first_principles

    dynamics = _first_principles(package)
    (numbers,) = tomllib.loads((folder / package / "params.toml").read_text()).values()
    (commands,) = load(folder / package, "commands")
    p = {k: np.array(v, dtype=float) for k, v in numbers.items() if k in _KEYS}
    p["J_inv"] = np.linalg.inv(p["J"])
    if jit:
        import jax
        import jax.numpy as xp

        p = {k: xp.asarray(v) for k, v in p.items()}
    else:
        xp = np  # type: ignore[misc]

    def rates(s: Any, cmd: Any) -> Any:
        quat, ang = s[..., 3:7], s[..., 10:13]
        d = dynamics(s[..., :3], quat, s[..., 7:10], ang, cmd, s[..., 13:], **p)
        return xp.concatenate([d[0], d[1], d[2], d[3], d[4]], axis=-1)

    def step(s: Any, cmd: Any) -> Any:
        k1 = rates(s, cmd)
        k2 = rates(s + DT / 2 * k1, cmd)
        k3 = rates(s + DT / 2 * k2, cmd)
        return s + DT / 6 * (k1 + 2 * (k2 + k3) + rates(s + DT * k3, cmd))

    hover = np.full(4, commands.RPM_MAX * commands.HOVER)
    one = np.concatenate([np.zeros(6), [1.0], np.zeros(6), hover])
    for n in (1, MANY):
        s, cmd = (one, hover) if n == 1 else (np.tile(one, (n, 1)), np.tile(hover, (n, 1)))
        if jit:
            import jax

            run = jax.jit(step)
            s, cmd = xp.asarray(s), xp.asarray(cmd)
            yield f"{package}, JAX", n, lambda run=run, a=(s, cmd): jax.block_until_ready(run(*a))
        else:
            yield f"{package}, NumPy", n, lambda a=(s, cmd): step(*a)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("model", nargs="?", metavar="MODEL.json")
    parser.add_argument("--out", metavar="F.json")
    options = parser.parse_args(arguments)
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        twin(
            _model(options.model),
            ("numpy", "jax", "rotorpy", "drone-models", "crazyflow"),
            out=folder,
            even_so=True,
        )
        for found in (
            ours(folder),
            ours_in_jax(folder),
            rotorpy(folder),
            rotorpy_batch(folder),
            first_principles(folder, "drone-models", False),
            first_principles(folder, "crazyflow", True),
        ):
            try:
                for who, craft, step in found:
                    rows.append({"who": who, "craft": craft, "steps_per_second": rate(step, craft)})
                    print(
                        f"{who:24} {craft:5d} craft  {rows[-1]['steps_per_second']:12,.0f} steps/s",
                        flush=True,
                    )
            except (ImportError, RuntimeError) as missing:
                print(f"not measured: {missing}")
    if options.out:
        about = {
            "question": "How many steps does a written twin fly in a second of CPU, beside other "
            "simulators?",
            "date": datetime.date.today().isoformat(),
            "machine": platform.machine(),
            "cores": os.cpu_count(),
            "load": os.getloadavg(),
            "seconds_per_step": DT,
            "versions": {n: _version(n) for n in PACKAGES},
        }
        write_json(options.out, {**about, "rows": rows})


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _model(path: str | None) -> Any:
    if path is not None:
        from greybox.residual.files import load_model

        return load_model(path)
    from greybox.model.example import example_vehicle
    from greybox.simulators.data_sheet import model_of

    return model_of(example_vehicle())


if __name__ == "__main__":
    main()
