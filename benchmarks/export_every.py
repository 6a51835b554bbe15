"""What does every kind of fitted thing cost per call once it is C?

    python -m benchmarks.export_every [--only physics] [--out F.json]

Microseconds of CPU time of the output h, the step f_d, both with their Jacobians, one step of the
covariance and one of the filter; compiled as in `export_speed`, sources beyond `LARGE` with
`GENERATED_FLAGS`, called from one C loop, median of the turns. The numbers of the models are
random, their sizes those of a quadrotor: 10 features, six learned outputs, 50 support points or
features, four commands. It needs the checkout's `tests`.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import platform
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import numpy as np  # noqa: E402 (after the thread counts)

from benchmarks.export_speed import POINTER, TURNS, Timer, shared_library  # noqa: E402
from benchmarks.gpytorch_export import made  # noqa: E402
from greybox.baselines.base_predictor import BasePredictor  # noqa: E402
from greybox.baselines.linear_predictor import LinearPredictor  # noqa: E402
from greybox.baselines.lstm import LSTMModel  # noqa: E402
from greybox.baselines.narx import NARXModel  # noqa: E402
from greybox.baselines.output_residual import OutputHybrid  # noqa: E402
from greybox.baselines.predictor_features import layout_of  # noqa: E402
from greybox.baselines.regressors import Lags  # noqa: E402
from greybox.model.layer import LongerWindow  # noqa: E402
from greybox.model.linear import LinearModel  # noqa: E402
from greybox.model.matrices import Matrices  # noqa: E402
from greybox.residual.candidates import FeatureMaker  # noqa: E402
from greybox.residual.discrepancy import Discrepancy  # noqa: E402
from greybox.residual.feature_posterior import FeaturePosterior  # noqa: E402
from greybox.residual.features import feature_layout, with_lags  # noqa: E402
from greybox.residual.from_gpytorch import from_gpytorch  # noqa: E402
from greybox.residual.hybrid import HybridModel  # noqa: E402
from greybox.residual.learners import LEARNERS, LooksBack, learner_of  # noqa: E402
from greybox.symbolic import Layout, Signal  # noqa: E402
from mpc_export.c_code import FAST_FLAGS, GENERATED_FLAGS, write_c  # noqa: E402
from mpc_export.c_kernels import kernels_of  # noqa: E402
from mpc_export.functions import model_functions  # noqa: E402
from tests.mpc_export import cases  # noqa: E402
from tests.mpc_export.predictor_cases import posterior  # noqa: E402
from tests.residual import hybrid_cases  # noqa: E402

COLUMNS = {
    "h": ("h", "gp_mean"),
    "h, Jacobian": ("h_jac_raw", "gp_mean_jac"),
    "step": ("f_d",),
    "step, Jacobian": ("f_d_jac_raw",),
    "covariance": ("covariance_step", "gp_all"),
    "filter": ("filter_step",),
}
"""Column -> functions of an export, the first that there is; of a process alone its own."""
LARGE = 4_000_000
"""Bytes of C of which -O3 takes more than a quarter of an hour (the lstm's 6.4 million)."""
POINTS = 50
RATES, FORCES = ("p", "q", "r"), ("ax", "ay", "az")
UNITS = dict.fromkeys(RATES, "rad/s") | dict.fromkeys(FORCES, "m/s^2")
COMMANDS = ("u1", "u2", "u3", "u4")
FEATURES = (*(f"body_velocity.{a}" for a in "xyz"), *RATES, *(f"nu{i}" for i in (1, 2, 3, 4)))
WRENCH = tuple(f"{g}.{a}" for g in ("force", "torque") for a in "xyz")
LAGS = Lags(outputs=RATES + FORCES, inputs=COMMANDS, n_a=4, n_b=4, newest=1)


def signals(names: tuple[str, ...]) -> Layout:
    return Layout([Signal(name=n, unit=UNITS.get(n, "1")) for n in names])


def linear(outputs: tuple[str, ...], inputs: tuple[str, ...], order: int) -> BasePredictor:
    """A stable model of random numbers in innovation form, commands a sample late."""
    rng = np.random.default_rng(0)
    a = np.linalg.qr(rng.standard_normal((order, order)))[0] * 0.9
    b, c = rng.standard_normal((order, len(inputs))), rng.standard_normal((len(outputs), order))
    gain = 0.1 * rng.standard_normal((order, len(outputs)))
    model = LinearModel(
        name="body",
        matrices=Matrices(a, b, c, np.zeros((len(outputs), len(inputs))), gain),
        noise=1e-3 * np.eye(len(outputs)),
        dt=0.01,
        inputs=signals(inputs),
        outputs=signals(outputs),
        delays=(1,) * len(inputs),
        input_offset=np.zeros(len(inputs)),
        output_offset=np.zeros(len(outputs)),
    )
    return LinearPredictor(model=model, outputs=outputs, channels={n: ((1.0, n),) for n in inputs})


def siso() -> BasePredictor:
    return linear(("p",), ("u1",), 3)


def mimo() -> BasePredictor:
    return linear(RATES + FORCES, COMMANDS, 8)


def output_hybrid(base: BasePredictor) -> OutputHybrid:
    names = (*base.outputs, *(f"{u}[t-{k}]" for u in COMMANDS for k in (1, 2)))[:10]
    layout = layout_of(base, names)
    return OutputHybrid(base=base, posterior=posterior(layout, signals(base.outputs), 0, POINTS))


def narx() -> NARXModel:
    return NARXModel(
        lags=LAGS,
        increments=True,
        posterior=posterior(LAGS.layout, LAGS.output_layout, 0, POINTS),
        dt=0.01,
    )


def lstm(size: int) -> LSTMModel:
    rng, width = np.random.default_rng(0), len(LAGS.outputs) + len(LAGS.inputs)
    layers = tuple(
        (
            0.3 * rng.standard_normal((4 * size, d)),
            0.3 * rng.standard_normal((4 * size, size)),
            rng.standard_normal(4 * size),
        )
        for d in (width, size)
    )
    return LSTMModel(
        lags=LAGS,
        increments=True,
        input_mean=np.zeros(LAGS.width),
        input_scale=np.ones(LAGS.width),
        target_mean=np.zeros(6),
        target_scale=np.full(6, 0.1),
        layers=layers,
        head=(rng.standard_normal((6, size)), np.zeros(6)),
        variance=np.full((2, 6), 1e-3),
        dt=0.01,
    )


def physics() -> Any:
    return cases.identified(hybrid_cases.craft())


def on_physics(learner: str) -> Any:
    """The craft with a push on force and torque that a learner makes, last layer random."""
    craft, rng = hybrid_cases.craft(), np.random.default_rng(0)
    if learner == "gp":
        push: Any = hybrid_cases.push(craft, FEATURES, WRENCH, points=POINTS)
        return cases.identified(HybridModel(inner=craft, posterior=push))
    chosen, names, inner = learner_of(learner), FEATURES, craft
    if isinstance(chosen, LooksBack):
        lags = chosen.lags(0.01)
        names, inner = with_lags(craft, FEATURES, lags), LongerWindow(inner=craft, past=lags)
    outputs = Layout([craft.noises.signals[craft.noises[c]] for c in WRENCH])
    z = rng.standard_normal((400, len(names)))
    rows = Discrepancy(
        inputs=feature_layout(craft, names),
        outputs=outputs,
        z=z,
        y=np.sin(z[:, :6]) * z[:, 1:7] + 0.1 * rng.standard_normal((400, 6)),
        flights=tuple(f"f{i // 100}" for i in range(400)),
    )
    maker = FeatureMaker(learner=chosen, sets={"all": rows}, points=POINTS, seed=0)
    found = next(iter(maker.candidates(lambda _text, _share: None).values()))
    assert isinstance(found, FeaturePosterior)
    push = replace(
        found,
        weights=rng.standard_normal(found.weights.shape),
        root=0.1 * rng.standard_normal(found.root.shape),
    )
    return cases.identified(HybridModel(inner=inner, posterior=push))


THINGS: dict[str, Callable[[], Any]] = {
    "physics": physics,
    **{f"physics + {n}": lambda n=n: on_physics(n) for n in ("gp", *LEARNERS)},  # type: ignore[misc]
    "linear SISO": siso,
    "linear MIMO": mimo,
    "linear SISO + GP": lambda: output_hybrid(siso()),
    "linear MIMO + GP": lambda: output_hybrid(mimo()),
    "NARX": narx,
    "LSTM, 2 x 16 units": lambda: lstm(16),
    "GP alone": lambda: posterior(
        signals(tuple(f"z{i}" for i in range(10))), signals(RATES + FORCES), 0, POINTS
    ),
    "from_gpytorch": lambda: from_gpytorch(*made(100, 10)),
}


def microseconds(thing: Any, folder: Path) -> dict[str, float | None]:
    """Column of the table -> median microseconds of a call; None where there is no such
    function."""
    folder.mkdir()
    functions = model_functions(thing, with_=("covariance", "filter"))
    there = functions.functions
    chosen = {c: next((n for n in names if n in there), None) for c, names in COLUMNS.items()}
    if not functions.states:  # a process alone is its output
        chosen |= {"step": None, "step, Jacobian": None, "filter": None}
        chosen |= {"h": "gp_mean", "h, Jacobian": "gp_mean_jac", "covariance": "gp_all"}
    made = [there[n] for n in dict.fromkeys(chosen.values()) if n is not None]
    source = write_c(made, folder, prefix="every", kernels=kernels_of(functions))
    flags = FAST_FLAGS if source.source.stat().st_size < LARGE else GENERATED_FLAGS
    library = shared_library(folder, "every", source.source, *flags)
    sizes = {f.name: f for f in source.functions}
    rng = np.random.default_rng(1)
    if functions.states:
        values = cases.point(functions, rng, 0.1)
    else:
        values = {"z": rng.standard_normal(len(functions.features)), "p": np.zeros(0)}
    timer = Timer(folder)
    for function in made:
        add(timer, function, library, sizes[function.name()], values)
    found = timer.run()
    return {c: None if n is None else found[n] for c, n in chosen.items()}


def add(timer: Timer, function: Any, library: Any, size: Any, values: dict[str, Any]) -> None:
    """A candidate with the sizes of the C, which kernels change; checked against CasADi."""
    names = [function.name_in(i) for i in range(function.n_in())]
    sent = [np.asfortranarray(values[n], float).ravel(order="F") for n in names]
    results = [np.zeros(max(1, function.nnz_out(i))) for i in range(function.n_out())]
    arg = (POINTER * (size.sz_arg + 8))(*(a.ctypes.data_as(POINTER) for a in sent))
    res = (POINTER * (size.sz_res + 8))(*(r.ctypes.data_as(POINTER) for r in results))
    iw, w = (ctypes.c_longlong * (size.sz_iw + 8))(), np.zeros(size.sz_w + 8)
    code = getattr(library, f"every_{function.name()}")
    timer.keep += [sent, results, library, iw, w]
    assert code(arg, res, iw, w.ctypes.data_as(POINTER), 0) == 0
    for got, want in zip(results, function.call([values[n] for n in names]), strict=True):
        exact = np.array(want.nonzeros())
        scale = max(1.0, np.abs(exact).max(initial=0.0))
        assert np.abs(got[: exact.size] - exact).max(initial=0.0) < 1e-8 * scale, function.name()
    timer.candidates[function.name()] = (
        lambda n: timer.driver.time_casadi(code, arg, res, iw, w.ctypes.data_as(POINTER), n),
        200,
    )


def table(rows: dict[str, dict[str, float | None]]) -> str:
    """The rows as text."""
    lines = [f"{'us a call':28s}" + "".join(f"{c:>16s}" for c in COLUMNS)]
    for name, found in rows.items():
        cells = ("-" if v is None else f"{v:.2f}" for v in found.values())
        lines.append(f"{name:28s}" + "".join(f"{c:>16s}" for c in cells))
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="things whose name holds this")
    parser.add_argument("--out", type=Path, metavar="F.json", help="default: its file in results")
    options = parser.parse_args()
    if not shutil.which("gcc"):
        raise SystemExit("gcc is needed")
    rows = {}
    with tempfile.TemporaryDirectory() as name:
        for i, (thing, make) in enumerate(THINGS.items()):
            if options.only in thing:
                rows[thing] = microseconds(make(), Path(name) / str(i))
                print(table({thing: rows[thing]}), flush=True)
    print(table(rows))
    content = {
        "question": __doc__.splitlines()[0],
        "unit": f"us of CPU time, median of {TURNS} turns",
        "machine": platform.machine(),
        "flags": " ".join(FAST_FLAGS),
        "flags of large sources": " ".join(GENERATED_FLAGS),
        "microseconds": rows,
    }
    if options.out or not options.only:
        out = options.out or Path(__file__).parent / "results" / "export_every.json"
        out.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
