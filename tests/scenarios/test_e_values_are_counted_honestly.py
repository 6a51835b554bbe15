"""The study of e-values counts every log, says exact intervals, and a row is the certificate of a
fixed structure."""

from __future__ import annotations

from typing import Any

import pytest

from scenarios.studies.e_values import drawn, grown, rows_of, summary


def row(
    seed: int, log10_e: float | None, name: str = "rotor_drag", what: str = "null", flights: int = 1
) -> dict[str, Any]:
    return {
        "what": what,
        "seed": seed,
        "flights": flights,
        "name": name,
        "seconds": 4.0,
        "log10_e": log10_e,
    }


def test_one_large_e_value_is_counted_by_name_and_by_seed():
    rows = [row(s, -2.0) for s in range(20)] + [
        row(s, 1.4 if s == 3 else -1.0, "gyro_scale") for s in range(20)
    ]
    said = summary(rows)
    # upper bounds: 1 - 0.025^(1/20) of none of 20
    assert "rotor_drag               0 of 20 (0.0 %, 0.0 to 16.8)" in said
    assert "gyro_scale               1 of 20 (5.0 %" in said
    assert "all names                1 of 40 (2.5 %" in said
    assert "the largest of a seed    1 of 20 (5.0 %" in said


def test_a_fit_that_did_not_end_is_said_and_is_no_evidence():
    assert "did not end): 1 of 2" in summary([row(1, None), row(2, 0.0)])
    rows = [row(1, None, what="power"), row(2, 3.0, what="power", flights=2)]
    assert grown(rows, gust=True) == {2: [3.0]}


def test_evidence_in_gusts_and_in_still_air_is_told_apart():
    rows = [row(s, float(s), what="power") for s in (1, 2, 3, 4)]
    assert grown(rows, gust=True) == {1: [2.0, 3.0]}
    assert grown(rows, gust=False) == {1: [1.0, 4.0]}


def test_depths_of_optima_are_those_of_every_later_step_of_fits_that_ended():
    known = {"what": "depth", "seed": 1, "flights": 1, "seconds": 4.0}
    rows = [known | {"name": "", "converged": True, "depths": [1.0] * 99}]
    rows += [
        known | {"name": "rotor_drag", "converged": c, "depths": [d]}
        for c, d in ((True, 12.0), (False, 50.0))
    ]
    assert "100 later steps of 2 fits: half below 1, 95 % below 1" in summary(rows)
    assert "deepest 12; charged 10" in summary(rows)
    assert "did not end): 0 of 0" in summary(rows), "they are no e-values"


def test_the_figure_is_drawn_of_whatever_there_is():
    assert drawn([row(1, -1.0)]).startswith("<?xml")
    assert drawn([row(1, 2.0 * n, what="power", flights=n) for n in (1, 2, 4)]).startswith("<?xml")


@pytest.mark.slow
def test_what_is_not_there_has_no_e_value_of_twenty_in_a_log_of_development():
    done = {
        ("null", 1, 1, n, 3.0)
        for n in (
            "rotor_drag",
            "constant_force",
            "center_of_mass_offset",
            "thrust_curve",
            "gyro_scale",
        )
    }
    (one,) = rows_of("null", 1, 3.0, done)
    assert one["name"] == "rotational_damping" and one["log10_e"] < 1.3
