"""A quaternion of no length is no measurement: every function that measures takes it as missing,
in CasADi as in the C that is generated from it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.model.sensors.attitude import Attitude
from mpc_export.functions import model_functions
from mpc_export.golden import golden_vectors
from mpc_export.model_parts import readings
from mpc_export.tube.gate import UNIT
from tests.mpc_export import cases

MEASURING = ("filter_step", "follow_step", "forecast_step", "pilot_step")


@pytest.fixture(scope="module")
def functions():
    return model_functions(cases.disturbed(), with_=("pilot", "calibrate"))


@pytest.mark.parametrize("length", [0.0, 0.4, 2.5, 5.0])
@pytest.mark.parametrize("name", MEASURING)
def test_it_is_as_if_it_were_missing(functions, name, length):
    golden = next(g for g in golden_vectors(functions, 4) if g.name == name)
    function, names = functions[name], [*golden.arguments]
    turned = [functions.outputs[f"q{a}"] for a in "wxyz"]
    attitudes = [i for i, n in enumerate(functions.innovations.names) if "attitude" in n]
    results = [i for i, n in enumerate(function.name_out()) if n not in ("e",)]
    for k in range(4):
        at = {n: v[k].reshape(function.size_in(n), order="F") for n, v in golden.arguments.items()}
        at["there"] = np.ones_like(at["there"])
        absurd = {**at, "y": at["y"].copy()}
        absurd["y"][turned] *= length
        missing = {**at, "there": at["there"].copy()}
        missing["there"][attitudes] = 0.0
        got, want = (
            [v.full() for v in function(*(a[n] for n in names))] for a in (absurd, missing)
        )
        for i in results:
            np.testing.assert_array_equal(got[i], want[i])


def test_the_filter_that_adapts_does_not_turn_after_it():
    own = cases.disturbed()
    model = replace(own, flight_spread={"mass": (own.values["mass"], 0.1 * own.values["mass"])})
    f = model_functions(model, with_=("adapt",))
    x, u = f.reference
    y = f["h"](x, u, f.parameter_values).full().ravel()
    y[[f.outputs[f"q{a}"] for a in "wxyz"]] = 0.0
    there, attitudes = np.ones(len(f.innovations)), ["attitude" in n for n in f.innovations.names]
    v = f.adapted.covariance
    absurd = f["adapt_step"](x, u, f.parameter_values, y, there, v, 0.0)
    there[attitudes] = 0.0
    missing = f["adapt_step"](x, u, f.parameter_values, y, there, v, 0.0)
    for got, want in list(zip(absurd, missing))[:3]:
        np.testing.assert_array_equal(got.full(), want.full())


def test_what_the_tube_believes_is_within_what_the_functions_take():
    assert Attitude.length is not None
    assert Attitude.length[0] < UNIT[0] < 1 < UNIT[1] < Attitude.length[1]
    assert [len(r.columns) for r in readings(cases.physics().dynamics)] == [4]
    assert readings(cases.linear()) == []
