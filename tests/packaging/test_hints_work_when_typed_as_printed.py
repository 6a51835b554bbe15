"""In an empty environment with nothing but the wheel, what "Usual fix: pip install ..." says is
typed as printed, and helps.

Typed are the hints for shell completion and for logs of PX4, Parquet and Betaflight; hints for the
other extras are not. Slow (asks PyPI; PyTorch's index for the extra `gp`). The wheel is found as a
released one would be, by its name.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.data.readers import writers
from tests.packaging.test_releases_install_and_run import built  # noqa: F401

pytestmark = pytest.mark.slow


class Installed:
    """An environment with the wheel, and what one types in it."""

    def __init__(self, folder: Path, wheels: Path) -> None:
        subprocess.run([sys.executable, "-m", "venv", str(folder / "venv")], check=True)
        self.folder = folder / "my flights, Übung"
        self.folder.mkdir()
        clean = {
            k: v
            for k, v in os.environ.items()
            if k not in ("PYTHONPATH", "VIRTUAL_ENV", "PYTHONHOME")
        }
        path = f"{folder / 'venv' / 'bin'}{os.pathsep}{clean['PATH']}"
        self.environment = {
            **clean,
            "PATH": path,
            "PIP_FIND_LINKS": str(wheels),
            "PIP_QUIET": "1",
            "PIP_DISABLE_PIP_VERSION_CHECK": "1",
        }

    def type(self, line: str) -> subprocess.CompletedProcess[str]:
        """Run a line of a shell in a folder whose name has blanks and an umlaut."""
        return subprocess.run(
            ["bash", "-c", line],
            cwd=self.folder,
            env=self.environment,
            capture_output=True,
            text=True,
            check=False,
            timeout=3000,
        )


@pytest.fixture(scope="module")
def environment(built: Path, tmp_path_factory: pytest.TempPathFactory) -> Installed:  # noqa: F811
    there = Installed(tmp_path_factory.mktemp("empty"), built)
    done = there.type("pip install greybox-sysid")
    assert done.returncode == 0, done.stderr
    return there


LOGS: dict[str, Callable[[Path, dict[str, object]], Path]] = {
    "f.ulg": writers.write_ulog,
    "f.parquet": writers.write_parquet,
    "f.bbl": writers.write_betaflight,
}


def follow(environment: Installed, line: str) -> None:
    """`line` fails with one hint; that is typed; then `line` works."""
    failed = environment.type(line)
    assert failed.returncode == 2, failed.stdout + failed.stderr
    assert "Traceback" not in failed.stderr
    (hint,) = re.findall(r"Usual fix: (pip install .*)", failed.stderr)
    typed = environment.type(hint)
    if "download.pytorch.org" in hint and "ConnectionError" in typed.stderr + typed.stdout:
        pytest.skip("the index of PyTorch cannot be reached")
    assert typed.returncode == 0, f"{hint}\n{typed.stderr}"
    done = environment.type(line)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_package_alone_has_no_scenarios_and_brings_its_flights(environment: Installed) -> None:
    assert environment.type("python -c 'import scenarios'").returncode == 1
    done = environment.type("greybox examples arpl_crazyflie && ls arpl_crazyflie")
    assert done.returncode == 0, done.stderr
    assert {"LICENSE", "README.md", "SHA256SUMS", "vehicle.toml"} <= set(done.stdout.split())


def test_a_completion_script(environment: Installed) -> None:
    follow(environment, "greybox completion bash")


@pytest.mark.parametrize("name", LOGS)
def test_logs_of_other_systems(name: str, environment: Installed) -> None:
    LOGS[name](environment.folder / name, writers.channels(rows=400))
    missing = environment.type(f"greybox inspect {name}")
    if missing.returncode == 0 and name != next(iter(LOGS)):
        return  # the extra of the format before it brought the reader of this one
    follow(environment, f"greybox inspect {name}")


def test_a_compiler_where_there_is_none(environment: Installed) -> None:
    """With an empty PATH; what the selftest prints is typed, and models run compiled."""
    alone = "PATH= ../venv/bin/python -m greybox selftest"
    before = environment.type(alone)
    assert before.returncode == 0, before.stdout + before.stderr
    (hint,) = re.findall(r"no C compiler.*\n *usual fix: (pip install \"[^\"]+\")", before.stdout)
    assert environment.type(hint).returncode == 0
    after = environment.type(alone)
    assert after.returncode == 0, after.stdout + after.stderr
    assert "(wheel ziglang)" in after.stdout
    assert re.search(r"^works +fit .*, compiled$", after.stdout, re.M)
    assert re.search(r"^works +export +the exported C and", after.stdout, re.M)
