"""Claims about `fit`: truth within its errors, honest status, bounds, priors, and names for what
cannot be identified."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from greybox import build_model, fit
from greybox.errors import FileFormatError, UnknownNameError
from greybox.estimation.covariance import Covariance
from greybox.estimation.fit import Fit
from greybox.estimation.solvers.levenberg_marquardt import LevenbergMarquardt
from greybox.estimation.status import Code
from greybox.model.identified import IdentifiedModel
from tests.simulated import flights, truth, vehicle

EFFECTS = ("motor_lag", "command_delay", "rotor_drag", "rotational_damping")


@pytest.fixture(scope="module")
def fitted() -> Fit:
    data = flights()
    return fit(build_model(vehicle(), data.channels, EFFECTS), data)


def test_every_true_parameter_lies_within_four_standard_errors(fitted: Fit) -> None:
    assert fitted.converged
    for name, estimate in fitted.parameters.items():
        assert abs(estimate.value - truth()[name]) < 4 * estimate.std, name


def test_wrong_nominal_values_are_corrected(fitted: Fit) -> None:
    assert fitted["inertia.xx"].value == pytest.approx(truth()["inertia.xx"], rel=0.01)
    assert fitted["thrust.c2"].prior_influence < 0.01


def test_noise_levels_are_found(fitted: Fit) -> None:
    level, std, unit = fitted.noise["noise.sensor.p"]
    assert unit == "rad/s"
    assert abs(level - 0.015) < 5 * std


def test_white_innovations_take_fisher_errors(fitted: Fit) -> None:
    assert not fitted.coloured
    ratio = [e.std / e.std_fisher for e in fitted.parameters.values()]
    np.testing.assert_allclose(ratio, 1.0)


def test_sandwich_and_fisher_agree_when_the_model_is_right(fitted: Fit) -> None:
    shared = [i for i, u in enumerate(fitted.problem.unknowns) if u.kind == "parameter"]
    ratio = np.sqrt(
        np.diag(fitted.covariance.sandwich)[shared] / np.diag(fitted.covariance.fisher)[shared]
    )
    assert 0.6 < np.median(ratio) < 1.6


def test_the_same_fit_twice_gives_the_same_numbers(fitted: Fit) -> None:
    data = flights()
    again = fit(build_model(vehicle(), data.channels, EFFECTS), data)
    assert again.to_dict()["parameters"] == fitted.to_dict()["parameters"]


def test_the_iteration_limit_is_not_convergence() -> None:
    data = flights()
    result = fit(
        build_model(vehicle(), data.channels, EFFECTS),
        data,
        solver=LevenbergMarquardt(max_iterations=2),
    )
    assert not result.converged
    assert result.status.code is Code.MAX_ITERATIONS
    assert result.warnings[0].startswith("NOT converged")
    assert result.summary().startswith("NOT converged")


def test_mass_and_everything_in_newtons_scale_jointly() -> None:
    """With neither mass nor thrust known, only ratios are in the data: it says so, by name."""
    data = flights(1)
    loose = vehicle(mass=0.3)
    result = fit(build_model(loose, data.channels, EFFECTS), data)
    texts = [c for c in result.unidentifiable if "mass" in c.names]
    assert len(texts) == 1
    assert {"mass", "thrust.c2", "inertia.xx", "inertia.yy", "inertia.zz", "torque.c2"} <= set(
        texts[0].names
    )
    assert "only as a ratio" in texts[0].text
    assert result["mass"].prior_influence > 0.99
    assert any("the priors decide" in w for w in result.warnings)


def test_a_known_mass_leaves_nothing_unidentified(fitted: Fit) -> None:
    assert fitted.unidentifiable == ()


def test_an_estimate_at_its_bound_has_no_two_sided_error() -> None:
    """The plant has no blade flapping and no negative drag: force a bound by a prior range that
    excludes the truth."""
    data = flights(1)
    model = build_model(vehicle(), data.channels, EFFECTS)
    from dataclasses import replace

    high = tuple(
        replace(p, lower=0.06, nominal=0.07) if p.name == "motor_lag.tau" else p
        for p in model.parameters
    )
    object.__setattr__(model, "parameters", high)
    result = fit(model, data)
    bound = result["motor_lag.tau"]
    assert bound.at_bound
    assert bound.value == 0.06
    assert np.isnan(bound.std)
    assert any("motor_lag.tau is at its bound" in w for w in result.warnings)
    assert result["inertia.xx"].std > 0


def test_per_flight_parameters_get_one_value_per_flight(fitted: Fit) -> None:
    data = flights()
    result = fit(build_model(vehicle(), data.channels, EFFECTS), data, per_flight=["thrust.c2"])
    each = result["thrust.c2"].per_flight
    assert set(each) == set(data.names)
    for value, std in each.values():
        assert abs(value - truth()["thrust.c2"]) < 4 * std
    assert result.model.flight_spread["thrust.c2"][0] == pytest.approx(
        truth()["thrust.c2"], rel=0.01
    )


def test_an_unknown_parameter_is_named_with_its_neighbours() -> None:
    data = flights(1)
    with pytest.raises(UnknownNameError, match=r"motor_lag\.tau"):
        fit(build_model(vehicle(), data.channels, EFFECTS), data, fixed=["motor_lag.tao"])


def test_model_file_rebuilds_the_same_model(fitted: Fit, tmp_path: Path) -> None:
    path = fitted.model.save(tmp_path / "model.json")
    back = IdentifiedModel.load(path)
    assert back.to_dict() == {**fitted.model.to_dict()}
    np.testing.assert_array_equal(back.parameter_vector(), fitted.model.parameter_vector())
    assert back.effects == fitted.model.effects


def test_an_edited_model_file_is_refused(fitted: Fit, tmp_path: Path) -> None:
    path = fitted.model.save(tmp_path / "model.json")
    content = json.loads(path.read_text())
    content["values"]["mass"] = 1.0
    path.write_text(json.dumps(content))
    with pytest.raises(FileFormatError, match="checksum"):
        IdentifiedModel.load(path)


def test_what_held_numbers_add_is_in_the_errors_once_whatever_the_blocks_say():
    """Less it, the errors are a covariance still: a held mass explains no more than it is off."""
    rng = np.random.default_rng(3)
    root = rng.normal(size=(3, 3))
    fisher, moves = root @ root.T, 5.0 * rng.normal(size=(3, 1))
    size = np.array([0.1, 2.0, 1.0])
    sandwich, more = fisher * np.outer(size, size), moves @ moves.T
    whole = Covariance(fisher=fisher + more, sandwich=sandwich + more, blocks=1000, more=more)
    found = whole.chosen(True)
    assert np.linalg.eigvalsh(found - more).min() > -1e-9
    larger = np.maximum(np.diag(fisher), np.diag(sandwich))
    assert np.diag(found) == pytest.approx(larger + np.diag(more))
    assert whole.chosen(False) is whole.fisher
