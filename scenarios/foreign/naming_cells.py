"""Cells of the judge of names: what hides in which craft, who flies it, how it is measured, what
its owner believes; and the folder that `greybox discover` is given.

    clean            nothing is hidden: the file declares the rotors' lag, which every craft has
    single:EFFECT    one effect of the catalogue (`single`: the seed chooses)
    pair, five       two or five of them, chosen by the seed
    outside:EFFECT   an effect that the catalogue does not have, or a simulator's own form
    imu              one effect; logs have gyro, accelerometer and commands only
    wind             wind of 2 to 12 m/s with rotor drag and inflow, all hidden
    power:N          an effect at a third of its size, N training flights (1, 2, 4, 8)

The seed chooses craft, simulator, gusts, sensors (ideal; or real: colour, vibration, low-pass, late
pose with jitter, steps, lost rows, drift, quaternions of 5 digits) and the vehicle file (exact;
wrong with its sigmas; wrong without any).
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from greybox.plants.controller import CascadeController
from greybox.plants.effects import RotorDrag
from greybox.plants.effects.base import PlantEffect
from greybox.plants.flight_log import Log, fly, write_log
from greybox.plants.noise import SensorNoise
from scenarios.foreign.craft import Air, Craft
from scenarios.foreign.draw import Draw, draw, logged
from scenarios.foreign.flights import (
    SAMPLE_TIME,
    TEST,
    TRAIN,
    WARM_UP,
    Plan,
    excitation_for,
    gains_for,
    path_for,
)
from scenarios.foreign.hidden import (
    CATALOGUED,
    DRAWN,
    NEEDS_DRAG,
    OUTSIDE,
    OWN,
    hidden_effect,
    outside_effect,
    settled,
    windy,
)
from scenarios.foreign.plant import ForeignPlant
from scenarios.foreign.stranger import Knowledge, vehicle_text

SIMULATORS = ("rotorpy", "mujoco", "drone_models")
FILES = ("exact", "wrong", "bare")
SECONDS = 16.0
TRAINING = 2
POWER = (1, 2, 4, 8)
WEAK = 1.0 / 3.0
"""Size of the effects of the power cells, as a share of what matters in flight."""
WINDS = (2.0, 12.0)
STEEP = 0.9
"""Largest tilt [rad] that the controller asks for in the wind cells."""
SETTLING = 4.0
"""Seconds flown there before a log begins, in which the controller finds its tilt."""
LAG_ERROR = 0.15
"""Standard deviation of a declared lag in a wrong file, relative."""
REAL = ("pose_delay", "sensor_delay", "command_delay", "gyro_bias")
POSE = ("qw", "qx", "qy", "qz", "x", "y", "z", "vx", "vy", "vz")
BY_IMU = (
    *("motor_lag", "command_delay", "thrust_curve", "battery_sag", "rotor_asymmetry"),
    *("rotational_damping", "products_of_inertia", "rotor_gyroscopic", "center_of_mass_offset"),
    *("rotor_drag", "accelerometer_lever_arm", "gyro_scale", "accelerometer_scale"),
)
"""Effects that gyro and accelerometer can show."""
TOGETHER = tuple(n for n in DRAWN if n not in (*NEEDS_DRAG, "command_saturation"))
"""Effects of pair and five."""
KINDS = ("clean", "single", "pair", "five", "outside", "imu", "wind", "power")


@dataclass(frozen=True, kw_only=True)
class Case:
    """One log of one cell.

    hidden: names that should be found; family: names that would not be wrong (outside cells); axes:
    those of force and torque that the effect acts on (outside cells); declared: effects that the
    vehicle file knows, with what it says; columns: "full" or "imu".
    """

    cell: str
    seed: int
    simulator: str
    base: Draw
    effects: tuple[PlantEffect, ...]
    hidden: tuple[str, ...]
    file: str
    gusts: bool
    family: tuple[str, ...] = ()
    axes: tuple[str, ...] = ()
    own: str | None = None
    declared: dict[str, dict[str, float]]
    columns: str = "full"
    flights: int = TRAINING

    @property
    def kind(self) -> str:
        """The cell without its effect."""
        return self.cell.split(":")[0]

    @property
    def sensors(self) -> str:
        """ideal or real."""
        return "ideal" if self.base.realism is None else "real"

    @property
    def true(self) -> tuple[str, ...]:
        """Names that are true of real sensors: their pose is late and so is a filtered IMU (both
        together: the commands), and the gyro's bias drifts."""
        return () if self.base.realism is None else REAL

    def truth(self) -> dict[str, float]:
        """Parameters of the hidden effects by catalogue name; those of the family stay out."""
        wanted = set(self.hidden)
        return {
            name: float(value)
            for effect in self.effects
            if effect.name in wanted
            for name, value in effect.parameters().items()
        }


def case_of(cell: str, seed: int) -> Case:
    """The log of this cell and seed. Raises ValueError for an unknown cell."""
    kind, _, which = cell.partition(":")
    if kind not in KINDS:
        raise ValueError(f"no such cell: {cell}; there are {', '.join(KINDS)}")
    random = np.random.default_rng([seed, 200, zlib.crc32(kind.encode())])
    simulator = str(random.choice(SIMULATORS))
    gusts, file = bool(random.random() < 0.5), str(random.choice(FILES))
    if kind == "outside" and not which:
        which = str(random.choice([*OUTSIDE, *OWN]))
    own = which if kind == "outside" and which in OWN else None
    if own is not None:
        simulator = OWN[own].simulator
    base = draw(seed, simulator)
    if own == "rotor_law":
        base = replace(base, fitted=str(random.choice(["cf2x_L250", "cf2x_P250", "cf21B_500"])))
    effects, names, declared = _hidden(kind, which, base.craft, random)
    if "motor_lag" not in names and own != "rotor_law":
        tau = base.craft.lag
        declared["motor_lag"] = {"tau": tau if file == "exact" else tau * _off(random)}
    stranger = OUTSIDE.get(which) or OWN.get(which) if kind == "outside" else None
    return Case(
        cell=f"outside:{which}" if kind == "outside" else cell,
        seed=seed,
        simulator=simulator,
        base=base,
        effects=effects,
        hidden=names,
        file=file,
        gusts=gusts,
        family=() if stranger is None else stranger.family,
        axes=() if stranger is None else stranger.axes,
        own=own,
        declared=declared,
        columns="imu" if kind == "imu" else "full",
        flights=int(which or TRAINING) if kind == "power" else TRAINING,
    )


def _off(random: np.random.Generator) -> float:
    return 1.0 + LAG_ERROR * float(np.clip(random.standard_normal(), -2.0, 2.0))


def _hidden(
    kind: str, which: str, craft: Craft, random: np.random.Generator
) -> tuple[tuple[PlantEffect, ...], tuple[str, ...], dict[str, dict[str, float]]]:
    """Effects, names to find, effects that the file declares."""
    frame = craft.airframe
    if kind == "wind":
        some = windy(frame, random, *WINDS)
        return some, tuple(e.name for e in some), {}
    if kind == "outside":
        return (() if which in OWN else (outside_effect(which, frame, random),)), (), {}
    count = {"clean": 0, "pair": 2, "five": 5}.get(kind, 1)
    pool = {"imu": BY_IMU, "single": DRAWN}.get(kind, TOGETHER)
    chosen = [str(n) for n in random.choice(pool, count, replace=False)]
    if kind in ("single", "imu") and which:
        chosen = [which]
    effects = [hidden_effect(n, frame, random) for n in chosen]
    if kind == "power":
        effects = [scaled(e, WEAK) for e in effects]
    declared: dict[str, dict[str, float]] = {}
    if set(chosen) & set(NEEDS_DRAG):
        # wind acts through a drag, which the file knows here
        drag = hidden_effect("rotor_drag", frame, random)
        assert isinstance(drag, RotorDrag)
        effects.append(drag)
        declared["rotor_drag"] = {"k_x": float(drag.k_x), "k_y": float(drag.k_y)}
    return tuple(effects), tuple(chosen), declared


def scaled(effect: PlantEffect, factor: float) -> PlantEffect:
    """The effect with all of its parameters `factor` times as large."""
    own = {name.split(".")[1] for name in effect.parameters()}
    changed: dict[str, Any] = {}
    for field in fields(effect):  # type: ignore[arg-type]
        value = getattr(effect, field.name)
        if isinstance(value, tuple):
            changed[field.name] = tuple(factor * v for v in value)
        elif field.name in own:
            changed[field.name] = factor * value
    return replace(effect, **changed)  # type: ignore[type-var]


def flown_craft(case: Case) -> tuple[Craft, tuple[PlantEffect, ...]]:
    """The craft that the simulator is given, and what acts on it from outside."""
    craft = replace(case.base.craft, air=air_of(case))
    craft, left = settled(case.simulator, craft, case.effects)
    if case.own == "fluid":
        craft = replace(craft, air=replace(craft.air, parasitic=(1.0, 1.0, 1.0)))
    if case.own == "linear_drag":
        drag = case.base.craft.air.rotor_drag
        craft = replace(craft, air=replace(craft.air, rotor_drag=drag))
    return craft, left


def air_of(case: Case) -> Air:
    """Gusts that push and turn every craft alike: 0.15 to 0.5 m/s^2, 0.5 to 2 rad/s^2."""
    if not case.gusts:
        return Air()
    random = np.random.default_rng([case.seed, 201])
    mass = float(case.base.craft.airframe.mass)
    push, turn, time = random.uniform(0.15, 0.5), random.uniform(0.5, 2.0), random.uniform(0.4, 1.5)
    return Air(push=mass * push, turn=turn, gust_time=time)


def plant_of(case: Case) -> ForeignPlant:
    """The plant. Raises MissingSimulator when its package is not installed."""
    craft, left = flown_craft(case)
    sensors: SensorNoise = case.base.sensors
    if case.simulator == "rotorpy":
        from scenarios.foreign.rotorpy_plant import RotorPyPlant

        return RotorPyPlant(craft, sensors=sensors, effects=left)
    if case.simulator == "mujoco":
        from scenarios.foreign.mujoco_plant import MuJoCoPlant

        return MuJoCoPlant(craft, sensors=sensors, effects=left)
    from scenarios.foreign.drone_models_plant import DroneModelsPlant

    return DroneModelsPlant(craft, sensors=sensors, effects=left, fitted=case.base.fitted)


def fly_case(case: Case, *, seconds: float = SECONDS) -> dict[str, Log]:
    """The flights by name (train1, ..., test1) before the sensors' faults, true states included."""
    plant = plant_of(case)
    plans: dict[str, Plan] = {f"train{k}": TRAIN[0] for k in range(1, case.flights + 1)}
    plans["test1"] = TEST[case.seed % len(TEST)]
    steep = case.kind == "wind"
    return {
        name: _flight(plant, plan, 100 * case.seed + k, seconds, steep=steep)
        for k, (name, plan) in enumerate(plans.items())
    }


def _flight(plant: ForeignPlant, plan: Plan, seed: int, seconds: float, *, steep: bool) -> Log:
    craft = plant.craft
    gains = gains_for(craft)
    if steep:
        gains = replace(gains, tilt_max=STEEP)
    return fly(
        plant,
        CascadeController(craft.airframe, gains),
        path_for(craft, plan),
        excitation_for(craft, plan.level),
        seconds,
        SAMPLE_TIME,
        seed,
        warm_up=SETTLING if steep else WARM_UP,
        record=("truth",),
    )


def knowledge(case: Case) -> Knowledge:
    """What the owner believes."""
    drawn = case.base.knowledge
    if case.file == "exact":
        return replace(drawn, mass=1.0, inertia=(1.0,) * 3, thrust=1.0, torque=1.0, sigmas=True)
    return replace(drawn, sigmas=case.file == "wrong")


def vehicle_file(case: Case) -> str:
    """The vehicle file of the case, with the effects that it declares."""
    frame = replace(
        case.base.craft.airframe, nominal_voltage=flown_craft(case)[0].airframe.nominal_voltage
    )
    text = vehicle_text(frame, knowledge(case), case.base.sensors)
    if case.file == "exact":
        text = _without_sigmas(text)
    for name, values in case.declared.items():
        text += f"\n[effects.{name}]\n"
        for key, value in values.items():
            sigma = LAG_ERROR * abs(value) if name == "motor_lag" else 0.0
            said = f"{{ value = {value:.6g}, sigma = {sigma:.6g} }}"
            text += f"{key} = {said if case.file == 'wrong' and sigma else f'{value:.6g}'}\n"
    return text


def _without_sigmas(text: str) -> str:
    """A file of schema 1 whose numbers stand bare, which means exact."""
    lines = []
    for line in text.replace("greybox.vehicle/2", "greybox.vehicle/1").splitlines():
        if "_sigma = " in line:
            continue
        if "{ value = " in line:
            line = line.split("{ value = ")[0] + line.split("{ value = ")[1].split(",")[0]
        lines.append(line)
    return "\n".join(lines) + "\n"


def write(case: Case, out: Path, *, seconds: float = SECONDS) -> dict[str, Log]:
    """Write vehicle.toml, the logs and truth.json; return the flights. `out` is made if it is
    missing."""
    out.mkdir(parents=True, exist_ok=True)
    logs = fly_case(case, seconds=seconds)
    left_out: tuple[str, ...] = () if case.base.rotor_speeds else ("omega",)
    if case.columns == "imu":
        left_out = (*left_out, *POSE)
    for k, (name, log) in enumerate(logs.items()):
        write_log(out / f"{name}.csv", logged(case.base, log, k), drop=left_out)
    (out / "vehicle.toml").write_text(vehicle_file(case), encoding="utf-8")
    text = json.dumps(described(case), indent=2)
    (out / "truth.json").write_text(text + "\n", encoding="utf-8")
    return logs


def described(case: Case) -> dict[str, Any]:
    """What truth.json says."""
    realism = case.base.realism
    return {
        "schema": "scenarios.naming/1",
        "cell": case.cell,
        "seed": case.seed,
        "simulator": case.simulator,
        "gusts": case.gusts,
        "sensors": case.sensors,
        "realism": None if realism is None else asdict(realism),
        "file": case.file,
        "columns": case.columns,
        "flights": case.flights,
        "hidden": list(case.hidden),
        "family": list(case.family),
        "axes": list(case.axes),
        "own": case.own,
        "declared": case.declared,
        "truth": case.truth(),
        "sensor_noise": asdict(case.base.sensors),
    }


def cells(asked: Iterable[str]) -> list[str]:
    """Cells by name, `power` as one per number of flights. Raises ValueError for an unknown one."""
    out: list[str] = []
    for cell in asked:
        kind, _, which = cell.partition(":")
        if kind not in KINDS:
            raise ValueError(f"no such cell: {cell}; there are {', '.join(KINDS)}")
        allowed: Sequence[str] = {
            "single": CATALOGUED,
            "imu": CATALOGUED,
            "outside": (*OUTSIDE, *OWN),
            "power": tuple(map(str, POWER)),
        }.get(kind, ())
        if which and which not in allowed:
            raise ValueError(f"{kind} takes {', '.join(allowed) or 'nothing'}, not {which}")
        out += [f"power:{n}" for n in POWER] if cell == "power" else [cell]
    return out
