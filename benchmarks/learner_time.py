"""What does one evaluation of an exported LSTM, neural network or Gaussian process cost at the same
held-out error?

    python -m benchmarks.learner_time [--seeds 1022]

All learn the same function, the next change of six outputs from the last four samples, from the
same 20 s of the record of `scenarios.studies.paper_data`: the LSTM of Ghoul et al. with one or two
layers, a network of two tanh layers with a Bayesian last layer (`--learner neural`), a sparse
Gaussian process; each in several sizes. Every size is exported, the C of its learned part compiled
with the flags printed, and the candidates take turns (median of CPU time, one thread). The level
that all reach is the lowest error on 20-25 s of the learner that is worst there; of each learner
the quickest size within it counts. The errors on 25-30 s, which nothing was chosen by, stand
beside.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import casadi as ca  # noqa: E402 (after the thread counts)
import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from benchmarks.export_speed import Timer, shared_library  # noqa: E402
from greybox.baselines.lstm_train import LSTMSettings, train_lstm  # noqa: E402
from greybox.baselines.narx import fit_narx  # noqa: E402
from greybox.baselines.regressors import Lags  # noqa: E402
from greybox.residual.candidates import feature_candidates  # noqa: E402
from greybox.residual.discrepancy import Discrepancy  # noqa: E402
from greybox.residual.feature_posterior import FeaturePosterior  # noqa: E402
from greybox.residual.learners.learner import Features  # noqa: E402
from greybox.residual.learners.neural import trained  # noqa: E402
from greybox.residual.posterior import GPPosterior  # noqa: E402
from greybox.residual.weight_space import fitted  # noqa: E402
from greybox.symbolic import evaluate  # noqa: E402
from mpc_export.c_code import FAST_FLAGS, write_c  # noqa: E402
from mpc_export.c_kernels import gp_kernels  # noqa: E402
from mpc_export.functions import model_functions  # noqa: E402
from mpc_export.innovation_form import LagForm  # noqa: E402
from mpc_export.predictors import Learned, PredictorModel, predictor_model  # noqa: E402
from scenarios.studies.paper_data import DT, OUTPUTS, TEST, TRAIN, VALIDATION, PaperData, paper_data  # noqa: E402
from scenarios.studies.paper_methods import BLACK_BOX_INPUTS  # noqa: E402

Array = NDArray[np.float64]

RESULTS = Path(__file__).resolve().parent / "results"
INPUTS = BLACK_BOX_INPUTS[0]
PAST = 4
SIZES: Mapping[str, Sequence[int]] = {
    "LSTM": (4, 16, 64),
    "LSTM, 2 layers": (16,),
    "MLP": (1, 2, 4, 8),
    "GP": (10, 30, 100),
}
"""Hidden units, units of the second hidden layer, support points."""
STRENGTHS = (1e-2, 1e-1, 1.0, 1e1, 1e2)
"""Variance of the noise over that of a weight, to choose from on 20-25 s."""
QUANTITIES = {"mean": "mean", "mean and Jacobian": "mean_jac"}


@dataclass(frozen=True, kw_only=True)
class Size:
    """One trained size: errors in units of the training variance, mean over outputs and records;
    microseconds per call."""

    learner: str
    size: int
    numbers: int
    validation: float
    test: float
    truth: float
    microseconds: Mapping[str, float]


class Units:
    """The learner `neural` with as many units as asked for, one start."""

    name = "neural"

    def features(self, x: Array, y: Array, *, points: int, seed: int) -> Mapping[str, Features]:
        """The units of a network trained on all rows."""
        return {"network": trained(x, y, units=points, seed=seed)}


def network(data: PaperData, lags: Lags, units: int) -> PredictorModel:
    """A neural network on past samples, its last layer in closed form."""
    z, y, flights = lags.pairs(list(data.part(TRAIN).segments))
    zv, yv, _ = lags.pairs(list(data.part(VALIDATION).segments))
    n_y = len(OUTPUTS)
    names = tuple(str(f) for f in flights)
    rows = Discrepancy(
        inputs=lags.layout, outputs=lags.output_layout, z=z, y=y - z[:, :n_y], flights=names
    )
    candidate = feature_candidates(Units(), rows, points=units, seed=data.seed)["network"]

    def phi(at: Array) -> Array:
        return np.asarray(
            evaluate(
                candidate.phi,
                np.ascontiguousarray((at - candidate.input_mean) / candidate.input_scale),
            )
        )

    seen, target = phi(z), rows.y / candidate.output_scale
    held, wanted = phi(zv), (yv - zv[:, :n_y]) / candidate.output_scale
    matrix, right = seen.T @ seen, seen.T @ target

    def weights(strength: float) -> Array:
        return np.asarray(np.linalg.solve(matrix + strength * np.eye(len(matrix)), right))

    # An output's own unit cancels: one strength for all.
    best = min(STRENGTHS, key=lambda s: float(np.mean((wanted - held @ weights(s)) ** 2)))
    level = np.mean((target - seen @ weights(best)) ** 2, axis=0)
    covariance = np.kron(np.eye(n_y), np.linalg.inv(matrix + best * np.eye(len(matrix))))
    last = fitted(candidate, weights(best).T.ravel(), covariance, np.full(n_y, best), level)
    return lagged(replace(last, noise=level * last.output_scale**2), lags)


def lagged(learned: Learned, lags: Lags) -> PredictorModel:
    """What foretells the next change of the outputs, as a model with the past samples as state."""
    form = LagForm(label="mlp", lags=lags, increments=True)
    typical = dict(zip(learned.inputs.names, learned.input_mean.tolist(), strict=True))
    u = np.array([typical[f"{n}[t-1]"] for n in lags.inputs])
    return PredictorModel(
        name="mlp",
        kind="narx",
        form=form,
        learned=learned,
        noise=np.diag(learned.noise),
        dt=DT,
        domain={},
        reference=(form.reference(typical), u),
    )


def made(learner: str, size: int, lags: Lags, data: PaperData) -> tuple[PredictorModel, int]:
    """A trained model and how many numbers it has."""
    train, validation = data.part(TRAIN), data.part(VALIDATION)
    if learner == "MLP":
        model = network(data, lags, size)
        learned = model.learned
        assert isinstance(learned, FeaturePosterior)
        first = (len(learned.inputs) + 1) * 16 + 17 * size
        return model, first + learned.weights.size
    if learner == "GP":
        gp = fit_narx(
            train,
            outputs=OUTPUTS,
            inputs=INPUTS,
            n_a=PAST,
            n_b=PAST,
            increments=True,
            points=size,
            seed=data.seed,
        )
        return predictor_model(gp), gp.parameters
    settings = LSTMSettings(
        n_a=PAST,
        n_b=PAST,
        hidden=size,
        layers=2 if learner.endswith("layers") else 1,
        dropout=0.0,
        increments=True,
    )
    lstm = train_lstm(
        train, validation, outputs=OUTPUTS, inputs=INPUTS, settings=settings, seed=data.seed
    )
    return predictor_model(lstm), lstm.parameters


def errors(model: PredictorModel, data: PaperData, lags: Lags) -> tuple[float, float, float]:
    """One step ahead: of the measurement on 20-25 s and on 25-30 s, and of the truth on 25-30 s."""
    learned = model.learned
    assert learned is not None
    segment = data.segment
    z, y = lags.rows(segment), lags.measured(segment)
    whole = np.flatnonzero(np.isfinite(z).all(axis=1))
    at = ca.MX.sym("z", z.shape[1])
    mean = np.full_like(y, np.nan)
    mean[whole] = evaluate(
        ca.Function("mean", [at], [learned.expressions(at, ("mean",))["mean"]]), z[whole]
    )
    if model.form.increments:  # the LSTM's own function adds the last output
        mean += z[:, : len(OUTPUTS)]
    scale = y[data.rows(TRAIN)].var(axis=0)
    held, test = data.rows(VALIDATION), data.rows(TEST)
    return (
        float(np.mean((y - mean)[held] ** 2 / scale)),
        float(np.mean((y - mean)[test] ** 2 / scale)),
        float(np.mean((data.truth.y - mean)[test] ** 2 / scale)),
    )


def timed(
    timer: Timer, label: str, model: PredictorModel, z: Array, folder: Path, stem: str
) -> dict[str, str]:
    """Adds the C that an export of the model has for its learned part to the timer; quantity ->
    name there."""
    exported = model_functions(model)
    known = exported.functions
    names = {w: n for w, q in QUANTITIES.items() for n in (f"gp_{q}", f"network_{q}") if n in known}
    own = {n: tuple(known[n].name_out()) for n in names.values()}
    kernels = (
        gp_kernels(exported.posterior, own, silent=False)
        if isinstance(exported.posterior, GPPosterior)
        else ()
    )
    source = write_c([known[n] for n in own], folder, prefix=stem, kernels=kernels)
    library = shared_library(folder, stem, source.source, *FAST_FLAGS)
    for what, n in names.items():
        timer.add_c(
            f"{label} {what}", known[n], library, f"{stem}_{n}", [z, exported.parameter_values], 200
        )
    return {what: f"{label} {what}" for what in names}


def measured(
    seeds: Sequence[int], sizes: Mapping[str, Sequence[int]], say: Callable[[str], None]
) -> list[Size]:
    """Every size of every learner: trained on every record, timed as exported from the first."""
    data = [paper_data(s) for s in seeds]
    lags = Lags(outputs=OUTPUTS, inputs=INPUTS, n_a=PAST, n_b=PAST)
    z = lags.rows(data[0].segment)[data[0].rows(TEST).start]
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as name:
        timer = Timer(Path(name))
        for learner, size in ((k, n) for k, many in sizes.items() for n in many):
            models = [made(learner, size, lags, d) for d in data]
            found = [errors(m, d, lags) for (m, _), d in zip(models, data, strict=True)]
            validation, test, truth = np.mean(found, axis=0).tolist()
            names = timed(timer, f"{learner} {size}", models[0][0], z, Path(name), f"m{len(rows)}")
            rows.append(
                {
                    "learner": learner,
                    "size": size,
                    "numbers": models[0][1],
                    "names": names,
                    "validation": validation,
                    "test": test,
                    "truth": truth,
                }
            )
            say(f"{learner} {size}: error {validation:.3e} to choose by, {test:.3e} judged")
        us = timer.run()
    return [Size(microseconds={w: us[n] for w, n in r.pop("names").items()}, **r) for r in rows]


def chosen(rows: Sequence[Size]) -> tuple[float, list[Size]]:
    """The level that every learner reaches on 20-25 s, and of each the quickest size within it;
    LSTMs are one learner."""
    kinds = {r.learner.partition(",")[0] for r in rows}
    own = {k: [r for r in rows if r.learner.partition(",")[0] == k] for k in sorted(kinds)}
    level = max(min(r.validation for r in many) for many in own.values())
    within = {k: [r for r in many if r.validation <= level] for k, many in own.items()}
    return level, [
        min(many, key=lambda r: r.microseconds["mean and Jacobian"]) for many in within.values()
    ]


def table(rows: Sequence[Size]) -> str:
    """One line per size."""
    head = f"{'learner':16s}{'size':>6s}{'numbers':>9s}{'to choose':>11s}{'judged':>11s}{'to truth':>11s}"
    lines = [head + "".join(f"{w:>19s}" for w in QUANTITIES)]
    for r in rows:
        us = "".join(
            f"{r.microseconds[w]:16.2f} us" if w in r.microseconds else f"{'-':>19s}"
            for w in QUANTITIES
        )
        errors_ = f"{r.validation:11.2e}{r.test:11.2e}{r.truth:11.2e}"
        lines.append(f"{r.learner:16s}{r.size:6d}{r.numbers:9d}{errors_}{us}")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Train, export, time, print; the result goes to `results/learner_time.json`."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[1022], help="records")
    parser.add_argument("--out", type=Path, default=RESULTS / "learner_time.json", metavar="F.json")
    options = parser.parse_args(arguments)
    rows = measured(options.seeds, SIZES, lambda text: print(text, flush=True))
    level, best = chosen(rows)
    print(f"\nOne step ahead, mean over {len(options.seeds)} records; gcc {' '.join(FAST_FLAGS)}\n")
    print(table(rows))
    print(f"\nQuickest of each within {level:.2e} on 20-25 s\n\n{table(best)}\n")
    gp = next(r for r in best if r.learner == "GP")
    for what in QUANTITIES:
        own = {
            r.learner: r.microseconds[what] / gp.microseconds[what]
            for r in best
            if what in r.microseconds
        }
        print(
            f"{what}: "
            + ", ".join(f"{n} {v:.2f}" for n, v in own.items())
            + " times the time of the GP"
        )
    body = {
        "question": __doc__.splitlines()[0],
        "machine": platform.machine(),
        "flags": " ".join(FAST_FLAGS),
        "seeds": options.seeds,
        "level": level,
        "rows": [asdict(r) for r in rows],
        "chosen": [asdict(r) for r in best],
    }
    options.out.write_text(json.dumps(body, indent=1) + "\n")


if __name__ == "__main__":
    main()
