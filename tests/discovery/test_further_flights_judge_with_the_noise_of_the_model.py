"""Further flights multiply the evidence of names, also where the sensors of the model are coloured."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from greybox.data import Dataset
from greybox.discovery.cause import sensor_cause
from greybox.discovery.further import further
from greybox.model.identified import IdentifiedModel
from greybox.model.noise import Coloured, sensor_parts
from tests.discovery.small_world import DAMPING, damped, flown, shorten
from tests.discovery.test_noise_that_is_not_felt_is_not_kept import coloured

pytestmark = pytest.mark.slow
NAME = "rotational_damping"


def seen(data: Dataset, seed: int) -> Dataset:
    """The flights as a gyro with errors that last shows them."""
    rng = np.random.default_rng(seed)
    return Dataset(flights=tuple(coloured(f, rng) for f in data))


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> IdentifiedModel:
    """Damping and a coloured gyro, read from its file."""
    flights = damped()
    flights.data = seen(flights.data, 1)
    part = sensor_cause(Coloured(sensor="gyro"), flights.causes.model)
    flights.causes = flights.causes.with_cause(part)
    at = flights.fit(flights.causes.base | {part.name, NAME})
    path: Path = tmp_path_factory.mktemp("model") / "model.json"
    flights.settled(at).model.save(path)
    return IdentifiedModel.load(path)


def content(log10_e: float) -> dict[str, Any]:
    """What discovery.json says of the one name, as far as it is looked at."""
    effect = {"name": NAME, "status": "supported", "log10_e": log10_e, "against": "parasitic_drag", "worth": None}
    return {
        "effects": [effect], "bar_log10_e": 2.0, "trained_on": ["train0", "train1"], "tested_on": [],
        "not_certified": [], "ambiguous": [], "unnamed": [],
    }  # fmt: skip


def test_a_name_that_is_there_gains_and_one_that_is_not_loses(
    model: IdentifiedModel, monkeypatch: pytest.MonkeyPatch
):
    shorten(monkeypatch)
    assert [p.name for p in sensor_parts(model.dynamics)] == ["coloured.gyro"]
    there = further(content(1.0), model, seen(flown(DAMPING, seeds=(21,), name="more"), 2))
    assert there["effects"][0]["further"] > 1.0
    assert there["effects"][0]["status"] == "certified"
    assert there["verdict"] == "named"
    gone = further(content(1.0), model, seen(flown(seeds=(31, 32, 33), name="clean"), 3))
    assert gone["effects"] == []
    (lost,) = gone["not_certified"]
    assert lost["further"] < -1.0
    assert gone["verdict"] == "nothing_missing"
