"""What columns with names of their own look like: a draft of a mapping file, from names and sizes
of the numbers.

A guess is never used by itself: it is shown, written where a user asks for it, and looked over.
Axes, the order of the rotors and a rate in deg/s that never exceeds a calm 25 are what such a look
must settle; `greybox check` tries the rest.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from greybox.data.direction import axis_of_thrust
from greybox.data.raw import FloatArray
from greybox.data.readers.mapping import SCHEMA, TIME_UNITS, mapping_text
from greybox.data.readers.recording import FRAMES
from greybox.files import Json
from greybox.frames import GRAVITY

_AXES = ({"x": 0, "y": 1, "z": 2}, {str(i): i for i in range(4)})
"""By letters, and by numbers: of these a fourth is none, w0 to w3 are four rotors and no rates."""
_RATES_OF_PLACE = {f"{axis}{link}dot": i for i, axis in enumerate("xyz") for link in ("", "_")}
_WORDS = {
    "specific_force": r"acc\w*|a|specificforce|linearacceleration",
    "rate": r"gyr\w*|angvel|angularvelocity|velocityangular|twistangular|bodyrates?|rates?|omega|w",
    "velocity": r"v|vel|velocity|linvel|linearvelocity|velocitylinear|twistlinear",
    "position": r"p|pos|position",
    "setpoint": r"sp|setpoint|target|ctrltarget|ref|reference|des|desired",
}
_CRAFT = r"drone|uav|quad\w*|pose|state\w*|odom\w*|mocap|vicon|optitrack"
"""Words of the craft and of who sees it, whose x, y, z are its position."""
_TURNED_FASTER = r"ang\w*acc\w*"
_FRAME = r"[rs]|rs|b|w|i|body|world|inertial|local|global|map|imu|enu|ned|flu|frd"
"""Words and letters of axes behind the word of what stands in them: w_RS_S, vel_body."""
_IN_FRAME = re.compile(rf"(.+)[\W_]+({_FRAME})")
_ALONG = {"FLU": "b|body|flu", "FRD": "frd", "ENU": "w|world|inertial|global|enu", "NED": "ned"}
_NO_NAME = frozenset({"xyz", "signals", "values", "data"})
"""Words of containers, which say nothing of what is in them."""
_NUMBERED = {
    "rotor_speed": r"e?rpm|omega|w|rotorspeed|motorspeed|escspeed|angularvelocities",
    "command": r"m|u|mots?|motors?|rotors?|thrusts?|pwm|cmd|command|controls?|ctrl|esc|act|actuators?|outputs?"
    r"|outchannels|f|forces?|thr|throttles?",
}
_ODOMETRY = re.compile(r"twist\W+twist\W+linear\W")
"""The velocity of ROS's nav_msgs/Odometry, which is along the axes of the body."""
_ROTOR = r"rotors?"
"""A word of commands that may mean a speed, too."""
_PULSE = r"u|pwm|cmd|command|controls?|ctrl|outputs?"
"""Words of what goes to a rotor, which no speed is that comes back."""
_STICKS = r"channels?|rc\w*|sticks?|joy\w*"
"""Words of a pilot's sticks, which turn nothing by themselves."""
_OPEN = r"controls?|ctrl|w|f|forces?|thrusts?"
"""Words of rotors that may mean a torque, a side force or a weight, too, which no rotor's is: it has
no sign."""
_AFTER = rf"pwm|cmd|command|output|e?rpm|speed|{_WORDS['setpoint']}"
"""Words that may stand behind the number of a motor or an axis: motor1_pwm, x_ref."""
_ASKED = rf"cmd|command|actions?|{_WORDS['setpoint']}"
"""Words of what somebody asked for, so that nothing was measured, and a speed of the rotors is a
command."""
_SPEED = re.compile(r"rpm|omega|speed|(?<![a-z])w(?![a-z])")
_SPEED_ASKED = re.compile(rf"{_SPEED.pattern}|des|ref|target|setpoint")
"""The same of commands: what a rotor is to reach is a speed."""
_TURNS = (
    {"w": 0, "x": 1, "y": 2, "z": 3},
    {"roll": 0, "pitch": 1, "yaw": 2},
    {"phi": 0, "theta": 1, "psi": 2},
)
"""How names of an attitude end."""
_QUATERNION = r"q|quat\w*|att\w*|orientation"
_OF_TIME = frozenset({"d", "dot"})
"""Stems of derivatives: those of angles are no body rates."""
_OTHERS = r"att\w*|angles?|rpy|euler|q|quat\w*|thrusts?|forces?|torques?|moments?"
"""Words of what else is set: attitude, force and moment."""
_UNITS = {
    "rate": {"deg/s": "deg/s", "\N{DEGREE SIGN}/s": "deg/s", "dps": "deg/s", "rad/s": "rad/s"},
    "specific_force": {
        "m/s^2": "m/s^2",
        "m/s2": "m/s^2",
        "m/s\N{SUPERSCRIPT TWO}": "m/s^2",
        "g": "g",
        "mg": "mg",
    },
    "rotor_speed": {"rpm": "rpm", "rad/s": "rad/s", "hz": "Hz"},
    "battery": {"v": "V", "mv": "mV"},
    "attitude": {"deg": "deg", "\N{DEGREE SIGN}": "deg", "rad": "rad"},
    "position": {"m": "m", "mm": "mm"},
    "setpoint": {"m": "m", "mm": "mm"},
    "velocity": {"m/s": "m/s", "mm/s": "mm/s"},
    "command": {"us": "", "\N{MICRO SIGN}s": "", "%": "", "1": ""},
    "temperature": {"c": "", "\N{DEGREE SIGN}c": "", "degc": "", "k": ""},
    "current": {"a": "", "ma": "", "mah": ""},
}
"""Units as names of columns say them, "Gyro X (deg/s)", per group; a column with the unit of
another group is none."""
_UNIT = re.compile(r"(?<=\S)\s*[(\[]\s*([^\d\s)\]'][^)\]]*?|)\s*[)\]]\s*$")
_WRITTEN = {
    form: unit
    for units in _UNITS.values()
    for unit in units
    if unit[0].isascii() and unit[0].isalpha()
    for plain in (unit.replace("^", ""),)
    for form in (plain.replace("/", "_"), plain.replace("/", "p"))
}
"""How names without signs write a unit behind "_": gyro_x_dps, gyro_x_rad_s, acc_x_m_s2, accz_mps2.
"""
_UNIT_WRITTEN = re.compile(
    rf"(.*(?:(?:^|[\W_])[xyz]|(?:acc|gyro?)[xyz]|\d|roll|pitch|yaw|bat\w*?|volt\w*?))"
    rf"_({'|'.join(sorted(_WRITTEN, key=len, reverse=True))})",
    re.IGNORECASE,
)
"""Behind an axis or a number or the battery alone: elsewhere a letter is no unit."""
_ABOUT = r"temp\w*|bias\w*|offsets?|var|variance|std|cov\w*|err\w*|noise|scale|dt|clip\w*|vib\w*"
"""Words of what is said about a sensor and is not its reading."""
POLE_PAIRS = 7
"""Of the motors whose electrical speed is logged: 14 poles are by far the most usual."""
_LESS = re.compile(r"est|state|target|setpoint|filt|raw|debug|ref")
_TIME_WORDS = {
    "us": r"us|usecs?|micros\w*",
    "ms": r"ms|msecs?|millis\w*",
    "ns": r"ns|nsecs?|nanos\w*",
    "s": r"s|secs?|seconds?",
}
"""How the name of a clock says its unit."""
_TIME = re.compile(
    r"(?:.*[\W_])?t|t_\w+|.*(?:time|stamp|clock|elapsed|epoch).*"
    rf"|(?:t_?)?(?:ticks?|{'|'.join(_TIME_WORDS.values())})"
)
"""Names of clocks; only what grows as a clock is asked."""


@dataclass(frozen=True, kw_only=True)
class Guess:
    """A group, the columns that look like it in the order of its channels, its unit ("": SI), its
    frame ("": ours), and why."""

    group: str
    fields: tuple[str, ...]
    unit: str = ""
    frame: str = ""
    limits: tuple[float, float] | None = None
    scale: float = 1.0
    gravity: bool = True
    stream: str = ""
    why: str = ""


def guess_columns(
    columns: Mapping[str, FloatArray], without: Iterable[str] = ()
) -> tuple[Guess, ...]:
    """Groups that columns (name -> (N,) numbers) look like, one guess a group; groups of `without`
    are left out."""
    found: dict[str, list[tuple[str, ...]]] = {}

    def take(group: str, names: Sequence[str]) -> None:
        if _may_be(group, names[0]):
            found.setdefault(group, []).append(tuple(names))

    speeds = _along_the_body(columns)
    attitudes = list(_attitudes({n: v for n, v in columns.items() if n not in speeds}))
    turned = {n for _, names in attitudes for n in names}
    triads = [(e, *family) for e in _AXES for family in _families(columns, e)]
    stems = {stem for _, stem, _ in triads}
    for ends, stem, members in triads:
        if set(members) == {0, 1, 2}:
            lone = not stem and _bare(members[0]).lower() == "x" and members[0] not in turned
            seen = ends is _AXES[0] and re.fullmatch(_CRAFT, re.split(r"[\W_]+", stem)[-1])
            gyro = re.fullmatch(r"g|.*[\W_]g", stem) and f"{stem[:-1]}a" in stems
            group = "position" if lone or seen else "rate" if gyro else _meant(stem)
            if group:
                take(group, [members[i] for i in range(3)])
    for group, numbered in _by_number(columns):
        take(group, numbered)
    for group, turns in attitudes:
        take(group, turns)
    if speeds:
        take("velocity", speeds)
    for stem, members in _families(columns, _RATES_OF_PLACE):
        if len(members) == 3 and (not stem or _says(stem, _WORDS["position"])):
            take("velocity", [members[i] for i in range(3)])
    for stem, members in _families(columns, {"north": 0, "east": 1, "down": 2}):
        if len(members) == 3 and not _wanted(stem):
            take(
                "velocity" if _says(stem, _WORDS["velocity"]) else "position",
                [members[i] for i in range(3)],
            )
    for stem, members in _families(columns, {"n": 0, "e": 1, "d": 2}):
        group = next((g for g in ("velocity", "position") if _says(stem, _WORDS[g])), "")
        group = group if stem else "position"
        if group and len(members) == 3 and not _wanted(stem):
            take(group, [members[i] for i in range(3)])
    for name in filter(_battery, columns):
        take("battery", [name])
    left_out = set(without)
    return _framed(
        _sized(
            group,
            min(found[group], key=lambda names: _rank(group, names, columns)),
            columns,
        )
        for group in (*_NUMBERED, "battery", "attitude", *_WORDS)
        if group in found and group not in left_out
    )


def _rank(
    group: str, names: Sequence[str], columns: Mapping[str, FloatArray]
) -> tuple[int, bool, int]:
    """What of a group is taken first: a quaternion, a matrix, angles, whose order and signs no name
    tells; a force with gravity; then what is measured; then what says least more, as a bias does.
    """
    last = 0
    if group == "attitude":
        last = {4: 0, 9: 1}.get(len(names), 2)
    elif group == "specific_force":
        last = int(not axis_of_thrust(np.column_stack([columns[n] for n in names])))
    return last, bool(_LESS.search(names[0].lower())), len(re.split(r"[\W_]+", names[0]))


def guess_streams(
    streams: Mapping[str, Mapping[str, FloatArray]], without: Iterable[str] = ()
) -> tuple[Guess, ...]:
    """As `guess_columns`, of several tables by name, whose names say what is in them as well; a
    guess has columns of one table."""
    # The number of an instance stands behind the name, and says nothing.
    origin: dict[str, tuple[str, str]] = {}
    for name, fields in streams.items():
        for field in fields:
            origin.setdefault(f"{re.sub(r'_[0-9]+$', '', name)}/{field}", (name, field))
    found = guess_columns({k: streams[n][f] for k, (n, f) in origin.items()}, without)
    return tuple(
        replace(
            g,
            stream=origin[g.fields[0]][0],
            fields=tuple(origin[f][1] for f in g.fields),
            why=f"in {origin[g.fields[0]][0]}; {g.why}",
        )
        for g in found
    )


def _by_number(columns: Mapping[str, FloatArray]) -> Iterator[tuple[str, list[str]]]:
    """(group, names) of columns that are numbered from 0 or 1 on, one a rotor."""
    families = _families(columns, {str(i): i for i in range(13)})
    stems = {stem for stem, _ in families}
    shares = {s for s, m in families if _known(m.values(), columns).max(initial=0.0) <= 100.0}
    asked_of = {
        base: stem
        for stem in stems
        if (base := _asked_of(stem)) in stems - shares and not _says(base, _PULSE)
    }
    for stem, every in families:
        there = {i: n for i, n in every.items() if np.isfinite(columns[n]).any()}
        members = there or every
        first, count = min(members), len(members)
        if first not in (0, 1) or not 3 <= count <= 8 or max(members) != first + count - 1:
            continue
        if count < 4 and _says(stem, _WORDS["rate"]):
            continue
        group = _said(stem, _NUMBERED)
        if stem in asked_of or stem in asked_of.values():
            # what is asked for and measured, rotor by rotor
            group = "rotor_speed" if stem in asked_of else "command"
            if _known(members.values(), columns).min(initial=0.0) >= 0.0:
                yield group, [members[i] for i in sorted(members)]
            continue
        if group and _unit_of(members[first]) in _UNITS["rotor_speed"]:
            group = "rotor_speed"
        if group == "command" and not _commanded(stem, members.values(), columns):
            continue
        if _says(stem, _OPEN) and not _known(members.values(), columns).min(initial=0.0) >= 0.0:
            continue
        if _among(stem, _ASKED) and (group == "rotor_speed" or (not group and _SPEED.search(stem))):
            group = "command"
        if group:
            yield group, [members[i] for i in sorted(members)]


def _asked_of(stem: str) -> str:
    """The stem of what a stem asks for: mot of motdes or mot_des; "" where it asks for nothing."""
    match = re.fullmatch(rf"(.+?)[\W_]*(?:{_ASKED})", stem)
    return match[1] if match else ""


def _along_the_body(columns: Iterable[str]) -> list[str]:
    """The names u, v, w of velocities along the axes of the body; none where not all are there."""
    found = (m for stem, m in _families(columns, {"u": 0, "v": 1, "w": 2}) if not stem)
    return next(([m[i] for i in range(3)] for m in found if len(m) == 3), [])


def _attitudes(columns: Mapping[str, FloatArray]) -> Iterator[tuple[str, list[str]]]:
    """(group, names) of a quaternion with its scalar first, of a rotation matrix row by row, of
    angles, or of the turning of angles' names."""
    quaternion, *angles = _TURNS
    yield from _turns(columns, quaternion)
    for stem, members in _families(columns, {str(i): i for i in range(4)}):
        if len(members) == 4 and not _wanted(stem) and _says(stem, _QUATERNION):
            yield "attitude", _scalar_first([members[i] for i in range(4)], columns)
    for first in (0, 1):
        places = {f"{first + i}{first + j}": 3 * i + j for i in range(3) for j in range(3)}
        for ends in (places, {str(first + i): i for i in range(9)}):
            for stem, members in _families(columns, ends):
                names = [members[i] for i in sorted(members)]
                if len(names) == 9 and not _wanted(stem) and _turning(names, columns):
                    yield "attitude", names
    for ends in angles:
        yield from _turns(columns, ends)


def _turning(names: Sequence[str], columns: Mapping[str, FloatArray]) -> bool:
    """Whether nine columns are a rotation matrix that changes."""
    matrices = np.column_stack([columns[n] for n in names]).reshape(-1, 3, 3)
    matrices = matrices[np.isfinite(matrices).all(axis=(1, 2))]
    if not matrices.size or not np.ptp(matrices, axis=0).any():
        return False
    off = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    return float(np.median(off)) < 0.01


def _turns(
    columns: Mapping[str, FloatArray], ends: Mapping[str, int]
) -> Iterator[tuple[str, list[str]]]:
    """The same of names that end like this."""
    for stem, members in _families(columns, ends):
        if len(members) != len(ends) or _among(stem, rf"{_ASKED}|{_STICKS}") or stem in _OF_TIME:
            continue
        turning = len(ends) == 3 and _says(stem, _WORDS["rate"])
        yield "rate" if turning else "attitude", [members[i] for i in range(len(ends))]


def _scalar_first(names: list[str], columns: Mapping[str, FloatArray]) -> list[str]:
    """The names of a numbered quaternion, its scalar first: a craft that flies is nearly level, so
    that the two small ones are those about x and y."""
    size = [float(np.nansum(columns[n] ** 2)) for n in names]
    return names if size[2] <= size[0] else [names[3], *names[:3]]


def _battery(name: str) -> bool:
    low = name.lower()
    volts = re.search(r"v_?bat|volt", low) or ("bat" in low and _unit_of(name) in _UNITS["battery"])
    return bool(volts) and not re.search(r"temp|curr|perc|pct|(?<![a-z])soc(?![a-z])", low)


def _framed(guesses: Iterable[Guess]) -> tuple[Guess, ...]:
    """The same with frames: where the accelerometer's z says gravity downwards, x forward and y to
    the right go with it, in all that one IMU says; "down" is a name. Velocities u, v, w, which are
    those along the axes of the body, follow both."""
    found = tuple(guesses)
    turned = any(g.group == "specific_force" and g.frame for g in found)
    frames = {"rate": "FRD", "attitude": "FRD/NED"} if turned else {}
    down = turned or any(g.frame == "NED" for g in found)
    along = f"along the body, z {'down' if down else 'up, as nothing says down'}"
    return tuple(
        replace(g, frame="FRD" if down else "FLU", why=f"{g.why}; {along}")
        if g.group == "velocity"
        and (_bare(g.fields[0]).lower() == "u" or _axes_of(g) in ("FLU", "FRD"))
        else replace(g, frame=_axes_of(g), why=f"{g.why}; along {_axes_of(g)}, by the name")
        if _axes_of(g) in FRAMES.get(g.group, ())[1:]
        else replace(g, frame="FLU", why=f"{g.why}; along the body, as nav_msgs/Odometry says")
        if g.group == "velocity" and _ODOMETRY.search(g.fields[0].lower())
        else replace(g, frame=g.frame or frames.get(g.group, ""))
        for g in found
    )


def _axes_of(guess: Guess) -> str:
    """The frame that stands behind the word of a group, vel_body_x; "" where none does."""
    front, last = _framed_word(re.sub(r"[\W_]*[xyz0-9]\W*$", "", _bare(guess.fields[0]).lower()))
    if not _says(front, _WORDS.get(guess.group, "")):
        return ""
    return next((frame for frame, words in _ALONG.items() if re.fullmatch(words, last)), "")


def _framed_word(stem: str) -> tuple[str, str]:
    """(what stands in axes, the word or letter of these axes) of a stem; "" where none is there."""
    match = _IN_FRAME.fullmatch("_".join(_words(stem)))
    return (match[1], match[2]) if match else ("", "")


def _words(stem: str) -> list[str]:
    return [part for part in re.split(r"[\W_]+", stem) if part and part not in _NO_NAME]


def guess_time(columns: Mapping[str, FloatArray]) -> tuple[str, str] | None:
    """(column, unit) of the clock: it grows and does not begin anew, it has the name of a clock,
    and its steps are those of 1 Hz to 20 kHz in the unit that the name says, else those of 20 Hz to
    4 kHz."""
    for name, values in columns.items():
        step = np.diff(values[np.isfinite(values)])
        called = re.sub(r"\W+$", "", _bare(name).lower())
        if not _TIME.fullmatch(called) or step.size < 2 or np.mean(step > 0) < 0.9:
            continue
        if step.sum() < 0.5 * step[step > 0].sum():  # the part of a second, which wraps
            continue
        middle = float(np.median(step[step > 0]))
        said = _time_unit(name)
        if said and 5e-5 <= middle * TIME_UNITS[said] <= 1.0:
            return name, said
        for unit, seconds in TIME_UNITS.items():
            if 2.5e-4 <= middle * seconds <= 5e-2:
                return name, unit
    return None


def _time_unit(name: str) -> str:
    """The unit that the name of a clock says, "Time (ms)", time_us, usec, TimeUS; "" for none."""
    low = _unit_of(name) or name.lower()
    for unit, words in _TIME_WORDS.items():
        # No unit is glued to "time" as the plural is.
        before = r".*[\W_]" if unit == "s" else r".*[\W_]|t|\w*time|\w*stamp"
        if re.fullmatch(rf"(?:{before})?(?:{words})", low):
            return unit
    return ""


NO_TIME = """# No column looks like a clock. Unless one is called t [s] or time_us (s, ms, ns), fill in:
# [time]
# field = "NAME OF THE COLUMN"
# unit = "us"  # or s, ms, ns
"""


NO_COMMAND = """# No columns look like commands. Fill in, in the order of the vehicle file's rotors:
# [command]
# fields = ["NAME OF ROTOR 1", "NAME OF ROTOR 2", "..."]
# limits = [1000, 2000]  # what is u = 0 and u = 1 in the log
"""


def draft(
    guesses: Sequence[Guess],
    time: tuple[str, str] | None,
    without: Iterable[str] = (),
    *,
    clocked: bool = False,
) -> str:
    """A mapping file (docs/logs.md) that says what was guessed, to be looked over; groups of
    `without` need none, and no time where the log is `clocked`."""
    content: dict[str, Json] = {"schema": SCHEMA}
    if time is not None:
        content["time"] = {"field": time[0], "unit": time[1]}
    for g in guesses:
        said: dict[str, Json] = {"stream": g.stream, "fields": g.fields, "unit": g.unit}
        said |= {"frame": g.frame, "limits": g.limits}
        content[g.group] = {k: v for k, v in said.items() if v} | (
            {"scale": g.scale} if g.scale != 1.0 else {}
        )
        if not g.gravity:
            content[g.group] = {**content[g.group], "gravity": False}  # type: ignore[dict-item]
    head = "# A guess from names and sizes: look over axes, units and the order of the rotors.\n"
    text = mapping_text(content, comments={g.group: g.why for g in guesses})
    more = "" if clocked or time is not None else NO_TIME
    driven = not set(_NUMBERED).isdisjoint({*without, *content})
    return head + text + more + ("" if driven else NO_COMMAND)


def _families(
    columns: Iterable[str], ends: Mapping[str, int]
) -> Iterable[tuple[str, dict[int, str]]]:
    """(stem, {place: column}) of columns of one unit whose names differ in their end only: gyro.x,
    gyroADC[0], control.00, qw, or in the number of a motor: motor1_pwm."""
    out: dict[tuple[str, str], dict[int, str]] = {}
    for name in columns:
        pattern = (
            rf"(.*?)[\W_]*(?:0(?=\d))?({'|'.join(sorted(ends, key=len, reverse=True))})"
            rf"\W*(?:[\W_]*({_AFTER}))?\W*"
        )
        match = re.fullmatch(pattern, _bare(name), re.IGNORECASE)
        if match is not None:
            stem = "_".join(part.lower() for part in match.group(1, 3) if part)
            out.setdefault((stem, _unit_of(name)), {}).setdefault(ends[match[2].lower()], name)
    return [(stem, members) for (stem, _), members in out.items()]


def _bare(name: str) -> str:
    """A name without the unit that it ends with."""
    written = _UNIT_WRITTEN.fullmatch(name)
    return written[1] if written else _UNIT.sub("", name)


def _unit_of(name: str) -> str:
    """The unit that a name ends with, in small letters; "" where it states none."""
    written = _UNIT_WRITTEN.fullmatch(name)
    if written:
        return _WRITTEN[written[2].lower()]
    said = _UNIT.search(name)
    return re.sub(r" s\^?-1$", "/s", re.sub(r" s\^?-2$", "/s^2", said[1].lower())) if said else ""


def _may_be(group: str, name: str) -> bool:
    """Whether the unit of a name is one of this group, or of none."""
    unit = _unit_of(name)
    return unit in _UNITS.get(group, {}) or not any(unit in units for units in _UNITS.values())


def _wanted(stem: str) -> bool:
    """Whether a stem says what is wanted and not what is measured."""
    return _among(stem, _WORDS["setpoint"])


def _among(stem: str, words: str) -> bool:
    """Whether any word of a stem is one of these."""
    return any(re.fullmatch(words, word) for word in re.split(r"[\W_]+", stem))


def _commanded(stem: str, names: Iterable[str], columns: Mapping[str, FloatArray]) -> bool:
    """Whether columns with a word of commands are some: a rotor without a unit may be a speed, but
    where its values are shares or percent."""
    names = tuple(names)
    *before, last = re.split(r"[\W_]+", stem)
    said = any(re.fullmatch(_NUMBERED["command"], word) for word in before)
    if said or not re.fullmatch(_ROTOR, last):
        return True
    if _unit_of(names[0]) in _UNITS["command"]:
        return True
    known = _known(names, columns)
    return bool(known.size) and known.min() >= 0.0 and known.max() <= 100.0


def _known(names: Iterable[str], columns: Mapping[str, FloatArray]) -> FloatArray:
    """All numbers of columns, one behind the other."""
    return np.concatenate([columns[n][np.isfinite(columns[n])] for n in names])


def _meant(stem: str) -> str:
    """The group that the stem of three axes says; a setpoint is one of the position, where it says
    of what. "": none."""
    if _wanted(stem):
        others = [_OTHERS, *(w for g, w in _WORDS.items() if g not in ("position", "setpoint"))]
        return "" if any(_among(stem, o) for o in others) else "setpoint"
    if _among(stem, rf"{_ABOUT}|{_ASKED}") or _says(stem, _TURNED_FASTER):
        return ""
    return _said(stem, _WORDS)


def _said(stem: str, groups: Mapping[str, str]) -> str:
    """The group whose words most of the last words of a stem are: angular_velocity is no velocity.
    "": none. A letter behind a word of a group is that of axes: vel_w is no rate, drone_w is one."""
    front = "" if groups is _NUMBERED else _framed_word(stem)[0]
    if front and (said := _said(front, groups)):
        return said
    run = {group: _run(stem, words) for group, words in groups.items()}
    best = max(run, key=lambda group: run[group])
    return best if run[best] else ""


def _says(stem: str, words: str) -> bool:
    return _run(stem, words) > 0


def _run(stem: str, words: str) -> int:
    """How many of the last words of a stem, written as one, are one of these; 0 for none."""
    parts = _words(stem)
    runs = (n for n in range(len(parts), 0, -1) if re.fullmatch(words, "".join(parts[-n:])))
    if (run := next(runs, 0)) or words in _NUMBERED.values():  # a rotor's number is along no axis
        return run
    front = _framed_word(stem)[0]
    return _run(front, words) if front else 0


def _unit_of_gravity(norm: float) -> str:
    """The unit in which the middle length of a specific force is that of gravity; "" for none."""
    units = (("m/s^2", GRAVITY), ("g", 1.0), ("mg", 1000.0))
    return next((u for u, g in units if 0.7 < norm / g < 1.4), "")


CUSTOMARY = (
    (0.0, 1.0),
    (0.0, 100.0),
    (0.0, 255.0),
    (1000.0, 2000.0),
    (0.0, 2047.0),
    (0.0, 65535.0),
)
"""Ranges that logs have their commands in."""


def range_of_commands(low: float, high: float) -> tuple[float, float] | None:
    """The customary range that commands from `low` to `high` fill; None for 0 to 1, or none.

    The narrowest that holds them, by some slack, or no other: a wider one holds everything.
    """
    for least, most in CUSTOMARY:
        if high <= 1.05 * most and low >= least - 0.1 * (most - least):
            fills = low >= least and high - least > 0.5 * (most - least)
            return (least, most) if fills and (least, most) != (0.0, 1.0) else None
    return None


def _of_a_force(values: FloatArray) -> tuple[str, bool, str, str]:
    """(unit, whether gravity is in it, frame, why) of a specific force (N, 3)."""
    norm = float(np.median(np.linalg.norm(values, axis=1)))
    unit, why, gravity = _unit_of_gravity(norm), f"middle length {norm:.3g}", True
    if not unit:
        why += ": of no known unit, scale = 9.81 / at rest"
    if not axis_of_thrust(values):
        unit, gravity = "", False
        why += ", in no lasting direction: gravity was taken out (along the world: frame = 'ENU')"
    down = float(np.median(values[:, 2])) < -0.5 * norm
    return unit, gravity, "FRD" if down else "", f"{why}, z negative: z is down" if down else why


def _sized(group: str, names: tuple[str, ...], columns: Mapping[str, FloatArray]) -> Guess:
    """The guess with the unit that its numbers have."""
    values = np.column_stack([columns[n] for n in names])
    values = values[np.isfinite(values).all(axis=1)]
    if not values.size:
        return Guess(group=group, fields=names, why="no numbers to tell the unit by")
    low, high = float(values.min()), float(values.max())
    size = max(-low, high)
    unit, limits, why, frame, scale = "", None, f"values from {low:.4g} to {high:.4g}", "", 1.0
    gravity = True
    if group == "rate":
        unit = "deg/s" if float(np.percentile(np.abs(values), 99)) > 25 else "rad/s"
    elif group == "specific_force":
        unit, gravity, frame, why = _of_a_force(values)
    elif group == "command":
        asked_speed = (
            _SPEED_ASKED.search(names[0].lower()) or _unit_of(names[0]) in _UNITS["rotor_speed"]
        )
        limits = None if asked_speed else range_of_commands(low, high)
        if limits is None and not 0.0 <= low <= high <= 1.0:
            why += ": add limits = [what is u = 0, what is u = 1]"
    elif group == "rotor_speed":
        unit = "rpm" if size > 4000 or "rpm" in names[0].lower() else "rad/s"
        if "erpm" in names[0].lower():
            # Betaflight writes hundreds of electrical turns a minute; no motor of a craft is as
            # slow as 6000 of them.
            scale, what = (
                (100.0 / POLE_PAIRS, "hundreds of electrical")
                if size < 6000
                else (1 / POLE_PAIRS, "electrical")
            )
            why = f"{what} turns a minute, {2 * POLE_PAIRS} poles guessed: see scale; {why}"
    elif group == "battery":
        unit = "mV" if float(np.median(values)) > 200 else "V"
    elif group == "attitude" and len(names) == 3:
        unit = "deg" if size > 6.3 else "rad"
    elif group in ("position", "setpoint"):
        unit = "mm" if size > 1000 else "m"
    elif group == "velocity":
        unit = "mm/s" if size > 100 else "m/s"
    third = _bare(names[-1]).lower()
    if group in ("position", "velocity") and ("down" in third or third.endswith("d")):
        frame = "NED"
    stated = _UNITS.get(group, {}).get(_unit_of(names[0]), unit)
    if group == "specific_force" and stated != unit:
        why = f"{why.partition(':')[0].partition(',')[0]}: not gravity in that unit"
    return Guess(
        group=group,
        fields=names,
        unit=stated,
        frame=frame,
        limits=limits,
        scale=scale,
        gravity=gravity,
        why=why,
    )
