"""The grid of the discovery judges as it says, resumes where it was, and its intervals are
Wilson's."""

from __future__ import annotations

import gzip
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from greybox.discovery.result import Discovery
from greybox.plants.effects import MotorLag, RotorAsymmetry
from greybox.plants.presets import X250
from scenarios.studies import discovery_grid
from scenarios.studies.discovery_cells import Cell, cases, scaled
from scenarios.studies.discovery_summary import (
    confusion,
    false_names,
    recall,
    summary,
    wilson,
    write_docs,
)


def found(*names: str, groups: Sequence[tuple[str, ...]] = (), verdict: str = "named") -> Discovery:
    sets = [{"candidates": [{"name": n, "weight": 0.5} for n in g]} for g in groups]
    return cast(
        Discovery,
        SimpleNamespace(
            fit=True,
            effects=lambda: [{"name": n} for n in names],
            ambiguous=lambda: sets,
            verdict=verdict,
        ),
    )


@pytest.mark.parametrize(
    ("result", "truth", "verdict"),
    [
        (found("a"), ("a",), "right"),
        (found("a", "b"), ("a",), "extra"),
        (found("b"), ("a",), "wrong"),
        (found("b"), (), "wrong"),
        (found(verdict="nothing_missing"), (), "right"),
        (found(verdict="unnamed"), (), "silent"),
        (found(verdict="nothing_missing"), ("a",), "silent"),
        (found(groups=[("a", "b")]), ("a",), "group"),
        (found(groups=[("b", "c")]), ("a",), "wrong"),
        (found(groups=[("b", "c")]), (), "wrong"),
        (found("a", groups=[("b", "c")]), ("a", "b"), "group"),
        (found("a"), ("a", "b"), "part"),
        (found("a", groups=[("b+c", "d")]), ("a", "b", "c"), "group"),
    ],
)
def test_verdicts(result: Discovery, truth: tuple[str, ...], verdict: str):
    assert discovery_grid.judge(result, truth) == verdict


def test_wilson_intervals_have_their_textbook_values():
    low, high = wilson(0, 10)
    assert low == 0.0
    assert high == pytest.approx(0.2775, abs=1e-3)
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=1e-3)


def test_sizes_scale_every_parameter_and_nothing_else():
    for name, effects in cases(X250).items():
        for e in effects:
            twice = scaled(e, 2.0)
            assert {k: 2 * v for k, v in e.parameters().items()} == pytest.approx(
                twice.parameters()
            ), name
    assert scaled(MotorLag(tau=0.04), 0.5) == MotorLag(tau=0.02)
    assert (
        scaled(RotorAsymmetry(delta=(0.1, -0.1, 0, 0)), 2.0).parameters()["rotor_asymmetry.delta_2"]
        == -0.2
    )


def row(
    judged: str,
    hidden: Sequence[str] = (),
    names: Sequence[str] = (),
    seed: int = 1000,
    **more: Any,
) -> dict[str, Any]:
    cell = Cell(hidden=tuple(hidden))
    return {
        **cell.to_dict(),
        "kind": cell.kind,
        "seed": seed,
        "in_noise": 1.0 if hidden else None,
        "judged": judged,
        "effects": {n: {"k": [1.01, 0.02]} for n in names},
        "truth": {f"{n}.k": 1.0 for n in hidden},
        "log10_e": dict.fromkeys(names, 5.0),
        "ambiguous": [],
        "unnamed": [],
        "closed": None,
        "took": 1.0,
        "verdict": "named",
        **more,
    }


def test_a_false_name_on_clean_flights_counts_at_the_level_of_its_e_value():
    wrong = row("wrong", names=["a"], log10_e={"a": 3.0})
    assert false_names(wrong, 0.05)
    assert not false_names(wrong, 0.01)
    assert not false_names(row("right"), 0.05)
    assert false_names(row("wrong", ambiguous=[{"a": 0.5, "b": 0.5}]), 0.01)


def test_recall_and_precision_count_members_of_groups():
    rows = [
        row("extra", ("a", "b"), ("a", "c")),
        row("group", ("a", "b"), ("a",), ambiguous=[{"b": 0.6, "d": 0.4}]),
    ]
    assert recall(rows) == [
        "pair: recall 3/4 = 75.0 % (30.1-95.4), precision 3/4 = 75.0 % (30.1-95.4)",
    ]


def test_confusion_counts_every_single_effect_once():
    rows = [
        row("right", ("a",), ("a",)),
        row("wrong", ("a",), ("b",)),
        row("silent", ("b",)),
        row("group", ("b",)),
    ]
    hidden, said, counts = confusion(rows)
    assert hidden == ["a", "b"]
    assert counts.sum() == 4
    assert counts[0, said.index("b")] == 1
    assert counts[1, said.index("(silent)")] == counts[1, said.index("(group)")] == 1


def test_a_grid_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    asked: list[int] = []

    def run(cell: Cell, seeds: Sequence[int]) -> Iterator[dict[str, Any]]:
        for s in seeds:
            asked.append(s)
            yield row("right", seed=s)

    monkeypatch.setattr(discovery_grid, "run", run)
    out = tmp_path / "grid.jsonl"
    discovery_grid.main(["--out", str(out), "--seeds", "1000:1003"])
    with out.open("a") as stream:
        stream.write('{"seed": 10')  # cut off in the middle of a line
    discovery_grid.main(["--out", str(out), "--seeds", "1000:1005"])
    assert asked == [1000, 1001, 1002, 1003, 1004]
    assert [json.loads(line)["seed"] for line in out.read_text().splitlines() if line.endswith("}")]


def test_tables_and_figures_use_judging_seeds_only(tmp_path: Path):
    rows = [row("right", ("a",), ("a",)), row("wrong", ("a",), ("b",), seed=5), row("right")]
    assert "b" in summary(rows)
    write_docs(rows, tmp_path)
    text = (tmp_path / "discovery_results.md").read_text()
    assert "2 logs with seeds from 1000 on" in text
    assert "wrong: b" not in text
    assert (
        (tmp_path / "images" / "discovery_confusion.svg").read_text().lstrip().startswith("<?xml")
    )


def test_results_that_are_kept_can_be_summed_up_but_not_added_to(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "grid.jsonl.gz"
    out.write_bytes(gzip.compress((json.dumps(row("right", ("a",), ("a",))) + "\n").encode()))
    before = out.read_bytes()
    discovery_grid.main(["--out", str(out), "--summary"])
    assert "1/1" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="2"):
        discovery_grid.main(["--out", str(out), "--seeds", "1000"])
    assert "results that are kept can only be summed up" in capsys.readouterr().err
    assert out.read_bytes() == before
