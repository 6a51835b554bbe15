"""Everything that greybox fits exports as a state-space predictor that says what its source says:
one step, many steps, mean and variance, with its Jacobians; in CasADi, in C and from its file."""

from __future__ import annotations

import json
import subprocess
import sys

import casadi as ca
import numpy as np
import pytest

from greybox.baselines.base_predictor import BasePredictor
from greybox.baselines.output_residual import OutputHybrid
from greybox.baselines.predictor_features import last_errors
from greybox.data.channel import is_canonical
from greybox.errors import FileFormatError, GreyboxError, ModelError
from greybox.model.linear import LinearModel
from greybox.residual.gaussian_process import GaussianProcess
from mpc_export.bundle import ExportBundle, write_bundle
from mpc_export.functions import model_functions
from mpc_export.predictors import read_model
from mpc_export.verify import main as verify
from tests.mpc_export import compiled
from tests.mpc_export.predictor_cases import (
    ALONE,
    DT,
    PREDICTORS,
    mimo,
    network,
    pieced,
    segment,
    siso,
)

EVERYTHING = {**PREDICTORS, **ALONE}
GROUPS = ("covariance", "filter")
START, HORIZON = 25, 8


@pytest.fixture(scope="module")
def exported():
    """Name -> (source, functions), built once."""
    found = {}

    def get(name):
        if name not in found:
            source = EVERYTHING[name]()
            found[name] = source, model_functions(source, with_=GROUPS)
        return found[name]

    return get


def columns(functions, flight, k):
    """u and p at sample k of a flight; measured features `phi[t-1]` from their column."""

    def at(name):
        column, _, late = name.partition("[t-")
        return float(flight.channels[column][k - int(late[:-1] or 0) if late else k])

    u = np.array([at(n) for n in functions.inputs.names])
    return u, np.array([at(n) for n in functions.parameters.names])


def filtered(functions, flight, last):
    """States x(k) of the exported filter from sample 5 to `last`, and its predictions there; 0 as
    measured before."""
    outputs = functions.outputs.names
    x, states, means = np.zeros(functions.sizes["n_x"]), {}, {}
    there = np.ones(functions.sizes["n_e"])
    names = functions.states.names
    for i, n in enumerate(names):  # lags of columns are known from the flight
        column, _, late = n.partition("[t-")
        if late and column in flight.channels:
            x[i] = flight.channels[column][5 - int(late[:-1])]
    for k in range(5, last + 1):
        u, p = columns(functions, flight, k)
        y = np.array([flight.channels[n][k] for n in outputs])
        states[k] = x
        after, _, mean = functions["filter_step"](x, u, p, y, there)
        x, means[k] = np.asarray(after).ravel(), np.asarray(mean).ravel()
    return states, means


def base_state(source, flight, functions, k):
    """The state that the source itself has at sample k, in the export's order (linear bases)."""
    run = source.base.run(flight) if isinstance(source, OutputHybrid) else source.run(flight)
    base = source.base if isinstance(source, OutputHybrid) else source
    errors = last_errors(base, flight, run)
    out = []
    for n in functions.states.names:
        if n.startswith("history."):
            _, channel, lag = (
                n.split(".")
                if n.count(".") == 2
                else (*n.rsplit(".", 1)[0].split(".", 1), n.rsplit(".", 1)[1])
            )
            terms = base.channels[channel]
            out.append(sum(w * flight.channels[c][k - int(lag)] for w, c in terms))
        elif n.startswith("error."):
            out.append(
                errors[k, base.outputs.index(n.removeprefix("error.").removesuffix("[t-1]"))]
            )
        elif "[t-" in n:
            column, _, late = n.partition("[t-")
            out.append(flight.channels[column][k - int(late[:-1])])
        else:
            out.append(run.states[k, int(n[1:]) - 1])
    return np.array(out, dtype=float)


def start_of(source, functions, flight, k):
    if isinstance(source, (OutputHybrid, BasePredictor)):
        return base_state(source, flight, functions, k)
    return filtered(functions, flight, k)[0][k]


@pytest.mark.parametrize("name", PREDICTORS)
def test_one_step_is_the_sources(exported, name):
    source, f = exported(name)
    flight = segment()
    mean, variance = source.one_step(flight)
    zero = np.zeros((f.sizes["n_d"],) * 2)
    for k in (START, START + 11):
        x = start_of(source, f, flight, k)
        u, p = columns(f, flight, k)
        assert np.asarray(f["h"](x, u, p)).ravel() == pytest.approx(mean[k], rel=1e-9, abs=1e-12)
        spread = np.diag(np.asarray(f["output_covariance"](x, u, p, zero)))
        assert spread == pytest.approx(variance[k], rel=1e-9)


@pytest.mark.parametrize("name", PREDICTORS)
def test_the_filter_is_the_sources_own_recursion(exported, name):
    source, f = exported(name)
    flight = segment()
    mean, _ = source.one_step(flight)
    x = start_of(source, f, flight, START)
    for k in range(START, START + 10):
        u, p = columns(f, flight, k)
        y = np.array([flight.channels[n][k] for n in f.outputs.names])
        after, e, foretold = (
            np.asarray(v).ravel() for v in f["filter_step"](x, u, p, y, np.ones(f.sizes["n_e"]))
        )
        assert foretold == pytest.approx(mean[k], rel=1e-9, abs=1e-12)
        assert e == pytest.approx(y - mean[k], rel=1e-9, abs=1e-12)
        x = after


@pytest.mark.parametrize("name", PREDICTORS)
def test_many_steps_are_the_sources_in_mean_and_variance(exported, name):
    source, f = exported(name)
    flight = segment()
    mean, variance = source.free_run(flight, [START - 1], HORIZON)
    x = start_of(source, f, flight, START)
    nd, ng = f.sizes["n_d"], f.sizes["n_g"]
    sigma, c, gain = np.zeros((nd, nd)), np.zeros((nd, ng)), np.zeros((f.sizes["n_u"], nd))
    _, held = columns(f, flight, START)  # measured features keep their value over a prediction
    consider = isinstance(source, OutputHybrid)
    for h in range(HORIZON):
        u, _ = columns(f, flight, START + h)
        assert np.asarray(f["h"](x, u, held)).ravel() == pytest.approx(
            mean[0, h], rel=1e-9, abs=1e-12
        )
        if consider:
            spread = f["output_consider"](x, u, held, sigma, c)
            sigma, c = f["consider_step"](x, u, held, gain, sigma, c)[:2]
        else:
            spread = f["output_covariance"](x, u, held, sigma)
            sigma = f["covariance_step"](x, u, held, sigma)
        if (
            "LSTM" not in name
        ):  # a network's free run has the variances that were measured on validation data
            assert np.diag(np.asarray(spread)) == pytest.approx(variance[0, h], rel=1e-8)
        x = np.asarray(f["f_d"](x, u, held)).ravel()


@pytest.mark.parametrize("name", EVERYTHING)
def test_jacobians_are_slopes_of_the_functions(exported, name):
    _, f = exported(name)
    rng = np.random.default_rng(3)
    x, u = (
        f.reference[0] + 0.1 * rng.standard_normal(f.sizes["n_x"]),
        f.reference[1] + 0.1 * rng.standard_normal(f.sizes["n_u"]),
    )
    p = f.parameter_values + 0.1
    pairs = {"h": "h_jac_raw", "f_d": "f_d_jac_raw"} if f.sizes["n_x"] else {"h": "h_jac_raw"}
    for value, slopes in pairs.items():
        own = [ca.MX.sym(n, v.size) for n, v in (("x", x), ("u", u), ("p", p))]
        out = f[value](*own)
        truth = ca.Function("truth", own, [ca.jacobian(out, v) for v in own])(x, u, p)
        for want, got in zip(truth, f[slopes](x, u, p)[1:]):
            assert np.abs(np.asarray(want) - np.asarray(got)).max(initial=0.0) <= 1e-9


@pytest.mark.parametrize("name", ALONE)
def test_a_process_alone_is_itself(exported, name):
    source, f = exported(name)
    z = np.random.default_rng(4).standard_normal((4, len(source.inputs)))
    mean, variance = source.evaluate(z, noise=True)
    for k, row in enumerate(z):
        assert np.asarray(f["h"](np.zeros(0), row, [])).ravel() == pytest.approx(mean[k], rel=1e-12)
        zero = np.zeros((0, 0))
        spread = f["output_covariance"](np.zeros(0), row, [], zero)
        assert np.diag(np.asarray(spread)) == pytest.approx(variance[k], rel=1e-12)
        assert np.asarray(f["gp_all"](row, [])[2]) == pytest.approx(
            np.asarray(source.mean_jacobian(row)), rel=1e-12
        )


IN_C = ("output hybrid, MIMO", "GP of pieces")
"""The others take the compiler a while each: slow."""


@pytest.mark.parametrize(
    "name", [n if n in IN_C else pytest.param(n, marks=pytest.mark.slow) for n in EVERYTHING]
)
def test_its_bundle_passes_the_verifier(name, tmp_path, capsys):
    """C under strict flags without malloc, rebuild and golden vectors agree to 1e-10."""
    compiled.needs_compiler()
    write_bundle(EVERYTHING[name](), tmp_path / "thing", with_=GROUPS, use_cache=False)
    code = (tmp_path / "thing" / "c" / "thing.c").read_text()
    assert "malloc" not in code
    assert verify([str(tmp_path / "thing")]) == 0, capsys.readouterr().out


SAVED = {
    "linear": (siso, "linear"),
    "output hybrid": (PREDICTORS["output hybrid, MIMO"], "output-hybrid"),
    "NARX": (PREDICTORS["NARX"], "narx"),
    "LSTM": (lambda: network(1, False), "lstm"),
    "GP that greybox trained": (ALONE["GP alone"], "gp"),
    "GP of GPyTorch": (pieced, "gp"),
}


@pytest.mark.parametrize("name", SAVED)
def test_its_file_is_what_export_takes(name, tmp_path):
    make, kind = SAVED[name]
    source = make()
    source.save(tmp_path / "source.json")
    again = read_model(tmp_path / "source.json")
    assert type(again) is type(source)
    bundle = write_bundle(again, tmp_path / "thing", targets=("casadi",), use_cache=False)
    assert bundle.manifest["model"]["kind"] == kind
    rebuilt = ExportBundle.load(tmp_path / "thing").rebuild(["h"])["h"]
    f = model_functions(source)
    at = (f.reference[0] + 0.1, f.reference[1] - 0.1, f.parameter_values)
    assert np.abs(np.asarray(rebuilt(*at)) - np.asarray(f["h"](*at))).max() <= 1e-12


def test_linear_models_per_axis_are_one_predictor(tmp_path):
    """What `greybox linear` writes for several axes: one file, inputs as sums of columns in
    fit.json beside it."""
    parts = [siso("p", "roll").to_dict(), siso("q", "pitch").to_dict()]
    (tmp_path / "model.json").write_text(
        json.dumps({"schema": "greybox.linear_models/1", "models": parts})
    )
    bundle = write_bundle(
        read_model(tmp_path / "model.json"),
        tmp_path / "thing",
        targets=("casadi",),
        use_cache=False,
    )
    assert [s["name"] for s in bundle.manifest["inputs"]] == ["roll", "pitch"]
    assert [s["name"] for s in bundle.manifest["outputs"]] == ["p", "q"]


def test_the_command_takes_a_hybrid_and_says_what_it_wrote(tmp_path):
    PREDICTORS["output hybrid, SISO"]().save(tmp_path / "hybrid.json")
    command = [
        sys.executable,
        "-m",
        "greybox",
        "export",
        str(tmp_path / "hybrid.json"),
        "--out",
        str(tmp_path / "rate"),
        "--target",
        "casadi",
        "--with",
        "filter,covariance",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "filter_step" in done.stdout
    assert "phi[t-1]: measured or known from elsewhere, in p" in done.stdout


# -------------------- refusals


def said(error, action):
    with pytest.raises(error) as caught:
        action()
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_what_cannot_be_exported_is_said_in_one_line(tmp_path):
    assert "cannot export a dict" in said(ModelError, lambda: write_bundle({}, tmp_path / "x"))
    (tmp_path / "other.json").write_text('{"schema": "greybox.plan/1"}')
    assert "not a fitted model" in said(
        FileFormatError, lambda: read_model(tmp_path / "other.json")
    )
    from dataclasses import replace

    timeless = replace(network(1, False), dt=None)
    assert "does not know its sample time" in said(
        ModelError, lambda: write_bundle(timeless, tmp_path / "x")
    )
    narx = PREDICTORS["NARX"]()
    assert "discrete model" in said(
        ModelError, lambda: write_bundle(narx, tmp_path / "x", dt=2 * DT)
    )
    gp = pieced()
    options = {"runtime_parameters": ("gp.weights",)}
    assert "cannot change at run time" in said(
        ModelError, lambda: write_bundle(gp, tmp_path / "x", **options)
    )
    assert "--points" in said(GreyboxError, lambda: write_bundle(gp, tmp_path / "x", points=3))
    assert list(tmp_path.glob("*")) == [tmp_path / "other.json"]


def test_the_cases_are_of_every_kind_that_there_is():
    from mpc_export.predictors import Fitted

    kinds = {type(make()) for make in EVERYTHING.values()} | {LinearModel}
    missing = {
        k.__name__ for k in Fitted.__args__ if not any(issubclass(kind, k) for kind in kinds)
    }
    assert missing == {"IdentifiedModel"}  # the other tests of this folder
    assert isinstance(mimo(), LinearModel) and GaussianProcess in kinds and is_canonical("p")
