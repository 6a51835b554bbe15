"""A wrong argument of a public function is one line with what came and the usual fix, never the
traceback of something inside."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest

import greybox as gb
from greybox.data import Dataset, Flight
from greybox.data.inspection import inspect_log
from greybox.data.logs import read_log
from greybox.errors import GreyboxError, UnknownNameError
from greybox.estimation.filtering import Filter
from greybox.estimation.result import ByName
from greybox.examples import flight_path, vehicle_path
from greybox.linear.records import Record
from greybox.model.linear import LinearModel
from greybox.model.matrices import Matrices
from greybox.symbolic import Layout, Signal
from greybox.takes import COUNT, NAMES, NUMBERS, takes
from tests.residual.hybrid_cases import craft, craft_model

T = 0.01 * np.arange(50)
DATA = gb.dataset_from_arrays(T, {"p": T, "u1": T}, name="a")
OTHER = gb.dataset_from_arrays(T, {"p": T, "u1": T}, name="b")
VEHICLE = gb.read_vehicle(vehicle_path("arpl_crazyflie"))
MODEL = craft_model(craft())
A_LOG = flight_path("arpl_crazyflie", "log15")
LONG = gb.dataset_from_arrays(
    0.01 * np.arange(5000), {n: np.random.default_rng(0).normal(size=5000) for n in ("p", "u1")}
)
ONE = np.eye(1)
LINEAR = LinearModel(
    name="lag",
    matrices=Matrices(0.9 * ONE, ONE, ONE, 0.0 * ONE, 0.1 * ONE),
    noise=ONE,
    dt=0.01,
    inputs=Layout([Signal(name="u1", unit="1")]),
    outputs=Layout([Signal(name="p", unit="rad/s")]),
)
RECORD = Record(u=np.ones((50, 1)), y=np.ones((50, 1)))
FLIGHTS = "takes flights"
A_MODEL = "takes a model of fit, discover or learn"
A_VEHICLE = "takes a vehicle"
LIST = "takes a list of names"
CASES: dict[str, tuple[Callable[[], object], str]] = {
    "text in a channel": (lambda: gb.dataset_from_arrays(T, {"p": ["a"] * 50}), "p has values"),
    "text as time": (lambda: gb.dataset_from_arrays("time", {"p": T}), "t has values that are no"),
    "no channels": (lambda: gb.dataset_from_arrays(T, None), "channels takes channels by name"),
    "empty channels": (lambda: gb.dataset_from_arrays(T, {}), "channels takes channels by name"),
    "numbers as names": (lambda: gb.dataset_from_arrays(T, {1: T}), "channels by name"),
    "dates": (
        lambda: gb.dataset_from_arrays(np.datetime64("2024-01-01") + np.arange(50), {"p": T}),
        "t has dates.*seconds: ",
    ),
    "complex": (lambda: gb.dataset_from_arrays(T, {"p": T + 1j}), "p has complex numbers"),
    "a gap in time": (
        lambda: gb.dataset_from_arrays(np.where(T[7] == T, np.nan, T), {"p": T}),
        "t has no value at sample 7",
    ),
    "no vehicle file": (lambda: gb.read_vehicle(None), "takes a path; got NoneType"),
    "no model file": (lambda: gb.load(None), "takes a path; got NoneType"),
    "a vehicle as model": (lambda: gb.load(vehicle_path("nanobench")), "read_vehicle"),
    "no log": (lambda: inspect_log(None), "takes a path; got NoneType"),
    "a mapping by hand": (lambda: read_log("a.csv", mapping={"rate": 1}), "mapping takes the path"),
    "no logs": (lambda: gb.read_logs([], VEHICLE), "no logs"),
    "logs of nothing": (lambda: gb.read_logs(None, VEHICLE), "takes a list of paths"),
    "check turned round": (lambda: gb.check(VEHICLE, DATA), "data takes flights"),
    "check of a list": (lambda: gb.check([DATA], VEHICLE), "data takes flights"),
    "one check accepted": (lambda: gb.check(DATA, VEHICLE, accept="gaps"), r"accept=\['gaps'\]"),
    "fit turned round": (lambda: gb.fit(DATA, VEHICLE), f"subject {A_VEHICLE}.*got Dataset"),
    "fit of a fitted model": (lambda: gb.fit(MODEL, DATA), "subject .*got IdentifiedModel"),
    "fit to arrays": (lambda: gb.fit(VEHICLE, {"p": T}), f"data {FLIGHTS}.*got dict"),
    "columns of a data set": (lambda: gb.build_model(VEHICLE, DATA), f"columns {LIST}; got Flight"),
    "one effect": (
        lambda: gb.build_model(VEHICLE, ["p"], "motor_lag"),
        r"effects=\['motor_lag'\]",
    ),
    "no sample time": (lambda: gb.build_model(VEHICLE, ["p"], sample_time=0), "above zero; got 0"),
    "validate a vehicle": (lambda: gb.validate(VEHICLE, DATA), f"model {A_MODEL}.*got Vehicle"),
    "one horizon": (lambda: gb.validate(MODEL, DATA, horizons=0.5), r"horizons=\[0.5\]"),
    "horizons as text": (lambda: gb.validate(MODEL, DATA, horizons="0.1"), r"horizons=\[0.1\]"),
    "adapt as text": (
        lambda: gb.validate(MODEL, DATA, adapt="5"),
        "adapt takes a number, zero or above",
    ),
    "pairs of arrays": (lambda: gb.fit_linear([(T, T)]), "records takes a list of Records"),
    "learn turned round": (lambda: gb.learn(DATA, MODEL), f"model {A_MODEL}"),
    "learn on a vehicle": (lambda: gb.learn(VEHICLE, DATA), f"model {A_MODEL}"),
    "profile of a model": (lambda: gb.profile(MODEL, "mass"), "fit takes a Fit"),
    "plan of nothing": (lambda: gb.plan("v.toml"), "v.toml: no such vehicle file"),
    "identify a vehicle": (lambda: gb.identify(VEHICLE, ["a.csv"]), "vehicle takes a path"),
    "identify a data set": (lambda: gb.identify("v.toml", DATA), "logs takes a list of paths"),
    "own effects by name": (
        lambda: gb.discover(VEHICLE, DATA, own=["magnet"]),
        "own takes a list of effects of your own, as they are; got 'magnet' in it.*load_effects",
    ),
    "an own effect by name": (
        lambda: gb.load("a.json", effects="magnet"),
        "effects takes a list of effects of your own, as they are; got 'magnet'.*load_effects",
    ),
    "one parameter held by a search": (
        lambda: gb.discover(VEHICLE, DATA, fixed="mass"),
        r"fixed takes a list of names; got 'mass'.*fixed=\['mass'\]",
    ),
    "probability": (lambda: gb.discover(VEHICLE, DATA, alpha=2.0), "alpha .* between 0 and 1"),
    "a search in processes by name": (
        lambda: gb.discover(VEHICLE, DATA, executor="processes"),
        "executor takes an executor; got 'processes'.*ProcessPoolExecutor",
    ),
    "a seed of a fit": (lambda: gb.fit(VEHICLE, DATA, seed=np.random.default_rng(0)), "seed takes"),
    "a seed of a search": (lambda: gb.discover(VEHICLE, DATA, seed="a"), "from 0 on; got 'a'"),
    "a seed below zero": (lambda: gb.learn(MODEL, DATA, seed=-1), "from 0 on; got -1"),
    "half a seed": (lambda: gb.twin(MODEL, draws=2, seed=1.5), "from 0 on; got 1.5"),
    "a seed with a point": (lambda: gb.learn(MODEL, DATA, seed=3.0), "from 0 on; got 3.0"),
    "one input": (lambda: gb.frf(DATA, "roll", ["p"]), r"inputs=\['roll'\]"),
    "filter of a vehicle": (lambda: Filter(VEHICLE), f"model {A_MODEL}"),
    "filter a flight": (
        lambda: Filter(MODEL, use_compiler=False).run(DATA.flights[0]),
        "segment takes a Segment; got Flight",
    ),
    "more than flights": (lambda: DATA + {}, FLIGHTS),
    "segments as flights": (lambda: Dataset(flights=DATA.segments), "takes a list of Flights"),
    "one flight by name": (lambda: DATA.select("a"), r"names=\['a'\]"),
    "validate a linear model": (lambda: gb.validate(LINEAR, DATA), f"model {A_MODEL}.*its own fit"),
    "learn on a linear model": (lambda: gb.learn(LINEAR, DATA), "fit_output_residual"),
    "a plan for a linear model": (lambda: gb.plan(model=LINEAR), f"model {A_MODEL}"),
    "a twin of a linear model": (lambda: gb.twin(LINEAR), f"model {A_MODEL}.*got LinearModel"),
    "a predictor by number": (
        lambda: gb.fit(VEHICLE, DATA, predictor=3),
        "predictor takes a name, or a predictor; got 3",
    ),
    "no solver": (lambda: gb.fit(VEHICLE, DATA, solver=None), "solver takes a name.*NoneType"),
    "one number held": (lambda: gb.fit(VEHICLE, DATA, fixed=3), f"fixed {LIST}; got 3"),
    "held at a value": (lambda: gb.fit(VEHICLE, DATA, fixed={"mass": 0.03}), f"{LIST}; got dict"),
    "nothing held": (lambda: gb.fit(VEHICLE, DATA, fixed=None), f"fixed {LIST}; got NoneType"),
    "values as an array": (
        lambda: gb.fit(VEHICLE, DATA, values=T),
        "values takes names with numbers",
    ),
    "a value as text": (lambda: gb.fit(VEHICLE, DATA, values={"mass": "x"}), "names with numbers"),
    "noise in an array": (
        lambda: gb.fit(VEHICLE, DATA, estimate_noise=T),
        'takes True, False or "process"',
    ),
    "half a start": (lambda: gb.fit(VEHICLE, DATA, starts=2.5), "starts takes a whole number"),
    "options by hand": (
        lambda: gb.fit(VEHICLE, DATA, {"seed": 1}),
        "options takes FitOptions; got dict.*as keywords",
    ),
    "a model as options": (lambda: gb.discover(VEHICLE, DATA, None, MODEL), "DiscoverOptions"),
    "a rate as text": (lambda: gb.read_logs(A_LOG, VEHICLE, rate="100"), "a positive number of Hz"),
    "an input that there is not": (
        lambda: gb.build_model(VEHICLE, ["p"], input="speeds"),
        'input takes "command" or "speed"; got \'speeds\'',
    ),
    "own sensors by name": (
        lambda: gb.load("a.json", sensors="sonar"),
        "sensors takes a list of sensors of your own, as they are; got 'sonar'",
    ),
    "check of no path": (lambda: gb.check("", VEHICLE), "data takes flights"),
    "export to nowhere": (lambda: gb.export(MODEL, None), "folder takes a path; got NoneType"),
    "identify to a model": (
        lambda: gb.identify("v.toml", ["a.csv"], out=MODEL),
        "out takes a path; got IdentifiedModel",
    ),
    "a twin to a number": (lambda: gb.twin(MODEL, out=3), "out takes a path; got 3"),
    "half a twin": (
        lambda: gb.twin(MODEL, draws=2.5),
        "draws takes a whole number from 0 on; got 2.5",
    ),
    "a window as text": (
        lambda: gb.frf(LONG, ["u1"], ["p"], window="2"),
        "window '2'; expected a positive number of seconds",
    ),
    "a budget in halves": (
        lambda: gb.compare(VEHICLE, DATA, OTHER, budget=2.5),
        "budget takes a whole number above zero; got 2.5",
    ),
    "a plan of one limit": (lambda: gb.plan(VEHICLE, limits=3.0), "limits takes Limits; got 3.0"),
    "one target": (lambda: gb.export(MODEL, "out", targets="c"), r"targets=\['c'\]"),
    "progress in words": (
        lambda: gb.learn(MODEL, DATA, progress="bar"),
        "progress takes a function; got 'bar'",
    ),
    "a plan said in words": (lambda: gb.plan(VEHICLE, say=3), "say takes a function; got 3"),
    "faults in words": (
        lambda: gb.discover(VEHICLE, DATA, faults="none"),
        r"faults takes a CheckReport; got 'none'.*greybox\.check",
    ),
    "a fit to compare with": (
        lambda: gb.compare(VEHICLE, DATA, OTHER, fit=MODEL),
        "fit takes a function; got IdentifiedModel",
    ),
    "half a band": (lambda: gb.frf(LONG, ["u1"], ["p"], band=[1.0]), "band takes 2 numbers; got 1"),
    "a path of a response": (
        lambda: gb.frf(LONG, ["u1"], ["p"], model=3),
        "model takes a fitted model: of fit, discover or linear; got 3",
    ),
    "half an order": (lambda: gb.fit_linear([RECORD], 2.5), "order takes a whole number above z"),
    "a sample time in words": (
        lambda: gb.fit_linear([RECORD], dt="0.01"),
        "dt takes a number above zero; got '0.01'",
    ),
    "a twin of a vehicle": (lambda: gb.twin(VEHICLE), f"model {A_MODEL}"),
}


@pytest.mark.parametrize("case", CASES)
def test_a_wrong_argument_is_named_with_what_came(case: str) -> None:
    call, told = CASES[case]
    with pytest.raises(GreyboxError, match=told):
        call()


def test_data_sets_add_up() -> None:
    assert sum([DATA, OTHER]).names == (DATA + OTHER.flights[0]).names == ("a", "b")
    assert isinstance(Dataset(flights=list(DATA.flights)).flights, tuple)


def test_a_path_stands_for_what_is_read_from_it() -> None:
    log, path = flight_path("arpl_crazyflie", "log15"), vehicle_path("arpl_crazyflie")
    data = gb.read_logs(log, path)
    assert isinstance(data.flights[0], Flight)
    assert gb.check(data, path).vehicle == VEHICLE.name
    assert gb.build_model(path, data.channels).vehicle.name == VEHICLE.name


def test_a_name_that_is_near_is_told_whatever_its_capitals_and_its_group() -> None:
    found = ByName({"motor_lag.tau": None, "mass": None})  # type: ignore[dict-item]
    for wrong, right in (("tau", "motor_lag.tau"), ("MASS", "mass")):
        with pytest.raises(UnknownNameError, match=f"did you mean {right}"):
            found[wrong]
    assert found.get("tau") is None


def test_none_passes_where_it_is_the_default_and_positions_count() -> None:
    @takes(names=NAMES, count=COUNT, levels=NUMBERS)
    def function(first: object, names: object, count: object = None, **more: object) -> object:
        return first, names, count, more

    assert function(SimpleNamespace(), ["a"], levels=[1, 2.0])[1:] == (
        ("a",),
        None,
        {"levels": (1, 2.0)},
    )
    for arguments in ((0, None), (0, "a"), (0, ["a"], 0.5), (0, [1])):
        with pytest.raises(GreyboxError):
            function(*arguments)


def test_none_passes_where_it_is_declared() -> None:
    """As of the vehicle file of `identify`, which the log is asked for then."""

    @takes(names=NAMES)
    def function(names: list[str] | None) -> object:
        return names

    assert function(None) is None
    with pytest.raises(GreyboxError, match="got 3"):
        function(3)  # type: ignore[arg-type]
    with pytest.raises(GreyboxError, match=r"no-such-log\.csv"):
        gb.identify(None, ["no-such-log.csv"])
