"""calibrate_step holds its level on any sequence of errors, and costs next to nothing where nothing
is wrong."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import norm

from mpc_export.bundle import write_bundle
from mpc_export.calibration import (
    BURST,
    COLUMNS,
    GAIN,
    LEVEL,
    WIDEST,
    Calibration,
    calibrate_function,
)
from mpc_export.functions import model_functions
from mpc_export.verify import main as verify
from tests.mpc_export import cases, compiled
from tests.mpc_export.predictor_cases import ALONE, PREDICTORS
from tests.mpc_export.test_the_filter_adapts_in_flight import pushed_cart

HALF = norm.ppf(0.5 + 0.5 * LEVEL)
OWN = Calibration(every=1, multiples=(0, 5), sigma=np.ones((20, 2)), dt=0.01)
"""Twenty outputs at two horizons: the next sample, and one whose scales are four updates old when
they are judged."""
TRIPLES = Calibration(
    every=1,
    multiples=(0, 5),
    sigma=np.ones((60, 2)),
    dt=0.01,
    axes=tuple(tuple(range(i, i + 3)) for i in range(0, 60, 3)),
)
"""The same of twenty sensors with three axes."""


def calibrated(errors, samples, own=OWN):
    """(missed, scale in force for the error of that sample), each (n, n_e, n_h); `errors` maps
    (sample, scale) to E."""
    step = calibrate_function(own)
    theta, missed, scales = own.start()["theta"], [], []
    late = [a + d for a, d in zip(own.first, own.delays, strict=True)]
    for k in range(samples):
        issued = np.exp(theta[:, late])
        error = errors(k, issued)
        missed.append(np.abs(error) > HALF * issued * own.sigma)
        scales.append(issued)
        theta = np.array(step(theta, error, np.ones_like(error), own.sigma, LEVEL, GAIN)[0])
    return np.array(missed), np.array(scales)


def bound(own, samples):
    """Of the docstring of the file, by horizon."""
    steps = GAIN / np.sqrt(np.maximum(own.multiples, 1))
    ends = math.log(WIDEST) + (math.log(BURST) if own.axes else 0.0)
    return (ends + (np.array(own.delays) + 1) * steps) / (steps * samples)


def adversary(k, issued):
    """Outputs 0 to 4 miss whenever they may, 5 to 9 never do, 10 to 14 change by the thousand, 15
    to 19 do what is least expected: small while the scale is large, large while it is small."""
    largest, least = 0.999 * WIDEST * HALF, 1.001 * HALF / WIDEST
    e = np.empty_like(issued)
    e[:5] = np.minimum(1.001 * HALF * issued[:5], largest)
    e[5:10] = np.maximum(0.999 * HALF * issued[5:10], least)
    e[10:15] = largest if (k // 1000) % 2 else least
    e[15:] = np.where(issued[15:] > 1.0, least, largest)
    return e


def test_no_sequence_of_errors_takes_the_coverage_beyond_its_bound():
    for samples in (500, 3000):
        missed, _ = calibrated(adversary, samples)
        off = np.abs(missed.mean(axis=0) - (1 - LEVEL))
        assert (off <= bound(OWN, samples) + 1e-12).all()
        assert off.max() > 0.2 * bound(OWN, samples).max(), "the sequences are hard"


def test_axes_that_move_together_keep_each_ones_bound():
    """Sensors 0 to 4 have one axis of every kind that the adversary knows, so that each axis is
    led astray by the others; on 5 to 9 two axes are as small as may be and one misses always."""

    def errors(k, issued):
        rows = np.resize(np.arange(20), 60)
        e = np.empty_like(issued)
        order = np.argsort(rows, kind="stable")
        for part in np.split(order, 3):
            e[part] = adversary(k, issued[part])
        e[15:30] = 1.001 * HALF / WIDEST
        e[15:30:3] = np.minimum(1.001 * HALF * issued[15:30:3], 0.999 * WIDEST * HALF)
        return e

    for samples in (500, 3000):
        missed, _ = calibrated(errors, samples, TRIPLES)
        off = np.abs(missed.mean(axis=0) - (1 - LEVEL))
        assert (off <= bound(TRIPLES, samples) + 1e-12).all()
        assert off.max() > 0.2 * bound(TRIPLES, samples).max(), "the sequences are hard"


def test_axes_that_grow_together_are_held_sooner_and_cost_little():
    rng = np.random.default_rng(4)

    def errors(k, issued):
        return (2.0 if k >= 500 else 1.0) * rng.standard_normal(issued.shape)

    apart = Calibration(every=1, multiples=(0, 5), sigma=np.ones((60, 2)), dt=0.01)
    (alone, width), (both, wide) = (calibrated(errors, 600, own) for own in (apart, TRIPLES))
    for now, when in ((alone, "apart"), (both, "together")):
        assert now[300:500].mean() == pytest.approx(1 - LEVEL, abs=0.01), when
    assert (wide[300:500].mean(axis=(0, 1)) <= 1.05 * width[300:500].mean(axis=(0, 1))).all()
    late = slice(540, 600)
    assert (
        both[late].mean(axis=(0, 1)) - 0.05 < 0.5 * (alone[late].mean(axis=(0, 1)) - 0.05)
    ).all()


def test_an_axis_that_grows_alone_is_held_no_later_than_apart():
    rng = np.random.default_rng(5)

    def errors(k, issued):
        e = rng.standard_normal(issued.shape)
        if k >= 300:
            e[::3] *= 2.0
        return e

    apart = Calibration(every=1, multiples=(0, 5), sigma=np.ones((60, 2)), dt=0.01)
    alone, both = (calibrated(errors, 900, own)[0][:, ::3] for own in (apart, TRIPLES))
    for late in (slice(320, 400), slice(400, 600), slice(600, 900)):
        assert both[late].mean() <= alone[late].mean() + 0.01


def test_neighbours_of_an_axis_that_misses_for_good_widen_to_the_burst_at_most():
    """As an axis whose errors are no numbers does; one that only grew lets them go sooner."""
    rng = np.random.default_rng(6)

    def errors(k, issued):
        e = rng.standard_normal(issued.shape)
        if k >= 200:
            e[::3] = np.nan
        return e

    with np.errstate(invalid="ignore"):
        _, widths = calibrated(errors, 1200, TRIPLES)
    beside = widths[:, [i for i in range(60) if i % 3]]
    assert beside[300:].max() < 1.6 * BURST
    assert beside[-100:, :, 0].mean() < beside[300:600, :, 0].mean()


def test_a_scale_comes_back_from_its_end_as_fast_as_it_would_alone():
    """An axis alone is not wound up beyond the largest scale."""
    alone = Calibration(every=1, multiples=(0, 5), sigma=np.ones((2, 2)), dt=0.01)

    def errors(k, issued):
        return np.full(issued.shape, 1e4 if k < 2000 else 0.0)

    _, widths = calibrated(errors, 2300, alone)
    assert widths[1999].min() == pytest.approx(WIDEST)
    back = np.argmax(widths[2000:, 0] < 0.99 * WIDEST, axis=0)
    assert (back > 0).all() and back[0] <= 30 and back[1] <= 130


def test_axes_of_a_vehicles_sensor_belong_together_and_outputs_of_other_models_do_not():
    own = model_functions(cases.disturbed(), with_=("calibrate",))
    names = own.innovations.names
    together = [{names[i] for i in rows} for rows in own.calibration.axes]
    assert {"position.x", "position.y", "position.z"} in together
    assert {"p", "q", "r"} in together
    assert model_functions(cases.linear(), with_=("calibrate",)).calibration.axes == ()


def test_gaussian_errors_as_stated_keep_their_width_and_level():
    rng = np.random.default_rng(0)
    missed, scales = calibrated(lambda k, s: rng.standard_normal(s.shape), 4000)
    assert missed.mean(axis=(0, 1)) == pytest.approx(1 - LEVEL, abs=0.01)
    assert scales[500:].mean(axis=(0, 1)) == pytest.approx(1.0, abs=0.05)
    assert scales[500:].std(axis=(0, 1)).max() < 0.12


def test_tails_heavier_than_gaussian_keep_the_level():
    rng = np.random.default_rng(1)
    missed, scales = calibrated(lambda k, s: rng.standard_t(2, size=s.shape), 4000)
    assert missed[500:].mean(axis=(0, 1)) == pytest.approx(1 - LEVEL, abs=0.01)
    # the 97.5 % quantile of Student's t with two degrees of freedom is 4.30
    assert np.median(scales[1000:], axis=(0, 1)) == pytest.approx(4.30 / HALF, rel=0.1)


def test_errors_that_triple_are_held_again_within_150_samples():
    rng = np.random.default_rng(2)
    own = Calibration(every=1, multiples=(0,), sigma=np.ones((200, 1)), dt=0.01)
    missed, _ = calibrated(
        lambda k, s: (3.0 if k >= 500 else 1.0) * rng.standard_normal(s.shape), 900, own
    )
    assert missed[500:510].mean() > 0.35
    assert missed[650:900].mean() < 0.07


def test_what_is_not_measured_changes_nothing_and_what_is_no_number_has_missed():
    step = calibrate_function(OWN)
    own = 0.1 * np.random.default_rng(0).standard_normal((20, 1))
    theta = np.tile(own, (1, OWN.remembered))
    theta[:, [at - 1 for at in OWN.first]] = 0.0
    wild = np.full((20, 2), np.nan)
    after, scale = step(theta, wild, np.zeros((20, 2)), OWN.sigma, LEVEL, GAIN)
    np.testing.assert_array_equal(after, theta)
    np.testing.assert_allclose(scale, np.exp(theta[:, list(OWN.first)]))
    after, _ = step(theta, wild, np.ones((20, 2)), OWN.sigma, LEVEL, GAIN)
    assert (np.array(after)[:, 0] > theta[:, 0]).all()


def flights(functions, count, samples, seed=0):
    """Errors (due samples, flights, n_h) of `count` simulated flights of pushed_cart, and of the
    longest forecasts anew."""
    rng, own = np.random.default_rng(seed), functions.calibration
    root = np.linalg.cholesky(functions.noise.process + 1e-15 * np.eye(2))
    b = functions.parameter_values
    true, x = np.zeros((2, count)), np.zeros((2, count))
    run = {n: functions[n].map(count) for n in ("f_d", "filter_step", "forecast_step")}
    under_way, clock = np.zeros((2, COLUMNS * count)), np.zeros((1, count))
    there, p = np.ones((1, count)), np.tile(b[:, None], (1, count))
    found, again, begun, pushes = [], [], [], []
    for k in range(samples):
        u = rng.standard_normal((1, count))
        y = true[:1] + 0.1 * rng.standard_normal((1, count))
        after = np.array(run["filter_step"](x, u, p, y, there)[0])
        under_way, clock, e, seen = (
            np.array(v) for v in run["forecast_step"](x, after, u, p, y, there, under_way, clock)
        )
        pushes.append(u)
        if k % own.every == 0 and k >= own.samples[-1]:
            assert (seen == 1).all()
            found.append(e.reshape(count, -1))
            free = begun[(k - own.samples[-1]) // own.every]
            for push in pushes[-own.samples[-1] :][:-1]:
                free = np.array(run["f_d"](free, push, p))
            again.append((y - free[:1]).ravel())
        elif k % own.every:
            assert (seen.reshape(count, -1)[:, 1:] == 0).all()
        if k % own.every == 0:
            begun.append(after)
        x = after
        true = np.array(run["f_d"](true, u, p)) + root @ rng.standard_normal((2, count))
    return np.array(found), np.array(again)


def test_errors_of_forecasts_are_those_of_the_model_flown_again_and_as_wide_as_stated():
    functions = model_functions(pushed_cart(2), with_=("calibrate",))
    own = functions.calibration
    assert own.samples == (1, 5, 10, 25, 50)
    found, again = flights(functions, 60, 300)
    np.testing.assert_allclose(found[:, :, -1], again, atol=1e-12)
    settled = found[10:]
    assert np.sqrt(np.mean(settled**2, axis=(0, 1))) == pytest.approx(own.sigma.ravel(), rel=0.08)


def test_a_flight_begins_with_zeros_in_place_of_forecasts():
    functions = model_functions(cases.disturbed(), with_=("calibrate",))
    x, u = functions.reference
    p, there = functions.parameter_values, np.ones(len(functions.innovations))
    y = functions["h"](x, u, p)
    under_way, clock = np.zeros((x.size, COLUMNS)), 0.0
    for k in range(12):
        given = [x, x, u, p, y, there, under_way, clock]
        under_way, clock, errors, seen = (np.array(v) for v in functions["forecast_step"](*given))
        assert all(np.isfinite(v).all() for v in (under_way, errors))
        assert seen.any(axis=0).tolist() == [True, k in (5, 10), k == 10, False, False]


def test_the_export_calibrates_in_c(tmp_path):
    compiled.needs_compiler()
    bundle = write_bundle(
        cases.linear(), tmp_path / "own", targets=("c",), with_=("calibrate",), use_cache=False
    )
    library = compiled.load(
        bundle, compiled.compile_library(bundle, tmp_path / "lib", "gcc", "-O0")
    )
    functions = model_functions(cases.linear(), with_=("calibrate",))
    own = functions.calibration

    def in_c(name, *arguments):
        entry = next(f for f in bundle.manifest["functions"] if f["name"] == name)
        given = [np.ravel(a, order="F").astype(float).tolist() for a in arguments]
        shapes = [(r["rows"], r["columns"]) for r in entry["results"]]
        return [
            np.reshape(r, s, order="F")
            for r, s in zip(library.call(entry, given), shapes, strict=True)
        ]

    def flown(call):
        rng = np.random.default_rng(3)
        x, p, there = functions.reference[0], functions.parameter_values, np.ones(2)
        under_way, (clock, theta), out = np.zeros((x.size, COLUMNS)), own.start().values(), []
        for _ in range(120):
            u, y = rng.standard_normal(2), 5.0 * rng.standard_normal(2)
            after, _, _ = call("filter_step", x, u, p, y, there)
            under_way, clock, e, seen = call(
                "forecast_step", x, after, u, p, y, there, under_way, clock
            )
            theta, scale = call("calibrate_step", theta, e, seen, own.sigma, LEVEL, GAIN)
            x = after
            out.append(scale)
        return np.array(out)

    casadi = flown(lambda name, *a: [np.array(v) for v in functions[name](*a)])
    np.testing.assert_allclose(flown(in_c), casadi, rtol=1e-9)
    assert casadi.max() > 2.0
    header = (bundle.folder / "c" / "own_model.h").read_text()
    assert "#define OWN_N_H 5" in header and f"own_calibration_sigma[{own.sigma.size}]" in header
    np.testing.assert_allclose(bundle.manifest["calibration"]["sigma"], own.sigma)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("source", "real"),
    [
        (cases.hybrid, "double"),
        (cases.hybrid, "float"),
        (PREDICTORS["NARX"], "double"),
        (ALONE["GP alone"], "double"),
    ],
)
def test_the_self_test_of_a_calibrated_bundle_passes(tmp_path, source, real):
    compiled.needs_compiler()
    bundle = write_bundle(
        source(), tmp_path / "own", real=real, targets=("c",), with_=("calibrate",), use_cache=False
    )
    assert verify([str(bundle.folder)]) == 0
