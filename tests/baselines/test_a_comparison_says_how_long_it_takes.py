"""Before a comparison starts it says how long each method usually takes."""

from greybox.baselines.compare import compare
from greybox.baselines.compare_bench import Bench
from greybox.baselines.compare_costs import FIT, TYPICAL, expectation, expected
from greybox.baselines.compare_methods import METHODS
from tests.simulated import flights, vehicle


def test_every_method_has_a_typical_time():
    assert set(TYPICAL) == set(METHODS)


def test_the_fit_counts_once_and_only_where_it_is_needed():
    rows = {"train": 10_000, "test": 2_000, "budget": 2}
    fitted = expected(METHODS, **rows, fitted=True)
    fits = expected(METHODS, **rows, fitted=False)
    own = FIT.seconds(10_000, 2_000, 2)
    assert fits["nonlinear PEM"] - fitted["nonlinear PEM"] == own
    assert {n: s for n, s in fits.items() if n != "nonlinear PEM"} == {
        n: s for n, s in fitted.items() if n != "nonlinear PEM"
    }


def test_what_is_not_known_is_said():
    line = expectation({"TCN": 120.0, "linear MIMO PEM + own": None})
    assert "TCN about 2 min" in line and "linear MIMO PEM + own not known" in line
    assert line.endswith("in all about 2 min")


def test_it_is_the_first_thing_said():
    said = []
    train, test = flights(3, 6.0).split_by_flight(["run2"])
    bench = Bench(
        vehicle=vehicle(), train=train, test=test, fit=lambda: 1 / 0, say=said.append, fitted=True
    )
    next(iter(compare(bench, ("persistence", "TCN"))))
    assert said[0].startswith("CPU that is usual") and "TCN about 2 min" in said[0]
