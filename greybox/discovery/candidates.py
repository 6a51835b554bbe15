"""Candidates: the whole catalogue in one model, every effect at its null; and what cannot be judged, with the reason.

At its null an effect is exactly absent, so that every smaller model is nested in the one that holds them all.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property

from greybox.discovery.velocity import moving
from greybox.errors import GreyboxError
from greybox.model.effect import Effect
from greybox.model.effects import CATALOGUE
from greybox.model.layer import physics_of
from greybox.model.model import PhysicsModel, build_model
from greybox.model.noise import Augmented
from greybox.model.sensors import on_clock
from greybox.model.vehicle import Vehicle

TOGETHER = (("motor_lag", "command_delay"),)
"""Effects whose slopes at the null are the same: they always enter a refit alone and together."""
TIMING = ("motor_lag", "command_delay", "sensor_delay", "pose_delay")
"""Lags and delays: only their sum is seen well, and a filter of the IMU looks like them."""
IN_OTHER_WORDS = {"command_delay": ("sensor_delay", "pose_delay")}
"""The same thing said otherwise: where all sensors are late by as much, no log tells that from late commands."""
INERTIAL = frozenset(on_clock("imu"))
LATE_ALIKE = ((INERTIAL, "sensor_delay"), (frozenset(on_clock("pose")), "pose_delay"))
"""Where nothing but these sensors is logged, their delay is the same thing as one of the commands."""
LOOK_ALIKES = (TIMING,)
"""Effects that a screening ranks badly against each other: where one of them is a contender all are."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidates:
    """`model` holds the known effects and all candidates; `parameters` maps a candidate to its full parameter names,
    `null` every one of these to its null; `core` are the core parameters that are free (their sigma is above zero) with
    those of known effects; `unjudged` maps an effect to the reason why the log cannot judge it; `moving` are those
    without which the log feels no velocity (drags, where neither position nor velocity is measured)."""

    model: PhysicsModel | Augmented
    parameters: Mapping[str, tuple[str, ...]]
    null: Mapping[str, float]
    core: tuple[str, ...]
    unjudged: Mapping[str, str]
    moving: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """The candidates in the order of the catalogue."""
        return tuple(self.parameters)

    @cached_property
    def physics(self) -> PhysicsModel:
        """The model without noise states."""
        physics = physics_of(self.model)
        assert physics is not None, "candidates are effects of a physics model"
        return physics

    @property
    def _sensors(self) -> frozenset[str]:
        return self.physics.sensor_names

    @property
    def blind(self) -> bool:
        """Whether nothing but rates and specific forces is measured."""
        return self._sensors <= INERTIAL

    @property
    def late_alike(self) -> str | None:
        """The delay of sensors that all that is measured has, which no log tells from late commands; None without one."""
        other = next((n for late, n in LATE_ALIKE if self._sensors and self._sensors <= late), None)
        # One that the vehicle file knows is no other word for a further one.
        return other if "command_delay" in self.parameters and (other in self.parameters or other in self.unjudged) else None

    @property
    def lags(self) -> frozenset[str]:
        """Candidates that bring rotors with a lag, where none is known."""
        late = {e.name for e in self.physics.effects if "lag" in e.early}
        return frozenset(late) if late <= set(self.parameters) else frozenset()

    def only(self, effects: Iterable[str]) -> PhysicsModel | Augmented:
        """The model that holds the known effects and some of the candidates."""
        chosen = set(effects)
        return self.model.without_effect(*(n for n in self.parameters if n not in chosen))


def candidates(
    vehicle: Vehicle,
    columns: Iterable[str],
    *,
    own: Iterable[Effect] = (),
    sample_time: float = 0.01,
    noncausal: Iterable[str] = (),
    kinematic_noise: bool = False,
) -> Candidates:
    """All effects of the catalogue and of the user's `own` that the vehicle file and the `columns` of the log allow.

    Effects in the vehicle file are known and not offered again. Raises `ModelError` for a log without sensors.
    """
    columns = tuple(columns)
    common = {"sample_time": sample_time, "noncausal": noncausal, "kinematic_noise": kinematic_noise}
    bare = build_model(vehicle, columns, (), **common)  # type: ignore[arg-type]
    known = {e.name for e in bare.effects}
    offered: list[Effect] = []
    unjudged: dict[str, str] = {}
    for effect in (*CATALOGUE, *own):
        if effect.name in known:
            continue
        missing = [c for c in effect.needs.columns if c not in columns]
        if missing:
            unjudged[effect.name] = f"no {', '.join(missing)}"
            continue
        if effect.name == "rotor_gyroscopic" and not bare.omega_known:
            unjudged[effect.name] = "no speed_max in the vehicle file"
            continue
        try:
            bare.with_effect(effect)
        except GreyboxError as error:
            unjudged[effect.name] = str(error)
            continue
        offered.append(effect)
    model = build_model(vehicle, columns, offered, **common)  # type: ignore[arg-type]
    parameters: dict[str, tuple[str, ...]] = {}
    null: dict[str, float] = {}
    for effect in offered:
        declared = effect.parameters(vehicle)
        parameters[effect.name] = tuple(f"{effect.name}.{d.name}" for d in declared)
        null |= {f"{effect.name}.{d.name}": float(d.null) for d in declared if d.null is not None}
    every = {p for ps in parameters.values() for p in ps}
    core = tuple(d.name for d in model.parameters if d.sigma > 0 and d.name not in every)
    return Candidates(
        model=model, parameters=parameters, null=null, core=core, unjudged=unjudged, moving=moving(bare, offered)
    )
