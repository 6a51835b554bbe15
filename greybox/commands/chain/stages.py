"""The stages of the chain in their order, each as the command that a user would type."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path

from greybox.commands.chain.choice import best, best_physics, verdict_of
from greybox.commands.chain.request import Skip, SoFar, Stage, Work
from greybox.files import read_json


def _inspect(so_far: SoFar) -> Work | Skip:
    request, folder = so_far.request, so_far.folders["inspect"]
    logs = (*request.train, *request.test)
    files = tuple(folder / f"{k}.json" for k in range(1, len(logs) + 1))
    commands = tuple(
        ("inspect", log, "--vehicle", request.vehicle, *_mapping(so_far), "--json", str(file))
        for log, file in zip(logs, files, strict=True)
    )
    return Work(commands=commands, writes=files)


def _check(so_far: SoFar) -> Work | Skip:
    request, file = so_far.request, so_far.folders["check"] / "check.json"
    logs = (*request.train, *request.test)
    words = ("check", *logs, "--vehicle", request.vehicle, *_mapping(so_far), *_accept(so_far))
    return Work(commands=((*words, "--json", str(file)),), writes=(file,))


def _accept(so_far: SoFar) -> list[str]:
    accept = so_far.request.accept
    return ["--accept", ",".join(accept)] if accept else []


def _fit(so_far: SoFar) -> Work | Skip:
    request, folder = so_far.request, so_far.folders["fit"]
    words = ("fit", "--vehicle", request.vehicle, "--train", *request.train)
    return Work(
        commands=((*words, *_fit_options(so_far), "--out", str(folder)),),
        writes=(folder / "fit.json", folder / "model.json"),
    )


def _discover(so_far: SoFar) -> Work | Skip:
    request, folder = so_far.request, so_far.folders["discover"]
    fit_file = so_far.folders["fit"] / "fit.json"
    fit = read_json(fit_file)
    recipe = fit.get("recipe") or {}
    options = recipe.get("options") or {}
    words = ["discover", "--vehicle", request.vehicle, "--train", *_trained(so_far)]
    words += [*_mapping(so_far), *_accept(so_far)]
    if recipe.get("rate"):
        words += ["--rate", f"{recipe['rate']:g}"]
    if recipe.get("kinematic_noise"):
        words.append("--kinematic-noise")
    # Parameters of the body alone: whether their effects are there is what is searched for.
    for option, key in (("--fixed", "fixed"), ("--per-flight", "per_flight")):
        names = [n for n in options.get(key, ()) if n.split(".")[0] not in fit["model"]["effects"]]
        words += [option, ",".join(names)] if names else []
    words += ["--seed", str(request.seed), "--out", str(folder)]
    return Work(commands=(tuple(words),), writes=(folder / "discovery.json",), reads=(fit_file,))


def _refit(so_far: SoFar) -> Work | Skip:
    if not so_far.ran("discover"):
        return Skip(reason="discover did not run")
    request, folder = so_far.request, so_far.folders["refit"]
    found_file = so_far.folders["discover"] / "discovery.json"
    fit_file = so_far.folders["fit"] / "fit.json"
    fit = read_json(fit_file)
    there = list(fit["model"]["effects"])
    named = [str(e["name"]) for e in read_json(found_file)["effects"]]
    new = [n for n in named if n not in there and _in_catalogue(n)]
    if not new:
        return Skip(reason="discover names no effect that the fit does not have already")
    recipe = fit.get("recipe") or {}
    effects = [*recipe.get("effects", ()), *new]
    own = (recipe.get("options") or {}).get("per_flight", ())
    words = ["fit", "--vehicle", request.vehicle, "--train", *request.train]
    words += [*_fit_options(so_far), "--effects", ",".join(effects)]
    words += ["--per-flight", ",".join(own)] if own else []
    return Work(
        commands=((*words, "--out", str(folder)),),
        writes=(folder / "fit.json", folder / "model.json"),
        reads=(found_file, fit_file),
    )


def _learn(so_far: SoFar) -> Work | Skip:
    if (closed := _closed(so_far)) is not None:
        return closed
    request, folder, chosen = so_far.request, so_far.folders["learn"], best_physics(so_far)
    assert chosen is not None
    trained = _trained(so_far)
    # The last training flight is not learned from: on it the learned part is chosen or not.
    first, last = (trained, []) if len(trained) < 2 else (trained[:-1], trained[-1:])
    words = ["learn", str(chosen.model), "--train", *first]
    words += ["--test", *last] if last else []
    words += [*_mapping(so_far), *_accept(so_far), *_adapt(chosen.model.parent)]
    words += ["--seed", str(request.seed), "--out", str(folder)]
    return Work(
        commands=(tuple(words),),
        writes=(folder / "hybrid.json", folder / "learn.json"),
        reads=(chosen.model,),
    )


def _validate(so_far: SoFar) -> Work | Skip:
    request, folder, chosen = so_far.request, so_far.folders["validate"], best(so_far)
    assert chosen is not None
    if not request.test:
        return Skip(reason="no --test flights; the fit was judged on pieces of flights left out")
    file = folder / "validate.json"
    words = ["validate", str(chosen.model), "--log", *request.test, *_mapping(so_far)]
    physics = best_physics(so_far)
    assert physics is not None
    words += [*_adapt(physics.model.parent), "--json", str(file)]
    return Work(commands=(tuple(words),), writes=(file,), reads=(chosen.model,))


def _export(so_far: SoFar) -> Work | Skip:
    if (closed := _closed(so_far)) is not None:
        return closed
    chosen = best(so_far)
    assert chosen is not None
    folder = so_far.folders["export"]
    words = ["export", str(chosen.model), "--name", "model", "--out", str(folder / "model")]
    words += ["--even-so"] if so_far.request.even_so else []
    writes = (folder / "model" / "manifest.json",)
    return Work(commands=(tuple(words),), writes=writes, reads=(chosen.model,))


def _closed(so_far: SoFar) -> Skip | None:
    """Nobody builds on a model that is not usable unless told to; test flights that were flown
    have the last word."""
    chosen = best(so_far)
    refused = chosen is not None and chosen.refused
    if so_far.ran("validate"):
        last = verdict_of(read_json(so_far.folders["validate"] / "validate.json"))
        refused |= last is not None and last.refused
    if not refused or so_far.request.even_so:
        return None
    return Skip(reason="the model is NOT USABLE; to go on all the same: --even-so")


def _mapping(so_far: SoFar) -> list[str]:
    mapping = so_far.request.mapping
    return ["--mapping", mapping] if mapping else []


def _fit_options(so_far: SoFar) -> list[str]:
    request = so_far.request
    words = ["--test", *request.test, "--judge-left-out"] if request.test else []
    words += [*_mapping(so_far), *_accept(so_far)]
    words += [] if request.rate is None else ["--rate", f"{request.rate:g}"]
    return [*words, "--seed", str(request.seed)]


def _adapt(folder: Path) -> list[str]:
    """--adapt as the fit in `folder` was validated with: all models are judged alike."""
    path = folder / "validate.json"
    adapted = read_json(path).get("adapted_on") if path.exists() else None
    return ["--adapt", f"{adapted['seconds']:g}"] if adapted else []


def _trained(so_far: SoFar) -> list[str]:
    """The training logs without those that the fit left out (faults, another craft)."""
    content = read_json(so_far.folders["fit"] / "fit.json")
    explicit: Mapping[str, str] = content.get("explicit") or {}
    words = shlex.split(explicit.get("command", ""))
    kept = _values(words, "--train")
    return [log for log in so_far.request.train if log in kept] or list(so_far.request.train)


def _values(words: Sequence[str], option: str) -> list[str]:
    """The words after an option up to the next one."""
    if option not in words:
        return []
    rest = words[words.index(option) + 1 :]
    end = next((k for k, w in enumerate(rest) if w.startswith("--")), len(rest))
    return list(rest[:end])


def _in_catalogue(name: str) -> bool:
    from greybox.model.effects import CATALOGUE

    return name in {e.name for e in CATALOGUE}


STAGES = (
    Stage(
        name="inspect", about="what the logs hold", plan=_inspect, start=0.5, each=0.01, needed=True
    ),
    Stage(name="check", about="faults of the data", plan=_check, start=0.5, each=0.01, needed=True),
    Stage(name="fit", about="automatic fit", plan=_fit, start=10.0, each=0.5, needed=True),
    Stage(
        name="discover", about="which effects are missing", plan=_discover, start=12.0, each=0.75
    ),
    Stage(name="refit", about="fit with what was found", plan=_refit, start=5.0, each=0.3),
    Stage(name="learn", about="what no effect explains", plan=_learn, start=25.0, each=1.5),
    Stage(name="validate", about="on the test flights", plan=_validate, start=1.0, each=0.03),
    Stage(name="export", about="C and CasADi for a controller", plan=_export, start=2.0, each=0.0),
)
"""The whole chain. Times [s of CPU]: three simulated flights of 20 s and one of test at 100 Hz,
cold cache (`greybox identify` writes those of its own run into identify.json)."""
NAMES = tuple(s.name for s in STAGES)
