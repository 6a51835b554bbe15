"""plan: from a vehicle or a model to excitation flights with the standard errors that they are
expected to give."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Unpack

import numpy as np
from threadpoolctl import threadpool_limits

from greybox.data import Dataset
from greybox.errors import FitError, GreyboxError
from greybox.estimation.identifiability import marginal_information, unidentified
from greybox.estimation.options import says_choices
from greybox.model.identified import IdentifiedModel
from greybox.model.known import demand_known
from greybox.model.vehicle import Vehicle
from greybox.planning.excitation_blocks import Flown, excitation_blocks, fit_in, sequence
from greybox.planning.information import Score, choose, efficiency, errors, information, pairs
from greybox.planning.limits import Limits
from greybox.planning.manoeuvres import Trial, tried_together
from greybox.planning.options import (
    LONGEST,
    PlanChoices,
    PlanOptions,
    demand_lengths,
    left_over,
    whole_pieces,
)
from greybox.planning.planning_case import PlanningCase, planning_case
from greybox.planning.result import Plan, Step
from greybox.progress import in_notebooks
from greybox.takes import FUNCTION, MODEL, VEHICLE, takes

ROUNDS, SMALLER = 8, 0.85
"""How often, and by which factor, manoeuvres that break a limit in the whole flight are made
smaller."""


@in_notebooks(say="say")
@says_choices(PlanOptions)
@takes(vehicle=VEHICLE, model=MODEL, say=FUNCTION)
def plan(
    vehicle: Vehicle | None = None,
    options: PlanOptions | None = None,
    *,
    model: IdentifiedModel | None = None,
    say: Callable[[str], None] | None = None,
    **choices: Unpack[PlanChoices],
) -> Plan:
    """Choose `seconds` of manoeuvres of `piece` seconds each, in `flights` flights, that tell most
    about what is wanted.

    The choices are keywords, fields of `PlanOptions` with its defaults, or `options` as a whole:
    effects, seconds, piece, flights, limits, free, values, noise, sensors, sample_time,
    setpoints_only, seed.

    Wanted are the parameters of `effects`, or all that are free where none is named; see `subject`
    for model, values, noise levels and sensors. `limits` default to a box of 4 x 4 x 2.5 m, 3 m/s,
    35 degrees and the command range less 2 % at both ends. `setpoints_only` leaves out manoeuvres
    that need injected signals. `say` hears of progress. Raises `GreyboxError` (limits without room,
    nothing to estimate), `FitError` (nothing that can be flown), `UnknownNameError`, `ModelError`.
    """
    o = PlanOptions.of(options, choices)
    demand_known(model)
    count = _pieces(o)
    short = left_over(o.seconds, o.piece)
    for text in short:
        _say(say, text)
    with threadpool_limits(limits=1):
        wish, limits, notes = _hovering(_case(vehicle, model, o), o.limits, o.piece)
        candidates, left_out = _flyable(wish, limits, o.piece, o.seed, o.setpoints_only, say)
        split = _chosen(wish, candidates, count, o.flights, say)
        split, log = _kept(wish, limits, split, say)
        found = information(wish, log)
        naive = information(wish, _naive(wish, limits, candidates, count * o.piece))
    places = [i for i, n in enumerate(found.names) if n in wish.free]
    expected = errors(wish, found)
    return Plan(
        subject=wish,
        limits=limits,
        flights=split,
        log=log,
        information=found,
        errors=expected,
        naive=errors(wish, naive),
        efficiency=efficiency(wish, found, naive),
        pairs=tuple(pairs(wish, found)),
        unidentified=unidentified(
            marginal_information(found.matrix, places),
            [found.names[i] for i in places],
            [wish.values[found.names[i]] for i in places],
            [wish.declared[found.names[i]].scale for i in places],
        ),
        left_out=tuple(left_out),
        warnings=(
            *(f"the whole flight breaks the limit of {b}" for b in limits.broken(log)),
            *(f"nothing will be known of {n}" for n in _unknown(expected)),
            *notes,
            *short,
        ),
        seed=o.seed,
    )


def _unknown(expected: Mapping[str, tuple[float, float]]) -> list[str]:
    """Parameters without a finite standard error."""
    return [n for n, (std, _) in expected.items() if not np.isfinite(std)]


def _case(
    vehicle: Vehicle | None, model: IdentifiedModel | None, o: PlanOptions
) -> Callable[[float], PlanningCase]:
    """Size of the effects that are assumed -> what is planned for."""
    return lambda assumed: planning_case(
        vehicle,
        model,
        effects=o.effects,
        free=o.free,
        values=o.values,
        noise=o.noise,
        sensors=o.sensors,
        sample_time=o.sample_time,
        assumed=assumed,
    )


def _pieces(o: PlanOptions) -> int:
    """The number of manoeuvres. Raises `GreyboxError` for too short a flight, or too many."""
    seconds, piece, flights = o.seconds, o.piece, o.flights
    demand_lengths("a flight", seconds, piece, shortest=(2.0, "2 s"), longest=LONGEST)
    count = whole_pieces(seconds, piece)
    if not 1 <= flights <= count:
        raise GreyboxError(
            "every flight needs a manoeuvre",
            expected=f"1 to {count} flights",
            got=str(flights),
            fix="--flights 1",
        )
    return count


def _chosen(
    wish: PlanningCase,
    candidates: Mapping[str, Flown],
    count: int,
    flights: int,
    say: Callable[[str], None] | None,
) -> tuple[tuple[Step, ...], ...]:
    """The `count` manoeuvres that together tell most, in order, split over the flights."""
    told = {}
    for name, f in candidates.items():
        told[name] = information(wish, f.log)
        _say(say, f"weighed {f.piece.text}")
    names = next(iter(told.values())).names
    chosen = choose(told, count, Score(wish, names))
    steps = [(candidates[n].piece, candidates[n].amplitude) for n in chosen]
    return tuple(
        tuple(steps[i] for i in part) for part in np.array_split(np.arange(count), flights)
    )


def _hovering(
    make: Callable[[float], PlanningCase], limits: Limits | None, seconds: float
) -> tuple[PlanningCase, Limits, list[str]]:
    """The subject, with effects of assumed size made smaller until the craft hovers within the
    limits."""
    for assumed in (1.0, 0.5, 0.25, 0.1, 0.05):
        wish = make(assumed)
        room = (limits or Limits()).of(wish.physics.vehicle)
        hover = excitation_blocks(wish.flying, room, seconds=seconds, setpoints_only=True)[0]
        if fit_in(wish.flying, [hover], room)[0] is not None:
            note = f"effects without a stated size are taken at {assumed:g} of their typical one"
            return wish, room, [] if assumed == 1.0 else [note]
    raise FitError(
        "the craft cannot hover within the limits",
        expected="a vehicle that carries itself, and effects that it can trim",
        got="rotors at their limits or a lost path",
        fix="greybox vehicle check; smaller --value of the effects; wider --box",
    )


def _say(say: Callable[[str], None] | None, text: str) -> None:
    if say is not None:
        say(text)


def _flyable(
    wish: PlanningCase,
    limits: Limits,
    seconds: float,
    seed: int,
    setpoints_only: bool,
    say: Callable[[str], None] | None,
) -> tuple[dict[str, Flown], list[str]]:
    """The pieces that keep the limits, by name, and the texts of those that do not. Raises
    `FitError` where none does."""
    out, left_out = {}, []
    pieces = excitation_blocks(
        wish.flying, limits, seconds=seconds, seed=seed, setpoints_only=setpoints_only
    )
    for p, done in zip(pieces, fit_in(wish.flying, pieces, limits), strict=True):
        if done is None:
            left_out.append(p.text)
            _say(say, f"cannot be flown inside the limits: {p.text}")
        else:
            out[p.name] = done
            _say(say, f"flown: {p.text} ({100 * done.amplitude:.0f} %)")
    if "hover" not in out or len(out) < 2:
        raise FitError(
            "no manoeuvre keeps the limits",
            expected="at least hover and one manoeuvre",
            got=f"{len(out)} of {len(out) + len(left_out)}",
            fix="widen --box, --speed, --tilt or --command; greybox vehicle check; smaller --value "
            "of the effects",
        )
    return out, left_out


def _kept(
    wish: PlanningCase,
    limits: Limits,
    split: Sequence[Sequence[Step]],
    say: Callable[[str], None] | None = None,
    *,
    limited: bool = True,
) -> tuple[tuple[tuple[Step, ...], ...], Dataset]:
    """The flights and their logs. Manoeuvres that cannot be flown where they follow each other, or
    break a limit there (`limited`), are made smaller. Raises `FitError` where that is not enough.

    What a manoeuvre leaves behind reaches into the next one, so that the one before is made smaller
    as well.
    """
    sizes = [[a for _, a in steps] for steps in split]
    seconds = split[0][0][0].seconds
    for _ in range(ROUNDS):
        smaller = tuple(
            tuple((p, a) for (p, _), a in zip(steps, own, strict=True))
            for steps, own in zip(split, sizes, strict=True)
        )
        trials = _flown(wish, limits, smaller)
        hurt = np.concatenate([t.failed for t in trials])
        logs = [t.log for t in trials if t.log is not None]
        if len(logs) == len(trials):
            log = sum(logs[1:], start=logs[0])
            for where in limits.breaches(log).values() if limited else ():
                hurt |= where
        if not hurt.any():
            break
        pieces = np.flatnonzero(hurt) * wish.sample_time // seconds
        flat = [(f, k) for f, steps in enumerate(split) for k in range(len(steps))]
        for i in {min(int(k), len(flat) - 1) for k in pieces}:  # samples of a flight are rounded
            for f, k in flat[max(i - 1, 0) : i + 1]:
                if flat[i][0] == f:
                    sizes[f][k] *= SMALLER
    for k, t in enumerate(trials):
        if t.log is None:
            raise FitError(
                f"flight {k + 1} of the plan saturates the rotors or loses its path",
                fix="smaller --speed or --tilt; another --piece",
            )
    less = sum(a != b for was, now in zip(split, smaller) for (_, a), (_, b) in zip(was, now))
    if less:
        _say(say, f"made smaller, for the whole flight to keep the limits: {less} manoeuvre(s)")
    return smaller, log


def _flown(wish: PlanningCase, limits: Limits, split: Sequence[Sequence[Step]]) -> list[Trial]:
    """How whole flights go, without noise."""
    return [
        tried_together(
            wish.flying,
            [(sequence(list(steps), limits, f"flight_{k + 1}"), 1.0)],
            seconds=sum(p.seconds for p, _ in steps),
        )[0]
        for k, steps in enumerate(split)
    ]


def _naive(
    wish: PlanningCase, limits: Limits, candidates: Mapping[str, Flown], seconds: float
) -> Dataset:
    """Half hover, half figure of eight, as a pilot would who is asked for data (to and fro, where
    it cannot be flown)."""
    eight = candidates.get("figure_eight") or max(
        candidates.values(), key=lambda f: f.piece.kind == "speed"
    )
    n = max(round(seconds / eight.piece.seconds), 1)
    steps = [(candidates["hover"].piece, 1.0)] * ((n + 1) // 2) + [
        (eight.piece, eight.amplitude)
    ] * (n // 2)
    return _kept(wish, limits, [steps], limited=False)[1]
