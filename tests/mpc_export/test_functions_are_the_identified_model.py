"""Exported functions are the identified model: its step, its filter, its uncertainty, with exact
Jacobians."""

from __future__ import annotations

import functools
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from greybox.errors import ModelError, UnknownNameError
from greybox.estimation.filtering import Filter, Filtered
from greybox.estimation.propagation import Propagator
from greybox.estimation.settling import RecordGains
from greybox.residual.errors_together import ProcessErrors
from greybox.residual.hybrid import HybridModel
from mpc_export.functions import model_functions
from tests.mpc_export import cases
from tests.residual import hybrid_cases
from tests.residual.hybrid_cases import craft, craft_model

KINDS = {
    "physics": cases.physics,
    "disturbed": cases.disturbed,
    "filtered": cases.filtered,
    "hybrid": cases.hybrid,
    "linear": cases.linear,
}
ALL = ("covariance", "filter", "target", "hessian")


@functools.cache
def exported(kind: str, runtime: tuple[str, ...] = ()):
    return model_functions(KINDS[kind](), with_=ALL, runtime_parameters=runtime)


def call(functions, name, point):
    made = functions[name]
    out = made.call([ca.DM(point[n]) for n in made.name_in()])
    return {n: v.full() for n, v in zip(made.name_out(), out, strict=True)}


def own_window(functions, point):
    """The window of the model itself, put together by hand from x and u."""
    past, future = functions.sampled.dynamics.window
    names = functions.sampled.dynamics.inputs.names
    window = np.tile(point["u"][:, None], past + 1 + future)
    for i, name in enumerate(functions.states.names):
        if name.startswith("history."):
            _, column, lag = name.split(".")
            window[names.index(column), past - int(lag)] = point["x"][i]
    return window


@pytest.mark.parametrize("kind", list(KINDS))
def test_f_d_and_h_are_the_models_own_step_and_output(kind):
    functions = exported(kind)
    dynamics = getattr(functions.model, "dynamics", functions.model)
    past, future = dynamics.window
    x, p = ca.SX.sym("x", len(dynamics.states)), ca.SX.sym("p", len(dynamics.parameters))
    u = ca.SX.sym("u", len(dynamics.inputs), past + 1 + future)
    w = np.zeros(len(dynamics.noises))
    own = ca.Function(
        "own",
        [x, u, p],
        [getattr(dynamics, n)(0, x, u, p, w, functions.dt) for n in ("step", "output")],
    )
    values = functions.sampled.values
    vector = [values[d.name] for d in dynamics.parameters]
    rng = np.random.default_rng(1)
    for _ in range(20):
        point = cases.point(functions, rng)
        after, y = (
            v.full().ravel()
            for v in own(point["x"][: functions.own_states], own_window(functions, point), vector)
        )
        got = call(functions, "f_d", point)["x_next"].ravel()
        np.testing.assert_allclose(got[: after.size], after, rtol=1e-12, atol=1e-13)
        np.testing.assert_allclose(
            call(functions, "h", point)["y"].ravel(), y, rtol=1e-12, atol=1e-12
        )


@pytest.mark.parametrize("kind", ["physics", "linear"])
def test_history_states_shift_the_commands(kind):
    functions = exported(kind)
    assert functions.delay == (
        {"u1": 2, "u2": 2, "u3": 2, "u4": 2} if kind == "physics" else {"u": 2}
    )
    point = cases.point(functions, np.random.default_rng(2))
    after = call(functions, "f_d", point)["x_next"].ravel()
    names = functions.states.names
    for name, steps in functions.delay.items():
        assert after[names.index(f"history.{name}.1")] == point["u"][functions.inputs[name]]
        for lag in range(2, steps + 1):
            assert (
                after[names.index(f"history.{name}.{lag}")]
                == point["x"][names.index(f"history.{name}.{lag - 1}")]
            )


def test_a_delay_of_whole_samples_needs_no_more_history_than_its_length():
    lengths = {}
    for delay in (0.0, 0.02):
        model = replace(
            cases.physics(delay), covariance_names=("mass",), covariance=np.array([[1e-8]])
        )
        lengths[delay] = model_functions(model).delay.get("u1", 0)
    assert lengths == {0.0: 0, 0.02: 2}


@pytest.mark.parametrize("kind", list(KINDS))
def test_jacobians_are_the_slopes(kind):
    runtime = {"linear": (), "hybrid": ("mass", "gp.weights")}.get(kind, ("mass", "motor_lag.tau"))
    functions = exported(kind, runtime)
    rng = np.random.default_rng(3)
    point = cases.point(functions, rng)
    eps = 1e-6

    def moved(variable, direction, error):
        if variable == "x" and error:
            return functions["boxplus"](point["x"], direction).full().ravel()
        return point[variable] + direction

    for name, error, first in (
        ("f_d_jac", True, "x_next"),
        ("f_d_jac_raw", False, "x_next"),
        ("h_jac_raw", False, "y"),
        ("f_jac_raw", False, "dx"),
    ):
        if name not in functions.functions:
            assert kind == "linear" and name == "f_jac_raw"
            continue
        base = dict(point)
        if name == "f_jac_raw":
            base["x"] = point["x"][: functions.own_states]
        got = call(functions, name, base)
        slopes = list(got.values())[1:]
        for variable, slope in zip("xup", slopes, strict=True):
            size = {"p": np.maximum(np.abs(point["p"]), 1e-3)}.get(
                variable, np.ones(slope.shape[1])
            )
            for j in rng.permutation(slope.shape[1])[:25]:
                direction = np.zeros(slope.shape[1])
                direction[j] = eps * size[j]
                ends = []
                for sign in (1, -1):
                    if name == "f_jac_raw" and variable == "x":
                        value = base["x"] + sign * direction
                    else:
                        value = moved(variable, sign * direction, error)
                    ends.append(call(functions, name, {**base, variable: value})[first].ravel())
                if error:
                    here = got[first].ravel()
                    ends = [functions["boxminus"](v, here).full().ravel() for v in ends]
                found = (ends[0] - ends[1]) / (2 * eps)
                np.testing.assert_allclose(
                    slope[:, j] * size[j], found, rtol=2e-5, atol=2e-6, err_msg=f"{name} {variable}"
                )


@pytest.mark.parametrize("kind", ["physics", "disturbed", "hybrid"])
def test_the_filter_is_the_identified_one(kind):
    functions, model = exported(kind), KINDS[kind]()
    runner = Filter(model, use_compiler=False)
    n = functions.own_error_states
    np.testing.assert_allclose(
        functions.noise.covariance[:n, :n], runner.riccati.P, rtol=1e-6, atol=1e-14
    )
    rng = np.random.default_rng(5)
    for _ in range(5):
        point = cases.point(functions, rng)
        there = whole(model, point["there"])
        gain, s = runner.riccati.gain(there)[:2]
        found = call(functions, "innovation_gain", point)
        np.testing.assert_allclose(found["S"], s, atol=1e-12 * s.max())
        np.testing.assert_allclose(found["K"][:n], gain, atol=1e-8 * np.abs(gain).max())
        x, window, y = point["x"][: functions.own_states], own_window(functions, point), point["y"]
        after, e, y_hat = (
            v.full().ravel()
            for v in runner.engine.value(x, window, y, model.parameter_vector(), 0.01)
        )
        corrected = runner.engine.move(after, gain @ (e * there)).full().ravel()
        step = call(functions, "filter_step", point)
        np.testing.assert_allclose(step["e"].ravel(), e, atol=1e-11)
        np.testing.assert_allclose(step["y_hat"].ravel(), y_hat, atol=1e-11)
        np.testing.assert_allclose(step["x_next"].ravel()[: x.size], corrected, atol=1e-9)


def whole(model, there):
    """`there` without the innovations that need a channel of one that is missing."""
    columns = [set(c) for c in model.dynamics.innovation_columns]
    gone = set().union(*(c for c, on in zip(columns, there, strict=True) if not on))
    return np.array([float(not c & gone) for c in columns])


@pytest.mark.parametrize("gone", ["position.x", "position.z", "attitude.y"])
def test_a_missing_channel_takes_along_every_innovation_that_needs_it(gone):
    """Positions are compared in body axes: without the world's x nothing is known of any."""
    functions = exported("disturbed")
    point = cases.point(functions, np.random.default_rng(6))
    names = functions.innovations.names
    kind = gone.split(".")[0]
    own = [names.index(n) for n in names if n.split(".")[0] == kind]
    assert len(own) == 3
    for name in ("filter_step", "follow_step"):
        found = []
        for at in ([names.index(gone)], own):
            point["there"] = np.ones(len(names))
            point["there"][at] = 0.0
            for wrong in (0.0, 1e9, np.nan):
                columns = {"position": "xyz", "attitude": ("qw", "qx", "qy", "qz")}[kind]
                for column in columns:
                    point["y"][functions.outputs[column]] = wrong
                found.append(call(functions, name, point)["x_next"])
        assert np.isfinite(found[0]).all()
        for other in found[1:]:
            np.testing.assert_array_equal(found[0], other)


def test_a_missing_channel_may_hold_nan():
    functions = exported("physics")
    point = cases.point(functions, np.random.default_rng(6))
    names = functions.innovations.names
    gone = names.index("p")
    point["there"] = np.ones(len(names))
    point["there"][gone] = 0.0
    plain = call(functions, "filter_step", point)["x_next"]
    point["y"][functions.outputs["p"]] = np.nan
    np.testing.assert_array_equal(call(functions, "filter_step", point)["x_next"], plain)


def test_the_filter_of_a_linear_model_is_its_innovation_form():
    functions, model = exported("linear"), cases.linear()
    m = model.matrices
    point = cases.point(functions, np.random.default_rng(7))
    point["there"] = np.ones(2)
    held = own_window(functions, point)
    u = np.array([held[0, 0], held[1, 2]]) - model.input_offset
    x = point["x"][:3]
    e = point["y"] - (m.c @ x + m.d @ u + model.output_offset)
    want = m.a @ x + m.b @ u + m.k @ e
    np.testing.assert_allclose(
        call(functions, "filter_step", point)["x_next"].ravel()[:3], want, atol=1e-12
    )


@pytest.mark.parametrize("kind", ["physics", "hybrid"])
def test_uncertainty_travels_as_greybox_propagates_it(kind, monkeypatch):
    # A controller carries one error of what was learned, the same over its horizon.
    variance = ProcessErrors.together
    monkeypatch.setattr(
        ProcessErrors,
        "together",
        lambda one, others, **_: np.sqrt(
            [variance(one, [one])[0] * variance(o, [o])[0] for o in others]
        ),
    )
    functions, model = exported(kind), KINDS[kind]()
    runner = Filter(model, use_compiler=False)
    horizon, past = 12, model.dynamics.window[0]
    rng = np.random.default_rng(8)
    commands = rng.uniform(0.6, 0.8, size=(past + horizon + 2, len(model.dynamics.inputs)))
    start = model.reference_state
    record = _Record(inputs=commands, n=horizon + 2, dt=0.01)
    always = np.ones(len(model.dynamics.innovations))
    settled = RecordGains(
        solutions=(runner.riccati,),
        rows=((0, always),),
        pattern=np.zeros(horizon + 2, dtype=np.int32),
    )
    filtered = Filtered(
        record=record,
        states=np.tile(start, (horizon + 2, 1)),
        innovations=np.zeros((1, 1)),
        outputs=np.zeros((1, 1)),
        covariance=np.zeros((1, 1, 1)),
        p=model.parameter_vector(),
        gains=settled,
    )
    ahead = list(Propagator(runner, use_compiler=False).run(filtered, np.array([0]), horizon))
    n, size = functions.own_error_states, functions.sizes
    x = np.concatenate([start, *(commands[past + 1 - lag] for lag in (1, 2))])
    values = {"S": functions.noise.covariance.copy(), "K": np.zeros((size["n_u"], size["n_d"]))}
    values |= {
        "c": np.zeros((size["n_d"], size["n_g"])),
        "b": np.zeros((size["n_d"], size["n_theta"])),
    }
    # greybox takes B_d at the reference point, the exported step where the path is: put the former
    # into the latter.
    reference = {
        "x": functions.reference[0],
        "u": functions.reference[1],
        "p": functions.parameter_values,
    }
    far = call(functions, "B_d", reference)["B_d"] if kind == "hybrid" else None
    for h in range(1, horizon):
        point = {"x": x, "u": commands[past + h], "p": functions.parameter_values, **values}
        found = call(functions, "consider_step", point)
        if far is not None:
            here = call(functions, "B_d", point)["B_d"]
            deviation = np.sqrt(
                functions["gp_variance"](call(functions, "gp_features", point)["z"], [])
                .full()
                .ravel()
            )
            found["c_next"] = found["c_next"] + (far - here) * deviation
        x = call(functions, "f_d", point)["x_next"].ravel()
        values |= {k.removesuffix("_next"): v for k, v in found.items() if k.endswith("_next")}
        point = {"x": x, "u": commands[past + h + 1], "p": functions.parameter_values, **values}
        total = call(functions, "consider_step", point)["total"]
        want = ahead[h].covariance[0]
        spread = np.sqrt(np.diag(want))
        assert np.abs((total[:n, :n] - want) / np.outer(spread, spread)).max() < 1e-6
        np.testing.assert_allclose(x[: start.size], ahead[h].states[0], atol=1e-10)


def test_covariance_steps_are_the_formula():
    functions = exported("hybrid")
    point = cases.point(functions, np.random.default_rng(9))
    jac = call(functions, "f_d_jac", point)
    z = call(functions, "gp_features", point)["z"]
    variance = functions["gp_variance"](z, point["p"]).full().ravel()
    b_d = call(functions, "B_d", point)["B_d"]
    learned = b_d @ np.diag(variance) @ b_d.T
    open_loop = jac["A"] @ point["S"] @ jac["A"].T + learned + functions.noise.process
    closed = jac["A"] + jac["B"] @ point["K"]
    np.testing.assert_allclose(
        call(functions, "covariance_step", point)["S_next"], open_loop, atol=1e-12
    )
    want = closed @ point["S"] @ closed.T + learned + functions.noise.process
    np.testing.assert_allclose(
        call(functions, "covariance_feedback", point)["S_next"], want, atol=1e-12
    )
    assert variance.min() > 0


@pytest.mark.parametrize("kind", ["disturbed", "filtered", "hybrid"])
def test_targets_hold_the_reference_under_the_disturbance(kind):
    functions = exported(kind)
    x, u = (v.copy() for v in functions.reference)
    x[functions.states["disturbance.torque.y"]] = 2e-5
    if kind != "hybrid":
        x[functions.states["disturbance.force.x"]] = 0.03
    r = np.array([0.5, -0.2, 1.0, 2.8])
    for _ in range(12):
        x, u, residual = (
            v.full().ravel() for v in functions["target_step"](x, u, functions.parameter_values, r)
        )
    assert residual[0] < 1e-12
    held = x.copy()
    for _ in range(50):
        held = functions["f_d"](held, u, functions.parameter_values).full().ravel()
        for name in (
            functions.states.names
        ):  # the disturbances fade by themselves; the target takes them as they are
            if name.startswith("disturbance"):
                held[functions.states[name]] = x[functions.states[name]]
    np.testing.assert_allclose(held, x, atol=1e-9)
    np.testing.assert_allclose(
        x[[functions.states[f"position.{a}"] for a in "xyz"]], r[:3], atol=1e-10
    )
    assert x[functions.states["disturbance.torque.y"]] == 2e-5


@pytest.mark.parametrize("kind", ["physics", "hybrid"])
def test_the_hessian_is_the_slope_of_the_gradient(kind):
    functions = exported(kind)
    point = cases.point(functions, np.random.default_rng(10))
    hessian = call(functions, "lagrangian_hessian", point)["H"]
    nx = len(functions.states)

    def gradient(v):
        got = call(functions, "f_d_jac_raw", {**point, "x": v[:nx], "u": v[nx:]})
        return point["lam"] @ np.hstack([got["A_raw"], got["B_raw"]])

    v = np.concatenate([point["x"], point["u"]])
    for j in range(0, v.size, 4):
        step = np.zeros(v.size)
        step[j] = 1e-6
        np.testing.assert_allclose(
            hessian[:, j], (gradient(v + step) - gradient(v - step)) / 2e-6, rtol=1e-4, atol=1e-5
        )
    np.testing.assert_allclose(hessian, hessian.T, atol=1e-12)


def test_run_time_parameters_act_like_another_model():
    functions = exported("hybrid", ("mass", "gp.weights"))
    model = cases.hybrid()
    heavy = model.with_values({"mass": 1.3 * model.values["mass"]})
    posterior = model.dynamics.posterior
    other = replace(
        heavy,
        dynamics=HybridModel(
            inner=model.dynamics.inner,
            posterior=replace(posterior, weights=-2.0 * posterior.weights),
        ),
    )
    baked = model_functions(other)
    point = cases.point(functions, np.random.default_rng(11))
    p = functions.parameter_values.copy()
    assert functions.parameters.names[0] == "mass"
    p[0] *= 1.3
    p[1:] *= -2.0
    a = functions["f_d"](point["x"], point["u"], p).full()
    b = baked["f_d"](point["x"], point["u"], []).full()
    np.testing.assert_allclose(a, b, atol=1e-13)


def test_a_delay_at_run_time_needs_the_longest_history():
    free = model_functions(cases.physics(), runtime_parameters=("command_delay.d",))
    fixed = exported("physics")
    assert free.delay["u1"] == 11  # the declared upper bound of 0.1 s, and one for the share
    point = cases.point(free, np.random.default_rng(13))
    own, u = free.own_states, point["u"]
    short = np.concatenate([point["x"][:own], point["x"][own : own + 8]])
    a, b = free["f_d"](point["x"], u, [0.013]).full(), fixed["f_d"](short, u, []).full()
    np.testing.assert_allclose(a[:own], b[:own], atol=1e-14)


def test_a_plan_keeps_no_commands_that_only_a_late_pose_sees():
    late = craft_model(craft(("motor_lag", "pose_delay")))
    options = {"with_": ("covariance", "target"), "runtime_parameters": ("pose_delay.d",)}
    whole = model_functions(late, **options)
    plan = model_functions(late, measured=False, **options)
    assert whole.delay["u1"] == 6 and not plan.delay  # .05 s, and one for the share
    assert plan.parameters.names == whole.parameters.names
    assert set(whole.functions) - set(plan.functions) == {"h", "h_jac", "h_jac_raw"}
    point, own = cases.point(whole, np.random.default_rng(14)), plan.own_states
    x, u, p = point["x"], point["u"], point["p"]
    a, b = whole["f_d"](x, u, p).full(), plan["f_d"](x[:own], u, p).full()
    np.testing.assert_allclose(a[:own], b, atol=1e-14)
    np.testing.assert_allclose(plan.noise.process, whole.noise.process[: own - 1, : own - 1])


def test_functions_that_measure_nothing_have_no_filter():
    with pytest.raises(ModelError, match="measured=False leaves out what measurements need"):
        model_functions(cases.physics(), with_=("filter",), measured=False)


def test_out_of_domain_is_zero_inside_and_grows_outside():
    functions = exported("physics")
    point = cases.point(functions, np.random.default_rng(12))
    point["x"], point["u"] = (v.copy() for v in functions.reference)
    inside = call(functions, "out_of_domain", point)["number"].item()
    point["u"][0] = 1.25
    outside = call(functions, "out_of_domain", point)["number"].item()
    assert inside == 0.0
    assert outside == pytest.approx((1.25 - 0.9) / 0.7)


def test_battery_voltage_is_a_parameter_and_noise_keeps_its_intensity_at_another_rate():
    from greybox.model.model import build_model
    from tests import simulated

    columns = (
        "u1",
        "u2",
        "u3",
        "u4",
        "vbat",
        "p",
        "q",
        "r",
        "ax",
        "ay",
        "az",
        "qw",
        "qx",
        "qy",
        "qz",
        "x",
        "y",
        "z",
    )
    dynamics = build_model(
        simulated.vehicle(),
        columns,
        ("motor_lag", "command_delay", "battery_sag"),
        sample_time=0.01,
    )
    values = {"command_delay.d": 0.013, "motor_lag.tau": 0.04, "battery_sag.c_V": 1.0}
    model = hybrid_cases.craft_model(dynamics).with_values(values)
    model = replace(model, reference_inputs=np.array([0.7, 0.7, 0.7, 0.7, 3.8]))
    slow, fast = model_functions(model), model_functions(model, dt=0.005)
    assert slow.parameters.names == ("vbat",) and slow.parameter_values == 3.8
    assert (slow.delay["u1"], fast.delay["u1"]) == (2, 3)
    # Two short steps under one command end where one long step ends, and their noise adds up to the
    # same. Noise at the end of one long step: rates gain dt w/J, so that variances add over the two
    # short ones.
    rate = slow.error_states["d_rate.x"]
    np.testing.assert_allclose(
        2 * fast.noise.process[rate, rate], slow.noise.process[rate, rate], rtol=1e-4
    )
    x, u, p = *slow.reference, slow.parameter_values
    u = u + 0.1
    x = np.concatenate([x[: slow.own_states], u, u])
    one = slow["f_d"](x, u, p).full().ravel()[: slow.own_states]
    y = np.concatenate([x[: slow.own_states], u, u, u])
    for _ in range(2):
        y = fast["f_d"](y, u, p).full().ravel()
    np.testing.assert_allclose(y[: slow.own_states], one, atol=5e-6)


@pytest.mark.parametrize("kind", list(KINDS))
def test_what_is_not_a_number_is_out_of_every_domain(kind):
    functions = exported(kind)
    x, u = functions.reference
    p = functions.parameter_values
    assert float(functions["out_of_domain"](x, u, p)[0]) < 1e3
    for wrong in (np.nan, np.inf):
        for i in range(x.size):
            bad = x.copy()
            bad[i] = wrong
            assert float(functions["out_of_domain"](bad, u, p)[0]) == 1e30
        assert float(functions["out_of_domain"](x, u * wrong, p)[0]) == 1e30


@pytest.mark.parametrize("dt", [0.0025, 0.03])
def test_disturbances_decay_and_spread_alike_at_another_rate(dt):
    """d+ = exp(-dt/T) d + w with the stationary variance of the identified rate, q / (1 - exp(-2
    dt/T))."""
    model = cases.disturbed()
    own, other = model_functions(model), model_functions(model, dt=dt)
    for state in ("disturbance.force.x", "disturbance.torque.z"):
        time = float(model.values[f"{state.rpartition('.')[0]}.T"])
        at, error = other.states[state], other.error_states[f"d_{state}"]
        x, u = other.reference[0].copy(), other.reference[1]
        x[at] = 0.02
        after = other["f_d"](x, u, other.parameter_values).full().ravel()
        assert after[at] == pytest.approx(0.02 * np.exp(-dt / time), rel=1e-12)
        fresh, usual = other.noise.process[error, error], own.noise.process[error, error]
        assert usual > 0
        assert fresh / -np.expm1(-2 * dt / time) == pytest.approx(
            usual / -np.expm1(-2 * own.dt / time), rel=1e-9
        )


def test_what_cannot_be_exported_is_refused():
    with pytest.raises(ModelError, match="discrete"):
        model_functions(cases.linear(), dt=0.01)
    with pytest.raises(UnknownNameError, match="covariance"):
        model_functions(cases.physics(), with_=("covarianse",))
    with pytest.raises(UnknownNameError, match="mass"):
        model_functions(cases.physics(), runtime_parameters=("mas",))
    with pytest.raises(ModelError, match=r"gp\.weights"):
        model_functions(cases.physics(), runtime_parameters=("gp.weights",))
    push = hybrid_cases.push(hybrid_cases.craft(), ("phi", "p"))
    with pytest.raises(ModelError, match="Euler"):
        model_functions(cases.identified(HybridModel(inner=hybrid_cases.craft(), posterior=push)))


class _Record:
    """What `Propagator` asks of a record."""

    def __init__(self, *, inputs: np.ndarray, n: int, dt: float) -> None:
        self.inputs, self.n, self.dt = inputs, n, dt
