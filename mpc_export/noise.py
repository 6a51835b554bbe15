"""Noise: the identified filter and process noise at the controller's sample time, as plain numbers.

White noise that is constant over a step keeps its intensity: variance times sample time is the same
at every sample time. What is correlated in time keeps its stationary variance (each kind of noise
part says how). Sensor noise is one per sample, whatever the rate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from greybox.estimation.gain import stationary
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import layers
from greybox.model.noise import Augmented
from greybox.symbolic import FloatArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Noise:
    """Numbers of the stationary filter and of the covariance step, in error coordinates, history
    states included as zeros.

    gain K (n_d, n_e), innovation covariance S (n_e, n_e), cross N (n_d, n_e) with K = N S^-1,
    covariance P (n_d, n_d) of the predicted state, process Q (n_d, n_d) per step of an open-loop
    prediction, sensor (n_e,) standard deviations. filtered (n_d, n_d): Q of the filter, which P
    belongs to. unfiltered (n_d, n_d): the part of Q that it does not allow for, where errors ahead
    are larger than one step ahead says.
    """

    gain: FloatArray
    innovation: FloatArray
    cross: FloatArray
    covariance: FloatArray
    process: FloatArray
    sensor: FloatArray
    filtered: FloatArray
    unfiltered: FloatArray


def levels_at(model: IdentifiedModel, levels: FloatArray, dt: float) -> FloatArray:
    """Process-noise standard deviations (n_w) of the model for steps of dt seconds instead of its
    own sample time."""
    own = model.sample_time
    if math.isclose(own, dt, rel_tol=1e-12):
        return levels
    for layer in layers(model.dynamics):
        if isinstance(layer, Augmented):
            return np.asarray(levels * layer.rescaled(model.values, own, dt))
    return np.asarray(levels * math.sqrt(own / dt))


def identified_noise(
    model: IdentifiedModel,
    dt: float,
    matrices: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    extra: int,
) -> Noise:
    """From the noise levels of a fit and A, G, C, D of the model at its reference point; `extra`
    history states."""
    _, g, _, d = matrices
    noise = levels_at(model, model.process_noise, dt)
    ahead = noise if model.horizon_noise is None else levels_at(model, model.horizon_noise, dt)
    found = stationary(matrices, noise**2, model.sensor_noise**2, model.weak**2)
    gain, covariance = found.gain(np.ones(d.shape[0]))[:2]
    return Noise(
        gain=_rows(gain, extra),
        innovation=covariance,
        cross=_rows(found.N, extra),
        covariance=_square(found.P, extra),
        process=_square((g * ahead**2) @ g.T, extra),
        sensor=np.asarray(model.sensor_noise, dtype=float),
        filtered=_square((g * noise**2) @ g.T, extra),
        unfiltered=_square((g * np.maximum(ahead**2 - noise**2, 0.0)) @ g.T, extra),
    )


def innovation_noise(k: FloatArray, covariance: FloatArray, extra: int) -> Noise:
    """Of an innovation form with gain K (n_d, n_e) and cov(e): the filter is the model, P = 0 and S
    = cov(e)."""
    return Noise(
        gain=_rows(k, extra),
        innovation=covariance,
        cross=_rows(k @ covariance, extra),
        covariance=np.zeros((len(k) + extra,) * 2),
        process=_square(k @ covariance @ k.T, extra),
        sensor=np.sqrt(np.diag(covariance)),
        filtered=_square(k @ covariance @ k.T, extra),
        unfiltered=np.zeros((len(k) + extra,) * 2),
    )


def _rows(matrix: FloatArray, extra: int) -> FloatArray:
    return np.vstack([matrix, np.zeros((extra, matrix.shape[1]))])


def _square(matrix: FloatArray, extra: int) -> FloatArray:
    return np.asarray(np.pad(matrix, (0, extra)))


def parameter_covariance(model: object) -> tuple[tuple[str, ...], FloatArray]:
    """(names, covariance) of the shared parameters of a fit and of those that were held although
    they are not exact: the ratio of thrust to a mass that was held is known better than either.
    Empty for a model without."""
    if not isinstance(model, IdentifiedModel):
        return (), np.zeros((0, 0))
    declared = {d.name for d in model.dynamics.parameters}
    names, joint = model.joint_covariance
    at = [i for i, n in enumerate(names) if n in declared]
    return tuple(names[i] for i in at), np.nan_to_num(joint[np.ix_(at, at)])
