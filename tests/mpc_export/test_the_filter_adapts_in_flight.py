"""adapt_step finds in one pass what the batch fit of the flight finds, in C as in CasADi, and stays
inside the physics."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize

from greybox.errors import ModelError
from greybox.estimation.filtering import Filter
from greybox.estimation.record import make_record
from greybox.model.dynamics import StateSpaceModel
from greybox.model.identified import IdentifiedModel
from greybox.model.noise import with_disturbance
from greybox.model.parameter import Parameter, ParameterValues
from greybox.residual.hybrid import HybridModel
from greybox.symbolic import Layout, Signal
from greybox.validation.adapt import adapt_to_flight
from mpc_export.adaptation import authority
from mpc_export.bundle import write_bundle
from mpc_export.functions import model_functions
from mpc_export.manifest import _notes
from mpc_export.verify import main as verify
from tests.mpc_export import cases, compiled
from tests.residual import hybrid_cases
from tests.validation.test_validate_judges_causally import DT, dataset, fly, make_model

TRUE = {"accelerometer_bias.b_x": 0.25, "accelerometer_bias.b_y": -0.3, "mass": 0.045}


def craft():
    """Accelerometer biases and the mass differ from flight to flight."""
    own = make_model()
    return replace(
        own,
        flight_spread={**own.flight_spread, "mass": (own.values["mass"], 0.1 * own.values["mass"])},
    )


@pytest.fixture(scope="module")
def functions():
    return model_functions(craft(), with_=("adapt",))


def start(functions, segment):
    """x, p, V before the first sample, as a user has them."""
    x = functions.reference[0].copy()
    own = make_record(Filter(functions.model, use_compiler=False).engine, segment).x0
    x[: len(own)] = own
    return x, functions.parameter_values.copy(), functions.adapted.covariance.copy()


def flown(functions, segment, step=None, *, memory=0.0, there=None):
    """Adapted parameters (n, n_a), the last covariance and state, after one pass over a flight."""
    call = step or functions["adapt_step"]
    x, p, v = start(functions, segment)
    u = segment.matrix(functions.inputs.names)
    y = segment.matrix(functions.outputs.names)
    seen = np.ones((segment.n, functions.sizes["n_e"])) if there is None else there
    rows = list(functions.adapted.rows)
    found = []
    for k in range(segment.n):
        x, p, v, _, _ = (np.array(r) for r in call(x, u[k], p, y[k], seen[k], v, memory))
        x, p = x.ravel(), p.ravel()
        found.append(p[rows])
    return np.array(found), v, x


def test_one_pass_gives_the_numbers_of_the_batch_fit(functions):
    """Maximum a posteriori over the whole flight, with the same filter and the same prior."""
    segment = fly(functions.model, 400, noise=1.0, changes=TRUE)
    batch = adapt_to_flight(functions.model, dataset(segment)["f"], 400 * DT, use_compiler=False)
    found, covariance, _ = flown(functions, segment)
    std = dict(zip(functions.adapted.names, np.sqrt(np.diag(covariance)), strict=True))
    last = dict(zip(functions.adapted.names, found[-1]))
    for name, true in TRUE.items():
        assert last[name] == pytest.approx(batch.values[name], rel=0.02)
        assert std[name] == pytest.approx(batch.std[name], rel=0.02)
        assert abs(last[name] - true) < 4 * std[name]
    still = "accelerometer_bias.b_z"
    assert abs(last[still] - batch.values[still]) < 0.5 * batch.std[still]


def late():
    """A craft whose commands come late: their history is part of the state, and known."""
    own = cases.physics()
    return replace(own, flight_spread={"mass": (own.values["mass"], 0.1 * own.values["mass"])})


@pytest.mark.parametrize("model", [craft, late])
def test_the_covariance_goes_with_the_slopes_of_the_filter_however_large_the_innovation(model):
    """Errors so small that the update moves nothing: V_next is F V F' with F by differences of
    filter_step, .3 rad off in attitude, where the slopes of a rotation's innovation are not those
    at zero."""
    functions = model_functions(model(), with_=("adapt",))
    rng = np.random.default_rng(3)
    n_t, n_d = len(functions.adapted.rows), functions.own_error_states
    history = np.zeros(len(functions.error_states) - n_d)
    assert len(functions.adapted.names) == n_t + n_d and (len(history) > 0) == (model is late)
    x, u, p = (
        functions.reference[0].copy(),
        functions.reference[1],
        functions.parameter_values.copy(),
    )
    off = np.concatenate([0.3 * rng.standard_normal(n_d), history])
    away = np.array(functions["boxplus"](x, off)).ravel()
    y, there = np.array(functions["h"](away, u, p)).ravel(), np.ones(functions.sizes["n_e"])

    def following(moved):
        q = p.copy()
        q[list(functions.adapted.rows)] += moved[:n_t]
        start = np.array(functions["boxplus"](x, np.concatenate([moved[n_t:], history]))).ravel()
        return np.array(functions["filter_step"](start, u, q, y, there)[0]).ravel()

    still, h = following(np.zeros(n_t + n_d)), 1e-6
    slope = np.eye(n_t + n_d)
    for j, unit in enumerate(np.eye(n_t + n_d)):
        ends = [
            np.array(functions["boxminus"](following(s * h * unit), still)).ravel()[:n_d]
            for s in (1, -1)
        ]
        slope[n_t:, j] = (ends[0] - ends[1]) / (2 * h)
    small = 1e-14
    after = (
        np.array(functions["adapt_step"](x, u, p, y, there, small * np.eye(n_t + n_d), 0.0)[2])
        / small
    )
    want = slope @ slope.T
    assert np.abs(after - want).max() < 1e-5 * np.abs(want).max()


def test_where_the_prior_is_narrow_one_pass_is_the_least_squares_step_of_the_whole_flight(
    functions,
):
    """Every slope is then taken where the flight ends: what is left to the batch fit of a wide prior
    is that a filter takes them at what it believes by then."""
    n, narrow = 100, 1e-4
    segment = fly(functions.model, n, noise=1.0, changes=TRUE)
    x, p, v = start(functions, segment)
    u = segment.matrix(functions.inputs.names)
    y = segment.matrix(functions.outputs.names)
    there = np.ones(functions.sizes["n_e"])
    n_t, n_d, rows = (
        len(functions.adapted.rows),
        len(functions.error_states),
        functions.adapted.rows,
    )
    white = np.linalg.inv(np.linalg.cholesky(functions["innovation_gain"](there)[1].full()))

    def innovations(moved):
        q, at = p.copy(), np.array(functions["boxplus"](x, moved[n_t:])).ravel()
        q[list(rows)] += moved[:n_t]
        out = []
        for k in range(n):
            at, e = functions["filter_step"](at, u[k], q, y[k], there)[:2]
            out.append(white @ e.full().ravel())
        return np.concatenate(out)

    sigma = narrow * np.sqrt(np.diag(v))
    steps = np.maximum(sigma, 1e-9)
    slopes = np.column_stack(
        [
            (innovations(h * unit) - innovations(-h * unit)) / (2 * h)
            for h, unit in zip(steps, np.eye(n_t + n_d), strict=True)
        ]
    )
    scaled = slopes * sigma
    information = scaled.T @ scaled + np.eye(n_t + n_d)
    best = -sigma * np.linalg.solve(information, scaled.T @ innovations(np.zeros(n_t + n_d)))
    std = sigma * np.sqrt(np.diag(np.linalg.inv(information)))
    before = p[list(rows)].copy()
    v = narrow**2 * v
    for k in range(n):
        x, p, v = (
            np.array(r) for r in functions["adapt_step"](x, u[k], p, y[k], there, v, 0.0)[:3]
        )
        x, p = x.ravel(), p.ravel()
    assert np.abs(p[list(rows)] - before - best[:n_t]) / std[:n_t] == pytest.approx(0, abs=1e-3)
    assert np.sqrt(np.diag(v))[:n_t] == pytest.approx(std[:n_t], rel=1e-3)


def test_learned_weights_get_the_numbers_of_their_batch_fit():
    """Of a pendulum with a learned torque: weights by Gauss-Newton on the filter's innovations,
    with the prior."""
    base = hybrid_cases.pendulum_model()
    push = hybrid_cases.push(base.dynamics, ("rate",), ("rate",), points=4)
    push = replace(push, output_scale=np.array([0.5]))
    model = replace(base, dynamics=HybridModel(inner=base.dynamics, posterior=push), trained_on=())
    functions = model_functions(model, with_=("adapt",), runtime_parameters=("gp.weights",))
    own = functions.adapted
    assert own.names[:4] == tuple(f"gp.weights.rate.{i + 1}" for i in range(4))
    segment = hybrid_cases.swings(1, 3, hidden=0.1, period=3.0, seconds=6.0).flights[0].segments[0]
    found, covariance, _ = flown(functions, segment)
    unsure = np.flatnonzero(np.diag(own.covariance)[4:])
    kept = [*range(4), *(4 + unsure)]
    root = np.linalg.inv(
        np.linalg.cholesky(own.covariance[np.ix_(kept, kept)] + 1e-12 * np.eye(len(kept)))
    )
    size = np.linalg.inv(np.linalg.cholesky(functions.noise.innovation))
    prior = np.concatenate([own.mean, np.zeros(len(unsure))])

    def left(theta):
        x, p, _ = start(functions, segment)
        p[list(own.rows)] = theta[:4]
        off = np.zeros(len(functions.error_states))
        off[unsure] = theta[4:]
        x = np.array(functions["boxplus"](x, off)).ravel()
        out = []
        for u, y in zip(segment.matrix(("u",)), segment.matrix(("y", "w")), strict=True):
            after, e, _ = functions["filter_step"](x, u, p, y, np.ones(2))
            x = np.array(after).ravel()
            out.append(size @ np.array(e).ravel())
        return np.concatenate([*out, root @ (theta - prior)])

    batch = scipy.optimize.least_squares(left, prior, max_nfev=4)
    std = np.sqrt(np.diag(np.linalg.inv(batch.jac.T @ batch.jac)))[:4]
    assert np.sqrt(np.diag(covariance))[:4] == pytest.approx(std, rel=0.03)
    assert np.abs(found[-1] - own.mean).max() > 2 * std.min(), "the flight had something to say"
    assert np.abs(found[-1] - batch.x[:4]).max() < 0.15 * std.max()


def test_a_change_in_flight_is_followed_with_a_memory_and_averaged_without(functions):
    model = functions.model
    first, second = (
        fly(model, 800, noise=1.0, seed=s, changes={"mass": m}) for s, m in ((1, 0.042), (2, 0.046))
    )
    both = first.replace(
        {
            n: np.concatenate([first.channels[n][:400], second.channels[n][400:]])
            for n in first.channels
        }
    )
    at = functions.adapted.names.index("mass")
    with_memory, without = (flown(functions, both, memory=m)[0][-1, at] for m in (2.0, 0.0))
    assert with_memory == pytest.approx(0.046, rel=0.02)
    assert abs(without - 0.046) > 3 * abs(with_memory - 0.046)


def test_nothing_measured_leaves_the_spread_between_flights(functions):
    segment = fly(functions.model, 300, noise=1.0, changes=TRUE)
    blind = np.ones((300, functions.sizes["n_e"]))
    blind[150:] = 0.0
    found, covariance, _ = flown(functions, segment, memory=0.2, there=blind)
    n = len(functions.adapted.rows)
    np.testing.assert_allclose(
        covariance[:n, :n], functions.adapted.covariance[:n, :n], rtol=1e-3, atol=1e-9
    )
    np.testing.assert_allclose(found[-1], functions.adapted.mean, rtol=1e-3, atol=1e-3)


def test_a_missing_reading_may_be_anything(functions):
    segment = fly(functions.model, 50, noise=1.0, changes=TRUE)
    there = np.ones((50, functions.sizes["n_e"]))
    there[:, functions.innovations.names.index("ax")] = 0.0
    broken = segment.replace({**segment.channels, "ax": np.full(50, np.nan)})
    plain = flown(functions, segment, there=there)
    for a, b in zip(plain, flown(functions, broken, there=there), strict=True):
        np.testing.assert_array_equal(a, b)


def test_wild_readings_leave_parameters_and_discrepancy_inside_the_physics():
    model = craft()
    pushed = with_disturbance(model.dynamics, ("force", "torque"), time=2.0)
    model = replace(
        hybrid_cases.craft_model(pushed),
        flight_spread=model.flight_spread,
        reference_inputs=model.reference_inputs,
        sample_time=DT,
        reference_state=pushed.reference({f"u{i}": 0.849 for i in range(1, 5)}),
    )
    functions = model_functions(model, with_=("adapt",))
    own = functions.adapted
    x, p, v = start(functions, fly(make_model(), 3))
    rng = np.random.default_rng(0)
    limited = {functions.states[n]: most for n, most in own.limits.items()}
    assert len(limited) == 6
    hover = np.array(functions["h"](x, np.full(4, 0.8), p)).ravel()
    u, there, touched = np.full(4, 0.8), np.ones(len(functions.innovations)), False
    for _ in range(200):
        y = hover + 3.0 * rng.standard_normal(functions.sizes["n_y"])
        found = functions["adapt_step"](x, u, p, y, there, v, 5.0)
        x, p, v = (np.array(r) for r in found[:3])
        theta = p.ravel()[list(own.rows)]
        assert np.isfinite(x).all() and np.isfinite(v).all()
        assert (theta >= own.lower).all() and (theta <= own.upper).all()
        assert all(abs(x.ravel()[i]) <= most for i, most in limited.items())
        assert np.linalg.eigvalsh(v).min() > -1e-12 * np.abs(v).max()
        touched |= any(abs(x.ravel()[i]) == most for i, most in limited.items())
    assert touched


def test_the_plain_export_adapts_in_c(tmp_path, functions):
    compiled.needs_compiler()
    bundle = write_bundle(
        craft(), tmp_path / "own", targets=("c",), with_=("adapt",), use_cache=False
    )
    library = compiled.load(
        bundle, compiled.compile_library(bundle, tmp_path / "lib", "gcc", "-O0")
    )
    entry = next(f for f in bundle.manifest["functions"] if f["name"] == "adapt_step")

    def in_c(*arguments):
        given = [np.ravel(a, order="F").astype(float).tolist() for a in arguments]
        shapes = [(r["rows"], r["columns"]) for r in entry["results"]]
        return [
            np.reshape(r, s, order="F")
            for r, s in zip(library.call(entry, given), shapes, strict=True)
        ]

    segment = fly(functions.model, 60, noise=1.0, changes=TRUE)
    c, casadi = (flown(functions, segment, step)[0] for step in (in_c, None))
    np.testing.assert_allclose(c, casadi, rtol=1e-9, atol=1e-11)
    header = (bundle.folder / "c" / "own_model.h").read_text()
    assert (
        "#define OWN_A_MASS" in header
        and f"own_adapted_covariance[{functions.adapted.covariance.size}]" in header
    )
    assert bundle.manifest["adapted"]["names"] == list(functions.adapted.names)


@pytest.mark.slow
@pytest.mark.parametrize("real", ["double", "float"])
def test_the_self_test_of_an_adaptive_bundle_passes(tmp_path, real):
    compiled.needs_compiler()
    bundle = write_bundle(
        craft(), tmp_path / "own", real=real, targets=("c",), with_=("adapt",), use_cache=False
    )
    assert verify([str(bundle.folder)]) == 0


def pushed_cart(states):
    """A mass that friction slows and an unknown acceleration b pushes. Measured is its place, or
    the speed as only state."""
    names = {1: ("v",), 2: ("s", "v")}[states]
    dynamics = StateSpaceModel(
        name="cart",
        states=Layout([Signal(name=n, unit="m") for n in names]),
        inputs=Layout([Signal(name="u", unit="m/s^2")]),
        outputs=Layout([Signal(name="y", unit="m")]),
        parameters=(Parameter(name="b", unit="m/s^2", nominal=0.0, scale=1.0),),
        dynamics=lambda t, x, u, p: [*([x[1]] if states == 2 else []), u[0] - x[-1] + p["b"]],
        measurement=lambda t, x, u, p: [x[0]],
        noise_states=("v",),
    )
    return IdentifiedModel(
        dynamics=dynamics,
        values=ParameterValues({"b": 0.0}),
        process_noise=np.array([1.0]),
        sensor_noise=np.array([0.1]),
        weak=np.full(states, 1e4),
        reference_state=np.zeros(states),
        reference_inputs=np.zeros(1),
        sample_time=0.01,
        flight_spread={"b": (0.0, 1.0)},
        per_flight={},
    )


@pytest.mark.parametrize(
    ("states", "memory"),
    [
        (2, 0.5),
        *(pytest.param(n, s, marks=pytest.mark.slow) for n, s in ((2, 0.0), (2, 5.0), (1, 0.5))),
    ],
)
def test_the_stated_error_is_the_one_made_with_a_memory_too(states, memory):
    """b is drawn as the filter supposes. Judge: a Kalman filter of state and b together, written
    here."""
    functions = model_functions(pushed_cart(states), with_=("adapt",))
    flights, n, rng = 200, 800, np.random.default_rng(0)
    keep = np.exp(-0.01 / memory) if memory else 1.0
    _, a, _, by = (
        np.array(r) for r in functions["f_d_jac"](np.zeros(states), np.zeros(1), np.zeros(1))
    )
    root = np.linalg.cholesky(functions.noise.process + 1e-15 * np.eye(states))
    on = np.block([[a, by[:, :1]], [np.zeros((1, states)), keep]])
    noise = scipy.linalg.block_diag(functions.noise.process, 1 - keep**2)
    b, true = rng.standard_normal(flights), np.zeros((states, flights))
    x, p = np.zeros((states, flights)), np.zeros((1, flights))
    v = np.tile(functions.adapted.covariance, (1, flights))
    judge = scipy.linalg.block_diag(
        functions.noise.covariance + functions.adapted.covariance[1:, 1:], 1.0
    )
    step, made, stated, best = functions["adapt_step"].map(flights), [], [], []
    whole, wholly, inside = [], [], []
    blank, there, memories = (
        np.zeros((1, flights)),
        np.ones((1, flights)),
        np.full((1, flights), memory),
    )
    for k in range(n):
        y = true[:1] + 0.1 * rng.standard_normal((1, flights))
        x, p, v = (np.array(r) for r in step(x, blank, p, y, there, v, memories)[:3])
        gain = judge[:, :1] / (judge[0, 0] + 0.01)
        judge = on @ (judge - gain @ judge[:1]) @ on.T + noise
        true = a @ true + by[:, :1] * b + root @ rng.standard_normal((states, flights))
        b = keep * b + np.sqrt(1 - keep**2) * rng.standard_normal(flights)
        # of the state V holds what is beyond the settled filter's: the two together are the whole
        state = functions.noise.covariance + v.reshape(states + 1, flights, -1)[1:, 0, 1:]
        whole.append(state)
        wholly.append(judge[:states, :states])
        if k >= n // 4:
            inside.append((x - true) ** 2 < 1.96**2 * np.diag(state)[:, None])
            made.append(np.mean((p[0] - b) ** 2))
            stated.append(v[0, 0])
            best.append(judge[-1, -1])
    assert np.sqrt(np.mean(stated)) == pytest.approx(np.sqrt(np.mean(made)), rel=0.1)
    assert stated == pytest.approx(best, rel=0.02)
    np.testing.assert_allclose(whole[n // 4 :], wholly[n // 4 :], rtol=0.02, atol=1e-9)
    assert np.mean(inside) == pytest.approx(0.95, abs=0.01)


def test_a_torque_is_bounded_by_what_the_mixer_makes_of_full_and_idle_rotors():
    own = craft()
    vehicle = own.physics.vehicle
    values = {
        **own.values,
        "thrust.c0": 0.01,
        "thrust.c1": 0.02,
        "thrust.c2": 0.1,
        "center_of_mass.x": 0.004,
    }
    actuator = replace(vehicle.actuator, u_min=0.1, u_max=0.8)
    limited = replace(
        own,
        values=ParameterValues(values),
        dynamics=replace(own.dynamics, vehicle=replace(vehicle, actuator=actuator)),
    )
    limits = authority(limited)
    most = {"x": 0.0, "y": 0.0, "z": 0.0}
    for commands in itertools.product((0.1, 0.8), repeat=4):
        total = np.zeros(3)
        for u, rotor in zip(commands, vehicle.rotors, strict=True):
            arm = np.array(rotor.position) - [
                0.004,
                values["center_of_mass.y"],
                values["center_of_mass.z"],
            ]
            total += np.cross(arm, [0.0, 0.0, 0.01 + 0.02 * u + 0.1 * u**2])
            total[2] -= rotor.spin * sum(values[f"torque.c{k}"] * u**k for k in range(3))
        most = {a: max(m, abs(t)) for (a, m), t in zip(most.items(), total, strict=True)}
    for axis, value in most.items():
        assert limits[f"disturbance.torque.{axis}"] == pytest.approx(value)
    assert limits["disturbance.force.z"] == pytest.approx(4 * (0.01 + 0.02 * 0.8 + 0.1 * 0.64))


def test_what_cannot_adapt_is_refused_in_one_line():
    with pytest.raises(
        ModelError, match="no parameter of this model differs between its training flights"
    ):
        model_functions(replace(make_model(), flight_spread={}), with_=("adapt",))
    with pytest.raises(ModelError, match="adapt needs the physics model"):
        model_functions(cases.linear(), with_=("adapt",))


def test_an_export_that_does_not_adapt_says_what_it_takes_as_exact(functions):
    plain = model_functions(craft(), with_=("filter",))
    (said,) = [n for n in _notes(plain) if "flight to flight" in n]
    assert said.startswith("mass") or ", mass" in said
    assert not [n for n in _notes(functions) if "flight to flight" in n]
