"""A saved posterior comes back bit by bit, and what is damaged, foreign or executable is refused in
one line."""

from __future__ import annotations

import copy
import json
import pickle

import numpy as np
import pytest

from greybox.errors import FileFormatError
from greybox.residual.posterior import GPPosterior
from tests.residual.gp_cases import sparse_case


@pytest.fixture
def posterior():
    return sparse_case("linear+se", share=True, n_out=3)


def same(a: GPPosterior, b: GPPosterior) -> None:
    plain_a, arrays_a = a.parts()
    plain_b, arrays_b = b.parts()
    assert plain_a == plain_b
    for name, values in arrays_a.items():
        assert values.tobytes() == arrays_b[name].tobytes()
    z = np.random.default_rng(0).standard_normal((5, len(a.inputs)))
    for first, second in zip(a.evaluate(z), b.evaluate(z)):
        np.testing.assert_array_equal(first, second)


def test_json_and_npz(posterior, tmp_path):
    path = posterior.save(tmp_path / "gp.json")
    same(posterior, GPPosterior.load(path))
    first = (tmp_path / "gp.npz").read_bytes()
    posterior.save(path)
    assert (tmp_path / "gp.npz").read_bytes() == first


@pytest.mark.parametrize("copied", [lambda p: pickle.loads(pickle.dumps(p)), copy.deepcopy])
def test_a_copy_for_another_process(copied, posterior):
    again = copied(posterior)
    same(posterior, again)
    assert again.group_noise.keys() == posterior.group_noise.keys()
    with pytest.raises(ValueError, match="read-only"):
        again.weights[0] = 0.0


def test_one_dictionary(posterior):
    same(posterior, GPPosterior.from_dict(json.loads(json.dumps(posterior.to_dict()))))


def test_outputs_that_share_a_kernel_still_do(posterior, tmp_path):
    loaded = GPPosterior.load(posterior.save(tmp_path / "gp.json"))
    assert len({id(k) for k in loaded.kernels}) == 1


def test_damage_is_refused(posterior, tmp_path):
    path = posterior.save(tmp_path / "gp.json")
    text = path.read_text()
    path.write_text(text.replace('"method": "sgpr"', '"method": "svgp"'))
    with pytest.raises(FileFormatError, match="checksum"):
        GPPosterior.load(path)
    path.write_text(text)
    other = sparse_case(seed=9)
    other.save(tmp_path / "other.json")
    (tmp_path / "gp.npz").write_bytes((tmp_path / "other.npz").read_bytes())
    with pytest.raises(FileFormatError, match="not the arrays"):
        GPPosterior.load(path)
    (tmp_path / "gp.npz").write_bytes(b"PK not a zip")
    with pytest.raises(FileFormatError, match="cannot read the arrays"):
        GPPosterior.load(path)
    (tmp_path / "gp.npz").unlink()
    with pytest.raises(FileFormatError, match=r"keep the \.npz beside"):
        GPPosterior.load(path)
    with pytest.raises(FileFormatError, match="schema"):
        GPPosterior.from_dict({"schema": "greybox.model/1"})


def test_pickled_arrays_are_refused(posterior, tmp_path):
    path = posterior.save(tmp_path / "gp.json")
    np.savez(tmp_path / "gp.npz", support=np.array([{"a": 1}], dtype=object))
    with pytest.raises(FileFormatError, match="cannot read the arrays"):
        GPPosterior.load(path)
