"""from_gpytorch: a GP that was trained in GPyTorch (or BoTorch) as plain numbers, CasADi
expressions and C.

    gp = from_gpytorch(model, likelihood)
    gp.mean(z), gp.variance(z), gp.mean_jacobian(z)      # CasADi expressions
    gp.function("gp")                                    # a CasADi function, without PyTorch
    gp.save("gp.json")                                   # `greybox export gp.json --out gp` writes
    C

What comes out is GPyTorch's own posterior in exact arithmetic (Cholesky factors, no approximations
by iterations), not a guarded one. Before it is handed back it is compared with the model itself at
a few points, so that a `forward` which does something else than its mean and covariance module is
refused and not exported wrongly. PyTorch is imported only by whoever made the model.
"""

from __future__ import annotations

import copy
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.linalg import block_diag

from greybox.errors import ModelError
from greybox.residual.covariances.covariance import numbers
from greybox.residual.gaussian_process import Base, GaussianProcess, Latent
from greybox.residual.gpytorch_models import Posterior, kinds, read_model
from greybox.residual.posterior import Domain
from greybox.symbolic import FloatArray, Layout, Signal

if TYPE_CHECKING:
    import torch

    Model: TypeAlias = torch.nn.Module
    """A model or a likelihood of GPyTorch."""
    Models: TypeAlias = list[Model] | tuple[Model, ...]

PROBES = 6
"""Points, at and around the training inputs, at which the numbers are compared with the model."""
AGREEMENT = 1e-6
"""Largest difference there, of the mean in units of its prior deviation and of the variance in
those of the prior's."""
DOMAIN_SAMPLES = 2000
Affine = tuple[npt.ArrayLike, npt.ArrayLike]


def from_gpytorch(
    model: Model | Models,
    likelihood: Model | None = None,
    *,
    inputs: Layout | Sequence[str] | None = None,
    outputs: Layout | Sequence[str] | None = None,
    input_transform: Affine | None = None,
    output_transform: Affine | None = None,
) -> GaussianProcess:
    """The posterior of a trained GPyTorch model as a `GaussianProcess`.

    `model` is an ExactGP (one output, a batch of independent outputs, MultitaskKernel, LCMKernel;
    also on inducing points) or an ApproximateGP (VariationalStrategy or
    UnwhitenedVariationalStrategy; independent outputs, LMC). Lists of such models
    (IndependentModelList, BoTorch's ModelListGP) and a BoTorch SingleTaskGP with its input and
    outcome transforms are taken, too. `likelihood` defaults to `model.likelihood`. `inputs` and
    `outputs` name the signals (or give a `Layout` with units). Models that were trained on
    standardised data take `input_transform` = (mean, scale) (n_in,), x = (z - mean)/scale, and
    `output_transform` = (mean, scale) (n_out,), y = mean + scale f. The model is not changed.

    Raises `ModelError` that names what is not supported and where ("SpectralMixtureKernel in
    covar_module.kernels.1"), for a noise that is not positive and for sizes that do not fit;
    `DataError` for an exact model without data."""
    if _members(model) is not None:
        return _stacked(model, likelihood, inputs, outputs, input_transform, output_transform)
    if likelihood is None:
        likelihood = getattr(model, "likelihood", None)
    if likelihood is None:
        raise ModelError("no likelihood", fix="from_gpytorch(model, likelihood)")
    own, likelihood, jitter = _copy(model, likelihood)
    posterior = read_model(own, likelihood, jitter)
    center, scale, outcome = _transforms(own, posterior.inputs.shape[1])
    told = _reference(own)
    gp = _assembled(posterior, center, scale, outcome)
    _compare(gp, posterior, told, center, scale)
    return _named(_scaled(gp, input_transform, output_transform), inputs, outputs)


# -------------------- lists of models


def _members(model: Model | Models) -> list[Model] | None:
    """The models of a list of models."""
    if isinstance(model, (list, tuple)):
        return list(model)
    if kinds(model) & {"IndependentModelList", "ModelListGP", "ModelList"}:
        return list(model.models)
    return None


def _stacked(
    model: Model | Models,
    likelihood: Model | None,
    inputs: Layout | Sequence[str] | None,
    outputs: Layout | Sequence[str] | None,
    input_transform: Affine | None,
    output_transform: Affine | None,
) -> GaussianProcess:
    """One process with the outputs of all models of a list."""
    models = _members(model)
    assert models is not None
    given = getattr(likelihood, "likelihoods", likelihood)
    each = (
        list(given)
        if given is not None and not hasattr(given, "forward")
        else [given] * len(models)
    )
    if not models or len(each) != len(models):
        raise ModelError(
            "a list of models",
            expected="one likelihood for each model",
            got=f"{len(each)} of {len(models)}",
        )
    parts = [from_gpytorch(m, likelihood) for m, likelihood in zip(models, each)]
    first = parts[0]
    if any(len(p.inputs) != len(first.inputs) for p in parts):
        raise ModelError("the models of the list have inputs of different sizes")
    if any(
        not np.array_equal(getattr(p, n), getattr(first, n))
        for p in parts
        for n in ("input_mean", "input_scale")
    ):
        raise ModelError(
            "the models of the list transform their inputs differently",
            fix="export them one by one",
        )
    latents: list[Latent] = []
    bases: list[Base] = []
    for part in parts:
        latents += [replace(f, bases=tuple(q + len(bases) for q in f.bases)) for f in part.latents]
        bases += part.bases
    noise = np.concatenate([p.noise for p in parts])
    names = [f"f{i + 1}" for i in range(len(noise))]
    whole = replace(
        first,
        bases=tuple(bases),
        latents=tuple(latents),
        mixing=block_diag(*(p.mixing for p in parts)),
        outputs=Layout([Signal(name=n, unit="1") for n in names]),
        output_mean=np.concatenate([p.output_mean for p in parts]),
        output_scale=np.concatenate([p.output_scale for p in parts]),
        noise=noise,
        offset=np.concatenate([p.offset for p in parts]),
    )
    return _named(_scaled(whole, input_transform, output_transform), inputs, outputs)


# -------------------- the model's copy


def _copy(model: Model, likelihood: Model) -> tuple[Model, Model, float]:
    """(model, likelihood) in float64 and evaluation mode, apart from the user's, and the
    variational jitter.

    The jitter depends on the precision of the model as it was handed over.
    """
    kept = getattr(model, "prediction_strategy", None)
    if kept is not None:
        model.prediction_strategy = None
    try:
        pair = copy.deepcopy((model, likelihood))
    except (RuntimeError, TypeError) as error:
        raise ModelError(f"the model cannot be copied ({str(error).splitlines()[0]})") from None
    finally:
        if kept is not None:
            model.prediction_strategy = kept
    own, noise = pair
    jitter = 0.0
    for strategy in _strategies(own):
        if getattr(strategy, "jitter_val", None) is not None:
            jitter = float(strategy.jitter_val)
            strategy.jitter_val = jitter
    own, noise = own.double(), noise.double()
    own.eval()
    noise.eval()
    _settle(own)
    for part in (own, noise):
        for p in part.parameters():
            if not np.isfinite(numbers(p)).all():
                raise ModelError(
                    "a parameter of the model is NaN or infinite", fix="train it again"
                )
    return own, noise, jitter


def _settle(model: Model) -> None:
    """Variational parameters as GPyTorch's next call would have them. Raises `ModelError` where
    that would draw them."""
    for strategy in _strategies(model):
        ready = getattr(strategy, "variational_params_initialized", None)
        if ready is not None and not bool(numbers(ready)):
            raise ModelError(
                "the variational parameters were never set",
                fix="train the model, or load a state_dict of a trained one",
            )
        whitened = getattr(strategy, "updated_strategy", None)
        if whitened is not None and not bool(numbers(whitened)):
            _reference(model)  # a state of an old GPyTorch, which the first call converts


def _strategies(model: Model) -> Iterator[Model]:
    """Its variational strategy and what this wraps, the outermost first; none of an exact GP."""
    strategy = getattr(model, "variational_strategy", None)
    while strategy is not None:
        yield strategy
        strategy = getattr(strategy, "base_variational_strategy", None)


@contextmanager
def _exactly() -> Iterator[None]:
    """GPyTorch with Cholesky factors throughout."""
    settings, torch = sys.modules["gpytorch"].settings, sys.modules["torch"]
    chosen = (
        settings.fast_computations(False, False, False),
        settings.fast_pred_var(False),
        settings.max_cholesky_size(10**9),
        settings.debug(False),
        torch.no_grad(),
    )
    with ExitStack() as stack:
        stack.enter_context(warnings.catch_warnings())
        warnings.simplefilter("ignore")
        for setting in chosen:
            stack.enter_context(setting)
        yield


def _reference(model: Model) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(x (P, n_in), mean (P, n_out), variance (P, n_out)) of the model itself, in its own units,
    at a few points."""
    torch = sys.modules["torch"]
    inputs = getattr(model, "train_inputs", None)
    seen = inputs[0] if inputs is not None else [*_strategies(model)][-1].inducing_points
    batch = tuple(seen.shape[:-2]) if inputs is not None else ()
    x = numbers(seen)
    x = x[:, None] if x.ndim == 1 else x.reshape(-1, *x.shape[-2:])[0]
    rng = np.random.default_rng(0)
    spread = np.std(x, axis=0) + 1e-3
    points = x[rng.integers(0, len(x), PROBES)] + 0.3 * spread * rng.standard_normal(
        (PROBES, x.shape[1])
    )
    with _exactly():
        given = torch.tensor(points)
        try:
            told = model(given.expand(*batch, *given.shape))
            mean, variance = numbers(told.mean), numbers(told.variance)
        except Exception as error:  # whatever a model of the user's raises
            said = f"{type(error).__name__}: {str(error).splitlines()[0]}"
            raise ModelError(
                f"the model itself cannot be evaluated ({said})",
                fix="see that model(x) works in evaluation mode",
            ) from None
    if "MultitaskMultivariateNormal" in kinds(told):
        return points, mean.reshape(PROBES, -1), variance.reshape(PROBES, -1)
    return points, mean.reshape(-1, PROBES).T, variance.reshape(-1, PROBES).T


def _compare(
    gp: GaussianProcess,
    posterior: Posterior,
    told: tuple[FloatArray, FloatArray, FloatArray],
    center: FloatArray,
    scale: FloatArray,
) -> None:
    """Raises `ModelError` where the numbers are not the model's."""
    points, mean, variance = told
    z = points * scale + center
    got_mean, got_variance = gp.evaluate(z)
    got_mean = (got_mean - gp.output_mean) / gp.output_scale
    got_variance = got_variance / gp.output_scale**2
    if got_mean.shape != mean.shape:
        raise ModelError(
            "the model's output has another size than its modules",
            expected=f"{mean.shape[1]} outputs",
            got=f"{got_mean.shape[1]}",
            fix="see that forward returns mean_module(x) and covar_module(x)",
        )
    prior = [
        sum(
            a * gp.bases[q].covariance.variance(points.T, np).ravel()
            for a, q in zip(f.prior, f.bases)
        )
        for f in posterior.latents
    ]
    size = np.maximum(np.stack(prior, axis=1) @ (posterior.mixing**2).T, 1e-12)
    worst = max(
        float((np.abs(got_mean - mean) / (np.sqrt(size) + np.abs(mean))).max()),
        float((np.abs(got_variance - variance) / size).max()),
    )
    if not worst <= AGREEMENT:
        raise ModelError(
            "the model computes something else than its mean_module and covar_module say",
            expected=f"a difference below {AGREEMENT:g} of the prior",
            got=f"{worst:.2g}",
            fix="see that forward does nothing to x and returns mean_module(x) and covar_module(x)",
        )


# -------------------- transforms


def _transforms(
    model: Model, n_in: int
) -> tuple[FloatArray, FloatArray, tuple[FloatArray, FloatArray] | None]:
    """(offset, coefficient) of BoTorch's input transform, and (mean, deviation) of its outcome
    transform or None."""
    center, scale = np.zeros(n_in), np.ones(n_in)
    given = getattr(model, "input_transform", None)
    chain = (
        []
        if given is None
        else list(given.values())
        if "ChainedInputTransform" in kinds(given)
        else [given]
    )
    for transform in chain:
        if "AffineInputTransform" not in kinds(transform):
            raise ModelError(
                f"{type(transform).__name__} in input_transform is not supported",
                expected="an affine one",
            )
        for name, usual in (("reverse", False), ("transform_on_eval", True)):
            if bool(getattr(transform, name, usual)) is not usual:
                raise ModelError(
                    f"input_transform with {name}={not usual} is not supported",
                    expected=f"{name}={usual}",
                )
        at = slice(None) if not hasattr(transform, "indices") else transform.indices.tolist()
        size, offset = np.ones(n_in), np.zeros(n_in)
        wide = (numbers(transform.coefficient).reshape(-1), numbers(transform.offset).reshape(-1))
        size[at], offset[at] = (np.broadcast_to(v, (n_in,))[at] for v in wide)
        center, scale = center + scale * offset, scale * size
    outcome = getattr(model, "outcome_transform", None)
    if outcome is None:
        return center, scale, None
    if type(outcome).__name__ != "Standardize":
        raise ModelError(
            f"{type(outcome).__name__} in outcome_transform is not supported",
            expected="Standardize",
        )
    return center, scale, (numbers(outcome.means).reshape(-1), numbers(outcome.stdvs).reshape(-1))


def _assembled(
    posterior: Posterior,
    center: FloatArray,
    scale: FloatArray,
    outcome: tuple[FloatArray, FloatArray] | None,
) -> GaussianProcess:
    """The process with the model's own transforms, its domain, and names f1, f2, ... and x1, x2,
    ..."""
    n_in, n_out = posterior.inputs.shape[1], len(posterior.noise)
    mean, size = outcome if outcome is not None else (np.zeros(n_out), np.ones(n_out))
    mean, size = np.broadcast_to(mean, (n_out,)), np.broadcast_to(size, (n_out,))
    seen = posterior.inputs * scale + center
    gp = GaussianProcess(
        inputs=Layout([Signal(name=f"x{i + 1}", unit="1") for i in range(n_in)]),
        outputs=Layout([Signal(name=f"f{i + 1}", unit="1") for i in range(n_out)]),
        method=posterior.method,
        bases=posterior.bases,
        latents=tuple(map(_light, posterior.latents)),
        mixing=posterior.mixing,
        input_mean=center,
        input_scale=scale,
        output_mean=mean,
        output_scale=size,
        noise=posterior.noise * size**2,
        offset=posterior.offset,
        domain=Domain(lower=seen.min(axis=0), upper=seen.max(axis=0), samples=len(seen)),
    )
    rows = seen[np.linspace(0, len(seen) - 1, min(len(seen), DOMAIN_SAMPLES)).astype(int)]
    q = [float(v) for v in np.quantile(gp.evaluate_distance(rows), [0.5, 0.95, 0.99, 1.0])]
    return replace(gp, domain=replace(gp.domain, distance=(q[0], q[1], q[2], q[3])))


def _light(latent: Latent) -> Latent:
    """Without rows of E and F that are all zero."""
    kept = {
        n: getattr(latent, n)[np.any(getattr(latent, n) != 0.0, axis=1)]
        for n in ("explained", "uncertain")
    }
    return replace(latent, **kept)


def _scaled(gp: GaussianProcess, inputs: Affine | None, outputs: Affine | None) -> GaussianProcess:
    """With the user's own standardisation around it."""
    if inputs is not None:
        mean, scale = (_vector(v, len(gp.inputs), "input_transform") for v in inputs)
        if not (scale != 0).all():
            raise ModelError("input_transform: a scale is zero")
        domain = replace(
            gp.domain, lower=gp.domain.lower * scale + mean, upper=gp.domain.upper * scale + mean
        )
        gp = replace(
            gp,
            input_mean=mean + scale * gp.input_mean,
            input_scale=scale * gp.input_scale,
            domain=domain,
        )
    if outputs is not None:
        mean, scale = (_vector(v, len(gp.outputs), "output_transform") for v in outputs)
        if not (scale > 0).all():
            raise ModelError("output_transform: scales must be positive")
        gp = replace(
            gp,
            output_mean=mean + scale * gp.output_mean,
            output_scale=scale * gp.output_scale,
            noise=scale**2 * gp.noise,
        )
    return gp


def _vector(value: npt.ArrayLike, n: int, what: str) -> FloatArray:
    array = numbers(value).reshape(-1)
    if array.size not in (1, n) or not np.isfinite(array).all():
        raise ModelError(what, expected=f"{n} finite numbers", got=str(array.size))
    return np.array(np.broadcast_to(array, (n,)))


def _named(
    gp: GaussianProcess,
    inputs: Layout | Sequence[str] | None,
    outputs: Layout | Sequence[str] | None,
) -> GaussianProcess:
    for what, given in (("inputs", inputs), ("outputs", outputs)):
        if given is None:
            continue
        layout = (
            given
            if isinstance(given, Layout)
            else Layout([Signal(name=n, unit="1") for n in given])
        )
        n = len(getattr(gp, what))
        if len(layout) != n:
            raise ModelError(
                f"the model has {n} {what}", got=f"{len(layout)} names: {', '.join(layout.names)}"
            )
        gp = replace(gp, inputs=layout) if what == "inputs" else replace(gp, outputs=layout)
    return gp
