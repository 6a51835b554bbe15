"""What a flight shows by itself is found once, however often and beside whom it is reported, and
every report is the one that it would be alone."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import pytest

from greybox.data.checks import Checked, kinematics
from greybox.data.checks.view import View
from tests.data.faults import real, vehicle

SET = "nanobench"
NAMES = ("B7_oval_medium_rep2", "B5_helix_medium_rep2")


def test_reports_of_flights_that_are_asked_again_are_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    judged, of_streams = Counter[tuple[str, str]](), kinematics._of_streams

    def counted(
        relation: kinematics.Relation, view: View, streams: kinematics.Streams
    ) -> kinematics.Related | str:
        judged[relation.name, view.name] += 1
        return of_streams(relation, view, streams)

    monkeypatch.setattr(kinematics, "_of_streams", counted)
    craft = vehicle(SET)
    file = replace(craft, rotors=tuple(replace(r, spin=-r.spin) for r in craft.rotors))
    own, other = (real(SET, n) for n in NAMES)
    kept = Checked.of([other], file, asked_again=True)
    once, beside = Checked.of([other], file).report(), Checked.of([other], file)
    joint = Checked.of([own], file).report(beside=beside)
    judged.clear()
    assert Checked.of([own], file).report(beside=kept).to_dict() == joint.to_dict()
    assert kept.report().to_dict() == once.to_dict()
    assert kept.report().to_dict() == once.to_dict()
    assert joint.blocking
    assert judged
    assert set(judged.values()) == {1}
