"""What a journal gives back is what it was told, to the last bit; what was cut off, changed or told
of other input is asked anew, and the answers are the same."""

from __future__ import annotations

import contextlib
import errno
import json
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from greybox import journal
from greybox.errors import DataError, ModelError
from greybox.estimation.status import Code, Status
from greybox.symbolic import FloatArray

GIVEN = {"file a.csv": "1", "--alpha": "0.05"}
numbers = st.floats(width=64)
simple = st.none() | st.booleans() | st.integers(-(2**70), 2**70) | numbers | st.text()
values = st.recursive(
    simple,
    lambda inner: (
        st.tuples(inner, inner)
        | st.lists(inner, max_size=2)
        | st.dictionaries(st.text() | st.tuples(st.text()), inner, max_size=2)
        | st.frozensets(st.text(), max_size=1)
    ),
)


@dataclass(frozen=True)
class Answer:
    """A status and an array."""

    status: Status
    array: FloatArray


PARTS = (Answer, Status, Code)


@dataclass
class Asked:
    """Work that counts what it was asked: (place, question) -> answer."""

    count: int = 0

    def of(self, questions: Sequence[float]) -> list[Answer]:
        def work(places: Sequence[int]) -> Iterator[tuple[int, Answer]]:
            for k in reversed(places):
                self.count += 1
                code = Code.CONVERGED
                status = Status(code=code, iterations=k, evaluations=1, decrement=np.inf)
                yield k, Answer(status, np.outer([questions[k], 0.1], [1 / 3, -0.0]))

        return journal.answers(questions, work, Answer, PARTS)

    def story(self, path: Path, given: dict[str, str] = GIVEN, ends: bool = False) -> list[object]:
        """Three rounds of questions, of which each depends on the answers before."""
        try:
            with journal.kept_in(path, given):
                told, ask = list[object](), [1.0, 2.0]
                for _ in range(3):
                    found = self.of(ask)
                    told += [(a.status, a.array.tobytes()) for a in found]
                    ask = [float(a.array.sum()) for a in found]
                if not ends:
                    raise KeyboardInterrupt
        except KeyboardInterrupt:
            pass
        return told


with tempfile.TemporaryDirectory() as _folder:
    TOLD = Asked().story(Path(_folder) / "j")


@given(values)
def test_plain_values_come_back_to_the_last_bit(value: object) -> None:
    content = json.loads(json.dumps(journal.plain(value)))
    assert repr(journal.restored(content, {})) == repr(value)


@given(arrays(np.float64, array_shapes(min_dims=1, max_dims=2, max_side=5)), st.booleans())
def test_arrays_come_back_to_the_last_bit(value: FloatArray, mirrored: bool) -> None:
    if mirrored and value.ndim == 2:
        size = min(value.shape)
        value = np.where(np.tri(size, dtype=bool), value[:size, :size], value[:size, :size].T)
    back = journal.restored(json.loads(json.dumps(journal.plain(value))), {})
    assert back.shape == value.shape
    assert back.tobytes() == value.tobytes()


def test_what_is_there_is_not_asked_again(tmp_path: Path) -> None:
    first, second, third = Asked(), Asked(), Asked()
    assert first.story(tmp_path / "j") == TOLD
    assert second.story(tmp_path / "j", ends=True) == TOLD
    assert (first.count, second.count) == (6, 0)
    assert not (tmp_path / "j").exists()
    assert third.story(tmp_path / "j") == TOLD
    assert third.count == 6


@settings(max_examples=60)
@given(st.integers(0, 10_000), st.booleans(), st.integers(0, 255))
def test_a_line_that_is_cut_or_changed_counts_as_not_there(at: int, cut: bool, byte: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path, again = Path(folder) / "j", Asked()
        Asked().story(path)
        text = bytearray(path.read_bytes())
        at %= len(text)
        if cut:
            del text[at:]
        else:
            text[at] = byte
        path.write_bytes(text)
        assert again.story(path) == TOLD
        lines = [text[:at].count(b"\n"), 6]
        # What stands before the place is not asked again, nor what stands behind a changed line.
        if lines[0] > 0:
            assert again.count <= (7 - lines[0] if cut else 2)
            last = Asked()
            assert last.story(path) == TOLD
            assert last.count == 0


@pytest.mark.parametrize("other", [{**GIVEN, "--alpha": "0.01"}, {"file a.csv": "1"}])
def test_other_input_is_said_and_starts_anew(tmp_path: Path, other: dict[str, str]) -> None:
    path, again = tmp_path / "j", Asked()
    Asked().story(path)
    assert "other input (--alpha)" in journal.Journal(path, other).going_on
    assert again.story(path, other) == TOLD
    assert again.count == 6
    assert "after 6 fits" in journal.Journal(path, other).going_on


def test_a_journal_of_another_version_is_said_to_be_one_and_starts_anew(tmp_path: Path) -> None:
    path, again = tmp_path / "j", Asked()
    Asked().story(path)
    path.write_text(path.read_text().replace(journal.SCHEMA, "greybox.journal/0", 1))
    assert "another version of greybox" in journal.Journal(path, GIVEN).going_on
    assert again.story(path) == TOLD
    assert again.count == 6
    assert "after 6 fits" in journal.Journal(path, GIVEN).going_on


def test_an_answer_of_another_kind_counts_as_not_there(tmp_path: Path) -> None:
    def ask(answer: object) -> list[object]:
        with contextlib.suppress(KeyboardInterrupt), journal.kept_in(tmp_path / "j", GIVEN):
            told.extend(journal.answers(["a"], lambda _: [(0, answer)], type(answer)))
            raise KeyboardInterrupt
        return told[-1:]

    told = list[object]()
    assert [ask("1"), ask("2"), ask(2.0), ask(3.0)] == [["1"], ["1"], [2.0], [2.0]]


@pytest.mark.parametrize("text", ["my notes\n", "{}\n", "[" * 5000, '{"schema": 3}\n', "\xff\0\n"])
def test_what_is_no_journal_stays_as_it_is(tmp_path: Path, text: str) -> None:
    path, work = tmp_path / "j", Asked()
    path.write_text(text, encoding="latin-1")
    assert "no journal" in journal.Journal(path, GIVEN).going_on
    assert work.story(path, ends=True) == TOLD
    assert path.read_text(encoding="latin-1") == text


def test_a_full_disk_stops_no_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "no space")

    monkeypatch.setattr(journal, "append_json_line", full)
    assert Asked().story(tmp_path / "j") == TOLD
    monkeypatch.setattr(journal, "write_atomic", full)
    assert Asked().story(tmp_path / "k") == TOLD


def test_what_cannot_be_kept_is_asked_again(tmp_path: Path) -> None:
    asked = list[int]()

    def work(places: Sequence[int]) -> Iterator[tuple[int, object]]:
        for k in places:
            asked.append(k)
            yield k, (object if k else 1.0)

    for _ in range(2):
        with contextlib.suppress(KeyboardInterrupt), journal.kept_in(tmp_path / "j", GIVEN):
            assert journal.answers(["a", "b"], work, object) == [1.0, object]
            assert journal.answers(["c"], work, object) == [1.0]
            raise KeyboardInterrupt
    assert asked == [0, 1, 0, 1]


def test_time_is_spared_once_where_an_answer_asked_in_its_turn(tmp_path: Path) -> None:
    def inner(places: Sequence[int]) -> Iterator[tuple[int, float]]:
        for k in places:
            time.sleep(0.2)
            yield k, 1.0

    def outer(places: Sequence[int]) -> Iterator[tuple[int, float]]:
        for k in places:
            with journal.apart("shared"):
                yield k, journal.answers(["fit"], inner, float)[0]

    with contextlib.suppress(KeyboardInterrupt), journal.kept_in(tmp_path / "j", GIVEN):
        journal.answers(["method"], outer, float)
        raise KeyboardInterrupt
    with journal.kept_in(tmp_path / "j", GIVEN):
        journal.answers(["method"], outer, float)
        with journal.apart("shared"):
            journal.answers(["fit"], inner, float)
        assert 0.2 <= journal.spared() < 0.4


@pytest.mark.parametrize("error", [DataError("too short"), ModelError("not finite"), OSError()])
def test_what_is_refused_would_be_refused_again_and_leaves_nothing(
    error: Exception, tmp_path: Path
) -> None:
    with contextlib.suppress(type(error)), journal.kept_in(tmp_path / "out" / "j", GIVEN):
        assert len(Asked().of([1.0, 2.0])) == 2
        raise error
    assert (tmp_path / "out" / "j").exists() is isinstance(error, OSError)
    assert (tmp_path / "out").exists() is isinstance(error, OSError)


def test_without_a_journal_nothing_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    work = Asked()
    assert len(work.of([1.0, 2.0])) == 2 and len(work.of([1.0, 2.0])) == 2
    assert work.count == 4
    assert journal.spared() == 0.0
    assert not list(tmp_path.iterdir())
