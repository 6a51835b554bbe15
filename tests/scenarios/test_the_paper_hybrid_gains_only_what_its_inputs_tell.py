"""The paper's literal hybrid gains what its inputs tell, and is refused where a linear model misses
nothing."""

import pytest

from scenarios.studies.hybrid_gains import AHEAD, PLANTS, judged

TENTH = AHEAD.index(10)


@pytest.mark.slow
def test_thrust_with_the_square_of_speed_is_learned():
    row = judged(PLANTS["climbs"], lambda _: None)
    assert row["kept"] == [True, True, True]
    assert row["ratio"][TENTH] < 0.7


@pytest.mark.slow
def test_nothing_is_learned_where_nothing_is_missed():
    row = judged(PLANTS["a ball"], lambda _: None)
    assert row["kept"] == [False, False, False]
    assert row["ratio"] == pytest.approx([1.0] * len(AHEAD), abs=1e-9)
