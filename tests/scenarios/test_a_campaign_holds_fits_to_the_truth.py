"""The campaign over drawn craft counts what a fit says against what is true, and nothing else."""

from __future__ import annotations

import json
from dataclasses import asdict

import pytest

from scenarios.foreign import campaign
from scenarios.foreign.campaign import Row, deviations, share, summary, worse_than_last_value

ROW = Row(
    seed=3,
    simulator="plants",
    mass=0.03,
    gusts=True,
    sensors="real",
    sigmas=False,
    code=0,
    seconds=20.0,
    said="useful for 0.5 s",
    z={"mass": 0.5, "thrust.c2": -2.5},
    off={"mass": 0.01, "thrust.c2": -0.2},
    worse=[],
)


def test_only_what_was_estimated_for_all_flights_and_is_known_counts():
    fitted = {
        "mass": {"value": 1.1, "std": 0.05, "per_flight": {}},
        "inertia.xx": {"value": 2.0, "std": None, "per_flight": {}},
        "gyro_bias.b_x": {"value": 0.1, "std": 0.01, "per_flight": {"train1": {}}},
        "rotor_drag.k_x": {"value": 1e-6, "std": 1e-7, "per_flight": {}},
    }
    z, off = deviations(fitted, {"mass": 1.0, "inertia.xx": 1.0, "gyro_bias.b_x": 0.0})
    assert z == {"mass": pytest.approx(2.0)}
    assert off == {"mass": pytest.approx(0.1)}


def test_a_model_is_compared_with_holding_the_last_value_at_two_horizons():
    def table(rate, rotation):
        groups = {"rate": {"rmse": rate}, "rotation": {"rmse": rotation}}
        return [{"seconds": s, "groups": groups} for s in (0.01, 0.1)]

    validation = {"horizons": table(0.5, 0.1), "persistence": {"horizons": table(0.4, 0.2)}}
    assert worse_than_last_value(validation) == ["rate 0.1 s"]


def test_shares_have_exact_intervals():
    assert share(57, 60) == "57 of 60 (95.0 %, 86.1 to 99.0)"
    assert share(0, 60) == "0 of 60 (0.0 %, 0.0 to 6.0)"


def test_the_summary_counts_intervals_of_usable_fits_only():
    bad = Row(**(asdict(ROW) | {"seed": 4, "code": 1, "z": {"mass": 9.0}}))
    said = summary([ROW, bad]).splitlines()
    assert said[0].startswith("all          usable 1 of 2")
    assert "inside their intervals 1 of 2" in said[0]


def test_a_second_run_does_not_repeat_a_seed(tmp_path, monkeypatch, capsys):
    (tmp_path / "rows.jsonl").write_text(json.dumps(asdict(ROW)) + "\n")
    asked = []

    def judge(seed, out, simulator, hidden, options):
        asked.append((seed, list(options)))
        return Row(**(asdict(ROW) | {"seed": seed}))

    monkeypatch.setattr(campaign, "judge", judge)
    arguments = ["--seeds", "3", "4", "--out", str(tmp_path), "--", "--effects", "motor_lag"]
    assert campaign.main(arguments) == 0
    assert asked == [(4, ["--effects", "motor_lag"])]
    assert len((tmp_path / "rows.jsonl").read_text().splitlines()) == 2
    assert "1/2 inside" in capsys.readouterr().out
