"""What every command shares: nothing heavy is loaded for a help text, --quiet is quiet, shells
complete."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from greybox.cli import COMMANDS, main
from greybox.examples import flight_paths, vehicle_path

HEAVY = (
    "numpy",
    "casadi",
    "scipy",
    "matplotlib",
    "control",
    "torch",
    "gpytorch",
    "greybox.data",
    "greybox.model",
)


def test_a_help_text_loads_no_library():
    code = (
        "import sys\nfrom greybox.cli import build_parser\nbuild_parser().format_help()\n"
        f"print([m for m in {HEAVY} if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_every_command_stands_in_the_help_with_its_exit_codes(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        main(["--help"])
    text = capsys.readouterr().out
    assert all(f"    {name} " in text or f"    {name}\n" in text for name in COMMANDS)
    assert "Exit codes" in text


def arpl() -> list[str]:
    return [
        "check",
        "--vehicle",
        str(vehicle_path("arpl_crazyflie")),
        str(flight_paths("arpl_crazyflie")[0]),
    ]


def test_quiet_says_nothing_but_the_exit_code(capsys: pytest.CaptureFixture[str]):
    loud = main(arpl())
    assert capsys.readouterr().out
    assert main(["--quiet", *arpl()]) == loud
    said = capsys.readouterr()
    assert (said.out, said.err) == ("", "")


def test_quiet_still_writes_the_json_that_was_asked_for(capsys: pytest.CaptureFixture[str]):
    main(["--quiet", "effects", "motor_lag", "--json"])
    assert '"motor_lag"' in capsys.readouterr().out


def test_quiet_does_not_hide_an_error(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    assert main(["--quiet", "check", "--vehicle", str(tmp_path / "no.toml"), "no.csv"]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
def test_bash_completes_commands_and_options(tmp_path: Path):
    script = subprocess.run(
        [sys.executable, "-m", "greybox.cli", "completion", "bash"],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    (tmp_path / "greybox.bash").write_text(script)

    def complete(*words: str) -> list[str]:
        line = (
            f"source {tmp_path}/greybox.bash; COMP_WORDS=({' '.join(words)}); "
            f"COMP_CWORD={len(words) - 1}; "
            '_shtab_greybox greybox "${COMP_WORDS[COMP_CWORD]}"; echo "${COMPREPLY[@]}"'
        )
        return subprocess.run(
            ["bash", "-c", line], capture_output=True, text=True, check=True
        ).stdout.split()

    assert complete("greybox", "disc") == ["discover"]
    assert "--max-effects" in complete("greybox", "discover", "--ma")
