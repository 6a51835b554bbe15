"""What is written to a CSV log comes back bit by bit, by the fast path and by the careful one."""

from __future__ import annotations

import datetime
import gzip
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from greybox.data import read_table
from greybox.data.logs.csv import read_csv
from greybox.errors import DataError
from greybox.examples import flight_path, vehicle_path
from greybox.model.vehicle import read_vehicle

FINITE = st.floats(allow_nan=False, allow_infinity=False, width=64)
CELL = st.one_of(FINITE, st.just(float("nan")))


def text_of(value: float, blank: bool) -> str:
    return "" if blank and np.isnan(value) else repr(value)


@given(
    table=st.integers(1, 5).flatmap(
        lambda k: st.lists(st.lists(CELL, min_size=k, max_size=k), min_size=1, max_size=20)
    ),
    blank=st.booleans(),
    newline=st.sampled_from(["\n", "\r\n"]),
    bom=st.booleans(),
    packed=st.booleans(),
    last=st.booleans(),
)
def test_values_come_back(tmp_path_factory, table, blank, newline, bom, packed, last):
    names = [f"c{j}" for j in range(len(table[0]))]
    # A row of one empty cell is a blank line, which no CSV reader can tell from none.
    blank = blank and len(names) > 1
    lines = [",".join(names), *(",".join(text_of(v, blank) for v in row) for row in table)]
    content = ("\ufeff" * bom + newline.join(lines) + newline * last).encode()
    path = tmp_path_factory.mktemp("csv") / "log.csv"
    path.write_bytes(gzip.compress(content) if packed else content)
    read = read_csv(path)
    assert list(read.columns) == names
    assert np.array_equal(
        np.stack([read.columns[n] for n in names], axis=1), np.array(table), equal_nan=True
    )
    assert read.rows.tolist() == list(range(2, 2 + len(table)))


@pytest.mark.parametrize("sign", ["\x0b", "\x1c", "\x85", "\u2028"])
def test_only_line_ends_end_a_row(tmp_path, sign):
    path = tmp_path / "log.csv"
    path.write_bytes(f"t,note,p\r\n0.0,a{sign}b,1.0\r\n0.1,c,2.0\r\n".encode())
    read = read_csv(path)
    assert read.columns["note"].tolist() == [f"a{sign}b", "c"]
    assert read.columns["p"].tolist() == [1.0, 2.0]


PARTED = {
    "semicolons": lambda text: text.replace(",", ";"),
    "decimal commas": lambda text: text.replace(",", ";").replace(".", ","),
    "tabs": lambda text: text.replace(",", "\t"),
    "bars": lambda text: text.replace(",", "|"),
    "spaces": lambda text: text.replace(",", "  "),
    "numpy's header": lambda text: f"# {text}",
    "numpy's default": lambda text: f"# {text}".replace(",", " "),
    "comments before": lambda text: f"# craft: x, y\n#\n{text}",
    "comments before, a header among them": lambda text: f"# craft: x\n# {text}",
}


@pytest.mark.parametrize("form", PARTED)
@given(
    table=st.lists(
        st.lists(FINITE.filter(lambda x: x != 0), min_size=3, max_size=3), min_size=2, max_size=9
    )
)
def test_columns_may_be_parted_otherwise(tmp_path_factory, form, table):
    text = "\n".join(["t,p,q", *(",".join(repr(v) for v in row) for row in table)])
    path = tmp_path_factory.mktemp("csv") / "log.csv"
    path.write_text(PARTED[form](text))
    read = read_csv(path)
    assert list(read.columns) == ["t", "p", "q"]
    assert np.array_equal(np.stack([read.columns[n] for n in "tpq"], axis=1), np.array(table))
    begun = path.read_text().count("#") or 1
    begun += form == "comments before"
    assert read.rows.tolist() == list(range(begun + 1, begun + 1 + len(table)))


@pytest.mark.parametrize(
    ("form", "zone"),
    [
        ("%Y-%m-%d %H:%M:%S.%f", ""),
        ("%Y-%m-%dT%H:%M:%S.%f", "Z"),
        ("%Y-%m-%d %H:%M:%S.%f", "+02:00"),
    ],
)
def test_dates_are_seconds(tmp_path, form, zone):
    start = datetime.datetime(2026, 11, 30, 23, 59, 59, 900000)
    stamps = [start + datetime.timedelta(milliseconds=10 * k) for k in range(30)]
    cells = [s.strftime(form) + zone for s in stamps]
    cells[7] = ""
    path = tmp_path / "log.csv"
    path.write_text("\n".join(["Timestamp,p", *(f"{c},1.5" for c in cells)]))
    t = read_csv(path).columns["Timestamp"]
    expected = 1e-2 * np.arange(30.0)
    expected[7] = np.nan
    assert np.allclose(t - t[0], expected, rtol=0, atol=1e-6, equal_nan=True)
    assert t[0] == pytest.approx(start.replace(tzinfo=datetime.UTC).timestamp(), abs=1e-6)


@pytest.mark.parametrize(
    "cell", ["2026-13-01 00:00:00", "2026-11-30", "1 s", "2026-11-30 10:00:00 CET"]
)
def test_what_is_no_date_stays_text(tmp_path, cell):
    path = tmp_path / "log.csv"
    path.write_text(f"Timestamp,p\n{cell},1\n2026-11-30 10:00:00,2\n")
    assert read_csv(path).columns["Timestamp"].dtype.kind == "U"


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("#t,x\n2026-11-30T10:00:00,1\n", ["t", "x"]),
        ("#mode,t\nHOLD,0\nHOLD,1\n", ["mode", "t"]),
        ("# t,x\n,1\n0,1\n", ["t", "x"]),
        ('# t,x\n"0","1"\n', ["t", "x"]),
        ("# t, x, y\n0 1 2\n1 2 3\n", ["t", "x", "y"]),
        ("# a flight, of two\nt,x,y\n0,1,2\n", ["t", "x", "y"]),
        ("#,t\n1,0\n2,1\n", ["unnamed1", "t"]),
        ("# one, two, three\nt,x,y\n0,1,2\n", ["t", "x", "y"]),
    ],
)
def test_a_comment_is_the_header_of_the_values_below_it(tmp_path, text, names):
    path = tmp_path / "log.csv"
    path.write_text(text)
    table = read_csv(path)
    below = text.split("\n").index(next(r for r in text.split("\n") if "x" in r or ",t" in r)) + 1
    assert (list(table.columns), table.rows[0]) == (names, below + 1)


def test_commas_are_decimals_where_no_number_has_a_point(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("t;v;what;on\n0,5;12,25;a,b;01.12.2026\n1,5;1e-3;v1.2;01.12.2026\n")
    columns = read_csv(path).columns
    assert columns["t"].tolist() == [0.5, 1.5] and columns["v"].tolist() == [12.25, 1e-3]
    assert columns["what"].tolist() == ["a,b", "v1.2"]


@pytest.mark.parametrize("first", ["0", "0,25"])
def test_thousands_are_never_taken_for_decimals(tmp_path, first):
    path = tmp_path / "log.csv"
    path.write_text(f"t;rpm\n{first};12,345\n1;11,000\n")
    if first == "0,25":
        assert read_csv(path).columns["rpm"].tolist() == [12.345, 11.0]
        return
    with pytest.raises(DataError, match="may be a number with three decimals"):
        read_csv(path)
    path.write_text("t;rpm\n0.5;12,345\n1.5;11,000\n")
    assert read_csv(path).columns["rpm"].dtype.kind == "U"


def test_a_header_whose_quote_is_not_closed_is_a_clear_error(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text('t,"p,q\n1,2,3\n')
    with pytest.raises(DataError, match="row 2"):
        read_csv(path)


@given(content=st.one_of(st.binary(max_size=300), st.text(max_size=300).map(str.encode)))
def test_any_bytes_are_a_table_or_a_clear_error(tmp_path_factory, content):
    path = tmp_path_factory.mktemp("csv") / "log.csv"
    path.write_bytes(content)
    table, message = None, None
    try:
        table = read_csv(path)
    except DataError as error:
        message = str(error)
    if table is None:
        assert str(path) in message
        assert "\n" not in message
        assert "Usual fix" in message
    else:
        assert all(c.shape == table.rows.shape for c in table.columns.values())


def test_text_columns_are_kept_as_text(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("t,mode,u1\n0.0,hover,0.5\n0.01,,0.5\n0.02,land,\n")
    raw = read_table(path)
    assert raw.extra["mode"].tolist() == ["hover", "", "land"]
    assert raw.channels["u1"].tolist()[:2] == [0.5, 0.5]
    assert np.isnan(raw.channels["u1"][2])
    assert any("mode" in note for note in raw.notes)


def test_quotes_and_spaces_are_accepted(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text('"t", "u1"\n"0.0", 0.5\n 0.01 ,"0.6"\n')
    assert read_table(path).channels["u1"].tolist() == [0.5, 0.6]


def test_row_numbers_are_those_of_the_file(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("\nt,p\n0.0,1\n\n0.01,x\n")
    with pytest.raises(DataError, match=r"row 5, column 'p' \(p\)"):
        read_table(path)


def test_vehicle_columns_give_names_scales_offsets_and_causality():
    vehicle = read_vehicle(vehicle_path("nanobench"))
    path = flight_path("nanobench", "B2_circle_slow_rep1")
    raw, table = read_table(path, vehicle), read_csv(path)
    assert np.array_equal(raw.channels["az"], table.columns["imu_acc_z"] * 9.81)
    assert np.array_equal(raw.channels["z"], table.columns["pz"])
    assert raw.channels["u1"].max() <= 1.0
    assert raw.noncausal == {"vx", "vy", "vz"}
    assert set(raw.extra) == {c for c in table.columns if c.startswith(("est_", "att_"))}
    assert raw.flight == "B2_circle_slow_rep1"


def test_a_long_log_is_read_whole():
    raw = read_table(
        flight_path("arpl_crazyflie", "log15"), read_vehicle(vehicle_path("arpl_crazyflie"))
    )
    assert raw.n == 44299 + 1


def test_a_second_row_of_the_header_is_names_or_units(tmp_path: Path) -> None:
    rows = "0.0,1.0,2.0,x\n0.1,3.0,4.0,y\n"
    for text, names in (
        ("time,imu,imu,\nt,ax,ay,flag\n", ["time.t", "imu.ax", "imu.ay", "flag"]),
        ("time,gyro_x,gyro_y,mode\n(s),[deg/s],deg/s,\n", ["time [s]", "gyro_x [deg/s]"]),
    ):
        (tmp_path / "a.csv").write_text(text + rows)
        table = read_csv(tmp_path / "a.csv")
        assert list(table.columns)[: len(names)] == names
        assert len(table.rows) == 2 and table.rows[0] == 3


def test_a_first_row_without_numbers_is_no_header(tmp_path: Path) -> None:
    """A craft that stands still says its mode alone, and one column of text is one of text."""
    (tmp_path / "a.csv").write_text("t,p,q,mode\n,,,IDLE\n0.1,3.0,4.0,y\n")
    table = read_csv(tmp_path / "a.csv")
    assert list(table.columns) == ["t", "p", "q", "mode"] and len(table.rows) == 2
