"""The judge of names: what a discovery.json says, when it is right, what is counted, who can
see."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

import scenarios.foreign.power as oracle
from greybox.model.vehicle import read_vehicle
from scenarios.foreign.hidden import CATALOGUED, OUTSIDE, OWN
from scenarios.foreign.naming import main, retired
from scenarios.foreign.naming_cells import air_of, case_of, cells, fly_case, vehicle_file
from scenarios.foreign.naming_summary import summary
from scenarios.foreign.opened import lines, opened, twin
from scenarios.foreign.power import power
from scenarios.foreign.verdicts import Said, judge, judge_outside, speed_error


def file(effects=(), ambiguous=(), verdict="named", **more):
    """A discovery.json with these names."""
    parameters = {"k": {"value": 1.0, "std": 0.1, "unit": "-"}}
    return {
        "schema": "greybox.discovery/1",
        "verdict": verdict,
        "effects": [{"name": n, "parameters": parameters, "alternatives": []} for n in effects],
        "ambiguous": [{"candidates": [{"name": n, "weight": 0.5} for n in s]} for s in ambiguous],
        **more,
    }


@pytest.mark.parametrize(
    ("effects", "sets", "hidden", "verdict"),
    [
        (["a"], [], ["a"], "right"),
        (["a", "b"], [], ["a"], "extra"),
        (["b"], [], ["a"], "wrong"),
        ([], [["a", "b"]], ["a"], "set"),
        ([], [["b", "c"]], ["a"], "wrong"),
        (["a"], [["b", "c"]], ["a", "c"], "set"),
        (["a"], [["b+c", "d"]], ["a", "b", "c"], "set"),
        (["a"], [], ["a", "b"], "part"),
        ([], [], ["a"], "silent"),
        ([], [], [], "right"),
        (["a"], [], [], "wrong"),
        ([], [["a", "b"]], [], "wrong"),
        (["late"], [], [], "right"),
        (["late", "a"], [], ["a"], "right"),
        (["late"], [], ["a"], "silent"),
    ],
)
def test_a_verdict_follows_from_names_and_sets(effects, sets, hidden, verdict):
    assert judge(Said.of(file(effects, sets)), hidden, ["late"]) == verdict


def test_no_result_and_bad_data_are_neither_right_nor_wrong():
    assert judge(None, []) == judge(Said.of(file(verdict="stopped")), []) == "failed"
    assert judge(Said.of(file(verdict="bad_data")), ["a"]) == "refused"
    with pytest.raises(ValueError, match="not a discovery"):
        Said.of({"schema": "greybox.fit/1"})


def test_a_trace_is_no_name_and_what_the_base_model_has_counts_as_found():
    trace = {"name": "b", "status": "trace", "parameters": {}}
    content = file(["a"], traces=[{"name": "c", "log10_e": 3.0}], base=["d"])
    content["effects"].append(trace)
    said = Said.of(content)
    assert said.named == {"a"} and sorted(said.traces) == ["b", "c"]
    assert judge(said, ["a", "d"]) == "right"


def test_a_name_that_looks_alike_is_a_set():
    content = file(["motor_lag"])
    content["effects"][0]["alternatives"] = ["sensor_delay+pose_delay"]
    said = Said.of(content)
    assert judge(said, ["motor_lag"]) == "set"
    assert judge(said, ["sensor_delay", "pose_delay"]) == "set"
    assert judge(said, ["rotor_drag"]) == "wrong"


def test_the_largest_evidence_is_that_of_any_cause_that_was_tried():
    content = file(["a"], candidates=[{"name": "a", "log10_e": 5.0}, {"name": "b", "log10_e": 0.2}])
    assert Said.of(content).largest == 5.0
    unsure = file(ambiguous=[["a", "b"]], not_certified=[{"name": "c", "log10_e": 1.5}])
    unsure["ambiguous"][0]["log10_e"] = 4.0
    assert Said.of(unsure).evidence == {"c": 1.5, "a|b": 4.0}
    # nothing was put to a test, by a search with e-values and by one without
    assert Said.of(file(bar_log10_e=2.7)).largest == 0.0
    assert Said.of(file(["a"])).largest is None


def test_outside_the_catalogue_an_axis_or_a_relative_is_right():
    flagged = Said.of(file(unnamed=[{"channel": "force.x"}], verdict="unnamed"))
    assert judge_outside(flagged, ["force.x"], []) == "right"
    assert judge_outside(flagged, ["torque.x"], []) == "elsewhere"
    assert judge_outside(Said.of(file(["drag"])), ["force.x"], ["drag"]) == "right"
    assert judge_outside(Said.of(file(["lag"])), ["force.x"], ["drag"]) == "wrong"


def test_the_speed_of_a_wind_is_compared_with_the_truth():
    content = file()
    parameters = {f"w_{axis}": {"value": v} for axis, v in zip("xyz", (3.3, 4.4, 0.0))}
    content["effects"] = [{"name": "steady_wind", "parameters": parameters}]
    truth = {f"steady_wind.w_{axis}": v for axis, v in zip("xyz", (3.0, 4.0, 0.0))}
    assert speed_error(Said.of(content), truth) == pytest.approx(0.1)
    assert speed_error(Said.of(file(["a"])), truth) is None


def test_every_effect_can_be_drawn_and_the_file_does_not_tell_it():
    for seed, name in enumerate(CATALOGUED):
        case = case_of(f"single:{name}", seed)
        assert case.hidden == (name,) and name not in case.declared
        assert case.own is None, "nothing hides that the truth does not know"
        assert all(key.startswith(f"{name}.") for key in case.truth())
        assert name not in vehicle_file(case)


@pytest.mark.parametrize("kind", ["exact", "wrong", "bare"])
def test_a_vehicle_file_says_what_its_owner_knows(kind, tmp_path):
    case = next(c for c in (case_of("clean", s) for s in range(60)) if c.file == kind)
    (tmp_path / "vehicle.toml").write_text(vehicle_file(case), encoding="utf-8")
    vehicle = read_vehicle(tmp_path / "vehicle.toml")
    mass, true = vehicle.quantities["mass"], float(case.base.craft.airframe.mass)
    lag = vehicle.effects["motor_lag"]["tau"]
    assert (mass.sigma == 0.0) == (kind == "exact") and (lag.sigma == 0.0) == (kind == "exact")
    assert (mass.value == pytest.approx(true, rel=1e-5)) == (kind == "exact")


def test_seeds_repeat_and_cells_are_known():
    assert case_of("five", 3) == case_of("five", 3)
    assert len(set(case_of("five", 3).hidden)) == 5
    assert cells(["clean", "power"]) == ["clean", "power:1", "power:2", "power:4", "power:8"]
    with pytest.raises(ValueError, match="no such cell"):
        cells(["clan"])
    with pytest.raises(ValueError, match="single takes"):
        cells(["single:magnet"])


def test_retired_logs_are_read_with_their_comments(tmp_path):
    path = tmp_path / "retired.txt"
    path.write_text("# looked at\nclean 1001  # why\n\nsingle 1002\n", encoding="utf-8")
    assert retired(path) == {("clean", 1001), ("single", 1002)}
    assert retired(tmp_path / "none.txt") == set()


def light(cell, seeds):
    """The case of the first of these seeds that MuJoCo flies in still air with ideal sensors."""
    for seed in seeds:
        case = case_of(cell, seed)
        if case.simulator == "mujoco" and not case.gusts and case.base.realism is None:
            return case
    raise AssertionError("no such seed")


def test_the_oracle_sees_what_shows_and_not_what_the_file_cannot_tell():
    pytest.importorskip("mujoco", reason="MuJoCo comes with the extra judge")
    drag = replace(light("single:rotor_drag", range(200)), file="exact")
    flights = fly_case(drag, seconds=1.5)
    found = power(drag, flights)
    assert found["power"] and found["strength"]["rotor_drag"] > 100.0
    # a tenth of a drag is a hundredth of its strength
    less = tuple(replace(e, k_x=0.1 * e.k_x, k_y=0.1 * e.k_y) for e in drag.effects)
    small = power(replace(drag, effects=less), flights)["strength"]["rotor_drag"]
    assert small == pytest.approx(0.01 * found["strength"]["rotor_drag"], rel=0.3)
    # a mass that is wrong is in the span of a thrust that is not known
    load = light("single:payload_mass", range(200))
    flights = fly_case(load, seconds=1.5)
    bare, exact = (power(replace(load, file=kind), flights) for kind in ("bare", "exact"))
    assert bare["strength"]["payload_mass"] < 0.01 * exact["strength"]["payload_mass"]


def test_the_oracle_sees_a_steady_force_in_gusts_as_a_mean_of_what_lasts(monkeypatch):
    """The best linear unbiased estimate of the mean of a Gauss-Markov process that was seen for T
    has the variance 2 tau sigma^2 / (T + 2 tau) (Grenander 1954, Annals of Mathematical Statistics
    25(2)). Nobody knows how long gusts last, which takes more."""
    pytest.importorskip("mujoco", reason="MuJoCo comes with the extra judge")
    case = replace(light("single:constant_force", range(200)), gusts=True, file="exact")
    flights = {n: f for n, f in fly_case(case, seconds=3.3).items() if n.startswith("train")}
    monkeypatch.setattr(oracle, "SLOWER", (1.0,))
    known = oracle.strengths(case, flights)["constant_force"]
    air = air_of(case)
    windows = oracle.windows_of(flights).count
    force = np.array([case.truth()[f"constant_force.f_{axis}"] for axis in "xyz"])
    seconds = windows * oracle.WINDOW * 0.01
    expected = np.square(force / air.push).sum() * (seconds / (2 * air.gust_time) + len(flights))
    assert known == pytest.approx(expected, rel=0.25)
    monkeypatch.undo()
    assert oracle.strengths(case, flights)["constant_force"] <= known


def test_the_command_judges_a_program_and_does_not_repeat_it(tmp_path, capsys):
    """A search that always says rotor_drag: right where that hides, wrong on a clean flight."""
    pytest.importorskip("mujoco", reason="MuJoCo comes with the extra judge")
    seed = light("clean", range(200)).seed
    program = tmp_path / "always.py"
    program.write_text(
        "import json, pathlib, sys\n"
        "assert sys.argv[1] == 'discover' and 'train1.csv' in sys.argv\n"
        "out = pathlib.Path('found'); out.mkdir(exist_ok=True)\n"
        f"(out / 'discovery.json').write_text({json.dumps(file(['rotor_drag']))!r})\n",
        encoding="utf-8",
    )
    out = tmp_path / "out"
    asked = ["--seeds", str(seed), str(seed), "--out", str(out), "--seconds", "3"]
    asked += ["--greybox", f"python {program}"]
    assert main(["--cells", "clean", *asked]) == 0
    rows = (out / "rows.jsonl").read_text(encoding="utf-8").splitlines()
    row = json.loads(rows[0])
    assert row["judged"] == "wrong" and row["code"] == 0 and row["seconds"] > 0.0
    assert main(["--cells", "clean", *asked]) == 0
    assert len((out / "rows.jsonl").read_text(encoding="utf-8").splitlines()) == 1
    said = capsys.readouterr().out
    assert "a false name 1 of 1" in said and "said rotor_drag" in said


def row(**changes):
    return {
        "asked": "clean",
        "cell": "clean",
        "seed": 1,
        "simulator": "mujoco",
        "gusts": False,
        "sensors": "ideal",
        "file": "exact",
        "hidden": [],
        "judged": "right",
        "names": {},
        "sets": [],
        "traces": [],
        "seconds": 5.0,
        "flights": 2,
        "power": None,
    } | changes


def test_shares_come_with_exact_intervals_and_logs_without_power_apart():
    rows = [
        row(seed=s, largest_log10_e=e, log10_e={"a": e})
        for s in range(20)
        for e in [0.5 if s else 2.0]
    ]
    said = summary(rows)
    # upper bound of none of 20: 1 - 0.025^(1/20)
    assert "a false name 0 of 20 (0.0 %, 0.0 to 16.8)" in said
    assert "the largest E of what is not there is 20 or more: 1 of 20" in said
    late = {"largest_log10_e": 90.0, "log10_e": {"pose_delay": 90.0, "a|b": -3.0}}
    assert "20 or more: 0 of 1" in summary([row(sensors="real", **late)])
    assert "20 or more: 1 of 1" in summary([row(sensors="ideal", **late)])
    single = [
        row(asked="single", hidden=["a"], power=True, names={"a": {}}),
        row(asked="single", hidden=["a"], power=False, judged="silent"),
        row(asked="single", hidden=["a"], power=True, judged="set", sets=[["a", "b", "c"]]),
        row(asked="single", hidden=["a"], power=True, judged="wrong", names={"b": {}}),
    ]
    said = summary(single)
    assert "with power 2 of 3" in said and "wrong 1 of 3" in said and "size of a set 2" in said
    assert "a hidden, said b" in said
    assert "missed with power: 1 not taken up" in said
    missed = row(asked="single", hidden=["a"], power=True, judged="silent")
    trace, small = missed | {"traces": ["a"]}, missed | {"log10_e": {"a|b": 1.0}}
    said = summary([trace, small, small])
    assert "1 certain, and worth nothing (a trace), 2 taken up, its e-value too small" in said


def test_recall_counts_only_what_can_be_seen():
    able = {"a": True, "b": True, "c": False}
    some = row(asked="pair", hidden=["a", "b", "c"], able=able, names={"a": {}}, judged="part")
    assert "recall of effects with power 1 of 2" in summary([some])


def test_draws_are_of_flight_size():
    for seed in range(12):
        case = case_of("wind", 1000 + seed)
        speed = np.hypot(case.truth()["steady_wind.w_x"], case.truth()["steady_wind.w_y"])
        assert 2.0 <= speed <= 12.0


def test_evidence_for_the_truth_is_shown_against_the_number_of_flights():
    rows = [
        row(
            asked=f"power:{n}",
            flights=n,
            hidden=["a"],
            log10_e={"a|b": 1.0 * n, "c": 50.0},
            largest_log10_e=50.0,
            judged="set",
            sets=[["a", "b"]],
        )
        for n in (1, 2, 4)
    ]
    assert "power, 4 flights: named 1 of 1" in summary(rows)
    assert "log10 E of the true cause 4.0" in summary(rows)


@pytest.mark.parametrize("which", [*OUTSIDE, *OWN])
def test_the_twin_of_a_log_lacks_the_effect_and_nothing_else(which):
    case = case_of(f"outside:{which}", 905)
    base = twin(case)
    assert base.own is None and base.effects == () and base.base.fitted is None
    assert (case.own, bool(case.effects)) == ((which, False) if which in OWN else (None, True))
    assert (case.own == "rotor_law") == (case.base.fitted is not None)
    assert air_of(case) == air_of(base) and case.base.craft == base.base.craft


def test_the_share_that_is_closed_leaves_out_what_no_law_foretells():
    def file(*rows, laws=False):
        names = ("group", "before", "after", "with_proposals")
        gap = [dict(zip(names, r, strict=True), horizon_s=0.5, floor=1.0) for r in rows]
        return {"gap": gap, "model_with_laws": "model_with_laws.json" if laws else None}

    none = (None,)
    base = file(*((g, e, e, *none) for g, e in (("position", 3.0), ("rotation", 5.0))))
    found = ("position", 5.0, 4.0, *none), ("rotation", 5.2, 1.0, *none)
    assert opened(file(*found), base)["closed"] == pytest.approx((25 - 16) / (25 - 9))
    assert opened(file(found[1]), base)["closed"] is None, "gusts turned it all, and no effect"
    lawful = ("position", 5.0, 4.0, 0.5)
    assert opened(file(lawful, laws=True), base)["closed"] == pytest.approx(0.5 * 24 / 16)
    assert opened(file(lawful), base)["closed"] == opened(file(found[0]), base)["closed"]
    rows = [
        {"gusts": gusts, "closed": closed, "failed": failed}
        for gusts, closed, failed in (
            (True, 0.5, None),
            (True, None, "bad_data"),
            (True, None, None),
            (False, 0.9, None),
        )
    ]
    assert lines(rows) == [
        "all: 2 of 4 open a gap, 1 without a result, closed 0.50 (median)",
        "gusts: 1 of 3 open a gap, 1 without a result, closed 0.25 (median)",
        "still air: 1 of 1 open a gap, closed 0.90 (median)",
    ]
