"""Every kind of noise part is white at zero, fits its sizes and units, steps as its closed form, in
any order and backend."""

from __future__ import annotations

import pickle

import casadi as ca
import numpy as np
import pytest

from greybox.errors import ModelError, UnknownNameError
from greybox.model.dynamics import Dynamics, StateSpaceModel
from greybox.model.layer import innermost, physics_of
from greybox.model.model import build_model
from greybox.model.noise import (
    KINDS,
    Augmented,
    Coloured,
    Delay,
    Disturbance,
    Drift,
    Gust,
    Line,
    LowPass,
    disturbances,
    sensor_parts,
    with_disturbance,
    with_parts,
    with_white_sensors,
    without_parts,
)
from greybox.model.vehicle import read_vehicle
from greybox.plants.presets import x250
from greybox.plants.vehicle_file import write_vehicle
from greybox.symbolic import Layout, Signal

DT = 0.01
COLUMNS = ("p", "q", "r", "ax", "ay", "az", "qw", "qx", "qy", "qz", "x", "y", "z")
EXAMPLES = {
    "disturbance": Disturbance(group="torque", time=0.4),
    "gust": Gust(group="force", time=0.4),
    "coloured": Coloured(sensor="gyro", time=0.05),
    "drift": Drift(sensor="gyro"),
    "line": Line(sensor="accelerometer", time=0.5, frequency=13.0),
    "low_pass": LowPass(sensor="accelerometer", time=0.008),
    "delay": Delay(sensor="gyro", time=0.004),
}
PARTS = (*EXAMPLES.values(), Coloured(sensor="attitude", time=0.2))


@pytest.fixture(scope="module")
def physics(tmp_path_factory):
    vehicle = read_vehicle(
        write_vehicle(tmp_path_factory.mktemp("v") / "v.toml", x250(), sigma={"thrust.c2": 0.1})
    )
    return build_model(vehicle, COLUMNS, ("motor_lag", "rotor_drag"), sample_time=DT)


def functions(model, symbols=ca.SX):
    """step and output of (x, U, p, w), innovation of (y, x, U, p, w), f and h of (x, u, p, w)."""
    sizes = {
        "x": (len(model.states), 1),
        "U": (len(model.inputs), sum(model.window) + 1),
        "p": (len(model.parameters), 1),
        "w": (len(model.noises), 1),
        "y": (len(model.outputs), 1),
    }
    x, u, p, w, y = (symbols.sym(n, *size) for n, size in sizes.items())
    out, now = model.output(0, x, u, p, w, DT), u[:, model.window[0]]
    return {
        "step": ca.Function("step", [x, u, p, w], [model.step(0, x, u, p, w, DT)]),
        "output": ca.Function("output", [x, u, p, w], [out]),
        "innovation": ca.Function("innovation", [y, x, u, p, w], [model.innovation(y, out, x)]),
        "f": ca.Function("f", [x, u, p, w], [model.f(0, x, now, p, w)]),
        "h": ca.Function("h", [x, u, p, w], [model.h(0, x, now, p, w)]),
    }


def point(model, seed=0):
    """A state near hover with random own states, commands, parameters, no noise."""
    rng = np.random.default_rng(seed)
    x, sigma = model.initial_state({n: np.array([0.1]) for n in COLUMNS} | {"qw": np.array([1.0])})
    n, nd = len(innermost(model).states), len(innermost(model).error_states)
    x[n:] += sigma[nd:] * rng.normal(size=x.size - n)
    u = rng.uniform(0.4, 0.6, (len(model.inputs), sum(model.window) + 1))
    return x, u, np.array([d.nominal for d in model.parameters]), np.zeros(len(model.noises))


def flat(value):
    return np.asarray(value.full()).ravel()


def test_there_is_an_example_of_every_kind():
    assert {k.kind for k in KINDS} == set(EXAMPLES)
    assert all(type(EXAMPLES[k.kind]) is k for k in KINDS)


@pytest.mark.parametrize("kind", EXAMPLES)
def test_sizes_names_and_units_fit(physics, kind):
    part = EXAMPLES[kind]
    model = Augmented(core=physics, parts=(part,))
    assert isinstance(model, Dynamics)
    own = model.states.signals[len(physics.states) :]
    assert len(own) == 3 * len(part.copies)
    assert model.noises.signals[len(physics.noises) :] == own
    assert tuple(s.name for s in model.error_states.signals[len(physics.error_states) :]) == tuple(
        f"d_{s.name}" for s in own
    )
    where = physics.noises if isinstance(part, Disturbance) else physics.innovations
    own_group = getattr(part, "group", "")
    units = [
        s.unit
        for s in where
        if s.name.split(".")[0] in (own_group, "p", "q", "r", "ax", "ay", "az")
    ]
    expected = units[-3:] if part.name.endswith("accelerometer") else units[:3]
    assert [s.unit for s in own] == expected * len(part.copies)
    declared = model.parameters[len(physics.parameters) :]
    assert [d.name for d in declared] == [f"{part.name}.{q}" for q in part.quantities]
    assert all(
        d.unit == {"T": "s", "f": "Hz", "d": "s", "world": "-"}[d.name.split(".")[-1]]
        for d in declared
    )
    for value, size in (
        (model.reference(dict.fromkeys(COLUMNS, 0.1)), len(model.states)),
        (model.initial_state({})[0], len(model.states)),
        (model.initial_state({})[1], len(model.error_states)),
        (model.noise_scale(DT), len(model.noises)),
        (model.sensor_scale(), len(model.innovations)),
    ):
        assert value.shape == (size,)
        assert np.isfinite(value).all()
    assert (model.noise_scale(DT) > 0).all()
    assert (model.initial_state({})[1] > 0).all()


@pytest.mark.parametrize("kind", [k for k in EXAMPLES if k not in ("low_pass", "delay")])
def test_it_is_white_noise_where_its_states_are_zero(physics, kind):
    model = Augmented(core=physics, parts=(EXAMPLES[kind],))
    n, q, m = len(physics.states), len(physics.parameters), len(physics.noises)
    x, u, p, w = point(model)
    x[n:] = 0.0
    w[:m] = 0.1 * physics.noise_scale(DT)
    y = np.linspace(0.1, 1.0, len(model.outputs))
    mine, bare = functions(model), functions(physics)
    for which in ("step", "output", "f", "h"):
        size = n if which in ("step", "f") else len(physics.outputs)
        assert np.array_equal(
            flat(mine[which](x, u, p, w))[:size], flat(bare[which](x[:n], u, p[:q], w[:m]))
        )
    assert np.array_equal(
        flat(mine["innovation"](y, x, u, p, w)), flat(bare["innovation"](y, x[:n], u, p[:q], w[:m]))
    )
    assert not flat(mine["step"](x, u, p, w))[n:].any()


@pytest.mark.parametrize("kind", ["low_pass", "delay"])
def test_a_filter_without_time_is_no_filter(physics, kind):
    model = Augmented(core=physics, parts=(EXAMPLES[kind],))
    n, q, m = len(physics.states), len(physics.parameters), len(physics.noises)
    x, u, p, w = point(model)
    x[n:], p[-1] = 0.0, 1e-9
    expected = flat(functions(physics)["output"](x[:n], u, p[:q], w[:m]))
    assert flat(functions(model)["output"](x, u, p, w)) == pytest.approx(
        expected, rel=1e-6, abs=1e-6
    )


@pytest.mark.parametrize("kind", ["disturbance", "coloured", "drift", "line"])
def test_own_states_make_the_step_of_their_closed_form(physics, kind):
    part = EXAMPLES[kind]
    model = Augmented(core=physics, parts=(part,))
    n = len(physics.states)
    x, u, p, w = point(model)
    w[len(physics.noises) :] = np.linspace(0.1, 0.2, x.size - n)
    c = x[n:]
    expected = {
        "disturbance": np.exp(-DT / 0.4) * c,
        "coloured": np.exp(-DT / 0.05) * c,
        "drift": c,
        "line": np.exp(-DT / 0.5)
        * (
            np.kron(
                [[np.cos(t := 2 * np.pi * 13 * DT), -np.sin(t)], [np.sin(t), np.cos(t)]], np.eye(3)
            )
            @ np.resize(c, 6)
        ),
    }[kind]
    after = flat(functions(model)["step"](x, u, p, w))[n:]
    assert after == pytest.approx(expected[: c.size] + w[len(physics.noises) :], rel=1e-12)


@pytest.mark.parametrize(("world", "still"), [(1.0, "world"), (0.0, "body")])
def test_a_gust_stands_still_in_the_axes_of_its_share(physics, world, still):
    """A craft that turns by 3 rad/s for a second: the push of air stays, that of the craft goes
    along."""
    model = Augmented(core=physics, parts=(Gust(group="force"),))
    x, u, p, w = point(model)
    n, names = len(physics.states), model.states.names
    attitude, rate = names.index("attitude.w"), names.index("rate.x")
    p[-2:], u[:] = (1e9, world), 0.5

    def pushed(state):
        q0, q1, q2, q3 = state[attitude : attitude + 4]
        v = np.array([q1, q2, q3])
        turn = (q0**2 - v @ v) * np.eye(3) + 2 * np.outer(v, v) + 2 * q0 * np.cross(np.eye(3), v)
        return {"world": turn @ state[n:], "body": state[n:]}

    first, step = pushed(x), functions(model)["step"]
    for _ in range(100):
        x[rate : rate + 3] = [1.0, 2.0, -2.0]
        x = flat(step(x, u, p, w))
    other = {"world": "body", "body": "world"}[still]
    assert pushed(x)[still] == pytest.approx(
        first[still], rel=0.01, abs=0.01 * np.abs(first[still]).max()
    )
    assert np.linalg.norm(pushed(x)[other] - first[other]) > 0.3 * np.linalg.norm(first[other])


def test_a_filter_of_a_ramp_lags_by_its_time_constant():
    part = LowPass(sensor="accelerometer", time=0.008)
    values, slope = {"T": 0.008}, 3.0
    c, shown = ca.DM(0.0), []
    for k in range(60):
        reading = ca.DM(slope * DT * k)
        shown.append(float(part.shown(c, ca.DM(0.0), values, reading, DT)))
        c = part.step(c, ca.DM(0.0), values, reading, DT)
    t = DT * np.arange(60)
    exact = slope * (t - 0.008 * (1 - np.exp(-t / 0.008)))
    assert np.array(shown) == pytest.approx(exact, abs=1e-12)


def test_a_late_sensor_shows_a_ramp_late_by_its_delay():
    part = Delay(sensor="gyro", time=0.004)
    slope, c, shown = 3.0, ca.DM(0.0), []
    for k in range(10):
        reading = ca.DM(slope * DT * k)
        shown.append(float(part.shown(c, ca.DM(0.0), {"d": 0.004}, reading, DT)))
        c = part.step(c, ca.DM(0.0), {"d": 0.004}, reading, DT)
    assert np.array(shown)[1:] == pytest.approx(slope * (DT * np.arange(1, 10) - 0.004), abs=1e-12)


@pytest.mark.parametrize("kind", EXAMPLES)
def test_the_numbers_are_the_same_in_every_backend(physics, kind):
    model = Augmented(core=physics, parts=(EXAMPLES[kind],))
    x, u, p, w = point(model)
    y = np.linspace(0.1, 1.0, len(model.outputs))
    sx, mx = functions(model), functions(model, ca.MX)
    for which in sx:
        arguments = (y, x, u, p, w) if which == "innovation" else (x, u, p, w)
        assert flat(mx[which](*arguments)) == pytest.approx(
            flat(sx[which](*arguments)), rel=1e-12, abs=1e-14
        )


@pytest.mark.parametrize("kind", EXAMPLES)
def test_the_chart_goes_there_and_back(physics, kind):
    model = Augmented(core=physics, parts=(EXAMPLES[kind],))
    x = point(model)[0]
    d = 0.1 * np.random.default_rng(1).normal(size=len(model.error_states))
    moved = model.boxplus(ca.DM(x), ca.DM(d))
    assert flat(model.boxminus(moved, ca.DM(x))) == pytest.approx(d, abs=1e-12)
    assert flat(moved)[len(physics.states) :] == pytest.approx(
        x[len(physics.states) :] + d[len(physics.error_states) :]
    )


def test_parts_predict_the_same_in_whatever_order_they_were_added(physics):
    def predicted(order):
        model = physics
        for part in order:
            model = with_parts(model, (part,))
        x, u, p, w = point(model)
        names = model.states.names
        n = len(physics.states)
        x[n:] = [0.01 * (1 + sum(map(ord, name)) % 7) for name in names[n:]]
        y = np.linspace(0.1, 1.0, len(model.outputs))
        made = functions(model)
        step = flat(made["step"](x, u, p, w))
        return (
            dict(zip(names, step, strict=True)),
            flat(made["output"](x, u, p, w)),
            flat(made["innovation"](y, x, u, p, w)),
        )

    first = predicted(PARTS)
    for order in ((*reversed(PARTS),), PARTS[3:] + PARTS[:3]):
        step, output, innovation = predicted(order)
        assert step == pytest.approx(first[0], rel=1e-12)
        assert output == pytest.approx(first[1], rel=1e-12)
        assert innovation == pytest.approx(first[2], rel=1e-12)


def test_adding_parts_to_an_augmented_model_gives_one_augmented_model(physics):
    sensors = Augmented(core=physics, parts=PARTS[2:5])
    both = with_disturbance(sensors, ("torque", "force"))
    assert isinstance(both, Augmented)
    assert both.core is physics
    assert innermost(both) is physics_of(both) is physics
    # Disturbances stand in the order of the process noise, behind the sensors' own noise.
    assert [p.name for p in both.parts] == [
        *(p.name for p in PARTS[2:5]),
        "disturbance.force",
        "disturbance.torque",
    ]
    assert sensor_parts(both) == PARTS[2:5]
    assert [d.group for d in disturbances(both)] == ["force", "torque"]
    assert with_white_sensors(both) == with_disturbance(physics, ("force", "torque"))
    assert without_parts(both) is physics
    assert with_parts(physics, ()) is physics
    noise = "sensor noise coloured.gyro, drift.gyro, line.accelerometer, disturbance force, torque"
    assert both.name == f"{physics.name}, {noise}"


def test_effects_come_and_go_under_the_noise(physics):
    model = Augmented(core=physics, parts=PARTS)
    more = model.with_effect("gyro_bias")
    assert more.parts == model.parts
    assert "gyro_bias" in {e.name for e in physics_of(more).effects}
    assert more.without_effect("gyro_bias") == model


@pytest.mark.parametrize("kind", EXAMPLES)
def test_it_survives_a_trip_to_another_process(physics, kind):
    model = Augmented(core=physics, parts=(EXAMPLES[kind],))
    _ = model.states, model.step(0, *(ca.SX(v) for v in point(model)), DT)
    back = pickle.loads(pickle.dumps(model))
    assert back.parts == model.parts
    assert back.states == model.states
    assert back.parameters == model.parameters


def test_a_model_of_the_users_own_is_disturbed_but_has_no_sensors():
    model = StateSpaceModel(
        name="cart",
        states=Layout([Signal(name="x", unit="m"), Signal(name="v", unit="m/s")]),
        inputs=Layout([Signal(name="u", unit="N")]),
        outputs=Layout([Signal(name="x", unit="m")]),
        parameters=(),
        dynamics=lambda t, x, u, p: [x[1], u[0]],
        measurement=lambda t, x, u, p: [x[0]],
    )
    pushed = with_disturbance(model, ("v",), time=0.5)
    assert pushed.states.names == ("x", "v", "disturbance.v")
    assert pushed.parameters[0].nominal == 0.5
    assert physics_of(pushed) is None
    with pytest.raises(ModelError, match="cart has no sensors"):
        with_parts(model, (Drift(sensor="x"),))
    with pytest.raises(ModelError, match="cart is not a physics model"):
        pushed.with_effect("rotor_drag")


def test_mistakes_are_named(physics):
    with pytest.raises(UnknownNameError, match="barometer"):
        Augmented(core=physics, parts=(Coloured(sensor="barometer"),))
    with pytest.raises(UnknownNameError, match=r"disturbance group 'forse'.*did you mean force"):
        Augmented(core=physics, parts=(Disturbance(group="forse"),))
    with pytest.raises(ModelError, match=r"noise given twice: drift\.gyro"):
        Augmented(core=physics, parts=(EXAMPLES["drift"], Drift(sensor="gyro")))
    with pytest.raises(ModelError, match=r"two filters of one sensor.*gyro"):
        Augmented(core=physics, parts=(Delay(sensor="gyro"), LowPass(sensor="gyro")))
    with pytest.raises(ModelError, match=r"low_pass\.attitude"):
        Augmented(core=physics, parts=(LowPass(sensor="attitude"),))


@pytest.mark.parametrize("kind", EXAMPLES)
def test_at_another_rate_it_is_the_same_noise(physics, kind):
    """Simulated at 100 and at 250 Hz, filters fed with nothing: the same spread after two
    seconds."""
    part = EXAMPLES[kind]
    values = {d.name.removeprefix(f"{part.name}."): d.nominal for d in part.parameters(physics)}
    full = {f"{part.name}.{n}": v for n, v in values.items()}
    spread = {}
    for dt in (0.01, 0.004):
        size = len(part.copies) * len(part.place(physics).rows)
        c, w = ca.SX.sym("c", size), ca.SX.sym("w", size)
        reading = ca.DM.zeros(len(part.place(physics).rows))
        step = part.step(c, w, values, reading, dt)
        a, g = (np.array(ca.DM(ca.jacobian(step, v))) for v in (c, w))
        level = 0.3 * part.rescaled(full, 0.01, dt)
        p = np.zeros((size, size))
        for _ in range(round(2.0 / dt)):
            p = a @ p @ a.T + level**2 * g @ g.T
        spread[dt] = np.sqrt(np.diag(p))[0] if not getattr(part, "filters", False) else level
    assert spread[0.004] == pytest.approx(spread[0.01], rel=1e-9)
