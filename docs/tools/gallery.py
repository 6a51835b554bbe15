"""The gallery: every report from shipped data, and one picture of each by headless Chromium.

    python -m docs.tools.gallery --out gallery_out [--only fit,plan] [--pictures docs/images]

Minutes a report (`mpc` four, `discover` and `learn` about two on a calm machine). A report that is
there is not made again. Pictures need Chromium, its driver and selenium (the extra `test`).
"""

from __future__ import annotations

import argparse
import io
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from greybox.examples import ROOT

FLIGHTS = ("B2_circle_fast_rep1", "B3_figure8_slow_rep1", "B3_figure8_fast_rep1")
FIT = (
    "greybox.cli fit --vehicle vehicle.toml --train B2_circle_fast_rep1.csv.gz "
    "B3_figure8_slow_rep1.csv.gz --test B3_figure8_fast_rep1.csv.gz --out fit"
)
LARGEST = 150_000
"""Bytes of a picture."""


@dataclass(frozen=True)
class Page:
    """How a report is made, where it is, and the heading above the figure that the picture shows
    (none: the first)."""

    command: str
    report: str
    heading: str


PAGES = {
    "fit": Page(FIT, "fit/report.html", "How far ahead it predicts"),
    "plan": Page(
        "greybox.cli plan --model fit/model.json --for rotational_damping,blade_flapping --out "
        "plan",
        "plan/report.html",
        "What to fly",
    ),
    "discover": Page(
        "scenarios.studies.discovery_story --only one --out story",
        "story/one/report.html",
        "How far the gap closed",
    ),
    "learn": Page(
        "greybox.cli learn fit/model.json --train B2_circle_fast_rep1.csv.gz "
        "B3_figure8_slow_rep1.csv.gz --test B3_figure8_fast_rep1.csv.gz --out learn",
        "learn/report.html",
        "",
    ),
    "mpc": Page(
        "mpc_export.mission.demo --out mpc",
        "mpc/report.html",
        "How near the limits every controller came",
    ),
}


def make(name: str, out: Path) -> Path:
    """Make a report unless it is there. Raises `subprocess.CalledProcessError`."""
    page = PAGES[name]
    if not (out / page.report).exists():
        done = subprocess.run([sys.executable, "-m", *page.command.split()], cwd=out, check=False)
        if done.returncode not in (0, 1):
            raise subprocess.CalledProcessError(done.returncode, done.args)
    return out / page.report


def picture(browser: Any, report: Path, heading: str, target: Path) -> None:
    """The figure below a heading, as a PNG of at most `LARGEST` bytes: fewer colours, then a
    smaller size."""
    from PIL import Image

    browser.get(report.resolve().as_uri())
    place = (
        f"//h2[normalize-space()='{heading}']/following::figure[1]" if heading else "(//figure)[1]"
    )
    shot = Image.open(io.BytesIO(browser.find_element("xpath", place).screenshot_as_png)).convert(
        "RGB"
    )
    shot = shot.crop((0, 0, shot.width, min(shot.height, shot.width)))
    for share in (1.0, 0.8, 0.6, 0.4):
        size = (round(share * shot.width), round(share * shot.height))
        stream = io.BytesIO()
        shot.resize(size, Image.Resampling.LANCZOS).quantize(64).save(stream, "png", optimize=True)
        if stream.tell() <= LARGEST:
            break
    target.write_bytes(stream.getvalue())


def open_browser(profile: Path) -> Any:
    """Headless Chromium, 900 pixels wide."""
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = str(shutil.which("chromium"))
    for flag in (
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--window-size=900,2400",
        "--hide-scrollbars",
        f"--user-data-dir={profile}",
    ):
        options.add_argument(flag)
    return webdriver.Chrome(
        options=options, service=webdriver.ChromeService(str(shutil.which("chromedriver")))
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Make the reports and, where asked, their pictures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("gallery_out"))
    parser.add_argument("--only", default=",".join(PAGES))
    parser.add_argument("--pictures", type=Path, help="folder for the pictures")
    arguments = parser.parse_args(argv)
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name in (*(f"{f}.csv.gz" for f in FLIGHTS), "vehicle.toml"):
        shutil.copyfile(ROOT / "nanobench" / name, arguments.out / name)
    reports = {name: make(name, arguments.out) for name in arguments.only.split(",")}
    if arguments.pictures is not None:
        browser = open_browser(arguments.out.resolve() / "browser")
        try:
            for name, report in reports.items():
                picture(
                    browser, report, PAGES[name].heading, arguments.pictures / f"gallery_{name}.png"
                )
        finally:
            browser.quit()
    for name, report in reports.items():
        print(f"{name}: {report}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
