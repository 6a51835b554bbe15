"""Betaflight (and Cleanflight) blackbox files by orangebox.

The flight controller's axes are forward, left, up, with the yaw rate counter-clockwise. Fields:
time [us], gyroADC and gyroUnfilt [deg/s] (header gyro_scale: rad/us or deg/s per count in old logs;
with blackbox_high_resolution tenths of it), accSmooth [1 g = header acc_1G], imuQuaternion [1/32767:
x, y, z; w >= 0] (since 2025.12), motor[i] (DShot value or us), eRPM[i] [100 electrical rpm;
header motor_poles], vbatLatest [0.01 V since Betaflight 4.0]. Motors are numbered as on the flight
controller: 1 rear right, 2 front right, 3 rear left, 4 front left on a quad X.

All of this is what betaflight/betaflight says in src/main/blackbox/blackbox.c (4.6.0, loadMainState
and blackboxWriteSysinfo), and what its simulator build logged of flights of known truth.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Protocol

import numpy as np

from greybox.data.raw import FloatArray
from greybox.data.readers.recording import (
    LogFormat,
    Recording,
    Source,
    Stream,
    checked_file,
    damaged,
    library,
)
from greybox.errors import DataError

_MAGIC = b"H Product:Blackbox"
MOST_FLIGHTS = 64
"""Flights in one file that are looked at."""

LONGEST = 200_000_000
"""Files of more bytes than this are refused: a flash chip or a card holds no such log of one
craft."""


Headers = Mapping[str, int | float | str | list[int]]
"""The lines before the frames, as orangebox reads them."""
Row = Sequence[int | float | str]
"""The values of a frame; what is no number belongs to slow frames."""


class _Kind(Protocol):
    """Kind of a frame: I, P, ..."""

    value: str


class _Frame(Protocol):
    """A frame of orangebox."""

    type: _Kind
    data: Row


class _Parser(Protocol):
    """What is used of the parser of orangebox."""

    field_names: Sequence[str]
    headers: Headers

    def frames(self) -> Iterator[_Frame]:
        """All frames in order."""
        ...


def read_betaflight(path: Path) -> Recording:
    """Read a blackbox file; of several flights in it the longest. Raises `DataError`."""
    where = str(path)
    digest = checked_file(path)
    if path.stat().st_size > LONGEST:
        raise DataError(
            "a file of more than 200 MB",
            where=where,
            fix="cut it into its flights (bbsplit of orangebox)",
        )
    library("orangebox", where=where, what="a blackbox file")
    logging.getLogger("orangebox").addHandler(logging.NullHandler())
    box = library("orangebox.parser", where=where, what="a blackbox file")
    with damaged(where, "a blackbox file"):
        count = box.Reader(where, allow_invalid_header=True).log_count
        frames, parser, index = _longest(box, where, count)
        names = list(parser.field_names)
        table = _numbers(frames.rows, len(names))
        headers = parser.headers
    fields = {n: _integers(table[:, j]) for j, n in enumerate(names) if j < table.shape[1]}
    if "time" not in fields:
        raise DataError(
            "no field 'time'", where=where, got=", ".join(names[:8]), fix="copy the log again"
        )
    stream = Stream(
        name="main",
        t=_unwrapped(fields["time"]) * 1e-6,
        fields=fields,
        kind="I and P frames",
        clock="microseconds",
    )
    notes = [f"flight {index} of the {count} in the file (the longest)"] if count > 1 else []
    if frames.before:
        notes.append(
            f"{frames.before} frame(s) before the first whole one are left out: they are "
            "differences to nothing"
        )
    if frames.doubtful:
        notes.append(
            f"{frames.doubtful} frame(s) are left out: others before them are lost (the card or "
            "chip was too slow), or logging was paused"
        )
    if not frames.whole:
        notes.append(
            "the log ends in the middle of a frame, or is damaged from there on; it is read up to "
            "it"
        )
    sources, said = _sources(fields, headers)
    return Recording(
        format="betaflight",
        source=path.name,
        sha256=digest,
        streams={"main": stream},
        sources=tuple(sources),
        info=_info(headers),
        excitation=_chirp(fields, headers),
        notes=(*notes, *said),
    )


def _longest(box: ModuleType, where: str, count: int) -> tuple[_Frames, _Parser, int]:
    """The longest of `count` flights with its parser and number. Raises `DataError`."""
    best: tuple[_Frames, _Parser, int] | None = None
    for index in range(1, min(count, MOST_FLIGHTS) + 1):
        try:
            parser = box.Parser.load(where, index, allow_invalid_header=True)
        except (RuntimeError, ValueError, TypeError, IndexError, KeyError, AttributeError):
            if count == 1:
                raise
            continue  # a damaged flight beside good ones
        frames = _frames(parser)
        if best is None or len(frames.rows) > len(best[0].rows):
            best = (frames, parser, index)
    if best is None or len(best[0].rows) < 2:
        raise DataError(
            "no frames in it", where=where, fix="copy the log again; log from arming to disarming"
        )
    return best


PULSE = (1000.0, 2000.0)
"""Pulses of no and of full throttle [us]."""
DSHOT = (48.0, 2047.0)
"""DShot values of no and of full throttle: those below are commands to the ESC."""
WRAP = 2.0**32
"""Where numbers of 32 bits begin anew."""
FEATURE_3D = 1 << 12
"""Bit of the header `features`."""
HIGH_RESOLUTION = 10.0
"""Times finer gyro, stick and rate setpoint fields with blackbox_high_resolution = ON (since
Betaflight 4.3)."""
QUATERNION = 32767.0
"""Counts of imuQuaternion that are 1."""
PHASE = 5000.0
"""Counts of debug[0] per radian of the chirp's phase."""


@dataclass(frozen=True, kw_only=True)
class _Frames:
    """The values of all I and P frames from the first I frame up to the first frame that the parser
    cannot get over; `before` counts P frames before it, which are differences to nothing; `doubtful`
    those that are left out, as others before them are lost; `whole` tells whether the parser came
    through."""

    rows: list[Row]
    before: int
    doubtful: int
    whole: bool


def _frames(parser: _Parser) -> _Frames:
    rows: list[Row] = []
    begins: list[int] = []
    before, whole = 0, True
    try:
        for frame in parser.frames():
            if frame.type.value == "I":
                begins.append(len(rows))
            if frame.type.value == "I" or (frame.type.value == "P" and rows):
                rows.append(frame.data)
            elif frame.type.value == "P":
                before += 1
    except (RuntimeError, ValueError, TypeError, IndexError, KeyError, AttributeError, OSError):
        whole = False
    kept = _undoubted(rows, begins, _between(parser.headers))
    return _Frames(rows=kept, before=before, doubtful=len(rows) - len(kept), whole=whole)


def _between(headers: Headers) -> int | None:
    """Frames from one I frame up to the next; None where the headers do not tell. Old firmware
    writes P interval as the share of iterations that are logged, as 1/2."""
    every = int(_number(headers.get("I interval")) or 0)
    share = re.fullmatch(r"(?:(\d+)/)?([1-9]\d*)", str(headers.get("P interval")))
    if share is None:
        return None
    number, rest = divmod(every * int(share[1] or 1), int(share[2]))
    return None if rest else number


def _undoubted(rows: list[Row], begins: list[int], whole: int | None) -> list[Row]:
    """The frames without the P frames between two I frames, which begin at `begins`, of which some
    are lost: there are not `whole` of them.

    A P frame is a difference to those before it, so that behind a lost one all are wrong up to the
    next I frame. Where bytes are lost the parser cannot always tell, but the firmware writes the
    same number between any two I frames. Lost ones make it smaller: where no header tells it, it is
    the largest that comes twice.
    """
    sizes = np.diff([*begins, len(rows)])
    if sizes.size < 3:
        return rows
    values, times = np.unique(sizes[:-1], return_counts=True)
    if whole not in values:
        whole = int(max(values[times > 1], default=values[-1]))
    kept: list[Row] = []
    for at, size in zip(begins[:-1], sizes[:-1].tolist(), strict=True):
        kept += rows[at : at + (size if size == whole else 1)]
    return kept + rows[begins[-1] :]


def _numbers(rows: list[Row], width: int) -> FloatArray:
    """Frames as a matrix (N, K) of the main fields (slow and GPS fields may follow in a row; a
    short row ends in NaN)."""
    width = min(width, max(len(r) for r in rows))
    table = np.full((len(rows), width), np.nan)
    for i, row in enumerate(rows):
        for j, value in enumerate(row[:width]):
            if isinstance(value, (int, float)):
                table[i, j] = value
    return table


def _integers(values: FloatArray) -> FloatArray:
    """Values (N,) as the 32 bits that the firmware keeps of them: a motor below its least output,
    as a stopped one is, comes as that much less than 2^32."""
    return np.where(np.abs(values) < WRAP / 2, values, (values + WRAP / 2) % WRAP - WRAP / 2)


def _unwrapped(time: FloatArray) -> FloatArray:
    """Microseconds (N,) that go on where the firmware's counter of 32 bits begins anew, 71.6 min
    after boot."""
    counted = time % WRAP
    return counted + WRAP * np.cumsum(np.diff(counted, prepend=counted[:1]) < -0.5 * WRAP)


def _info(headers: Headers) -> dict[str, str]:
    shown = {
        "Firmware revision": "firmware",
        "Craft name": "craft",
        "Board information": "board",
        "looptime": "looptime",
    }
    shown |= {
        "debug_mode": "debug_mode",
        "P interval": "P interval",
        "blackbox_sample_rate": "blackbox_sample_rate",
    }
    # The chirp that Betaflight (2025.12 on) can add to the rate setpoints: amplitudes, frequencies,
    # time.
    shown |= {key: key for key in headers if str(key).startswith("chirp_")}
    return {
        label: str(headers[key])
        for key, label in shown.items()
        if headers.get(key) not in (None, "")
    }


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else None


def _sources(fields: Mapping[str, FloatArray], headers: Headers) -> tuple[list[Source], list[str]]:
    return list(_found(fields, headers)), list(_warned(fields, headers))


def _found(fields: Mapping[str, FloatArray], headers: Headers) -> Iterator[Source]:
    motors = tuple(f"motor[{i}]" for i in range(8) if f"motor[{i}]" in fields)
    limits = _limits(headers)
    if motors and limits:
        yield Source(
            group="command",
            stream="main",
            fields=motors,
            limits=limits,
            convert=lambda outputs: np.asarray(np.maximum(outputs, limits[0])),  # stopped
            note=_idle(headers),
        )
    for prefix, note in (("gyroADC", "low-pass filtered by the firmware"), ("gyroUnfilt", "")):
        names = tuple(f"{prefix}[{i}]" for i in range(3))
        yield Source(
            group="rate",
            stream="main",
            fields=names,
            unit="deg/s",
            frame="FLU",
            scale=_gyro_scale(headers),
            note=note,
        )
    quaternion = tuple(f"imuQuaternion[{i}]" for i in range(3))
    if fields.keys() >= set(quaternion):
        yield Source(
            group="attitude",
            stream="main",
            fields=("", *quaternion),
            convert=_with_w,
            note="estimate",
        )
    one_g = _number(headers.get("acc_1G"))
    if one_g:
        names = tuple(f"accSmooth[{i}]" for i in range(3))
        yield Source(
            group="specific_force",
            stream="main",
            fields=names,
            unit="g",
            frame="FLU",
            scale=1.0 / one_g,
            note="low-pass filtered by the firmware",
        )
    if _major(headers) >= 4:
        yield Source(group="battery", stream="main", fields=("vbatLatest",), unit="V", scale=0.01)
    speeds = tuple(f"eRPM[{i}]" for i in range(8) if f"eRPM[{i}]" in fields)
    poles = _number(headers.get("motor_poles"))
    if speeds and poles:
        yield Source(
            group="rotor_speed",
            stream="main",
            fields=speeds,
            unit="rpm",
            scale=200.0 / poles,
            note=f"{poles:g} poles",
        )


def _warned(fields: Mapping[str, FloatArray], headers: Headers) -> Iterator[str]:
    if "motor[0]" in fields and not _limits(headers):
        why = (
            "rotors may turn backwards (feature 3D)"
            if _reversible(headers)
            else "the range of the motor outputs is not in the header"
        )
        yield f"{why}; give [command] limits in a mapping file"
    if "debug[0]" in fields and any(str(key).startswith("chirp_") for key in headers):
        yield (
            "where debug_mode is CHIRP, debug[0] is 5000 times the phase of the chirp [rad], 0 "
            "while there is none; "
            "it goes into the rate setpoint, so that commands hold it closed-loop"
        )
    if "vbatLatest" in fields and _major(headers) < 4:
        yield (
            "vbatLatest has no fixed unit before Betaflight 4.0; give [battery] scale in a "
            "mapping file"
        )
    if "eRPM[0]" in fields and not _number(headers.get("motor_poles")):
        yield "motor_poles is not in the header; give [rotor_speed] scale in a mapping file"


def _chirp(fields: Mapping[str, FloatArray], headers: Headers) -> FloatArray | None:
    """Cosine of the chirp's phase (N,), as src/main/common/chirp.c adds it, 0 while there is none;
    None where debug[0] is not the phase (the number of debug_mode differs between versions, so that
    its values tell: a phase below a turn that only goes on)."""
    if "debug[0]" not in fields or not any(str(key).startswith("chirp_") for key in headers):
        return None
    phase = fields["debug[0]"] / PHASE
    on = phase > 0
    ahead = (np.diff(phase) % (2 * np.pi))[on[1:] & on[:-1]]
    if (
        not ahead.size
        or phase.min() < 0
        or phase.max() > 2 * np.pi + 0.01
        or np.mean(ahead < np.pi) < 0.95
    ):
        return None
    return np.where(on, np.cos(phase), 0.0)


def _limits(headers: Headers) -> tuple[float, float] | None:
    """What no and full throttle are to an ESC, None where the header does not tell.

    The lower end of motorOutput is the idle, at which rotors turn already, and the upper one falls
    with motor_output_limit: of data sheets and in mixing, speed grows from no throttle. DShot has
    fixed ends (src/main/drivers/dshot.h), pulses go from 1000 us to maxthrottle.
    """
    ends = _outputs(headers)
    if ends is None or _reversible(headers):
        return None
    if ends[0] < PULSE[0]:
        return DSHOT
    return PULSE[0], max(_number(headers.get("maxthrottle")) or PULSE[1], ends[1])


def _outputs(headers: Headers) -> tuple[float, float] | None:
    """Motor output at idle and the largest: motorOutput, else minthrottle and maxthrottle."""
    both = headers.get("motorOutput")
    pair = (
        both
        if isinstance(both, list) and len(both) == 2
        else [headers.get("minthrottle"), headers.get("maxthrottle")]
    )
    low, high = _number(pair[0]), _number(pair[1])
    return (low, high) if low is not None and high is not None and high > low else None


def _idle(headers: Headers) -> str:
    """The command at which armed rotors idle, in words."""
    ends, limits = _outputs(headers), _limits(headers)
    if ends is None or limits is None:
        return ""
    return f"idle {(ends[0] - limits[0]) / (limits[1] - limits[0]):.3f}"


def _reversible(headers: Headers) -> bool:
    """Whether rotors may turn backwards (feature 3D), from the middle of the range down."""
    return bool(int(_number(headers.get("features")) or 0) & FEATURE_3D)


def _with_w(logged: FloatArray) -> FloatArray:
    """Quaternions (N, 4) of which x, y, z are logged (columns 1 to 3) [1/32767], and w is not
    negative."""
    vector = logged[:, 1:] / QUATERNION
    w = np.sqrt(np.maximum(1.0 - np.sum(vector**2, axis=1), 0.0))
    return np.column_stack([w, vector])


def _gyro_scale(headers: Headers) -> float:
    """Degrees per second per count of the gyro's fields."""
    fine = _number(headers.get("blackbox_high_resolution"))
    return _gyro_unit(headers) / (HIGH_RESOLUTION if fine else 1.0)


def _gyro_unit(headers: Headers) -> float:
    """Degrees per second per count of the gyro. The header holds a float's bits: 1.0 (already
    deg/s), or rad/us (Cleanflight)."""
    raw = headers.get("gyro_scale", headers.get("gyro.scale"))
    if isinstance(raw, list):
        return 1.0
    try:
        bits = int(raw, 16) if isinstance(raw, str) else int(raw) if raw is not None else 0
        value = float(np.array([bits], dtype=np.uint32).view(np.float32)[0])
    except (ValueError, OverflowError, TypeError):
        return 1.0
    if not np.isfinite(value) or value <= 0.0 or value >= 0.5:
        return 1.0
    return float(np.rad2deg(value * 1e6)) if value < 1e-5 else value


def _major(headers: Headers) -> int:
    """Major version of Betaflight; 0 for other firmware. Versions named by year (2025.12) count as
    newer than 4."""
    match = re.match(r"Betaflight.*?(\d+)\.\d+", str(headers.get("Firmware revision", "")))
    return int(match[1]) if match else 0


FORMAT = LogFormat(
    name="betaflight",
    title="Betaflight blackbox",
    endings=(".bfl", ".bbl"),
    recognise=lambda path, head: head.startswith(_MAGIC),
    recording=read_betaflight,
    libraries=("orangebox",),
    advice={
        "": "set blackbox_sample_rate = 1/2 or 1/4 (1 kHz or more); blackbox_device = SDCARD or "
        "SPIFLASH",
        "command": "set blackbox_disable_motors = OFF; motor[i] is after the mixer (leave "
        "vbat_sag_compensation as flown)",
        "rotor_speed": "set dshot_bidir = ON and blackbox_disable_rpm = OFF, with the right "
        "motor_poles",
        "battery": "set blackbox_disable_bat = OFF with a voltage sensor (battery_meter = ADC or "
        "ESC)",
        "attitude": "set blackbox_disable_attitude = OFF and acc_hardware = AUTO (Betaflight "
        "2025.12 and later); before that, log motion capture or an estimator beside it",
        "rate": "set blackbox_disable_gyro = OFF; gyroUnfilt needs Betaflight 4.5, before that "
        "debug_mode = GYRO_SCALED",
        "specific_force": "set acc_hardware = AUTO and blackbox_disable_acc = OFF",
        "position": "GPS alone is too coarse; log motion capture beside it",
        "velocity": "GPS alone is too coarse; log motion capture beside it",
        "setpoint": "rate setpoints only: a position setpoint does not exist in Betaflight",
    },
)
