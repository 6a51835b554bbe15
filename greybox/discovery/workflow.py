"""discover: from a model and flights to certified names, or an honest no."""

from __future__ import annotations

import concurrent.futures
import contextlib
import functools
import itertools
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Unpack

import numpy as np
from threadpoolctl import threadpool_limits

from greybox.automatic.held_ahead import Terms, held_ahead, is_bent
from greybox.data import Dataset
from greybox.data.checks import CheckReport
from greybox.data.halves import demand_apart
from greybox.data.lead import without_lead_in
from greybox.discovery.cause import BASE, Causes, offer
from greybox.discovery.certificate import certificates, certificates_beside, splits
from greybox.discovery.document import SearchSettings, settings_of
from greybox.discovery.evidence import Fitted, Flights
from greybox.discovery.left import Left, left_over
from greybox.discovery.name import (
    NAMED,
    Name,
    by_errors_ahead,
    held,
    judged,
    out_done,
    separating,
    unneeded,
    untold,
    verdict_of,
    with_values_elsewhere,
)
from greybox.discovery.options import DiscoverChoices, DiscoverOptions
from greybox.discovery.own_cause import memory_of, offer_own
from greybox.discovery.result import Discovery
from greybox.discovery.rules import RULES
from greybox.discovery.search import Rival, Search
from greybox.discovery.words import moved_names, so_far, stays, with_size
from greybox.errors import GreyboxError, ModelError, UnknownNameError
from greybox.estimation.few_samples import demand_long_enough
from greybox.estimation.fit import Fit
from greybox.estimation.noise_table import sensor_table
from greybox.estimation.options import says_choices
from greybox.estimation.record import sample_time
from greybox.journal import spared
from greybox.model.dynamics import StateSpaceModel
from greybox.model.faults import faults_of
from greybox.model.known import demand_known
from greybox.model.layer import physics_of
from greybox.model.noise_free import as_measured
from greybox.model.vehicle import Vehicle
from greybox.model.verdict import STOPPED
from greybox.planning.experiment import Manoeuvres
from greybox.progress import in_notebooks, onward
from greybox.residual.attainable import attainable
from greybox.statistics.betting import bar_of_several
from greybox.takes import EXECUTOR, FAULTS, FLIGHTS, FUNCTION, NAMES, SEARCHED, takes
from greybox.validation.adapt import adaptation
from greybox.validation.gap import GapRow, HeldOutErrors, outgrown, worsened
from greybox.validation.judges import Judges
from greybox.validation.sanity import denied, impossible
from greybox.validation.then import Then
from greybox.validation.worth import Worth, worth

Progress = Callable[[str, float], None]
Judged = tuple[list[Name], Fitted]
"""Names, and the structure of what is said."""
Answer = tuple[list[Name], Fitted, Left]
"""The same with what is left."""


@in_notebooks(progress="share")
@says_choices(DiscoverOptions)
@threadpool_limits.wrap(limits=1)  # small matrices: threads of BLAS only wait for each other
@takes(subject=SEARCHED, train=FLIGHTS, test=FLIGHTS, accept=NAMES)
@takes(executor=EXECUTOR, faults=FAULTS, progress=FUNCTION, save=FUNCTION)
def discover(
    subject: Vehicle | StateSpaceModel,
    train: Dataset,
    test: Dataset | None = None,
    options: DiscoverOptions | None = None,
    *,
    faults: CheckReport | None = None,
    accept: Iterable[str] = (),
    progress: Progress | None = None,
    save: Callable[[Discovery], None] | None = None,
    executor: concurrent.futures.Executor | None = None,
    **choices: Unpack[DiscoverChoices],
) -> Discovery:
    """Find, certify and add what the model of a vehicle, or one of your own, misses on the flights
    of `train`; flights of `test` did not propose and judge (without any, halves of `train` judge
    each other). Effects of a model of your own are its parameters with a `null`.

    The choices are keywords, fields of `DiscoverOptions` with its defaults, or `options` as a
    whole: own, alpha, max_effects, adapt, kinematic_noise, per_flight, fixed, hold_sensor_noise,
    attainable, trace, since, effort, seed.

    `faults`: what `check_logs` said about the files (default: the data are checked, of which those
    of the clock do not show; the checks in `accept` do not block). `save` gets what is known after
    every step. `executor` fits rivals side by side. Raises what a fit does, `UnknownNameError`.
    """
    began = time.perf_counter()
    options, doubts = DiscoverOptions.of(options, choices), list[str]()
    demand_known(options.since)
    train, vehicle = Dataset.of(train), subject if isinstance(subject, Vehicle) else None
    tested = test if test is not None and test.flights else None
    if tested is not None:
        demand_apart(train, tested)
    if vehicle is not None:
        faults = faults or faults_of(vehicle, train + tested if tested else train, accept=accept)
        if not faults.ok:
            return refused(faults, vehicle, settings_of(options), time.perf_counter() - began)
        demand_long_enough(train)
        train, tested, doubts = as_measured(train, tested, vehicle)
        options = _as_in_a_fit(options, faults, tested)
    settings: SearchSettings = {**settings_of(options), "sample_time": sample_time(train)}
    say = onward(progress or (lambda _text, _share: None))
    run = _Run(
        flights=Flights(
            causes=_offered(subject, train, options),
            data=without_lead_in(train) if vehicle else train,
            options=options.of_every_fit,
            effort=options.effort,
            executor=executor,
            say=say,
        ),
        test=without_lead_in(tested) if tested and vehicle else tested,
        judges=Judges(flights=tested or train, adapt=options.adapt, seed=options.seed),
        options=options,
        settings=settings,
        say=say,
        save=save or (lambda _found: None),
        began=began,
        warnings=doubts,
    )
    return run.carried_out()


def _as_in_a_fit(o: DiscoverOptions, faults: CheckReport, test: Dataset | None) -> DiscoverOptions:
    """Noise between attitude and gyro, and adaptation, where open, as the automatic fit has them."""
    loose = faults.loose if o.since is None else o.since.physics.kinematic_noise
    noise = loose if o.kinematic_noise is None else o.kinematic_noise
    return o.but(kinematic_noise=noise, adapt=adaptation(test or (), o.adapt))


def _offered(
    subject: Vehicle | StateSpaceModel, train: Dataset, options: DiscoverOptions
) -> Causes:
    """The causes on offer."""
    causes: Causes
    if isinstance(subject, Vehicle):
        causes = offer(
            subject,
            train.channels,
            own=options.own,
            sample_time=sample_time(train),
            noncausal=train.noncausal,
            kinematic_noise=bool(options.kinematic_noise),
            fixed=options.fixed,
            per_flight=options.per_flight,
            known=options.known,
        )
    else:
        if options.own or options.kinematic_noise:
            raise ModelError(
                "effects of the catalogue's kind, and noise of an attitude, are for vehicles",
                got=f"the model {subject.name} of your own",
                fix="declare an effect in the model: a parameter with a null",
            )
        own, known = options.per_flight, options.known
        causes = offer_own(subject, fixed=options.fixed, per_flight=own, known=known)
    declared = [d.name for d in causes.model.parameters]
    if wrong := {*options.per_flight, *options.fixed} - set(declared):
        raise UnknownNameError("parameter", min(wrong), declared)
    return causes


def refused(
    faults: CheckReport, vehicle: Vehicle, settings: SearchSettings, seconds: float = 0.0
) -> Discovery:
    """The answer "bad_data": faults that block would be read as physics."""
    return Discovery(
        verdict="bad_data",
        faults=tuple(f"{f.flight}: {f.message}" for f in faults.blocking),
        omega_known=vehicle.actuator.speed_max is not None,
        seconds=seconds,
        settings=settings,
    )


@dataclass(kw_only=True, eq=False)
class _Run:
    """One search with its flights and settings, and what it warned of."""

    flights: Flights
    test: Dataset | None
    judges: Judges
    options: DiscoverOptions
    settings: SearchSettings
    say: Progress
    save: Callable[[Discovery], None]
    began: float
    warnings: list[str] = field(default_factory=list)
    needed: float = np.inf
    """Log e-value that each of the names found needs, see `bar_of_several`."""
    ahead: bool = False
    unchanged: str = ""
    unfitted: list[str] = field(default_factory=list)
    last: Fitted | None = None
    """Where nothing has changed: what is said, and what flights are likelier with."""
    _settled: dict[Fitted, Fit] = field(default_factory=dict)
    _bent: dict[tuple[Fitted, Fitted | None], bool] = field(default_factory=dict)

    @property
    def bar(self) -> float:
        """Log e-value of a name that is alone: causes on offer over alpha (Bonferroni)."""
        offered = len(self.flights.causes.effects)
        return float(np.log(max(offered, 1) / self.options.alpha))

    def carried_out(self) -> Discovery:
        """The search from its first fit to the last figure."""
        self.say("fit of the base", 0.02)
        causes = self.flights.causes
        search = Search(
            flights=self.flights,
            most=self.options.max_effects,
            say=self.say,
            interim=lambda at: self._keep(search, at, None),
            hopeless=self._hopeless,
        )
        names, at, left = self._answer(search)
        found = self.settled(at)
        self.say("gap", 0.9)
        found = self.judges.judged(found)
        written = left.written and self.judges.judged(self.settled(left.written))
        ends = [f for f in (found, written) if f and not f.converged]
        self.warnings += dict.fromkeys(f"the last fit: {f.status.advice}" for f in ends)
        rows = self._gap(self.last or at, left.written)
        scores = None if self.ahead else search.scores
        taught = sum(f.n for f in self.flights.data)
        share = 0.5 if self.test is None else self.judges.samples / max(taught, 1)
        unfitted = dict.fromkeys(() if self.ahead or not names else self.unfitted)
        doubts = [impossible(self.settled(at), n) for n in sorted(causes.base)]
        smallest = {n: scores.smallest(n, self.bar, share) for n in scores.absent} if scores else {}
        return replace(
            self._so_far(found),
            verdict=verdict_of({n.status for n in names}, bool(left.unnamed or memory_of(found))),
            names=tuple(names),
            left=left,
            before=self._rest(self.null).axes,
            gap=tuple(rows),
            gap_on="train" if self.test is None else "test",
            bar=self.needed,
            minimum_detectable={n: v for n, v in smallest.items() if v},
            faults=tuple(doubt for doubt in doubts if doubt),
            warnings=(*self.warnings, *left.doubts, *unfitted),
            tested_on=() if self.test is None else tuple(self.test.names),
            separating=self._separated(names, at),
            steps=tuple(search.steps),
            sensors=tuple(sensor_table(found)),
            base=tuple(n for n in sorted(BASE) if n in found.model.effects),
            lawful=left.lawful(written) if written else None,
            denied=denied(self.settled(left.written or at), causes.core),
            unchanged=self.unchanged,
            ahead=self.ahead,
        )

    def _answer(self, search: Search) -> Answer:
        """The names, the structure with what is said, and what it leaves. A law is said only where
        no cause on offer, each fitted beside what was found, takes its place."""
        then, last = self.then, search.run(self.null)
        said_ahead = self._by_errors_ahead(search, last)
        if then and (line := then.unchanged(self.held_out(last), search.added(last), RULES.span)):
            self.unchanged, self.last, self.needed, self.ahead = line, last, self.bar, False
            return [], self.null, self._rest(self.null)
        if said_ahead:
            return said_ahead
        if not then:  # the likelihood judges, beside laws if not alone: all swaps count
            search.hopeless = lambda _at, _asked: False
            last = search.run(last) if search.added(last) and self.bent(last) else last
        more: Fitted | None = last
        while more is not None:
            at, said, offered = more, self.warnings.copy(), self.flights.causes
            names, named = self._named(at, search.contest(at))
            self._keep(search, at, names)
            named = self.flights.arrived(named)
            self.say("what is left", 0.8)
            left, with_laws = self._left(named), self.flights.causes
            self.flights.causes = offered
            more = None if left.written is None else search.every(at)
            more, self.warnings = (search.run(more), said) if more else (None, self.warnings)
        self.flights.causes = with_laws
        if full := search.crowded_out(at):
            more_said = f"{', '.join(full)} would make the flights likelier, too: --max-effects"
            self.warnings.append(f"as many effects as were asked for ({search.most}); {more_said}")
        while left.unnamed and (instead := self._laws_instead(names, named, left)):
            names, named, left = instead
        doubted = (n for n in names if n.kept and n.status != "trace")
        worse = {n.name for n in doubted if n.worth and n.worth.harms}
        if left.written is not None:
            names = [held(n) for n in names]
            while (fewer := self._beside_laws(names, named, left.written))[1] is not named:
                rest = self._left(fewer[1])
                if rest.written is None:
                    break  # the names had said what the laws say
                (names, named), left = fewer, rest  # even fewer may be needed beside these laws
        elif worse:
            names = [replace(n, kept=n.kept and n.name not in worse) for n in names]
            named = self.flights.arrived(self.flights.fit(named.structure - worse, [named.known]))
            left = replace(self._rest(named), doubts=left.doubts)
        return self._by_errors_ahead(search, named, left) or (names, named, left)

    def _keep(self, search: Search, at: Fitted, names: Sequence[Name] | None) -> None:
        """Save what is known where the search stands; `names` are what was said of causes there."""
        found = self._so_far(self.settled(at).judged(STOPPED))
        self.save(replace(found, so_far=so_far(search.added(at), names), steps=tuple(search.steps)))

    def _so_far(self, found: Fit) -> Discovery:
        return Discovery(
            verdict="stopped",
            fit=found,
            bar=self.bar,
            alone=self.bar,
            unjudged=dict(self.flights.causes.unjudged),
            omega_known=self.flights.causes.omega_known,
            seconds=time.perf_counter() - self.began + spared(),
            settings=self.settings,
            warnings=("the search was stopped before its end",),
        )

    def settled(self, at: Fitted) -> Fit:
        """The whole result of a fit, once."""
        if at not in self._settled:
            self._settled[at] = self.flights.settled(at)
        return self._settled[at]

    def held_out(self, at: Fitted) -> HeldOutErrors | None:
        """Errors of a structure on the flights that judge; None where it predicts nothing there."""
        with contextlib.suppress(GreyboxError):
            return self.judges.errors(self.settled(at).model)
        return None

    def _hopeless(self, at: Fitted, asked: int) -> bool:
        """Whether no further swap is asked: then foretells better, or no likelihood judges names."""
        then = self.then
        return then.beats(self.held_out(at), RULES.span) if then else asked > 0 and self.bent(at)

    def bent(self, at: Fitted, lawful: Fitted | None = None) -> bool:
        """Whether the likelihood is no judge of names of a vehicle, asked once: see `is_bent`; or it
        named what force and torque without a name stand against on the flights that judge."""
        if (at, lawful) not in self._bent and physics_of(self.settled(at).model.dynamics):
            found, laws = self.settled(at), self.settled(lawful).model if lawful else None
            given = self.flights.data, self.judges, RULES.span, RULES.law, laws, self.options.known
            bent = self._opposed(lawful or at) or is_bent(found, *given, self.unfitted.append)
            self._bent[at, lawful] = bent
        return self._bent.get((at, lawful), False)

    def _opposed(self, at: Fitted) -> bool:
        base, model = self.held_out(self.null), self.settled(at).model  # --from has a base, too
        return self.judges.oppose(base, model, at.structure - self.null.structure, RULES.span)

    def _by_errors_ahead(
        self, search: Search, at: Fitted, left: Left | None = None
    ) -> Answer | None:
        """Where a structure is bent, and laws that are `left` do not mend that, what is said of all
        that was in one on the way to it: by its worth to a model that is fitted by errors ahead,
        which takes its place, or the base where none has a name and errors grow with all. None
        where it is not bent, or nothing can be fitted."""
        asked, done = search.named(search.taken), itertools.count()
        if not search.added(at) or not self.bent(at):
            return None
        if left is None:
            offered, left = self.flights.causes, self._left(at)
            self.flights.causes = offered
        if left.written is not None and not self.bent(at, left.written):
            return None
        o = self.options

        def say(text: str) -> None:
            self.say(text, 0.6 + 0.3 * min(next(done) / len(asked), 3) / 3)

        physics = physics_of(self.flights.causes.built(at.structure | search.taken))
        terms = Terms(fixed=o.fixed, per_flight=o.per_flight, known=o.known)
        given, unable = (self.flights.data, self.judges, RULES.span, o.max_effects), self.unfitted
        fits = functools.partial(held_ahead, terms=terms, say=say, unable=unable.append)
        if not physics or (race := fits(physics, asked, *given)) is None:
            return None
        self._settled[at], self.ahead, self.needed = race.fit, True, self.bar
        odd = {n: impossible(race.fit, n) for n in asked}
        said = [by_errors_ahead(n, race, odd[n], self.bar) for n in asked]
        good = self._worth(self.null, at)
        if good and good.harms and not any(n.status in NAMED for n in said):
            self.warnings.append(f"errors ahead grow with {', '.join(asked)}: not in the model")
            return [replace(n, kept=False) for n in said], self.null, self._rest(self.null)
        return said, at, replace(left, written=None)

    @functools.cached_property
    def null(self) -> Fitted:
        return self.flights.fit(self.flights.causes.base)

    @functools.cached_property
    def then(self) -> Then | None:
        return Then.on(self.options.since, self.judges)

    def _named(self, at: Fitted, rivals: Mapping[str, Sequence[Rival]]) -> Judged:
        """What is said of every cause of the structure, and the structure of what is said."""
        judges, alpha = splits(self.flights, self.test), self.options.alpha
        whole = self.settled(at)
        odd = {n: impossible(whole, n) for n in rivals}
        names, before, self.needed = [], np.inf, self.bar
        while self.needed < before:  # fits near a lower bar are carried on, and more may pass it
            before = self.needed
            found = certificates(at, rivals, judges, before)
            possible = [c.log_e for n, c in found.items() if not odd[n]]
            self.needed = min(bar_of_several(possible, self.bar), before)
        for name, certificate in found.items():
            without = next(r.fitted for r in rivals[name] if not r.instead)
            good = self._worth(without, at)
            said = judged(certificate, good, odd[name], self.needed, alpha, self.bar)
            said = with_size(untold(said, whole) if len(rivals) > 1 else said, whole)
            names.append(with_values_elsewhere(said, whole, rivals[name]))
        return self._without_traces(names, at)

    def _worth(self, without: Fitted, at: Fitted) -> Worth | None:
        """What is more in a structure is worth to it; None where flights that judge cannot tell."""
        old, new = self.held_out(without), self.held_out(at)
        return None if old is None or new is None else worth(old, new, RULES.span)

    def _without_traces(self, names: list[Name], at: Fitted) -> Judged:
        """Names, and the structure without what has none but traces that numbers rest on."""
        traces, all_stay = {n.name for n in names if n.status == "trace"}, self.options.trace
        names = [replace(n, kept=n.kept or (all_stay and n.name in traces)) for n in names]
        gone = {n.name for n in names if n.status not in NAMED and not n.kept}
        bare = self.flights.fit(at.structure - gone, [at.known]) if gone else at
        found = self.settled(bare)
        why = {n: impossible(found, n.name) * (n.status in NAMED) for n in names}
        if any(why.values()):  # without what left
            bent = [replace(n, status="impossible", reason=w) if w else n for n, w in why.items()]
            return self._without_traces(bent, at)
        if not traces & gone:
            return names, bare
        whole = self.flights.fit(at.structure - (gone - traces), [at.known])
        ways = self._worth(bare, whole), self._worth(whole, bare)
        gain, harm = (way is not None and way.matters for way in ways)
        moved = moved_names(names, self.settled(whole), bare)
        if not gain and (harm or not moved):
            less = f"without {', '.join(sorted(traces))} (traces with which errors ahead grow)"
            self.warnings += [f"{n} is elsewhere {less}, beyond its error" for n in moved]
            return names, bare
        return [stays(n, moved) if n.name in traces & gone else n for n in names], whole

    def _laws_instead(self, names: list[Name], at: Fitted, left: Left) -> Answer | None:
        """Names, structure and what is left with laws in the place of all causes of the structure
        `at` that have no name, or of one cause, which make the flights clearly likelier and foretell
        no worse than a name: it stood in for them. Next to laws that are `left`, one whose numbers
        these take over is asked. None where none do."""
        offered, best = self.flights.causes, left.written or at
        asked = [n for n in names if n.name in at.structure and n.status != "trace"]
        if left.written:
            bent = {p.split(".")[0] for p in moved_names(names, self.settled(at), best)}
            asked = [n for n in asked if n.status in NAMED and n.name in bent]
        unsure = [n for n in asked if n.status not in NAMED]
        each = [[n] for n in sorted(asked, key=lambda n: n.certificate.log_e) if [n] != unsure]
        for some in [unsure, *each] if unsure else each:
            bare = self.flights.fit(at.structure - {n.name for n in some}, [at.known])
            rest = self._left(bare, bare if some is unsure else best)
            gain = rest.written.log_evidence - best.log_evidence if rest.written else -np.inf
            if gain >= self.bar:
                return [out_done(n, gain) if n in some else n for n in names], bare, rest
            self.flights.causes = offered
        return None

    def _beside_laws(self, names: list[Name], at: Fitted, laws: Fitted) -> Judged:
        """Names, without a name where laws that won need them no more, and the structure so."""
        asked = [n.name for n in names if n.name in laws.structure]
        judges = splits(self.flights, self.test)
        beside = certificates_beside(self.flights, laws, asked, judges, self.bar)
        gone = {n for n, c in beside.items() if c.log_e < self.bar}
        if not gone:
            return names, at
        names = [n if n.name not in gone else unneeded(n, beside[n.name], self.bar) for n in names]
        return names, self.flights.fit(at.structure - gone, [at.known])

    def _rest(self, at: Fitted) -> Left:
        return left_over(self.flights, at, self.settled(at), self.bar, seed=0)

    def _left(self, at: Fitted, next_to: Fitted | None = None) -> Left:
        doubts, o = list[str](), self.options
        holds = functools.partial(self._holds, next_to or at, doubts)
        try:
            found = left_over(self.flights, at, self.settled(at), self.bar, o.seed, holds=holds)
        except GreyboxError as error:
            return Left(axes=(), doubts=(f"what is left could not be looked at: {error}",))
        return replace(found, doubts=tuple(doubts))

    def _holds(self, at: Fitted, doubts: list[str], written: Fitted) -> bool:
        """Whether laws foretell no worse than the names of `at` on the flights that judge."""
        if grown := outgrown(*(self.held_out(f) for f in (self.null, at, written))):
            laws = ", ".join(sorted(written.structure - at.structure))
            said = f"laws were found ({laws}) and are not written: on the flights that judge errors"
            doubts.append(f"{said} grow with them ({', '.join(grown)})")
        return not grown

    def _separated(self, names: Sequence[Name], at: Fitted) -> dict[str, Manoeuvres | None]:
        alike = [n for n in names if n.status == "one of these"]
        if alike:
            self.say(f"what separates {', '.join(' and '.join(n.shares) for n in alike)}", 0.97)
        return {n.name: separating(self.flights, at, n) for n in alike}

    def _gap(self, at: Fitted, written: Fitted | None) -> list[GapRow]:
        if self.test is None:
            self.warnings += [
                "without --test flights causes were chosen on those that judge them, by halves, and "
                "the gap: e-values are then too large by what choosing gains"
            ]
        lawful, learned = self.held_out(written) if written else None, None
        if self.options.attainable:
            self.say("attainable line", 0.95)
            try:
                bare = self.settled(self.null).model
                learned = attainable(bare, self.flights.data, self.judges, self.options.seed)
            except GreyboxError as error:
                self.warnings.append(f"no attainable line: {error}")
        before = self.then.errors if self.then else self.held_out(self.null)
        rows = self.judges.rows(before, self.settled(at).model, lawful, learned)
        if not rows:
            self.warnings.append("no gap table: the models predict nothing on the judged flights")
        self.warnings += [] if self.last else worsened(rows)
        return rows
