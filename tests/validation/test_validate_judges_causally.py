"""validate uses no later sample, crosses no gap, and is exact on data that the model itself
made."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from importlib import resources

import jsonschema
import numpy as np
import pytest

from greybox.commands import validate as command
from greybox.data import Dataset, Flight, Segment
from greybox.errors import DataError, FileFormatError, ModelError
from greybox.estimation.engine import engine_for
from greybox.examples import vehicle_path
from greybox.files import dump_json
from greybox.model.effects import effect_by_name
from greybox.model.identified import IdentifiedModel
from greybox.model.model import PhysicsModel, sensors_for
from greybox.model.parameter import ParameterValues
from greybox.model.vehicle import read_vehicle
from greybox.model.verdict import Outcome
from greybox.validation.adapt import adapt_to_flight
from greybox.validation.open_loop import GroupReader, predict_from, started_at_measurement
from greybox.validation.validate import validate

DT = 0.01
COLUMNS = ("x", "y", "z", "qw", "qx", "qy", "qz", "p", "q", "r", "ax", "ay", "az")


def make_model(**changes: object) -> IdentifiedModel:
    vehicle = read_vehicle(vehicle_path("nanobench"))
    dynamics = PhysicsModel(
        vehicle=vehicle,
        sensors=sensors_for(COLUMNS, vehicle),
        effects=(effect_by_name("accelerometer_bias"),),
    )
    values = ParameterValues({d.name: d.nominal for d in dynamics.parameters})
    hover = {f"u{i}": 0.849 for i in range(1, 5)}
    fields = {
        "dynamics": dynamics,
        "values": values,
        "process_noise": np.array([4e-3] * 3 + [1e-5] * 3),
        "sensor_noise": np.array([1e-3] * 3 + [3e-3] * 3 + [2e-2] * 3 + [5e-2] * 3),
        "weak": np.full(12, 100.0),
        "reference_state": dynamics.reference(hover),
        "reference_inputs": np.full(4, 0.849),
        "sample_time": DT,
        "flight_spread": {f"accelerometer_bias.b_{a}": (0.0, 0.3) for a in "xyz"},
    }
    return IdentifiedModel(**{**fields, **changes})


def fly(
    model: IdentifiedModel,
    n: int,
    *,
    seed: int = 0,
    noise: float = 0.0,
    changes: dict | None = None,
) -> Segment:
    """A flight that obeys the model exactly, with white sensor noise of `noise` times the model's
    levels."""
    rng = np.random.default_rng(seed)
    engine = engine_for(model.dynamics, ())
    u = 0.849 + 0.003 * np.sin(
        np.arange(n)[:, None] * DT * rng.uniform(2, 9, 4) + rng.uniform(0, 6, 4)
    )
    start, _ = model.dynamics.initial_state({})
    p = model.parameter_vector(changes)
    y, x = engine.rollout(
        starts=start[None],
        rows=np.array([0]),
        horizon=n,
        inputs=engine.padded_inputs(u),
        p=p,
        dt=DT,
        want_states=True,
    )
    sigma = np.array([1e-3] * 3 + [1.5e-3] * 4 + [2e-2] * 3 + [5e-2] * 3)
    measured = y[0] + noise * sigma * rng.standard_normal(y[0].shape)
    measured[:, 3:7] /= np.linalg.norm(measured[:, 3:7], axis=1, keepdims=True)
    channels = dict(zip(COLUMNS, measured.T, strict=True))
    channels |= dict(zip(("vx", "vy", "vz"), x[0, :, 3:6].T, strict=True))
    channels |= {f"u{i + 1}": u[:, i] for i in range(4)}
    return Segment(t=DT * np.arange(n), channels=channels, flight="f")


def dataset(*segments: Segment) -> Dataset:
    return Dataset(
        flights=(Flight(name="f", segments=segments, noncausal=frozenset({"vx", "vy", "vz"})),)
    )


def test_the_true_model_predicts_its_own_flight_exactly() -> None:
    model = make_model()
    result = validate(model, dataset(fly(model, 200)), adapt=0.0, measured_start=True)
    assert set(result.table.groups) == {"position", "velocity", "rotation", "rate"}
    for table in (result.table, result.measured_start):
        # The velocity starts from a line through the first tenth of a second of positions: not
        # exact.
        limit = {"position": 3e-4, "velocity": 5e-4, "rotation": 1e-5, "rate": 1e-5}
        worst = {g: e.mae[:50].max() for g, e in table.groups.items()}
        assert {g: e for g, e in worst.items() if e > limit[g]} == {}
    assert result.table.groups["rate"].origins == 200 - 50 - 9
    assert result.persistence.groups["position"].mae[-1] > 1e-4
    assert "rate" not in result.dead_reckoning.groups


def test_a_prediction_does_not_change_with_later_measurements() -> None:
    model = make_model()
    from greybox.estimation.filtering import Filter

    segment = fly(model, 160, noise=1.0)
    later = {
        n: np.where(np.arange(160) > 80, v + 0.3, v)
        for n, v in segment.channels.items()
        if not n.startswith("u")
    }
    filt, reader = Filter(model), GroupReader(model)
    both = [
        predict_from(filt.engine, reader, filt.run(s), np.array([60, 80]), steps=50)
        for s in (segment, segment.replace(later))
    ]
    for g in both[0]:
        np.testing.assert_array_equal(both[0][g], both[1][g])


def test_origins_do_not_cross_a_gap() -> None:
    model = make_model()
    whole = fly(model, 250, noise=1.0)
    parts = whole.rows(0, 120), whole.rows(130, 250)
    result = validate(model, dataset(*parts), adapt=0.0)
    assert result.table.groups["rate"].origins == 2 * (120 - 50 - 9)
    assert result.table.groups["rate"].n[49] == 2 * (120 - 50 - 9)


def test_a_missing_sample_takes_its_origins_with_it() -> None:
    model = make_model()
    segment = fly(model, 200, noise=1.0)
    x = np.array(segment.channels["x"])
    x[100] = np.nan
    result = validate(model, dataset(segment.replace({"x": x})), adapt=0.0)
    assert result.table.groups["position"].left_out == 51
    assert result.table.groups["rate"].left_out == 0


def without_samples(segment: Segment, lost: np.ndarray) -> Segment:
    return segment.replace({n: np.where(lost, np.nan, segment.channels[n]) for n in COLUMNS[:7]})


@pytest.mark.parametrize("share", [0.02, 0.17])
def test_drop_outs_here_and_there_take_no_group_from_the_verdict(share: float) -> None:
    model = make_model()
    segment = fly(model, 400, noise=1.0)
    lost = np.random.default_rng(0).random(400) < share
    result = validate(model, dataset(without_samples(segment, lost)))
    assert {"position", "rotation", "rate"} <= set(result.table.groups)
    assert result.table.unjudged == ()
    assert any("are left out" in w for w in result.warnings)
    assert result.verdict.outcome is not Outcome.PARTLY_JUDGED


@pytest.mark.parametrize(
    ("slower", "every", "first"),
    [
        pytest.param(2, 2, 0, marks=pytest.mark.slow),
        pytest.param(2, 2, 1, marks=pytest.mark.slow),
        (3, 3, 2),
        (5, 10, 4),
    ],
)
def test_a_pose_that_is_slower_than_the_imu_is_judged_at_every_horizon(
    slower: int, every: int, first: int
) -> None:
    # A fixed stride meets every pose or none: 0.5 s ahead is no multiple of three samples.
    model = make_model()
    lost = np.arange(600) % slower != first
    flight = dataset(without_samples(fly(model, 600, noise=1.0), lost))
    result = validate(model, flight, every=every)
    assert {g.name for g in result.verdict.groups} >= {"position", "rotation", "rate"}
    for group in ("position", "rotation"):
        counts = result.table.groups[group].n[:50]
        assert counts.min() > 0.5 * counts.mean()
    assert "nan" not in f"{result.verdict.line} {result.format()}"


def test_a_group_measured_only_where_no_origin_is_could_not_be_judged() -> None:
    model = make_model()
    segment = fly(model, 400, noise=1.0)
    result = validate(
        model, dataset(without_samples(segment, np.arange(400) < 370)), use_compiler=False
    )
    assert result.table.unjudged == ("position", "rotation")
    assert (
        "osition and rotation could not be judged: too many samples missing" in result.verdict.line
    )
    assert result.verdict.outcome is not Outcome.USABLE
    assert result.judged().verdict == result.verdict


def test_smoothed_channels_are_a_reference_and_never_a_measurement() -> None:
    model = make_model()
    segment = fly(model, 150, noise=1.0)
    quiet = segment.replace({n: np.full(150, np.nan) for n in ("vx", "vy", "vz")})
    with_v, without = (validate(model, dataset(s)) for s in (segment, quiet))
    assert "velocity" in with_v.table.groups
    assert "velocity" not in without.table.groups
    np.testing.assert_array_equal(
        with_v.table.groups["position"].mae, without.table.groups["position"].mae
    )
    sensors = sensors_for([*COLUMNS, "vx", "vy", "vz"], model.dynamics.vehicle)
    wrong = replace(
        model, dynamics=replace(model.dynamics, sensors=sensors), sensor_noise=np.full(15, 0.1)
    )
    with pytest.raises(ModelError, match="vx"):
        validate(wrong, dataset(segment))


def test_measured_start_puts_the_measured_values_into_the_state() -> None:
    model = make_model()
    from greybox.estimation.filtering import Filter
    from greybox.validation.groups import GROUPS, error_norms

    segment = fly(model, 120, noise=3.0)
    reader, filtered = GroupReader(model), Filter(model).run(segment)
    references = {
        g: segment.matrix(GROUPS[g].columns) for g in ("position", "velocity", "rotation", "rate")
    }
    origins = np.arange(20, 60)
    states = started_at_measurement(filtered, reader, origins, references)
    outputs = np.zeros((len(origins), len(COLUMNS)))
    outputs[:, :10] = np.concatenate([states[:, :3], states[:, 6:13]], axis=1)
    values = reader.values(outputs, states, filtered.p, np.zeros((len(origins), 4)))
    for g, reference in references.items():
        assert error_norms(g, values[g], reference[origins]).max() < 1e-9


def test_adaptation_finds_the_bias_of_a_flight_and_judges_after_it() -> None:
    model = make_model()
    bias = {"accelerometer_bias.b_x": 0.25, "accelerometer_bias.b_y": -0.1}
    data = dataset(fly(model, 400, noise=1.0, changes=bias))
    found = adapt_to_flight(model, data["f"], 2.0)
    for name, value in bias.items():
        assert abs(found.values[name] - value) < 4 * found.std[name] < 0.1
    result = validate(model, data, adapt=2.0)
    assert result.table.groups["position"].origins == 400 - 200 - 50
    assert result.one_step["ax"].n == 200
    cell = result.to_dict()["adapted_on"]["flights"]["f"]["accelerometer_bias.b_x"]
    assert cell["value"] == pytest.approx(found.values["accelerometer_bias.b_x"], abs=1e-9)


def test_logs_without_pose_are_judged_by_rate_and_specific_force() -> None:
    vehicle = read_vehicle(vehicle_path("nanobench"))
    dynamics = PhysicsModel(vehicle=vehicle, sensors=sensors_for(COLUMNS[7:], vehicle))
    pose = make_model()
    model = IdentifiedModel(
        dynamics=dynamics,
        values=ParameterValues({d.name: d.nominal for d in dynamics.parameters}),
        process_noise=pose.process_noise,
        sensor_noise=np.array([2e-2] * 3 + [5e-2] * 3),
        weak=np.full(len(dynamics.error_states), 100.0),
        reference_state=dynamics.reference({}),
        reference_inputs=np.full(4, 0.849),
        sample_time=DT,
    )
    segment = fly(pose, 150, noise=1.0)
    imu = Segment(
        t=segment.t,
        channels={n: v for n, v in segment.channels.items() if n in COLUMNS[7:] or n[0] == "u"},
        flight="f",
    )
    result = validate(
        model, Dataset(flights=(Flight(name="f", segments=(imu,)),)), use_compiler=False
    )
    assert set(result.table.groups) == {"rate", "specific_force"}
    assert result.dead_reckoning is None


def test_the_result_is_valid_and_the_coverage_of_the_true_model_is_honest() -> None:
    model = make_model()
    result = validate(
        model,
        dataset(fly(model, 900, noise=1.0)),
        adapt=1.0,
        every=4,
        measured_start=True,
        use_compiler=False,
    )
    schema = json.loads(resources.files("greybox").joinpath("schemas/validate.json").read_text())
    jsonschema.Draft202012Validator(schema).validate(json.loads(dump_json(result.to_dict())))
    assert result.one_step["p"].rmse == pytest.approx(0.02, rel=0.1)
    assert all(c.fraction > 0.93 for c in (cs[1] for cs in result.coverage.values()))
    assert "position [m]" in result.format()
    row = next(line for line in result.format().splitlines() if line.split()[:1] == ["ax"])
    assert row.split()[2] == "m/s^2" and float(row.split()[3]) == round(result.one_step["ax"].r2, 4)


def test_a_setpoint_elsewhere_is_no_extrapolation_and_a_faster_rate_is() -> None:
    model = make_model()
    segment = fly(model, 300)
    far = replace(segment, channels={**segment.channels, "sp_x": np.full(segment.n, 9.0)})
    said = validate(
        replace(model, domain={"sp_x": (-1.0, 1.0), "q": (-1e-9, 1e-9)}), dataset(far)
    ).warnings
    assert [w for w in said if "outside the training range" in w and "q (" in w]
    assert not [w for w in said if "sp_x" in w]


def test_longer_horizons_than_fifty_use_the_origins_that_reach_them() -> None:
    model = make_model()
    result = validate(model, dataset(fly(model, 160)), adapt=0.0, horizon_samples=(1, 100))
    rate = result.table.groups["rate"]
    assert rate.origins == 110 - 9
    assert rate.n[99] == 60 - 9
    assert rate.mae[99] < 3e-5


def test_wrong_requests_are_refused() -> None:
    model = make_model()
    data = dataset(fly(model, 120))
    with pytest.raises(DataError, match="horizons"):
        validate(model, data, horizons=(0,))
    with pytest.raises(DataError, match="horizon_samples"):
        validate(model, data, horizons=(1, 10, 50))
    with pytest.raises(DataError, match="whole numbers"):
        validate(model, data, horizon_samples=(0,))
    with pytest.raises(DataError, match="sampled every"):
        validate(replace(model, sample_time=0.02), data)
    with pytest.raises(DataError, match="50 steps"):
        validate(model, dataset(fly(model, 40)))


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser()
    command.add(parser.add_subparsers())
    parsed = parser.parse_args(arguments)
    return parsed.run(parsed)


def test_the_command_writes_a_valid_result(tmp_path, capsys) -> None:
    model = make_model()
    segment = fly(model, 300, noise=1.0)
    vehicle = (vehicle_path("nanobench").read_text()).split("[columns.")[0]
    (tmp_path / "v.toml").write_text(vehicle)
    plain = replace(
        model, dynamics=replace(model.dynamics, vehicle=read_vehicle(tmp_path / "v.toml"))
    )
    plain.save(tmp_path / "model.json")
    names = [n for n in segment.channels if not n.startswith("v")]
    table = np.column_stack([segment.t, segment.matrix(names)])
    np.savetxt(
        tmp_path / "log.csv", table, delimiter=",", header=",".join(["t", *names]), comments=""
    )
    arguments = [
        "validate",
        str(tmp_path / "model.json"),
        "--log",
        str(tmp_path / "log.csv"),
        "--keep-ground",
    ]
    assert (
        main([*arguments, "--horizons-samples", "1,20", "--json", str(tmp_path / "out.json")]) == 0
    )
    result = json.loads((tmp_path / "out.json").read_text())
    assert [row["h"] for row in result["horizons"]] == [1, 20]
    assert set(result["horizons"][0]["groups"]) == {"position", "rotation", "rate"}
    assert "persistence" in capsys.readouterr().out
    with pytest.raises(DataError, match="--horizons"):
        main([*arguments, "--horizons", "one"])
    with pytest.raises(FileFormatError, match="no such file"):
        main(["validate", str(tmp_path / "none.json"), "--log", str(tmp_path / "log.csv")])
