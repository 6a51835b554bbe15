"""Open-loop predictions of an identified model in the channel groups of the multi-step tables.

From origin k the state is x_hat(k+1 | k), the filter's, from measurements up to k; recorded
commands drive k+1 .. k+H. Groups that the filter does not measure but whose state it carries
(velocity, where only the position is measured causally) are read from the predicted state.

What a sensor will read is predicted, its own lasting noise included as far as the filter knows it:
the reference is that sensor, and holding its last value repeats that noise too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace

import casadi as ca
import numpy as np

from greybox.estimation.ahead import OpenLoop, run_ahead
from greybox.estimation.engine import Engine
from greybox.estimation.filtering import Filtered
from greybox.estimation.reference_point import FEW, Fixed, once_per_model
from greybox.frames import numeric
from greybox.model.dynamics import Dynamics
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import physics_of, with_physics
from greybox.model.noise import sensor_errors
from greybox.model.sensors import SENSORS
from greybox.symbolic import FloatArray, IntArray, evaluate
from greybox.validation.groups import GROUPS, Group, groups_of

POSE = ("position", "velocity", "rotation")


class GroupReader:
    """Which groups a model predicts, and how their values are read from its outputs and states."""

    def __init__(self, model: IdentifiedModel) -> None:
        outputs = model.dynamics.outputs
        self.table = groups_of(model.dynamics)
        self._states = model.dynamics.states.names
        self._columns = {
            name: [outputs[c] for c in g.columns]
            for name, g in self.table.items()
            if all(c in outputs for c in g.columns)
        }
        self._velocity = (
            None
            if "velocity" in self._columns
            else _reading_of(model.dynamics, (), (model.sample_time,))
        )
        errors, at = sensor_errors(model.dynamics), model.dynamics.states
        self._errors = {
            name: [[at[n] for n in own] for own in errors[self.table[name].columns]]
            for name in self._columns
            if self.table[name].columns in errors
        }

    @property
    def groups(self) -> tuple[str, ...]:
        """Names of the groups that the model predicts, in the order of the tables."""
        own = {*self._columns, *(() if self._velocity is None else ("velocity",))}
        return tuple(g for g in self.table if g in own)

    def judged(self, channels: Iterable[str]) -> tuple[str, ...]:
        """Groups with a reference among `channels`; the specific force only where no pose is there
        (IMU-only logs)."""
        have = set(channels)
        there = [g for g in self.groups if have.issuperset(self.table[g].columns)]
        posed = any(p in there and not self.table[p].own for p in POSE)
        return tuple(g for g in there if g != "specific_force" or self.table[g].own or not posed)

    def state_rows(self, block: str) -> list[int]:
        """Places of a block ("position", "attitude", ...) in the state vector."""
        return [i for i, n in enumerate(self._states) if n.startswith(block + ".")]

    @property
    def needs_states(self) -> bool:
        """Whether the values are read from states too, not from the outputs alone."""
        return self._velocity is not None or bool(self._errors)

    def values(
        self,
        outputs: FloatArray,
        states: FloatArray | None,
        p: FloatArray,
        commands: FloatArray | None = None,
    ) -> dict[str, FloatArray]:
        """Group -> (..., dimension) from outputs (..., n_y), states (..., n_x) and commands (...,
        n_u) at p (n_p)."""
        read = {g: outputs[..., at] for g, at in self._columns.items()}
        if self._velocity is not None:
            assert states is not None
            assert commands is not None
            reading, rows, moves = self._velocity
            parts = [states[..., rows], commands[..., moves]]
            flat = np.concatenate(parts, axis=-1).reshape(-1, len(rows) + len(moves))
            read["velocity"] = evaluate(reading(p), flat).reshape(*states.shape[:-1], 3)
        for g, own in self._errors.items():
            assert states is not None
            error = np.sum([states[..., at] for at in own], axis=0)
            read[g] = _erring(self.table[g], read[g], error)
        return {g: read[g] for g in self.groups}

    def read(self, ahead: OpenLoop) -> dict[str, FloatArray]:
        """Group -> (m, steps, dimension) of runs in open loop, their states among them where
        `needs_states`."""
        commands = ahead.commands if self.needs_states else None
        return self.values(ahead.outputs, ahead.states, ahead.p, commands)


def _erring(kind: Group, value: FloatArray, error: FloatArray) -> FloatArray:
    """Values (..., dimension) that differ by `error` (..., error dimension) from `value`."""
    if kind.dimension == kind.error_dimension:
        return value + error
    turn = numeric("exp", error.reshape(-1, 3))
    return numeric("multiply", value.reshape(-1, 4), turn).reshape(value.shape)


def _velocity_reading(
    dynamics: Dynamics, sample_time: float
) -> tuple[Callable[[FloatArray], ca.Function], list[int], list[int]] | None:
    """How the velocity sensor would read: (p -> function of some states and commands, those states,
    those commands).

    None where no state carries the velocity. The command is taken as held through the delay.
    """
    physics = physics_of(dynamics)
    if physics is None or "position" not in physics.sensor_names:
        return None
    sensor = next(s for s in SENSORS if s.name == "velocity")
    seeing = with_physics(dynamics, lambda own: replace(own, sensors=(*own.sensors, sensor)))
    x, p = (
        ca.SX.sym("x", len(dynamics.states)),
        ca.SX.sym("p", len(dynamics.parameters)),
    )
    u = ca.SX.sym("u", len(physics.inputs))
    window = ca.repmat(u, 1, sum(seeing.window) + 1)
    quiet = ca.DM.zeros(len(seeing.noises))
    y = seeing.output(0, x, window, p, quiet, sample_time)
    v = y[[seeing.outputs[c] for c in GROUPS["velocity"].columns]]
    rows, moves = (
        [i for i in range(s.numel()) if any(ca.which_depends(v, s[i], 1, False))] for s in (x, u)
    )

    def at(values: FloatArray) -> ca.Function:
        fixed = ca.substitute(v, p, ca.DM(values))
        return ca.Function("velocity", [ca.vertcat(x[rows], u[moves])], [fixed])

    return at, rows, moves


def _build_reading(
    dynamics: Dynamics, _: tuple[str, ...], sample_time: Fixed
) -> tuple[Callable[[FloatArray], ca.Function], list[int], list[int]] | None:
    return _velocity_reading(dynamics, float(sample_time[0] or 0.0))


_reading_of = once_per_model(_build_reading, FEW)


def predict_from(
    engine: Engine,
    reader: GroupReader,
    filtered: Filtered,
    origins: IntArray,
    *,
    steps: int,
    measured_start: bool = False,
    references: Mapping[str, FloatArray] | None = None,
) -> dict[str, FloatArray]:
    """Group -> predictions (m, steps, dimension) of samples k+1 .. k+steps from every origin k.

    Past the end of the record the last command is held (those predictions have no reference). With
    `measured_start` the state at k is the measured one (`references`, smoothed velocities
    included), rotors and disturbances the filter's.
    """
    rows = np.asarray(origins, dtype=np.int64) + (0 if measured_start else 1)
    ahead = run_ahead(
        engine,
        starts=started_at_measurement(filtered, reader, rows, references or {}, engine.past)
        if measured_start
        else filtered.states[rows],
        rows=rows,
        steps=steps + 1 if measured_start else steps,
        inputs=filtered.record.inputs,
        p=filtered.p,
        dt=filtered.record.dt,
        want_states=reader.needs_states,
    )
    return reader.read(ahead.without_first() if measured_start else ahead)


def started_at_measurement(
    filtered: Filtered,
    reader: GroupReader,
    origins: IntArray,
    references: Mapping[str, FloatArray],
    past: int = 0,
) -> FloatArray:
    """States (m, n_x) at the origins whose outputs equal the measured pose, velocity and rate
    there.

    The predicted state x_hat(k | k-1) is moved by the difference between measured and predicted
    values (constant sensor offsets and turns stay as they are); a sample that is not measured
    leaves its part of the state as predicted. `past` is the number of commands before the first
    sample in the record.
    """
    states, commands = filtered.states[origins].copy(), filtered.record.inputs[origins + past]
    predicted = reader.values(filtered.outputs[origins], states, filtered.p, commands)
    for group, block in (
        ("position", "position"),
        ("velocity", "velocity"),
        ("rate", "rate"),
        ("rotation", "attitude"),
    ):
        at = np.array(reader.state_rows(block), dtype=np.intp)
        if group not in predicted or group not in references or not at.size:
            continue
        target = references[group][origins]
        seen = np.isfinite(target).all(axis=1)
        if not seen.any():
            continue
        if group == "rotation":
            # q_meas = q * q_mis: carry the predicted sensor-to-body turn over to the measured
            # attitude.
            conjugate = predicted[group][seen] * np.array([1.0, -1.0, -1.0, -1.0])
            turn = numeric("multiply", conjugate, states[np.ix_(seen, at)])
            moved = numeric("multiply", target[seen], turn)
            states[np.ix_(seen, at)] = moved / np.linalg.norm(moved, axis=1, keepdims=True)
        else:
            states[np.ix_(seen, at)] += target[seen] - predicted[group][seen]
    return states
