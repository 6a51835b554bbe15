"""The folder of `greybox discover`: files that are whole after every step of a search."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from greybox.data.checks import CheckReport
    from greybox.discovery.document import DiscoveryDocument
    from greybox.discovery.result import Discovery
    from greybox.model.effect import Effect

from greybox.commands.collector import nothing_collected
from greybox.commands.command_line import typed
from greybox.commands.judgement import next_of_faults


class SearchFolder:
    """The folder of a search: what it wrote so far (`written`: discovery.json), rewritten after
    every step."""

    def __init__(
        self, out: Path, title: str, offered: Mapping[str, Sequence[Effect]], faults: CheckReport
    ) -> None:
        self.written: DiscoveryDocument | None = None
        self._out, self._title, self._offered, self.faults = out, title, offered, faults
        self._began = False

    def write(self, found: Discovery) -> None:
        """Write what is found. The result comes last: until then it says that the search was
        stopped."""
        from greybox.discovery.result import write_found
        from greybox.files import withdraw
        from greybox.residual.laws.effect_file import WITH_LAWS

        out, content = self._out, found.to_dict()
        first, told = self.warnings()
        content["warnings"] = [*first, *content["warnings"], *told]
        content["command"] = typed("discover")
        has = () if found.fit is None else found.model.effects
        content["effects_files"] = [
            path for path, effects in self._offered.items() if {e.name for e in effects} & set(has)
        ]
        self.written = content
        withdraw(out, "report.html")
        if not self._began and found.fit is not None:
            withdraw(out, "discovery.json", WITH_LAWS)
            self._began = True
        write_found(found, out, content)

    def warnings(self) -> tuple[list[str], list[str]]:
        """What the flights were searched in spite of: (faults that were accepted, warnings)."""
        return self.faults.accepted_lines(), self.faults.warning_lines()

    @property
    def content(self) -> DiscoveryDocument:
        """discovery.json as it was written last."""
        assert self.written is not None
        return self.written

    def page(self) -> None:
        """Write report.html of what is found so far."""
        from greybox.files import write_atomic
        from greybox.report.discover_report import discover_report

        with nothing_collected():
            page = discover_report(self.content, title=self._title)
        write_atomic(self._out / "report.html", page)

    def kept(self) -> str:
        """What an interrupted search leaves, with its page; "" for nothing."""
        if self.written is None:
            return ""
        self.page()
        return f"what was found until then, not judged, is in {self._out}"

    def lines(self, found: Discovery) -> list[str]:
        """The result for people, and what was written."""
        from greybox.model.layer import physics_of
        from greybox.residual.laws.effect_file import WITH_LAWS

        lines, laws = found.summary().splitlines(), list(found.proposals())
        first = 1 + len(found.faults)
        lines[first:first] = [f"warning: {w}" for some in self.warnings() for w in some]
        lines += [] if self.faults.ok else [next_of_faults(self.faults)]
        written = ["discovery.json", *(["model.json"] if found.fit is not None else []), *laws]
        if found.lawful is not None:
            written.append(WITH_LAWS)
            own = physics_of(found.lawful.dynamics) is None
            files = [*self.content["effects_files"], *(str(self._out / name) for name in laws)]
            more = "" if own else f" --effects-file {shlex.join(files)}"
            model = shlex.quote(str(self._out / WITH_LAWS))
            lines.append(f"what laws leave: greybox learn {model}{more} --train ...")
        return [*lines, f"wrote {', '.join(written)} and report.html in {self._out}"]
