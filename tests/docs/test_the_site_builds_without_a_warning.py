"""The documentation becomes a site with search: no dead link, no page left out, nothing from a
network."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.skipif(importlib.util.find_spec("mkdocs") is None, reason="mkdocs is not installed")
def test_the_site_builds_strictly_and_stands_alone(tmp_path: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "mkdocs",
        "build",
        "--strict",
        "--quiet",
        "--site-dir",
        str(tmp_path / "site"),
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    site, docs = tmp_path / "site", ROOT / "docs"
    pages = {p.relative_to(site).with_suffix("") for p in site.rglob("*.html")}
    assert {p.relative_to(docs).with_suffix("") for p in docs.rglob("*.md")} - {
        Path("README")
    } <= pages
    loaded = re.compile(r'<(?:script|link|img)\b[^>]*(?:src|href)="(https?:[^"]*)"')
    for page in site.rglob("*.html"):
        assert loaded.findall(page.read_text(encoding="utf-8")) == []
    assert (site / "search" / "search_index.json").stat().st_size > 100_000
