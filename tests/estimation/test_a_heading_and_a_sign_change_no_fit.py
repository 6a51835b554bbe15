"""Physics knows no north: a flight that turns many times, rotated about the vertical and with any
sign of its quaternions, gives the same fit, errors ahead and predictions; so does the same flight in
other axes (NED, FRD)."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from greybox.data import Dataset, dataset_from_arrays
from greybox.data.logs import read_logs
from greybox.estimation.fit import Fit, fit
from greybox.excitation import Lemniscate
from greybox.excitation.injection import rich_excitation
from greybox.model.model import build_model
from greybox.plants.flight_log import fly
from greybox.plants.presets import controller_for
from greybox.validation.validate import Validation, validate
from scenarios.studies.recovery import plant
from tests.simulated import vehicle

VECTORS = (("x", "y", "z"), ("vx", "vy", "vz"))
QUATERNION = ("qx", "qy", "qz", "qw")
MAPPING = """
schema = "greybox.mapping/1"
[time]
field = "t"
[command]
fields = ["u1", "u2", "u3", "u4"]
[rate]
fields = ["g1", "g2", "g3"]
frame = "FRD"
[specific_force]
fields = ["a1", "a2", "a3"]
frame = "FRD"
[position]
fields = ["n", "e", "d"]
frame = "NED"
[velocity]
fields = ["vn", "ve", "vd"]
frame = "NED"
[attitude]
fields = ["roll", "pitch", "yaw"]
unit = "deg"
frame = "FRD/NED"
"""


@functools.cache
def flown() -> Mapping[str, np.ndarray]:
    """A flight of 8 s, more than two turns long."""
    path = Lemniscate(radius=1.0, period=4.0, climb=0.3, center=(0.0, 0.0, 1.5), yaw_rate=2.0)
    true = plant()
    log = fly(true, controller_for(true), path, rich_excitation(), 8.0, seed=3, warm_up=1.0)
    return {n: v for n, v in log.items() if not n.startswith("omega")}


def attitude(columns: Mapping[str, np.ndarray]) -> Rotation:
    return Rotation.from_quat(np.stack([columns[n] for n in QUATERNION], axis=1))


def turned(degrees: float, signs: str) -> Dataset:
    """The flight, rotated about the vertical; `signs` of its quaternions "as flown", "random" or
    "positive" (w)."""
    columns, by = dict(flown()), Rotation.from_euler("z", degrees, degrees=True)
    for names in VECTORS:
        moved = by.apply(np.stack([columns[n] for n in names], axis=1))
        columns |= dict(zip(names, moved.T, strict=True))
    q = (by * attitude(columns)).as_quat()
    along = np.cumprod([1.0, *np.sign(np.sum(q[1:] * q[:-1], axis=1))])
    q *= {
        "as flown": along[:, None],
        "positive": np.sign(q[:, 3:]),
        "random": np.random.default_rng(1).choice([-1.0, 1.0], (len(q), 1)),
    }[signs]
    columns |= dict(zip(QUATERNION, q.T, strict=True))
    return dataset_from_arrays(columns.pop("t"), columns, name="turned")


def fitted(data: Dataset) -> tuple[Fit, Validation]:
    model = build_model(vehicle(), data.channels, ["motor_lag"], sample_time=0.01)
    found = fit(model, data)
    return found, validate(found.model, data, adapt=0.0, horizons=(0.1, 0.5))


@functools.cache
def reference() -> tuple[Fit, Validation]:
    return fitted(turned(0.0, "as flown"))


def same(data: Dataset) -> None:
    (found, judged), (known, before) = fitted(data), reference()
    for name, estimate in known.parameters.items():
        # Noise of x and y is one level each, which a rotation mixes.
        assert abs(found[name].value - estimate.value) < 0.02 * estimate.std, name
        assert found[name].std == pytest.approx(estimate.std, rel=0.01), name
    errors, were = (v.verdict for v in (judged, before))
    assert errors is not None and were is not None
    for group, was in zip(errors.groups, were.groups, strict=True):
        assert (group.name, group.seconds) == (was.name, was.seconds)
        assert group.error == pytest.approx(was.error, rel=1e-3), group.name
        assert group.last_value == pytest.approx(was.last_value, rel=1e-6), group.name


def test_the_flight_turns_more_than_twice():
    yaw = np.unwrap(attitude(flown()).as_euler("ZYX")[:, 0])
    assert abs(yaw[-1] - yaw[0]) > 4 * np.pi


@pytest.mark.parametrize(
    ("degrees", "signs"),
    [
        (-137.0, "random"),
        pytest.param(90.0, "positive", marks=pytest.mark.slow),
        pytest.param(180.0, "as flown", marks=pytest.mark.slow),
    ],
)
def test_a_rotated_flight_is_the_same_flight(degrees, signs):
    same(turned(degrees, signs))


def test_a_flight_in_other_axes_is_the_same_flight(tmp_path: Path):
    columns = dict(flown())
    north, body = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]]), np.diag([1, -1, -1])
    there = {n: columns[n] for n in ("t", "u1", "u2", "u3", "u4")}
    for to, names, axes in (
        (("g1", "g2", "g3"), ("p", "q", "r"), body),
        (("a1", "a2", "a3"), ("ax", "ay", "az"), body),
        (("n", "e", "d"), ("x", "y", "z"), north),
        (("vn", "ve", "vd"), ("vx", "vy", "vz"), north),
    ):
        there |= dict(zip(to, axes @ np.stack([columns[n] for n in names]), strict=True))
    seen = Rotation.from_matrix(north @ attitude(columns).as_matrix() @ body)
    angles = seen.as_euler("ZYX", degrees=True)
    there |= dict(zip(("yaw", "pitch", "roll"), angles.T, strict=True))
    table = np.stack(list(there.values()), axis=1)
    np.savetxt(tmp_path / "a.csv", table, "%.15g", ",", header=",".join(there), comments="")
    (tmp_path / "map.toml").write_text(MAPPING)
    same(read_logs(tmp_path / "a.csv", mapping=tmp_path / "map.toml", trim=False))
