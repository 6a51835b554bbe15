"""A fit that lacks an effect bends other numbers into its place: their error bars hold the truth all
the same, and the first lines say that they are no measurements. Where nothing is missing all errors
stay as they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.automatic.wanted import _line, with_rivals
from greybox.cli import main
from greybox.estimation.fit import fit
from greybox.estimation.result import Fit
from greybox.model.known import known_numbers
from greybox.model.model import build_model
from greybox.plants.flight_log import write_log
from greybox.plants.vehicle_file import write_vehicle
from greybox.residual.files import load_model, save_model
from greybox.statistics.rivals import Form
from tests.automatic.craft import IMU, RATES, flights, flown, plant, vehicle

DAMPING = 5e-5
"""Of the air against rotation [N m s], which the model lacks."""
TRUE = {"motor_lag.tau": 0.05, "command_delay.d": 0.012, "thrust.c2": 0.14375}
EFFECTS = ("motor_lag", "command_delay", "gyro_bias")


def fitted(damping: float, predictor: str = "innovation") -> tuple[Fit, Fit]:
    """A fit without damping, and with the errors that hold it."""
    data = flights(RATES, damping=damping)
    dt = data.flights[0].dt
    model = build_model(vehicle(), data.channels, EFFECTS, sample_time=dt)
    plain = fit(model, data, disturbance=("torque",), predictor=predictor)
    return plain, with_rivals(plain, data)


@pytest.fixture(scope="module")
def damped() -> tuple[Fit, Fit]:
    return fitted(DAMPING)


def away(found: Fit, name: str) -> float:
    return abs(found[name].value - TRUE[name]) / found[name].std


def test_the_errors_hold_the_truth_although_the_form_is_wrong(damped):
    plain, held = damped
    assert max(away(plain, n) for n in TRUE) > 10
    assert max(away(held, n) for n in TRUE) < 2
    assert all(held[n].value == plain[n].value for n in plain.parameters)
    assert all(held[n].std >= plain[n].std for n in TRUE)


def test_it_is_said_first_and_what_the_flights_want(damped):
    plain, held = damped
    assert not plain.covariance.form
    assert "motor_lag.tau" in held.covariance.form
    assert "no measurement: the flights want rotational_damping" in held.covariance.form
    assert held.warnings[0] == held.covariance.form
    lines = held.summary().splitlines()
    assert lines.index(f"warning: {held.covariance.form}") == 2
    assert held.summary().count(held.covariance.form) == 1


def test_a_stated_number_that_flights_deny_asks_for_no_effect():
    """All numbers together go with the mass: a payload would bring any of them nearer to a wrong
    statement."""
    data = flights(IMU)
    effects = (*EFFECTS, "accelerometer_bias")
    model = build_model(vehicle(mass=0.01), data.channels, effects, sample_time=data.flights[0].dt)
    wrong = {"inertia.xx": (0.86e-5, 0.057e-5)}  # truth 1.43e-5
    plain = fit(model, data, fixed=["mass"], considered=["mass"], priors=wrong)
    held = with_rivals(plain, data)
    assert not held.covariance.form
    assert held["thrust.c2"].std == plain["thrust.c2"].std


def form_of(*causes: str, log_odds: float = 50.0) -> Form:
    return Form(causes=causes, log_odds=log_odds, shift=np.zeros(1), more=np.zeros((1, 1)))


def test_what_is_clearly_wanted_is_said_though_no_number_hangs_on_it():
    said = _line({}, form_of("parasitic_drag"), frozenset())
    assert said.startswith("the flights want parasitic_drag, which this model lacks: no number")
    assert not _line({}, form_of("parasitic_drag", log_odds=2.0), frozenset())


def test_how_far_a_limit_moves_numbers_is_not_claimed_to_be_known():
    away, wanted = {"thrust.c2": 4.2}, form_of("command_saturation", "thrust_curve")
    assert _line(away, wanted, frozenset()).endswith("the errors hold that now")
    said = _line(away, wanted, frozenset({"command_saturation", "ground_effect"}))
    assert said.startswith(
        "thrust.c2 is no measurement: the flights want command_saturation, thrust"
    )
    assert said.endswith(
        "how far command_saturation moves numbers needs a fit: trust no error before that"
    )


def test_predictions_stay(damped):
    plain, held = damped
    assert held.model.values == plain.model.values
    np.testing.assert_array_equal(held.model.covariance, plain.model.covariance)
    assert held.model.dynamics is plain.model.dynamics


def test_the_kept_model_tells_the_same_errors_to_people_and_to_the_next_fit(damped, tmp_path):
    """A file gave the narrow ones: a fit from it believed numbers that stood for a damping."""
    _, held = damped
    read = load_model(save_model(held.model, tmp_path / "model.json"))
    known = known_numbers(read)
    shown = {r["parameter"]: r["std"] for r in read._shown_rows()}
    for name in TRUE:
        assert read.standard_errors[name] == pytest.approx(held[name].std, rel=1e-9)
        value, error = known[name]  # never less than was known, see `known_numbers`
        assert value == pytest.approx(held[name].value, rel=1e-9)
        assert (1 - 1e-9) * held[name].std <= error < 1.5 * held[name].std
        assert shown[name] == pytest.approx(held[name].std, rel=1e-9)


def test_where_nothing_is_missing_nothing_changes():
    plain, held = fitted(0.0)
    assert held is plain
    assert max(away(plain, n) for n in TRUE) < 3


def test_a_fit_that_is_no_minimum_of_the_likelihood_stays_as_it_is(damped):
    data = flights(RATES, damping=DAMPING)
    plain = damped[0]
    lost = replace(plain.status, code=type(plain.status.code).MAX_ITERATIONS)
    other = replace(plain, diagnostics=replace(plain.diagnostics, status=lost))
    assert with_rivals(other, data) is other


@pytest.mark.slow
def test_the_command_says_it_below_the_reasons_of_its_verdict(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name, columns in zip("ab", flown(damping=DAMPING), strict=True):
        kept = {k: v for k, v in columns.items() if k in ("t", "u1", "u2", "u3", "u4", *RATES)}
        write_log(tmp_path / f"{name}.csv", kept)
    write_vehicle(tmp_path / "v.toml", plant(), sigma={"inertia": 0.2, "thrust.c2": 0.2})
    command = (
        "fit --vehicle v.toml --train a.csv b.csv --manual --disturbance torque "
        f"--effects {','.join(EFFECTS)} --out out"
    )
    main(command.split())
    first, *rest = capsys.readouterr().out.splitlines()
    said = [line for line in rest if not line.startswith("  ")]
    assert len(first) <= 100
    assert said[0] == "next: greybox discover --vehicle v.toml --train a.csv b.csv"
    reason = rest[rest.index(said[0]) + 1]
    assert reason.startswith("  ")
    assert "no measurement: the flights want rotational_damping" in reason
