"""Faults as they happen to log files, each put into the text of a real flight (NanoBench, 100 Hz,
own column names).

A fault takes the header and the numbers (rows, columns) and gives the bytes of the faulty file.
"""

from __future__ import annotations

import functools
import gzip
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from greybox.examples import flight_path

SET, FLIGHT = "nanobench", "B2_circle_medium_rep1"
GYRO, ACC = "imu_gyro_x imu_gyro_y imu_gyro_z", "imu_acc_x imu_acc_y imu_acc_z"
MOTORS = "motor_motor_m1 motor_motor_m2 motor_motor_m3 motor_motor_m4"
QUATERNION, POSITION, VELOCITY = "qw qx qy qz", "px py pz", "vx vy vz"
Numbers = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Sheet:
    """Header and numbers of a log."""

    names: tuple[str, ...]
    rows: Numbers

    def at(self, names: str) -> list[int]:
        """Columns of these names."""
        return [self.names.index(n) for n in names.split()]

    def but(self, names: str, change: Callable[[Numbers], Numbers]) -> Sheet:
        """With these columns (rows, k) changed."""
        rows, at = self.rows.copy(), self.at(names)
        rows[:, at] = change(rows[:, at])
        return Sheet(self.names, rows)

    def only(self, keep: npt.NDArray[np.bool_] | slice | Numbers) -> Sheet:
        """These rows."""
        return Sheet(self.names, self.rows[keep])

    def csv(self, *, end: str = "\n", mark: str = "") -> bytes:
        """The file's bytes."""
        lines = [
            ",".join(self.names),
            *(",".join("" if v != v else f"{v:.9g}" for v in row) for row in self.rows),
        ]
        return (mark + end.join(lines) + end).encode()


@functools.cache
def flight() -> Sheet:
    """The flight as it came."""
    header, *lines = gzip.decompress(flight_path(SET, FLIGHT).read_bytes()).decode().splitlines()
    return Sheet(
        tuple(header.split(",")),
        np.array([[float(c or "nan") for c in line.split(",")] for line in lines]),
    )


def _random() -> np.random.Generator:
    return np.random.default_rng(7)


def _dropped(s: Sheet) -> bytes:
    return s.only(_random().random(len(s.rows)) > 0.05).csv()


def _lost_second(s: Sheet) -> bytes:
    return s.only(np.r_[0:900, 1000 : len(s.rows)]).csv()


def _twice(s: Sheet) -> bytes:
    return s.only(np.sort(np.r_[0 : len(s.rows), _random().integers(0, len(s.rows), 40)])).csv()


def _jitter(s: Sheet) -> bytes:
    return s.but("t", lambda t: t + _random().uniform(-0.003, 0.003, t.shape)).csv()


def _clock_jump(s: Sheet) -> bytes:
    return s.but("t", lambda t: t + 3600.0 * (np.arange(len(t)) > 1200)[:, None]).csv()


def _back(s: Sheet) -> bytes:
    return s.but("t", lambda t: t - 0.5 * (np.arange(len(t)) > 1200)[:, None]).csv()


def _shuffled(s: Sheet) -> bytes:
    return s.only(_random().permutation(len(s.rows))).csv()


def _milliseconds(s: Sheet) -> bytes:
    return s.but("t", lambda t: 1e3 * t).csv()


def _wrong_rate(s: Sheet) -> bytes:
    return s.but("t", lambda t: t[0] + 2.0 * (t - t[0])).csv()


def _late_imu(s: Sheet) -> bytes:
    return s.but(f"{GYRO} {ACC}", lambda v: np.roll(v, 12, axis=0)).csv()


def _stuck(s: Sheet) -> bytes:
    def hold(v: Numbers) -> Numbers:
        v[800:1400] = v[800]
        return v

    return s.but(GYRO, hold).csv()


def _constant(s: Sheet) -> bytes:
    return s.but("imu_gyro_z", np.zeros_like).csv()


def _spikes(s: Sheet) -> bytes:
    hit = _random().random((len(s.rows), 3)) < 0.005
    return s.but(GYRO, lambda v: np.where(hit, 30.0, v)).csv()


def _nan_burst(s: Sheet) -> bytes:
    def blank(v: Numbers) -> Numbers:
        v[1000:1060] = np.nan
        return v

    return s.but(f"{GYRO} {ACC}", blank).csv()


def _saturated(s: Sheet) -> bytes:
    return s.but(GYRO, lambda v: np.clip(v, -0.5, 0.5)).csv()


def _quantised(s: Sheet) -> bytes:
    return s.but(GYRO, lambda v: 0.02 * np.round(v / 0.02)).csv()


def _swapped_axes(s: Sheet) -> bytes:
    return s.but("imu_gyro_x imu_gyro_y", lambda v: v[:, ::-1]).csv()


def _reversed_axis(s: Sheet) -> bytes:
    return s.but("imu_gyro_y", lambda v: -v).csv()


def _frd(s: Sheet) -> bytes:
    flip = np.array([1.0, -1.0, -1.0])
    return s.but(GYRO, lambda v: v * flip).but(ACC, lambda v: v * flip).csv()


def _ned(s: Sheet) -> bytes:
    turn = lambda v: v[:, [1, 0, 2]] * np.array([1.0, 1.0, -1.0])  # noqa: E731
    return s.but(POSITION, turn).but(VELOCITY, turn).csv()


def _degrees(s: Sheet) -> bytes:
    return s.but(GYRO, np.degrees).csv()


def _metres(s: Sheet) -> bytes:
    return s.but(ACC, lambda v: 9.81 * v).csv()  # the vehicle file says g


def _millimetres(s: Sheet) -> bytes:
    return s.but(POSITION, lambda v: 1e3 * v).csv()


def _swapped_motors(s: Sheet) -> bytes:
    return s.but("motor_motor_m1 motor_motor_m3", lambda v: v[:, ::-1]).csv()


def _scalar_last(s: Sheet) -> bytes:
    return s.but(QUATERNION, lambda v: v[:, [1, 2, 3, 0]]).csv()


def _conjugate(s: Sheet) -> bytes:
    return s.but("qx qy qz", lambda v: -v).csv()


def _cut(s: Sheet) -> bytes:
    whole = s.csv()
    return whole[: int(0.7 * len(whole)) + 5]


def _missing(s: Sheet) -> bytes:
    keep = [i for i, n in enumerate(s.names) if n != "motor_motor_m4"]
    return Sheet(tuple(s.names[i] for i in keep), s.rows[:, keep]).csv()


def _line_ends(s: Sheet) -> bytes:
    lines = s.csv().split(b"\n")
    return b"".join(line + (b"\r\n" if i % 2 else b"\n") for i, line in enumerate(lines) if line)


def _bom(s: Sheet) -> bytes:
    return s.csv(mark="\ufeff")


def _thousands(s: Sheet) -> bytes:
    # 38,687 splits the cell: every row has more cells than the header.
    head, *body = s.csv().decode().splitlines()
    at = s.at("motor_motor_m1")[0]
    out = []
    for line in body:
        cells = line.split(",")
        cells[at] = f"{float(cells[at]):,.0f}"
        out.append(",".join(cells))
    return "\n".join([head, *out, ""]).encode()


def _decimal_comma(s: Sheet) -> bytes:
    return s.csv().replace(b",", b";").replace(b".", b",")


FAULTS: dict[str, tuple[str, Callable[[Sheet], bytes]]] = {
    "dropped rows": ("5 % of the rows, at random", _dropped),
    "lost second": ("100 rows in one piece", _lost_second),
    "repeated rows": ("40 rows twice", _twice),
    "jitter": ("time stamps off by up to 3 ms", _jitter),
    "clock jump": ("an hour forward", _clock_jump),
    "clock set back": ("half a second", _back),
    "shuffled rows": ("in any order", _shuffled),
    "time in ms": ("instead of s", _milliseconds),
    "wrong rate": ("time stamps of half the rate", _wrong_rate),
    "shifted clock": ("IMU 120 ms late", _late_imu),
    "stuck sensor": ("gyro keeps its value for 6 s", _stuck),
    "constant channel": ("r is 0 throughout", _constant),
    "spikes": ("0.5 % of the gyro samples are 30 rad/s", _spikes),
    "NaN burst": ("60 rows without IMU", _nan_burst),
    "saturated sensor": ("gyro clipped at 0.5 rad/s", _saturated),
    "quantised sensor": ("gyro in steps of 0.02 rad/s", _quantised),
    "swapped axes": ("p and q of the gyro", _swapped_axes),
    "reversed axis": ("q of the gyro", _reversed_axis),
    "body axes FRD": ("IMU forward, right, down", _frd),
    "world axes NED": ("position and velocity", _ned),
    "gyro in deg/s": ("instead of rad/s", _degrees),
    "accelerometer in m/s^2": ("where the vehicle file says g", _metres),
    "position in mm": ("instead of m", _millimetres),
    "swapped motors": ("m1 and m3", _swapped_motors),
    "quaternion order": ("x, y, z, w", _scalar_last),
    "quaternion direction": ("world to body", _conjugate),
    "truncated file": ("cut inside a row at 70 %", _cut),
    "missing column": ("motor m4", _missing),
    "mixed line ends": ("LF and CR LF in turns", _line_ends),
    "byte order mark": ("at the start of the file", _bom),
    "thousands comma": ("38,687", _thousands),
    "decimal comma": ("with semicolons between cells", _decimal_comma),
}
"""Name -> (what was done, the function that does it)."""
