"""Decision and Recipe: what was chosen for a fit, why, and the whole as options that repeat it."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal

from greybox.estimation.options import FitOptions
from greybox.model.effect import Effect


@dataclass(frozen=True, kw_only=True)
class Decision:
    """One choice with its reason; `option` is what overrules it on the command line."""

    about: str
    choice: str
    reason: str
    option: str

    def line(self) -> str:
        """For a terminal."""
        return f"{self.about}: {self.choice} ({self.reason}) [{self.option}]"

    def to_dict(self) -> dict[str, str]:
        """Plain values for fit.json."""
        return {
            "about": self.about,
            "choice": self.choice,
            "reason": self.reason,
            "option": self.option,
        }


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Everything that an explicit fit needs besides vehicle file and logs.

    `rate` [Hz] is that to which the logs are resampled (None: their own), `effects` come besides
    those of the vehicle file, `adapt` [s] are the first seconds of a new flight from which its own
    parameters are taken (None: no parameter has a value per flight).
    """

    effects: tuple[str | Effect, ...] = ()
    input: Literal["command", "speed"] = "command"
    kinematic_noise: bool = False
    rate: float | None = None
    adapt: float | None = None
    options: FitOptions = field(default_factory=FitOptions)

    @property
    def effect_names(self) -> tuple[str, ...]:
        """Names of the effects; one from a user's file stands for its name."""
        return tuple(e if isinstance(e, str) else e.name for e in self.effects)

    def arguments(self) -> list[str]:
        """The options of `greybox fit` that give this fit, --manual first: nothing is left open."""
        words = ["--manual"]
        if self.rate is not None:
            words += ["--rate", repr(self.rate)]
        if self.effects:
            words += ["--effects", ",".join(self.effect_names)]
        if self.input != "command":
            words += ["--input", self.input]
        if self.kinematic_noise:
            words.append("--kinematic-noise")
        if self.adapt is not None:
            words += ["--adapt", f"{self.adapt:g}"]
        return words + self.options.command_line()

    def command_line(self, vehicle: str, train: Iterable[str], test: Iterable[str] = ()) -> str:
        """The explicit command of this fit."""
        words = ["greybox", "fit", "--vehicle", vehicle, "--train", *train]
        held_out = list(test)
        words += ["--test", *held_out] if held_out else []
        return shlex.join([*words, *self.arguments()])

    def to_python(self) -> str:
        """The same as Python source, for `vehicle` and `data` as read."""
        options = ", ".join(f"{k}={v!r}" for k, v in self.options.to_dict().items())
        build = (
            f"gb.build_model(vehicle, data.channels, {list(self.effect_names)!r}, "
            "sample_time=data.flights[0].dt"
        )
        build += ", noncausal=data.noncausal"
        if self.input != "command":
            build += f", input={self.input!r}"
        if self.kinematic_noise:
            build += ", kinematic_noise=True"
        return f"model = {build})\nresult = gb.fit(model, data, {options})"

    def to_dict(self) -> Mapping[str, object]:
        """Plain values for fit.json."""
        return {
            "effects": list(self.effect_names),
            "input": self.input,
            "kinematic_noise": self.kinematic_noise,
            "rate": self.rate,
            "adapt": self.adapt,
            "options": self.options.to_dict(),
        }
