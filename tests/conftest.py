"""Settings of all tests, and which of them are long."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# A busy machine is no fault of what is tested: speed is measured in benchmarks/.
settings.register_profile(
    "any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("any machine")

LONG = (
    "automatic/",
    "baselines/",
    "claims/",
    "cli/",
    "discovery/",
    "docs/test_documentation_runs.py",
    "estimation/test_no_fit_ends_in_an_impossible_body.py",
    "estimation/test_solvers_reach_the_same_optimum.py",
    "hardening/test_hostile_files_cannot_eat_the_memory.py",
    "linear/test_linear_command.py",
    "mpc_export/",
    "report/test_pages_work_in_a_real_browser.py",
    "residual/test_gp_posterior_equals_gpytorch.py",
    "scenarios/test_effects_outside_the_catalogue_act_and_vanish.py",
    "simulators/",
)
"""Folders and files that take many seconds (`python -m pytest --durations=0 PATH` tells them): whole
commands, fits, searches, exports and flights. `make test` leaves them to `make test-long`.

Both together are the gate, which takes less than fifteen minutes on two cores: a claim has its most
telling small case there, and what varies it is marked `slow`."""


def is_long(path: Path) -> bool:
    """Whether a test file belongs to `make test-long`."""
    folder = Path(__file__).parent
    return path.is_relative_to(folder) and path.relative_to(folder).as_posix().startswith(LONG)


def pytest_addoption(parser: pytest.Parser) -> None:
    """`--part`: without it all tests are run."""
    parser.addoption("--part", choices=("quick", "long"), help="run one part of the tests only")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Files of the other part are not even imported."""
    part = config.getoption("--part")
    if part is None or not collection_path.is_file():
        return None
    return True if is_long(collection_path) != (part == "long") else None
