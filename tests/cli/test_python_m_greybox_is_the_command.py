"""`python -m greybox` is the command, for those whose scripts folder is not on the path."""

from __future__ import annotations

import subprocess
import sys


def test_python_m_greybox_is_the_command():
    said = subprocess.run(
        [sys.executable, "-m", "greybox", "--version"], capture_output=True, text=True, check=True
    )
    assert said.stdout.startswith("greybox ")
    wrong = subprocess.run(
        [sys.executable, "-m", "greybox", "nonsense"], capture_output=True, text=True, check=False
    )
    assert wrong.returncode == 2
