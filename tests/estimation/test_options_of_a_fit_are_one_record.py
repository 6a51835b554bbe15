"""FitOptions: what `fit` takes as keywords is one frozen record, and a mistyped choice gets the
nearest name."""

from __future__ import annotations

import argparse
import dataclasses
import inspect
import pickle
from collections.abc import Callable
from typing import get_type_hints

import numpy as np
import pytest

from greybox.commands.model_options import fit_options, model_options
from greybox.discovery.options import DiscoverChoices, DiscoverOptions
from greybox.discovery.workflow import discover
from greybox.errors import GreyboxError, UnknownNameError
from greybox.estimation.fit import fit
from greybox.estimation.options import FitChoices, FitOptions
from greybox.estimation.predictors.multi_step import MultiStep
from greybox.estimation.problem import make_problem
from greybox.linear.fit import LinearChoices, LinearSetup, Record, fit_linear
from greybox.planning.options import PlanChoices, PlanOptions
from greybox.planning.plan import plan
from greybox.residual.learn import learn
from greybox.residual.options import GPChoices, GPOptions, LearnChoices, LearnOptions
from tests import motor

CHOICES = {"predictor": "simulation", "fixed": ["friction"], "values": {"friction": 0.1}, "seed": 3}


@pytest.mark.parametrize(
    ("record", "choices"),
    [
        (FitOptions, FitChoices),
        (DiscoverOptions, DiscoverChoices),
        (GPOptions, GPChoices),
        (LearnOptions, LearnChoices),
        (PlanOptions, PlanChoices),
        (LinearSetup, LinearChoices),
    ],
)
def test_keywords_are_the_fields(record: type, choices: type):
    assert [f.name for f in dataclasses.fields(record)] == list(get_type_hints(choices))


@pytest.mark.parametrize(
    ("function", "record"),
    [
        (fit, FitOptions),
        (discover, DiscoverOptions),
        (learn, LearnOptions),
        (plan, PlanOptions),
    ],
)
def test_help_lists_every_choice_with_its_default(function: Callable[..., object], record: type):
    shown = inspect.signature(function).parameters
    for name, default in vars(record()).items():
        assert shown[name].default == default
        assert shown[name].kind is inspect.Parameter.KEYWORD_ONLY
    assert "choices" not in shown


def test_keywords_and_record_are_the_same_fit():
    names = [p.name for p in motor.model().parameters]
    choices = {"predictor": "simulation", "fixed": names[:1], "initialisation": "nominal"}
    model, data = motor.model(), motor.record(n=300)
    by_keyword = fit(model, data, **choices)
    by_record = fit(model, data, FitOptions(**choices))
    base = FitOptions(predictor="innovation", fixed=names[:1])
    over = fit(model, data, base, predictor="simulation", initialisation="nominal")
    assert by_keyword.theta.tobytes() == by_record.theta.tobytes() == over.theta.tobytes()
    assert by_keyword.settings == by_record.settings == over.settings


@pytest.mark.parametrize(
    ("call", "wrong", "near"),
    [
        (lambda **k: fit(motor.model(), motor.record(n=50), **k), "predicter", "predictor"),
        (
            lambda **k: make_problem(motor.model(), motor.record(n=50), **k),
            "perflight",
            "per_flight",
        ),
        (lambda **k: FitOptions().but(**k), "prior", "priors"),
        (
            lambda **k: discover(motor.model(), motor.record(n=50), **k),
            "max_effect",
            "max_effects",
        ),
        (lambda **k: GPOptions().but(**k), "kernal", "kernel"),
        (lambda **k: LearnOptions().but(**k), "refitted", "refit"),
        (lambda **k: plan(**k), "second", "seconds"),
        (
            lambda **k: fit_linear([Record(u=np.zeros((9, 1)), y=np.zeros((9, 1)))], **k),
            "delay",
            "delays",
        ),
    ],
)
def test_a_mistyped_choice_gets_the_nearest_name(
    call: Callable[..., object], wrong: str, near: str
):
    with pytest.raises(
        UnknownNameError, match=rf"unknown option .*'{wrong}'.*did you mean.*\b{near}\b"
    ):
        call(**{wrong: "x"})


def test_options_are_values():
    a, b = FitOptions(**CHOICES), FitOptions().but(**CHOICES)
    assert a == b != FitOptions()
    assert a.fixed == ("friction",)
    assert pickle.loads(pickle.dumps(a)) == a
    given = {"friction": 0.2}
    held = a.but(values=given)
    given["friction"] = 9.0
    assert held.values == {"friction": 0.2}, "options keep copies"
    assert a.values == {"friction": 0.1}
    with pytest.raises(dataclasses.FrozenInstanceError):
        a.seed = 1  # type: ignore[misc]


def test_the_command_line_says_what_the_options_say():
    options = FitOptions(
        predictor="kalman",
        criterion="robust",
        disturbance=("force", "torque"),
        free=("mass",),
        per_flight=["mass"],
        values={"mass": 1.25, "inertia.x": 0.002},
        noise={"noise.sensor.p": 0.05},
        estimate_noise="process",
        seed=4,
        initialisation="noise",
    )
    parser = argparse.ArgumentParser()
    model_options(parser)
    parser.add_argument("--seed", type=int, default=0)
    assert fit_options(parser.parse_args(options.command_line())) == options
    assert fit_options(parser.parse_args([])) == FitOptions()
    assert FitOptions().command_line() == []


def test_options_as_plain_values_leave_out_defaults():
    assert FitOptions().to_dict() == {}
    said = FitOptions(
        predictor=MultiStep(stride=5), priors={"mass": (1.0, np.float64(0.1))}, free=()
    ).to_dict()
    assert said == {"predictor": "multi-step", "priors": {"mass": [1.0, 0.1]}, "free": []}


@pytest.mark.parametrize("name", ["disturbance", "fixed", "free", "per_flight"])
def test_a_list_of_names_given_as_one_text_is_refused_in_one_line(name: str):
    with pytest.raises(GreyboxError, match=r"takes a list of names.*\['force', 'torque'\]") as told:
        FitOptions.of(None, {name: "force, torque"})  # type: ignore[misc]
    assert "\n" not in str(told.value)
