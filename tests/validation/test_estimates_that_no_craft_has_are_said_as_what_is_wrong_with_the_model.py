"""Estimates that no craft has, or that deny what was measured, are said as statements about the
model with what to try."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from greybox.estimation.conclusion import _bound_warnings
from greybox.estimation.fit import Estimate, fit, noise_of
from greybox.model.identified import IdentifiedModel
from greybox.model.model import build_model
from greybox.model.vehicle import Vehicle
from greybox.model.vehicle_parts import Quantity
from greybox.model.verdict import Outcome, Verdict
from greybox.validation.advice import Hint, Symptom, hints_of_fit, hints_of_model, likely
from greybox.validation.sanity import ADVICE, LIMITS, sanity, sanity_of, sanity_of_model, untried
from tests.simulated import ERRORS, flights, vehicle
from tests.simulators.identified import identified

EFFECTS = ("motor_lag", "command_delay")

CRAFT = Vehicle.from_dict(
    {
        "schema": "greybox.vehicle/2",
        "mass": {"value": 0.043, "sigma": 0.0004},
        "inertia": [[3e-5, 0.0, 0.0], [0.0, 3e-5, 0.0], [0.0, 0.0, 5e-5]],
        "rotor": [
            {"position": [x, y, 0.0], "spin": s}
            for x, y, s in (
                (0.03, -0.03, 1),
                (-0.03, -0.03, -1),
                (-0.03, 0.03, 1),
                (0.03, 0.03, -1),
            )
        ],
        "actuator": {"thrust": [0.0, 0.0, 0.15], "torque": [0.0, 0.0, 9e-4]},
    }
)
UNITS = {"mass": "kg", "motor_lag.tau": "s", "command_delay.d": "s"}


def estimate(name: str, value: float, *, at_bound: bool = False, prior: bool = True) -> Estimate:
    quantity = CRAFT.quantities.get(name)
    return Estimate(
        name=name,
        value=value,
        std=0.0,
        std_fisher=0.0,
        unit=UNITS.get(name, ""),
        scope="shared",
        prior=(quantity.value, quantity.sigma) if quantity and prior else None,
        prior_influence=0.0,
        at_bound=at_bound,
    )


def judged(*estimates: Estimate):
    return sanity({e.name: e for e in estimates}, CRAFT)


def test_what_the_vehicle_file_says_is_sane():
    assert judged(*(estimate(n, q.value) for n, q in CRAFT.quantities.items())).findings == ()
    assert sanity({}, CRAFT).possible


def test_a_weighed_mass_that_the_flights_deny_is_a_statement_about_thrust():
    (found,) = judged(estimate("mass", 0.031)).findings
    assert (found.kind, found.severity, found.parameters) == ("overruled", "doubtful", ("mass",))
    assert "mass was weighed (43 +- 0.4 g) but the flights want 31 g" in found.statement
    assert (
        "thrust per command" in found.likely
        and "hold mass" in found.attempt
        and "free thrust.c2" in found.attempt
    )
    (other,) = judged(estimate("mass", 0.031), estimate("thrust.c2", 0.15)).findings
    assert "ratio" in other.likely and "free thrust" not in other.attempt


def test_what_to_free_is_the_number_that_the_thrust_map_consists_of():
    linear = {"thrust.c1": 0.15, "thrust.c2": 0.0}
    found = {
        re.findall(r"free (\S+),", advised.attempt)[0]
        for values in ({}, linear)
        for advised in sanity({"mass": estimate("mass", 0.031)}, CRAFT, values).findings
        if advised.kind == "overruled"
    }
    assert found == {"thrust.c2", "thrust.c1"}


@pytest.mark.parametrize(
    ("thrust", "inertia", "said"),
    [
        (0.54, 0.52, True),
        (1.7, 1.7, True),
        (0.54, 1.0, False),
        (1.0, 0.5, False),
        (0.9, 0.9, False),
    ],
)
def test_a_mass_that_is_wrong_is_told_by_all_that_it_scales(thrust, inertia, said):
    """Each is within four sigma of a number that nobody measured."""
    names = ("thrust.c2", "torque.c2", "inertia.xx", "inertia.yy", "inertia.zz")
    factors = (thrust, *(inertia,) * 4)
    found = judged(
        *(estimate(n, f * CRAFT.quantities[n].value) for n, f in zip(names, factors, strict=True))
    ).findings
    assert [f.parameters for f in found] == [("mass",)] * said
    assert all(
        "weigh the craft" in f.attempt and "sigma away together" in f.statement for f in found
    )


@pytest.mark.parametrize(("sigmas", "said"), [(3.9, False), (4.1, True), (-4.1, True)])
def test_a_prior_counts_as_denied_beyond_four_sigma(sigmas, said):
    q = CRAFT.quantities["inertia.xx"]
    report = judged(estimate("inertia.xx", q.value + sigmas * 0.1 * q.sigma, prior=False))
    assert not any(f.kind == "overruled" for f in report.findings)
    narrow = replace(estimate("thrust.c2", 0.15 + sigmas * 0.001), prior=(0.15, 0.001))
    assert any(f.kind == "overruled" for f in judged(narrow).findings) is said


def test_a_prior_at_its_four_sigma_bound_is_denied_too():
    stuck = replace(estimate("thrust.c2", 0.154, at_bound=True), prior=(0.15, 0.001))
    assert [f.kind for f in judged(stuck).findings] == ["overruled"]


def test_negative_drag_torque_at_hover_is_impossible():
    report = judged(estimate("torque.c2", -2e-4))
    assert not report.possible
    assert any("negative at hover" in f.statement and "spins" in f.attempt for f in report.findings)
    mixed = {"torque.c0": -1e-5, "torque.c2": 9e-4}
    assert judged(*(estimate(n, v, prior=False) for n, v in mixed.items())).possible


def test_thrust_that_cannot_carry_the_craft_is_impossible():
    assert not judged(estimate("thrust.c2", 0.03, prior=False)).possible
    assert not judged(estimate("thrust.c2", -0.15, prior=False)).possible


def test_a_delay_before_its_cause_is_impossible_and_a_slow_motor_doubtful():
    assert not judged(estimate("command_delay.d", -0.004)).possible
    (slow,) = judged(estimate("motor_lag.tau", 0.45)).findings
    assert slow.severity == "doubtful"
    assert judged(estimate("motor_lag.tau", 0.08)).findings == ()


@pytest.mark.parametrize(
    ("late", "std", "commands", "possible"),
    [
        (-5e-5, 9e-5, 0.0, True),
        (-2e-6, float("nan"), 0.0, True),
        (-0.008, 1e-4, 0.01, True),
        (-0.015, 1e-4, 0.008, False),
        (-0.015, float("nan"), 0.008, False),
        (0.03, 1e-4, 0.0, True),
    ],
)
def test_rotor_speeds_may_be_early_by_as_much_as_commands_are_late(late, std, commands, possible):
    shown = replace(estimate("rotor_speed_delay.d", late), std=std, unit="s")
    report = judged(shown, estimate("command_delay.d", commands))
    assert report.possible is possible
    assert possible or "rotor speeds answer 7.0 ms before the command" in report.lines()[0]


def test_moments_that_no_body_has_are_impossible_and_those_of_a_rounded_table_doubtful():
    def moments(zz):
        each = (("inertia.xx", 3e-5), ("inertia.yy", 3e-5), ("inertia.zz", zz))
        return judged(*(estimate(n, v, prior=False) for n, v in each))

    assert moments(5.9e-5).findings == ()
    assert [f.severity for f in moments(6.1e-5).findings] == ["doubtful"]
    assert not moments(7e-5).possible
    assert not judged(estimate("inertia.xx", 3e-3, prior=False)).possible


@pytest.mark.parametrize("factor", [1 / 3, 3.0])
def test_a_stated_inertia_that_is_off_by_three_is_said_in_either_direction(factor):
    true = CRAFT.quantities["inertia.yy"].value
    stated = (factor * true, 0.2 * factor * true)
    (found,) = judged(replace(estimate("inertia.yy", true), prior=stated)).findings
    assert (found.kind, found.parameters) == ("overruled", ("inertia.yy",))
    assert found.likely.startswith("the vehicle file's inertia.yy is wrong, or ")
    assert found.attempt.startswith("correct it where nobody measured it; ")
    near = (1.4 * true, 0.2 * 1.4 * true)
    assert judged(replace(estimate("inertia.yy", true), prior=near)).findings == ()


def test_moments_beyond_the_triangle_by_less_than_their_errors_are_doubtful():
    def moments(std):
        each = (("inertia.xx", 3e-5), ("inertia.yy", 3e-5), ("inertia.zz", 7e-5))
        return judged(*(replace(estimate(n, v, prior=False), std=std) for n, v in each))

    (found,) = moments(4e-6).findings  # 1e-5 too much, 7e-6 its standard error
    assert found.severity == "doubtful" and "by less than their errors" in found.statement
    assert not moments(2e-6).possible


def test_three_parameters_at_bounds_are_one_missing_cause():
    two = [estimate(n, CRAFT.quantities[n].value, at_bound=True) for n in ("mass", "inertia.xx")]
    assert judged(*two).findings == ()
    (found,) = judged(*two, estimate("inertia.yy", 3e-5, at_bound=True)).findings
    assert (
        found.kind == "bounds"
        and "3 of 3 parameters" in found.statement
        and "motor_lag" in found.attempt
    )


def test_the_record_is_plain_and_the_limits_have_sources():
    report = judged(estimate("mass", 0.031), estimate("torque.c2", -2e-4))
    assert [f.severity for f in report.findings] == sorted(
        (f.severity for f in report.findings), reverse=True
    )
    assert json.loads(json.dumps(report.to_dict()))["possible"] is False
    assert all(limit.source for limit in LIMITS.values())
    assert report.lines()[0].startswith("impossible: ")


@pytest.mark.parametrize("schema", ["greybox.vehicle/1", "greybox.vehicle/2"])
def test_a_real_fit_with_a_falsified_mass_says_so(schema):
    true, data = vehicle(), flights(1, 6.0)
    mass = Quantity(value=1.4 * true.mass.value, sigma=0.014 * true.mass.value)
    exact = tuple(Quantity(value=q.value / ERRORS["thrust.c2"]) for q in true.actuator.thrust)
    heavy = replace(true, mass=mass, actuator=replace(true.actuator, thrust=exact), schema=schema)
    found = sanity_of(fit(build_model(heavy, data.channels, EFFECTS), data)).findings
    assert any(f.kind == "overruled" and f.parameters == ("mass",) for f in found)


def test_a_real_fit_with_an_honest_vehicle_file_is_possible():
    data = flights(1, 6.0)
    report = sanity_of(fit(build_model(vehicle(), data.channels, EFFECTS), data))
    assert report.possible and not any(f.kind in ("overruled", "bounds") for f in report.findings)


@pytest.mark.parametrize(
    ("names", "missing"),
    [
        (("disturbance.force.T", "disturbance.torque.T", "low_pass.gyro.T"), False),
        (("mass", "inertia.xx", "thrust.c2"), True),
    ],
)
def test_noise_that_is_not_there_is_no_missing_cause(names: tuple[str, ...], missing: bool):
    data = flights(1, 3.0)
    found = fit(build_model(vehicle(), data.channels), data, free=["mass"])
    stuck = {n: replace(found["mass"], name=n, at_bound=True) for n in names}
    found = replace(found, estimates=replace(found.estimates, parameters=stuck))
    assert any(f.kind == "bounds" for f in sanity_of(found).findings) is missing
    assert any(h.symptom is Symptom.BOUNDS for h in hints_of_fit(found)) is missing
    said = _bound_warnings(found.parameters, found.model.dynamics)
    assert all(("effect list" in w) is missing for w in said) and len(said) == len(names)


def test_nobody_is_told_to_add_what_the_model_has():
    advice = "add motor_lag and command_delay; measure the arms"
    assert ADVICE["inertia"][1] == advice
    assert untried(advice, {"motor_lag"}) == "add command_delay; measure the arms"
    assert untried(advice, {"motor_lag", "command_delay"}) == "measure the arms"
    assert untried(ADVICE["mass"][1], {"battery_sag"}) == "free {thrust}, hold mass (--fixed mass)"
    assert untried(ADVICE["mass"][1], set()) == ADVICE["mass"][1]
    assert (
        untried("add rotor_asymmetry", {"rotor_asymmetry"})
        == "look at the innovations and at greybox check"
    )


@pytest.mark.parametrize(
    ("value", "std", "possible"),
    [(7.96, 0.55, False), (-7.96, 0.55, False), (2.7, 1.6, True), (0.3, 0.01, True)],
)
def test_an_offset_that_no_sensor_has_is_impossible(value: float, std: float, possible: bool):
    """An offset of a g is the thrust that a log without a pose does not tell from it."""
    model = offset(value, std)
    (*found,) = [f for f in sanity_of_model(model).findings if "accelerometer" in f.statement]
    assert len(found) == (not possible)
    for f in found:
        assert f.severity == "impossible" and f.parameters == ("accelerometer_bias.b_z",)
        assert f.statement.endswith(f"b_z is {value:.3g} m/s^2 (no craft has more than 2.5)")


def test_a_model_says_of_itself_what_its_fit_said():
    """Whoever validates it later is told the cause that the fit knew first."""
    said = hints_of_model(offset(7.96, 0.55))
    assert [h.symptom for h in said] == [Symptom.IMPOSSIBLE]
    seen = Hint(symptom=Symptom.SATURATED, detail="a: a command is at u_max for 4.5 %")
    reason, _, anchor = likely([seen, *said], Symptom.RATE)
    assert anchor == Symptom.IMPOSSIBLE.anchor and "accelerometer_bias.b_z is 7.96" in reason


@pytest.mark.parametrize("symptom", [Symptom.NOT_CONVERGED, Symptom.BOUNDS, Symptom.SATURATED])
def test_what_a_fit_gave_as_its_reason_is_said_again_unless_its_flights_showed_it(symptom: Symptom):
    reason, action, anchor = likely([Hint(symptom=symptom, detail="mass, inertia.xx")], symptom)
    own = Verdict(
        outcome=Outcome.NOT_USABLE,
        line="NOT USABLE",
        useful_seconds=0.0,
        judged_seconds=1.0,
        judged_on="a",
        flights=("a",),
        groups=(),
        reason=reason,
        action=action,
        anchor=anchor,
    )
    said = hints_of_model(replace(offset(0.1, 0.05), verdict=own))
    hint = Hint(symptom=symptom, detail="mass, inertia.xx")
    assert said == (() if symptom is Symptom.SATURATED else (hint,))


def offset(value: float, std: float) -> IdentifiedModel:
    """A model whose accelerometer is off by `value` +- `std` along z."""
    name = "accelerometer_bias.b_z"
    given = {f"accelerometer_bias.b_{a}": 0.0 for a in "xy"} | {name: value}
    square = np.array([[std**2]])
    return replace(identified(given), covariance_names=(name,), covariance=square)


@pytest.mark.parametrize(("share", "said"), [(0.5, 0), (0.1, 1)])
def test_a_sensor_that_is_much_noisier_than_stated_is_said(share: float, said: int):
    """Its error is one that the model lacks, a wrong scale for one."""
    data = flights(1, seconds=4.0)
    found = fit(build_model(vehicle(), data.channels), data, initialisation="noise")
    level = max(found.noise[f"noise.sensor.{c}"][0] for c in "pqr")
    stated = replace(vehicle(), noise={"gyro": share * level})
    model = build_model(stated, data.channels)
    again = fit(model, data, free=[], noise=noise_of(found.model), initialisation="nominal")
    lines = [f for f in sanity_of(again).findings if f.kind == "noise"]
    assert len(lines) == said
    for f in lines:
        assert f.statement.startswith("noise of gyro was stated (")
