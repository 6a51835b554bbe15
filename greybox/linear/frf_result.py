"""FrequencyResponse: magnitude, phase, coherence and 95 % bands per pair of output and input, with
what they say in words."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NotRequired, TypedDict

import numpy as np

from greybox.data.channel import rotor_speed_names
from greybox.data.drive import LATE_SPEEDS
from greybox.estimation.lag_and_gain import FEWEST, LagAndGain, LagAndGainRow
from greybox.linear.logs import ChannelSpec
from greybox.runs import runs
from greybox.shown import Cell, Shown
from greybox.statistics.spectra import ComplexArray
from greybox.symbolic import BoolArray, FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SCHEMA = "greybox.frf/1"
TRUSTED = 0.6
"""Coherence from which on a response is used (Tischler and Remple 2012, chapter 7)."""
RATES = {"rad": "rad/s", "rad/s": "rad/s^2", "m": "m/s", "m/s": "m/s^2"}


@dataclass(frozen=True, kw_only=True, eq=False)
class Pair:
    """One response over `frequency` (K,) [Hz]: `value` (K,) complex, `magnitude` and `phase` [deg]
    with the ends of their 95 % intervals, `radius` (K,) of the circle that holds the complex value,
    `coherence` (K,), where it is `coherent` (K,) and where `usable` (K,): not where the inputs are
    seen to follow the outputs, as in a closed loop, where intervals do not hold. `form`: lag and
    gain; `model`: the response (K,) of a model, NaN above half its rate. `fed_back`: a closed loop
    may bias `value` by more than the circle says, so that it judges no model."""

    input: ChannelSpec
    output: ChannelSpec
    frequency: FloatArray
    value: ComplexArray
    half: FloatArray
    radius: FloatArray
    coherence: FloatArray
    coherent: BoolArray
    usable: BoolArray
    form: LagAndGain | None
    model: ComplexArray | None = None
    fed_back: bool = False

    @property
    def name(self) -> str:
        """output/input."""
        return f"{self.output.name}/{self.input.name}"

    @property
    def unit(self) -> str:
        """Unit of the magnitude."""
        below = self.input.signal.unit
        return self.output.signal.unit + ("" if below == "1" else f"/({below})")

    @property
    def magnitude(self) -> FloatArray:
        """Absolute value (K,)."""
        return np.abs(self.value)

    @property
    def magnitude_band(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper end (K,) of the 95 % interval."""
        return np.maximum(self.magnitude - self.half, 0.0), self.magnitude + self.half

    @property
    def phase(self) -> FloatArray:
        """[deg] (K,), without jumps between coherent frequencies."""
        return self.phase_of(self.value)

    @property
    def phase_half(self) -> FloatArray:
        """Half width [deg] (K,) of the 95 % interval of the phase; 180 where there is none."""
        share = self.half / np.maximum(self.magnitude, 1e-300)
        return np.where(share < 1, np.rad2deg(np.arcsin(np.minimum(share, 1.0))), 180.0)

    def phase_of(self, value: ComplexArray) -> FloatArray:
        """Phase [deg] of a response (K,), on the branch of the measured one."""
        own = np.angle(self.value)
        own[self.coherent] = np.unwrap(own[self.coherent])
        if value is self.value or not self.coherent.any():
            return np.asarray(np.rad2deg(own + np.angle(value / self.value)))
        turn, known = np.angle(value), np.isfinite(value)
        turn[known] = np.unwrap(turn[known])
        away = (own - turn)[self.coherent & known]
        whole = 2 * np.pi * np.round(np.median(away) / (2 * np.pi)) if away.size else 0.0
        return np.asarray(np.rad2deg(turn + whole))

    @property
    def outside(self) -> BoolArray | None:
        """Where (K,) the model lies outside the 95 % circle at a coherent frequency; None without
        one."""
        if self.model is None:
            return None
        with np.errstate(invalid="ignore"):
            return np.asarray(self.coherent & (np.abs(self.model - self.value) > self.radius))

    def coherent_bands(self) -> str:
        """The coherent frequencies in words."""
        parts = [self.frequency[a:b] for a, b in runs(self.coherent)]
        return ", ".join(
            f"{p[0]:.2g} to {p[-1]:.2g} Hz" if len(p) > 1 else f"{p[0]:.2g} Hz" for p in parts
        )

    def lines(self) -> Iterator[str]:
        """What there is to say, a line each."""
        if not self.coherent.any():
            yield (
                f"{self.name}: no frequency has coherence above {TRUSTED:g} (highest "
                f"{self.coherence.max():.2f})"
            )
            return
        closed = "" if self.usable.any() else ": not usable, the loop is closed or looks so"
        yield f"{self.name}: coherence above {TRUSTED:g} at {self.coherent_bands()}{closed}"
        if self.form is not None:
            yield "  " + self._form_line(self.form)
        elif self.usable.sum() >= FEWEST:
            yield (
                "  these frequencies tell no gain and no lag: excite lower ones, where the output "
                "still follows"
            )
        yield from (f"  {line}" for line in self.parts())

    def _form_line(self, f: LagAndGain) -> str:
        unit = self.output.signal.unit
        for _ in range(f.integrators):
            unit = RATES.get(unit, f"{unit}/s")
        per = "unit" if self.input.signal.unit == "1" else self.input.signal.unit
        line = (
            f"{self.input.name} shows in {self.output.name} after {1e3 * f.lag:.1f} +- "
            f"{1e3 * f.lag_std:.1f} ms (slope of the phase, {f.low:.2g} to {f.high:.2g} Hz), gain "
            f"{f.gain:.4g} +- {f.gain_std:.2g} {unit} per {per}"
        )
        early = f.lag + 2 * f.lag_std < 0
        mixed = [n for _, n in self.input.terms]
        speeds = len(rotor_speed_names(mixed)) == len(mixed)
        if early and speeds and f.lag > -LATE_SPEEDS:
            return line + ": speeds of rotors are often logged late"
        return line + (
            ": before it is sent, so that this is the controller and not the craft" if early else ""
        )

    def parts(self) -> Iterator[str]:
        """Where the model and the measured response part."""
        outside = self.outside
        if outside is None or self.model is None:
            return
        known = self.coherent & np.isfinite(self.model)
        place = "the model lies outside the 95 % circle"
        if self.fed_back:
            place = "model and flights part"
            yield (
                "this does not judge the model: a closed loop may bias the response of the "
                "flights by more than its 95 % circle; its predictions do (greybox validate)"
            )
        bands = [slice(a, b) for a, b in runs(outside) if b - a > 1]
        for s in bands:
            f, ratio = self.frequency[s], self.model[s] / self.value[s]
            off = np.abs(ratio - 1)
            worst = int(np.argmax(off))
            yield (
                f"{place} from {f[0]:.2g} to {f[-1]:.2g} Hz: {100 * np.median(off):.0f} % off, "
                f"most at {f[worst]:.2g} Hz ({abs(ratio[worst]):.2f} times the magnitude, "
                f"{np.rad2deg(np.angle(ratio[worst])):+.0f} deg)"
            )
        if not self.fed_back:
            yield (
                f"the model is inside the 95 % circle at {int((known & ~outside).sum())} of "
                f"{int(known.sum())} usable frequencies"
            )

    def to_dict(self) -> PairDocument:
        """Plain values, as in frf.json."""
        low, high = self.magnitude_band
        phase, half = self.phase, self.phase_half
        out: PairDocument = {
            "input": self.input.name,
            "output": self.output.name,
            "unit": self.unit,
            "real": self.value.real.tolist(),
            "imaginary": self.value.imag.tolist(),
            "radius": self.radius.tolist(),
            "magnitude": self.magnitude.tolist(),
            "magnitude_lower": low.tolist(),
            "magnitude_upper": high.tolist(),
            "phase_deg": phase.tolist(),
            "phase_lower_deg": (phase - half).tolist(),
            "phase_upper_deg": (phase + half).tolist(),
            "coherence": self.coherence.tolist(),
            "usable": self.usable.tolist(),
            "form": None if self.form is None else self.form.to_dict(),
            "model": None,
            "lines": [line.strip() for line in self.lines()],
        }
        if self.model is not None:
            assert self.outside is not None
            out["model"] = {
                "magnitude": np.abs(self.model).tolist(),
                "phase_deg": self.phase_of(self.model).tolist(),
                "outside": self.outside.tolist(),
            }
        return out


class ModelPart(TypedDict):
    """The model's response, and where (K,) it lies outside the measured band."""

    magnitude: list[float]
    phase_deg: list[float]
    outside: list[bool]


class PairDocument(TypedDict):
    """One pair of frf.json: arrays over frequency; its schema says more."""

    input: str
    output: str
    unit: str
    real: list[float]
    imaginary: list[float]
    radius: list[float]
    magnitude: list[float]
    magnitude_lower: list[float]
    magnitude_upper: list[float]
    phase_deg: list[float]
    phase_lower_deg: list[float]
    phase_upper_deg: list[float]
    coherence: list[float]
    usable: list[bool]
    form: LagAndGainRow | None
    model: ModelPart | None
    lines: list[str]


class ResponseDocument(TypedDict):
    """frf.json; the command once there is one."""

    schema: str
    line: str
    measured: bool
    model: str | None
    sample_time: float
    flights: dict[str, float]
    references: list[str]
    closed_by: list[str]
    frequency: list[float]
    averages: list[float]
    window: list[float]
    pairs: list[PairDocument]
    warnings: list[str]
    command: NotRequired[str]


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class FrequencyResponse(Shown):
    """Responses of flights, `pairs` by "output/input", over `frequency` (K,) [Hz].

    `averages` (K,) independent averages and `window` (K,) [s] behind each; `flights` seconds that
    were used by flight; `references` the signals that make it an estimate for closed loops.
    `closed_by`: what follows the outputs (references, or inputs where there are none), so that
    nothing is usable. `untold`: of which that cannot be told, as the outputs were smoothed with
    later samples. `model`: the name of the model beside it. `warnings`: what must be known first.
    """

    pairs: Mapping[str, Pair]
    frequency: FloatArray
    averages: FloatArray
    window: FloatArray
    flights: Mapping[str, float]
    sample_time: float
    references: tuple[str, ...] = ()
    closed_by: tuple[str, ...] = ()
    untold: tuple[str, ...] = ()
    model: str | None = None
    warnings: tuple[str, ...] = ()

    @property
    def measured(self) -> bool:
        """Whether any response has a frequency that can be used."""
        return any(p.usable.any() for p in self.pairs.values())

    @property
    def line(self) -> str:
        """The result in one line."""
        if self.closed_by:
            need = "no reference from outside" if self.references else "no reference"
            many = "" if len(self.closed_by) > 1 else "s"
            return (
                f"not measured: {', '.join(self.closed_by)} follow{many} the outputs (a closed loop, "
                f"or outputs with later samples), and {need} is named"
            )
        if not self.measured:
            return f"not measured: no frequency has coherence above {TRUSTED:g}"
        good = [p.name for p in self.pairs.values() if p.usable.any()]
        how = f" with {', '.join(self.references)} as reference" if self.references else ""
        if self.untold:
            how += f", if {', '.join(self.untold)} did not follow the outputs"
        return (
            f"measured{how}: {', '.join(good)}, from {sum(self.flights.values()):.0f} s of "
            f"{len(self.flights)} flight(s)"
        )

    def summary(self) -> str:
        """The result, then the warnings, then every pair."""
        pairs = self.pairs.values()
        lines = [self.line, *(f"warning: {w}" for w in self.warnings)]
        lines += [line for p in pairs if p.coherent.any() for line in p.lines()]
        if rest := [f"{p.name} {p.coherence.max():.2f}" for p in pairs if not p.coherent.any()]:
            lines.append(f"too low a coherence everywhere (highest): {', '.join(rest)}")
        return "\n".join(lines)

    def _shown_text(self) -> str:
        return self.summary()

    def _shown_rows(self) -> list[dict[str, Cell]]:
        """One row per pair and frequency."""
        return list(self.rows())

    def rows(self) -> Iterator[dict[str, Cell]]:
        """One row per pair and frequency, as in frf.csv."""
        for p in self.pairs.values():
            low, high = p.magnitude_band
            columns = {
                "frequency": p.frequency,
                "magnitude": p.magnitude,
                "magnitude_lower": low,
                "magnitude_upper": high,
                "phase_deg": p.phase,
                "phase_half_deg": p.phase_half,
                "coherence": p.coherence,
            }
            for k in range(len(p.frequency)):
                numbers = {n: float(v[k]) for n, v in columns.items()}
                yield {
                    "output": p.output.name,
                    "input": p.input.name,
                    **numbers,
                    "usable": bool(p.usable[k]),
                }

    def to_dict(self) -> ResponseDocument:
        """Plain values of frf.json (without the command)."""
        return {
            "schema": SCHEMA,
            "line": self.line,
            "measured": self.measured,
            "model": self.model,
            "sample_time": self.sample_time,
            "flights": dict(self.flights),
            "references": list(self.references),
            "closed_by": list(self.closed_by),
            "frequency": self.frequency.tolist(),
            "averages": self.averages.tolist(),
            "window": self.window.tolist(),
            "pairs": [p.to_dict() for p in self.pairs.values()],
            "warnings": list(self.warnings),
        }

    def plot(self, pair: str | None = None, *, ax: Sequence[Axes] | None = None) -> list[Axes]:
        """Magnitude and phase with their bands, and coherence, of one pair (the first one);
        matplotlib axes (three, where they are given)."""
        from greybox.plots import Curve, panels

        p = self.pairs[next(iter(self.pairs)) if pair is None else pair]
        shown = np.where(p.usable, 1.0, np.nan)
        rows = {
            f"{p.name} [{p.unit}]": [
                Curve(label="flights", x=p.frequency, y=p.magnitude * shown, spread=p.half)
            ],
            "phase [deg]": [
                Curve(label="flights", x=p.frequency, y=p.phase * shown, spread=p.phase_half)
            ],
            "coherence": [Curve(label="", x=p.frequency, y=p.coherence)],
        }
        if p.model is not None:
            first, second = list(rows)[:2]
            rows[first].append(Curve(label=self.model or "model", x=p.frequency, y=np.abs(p.model)))
            rows[second].append(
                Curve(label=self.model or "model", x=p.frequency, y=p.phase_of(p.model))
            )
        axes = panels(rows, x="frequency [Hz]", ax=ax)
        for axis in axes:
            axis.set_xscale("log")
        axes[0].set_yscale("log")
        return axes
