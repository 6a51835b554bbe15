"""Sections of the page of a discovery beside the names: what only the sensors do, and what each
flight says alone."""

from __future__ import annotations

from collections.abc import Sequence

from greybox.discovery.document import DiscoveryDocument
from greybox.estimation.noise_table import SensorRow
from greybox.report.html import Cell, Report
from greybox.report.words import number

KINDS = {
    "coloured": "correlated noise",
    "line": "a line in the spectrum",
    "low_pass": "a low-pass filter",
    "delay": "a delay",
    "drift": "a drifting bias",
}
UNITS = {
    "T": ("time constant", "s"),
    "cutoff": ("cut-off", "Hz"),
    "frequency": ("frequency", "Hz"),
    "delay": ("delay", "s"),
}
ADVICE = {
    "low_pass": "log the IMU with a higher cut-off; what would look like a slower rotor is the "
    "filter.",
    "line": "a line is a vibration or its alias: balance the rotors, mount the IMU softly, or log "
    "it faster.",
    "delay": "compare it with the data sheet of the tracking system or with the time stamps.",
    "coloured": "correlated noise makes naive error bars too small; those of this page allow for "
    "it.",
    "drift": "let the sensor warm up, or leave the bias free per flight.",
}


def sensors_section(report: Report, content: DiscoveryDocument) -> None:
    """One row per sensor and kind of `content["sensors"]` that is not white; nothing where all
    are."""
    rows = [s for s in content.get("sensors", ()) if s["kind"] != "white"]
    if not rows:
        return
    report.section("What only the sensors do")
    report.paragraph(
        "These are not forces or torques: each stays in the channels of its sensor, while a force "
        "or torque reaches every channel that the motion couples. They are part of the noise that "
        "the names above were tested against."
    )
    groups: dict[tuple[str, str], list[SensorRow]] = {}
    for s in rows:
        groups.setdefault((s["channel"].split(".")[0], s["kind"]), []).append(s)
    cells: list[list[Cell]] = [
        [", ".join(s["channel"] for s in members), KINDS[kind], _numbers(members)]
        for (_, kind), members in groups.items()
    ]
    report.table(["channels", "what", "estimates"], cells)
    report.bullets([f"{KINDS[k]}: {ADVICE[k]}" for k in dict.fromkeys(s["kind"] for s in rows)])


def _numbers(members: Sequence[SensorRow]) -> str:
    out = []
    for key, (word, unit) in UNITS.items():
        found = (s["parameters"].get(key) for s in members)
        values = [float(v) for v in found if v is not None]
        if values:
            low, high = number(min(values), 3), number(max(values), 3)
            out.append(f"{word} {low if low == high else f'{low} to {high}'} {unit}")
    sizes = [float(v) for s in members if (v := s["parameters"].get("sigma"))]
    if sizes:
        low, high = number(min(sizes), 3), number(max(sizes), 3)
        out.append(f"standard deviation {low if low == high else f'{low} to {high}'}")
    return "; ".join(out)
