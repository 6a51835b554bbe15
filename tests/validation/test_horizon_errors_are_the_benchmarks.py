"""Multi-step tables follow the IDSIA definition: norms, geodesic angle, complete
origins."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from greybox.errors import DataError, UnknownNameError
from greybox.files import dump_json
from greybox.validation.baselines import persistence
from greybox.validation.groups import error_norms
from greybox.validation.horizon import HorizonAccumulator, spread_origins, strided

DT = 0.01


def _quaternion(rotation: Rotation) -> np.ndarray:
    return np.roll(rotation.as_quat(), 1, axis=-1)


@given(st.integers(0, 10_000))
@settings(max_examples=30, deadline=None)
def test_geodesic_angle_is_that_of_scipy_and_blind_to_sign(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = Rotation.random(5, rng=rng), Rotation.random(5, rng=rng)
    qa, qb = _quaternion(a), _quaternion(b)
    angle = error_norms("rotation", qa, qb)
    np.testing.assert_allclose(angle, (a.inv() * b).magnitude(), atol=1e-9)
    np.testing.assert_allclose(error_norms("rotation", -qa, qb), angle, atol=1e-9)
    np.testing.assert_allclose(error_norms("rotation", qb, qa), angle, atol=1e-9)


def test_tiny_angles_are_not_rounded_away() -> None:
    q = _quaternion(Rotation.from_rotvec([[0.0, 0.0, 0.0], [1e-7, 0.0, 0.0]]))
    assert error_norms("rotation", q[:1], q[1:])[0] == pytest.approx(1e-7, rel=1e-6)


def test_scalar_last_garbage_is_refused() -> None:
    with pytest.raises(DataError, match="unit norm"):
        error_norms("rotation", np.array([[2.0, 0, 0, 0]]), np.array([[1.0, 0, 0, 0]]))


def _ramp(n: int = 120, speed: float = 2.0) -> dict[str, np.ndarray]:
    t = np.arange(n) * DT
    return {
        "position": np.stack([speed * t, 0 * t, 0 * t], axis=1),
        "rate": np.ones((n, 3)) * t[:, None],
    }


def test_persistence_of_a_ramp_by_hand() -> None:
    reference = _ramp()
    origins = np.arange(70)
    accumulator = HorizonAccumulator(label="persistence", sample_time=DT)
    accumulator.add("a", persistence(reference, origins, steps=50), reference, origins)
    table = accumulator.table()
    plain = table.to_dict([1, 10, 50])
    for row in plain["horizons"]:
        assert row["seconds"] == pytest.approx(row["h"] * DT)
        assert row["groups"]["position"]["mae"] == pytest.approx(2.0 * DT * row["h"])
        assert row["groups"]["position"]["rmse"] == pytest.approx(2.0 * DT * row["h"])
        assert row["groups"]["rate"]["mae"] == pytest.approx(np.sqrt(3) * DT * row["h"])
        assert row["groups"]["position"]["n"] == len(origins)
        assert "velocity" not in row["groups"]
    assert plain["simerr"]["position"] == pytest.approx(2.0 * DT * 50 * 51 / 2)
    assert plain["per_flight"]["a"]["simerr"] == plain["simerr"]
    assert "position [m]" in table.format([1, 10, 50])


def test_pooling_weights_flights_by_their_origins() -> None:
    accumulator = HorizonAccumulator(label="model", sample_time=DT)
    for name, n, error in (("a", 10, 1.0), ("b", 30, 3.0)):
        reference = {"position": np.zeros((n + 50, 3))}
        accumulator.add(
            name, {"position": np.full((n, 50, 3), [error, 0, 0])}, reference, np.arange(n)
        )
    table = accumulator.table()
    assert table.groups["position"].mae[0] == pytest.approx((10 + 90) / 40)
    assert table.groups["position"].rmse[0] == pytest.approx(np.sqrt((10 + 270) / 40))
    assert table.simerr("b")["position"] == pytest.approx(150.0)


def test_adding_in_pieces_changes_nothing() -> None:
    rng = np.random.default_rng(0)
    reference = {"velocity": rng.standard_normal((200, 3))}
    predicted = rng.standard_normal((150, 50, 3))
    whole, pieces = (HorizonAccumulator(label="m", sample_time=DT) for _ in range(2))
    whole.add("a", {"velocity": predicted}, reference, np.arange(150))
    for part in np.array_split(np.arange(150), 7):
        pieces.add("a", {"velocity": predicted[part]}, reference, part)
    assert dump_json(whole.table().to_dict()).count("mae") == 6
    np.testing.assert_allclose(
        whole.table().groups["velocity"].mae, pieces.table().groups["velocity"].mae
    )


def test_missing_reference_drops_the_origin_or_the_step() -> None:
    reference = {"position": np.zeros((100, 3))}
    reference["position"][70] = np.nan
    predicted = {"position": np.ones((50, 50, 3))}
    strict = HorizonAccumulator(label="m", sample_time=DT)
    strict.add("a", predicted, reference, np.arange(50))
    errors = strict.table().groups["position"]
    assert (errors.origins, errors.left_out) == (20, 30)
    assert set(errors.n.tolist()) == {20}
    loose = HorizonAccumulator(label="m", sample_time=DT, missing="step")
    loose.add("a", predicted, reference, np.arange(50))
    errors = loose.table().groups["position"]
    assert errors.origins == 50
    assert errors.n[0] == 50
    assert errors.n[49] == 49


def test_longer_horizons_do_not_cost_origins_of_the_short_ones() -> None:
    accumulator = HorizonAccumulator(label="m", sample_time=DT, steps=80)
    accumulator.add(
        "a", {"rate": np.zeros((50, 80, 3))}, {"rate": np.ones((100, 3))}, np.arange(50)
    )
    table = accumulator.table()
    assert table.groups["rate"].n[49] == 50
    assert table.groups["rate"].n[79] == 20
    assert table.simerr()["rate"] == pytest.approx(50 * np.sqrt(3))


def test_a_diverged_prediction_is_infinite_and_counted_not_dropped() -> None:
    predicted = np.zeros((50, 50, 3))
    predicted[3, 40:] = np.nan
    accumulator = HorizonAccumulator(label="m", sample_time=DT)
    accumulator.add("a", {"rate": predicted}, {"rate": np.zeros((100, 3))}, np.arange(50))
    table = accumulator.table()
    assert table.diverged == 10
    assert table.groups["rate"].mae[39] == 0.0
    assert np.isinf(table.groups["rate"].mae[40])
    cell = json.loads(dump_json(table.to_dict([50])))["horizons"][0]["groups"]["rate"]
    assert cell["mae"] is None
    assert cell["diverged"] == 1


def test_coverage_of_calibrated_predictions_is_nominal() -> None:
    rng = np.random.default_rng(7)
    n = 1500
    spread = 0.02 * np.sqrt(np.arange(1, 51))
    rotation = Rotation.from_rotvec(rng.standard_normal((n * 50, 3)) * np.tile(spread, n)[:, None])
    reference = np.zeros((n + 50, 4))
    reference[:, 0] = 1.0
    predicted = _quaternion(rotation).reshape(n, 50, 4)
    covariance = np.broadcast_to((spread**2)[None, :, None, None] * np.eye(3), (n, 50, 3, 3))
    accumulator = HorizonAccumulator(label="m", sample_time=DT)
    accumulator.add(
        "a",
        {"rotation": predicted},
        {"rotation": reference},
        np.arange(n),
        covariances={"rotation": covariance},
    )
    coverage = accumulator.table().groups["rotation"].coverage
    assert coverage[0.68].mean() == pytest.approx(0.68, abs=0.01)
    assert coverage[0.95].mean() == pytest.approx(0.95, abs=0.01)


def test_bad_input() -> None:
    accumulator = HorizonAccumulator(label="m", sample_time=DT)
    with pytest.raises(UnknownNameError, match="rotation"):
        accumulator.add("a", {"rotatoin": np.zeros((1, 50, 4))}, {}, [0])
    with pytest.raises(DataError, match="lacks its 50 steps"):
        accumulator.add("a", {"rate": np.zeros((1, 50, 3))}, {"rate": np.zeros((60, 3))}, [10])
    with pytest.raises(DataError, match="do not match"):
        accumulator.add("a", {"rate": np.zeros((1, 51, 3))}, {"rate": np.zeros((60, 3))}, [0])
    with pytest.raises(DataError, match="no origin"):
        accumulator.table()


@pytest.mark.parametrize("every", [1, 2, 3, 5, 10])
def test_spread_origins_keep_their_mean_spacing_and_no_step_with_a_slower_sensor(
    every: int,
) -> None:
    rows = np.arange(7, 3007)
    origins = spread_origins(rows, every)
    assert abs(len(origins) - 3000 / every) <= 1
    assert np.diff(origins).min() >= 1 and np.diff(origins).max() < 2 * every
    for slower in (2, 3, 5, 7, 10):
        share = np.bincount(origins % slower, minlength=slower) / len(origins)
        assert np.allclose(share, 1 / slower, atol=0.02)


def test_a_stride_is_fixed_where_every_row_is_measured() -> None:
    rows, whole = np.arange(100), np.ones((200, 3))
    slow = np.where(np.arange(200)[:, None] % 2, np.nan, whole)
    never = np.full((200, 3), np.nan)
    assert np.array_equal(strided(rows, 4, [whole, never]), rows[::4])
    assert set(strided(rows, 4, [whole, slow]) % 2) == {0, 1}


def test_every_row_is_an_origin_of_its_own_where_none_is_left_out() -> None:
    assert np.array_equal(spread_origins(np.arange(30), 1), np.arange(30))


def test_a_table_lists_no_horizon_that_a_slower_reference_has_not() -> None:
    """One sample ahead of a reference of 10 Hz is the age of the last one, not .01 s."""
    reference = np.full((200, 3), np.nan)
    reference[::10] = np.arange(20)[:, None]
    origins = np.arange(10, 140)
    held = persistence({"position": reference}, origins, steps=50)
    rows = HorizonAccumulator(label="held", sample_time=0.01, missing="step")
    rows.add("a", held, {"position": reference}, origins)
    table = rows.table()
    assert table.groups["position"].interval == 10
    one, ten = table.to_dict([1, 10])["horizons"]
    assert one["groups"] == {} and ten["groups"]["position"]["mae"] == pytest.approx(3**0.5)
    assert table.format([1, 10]).splitlines()[-1].split()[1:3] == ["-", "1.7321"]
