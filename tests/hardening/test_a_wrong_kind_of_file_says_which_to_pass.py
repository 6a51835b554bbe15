"""A folder, or a file of another kind, where a model file is asked for: the line says which to
pass."""

from __future__ import annotations

import pytest

from greybox.errors import FileFormatError, VehicleError
from greybox.files import read_json, write_json
from greybox.model.vehicle import read_vehicle

SCHEMA = "greybox.model/1"


@pytest.fixture
def folder(tmp_path):
    write_json(tmp_path / "model.json", {"schema": SCHEMA, "kind": "physics"})
    write_json(tmp_path / "fit.json", {"schema": "greybox.fit/1"})
    (tmp_path / "notes.txt").write_text(SCHEMA)
    return tmp_path


@pytest.mark.parametrize("wrong", [".", "fit.json"])
def test_the_file_of_the_right_kind_is_named(folder, wrong):
    with pytest.raises(FileFormatError) as caught:
        read_json(folder / wrong, schema=SCHEMA)
    assert str(caught.value).endswith(f"Usual fix: pass {folder / 'model.json'}")


def test_a_file_of_another_version_is_said_to_be_one(folder):
    write_json(folder / "newer.json", {"schema": "greybox.model/2", "kind": "physics"})
    with pytest.raises(FileFormatError, match="written by another version of greybox") as caught:
        read_json(folder / "newer.json", schema=SCHEMA)
    assert "pass" not in str(caught.value), "no neighbour is what was meant"
    vehicle = folder / "v.toml"
    vehicle.write_text('schema = "greybox.vehicle/9"\n')
    with pytest.raises(VehicleError, match="written by another version of greybox"):
        read_vehicle(vehicle)


def test_without_a_schema_all_are(folder):
    with pytest.raises(FileFormatError, match=r"fit\.json or .*model\.json"):
        read_json(folder)


def test_where_there_is_none_the_kind_is_said(tmp_path):
    with pytest.raises(FileFormatError, match="pass a file of that kind"):
        read_json(tmp_path, schema=SCHEMA)
