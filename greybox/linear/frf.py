"""The frequency response of flights, without a model: which way, how much and how late outputs
follow inputs, and at which frequencies the flights tell it.

All inputs are conditioned on each other, all stretches without a gap of all flights are averaged.
The estimate itself is in `greybox.statistics.spectra`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from greybox.data import Dataset, Flight
from greybox.data.airframe import Airframe
from greybox.errors import DataError
from greybox.estimation.lag_and_gain import lag_and_gain
from greybox.linear.frf_channels import channels, mixed, vehicle_of, weights_of
from greybox.linear.frf_result import TRUSTED, FrequencyResponse, Pair
from greybox.linear.logs import ChannelSpec
from greybox.model.frequency_response import response_of
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import physics_of
from greybox.model.linear import LinearModel
from greybox.runs import runs
from greybox.statistics.feedback import follows
from greybox.statistics.spectra import (
    FEWEST_CYCLES,
    SHORTEST,
    ComplexArray,
    Response,
    averages_in,
    by_chance,
    circle,
    frequencies,
    response,
    spectra,
)
from greybox.statistics.spectra import band as band_of
from greybox.symbolic import BoolArray, FloatArray
from greybox.takes import POSITIVE, shown

LONGEST = 16.0
"""Longest window [s] that is chosen: 0.19 Hz is the lowest frequency then."""
LEAST_AVERAGES = 8
"""Independent averages that the longest window must leave, and two more per input."""
HIGHEST = 0.4
"""Highest frequency, as a share of the sample rate."""
STRONG = 10.0
"""F statistic from which on a reference moves an input enough (Staiger and Stock, Econometrica
65(3), 1997)."""
INTEGRATORS = {"p": 1, "q": 1, "r": 1, "az": 0}
"""From commands, which make torque and thrust, to these outputs; of others, what fits best."""
STILL = 1e-9
"""Root of a channel's sum of squares about its mean, in its largest value, up to which it does not
move: rounding."""
TOGETHER = 0.95
"""Coherence of an input with the others from which on they cannot be told apart."""


@dataclass(frozen=True, kw_only=True)
class _Channels:
    """Inputs, outputs and references, side by side in the columns of a stretch."""

    inputs: tuple[ChannelSpec, ...]
    outputs: tuple[ChannelSpec, ...]
    references: tuple[ChannelSpec, ...]

    @property
    def all(self) -> tuple[ChannelSpec, ...]:
        return (*self.inputs, *self.outputs, *self.references)

    @property
    def u(self) -> list[int]:
        return list(range(len(self.inputs)))

    @property
    def y(self) -> list[int]:
        return list(range(len(self.u), len(self.u) + len(self.outputs)))

    @property
    def z(self) -> list[int]:
        return list(range(len(self.u) + len(self.y), len(self.all)))


def frf(
    data: Dataset | Flight,
    inputs: Sequence[str],
    outputs: Sequence[str],
    *,
    references: Sequence[str] = (),
    vehicle: Airframe | None = None,
    model: IdentifiedModel | LinearModel | None = None,
    band: tuple[float, float] | None = None,
    window: float | None = None,
) -> FrequencyResponse:
    """The estimate behind `greybox.frf`, which says what the arguments mean and what is raised."""
    data = Dataset.of(data)
    vehicle = vehicle or vehicle_of(model)
    columns = (
        model.dynamics.inputs.names
        if isinstance(model, IdentifiedModel) and model.sensors
        else data.channels
    )
    c = _channels(inputs, outputs, references, vehicle, columns)
    stretches, seconds = _stretches(data, c)
    dt = data.flights[0].dt
    longest = _longest([len(s) for s in stretches], dt, len(c.z or c.u), window)
    used = [s for s in stretches if len(s) >= longest / dt / 2]
    f = frequencies(*_within(band or (FEWEST_CYCLES / longest, HIGHEST / dt), dt), longest)
    s = spectra(used, dt, f, longest)
    r = response(s, c.y, c.u, c.z)
    chance = by_chance(s.averages, len(c.z or c.u) - 1)
    coherent = (
        (r.coherence > np.maximum(TRUSTED, chance[:, None, None]))
        & (r.instrument > STRONG)[:, None, :]
        & (r.shared < TOGETHER)[:, None, :]
    )
    beside = None if model is None else _of_model(model, c, f)
    fed, untold = _fed_back(c, used, data)
    # A craft does not stay in the air by itself: its commands follow what it does, also where that
    # is more than the outputs show, or where larger motions hide it.
    flown = (
        not c.z and isinstance(model, IdentifiedModel) and physics_of(model.dynamics) is not None
    )
    return FrequencyResponse(
        pairs={
            p.name: p for p in _pairs(c, f, r, coherent, beside, (bool(fed), flown or bool(untold)))
        },
        frequency=f,
        averages=s.averages,
        window=s.window,
        flights=seconds,
        sample_time=dt,
        references=tuple(x.name for x in c.references),
        closed_by=fed,
        untold=untold,
        model=None if model is None else model.name,
        warnings=tuple(_warnings(c, fed, untold, r, data, model)),
    )


def _within(band: tuple[float, float], dt: float) -> tuple[float, float]:
    """The band [Hz], where logs of a sample time `dt` [s] can show it. Raises `DataError`."""
    low, high = band
    if not 0 < low < high <= 0.5 / dt:
        raise DataError(
            f"a band from {low:.3g} to {high:.3g} Hz",
            expected=f"increasing, above 0, up to {0.5 / dt:.3g} Hz",
            fix="--band 0.5,20, or logs of a higher rate",
        )
    return band


def _fed_back(
    c: _Channels, used: Sequence[FloatArray], data: Dataset
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """(what responses are measured by and follows the outputs; where there is none, what seems to).
    An output that was smoothed with later samples foretells what moved it, also in an open loop."""
    causal = [i for i in c.y if not _smoothed([c.all[i]], data)]
    ahead = [i for i in c.z or c.u if follows(used, i, c.y)]
    fed = tuple(c.all[i].name for i in ahead if causal and follows(used, i, causal))
    return fed, () if fed else tuple(c.all[i].name for i in ahead)


def _pairs(
    c: _Channels,
    f: FloatArray,
    r: Response,
    coherent: BoolArray,
    beside: ComplexArray | None,
    loop: tuple[bool, bool],
) -> Iterator[Pair]:
    """Every output over every input, at the frequencies f (K,) [Hz]; `beside` (K, n_y, n_u): what
    the model says; `loop`: whether what they are measured by follows the outputs, and whether it
    does so unseen. Bands are those of an open loop, so that nothing is usable in a closed one."""
    seen, unseen = loop
    usable = coherent & (not seen)
    half, radius = band_of(r), circle(r)
    for i, j in product(range(len(c.y)), range(len(c.u))):
        n = INTEGRATORS.get(c.outputs[i].name)
        yield Pair(
            output=c.outputs[i],
            input=c.inputs[j],
            frequency=f,
            value=r.value[:, i, j],
            half=half[:, i, j],
            radius=radius[:, i, j],
            coherence=r.coherence[:, i, j],
            coherent=coherent[:, i, j],
            usable=usable[:, i, j],
            form=lag_and_gain(f, r.value[:, i, j], r.error[:, i, j], usable[:, i, j], n),
            model=None if beside is None else beside[:, i, j],
            fed_back=seen or unseen,
        )


def _channels(
    inputs: Sequence[str],
    outputs: Sequence[str],
    references: Sequence[str],
    vehicle: Airframe | None,
    columns: Collection[str],
) -> _Channels:
    c = _Channels(
        inputs=channels(inputs, vehicle, "inputs", columns),
        outputs=channels(outputs, vehicle, "outputs", columns),
        references=channels(references, vehicle, "references", columns) if references else (),
    )
    names = [s.name for s in c.all]
    if both := sorted({n for n in names if names.count(n) > 1}):
        raise DataError(
            f"{', '.join(both)} is named as two things", fix="give every channel one part"
        )
    if c.references and len(c.references) < len(c.inputs):
        raise DataError(
            f"{len(c.references)} reference(s) for {len(c.inputs)} inputs",
            expected="at least as many",
            fix="name fewer inputs, or more references",
        )
    return c


def _stretches(data: Dataset, c: _Channels) -> tuple[list[FloatArray], dict[str, float]]:
    """Stretches (N_i, c) in which every channel was measured, and the seconds of each flight in
    them."""
    if len({f.dt for f in data.flights}) > 1:
        raise DataError(
            "flights with different sample times", fix="resample them: --rate, or read_logs(rate=)"
        )
    found: list[FloatArray] = []
    seconds: dict[str, float] = {}
    for flight in data.flights:
        for segment in flight.segments:
            columns = mixed(segment, c.all)
            known = np.asarray(np.isfinite(columns).all(axis=1))
            whole = [columns[a:b] for a, b in runs(known)]
            found += whole
            seconds[flight.name] = seconds.get(flight.name, 0.0) + flight.dt * sum(
                len(x) for x in whole
            )
    spread = (
        np.sqrt(np.sum([np.sum((x - x.mean(axis=0)) ** 2, axis=0) for x in found], axis=0))
        if found
        else None
    )
    size = np.max([np.abs(x).max(axis=0) for x in found], axis=0) if found else None
    for i, spec in enumerate(c.all):
        if spread is None or size is None or not spread[i] > STILL * size[i]:
            raise DataError(
                f"channel {spec.name} does not move",
                where=", ".join(data.names),
                fix="fly doublets, chirps or turns that move it"
                if found
                else "log all channels at one rate, or --rate",
            )
    return found, seconds


def _longest(lengths: Sequence[int], dt: float, sources: int, window: float | None) -> float:
    """The longest window [s] that leaves averages enough."""
    if window is not None and not POSITIVE.fits(window):
        raise DataError(f"window {shown(window)}", expected="a positive number of seconds")
    need = LEAST_AVERAGES + 2 * sources
    tried = [window] if window is not None else [LONGEST / 2**k for k in range(4)]
    for length in tried:
        n = 2 * round(length / dt / 2)
        if n >= 8 and averages_in(lengths, n) >= need:
            return float(length)
    least = tried[-1] if window is not None else SHORTEST
    raise DataError(
        f"too short: {sum(lengths) * dt:.3g} s, the longest without a gap {max(lengths) * dt:.3g} "
        "s",
        expected=f"about {0.53 * (need + 1) * least:.2g} s in stretches much longer than {least:g} "
        "s",
        fix="more or longer flights; of logs at several rates, --rate"
        if window is None
        else "a shorter --window",
    )


def _of_model(model: IdentifiedModel | LinearModel, c: _Channels, f: FloatArray) -> ComplexArray:
    """The model's response (K, p, q); NaN from half its sample rate on."""
    dynamics, who = model.dynamics, f"model {model.name}"
    seen = weights_of(c.outputs, dynamics.innovations.names, who, "output")
    driven = np.linalg.pinv(weights_of(c.inputs, dynamics.inputs.names, who, "input"))
    out = np.full((f.size, len(c.y), len(c.u)), np.nan, dtype=np.complex128)
    known = f < 0.49 / model.sample_time
    out[known] = seen @ response_of(model, f[known]) @ driven
    return out


def _smoothed(specs: Sequence[ChannelSpec], data: Dataset) -> list[str]:
    """Columns of `specs` that were smoothed with later samples."""
    return sorted({column for s in specs for _, column in s.terms} & data.noncausal)


def _warnings(
    c: _Channels,
    fed: Sequence[str],
    untold: Sequence[str],
    r: Response,
    data: Dataset,
    model: IdentifiedModel | LinearModel | None,
) -> list[str]:
    """`fed`: references, or inputs where there are none, that follow the outputs; `untold`: of which
    that cannot be told."""
    said = []
    if fed and c.z:
        said.append(
            f"{', '.join(fed)} follows the outputs itself: it is no reference from outside, and "
            "the estimate is biased"
        )
    elif fed:
        said.append(
            f"{', '.join(fed)} follow{'s' * (len(fed) == 1)} the outputs (a closed loop), or they "
            "hold later samples, which looks alike. In a closed loop, where gusts or noise move the "
            "craft more than the excitation does, what is seen is the controller, turned round, "
            "however high the coherence, so that no frequency is usable. Excite the set points, log "
            "them, and name them: greybox frf --references. In an open loop, log outputs as they are "
            "measured, or say in the log's layout which were smoothed: causal = false"
        )
    for j, spec in enumerate(c.inputs):
        if np.median(r.shared[:, j]) > TOGETHER:
            said.append(
                f"{spec.name} moves together with the other inputs: they cannot be told apart in "
                "these flights"
            )
        if c.z and not (r.instrument[:, j] > STRONG).any():
            said.append(f"the references hardly move {spec.name}")
    if smoothed := _smoothed((*c.outputs, *c.inputs), data):
        said.append(
            f"{', '.join(smoothed)} was smoothed with later samples: phases are not those of the "
            "craft"
        )
    if untold:
        late = ", ".join(_smoothed(c.outputs, data))
        said.append(
            f"whether {', '.join(untold)} follows {late} cannot be told, as later samples are in it: "
            "if so (a closed loop), the response is biased"
        )
    if model is not None:
        own, dt = model.sample_time, data.flights[0].dt
        if abs(own / dt - 1) > 1e-3:
            said.append(
                f"the flights have {1 / dt:.4g} Hz, the model {1 / own:.4g}: commands are held "
                "differently"
            )
    return said
