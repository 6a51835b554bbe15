"""Hostile vehicle and model files are read or refused in one line, at bounded cost; what was read
can be used.

`GREYBOX_FUZZ=N pytest -m slow tests/hardening` feeds N files of each kind.
"""

from __future__ import annotations

import copy
import json
import os
import random
import time
import tomllib
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from greybox.errors import GreyboxError
from greybox.model.linear import LinearModel
from greybox.model.vehicle import Vehicle, read_vehicle
from greybox.model.vehicle_template import TEMPLATES, template_text
from greybox.residual.files import load_model
from tests.hardening import hostile

MODELS = ("physics", "disturbed", "hybrid", "linear")
MANY = int(os.environ.get("GREYBOX_FUZZ", "5000"))
LONGEST = 20.0
"""Seconds that no file may take, on a machine that does other things too; most take
milliseconds."""


def said(error: GreyboxError) -> str:
    """The message, which is one line of bounded length."""
    line = str(error)
    assert line
    assert len(line.splitlines()) == 1, line
    assert len(line) < 2000, f"{len(line)} characters: {line[:300]}"
    return line


def read_model(path: Path, kind: str) -> bool:
    """Whether the file was read; if so the model has finite numbers, says its name, and is written
    again."""
    try:
        if kind == "linear":
            linear = LinearModel.load(path)
            linear.name.encode()
            assert linear.window[0] < 100_000
            linear.to_dict()
            return True
        model = load_model(path)
    except GreyboxError as error:
        said(error)
        return False
    model.name.encode()
    n = len(model.covariance_names)
    for what in (
        model.parameter_vector(),
        model.process_noise,
        model.sensor_noise,
        model.weak,
        model.reference_state,
        model.reference_inputs,
    ):
        assert np.isfinite(what).all()
    assert model.covariance.shape == (n, n)
    assert set(model.covariance_names) <= set(model.values)
    assert model.reference_state.shape == (len(model.dynamics.states),)
    assert model.reference_inputs.shape == (len(model.dynamics.inputs),)
    for flight in model.per_flight:
        assert np.isfinite(model.flight_vector(flight)).all()
    assert model.sample_time > 0
    assert model.dynamics.window[0] < 100_000
    model.to_dict()
    return True


def read_vehicle_file(path: Path) -> bool:
    """Whether the file was read; if so the vehicle is written and read again as it is."""
    try:
        vehicle = read_vehicle(path)
    except GreyboxError as error:
        said(error)
        return False
    assert Vehicle.from_dict(vehicle.to_dict()) == vehicle
    return True


def feed(kind: str, seeds: range, folder: Path) -> Counter[str]:
    """Reads one hostile file per seed. Returns how many were read and refused."""
    out: Counter[str] = Counter()
    vehicle = kind == "vehicle"
    path = folder / ("v.toml" if vehicle else "model.json")
    trees = {n: tomllib.loads(template_text(n)) for n in TEMPLATES} if vehicle else {}
    for seed in seeds:
        rng = random.Random(f"{kind}{seed}")
        name = rng.choice(TEMPLATES)
        if rng.random() < 0.25:
            good = template_text(name) if vehicle else hostile.model_tree(kind)
            path.write_bytes(hostile.damaged(good.encode(), rng))
        elif vehicle:
            path.write_text(
                hostile.to_toml(hostile.changed(copy.deepcopy(trees[name]), rng)), encoding="utf-8"
            )
        else:
            tree = hostile.changed(hostile.good_model(kind), rng)
            path.write_text(json.dumps(hostile.sealed(tree)))
        began = time.perf_counter()
        try:
            read = read_vehicle_file(path) if vehicle else read_model(path, kind)
        except BaseException as error:
            error.add_note(f"kind {kind}, seed {seed}, {path}")
            raise
        assert time.perf_counter() - began < LONGEST, (kind, seed)
        out["read" if read else "refused"] += 1
    assert sorted(p.name for p in folder.iterdir()) == [path.name], "a file wrote something"
    return out


@pytest.mark.parametrize("kind", ["vehicle", *MODELS])
def test_hundreds_of_hostile_files(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    count = feed(kind, range(150), tmp_path)
    assert count["read"] > 10
    assert count["refused"] > 50


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["vehicle", *MODELS])
def test_thousands_of_hostile_files(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    print(kind, dict(feed(kind, range(1000, 1000 + MANY), tmp_path)))
