"""The frequency response of a model about one point, with its delays exactly as the model steps.

H(z) = C (z I - A)^-1 B(z) + D(z),  z = exp(j omega dt),  B(z) = sum over j of B_j z^(j - past)

B_j and D_j are the slopes of step and output with respect to column j of the command window: a
delay of the model is an interpolation of that window, so that it is in the response to the last
digit.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
import numpy.typing as npt

from greybox.errors import ModelError
from greybox.model.dynamics import Dynamics
from greybox.model.identified import IdentifiedModel
from greybox.model.linear import LinearModel
from greybox.model.linearise import deviations
from greybox.model.parameter import nominal_values
from greybox.symbolic import FloatArray


def response_of(
    model: IdentifiedModel | LinearModel, frequency: FloatArray
) -> npt.NDArray[np.complex128]:
    """Response (K, n_e, n_u) of the innovation components (a measured quaternion: three angles) to
    the inputs at `frequency` (K,) [Hz], about the mean state and command of the model's training.

    Raises `ModelError` at and above half the model's sample rate.
    """
    dynamics, dt, x, u, p = _point(model)
    return _response(dynamics, dt, frequency, x, u, p)


def step_response(model: IdentifiedModel | LinearModel, steps: int) -> FloatArray:
    """What the innovation components do in samples 0 to `steps` - 1 (steps, n_e, n_u) after a
    unit step of each input at sample 0, about the same point: a deviation, and of the linearised
    model."""
    dynamics, dt, x, u, p = _point(model)
    past = dynamics.window[0]
    a, c, b, d = _slopes(dynamics, dt, x, u, p)
    columns = b.shape[1] // len(u)
    b, d = (m.reshape(len(m), columns, len(u)) for m in (b, d))
    state, out = np.zeros((len(a), len(u))), np.zeros((steps, len(c), len(u)))
    for k in range(steps):
        pushed = np.arange(columns) - past + k >= 0
        out[k] = c @ state + d[:, pushed].sum(axis=1)
        state = a @ state + b[:, pushed].sum(axis=1)
    return out


def _point(
    model: IdentifiedModel | LinearModel,
) -> tuple[Dynamics, float, FloatArray, FloatArray, FloatArray]:
    """(dynamics, sample time [s], state, inputs, parameters) where a model is linearised."""
    if isinstance(model, LinearModel):
        values = nominal_values(model.parameters)
        p = np.array([values[d.name] for d in model.parameters])
        return model, model.dt, np.zeros(model.order), model.input_offset, p
    x, u = model.reference_state, model.reference_inputs
    return model.dynamics, model.sample_time, x, u, model.parameter_vector()


def _response(
    model: Dynamics, dt: float, frequency: FloatArray, x: FloatArray, u: FloatArray, p: FloatArray
) -> npt.NDArray[np.complex128]:
    if frequency.size and frequency.max() >= 0.5 / dt:
        raise ModelError(
            f"{model.name} has no response at {frequency.max():.3g} Hz",
            expected=f"below half its rate, {0.5 / dt:.4g} Hz",
        )
    past = model.window[0]
    a, c, b, d = _slopes(model, dt, x, u, p)
    columns = b.shape[1] // len(u)
    out = np.zeros((frequency.size, len(c), len(u)), dtype=np.complex128)
    for k, z in enumerate(np.exp(2j * np.pi * frequency * dt)):
        shift = z ** (np.arange(columns) - past)
        b_z, d_z = (m.reshape(len(m), columns, len(u)).transpose(0, 2, 1) @ shift for m in (b, d))
        out[k] = c @ np.linalg.solve(z * np.eye(len(a)) - a, b_z) + d_z
    return out


def _slopes(
    model: Dynamics, dt: float, x: FloatArray, u: FloatArray, p: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """A (n_d, n_d), C (n_e, n_d), and slopes (n, columns n_u) by the window, column by column."""
    past, future = model.window
    columns, n_u = past + 1 + future, len(u)
    window = ca.SX.sym("window", n_u, columns)
    delta = ca.SX.sym("delta", len(model.error_states))
    x0, at_rest = ca.DM(x), ca.repmat(ca.DM(u), 1, columns)
    moved = model.boxplus(x0, delta), window
    after, seen = deviations(model, dt, (x0, at_rest), moved, ca.DM(p))
    by = (delta, ca.vec(window))
    slopes = [ca.densify(ca.jacobian(q, v)) for v in by for q in (after, seen)]
    found = ca.Function("slopes", [delta, window], slopes)(0, at_rest)
    a, c, b, d = (np.asarray(m, dtype=np.float64) for m in found)
    return a, c, b, d
