"""A log without commands is flight data too where every rotor's speed was measured: it is read, cut
and checked as others are, and speeds that are missing are not held but bridged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox import build_model, dataset_from_arrays, fit
from greybox.automatic.facts import Facts
from greybox.automatic.sets import nested_sets
from greybox.data import read_log, read_table
from greybox.data.checks import check
from greybox.data.conditioning import condition
from greybox.data.fitness import unfit
from greybox.errors import DataError, ModelError
from greybox.model.model import input_of
from greybox.model.vehicle_parts import Quantity
from tests.automatic.craft import flown, vehicle

SEED, SECONDS = (7,), 12.0
SPEEDS = ("omega1", "omega2", "omega3", "omega4")
FACTS = Facts(
    sensors=frozenset({"gyro", "accelerometer"}),
    noise={},
    loose=False,
    wander=0.0,
    axes_apart=0.0,
    apart=0.0,
    seconds=SECONDS,
    flights=1,
    rate=100.0,
    voltage=False,
)
COMMANDS = ("u1", "u2", "u3", "u4")
OTHERS = ("p", "q", "r", "ax", "ay", "az")


def columns(late: float = 0.0, commands: bool = False) -> dict[str, np.ndarray]:
    """A flight, with or without `commands`; its rotor speeds are logged `late` [s]."""
    log = dict(flown(SEED, SECONDS)[0])
    t = log["t"]
    return {
        "t": t,
        **{n: log[n] for n in COMMANDS if commands},
        **{n: np.interp(t - late, t, log[n]) for n in SPEEDS},
        **{n: log[n] for n in OTHERS},
    }


def written(tmp_path, log):
    path = tmp_path / "flight.csv"
    text = [",".join(log)] + [
        ",".join("" if np.isnan(v) else repr(float(v)) for v in row) for row in zip(*log.values())
    ]
    path.write_text("\n".join(text) + "\n")
    return path


def test_it_is_read(tmp_path):
    flight = read_log(written(tmp_path, columns()), vehicle())
    assert set(SPEEDS) <= set(flight.channels)
    assert not any(n.startswith("u") for n in flight.channels)


def test_a_log_with_neither_says_that_commands_are_missing(tmp_path):
    log = columns()
    del log["omega3"]
    with pytest.raises(DataError, match="no column 'u1' for the command u1") as caught:
        read_log(written(tmp_path, log), vehicle())
    assert "rotor speeds" in str(caught.value)


def test_speeds_that_are_missing_are_on_the_line_between_their_neighbours(tmp_path):
    log = columns()
    whole = log["omega2"].copy()
    log["omega2"][500:503] = np.nan
    log["omega1"][900:960] = np.nan
    flight = condition(read_table(written(tmp_path, log), vehicle()), vehicle())
    first, second = flight.segments
    filled = np.interp(first.t, log["t"][[499, 503]], whole[[499, 503]])
    inside = (first.t > log["t"][499]) & (first.t < log["t"][503])
    assert inside.sum() == 3
    np.testing.assert_allclose(first.column("omega2")[inside], filled[inside], rtol=1e-12)
    assert second.t[0] == pytest.approx(log["t"][960])
    assert any("rotor speeds interpolated over 3 sample(s)" in n for n in flight.notes)


@pytest.mark.parametrize("commands", [False, True])
@pytest.mark.parametrize("late", [0.0, 0.014, 0.03, 0.045])
def test_speeds_that_come_late_are_no_fault(tmp_path, late, commands):
    """Beside commands they are held against the motion as alone."""
    flight = read_table(written(tmp_path, columns(late, commands)), vehicle())
    report = check([flight], vehicle())
    assert not [f for f in report.findings if f.severity in ("blocking", "warning")]
    (said,) = [f for f in report.of("alignment") if "rotor speeds" in f.where]
    assert said.evidence["p_s"] == pytest.approx(-late, abs=0.005)
    assert ("rotor speeds are logged late" in said.message) == (late > 0.005)
    assert sum("the commands" in f.where for f in report.of("alignment")) == commands


@pytest.mark.parametrize("commands", [False, True])
@pytest.mark.parametrize(("late", "word"), [(0.08, "late"), (-0.08, "early")])
def test_speeds_too_far_from_the_motion_are_one_fault_with_its_cure(tmp_path, late, word, commands):
    flight = read_table(written(tmp_path, columns(late, commands)), vehicle())
    report = check([flight], vehicle())
    (found,) = report.blocking
    assert f"the rotor speeds are logged 80 ms {word}" in found.message
    assert f"delay = {late:g} in [columns.rotor_speed]" in found.fix
    # Commands still tell which rotor is which.
    assert bool([u for u in report.not_judged if u.check == "motors"]) != commands
    mapping = tmp_path / "map.toml"
    mapping.write_text(f'schema = "greybox.mapping/1"\n[rotor_speed]\ndelay = {late:g}\n')
    cured = read_table(tmp_path / "flight.csv", vehicle(), mapping=mapping)
    assert not check([cured], vehicle()).blocking


@pytest.mark.parametrize("name", ["rotor_speed_delay", "rotor_speed_scale"])
def test_the_automatic_fit_has_the_errors_of_speeds_that_are_an_output(name):
    measured = replace(FACTS, sensors=FACTS.sensors | {"rotor_speed"})
    assert name in nested_sets(vehicle(), measured)[0].effects
    assert name not in nested_sets(vehicle(), FACTS)[0].effects


def test_speeds_without_a_stated_maximum_have_no_scale_that_could_be_wrong():
    silent = replace(vehicle(), actuator=replace(vehicle().actuator, speed_max=None))
    measured = replace(FACTS, sensors=FACTS.sensors | {"rotor_speed"})
    assert "rotor_speed_scale" not in nested_sets(silent, measured)[0].effects


def test_rotors_in_another_order_are_named(tmp_path):
    log = columns()
    log["omega1"], log["omega2"] = log["omega2"], log["omega1"]
    flight = read_table(written(tmp_path, log), vehicle())
    (found,) = check([flight], vehicle()).of("motors")
    assert found.severity == "blocking"
    assert "omega1 drives rotor 2, omega2 drives rotor 1" in found.message
    assert "[columns.rotor_speed]" in found.fix


def test_speeds_without_a_stated_maximum_are_judged_too_and_want_one(tmp_path):
    craft = vehicle()
    silent = replace(craft, actuator=replace(craft.actuator, speed_max=None))
    flight = read_table(written(tmp_path, columns()), silent)
    (only,) = (f for f in check([flight], silent).findings if f.severity == "blocking")
    assert (only.check, only.where) == ("rotor_speeds", "omega1..")
    assert "no actuator.speed_max" in only.message and "speed_max [rad/s]" in only.fix
    assert only.evidence["highest_rad_s"] == pytest.approx(np.max(columns()["omega1"]), rel=0.2)
    flight = read_table(written(tmp_path, columns(commands=True)), silent)
    assert not [f for f in check([flight], silent).findings if f.severity == "blocking"]


def test_command_columns_that_hold_nothing_do_not_count(tmp_path):
    log = columns()
    log |= {f"u{i}": np.full(log["t"].size, np.nan) for i in range(1, 5)}
    flight = read_log(written(tmp_path, log), vehicle())
    assert set(SPEEDS) <= set(flight.channels)


def test_where_only_some_commands_are_there_speeds_drive():
    log = columns()
    t = log.pop("t")
    log |= {"u1": np.full(t.size, 0.5), "u2": np.full(t.size, 0.5)}
    data = dataset_from_arrays(t, log, name="run")
    assert input_of(data.channels, vehicle()) == "speed"
    assert not [f for f in check(data, vehicle()).findings if f.severity == "blocking"]


def test_a_log_without_anything_that_drives_is_judged_by_the_rest():
    log = columns()
    t = log.pop("t")
    data = dataset_from_arrays(t, {n: log[n] for n in OTHERS}, name="run")
    report = check(data, vehicle())
    assert any(u.check == "excitation" and "rotor speeds" in u.reason for u in report.not_judged)


def test_a_delay_of_commands_in_the_vehicle_file_says_nothing_of_the_log():
    stated = replace(vehicle(), effects={"command_delay": {"d": Quantity(value=0.012, sigma=0.0)}})
    offered = nested_sets(stated, FACTS, input="speed")
    assert "command_delay" in offered[0].effects
    model = build_model(stated, [*SPEEDS, *OTHERS], ["command_delay"])
    (delay,) = (d for d in model.parameters if d.name == "command_delay.d")
    assert (delay.nominal, delay.sigma > 0) == (0.0, True)


def test_speeds_without_a_scale_are_refused_before_any_work(tmp_path):
    craft = vehicle()
    silent = replace(craft, actuator=replace(craft.actuator, speed_max=None))
    log = columns()
    t = log.pop("t")
    run = dataset_from_arrays(t, log, name="run")
    with pytest.raises(DataError, match=r"no actuator.speed_max.*write speed_max \[rad/s\]"):
        fit(silent, run)
    with pytest.raises(ModelError, match="rotor speeds have no scale"):
        fit(silent, run, accept=["rotor_speeds"])


@pytest.mark.parametrize(
    ("scale", "rate", "reason"),
    [(0.0, 100.0, "no motor ever turns"), (1.0, 12.5, "rotor speeds come at 12.5 Hz")],
)
def test_speeds_that_say_nothing_are_not_usable(tmp_path, scale, rate, reason):
    log = columns()
    log |= {n: scale * log[n] for n in SPEEDS}
    raw = read_table(written(tmp_path, log), vehicle())
    rates = {"rotor_speed": rate, "rate": 100.0, "specific_force": 100.0}
    assert any(reason in why for why in unfit(raw, rates))


def test_sound_speeds_are_usable(tmp_path):
    raw = read_table(written(tmp_path, columns()), vehicle())
    rates = {"rotor_speed": 100.0, "rate": 100.0, "specific_force": 100.0}
    assert not list(unfit(raw, rates))


@pytest.mark.parametrize("late", [0.0, 0.045])
@pytest.mark.parametrize("order", [(2, 1, 3, 4), (3, 2, 1, 4), (2, 3, 4, 1)])
def test_speeds_in_another_order_than_right_commands_are_found(tmp_path, order, late):
    log = columns(late, commands=True)
    log |= {f"omega{i + 1}": columns(late)[f"omega{j}"] for i, j in enumerate(order)}
    report = check([read_table(written(tmp_path, log), vehicle())], vehicle())
    (found,) = report.of("rotor_speeds")
    assert found.severity == "blocking"
    for i, j in enumerate(order, 1):
        assert (f"omega{i} follows u{j}" in found.message) == (i != j)
    assert "[columns.rotor_speed]" in found.fix
    assert not report.of("motors")


def test_a_rotor_speed_that_stands_still_is_no_other_order(tmp_path):
    log = columns(commands=True)
    log["omega2"] = np.full_like(log["omega2"], float(np.mean(log["omega2"])))
    assert not check([read_table(written(tmp_path, log), vehicle())], vehicle()).of("rotor_speeds")


def test_speeds_before_the_motion_may_be_commands(tmp_path):
    flight = read_table(written(tmp_path, columns(late=-0.04)), vehicle())
    messages = [f.message for f in check([flight], vehicle()).of("alignment")]
    (said,) = [m for m in messages if "motion follows the rotor speeds by" in m]
    assert "or these are commands" in said
