"""The study of few flights parts test flights of a type that was fitted from those of others."""

from __future__ import annotations

from scenarios.studies.few_flights import AHEAD, GROUPS, cells, summary


def row(train: tuple[str, ...], errors: dict[str, float]) -> dict[str, object]:
    """A row whose errors are the same in all groups and at all horizons."""
    own = {
        flight: {f"{g} {h:g}": {"mae": e, "coverage95": 0.9} for g in GROUPS for h in AHEAD}
        for flight, e in errors.items()
    }
    return {"size": "one", "train": train, "method": "nonlinear PEM", "cpu": 60.0, "errors": own}


ROWS = [
    row(("B2_circle_slow",), {"B2_circle_fast": 3.0, "B8_star": 1.0, "B7_oval": 2.0}),
    row(("B8_star_slow",), {"B2_circle_fast": 2.0, "B8_star": 5.0, "B7_oval": 2.0}),
]


def test_a_type_that_was_fitted_is_told_from_others():
    assert cells(ROWS, "rate 0.5", "mae", True) == [3.0, 5.0]
    assert cells(ROWS, "rate 0.5", "mae", False) == [1.5, 2.0]
    assert cells(ROWS, "rate 0.5", "mae") == [2.0, 3.0]


def test_the_table_has_mean_range_and_coverage_of_the_sets():
    lines = summary(ROWS).splitlines()
    assert lines[1].split() == ["one,", "nonlinear", "PEM", *["2.5000", "(2-3)", "90%"] * 3]
    assert lines[-1].split()[-1] == "60"
