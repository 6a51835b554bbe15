"""Every field of every record of options refuses in one line what it is not, and takes numbers as
NumPy and Python write them; None stands for an empty container, and what is held is its own copy."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from greybox.baselines.compare_options import CompareOptions
from greybox.discovery.options import DiscoverOptions
from greybox.errors import GreyboxError
from greybox.estimation.options import FitOptions
from greybox.linear.fit import LinearSetup
from greybox.planning.limits import Limits
from greybox.planning.options import PlanOptions
from greybox.residual.options import GPOptions, LearnOptions
from greybox.takes import COUNT, NATURAL, WHOLE, WHOLES
from greybox.validation.options import ValidateOptions
from mpc_export.options import ExportOptions

RECORDS = (
    CompareOptions,
    DiscoverOptions,
    ExportOptions,
    FitOptions,
    GPOptions,
    LearnOptions,
    Limits,
    LinearSetup,
    PlanOptions,
    ValidateOptions,
)
FIELDS = [(record, f) for record in RECORDS for f in dataclasses.fields(record)]
WRONG = (object(), [object()], {"a": object()}, b"x", np.zeros((2, 2)))


def _named(part: type | dataclasses.Field) -> str:
    return part.__name__ if isinstance(part, type) else part.name


@pytest.mark.parametrize(("record", "field"), FIELDS, ids=_named)
def test_what_a_field_is_not_is_refused_by_its_name(record, field):
    for wrong in WRONG:
        with pytest.raises(GreyboxError, match=field.name) as refused:
            record(**{field.name: wrong})
        assert "\n" not in str(refused.value)


@pytest.mark.parametrize(("record", "field"), FIELDS, ids=_named)
def test_a_number_without_dimensions_is_a_number(record, field):
    default = getattr(record(), field.name)
    if isinstance(default, bool) or not isinstance(default, int | float):
        pytest.skip("no number")
    made = getattr(record(**{field.name: np.array(default)}), field.name)
    assert isinstance(made, type(default)) or isinstance(default, type(made))
    assert made == default


@pytest.mark.parametrize(("record", "field"), FIELDS, ids=_named)
def test_none_stands_for_an_empty_container_and_values_are_copied(record, field):
    if field.default_factory is dataclasses.MISSING:
        pytest.skip("no container")
    assert getattr(record(**{field.name: None}), field.name) == {}
    given = {"a": (1.0, 2.0) if "prior" in field.name else np.array(1.0)}
    made = getattr(record(**{field.name: given}), field.name)
    assert made == given and made is not given


def test_a_whole_number_is_one_thing_everywhere():
    for kind in (WHOLE, COUNT, NATURAL):
        for taken in (8, np.int64(8), np.array(8)):
            assert kind.taken("n", taken) == 8
        for refused in (8.0, True, "8", np.array([8])):
            with pytest.raises(GreyboxError, match="n takes a whole number"):
                kind.taken("n", refused)
    assert WHOLES.taken("n", np.arange(3)) == (0, 1, 2)


def test_an_effort_in_words_is_refused():
    with pytest.raises(
        GreyboxError, match=r"effort takes an Effort; got 'more'. Usual fix: .*Effort\("
    ):
        DiscoverOptions(effort="more")


def test_a_record_of_a_subclass_may_have_fields_of_its_own() -> None:
    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Mine(FitOptions):
        extra: list[int] = dataclasses.field(default_factory=list)

    assert Mine(extra=[1]).extra == [1]
    with pytest.raises(GreyboxError):
        Mine(extra=[1], starts="many")  # type: ignore[arg-type]
