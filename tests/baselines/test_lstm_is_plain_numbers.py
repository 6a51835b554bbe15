"""The LSTM without PyTorch says what PyTorch says, in NumPy and CasADi alike, and predicts
causally."""

from __future__ import annotations

import json
import subprocess
import sys

import casadi as ca
import numpy as np
import pytest

from greybox.baselines.lstm import LSTMModel
from greybox.baselines.regressors import Lags
from greybox.data import dataset_from_arrays
from greybox.errors import DataError, FileFormatError
from tests.baselines.second_order import flight

torch = pytest.importorskip("torch")


@pytest.fixture(scope="module")
def trained():
    from greybox.baselines.lstm_train import LSTMSettings, train_lstm

    settings = LSTMSettings(n_a=3, n_b=5, hidden=12, epochs=30, learning_rate=1e-2)
    return train_lstm(
        flight(0), flight(1), outputs=("y1", "y2"), inputs=("u",), settings=settings, seed=4
    )


@pytest.mark.parametrize("increments", [False, True])
@pytest.mark.parametrize(("n_a", "n_b", "newest"), [(4, 4, 1), (2, 5, 1), (5, 2, 0)])
def test_it_equals_torch_to_nine_digits(increments, n_a, n_b, newest):
    from greybox.baselines.lstm_train import LSTMSettings, Network, _layer, sequences

    lags = Lags(outputs=("p", "q"), inputs=("u1", "u2", "u3"), n_a=n_a, n_b=n_b, newest=newest)
    torch.manual_seed(1)
    network = Network(5, LSTMSettings(hidden=16), 2).double().eval()
    weights = {k: v.numpy() for k, v in network.state_dict().items()}
    rng = np.random.default_rng(2)
    scaling = {
        "input_mean": rng.normal(size=lags.width),
        "input_scale": rng.uniform(0.5, 2.0, lags.width),
    }
    model = LSTMModel(
        lags=lags,
        increments=increments,
        **scaling,
        target_mean=rng.normal(size=2),
        target_scale=rng.uniform(0.5, 2.0, 2),
        layers=(_layer(weights, 0), _layer(weights, 1)),
        head=(weights["head.weight"], weights["head.bias"]),
        variance=np.ones((3, 2)),
    )
    z = rng.normal(size=(50, lags.width))
    x = sequences(lags, (z - model.input_mean) / model.input_scale)
    with torch.no_grad():
        said = network(torch.from_numpy(x)).numpy() * model.target_scale + model.target_mean
    said += z[:, :2] if increments else 0.0
    assert model.mean(z) == pytest.approx(said, abs=1e-9)
    exported = model.function()
    assert np.array([exported(row).full().ravel() for row in z]) == pytest.approx(said, abs=1e-9)
    assert exported.name_in() == ["z"]
    slope = ca.Function(
        "slope",
        exported.mx_in(),
        [ca.jacobian(exported.call(exported.mx_in())[0], exported.mx_in()[0])],
    )
    assert np.isfinite(slope(z[0]).full()).all(), "it can be differentiated"


def test_it_learns_a_system_better_than_holding_the_last_value(trained):
    segment = flight(2).segments[0]
    y = segment.matrix(("y1", "y2"))
    mean, variance = trained.one_step(segment)
    known = np.isfinite(mean).all(axis=1)
    assert known.sum() == segment.n - 5
    error = np.mean((y - mean)[known] ** 2, axis=0)
    assert np.all(error < 0.25 * np.mean((y[known] - y[np.flatnonzero(known) - 1]) ** 2, axis=0))
    assert variance[known][0] == pytest.approx(error, rel=1.0)
    assert trained.report["ended"] in ("stopped", "epochs used up")


def test_the_first_step_of_a_free_run_is_the_one_step_prediction_and_later_ones_use_no_measurement(
    trained,
):
    segment = flight(2).segments[0]
    origins = np.array([10, 50, 200, segment.n - 3])
    one, _ = trained.one_step(segment)
    mean, variance = trained.free_run(segment, origins, 8)
    assert mean[:, 0] == pytest.approx(one[origins + 1], abs=1e-12)
    assert np.all(np.diff(np.nanmean(variance, axis=(0, 2))[:4]) > 0), "less is known further ahead"
    assert np.isnan(mean[-1, 4:]).all() and np.isfinite(mean[:-1]).all()
    later = {
        n: np.where(np.arange(segment.n) > 200, 9.0, segment.channels[n]) for n in ("y1", "y2")
    }
    changed, _ = trained.free_run(segment.replace(later), np.array([200]), 8)
    assert changed[0] == pytest.approx(mean[2], abs=1e-12)


def test_neither_the_measurement_nor_the_command_of_an_instant_moves_its_prediction(trained):
    segment = flight(2).segments[0]
    before, _ = trained.one_step(segment)
    now = np.arange(segment.n) == 100
    moved = segment.replace({n: np.where(now, 5.0, segment.channels[n]) for n in ("y1", "y2", "u")})
    after, _ = trained.one_step(moved)
    assert np.array_equal(after[:101], before[:101], equal_nan=True)
    assert not np.array_equal(after[101], before[101])


def test_the_same_seed_trains_the_same_network(trained):
    from greybox.baselines.lstm_train import LSTMSettings, train_lstm

    settings = LSTMSettings(n_a=3, n_b=5, hidden=12, epochs=30, learning_rate=1e-2)
    again = train_lstm(
        flight(0), flight(1), outputs=("y1", "y2"), inputs=("u",), settings=settings, seed=4
    )
    assert all(
        np.array_equal(a, b) for x, y in zip(again.layers, trained.layers) for a, b in zip(x, y)
    )


def test_it_survives_the_file_bit_by_bit_and_a_changed_file_is_refused(trained, tmp_path):
    path = trained.save(tmp_path / "lstm.json")
    again = LSTMModel.load(path)
    z = np.random.default_rng(0).normal(size=(20, trained.lags.width))
    assert np.array_equal(again.mean(z), trained.mean(z))
    assert again.report["ended"] == trained.report["ended"]
    assert again.parameters == trained.parameters
    body = json.loads(path.read_text())
    body["increments"] = not body["increments"]
    path.write_text(json.dumps(body))
    with pytest.raises(FileFormatError, match="checksum"):
        LSTMModel.load(path)


def test_data_without_a_complete_window_are_refused():
    from greybox.baselines.lstm_train import train_lstm

    short = dataset_from_arrays(0.01 * np.arange(5), {"y1": np.zeros(5), "u": np.zeros(5)})
    with pytest.raises(DataError, match="complete past"):
        train_lstm(short, short, outputs=("y1",), inputs=("u",))


def test_predicting_does_not_import_torch(trained, tmp_path):
    path = trained.save(tmp_path / "lstm.json")
    code = (
        "import sys; from greybox.baselines.lstm import LSTMModel; import numpy as np; "
        f"m = LSTMModel.load({str(path)!r}); m.mean(np.zeros((2, m.lags.width))); m.function(); "
        "print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
