"""Wheel and sdist, built from what git knows, install and run outside the tree: Python 3.11 to
3.13, old and new versions.

`make test-releases` (about three minutes an environment; asks PyPI). Pythons are looked for in
PYTHONS (paths, separated by blanks or colons), PATH and pyenv; one that is absent is listed as
skipped. PyTorch (the extra `gp`) is not installed here: it is 500 MB, and `make test` has it on
Python 3.11.
"""

from __future__ import annotations

import fnmatch
import functools
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SMOKE = Path(__file__).with_name("smoke.py")
WRITERS = ROOT / "tests" / "data" / "readers" / "writers.py"
PACKAGES = ("greybox", "mpc_export")
VERSIONS = ("3.11", "3.12", "3.13")
LARGEST_WHEEL = 9 * 10**6
"""Bytes; six of the eight million are example flights."""
SETTINGS = {
    "lowest": ("whl", ["-c", str(ROOT / "constraints-lowest.txt")]),
    "highest": ("whl", []),
    "tested": ("tar.gz", ["-c", str(ROOT / "constraints.txt")]),
}
"""Name -> (what is installed, versions of what it needs)."""


def _version(python: str) -> str:
    try:
        done = subprocess.run(
            [python, "-c", "import sys, venv; print('%d.%d' % sys.version_info[:2])"],
            capture_output=True,
            text=True,
            check=False,
            timeout=30,
        )
    except OSError:
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


@functools.cache
def pythons() -> dict[str, str]:
    """Version -> interpreter, of those that are there."""
    asked = re.split(r"[\s:]+", os.environ.get("PYTHONS", "").strip())
    pyenv = sorted((Path.home() / ".pyenv" / "versions").glob("3.*/bin/python"))
    found: dict[str, str] = {}
    for candidate in (*asked, sys.executable, *(f"python{v}" for v in VERSIONS), *map(str, pyenv)):
        if candidate and (version := _version(candidate)):
            found.setdefault(version, candidate)
    return found


def tracked() -> list[str]:
    """Files of the packages, as git has them."""
    done = subprocess.run(
        ["git", "ls-files", *PACKAGES], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if done.returncode != 0 or not done.stdout:
        pytest.skip("no git checkout")
    return done.stdout.split("\n")[:-1]


@pytest.fixture(scope="session")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the wheel, built from the sdist, and the sdist."""
    folder = tmp_path_factory.mktemp("release")
    for name in (*tracked(), "pyproject.toml", "README.md", "LICENSE"):
        (folder / "tree" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, folder / "tree" / name)
    python = folder / "builder" / "bin" / "python"
    subprocess.run([sys.executable, "-m", "venv", str(folder / "builder")], check=True)
    subprocess.run([str(python), "-m", "pip", "install", "-q", "build"], check=True)
    subprocess.run(
        [str(python), "-m", "build", "-o", str(folder), str(folder / "tree")],
        check=True,
        capture_output=True,
    )
    return folder


@pytest.mark.slow
def test_the_wheel_and_the_sdist_have_every_file_of_the_packages(built: Path) -> None:
    (wheel,), (sdist,) = built.glob("*.whl"), built.glob("*.tar.gz")
    expected = set(tracked())
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        assert {n for n in names if ".dist-info/" not in n} == expected
        assert {n.partition("/")[0] for n in names if ".dist-info/" not in n} == set(PACKAGES)
        (licence,) = (n for n in names if n.endswith(".dist-info/licenses/LICENSE"))
        assert archive.read(licence) == (ROOT / "LICENSE").read_bytes()
    assert wheel.stat().st_size < LARGEST_WHEEL
    with tarfile.open(sdist) as tar:
        assert expected <= {n.partition("/")[2] for n in tar.getnames()}


@pytest.mark.slow
@pytest.mark.parametrize("settings", SETTINGS)
@pytest.mark.parametrize("version", VERSIONS)
def test_it_installs_and_runs(version: str, settings: str, built: Path, tmp_path: Path) -> None:
    if version not in pythons():
        pytest.skip(f"no Python {version} here: name one in PYTHONS")
    kind, versions = SETTINGS[settings]
    (archive,) = built.glob(f"*.{kind}")
    python = tmp_path / "venv" / "bin" / "python"
    clean = {
        k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV", "PYTHONHOME")
    }
    subprocess.run(
        [pythons()[version], "-m", "venv", str(tmp_path / "venv")], check=True, env=clean
    )
    install = [str(python), "-m", "pip", "install", "-q", "--disable-pip-version-check", *versions]
    subprocess.run([*install, f"{archive}[logs,completion]"], check=True, env=clean, timeout=3600)
    subprocess.run([str(python), "-m", "pip", "check"], check=True, env=clean)
    away = tmp_path / "away"
    away.mkdir()
    done = subprocess.run(
        [str(python), str(SMOKE), str(ROOT / "README.md"), str(WRITERS)],
        cwd=away,
        env=clean,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
        timeout=3600,
    )
    assert done.returncode == 0, done.stdout
    said = subprocess.run(
        [str(python), "-m", "pip", "list"], capture_output=True, text=True, check=True, env=clean
    ).stdout
    names = "|".join(("casadi", "numpy", "scipy", "control", "matplotlib", "pyarrow", "rosbags"))
    print(
        f"\n{version} {settings} ({kind}):",
        ", ".join(" ".join(m) for m in re.findall(rf"^({names})\s+(\S+)", said, re.M)),
    )


def test_the_bounds_are_the_versions_that_were_tried() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    asked = dict(
        re.findall(
            r"^([\w-]+)>=([\d.]+)",
            "\n".join([*project["dependencies"], *extras["logs"], *extras["completion"]]),
            re.M,
        )
    )
    pinned: dict[str, str] = {}
    for name, version in re.findall(
        r"^([\w-]+)==([\d.]+)", (ROOT / "constraints-lowest.txt").read_text(), re.M
    ):
        pinned.setdefault(name, version)

    def whole(version: str) -> tuple[int, ...]:
        return tuple([*map(int, version.split(".")), 0, 0][:3])

    assert {n: whole(v) for n, v in asked.items()} == {n: whole(v) for n, v in pinned.items()}


def test_nothing_but_the_packages_is_installed() -> None:
    asked = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"][
        "find"
    ]
    here = [p.parent.name for p in ROOT.glob("*/__init__.py")]
    assert "scenarios" in here
    assert {
        n for n in here if any(fnmatch.fnmatch(n, pattern) for pattern in asked["include"])
    } == set(PACKAGES)


def test_example_flights_are_installed_with_licence_and_provenance() -> None:
    names = set(tracked())
    for folder in (ROOT / "greybox" / "examples").iterdir():
        if folder.is_dir() and folder.name != "__pycache__":
            for file in ("LICENSE", "README.md", "SHA256SUMS", "vehicle.toml"):
                assert (folder / file).relative_to(ROOT).as_posix() in names


def test_what_is_not_python_is_declared_as_package_data() -> None:
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"][
        "package-data"
    ]
    there = {
        str(path)
        for package, patterns in declared.items()
        for pattern in patterns
        for path in (ROOT / package).glob(pattern)
        if path.is_file()
    }
    assert [n for n in tracked() if not n.endswith(".py") and str(ROOT / n) not in there] == []
