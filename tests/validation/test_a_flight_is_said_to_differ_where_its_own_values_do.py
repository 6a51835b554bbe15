"""Of a model that fails on a flight whose own values lie beyond all that its training flights differ
by, the likely reason is that flight; commands that touch their limits come after it, and before a
flight that may differ."""

from __future__ import annotations

from dataclasses import replace

import pytest

from greybox.model.verdict import Outcome
from greybox.validation.adapt import Adaptation
from greybox.validation.advice import Hint, Symptom
from greybox.validation.validate import validate
from tests.validation.test_validate_judges_causally import dataset, fly, make_model

LIMITED = Hint(symptom=Symptom.SATURATED, detail="f: a command is at u_max for 3.8 % of the flight")
SPREAD = 1e-3


@pytest.fixture(scope="module")
def wrong():
    """Turns five times as fast as it should; its thrust differs by one part in a thousand."""
    model = make_model()
    c2 = model.values["thrust.c2"]
    slow = {n: 0.2 * model.values[n] for n in ("inertia.xx", "inertia.yy", "inertia.zz")}
    return replace(
        model, values=model.values.replace(slow), flight_spread={"thrust.c2": (c2, SPREAD * c2)}
    )


def reason(model, scale: float, **choices) -> str:
    flown = {"thrust.c2": scale * model.values["thrust.c2"]}
    flight = dataset(fly(make_model(), 900, noise=1.0, changes=flown))
    verdict = validate(model, flight, hints=(LIMITED,), **choices).verdict
    assert verdict is not None and verdict.outcome is Outcome.NOT_USABLE
    return verdict.reason


def test_a_thrust_that_no_training_flight_had_is_the_reason(wrong):
    said = reason(wrong, 1.03)
    assert said.startswith("this flight differs from those of the fit") and "thrust.c2" in said


def test_commands_at_their_limits_are_it_where_the_flight_is_like_the_others(wrong):
    assert reason(wrong, 1.0).startswith("commands are at their limits")


def test_commands_at_their_limits_come_before_values_that_nobody_asked_for(wrong):
    assert reason(wrong, 1.0, adapt=0).startswith("commands are at their limits")


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("thrust.c2", 1.02, "f: thrust.c2 1 N, in training 1 +- 0.001 N"),
        ("thrust.c2", 1.002, ""),
        ("gyro_bias.b_x", 2.0, ""),  # offsets of sensors spoil no model by much
    ],
)
def test_what_is_beyond_is_said_with_what_was_seen_before(wrong, name, value, said):
    found = Adaptation(
        flight="f", seconds=5.0, values={name: value}, std={name: 1e-4}, units={name: "N"}
    )
    assert found.beyond(replace(wrong, flight_spread={name: (1.0, SPREAD)})) == said
