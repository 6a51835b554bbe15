"""How the deviations of a closed loop at different stages of a plan hang together.

True state - plan = e + h: e the filter's error, h what the estimate has moved away from the plan.
Between two stages

    e+ = F e + ...,   h+ = (A + B K) h + (A - F) e + ...,   F = (A_1 - L C_1)^m,

with A_1, C_1 and the predictor's gain L at the filter's sample time and m filter steps a stage: the
estimate moves by innovations, and these see e. e and h of one stage are uncorrelated (separation
principle), of different stages they are not (Anderson and Moore 1979, chapter 5). Errors of
parameters and of the learned function stay as they are.
"""

from __future__ import annotations

import numpy as np

from greybox.symbolic import FloatArray
from mpc_export.functions import ModelFunctions
from mpc_export.tube.stages import Stages


def error_transition(filter_: ModelFunctions, steps: int, size: int) -> FloatArray:
    """F (size, size) of the filter's error over `steps` of its samples at hover; what it does not
    have is known: zero."""
    x, u = filter_.reference
    _, a, _, _ = (v.full() for v in filter_["f_d_jac"](x, u, filter_.parameter_values))
    _, c, _, _ = (v.full() for v in filter_["h_jac"](x, u, filter_.parameter_values))
    own = len(filter_.error_states) - (len(filter_.states) - filter_.own_states)
    one = (a - filter_.noise.gain @ c)[:own, :own]
    full = np.zeros((size, size))
    full[:own, :own] = np.linalg.matrix_power(one, steps)
    return full


def innovations(filter_: ModelFunctions, steps: int, size: int) -> FloatArray:
    """W (size, size): what the filter's innovations move the estimate by over `steps` of its
    samples at hover.

    Innovations L e of covariance L S L' are white, and go on with the model: W = sum_i A_1^i (L S L'
    + U) A_1^i', i < steps. U is the noise that the model knows of several steps ahead and its filter
    does not (`Noise.unfiltered`): with it, estimate and error move at least as the state does, W + P is
    at least A P A' + Q, and equal to it where Q is nowhere below the filter's.
    """
    x, u = filter_.reference
    _, a, _, _ = (v.full() for v in filter_["f_d_jac"](x, u, filter_.parameter_values))
    own = len(filter_.error_states) - (len(filter_.states) - filter_.own_states)
    noise = filter_.noise
    one = (noise.gain @ noise.innovation @ noise.gain.T + noise.unfiltered)[:own, :own]
    a = a[:own, :own]
    total = np.zeros((own, own))
    for _ in range(steps):
        total = a @ total @ a.T + one
    full = np.zeros((size, size))
    full[:own, :own] = total
    return full


def correlation(
    model: ModelFunctions, made: Stages, transition: FloatArray, normal: FloatArray, length: int
) -> FloatArray:
    """(length, length) correlation of normal . (true state - plan) between the stages 1..length of
    a plan at hover.

    normal (n_d,) in error coordinates; transition: `error_transition` over one stage.
    """
    x, u = made.steady
    _, a, b, _ = (v.full() for v in model["f_d_jac"](x, u, model.parameter_values))
    n, p = len(a), model.parameter_values
    closed = a + b @ made.gain
    joint = np.block([[transition, np.zeros((n, n))], [a - transition, closed]])
    z, c, bias = (
        np.zeros((n, n)),
        np.zeros((n, model.sizes["n_g"])),
        np.zeros((n, model.sizes["n_theta"])),
    )
    covariances, constant = [], np.zeros((length + 1, model.sizes["n_g"] + model.sizes["n_theta"]))
    values, vectors = np.linalg.eigh(model.covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    for k in range(length + 1):
        covariances.append(np.block([[made.estimate, np.zeros((n, n))], [np.zeros((n, n)), z]]))
        constant[k] = np.concatenate([normal @ c, normal @ bias @ root])
        _, z, c, bias = (v.full() for v in made.functions["tube_spread"](x, u, p, z, c, bias))
    row = np.concatenate([normal, normal])
    found = constant[1:] @ constant[1:].T
    for i in range(1, length + 1):
        moved = covariances[i] @ row
        for j in range(i, length + 1):
            found[j - 1, i - 1] += row @ moved
            found[i - 1, j - 1] = found[j - 1, i - 1]
            moved = joint @ moved
    size = np.sqrt(np.diag(found))
    return np.asarray(found / np.outer(size, size))
