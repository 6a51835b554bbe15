"""A result assembled from the validation types is valid under the published JSON Schema."""

import json
from importlib import resources

import jsonschema
import numpy as np
import pytest

from greybox.files import dump_json
from greybox.validation.baselines import persistence
from greybox.validation.coverage import LEVELS, interval_coverage
from greybox.validation.cross_correlation import cross_correlation
from greybox.validation.horizon import HorizonAccumulator
from greybox.validation.metrics import channel_metrics
from greybox.validation.whiteness import whiteness


def _schema() -> dict:
    return json.loads(resources.files("greybox").joinpath("schemas/validate.json").read_text())


def _result() -> dict:
    rng = np.random.default_rng(0)
    reference = {"rate": rng.standard_normal((400, 3))}
    origins = np.arange(350)
    model, naive = (
        HorizonAccumulator(label=name, sample_time=0.01) for name in ("model", "persistence")
    )
    covariance = np.broadcast_to(np.eye(3), (350, 50, 3, 3))
    model.add(
        "f", {"rate": np.zeros((350, 50, 3))}, reference, origins, covariances={"rate": covariance}
    )
    naive.add("f", persistence(reference, origins, steps=50), reference, origins)
    innovations = rng.standard_normal((400, 3))
    result = {
        "schema": "greybox.validate/1",
        "model": {"name": "physics", "file": "model.json"},
        "flights": [{"name": "f", "samples": 400, "seconds": 4.0}],
        "sample_time": 0.01,
        **model.table().to_dict(),
        "persistence": naive.table().to_dict(),
        "dead_reckoning": None,
        "curves": {"model": model.table().curve(), "persistence": naive.table().curve()},
        "adapted_on": {
            "seconds": 5,
            "flights": {"f": {"gyro_bias.x": {"value": 0.1, "std": 0.01}}},
        },
        "one_step": {
            "p": channel_metrics(reference["rate"][:, 0], innovations[:, 0], unit="rad/s").to_dict()
        },
        "whiteness": whiteness(innovations, names=["p", "q", "r"]).to_dict(),
        "cross_correlation": cross_correlation(
            innovations, rng.standard_normal((400, 2))
        ).to_dict(),
        "coverage": {
            "p": [interval_coverage([innovations[:, 0]], 1.0, nominal=k).to_dict() for k in LEVELS]
        },
        "warnings": [],
    }
    return json.loads(dump_json(result))


def test_a_full_result_is_valid() -> None:
    schema = _schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.Draft202012Validator(schema).validate(_result())


def test_optional_parts_are_optional_and_required_ones_are_not() -> None:
    validator = jsonschema.Draft202012Validator(_schema())
    result = _result()
    for key in (
        "persistence",
        "dead_reckoning",
        "curves",
        "one_step",
        "whiteness",
        "cross_correlation",
        "coverage",
    ):
        del result[key]
    result["adapted_on"] = None
    validator.validate(result)
    del result["horizons"]
    with pytest.raises(jsonschema.ValidationError, match="horizons"):
        validator.validate(result)
