"""`greybox discover --continue`: the names of an earlier search, judged by further flights."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from greybox.discovery.document import DiscoveryDocument

from greybox.commands.console import Console
from greybox.commands.flight_logs import read_flight_logs
from greybox.commands.judgement import log_faults, refuse_faults


def go_on(arguments: argparse.Namespace) -> int:
    """Multiply the evidence of the names of an earlier search by that of further flights."""
    from greybox.discovery.further import further
    from greybox.errors import GreyboxError
    from greybox.files import read_json, withdraw, write_atomic, write_json
    from greybox.model.effects_file import load_effects
    from greybox.model.identified import IdentifiedModel
    from greybox.model.layer import physics_of
    from greybox.report.discover_report import discover_report
    from greybox.residual.laws.effect_file import WITH_LAWS, set_aside_laws

    if any((arguments.vehicle, arguments.since, arguments.model_file)):
        raise GreyboxError(
            "--continue goes on with its own model",
            fix="leave --vehicle, --model-file and --from out",
        )
    folder, logs = Path(arguments.folder), [*arguments.train, *arguments.test]
    if not logs:
        raise GreyboxError("--continue needs further flights", fix="--train LOGS or --test LOGS")
    content: DiscoveryDocument = read_json(folder / "discovery.json")
    files = [*content.get("effects_files", ()), *arguments.effects_file]
    own = [e for path in files for e in load_effects(path)]
    model = IdentifiedModel.load(folder / "model.json", effects=own)
    if physics_of(model.dynamics) is None:
        raise GreyboxError(
            "--continue is for vehicles",
            got=f"the model {model.name} of your own",
            fix="greybox discover --from model.json --train LOGS",
        )
    rate = arguments.rate or 1 / model.sample_time
    faults = log_faults(arguments, model.physics.vehicle)
    if not faults.ok:
        return refuse_faults(faults, Console.of(arguments), "judging names by these flights")
    data = read_flight_logs(arguments, logs, model.physics.vehicle, rate=rate)
    content = further(content, model, data, own)
    out = Path(arguments.out or folder)
    withdraw(out, "report.html")
    if out != folder:
        withdraw(out, "discovery.json", "model.json", WITH_LAWS)
        set_aside_laws(out, {})
        write_atomic(out / "model.json", (folder / "model.json").read_bytes())
    write_json(out / "discovery.json", content)
    title = f"What the model of {model.physics.vehicle.name} misses"
    write_atomic(out / "report.html", discover_report(content, title=title))
    names = (
        f"  {e['name']}: {e['status']}, log10 e {e['log10_e']:.1f} ({e.get('further', 0.0):+.1f} "
        "by these flights)"
        for e in (*content["effects"], *content["not_certified"])
    )
    Console.of(arguments).result(
        content, content["line"], *names, f"wrote discovery.json and report.html in {out}"
    )
    return 0
