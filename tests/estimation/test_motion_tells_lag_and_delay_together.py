"""Motion tells the sum of motor lag and delay better than its parts, and the fit says it."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest

from greybox.automatic.widened import widened
from greybox.data import Dataset
from greybox.errors import FileFormatError
from greybox.estimation.fit import fit
from greybox.estimation.result import Fit
from greybox.files import checksum
from greybox.model.effective_lag import effective_lag
from greybox.model.identified import IdentifiedModel
from greybox.model.model import build_model
from tests.automatic.craft import flight, flown, plant, vehicle


@functools.cache
def fitted() -> Fit:
    columns = flown(seeds=(1,), seconds=8.0)
    data = Dataset(flights=tuple(flight(c, f"run{i}").flights[0] for i, c in enumerate(columns)))
    effects = ("motor_lag", "command_delay")
    model = build_model(vehicle(), data.channels, effects, sample_time=0.01)
    return fit(model, data, fixed=("mass", "torque.c2", "thrust.c2"))


def test_the_sum_holds_the_truth_and_is_known_better_than_the_lag():
    found = fitted()
    lag = found.model.effective_lag
    truth = plant().truth()["parameters"]
    true = truth["motor_lag.tau"] + truth["command_delay.d"]
    assert lag is not None and 0 < lag.std < found["motor_lag.tau"].std
    assert abs(lag.value - true) < 2 * lag.std
    assert lag.value == pytest.approx(sum(lag.parts.values()))


def test_text_file_and_shown_model_say_the_same_line(tmp_path):
    found = fitted()
    lag = found.model.effective_lag
    assert lag is not None
    assert lag.line.startswith("commands act after") and "motor lag" in lag.line
    assert lag.line in found.summary() and lag.line in repr(found.model)
    assert found.to_dict()["effective_lag"]["line"] == lag.line
    path = found.model.save(tmp_path / "model.json")
    assert found.model.to_dict()["effective_lag"] == lag.to_dict()
    assert IdentifiedModel.load(path).effective_lag == lag


def test_its_error_is_that_of_a_sum():
    names = ("inertia.xx", "motor_lag.tau", "command_delay.d")
    covariance = np.array([[9.0, 0.5, 0.0], [0.5, 4.0, -3.0], [0.0, -3.0, 5.0]])
    lag = effective_lag({"motor_lag.tau": 0.05, "command_delay.d": 0.01}, names, covariance)
    assert lag is not None
    assert lag.std == pytest.approx(np.sqrt(4.0 + 5.0 - 2 * 3.0))


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_what_a_missing_effect_adds_is_in_the_sum_too(tmp_path, way: float):
    """Both go one way, or one takes what the other gives."""
    found, step = fitted(), 2e-3
    rows = {n: [i] for i, n in enumerate(("motor_lag.tau", "command_delay.d"))}
    more = step**2 * np.array([[1.0, way], [way, 1.0]])
    told = widened(found, more, rows).model
    before, lag = found.model.effective_lag, told.effective_lag
    assert before is not None and lag is not None and before.std is not None
    assert lag.std == pytest.approx(np.hypot(before.std, step * (1.0 + way)))
    assert told.form_errors == pytest.approx(dict.fromkeys(rows, step))
    assert IdentifiedModel.load(told.save(tmp_path / "model.json")).effective_lag == lag


def test_what_two_missing_effects_add_adds_up():
    found = fitted()
    once = widened(found, np.eye(1), {"motor_lag.tau": [0]})
    twice = widened(once, np.eye(1), {"command_delay.d": [0]})
    assert twice.model.form_errors == {"motor_lag.tau": 1.0, "command_delay.d": 1.0}
    assert twice.model.covariance is found.model.covariance


def test_earlier_files_that_know_only_its_deviations_are_read(tmp_path):
    told = widened(fitted(), np.eye(1), {"motor_lag.tau": [0]}).model
    content = told.to_dict()
    content["form_errors"] = {"motor_lag.tau": 1.0}
    del content["form_covariance"]
    body = {k: v for k, v in content.items() if k not in ("checksum", "versions")}
    again = IdentifiedModel.from_dict({**content, "checksum": checksum(body)})
    assert again.form_errors == told.form_errors


@pytest.mark.parametrize("wrong", [-np.eye(3), np.full((3, 3), np.nan), np.eye(2)])
def test_an_error_of_a_form_that_is_none_is_refused(wrong: np.ndarray):
    model = fitted().model
    size = len(model.covariance_names)
    bad = wrong if len(wrong) == 2 else np.pad(wrong, (0, size - 3))
    content = replace(model, form_covariance=np.eye(size)).to_dict()
    content["form_covariance"] = bad.tolist()
    body = {k: v for k, v in content.items() if k not in ("checksum", "versions")}
    with pytest.raises(FileFormatError, match="form"):
        IdentifiedModel.from_dict({**content, "checksum": checksum(body)})


def test_a_filter_of_the_gyro_counts_and_one_number_alone_is_not_repeated():
    values = {"motor_lag.tau": 0.05, "low_pass.gyro.T": 0.005, "low_pass.accelerometer.T": 0.01}
    lag = effective_lag(values, (), np.zeros((0, 0)))
    assert lag is not None and lag.value == pytest.approx(0.055)
    assert lag.line.startswith("commands show in the gyro after 55.0 ms")
    assert effective_lag({"motor_lag.tau": 0.05}, (), np.zeros((0, 0))) is None
