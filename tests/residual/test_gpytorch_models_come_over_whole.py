"""A GP that was trained in GPyTorch comes over whole: mean, variance and both Jacobians are
GPyTorch's own, for every kernel and every kind of model; what cannot come over is named with its
place."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")
gpytorch = pytest.importorskip("gpytorch")
from greybox.errors import DataError, FileFormatError, GreyboxError, ModelError  # noqa: E402
from greybox.residual.covariances import COVARIANCES  # noqa: E402
from greybox.residual.from_gpytorch import from_gpytorch  # noqa: E402
from greybox.residual.gaussian_process import GaussianProcess  # noqa: E402
from tests.residual.gpytorch_cases import (  # noqa: E402
    KERNELS,
    MODELS,
    N_IN,
    Exact,
    exactly,
    kernel,
    make,
    told,
)

QUANTITIES = ("mean", "variance", "mean_jacobian", "variance_jacobian")
TOLERANCE = {"matern12": 1e-6}
"""GPyTorch's root of a rounded squared distance costs a kernel with a kink at zero half of its
digits; ours takes the differences themselves. All else: 1e-8."""
REST = [(m, k) for m in MODELS for k in KERNELS if not (m == "exact" or k == "tree")]
REFUSED_BY_GPYTORCH = [("icm", "active"), ("lcm", "active")]
"""GPyTorch's multitask kernel ignores active dimensions and then fails."""
DEGENERATE = [("sgpr", "linear")]
"""More inducing points than the kernel has features: the answer is one of the jitter."""


def agrees(model_kind, kernel_name, points=2, dtype=torch.float64, tolerance=None):
    model, likelihood = make(model_kind, kernel_name, dtype=dtype)
    gp = from_gpytorch(model, likelihood)
    function = gp.function("gp", QUANTITIES)
    limit = tolerance or TOLERANCE.get(kernel_name, 1e-8)
    if (model_kind, kernel_name) in DEGENERATE:
        limit = 1e-6
    for z in np.random.default_rng(1).standard_normal((points, N_IN)):
        for name, want, got in zip(QUANTITIES, told(model, z), function(z)):
            want = want.reshape(got.shape)
            gap = np.abs(np.asarray(got) - want).max() / np.abs(want).max()
            assert gap <= limit, f"{model_kind}, {kernel_name}: {name} off by {gap:.1e}"
    return gp


@pytest.mark.parametrize("name", KERNELS)
def test_every_kernel_of_an_exact_model_is_gpytorchs_own(name):
    gp = agrees("exact", name)
    assert gp.method == "exact"


@pytest.mark.parametrize("model", [m for m in MODELS if m != "exact"])
def test_every_kind_of_model_with_a_tree_of_kernels_is_gpytorchs_own(model):
    agrees(model, "tree")


# Of a kernel of low rank GPyTorch says that it adds jitter to the inducing points' covariance.
@pytest.mark.filterwarnings("ignore:A not p.d., added jitter")
@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "name"), [pair for pair in REST if pair not in REFUSED_BY_GPYTORCH]
)
def test_every_kernel_in_every_kind_of_model_is_gpytorchs_own(model, name):
    agrees(model, name, points=4)


def test_a_single_precision_model_agrees_to_single_precision():
    agrees("svgp", "rbf-ard", dtype=torch.float32, tolerance=2e-4)
    agrees("exact", "matern52", dtype=torch.float32, tolerance=2e-4)


def test_the_covariances_here_are_all_that_there_are_cases_for():
    kinds = set()

    def collect(plain):
        kinds.add(plain["kind"])
        for part in (*plain.get("parts", ()), *([plain["inner"]] if "inner" in plain else [])):
            collect(part)

    from greybox.residual.covariances import Pick, read_module

    for name in KERNELS:
        collect(read_module(kernel(name), Pick(), "covar_module").to_dict())
    assert kinds == {c.kind for c in COVARIANCES}


def test_a_file_gives_the_same_numbers_and_damage_is_named(tmp_path):
    model, likelihood = make("lcm", "tree")
    gp = from_gpytorch(model, likelihood, inputs=["a", "b", "c"], outputs=["f", "g", "h"])
    again = GaussianProcess.load(gp.save(tmp_path / "gp.json"))
    z = np.random.default_rng(2).standard_normal((5, N_IN))
    assert all(
        np.array_equal(a, b)
        for a, b in zip(gp.evaluate(z, noise=True), again.evaluate(z, noise=True))
    )
    assert (again.inputs, again.outputs) == (gp.inputs, gp.outputs)
    (tmp_path / "gp.npz").write_bytes(b"nothing")
    with pytest.raises(FileFormatError, match="arrays"):
        GaussianProcess.load(tmp_path / "gp.json")


def test_standardised_training_data_are_undone():
    model, likelihood = make("batch", "rbf-ard")
    mean, scale = np.array([1.0, -2.0, 3.0]), np.array([2.0, 0.5, 4.0])
    gp = from_gpytorch(model, likelihood)
    outer = from_gpytorch(
        model, likelihood, input_transform=(mean, scale), output_transform=(2 * mean, scale)
    )
    z = np.array([[0.3, -0.2, 0.7]])
    (m, v), (m2, v2) = gp.evaluate(z, noise=True), outer.evaluate(z * scale + mean, noise=True)
    assert np.allclose(m2, 2 * mean + scale * m, rtol=1e-12)
    assert np.allclose(v2, scale**2 * v, rtol=1e-12)
    slope = np.asarray(outer.mean_jacobian(z[0] * scale + mean))
    assert np.allclose(
        slope, scale[:, None] * np.asarray(gp.mean_jacobian(z[0])) / scale, rtol=1e-10
    )


def test_noise_of_a_new_sample_is_the_likelihoods():
    model, likelihood = make("icm", "rbf")
    gp = from_gpytorch(model, likelihood)
    z = np.array([[0.1, 0.2, 0.3]])
    with exactly(), torch.no_grad():
        want = likelihood(model(torch.tensor(z))).variance.numpy()
    assert np.allclose(gp.evaluate(z, noise=True)[1], want, rtol=1e-8)


def test_the_users_model_stays_as_it_was():
    model, likelihood = make("exact", "rbf", dtype=torch.float32)
    model.train()
    before = {n: p.clone() for n, p in model.state_dict().items()}
    from_gpytorch(model, likelihood)
    assert model.training
    assert next(model.parameters()).dtype == torch.float32
    assert all(torch.equal(p, before[n]) for n, p in model.state_dict().items())


# -------------------- other people's models


class BatchIndependent(gpytorch.models.ExactGP):
    """The structure of the model that l4acados' examples save: outputs as a batch, zero mean,
    scaled ARD kernel."""

    def __init__(self, x, y, likelihood, residual_dimension, input_dimension):
        super().__init__(x, y, likelihood)
        shape = torch.Size([residual_dimension])
        self.mean_module = gpytorch.means.ZeroMean(batch_shape=shape)
        self.covar_module = gpytorch.kernels.ScaleKernel(
            gpytorch.kernels.RBFKernel(ard_num_dims=input_dimension, batch_shape=shape),
            batch_shape=shape,
        )

    def forward(self, x):
        own = gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))
        return gpytorch.distributions.MultitaskMultivariateNormal.from_batch_mvn(own)


def test_a_saved_state_dict_in_l4acados_form_comes_over(tmp_path):
    rng = np.random.default_rng(3)
    x, y = torch.tensor(rng.standard_normal((20, 5))), torch.tensor(rng.standard_normal((20, 2)))
    likelihood = gpytorch.likelihoods.MultitaskGaussianLikelihood(num_tasks=2).double()
    trained = BatchIndependent(x, y, likelihood, 2, 5).double()
    with torch.no_grad():
        trained.covar_module.base_kernel.raw_lengthscale += 0.7
        likelihood.raw_task_noises += torch.tensor([0.2, -0.4])
    torch.save(trained.state_dict(), tmp_path / "model.pth")
    loaded = BatchIndependent(
        None, None, gpytorch.likelihoods.MultitaskGaussianLikelihood(num_tasks=2), 2, 5
    ).double()
    loaded.load_state_dict(torch.load(tmp_path / "model.pth", weights_only=True))
    with pytest.raises(DataError, match="no training data"):
        from_gpytorch(loaded)
    loaded.set_train_data(x, y, strict=False)
    gp = from_gpytorch(loaded)
    z = rng.standard_normal((3, 5))
    trained.eval()
    with exactly(), torch.no_grad():
        want = trained(torch.tensor(z))
    mean, variance = gp.evaluate(z)
    assert np.allclose(mean, want.mean.numpy(), rtol=1e-8)
    assert np.allclose(variance, want.variance.numpy(), rtol=1e-8)


class Affine(torch.nn.Module):
    """BoTorch's AffineInputTransform as far as its numbers go."""

    coefficient = torch.tensor([[2.0, 0.5]], dtype=torch.float64)
    offset = torch.tensor([[1.0, -1.0]], dtype=torch.float64)


AffineInputTransform = type("AffineInputTransform", (Affine,), {})


class Standardize(torch.nn.Module):
    """BoTorch's outcome transform as far as its numbers go."""

    means = torch.tensor([[3.0, 4.0]], dtype=torch.float64)
    stdvs = torch.tensor([[2.0, 5.0]], dtype=torch.float64)


def test_a_model_with_botorchs_structure_comes_over():
    """Outputs as the first dimension of the data, transforms on the model: what SingleTaskGP holds
    in evaluation mode."""
    rng = np.random.default_rng(4)
    x = torch.tensor(rng.standard_normal((20, 2))).expand(2, 20, 2).clone()
    y = torch.tensor(rng.standard_normal((2, 20)))
    shape = torch.Size([2])
    likelihood = gpytorch.likelihoods.GaussianLikelihood(batch_shape=shape).double()
    covar = gpytorch.kernels.RBFKernel(ard_num_dims=2, batch_shape=shape)
    model = (
        Exact(x, y, likelihood, gpytorch.means.ConstantMean(batch_shape=shape), covar)
        .double()
        .eval()
    )
    model.input_transform, model.outcome_transform = AffineInputTransform(), Standardize()
    gp = from_gpytorch(model)
    z = rng.standard_normal((3, 2))
    moved = (torch.tensor(z) - Affine.offset) / Affine.coefficient
    with exactly(), torch.no_grad():
        want = model(moved.expand(2, 3, 2))
    mean, variance = gp.evaluate(z)
    center, size = Standardize.means.numpy()[0], Standardize.stdvs.numpy()[0]
    assert np.allclose(mean, center + size * want.mean.numpy().T, rtol=1e-8)
    assert np.allclose(variance, size**2 * want.variance.numpy().T, rtol=1e-8)
    for name, value in (("reverse", True), ("transform_on_eval", False)):
        model.input_transform = AffineInputTransform()
        setattr(model.input_transform, name, value)
        with pytest.raises(ModelError, match=name):
            from_gpytorch(model)


def test_botorchs_single_task_gp_comes_over():
    pytest.importorskip("botorch")
    from botorch.models import ModelListGP, SingleTaskGP
    from botorch.models.transforms.input import Normalize

    rng = np.random.default_rng(5)
    x, y = torch.tensor(3 + 2 * rng.random((30, 3))), torch.tensor(5 + rng.standard_normal((30, 2)))
    z = 3 + 2 * rng.random((4, 3))
    both = SingleTaskGP(x, y, input_transform=Normalize(d=3))
    each = ModelListGP(
        *(SingleTaskGP(x, y[:, j : j + 1], input_transform=Normalize(d=3)) for j in range(2))
    )
    for model in (both, each):
        gp = from_gpytorch(model)
        with exactly(), torch.no_grad():
            want = model.posterior(torch.tensor(z))
        mean, variance = gp.evaluate(z)
        assert np.allclose(mean, want.mean.numpy(), rtol=1e-8)
        assert np.allclose(variance, want.variance.numpy(), rtol=1e-8)


# -------------------- refusals


def refusal(model, likelihood, error=ModelError, **options):
    with pytest.raises(error) as caught:
        from_gpytorch(model, likelihood, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def exact(covar=None, mean=None, likelihood=None):
    x = torch.linspace(0, 1, 3 * 7, dtype=torch.float64).reshape(7, 3) ** 2
    likelihood = likelihood or gpytorch.likelihoods.GaussianLikelihood()
    mean = mean or gpytorch.means.ZeroMean()
    return Exact(
        x, x[:, 0], likelihood, mean, covar or gpytorch.kernels.RBFKernel()
    ).double(), likelihood.double()


def test_what_is_not_supported_is_named_with_its_place():
    k = gpytorch.kernels
    said = refusal(
        *exact(
            k.ScaleKernel(k.RBFKernel() + k.SpectralMixtureKernel(num_mixtures=2, ard_num_dims=3))
        )
    )
    assert "SpectralMixtureKernel in covar_module.base_kernel.kernels.1" in said
    assert "RBFKernel" in said
    assert "LinearMeanGrad" in refusal(*exact(mean=gpytorch.means.LinearMeanGrad(3)))
    model, _ = make("svgp", "rbf")
    assert "StudentTLikelihood" in refusal(model, gpytorch.likelihoods.StudentTLikelihood())


def test_a_kernel_that_only_looks_like_one_that_is_supported_is_refused():
    class Warped(gpytorch.kernels.RBFKernel):
        def forward(self, x1, x2, **params):
            return super().forward(x1**3, x2**3, **params)

    assert "Warped in covar_module" in refusal(*exact(Warped()))


def test_a_forward_of_its_own_is_refused():
    class Deep(Exact):
        def forward(self, x):
            return super().forward(torch.tanh(3 * x))

    model, likelihood = exact()
    model.__class__ = Deep
    assert "something else than its mean_module and covar_module" in refusal(model, likelihood)


def test_a_noise_that_is_not_positive_is_refused():
    model, likelihood = exact()
    likelihood.noise_covar.raw_noise_constraint = gpytorch.constraints.Interval(-2.0, 1.0)
    likelihood.noise_covar.raw_noise.data.fill_(-1.0)
    assert "noise is not positive" in refusal(model, likelihood)


def test_missing_and_broken_training_data_are_refused():
    model, likelihood = exact()
    model.train_inputs = None
    assert "an exact GP is its data" in refusal(model, likelihood, DataError)
    model, likelihood = exact()
    model.train_targets[2] = float("nan")
    assert "training data with NaN" in refusal(model, likelihood, DataError)
    model, likelihood = exact()
    model.train_targets = model.train_targets[:5]
    refusal(model, likelihood, GreyboxError)


def test_sizes_that_do_not_fit_are_refused():
    model, likelihood = exact()
    assert "the model has 3 inputs; got 2 names" in refusal(model, likelihood, inputs=["a", "b"])
    assert "input_transform" in refusal(
        model, likelihood, input_transform=(np.zeros(2), np.ones(2))
    )
    with pytest.raises(ModelError, match="wrong length"):
        from_gpytorch(model, likelihood).mean(np.zeros(4))
    model.covar_module = gpytorch.kernels.RBFKernel(ard_num_dims=2)
    assert "not made for this number of inputs; got 3 inputs" in refusal(model, likelihood)


def test_something_else_than_a_model_is_refused():
    assert "is not supported" in refusal(
        gpytorch.kernels.RBFKernel(), gpytorch.likelihoods.GaussianLikelihood()
    )
