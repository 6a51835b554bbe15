"""The table of ratios reads the benchmarks' files, and says what became slower beside its peers."""

from __future__ import annotations

import json
import platform
from pathlib import Path

import pytest

from benchmarks import ratios

RESULTS = Path(ratios.__file__).resolve().parent / "results"


@pytest.mark.parametrize("name", ["export_speed", "gp_evaluation", "innovation_fit"])
def test_the_files_of_the_benchmarks_give_positive_ratios(name: str):
    taken, _ = ratios.BENCHMARKS[name]
    found = taken(json.loads((RESULTS / f"{name}.json").read_text()))
    assert found and all(r > 0 for r in found.values())


def test_only_what_fell_by_more_than_the_share_is_said():
    before = {"a": {"peer": 10.0, "other": 4.0, "gone": 3.0}, "b": {"peer": 2.0}}
    now = {"a": {"peer": 6.9, "other": 2.9, "new": 0.1}, "c": {"peer": 1.0}}
    assert ratios.fallen(now, before) == ["a: peer: 10 -> 6.9", "a: gone: 3 -> gone"]


def test_the_committed_table_has_every_benchmark_its_date_and_machine():
    table = json.loads(ratios.COMMITTED.read_text())
    assert set(table["ratios"]) == set(ratios.BENCHMARKS)
    assert (
        len(table["date"]) == 10
        and table["machine"]["processor"]
        and table["machine"]["cores"] >= 1
    )


def test_a_kind_of_machine_is_its_name_and_its_widest_vector_unit():
    two = "model name\t: AMD EPYC\nflags\t\t: fpu sse2 avx avx2\n"
    assert ratios.kind_of(two + two.replace("avx2", "avx2 avx512f")) == "AMD EPYC, AVX2"
    assert ratios.kind_of(two.replace("avx2", "avx2 avx512f avx512dq")) == "AMD EPYC, AVX-512"
    assert ratios.kind_of("Features\t: fp asimd\n").endswith(", NEON")
    assert ratios.kind_of("") == platform.machine()


@pytest.mark.slow
def test_no_ratio_fell_since_the_table_was_written():
    assert ratios.main(["--compare"]) == 0
