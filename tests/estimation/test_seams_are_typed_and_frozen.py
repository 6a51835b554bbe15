"""What predictors, criteria and solvers see of each other is declared: a user's own member fits in,
and nothing of a problem can be changed on the way."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import FrozenInstanceError, dataclass

import numpy as np
import pytest

from greybox.errors import ModelError
from greybox.estimation.criteria import CRITERIA
from greybox.estimation.fit import fit
from greybox.estimation.predictor import Block, Predictor
from greybox.estimation.predictors import PREDICTORS
from greybox.estimation.predictors.innovation import Innovation
from greybox.estimation.predictors.k_step import KStep
from greybox.estimation.predictors.simulation import start_of
from greybox.estimation.problem import Problem, make_problem
from greybox.estimation.recursion import GainTable
from greybox.estimation.solvers import SOLVERS
from greybox.symbolic import FloatArray
from tests import motor


@dataclass(frozen=True, kw_only=True)
class Still:
    """What `Freewheel` prepares: gains of zero, and how often they were asked for."""

    gains: GainTable
    made: int


class Freewheel(Predictor[Still]):
    """A predictor with the abstract members only: output error, as a user would write it."""

    made = 0

    @property
    def name(self) -> str:
        return "freewheel"

    def prepare(self, problem: Problem) -> Still:
        self.made += 1
        count, engine = max(len(r.patterns) for r in problem.records), problem.engine
        none = GainTable(
            gain=np.zeros((count, engine.nd, engine.ne)), zero=np.ones(count, dtype=np.int32)
        )
        return Still(gains=none, made=self.made)

    def blocks(self, problem: Problem, theta: FloatArray, jacobian: bool) -> Iterable[Block]:
        for i, r in enumerate(problem.records):
            x0, s0, columns = start_of(problem, theta, i)
            run = problem.engine.run(
                x0=x0,
                inputs=r.inputs,
                outputs=r.outputs,
                mask=r.mask,
                pattern=r.pattern,
                gains=problem.prepared(self).gains,
                p=problem.parameters_of(theta, r.flight),
                dt=r.dt,
                s0=s0 if jacobian else None,
                want=frozenset({"innovations", "sensitivity"}),
            )
            assert run.innovations is not None
            yield Block(
                record=r,
                e=run.innovations,
                mask=r.mask,
                jacobian=run.sensitivity,
                columns=columns,
                covariance=None,
                covariance_slope=None,
                pattern=r.pattern,
            )


@pytest.fixture(scope="module")
def problem() -> Problem:
    return make_problem(motor.model(), motor.record(n=200), predictor="innovation")


def test_a_predictor_with_the_abstract_members_alone_fits():
    own = Freewheel()
    found = fit(motor.model(), motor.record(), predictor=own)
    known = fit(motor.model(), motor.record(), predictor="simulation")
    assert found.converged
    assert found.settings["predictor"] == "freewheel"
    assert {n: e.value for n, e in found.parameters.items()} == {
        n: e.value for n, e in known.parameters.items()
    }
    assert found.model.sensor_noise == pytest.approx(known.model.sensor_noise)
    assert own.made == 1, "what it prepares is worked out once per problem"
    assert found.problem.prepared(own).made == 1


def test_a_predictor_without_an_abstract_member_cannot_be_made():
    class Half(Predictor[None]):
        name = "half"

        def prepare(self, problem: Problem) -> None:
            """Nothing."""

    with pytest.raises(TypeError, match="blocks"):
        Half()  # type: ignore[abstract]


def test_predictors_say_what_they_have():
    made = {n: make() for n, make in PREDICTORS.items()}
    assert {n for n, p in made.items() if p.has_noise} == {"innovation", "kalman"}
    assert {n for n, p in made.items() if not p.has_initial} == {"kalman"}
    assert {n for n, p in made.items() if p.one_step is not p} == {"k-step", "multi-step"}
    assert {n for n, p in made.items() if p.misfit_is_sensor_noise} == {
        "simulation",
        "multiple-shooting",
    }
    assert made["k-step"].horizons == (10,)
    assert {n: p.name for n, p in made.items()} == {n: n for n in made}
    assert all(
        hash(p) == hash(make()) and p == make()
        for p, make in zip(made.values(), PREDICTORS.values())
    )


def test_members_carry_the_name_of_the_catalogue():
    for catalogue in (CRITERIA, SOLVERS):
        assert {n: make().name for n, make in catalogue.items()} == {n: n for n in catalogue}


def test_equal_predictors_share_what_they_prepare(problem: Problem):
    there = problem.prepared(problem.predictor)
    assert problem.prepared(Innovation()) is there
    assert problem.prepared(Innovation(piece=7)) is there, "pieces change no number"
    assert problem.prepared(KStep(k=3)) is there, "it starts from the innovation form"


def test_a_predictor_that_cannot_be_a_key_is_refused_in_one_line():
    @dataclass
    class Loose(Freewheel):
        gain: float = 0.0

    with pytest.raises(ModelError, match="frozen=True"):
        make_problem(motor.model(), motor.record(n=50), predictor=Loose())


def test_nothing_of_a_problem_can_be_changed(problem: Problem):
    for field in dataclasses.fields(problem):
        with pytest.raises(FrozenInstanceError):
            setattr(problem, field.name, None)
    for array in (problem.base, problem.process_level, problem.sensor_level):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0
    for table in (problem.means, problem.index, problem.records, problem.unknowns):
        assert not hasattr(table, "__setitem__")
    before = problem.noise_levels(problem.start)
    before[0][:] = 7.0
    assert (problem.noise_levels(problem.start)[0] != 7.0).all(), "levels come as copies"


@pytest.mark.parametrize("record", ["estimates", "diagnostics", "provenance"])
def test_a_fit_is_three_records_and_has_their_attributes(record: str):
    found = fit(motor.model(), motor.record(n=200), initialisation="nominal")
    part = getattr(found, record)
    assert 5 < len(dataclasses.fields(part)) < 9
    for field in dataclasses.fields(part):
        assert getattr(found, field.name) is getattr(part, field.name)
    assert [f.name for f in dataclasses.fields(found)] == ["estimates", "diagnostics", "provenance"]
