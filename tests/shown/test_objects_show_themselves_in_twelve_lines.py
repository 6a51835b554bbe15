"""Public objects print at most twelve lines, show escaped HTML, hand over their table and plot into matplotlib axes."""

from __future__ import annotations

import functools
import html.parser

import matplotlib
import numpy as np
import pytest

import greybox as gb
from greybox.errors import GreyboxError
from greybox.plots import Curve, panels
from greybox.shown import LINES, Row, Shown, columns_of, html_table, shortened
from tests import simulated
from tests.residual import hybrid_cases

matplotlib.use("Agg")


@functools.cache
def flight() -> gb.Dataset:
    return simulated.flights(1, 4.0)


@functools.cache
def fitted() -> gb.Fit:
    model = gb.build_model(simulated.vehicle(), flight().channels, ("motor_lag",))
    return gb.fit(model, flight(), use_compiler=False)


@functools.cache
def shown_objects() -> dict[str, Shown]:
    model = fitted().model
    return {
        "vehicle": simulated.vehicle(),
        "dataset": flight(),
        "check": gb.check(flight(), simulated.vehicle()),
        "physics": model.dynamics,
        "augmented": fitted().problem.dynamics,
        "hybrid": hybrid_cases.hybrid(),
        "identified": model,
        "fit": fitted(),
        "validation": gb.validate(model, flight(), horizons=(0.01, 0.1)),
        "gp": hybrid_cases.push(hybrid_cases.craft()),
    }


class _Balanced(html.parser.HTMLParser):
    """Fails on a tag that is closed and was not opened; keeps the text."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.mark.parametrize("name", shown_objects())
def test_twelve_lines_html_and_a_table(name: str) -> None:
    it = shown_objects()[name]
    text = repr(it)
    assert 1 <= len(text.splitlines()) <= LINES
    assert "object at 0x" not in text
    page = _Balanced()
    page.feed(it._repr_html_())
    assert page.open == []
    assert text.splitlines()[0] in page.text
    assert len(columns_of(it._shown_rows())) > 1


def test_the_first_line_of_a_fit_is_its_verdict() -> None:
    assert repr(fitted()).startswith("NOT JUDGED")
    judged = fitted().judged(gb.validate(fitted().model, flight()).verdict)
    assert judged.verdict is not None
    assert repr(judged).splitlines()[0] == judged.verdict.line
    assert repr(judged.model).splitlines()[0] == judged.verdict.line


def test_a_frame_has_the_numbers_of_the_fit() -> None:
    frame = fitted().to_frame()
    names = list(frame["parameter"])
    at = names.index("motor_lag.tau")
    estimate = fitted().parameters["motor_lag.tau"]
    assert frame["value"][at] == estimate.value
    assert frame["t"][at] == pytest.approx(estimate.value / estimate.std)


def test_without_pandas_a_table_is_columns_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    columns = flight().to_frame()
    assert isinstance(columns, dict)
    assert columns["flight"] == list(flight().names)


def test_what_an_object_says_cannot_break_the_page() -> None:
    hostile = "<script>alert(1)</script> & more"

    class Hostile(Shown):
        def _shown_text(self) -> str:
            return hostile + "\nrest " + hostile

        def _shown_rows(self) -> list[Row]:
            return [{hostile: hostile}]

    assert "<script>" not in Hostile()._repr_html_()
    assert "<script>" not in html_table([{hostile: hostile}])


def test_a_long_text_says_how_much_is_left_out() -> None:
    short = shortened("\n".join(str(i) for i in range(30)))
    assert len(short.splitlines()) == LINES
    assert short.splitlines()[-1] == f"... and {30 - (LINES - 1)} more lines"
    assert shortened("a\nb\n") == "a\nb"


def test_plots_hold_the_numbers() -> None:
    axes = flight().plot(["p", "q", "z"])
    assert [a.get_ylabel() for a in axes] == ["rate [rad/s]", "position [m]"]
    (segment,) = flight().segments
    np.testing.assert_array_equal(axes[0].lines[0].get_ydata()[:-1], segment.column("p"))
    residuals = fitted().plot_residuals()
    assert len(residuals) == len(fitted().model.dynamics.innovations)
    bars = fitted().plot()
    assert "inertia.xx" in [t.get_text() for t in bars.get_yticklabels()]
    validation = gb.validate(fitted().model, flight())
    assert validation.table is not None
    first = next(iter(validation.table.groups.values()))
    np.testing.assert_array_equal(validation.plot()[0].lines[0].get_ydata(), first.mae)
    matplotlib.pyplot.close("all")


def test_a_slice_of_a_gp_is_its_mean_and_two_deviations() -> None:
    gp = hybrid_cases.push(hybrid_cases.craft())
    (axis,) = gp.plot("p", ["force.y"])
    x, y = axis.lines[0].get_data()
    z = np.zeros((x.size, len(gp.inputs)))
    z[:, gp.inputs["p"]] = x
    mean, variance = gp.evaluate(z)
    j = gp.outputs["force.y"]
    np.testing.assert_allclose(y, mean[:, j])
    band = axis.collections[0].get_paths()[0].get_extents()
    assert band.y1 == pytest.approx((mean + 2 * np.sqrt(variance))[:, j].max())
    matplotlib.pyplot.close("all")


@pytest.mark.parametrize(
    "ask",
    [
        lambda: flight().plot(["no such channel"]),
        lambda: flight().plot([]),
        lambda: flight().plot(flight="elsewhere"),
        lambda: fitted().plot_residuals("elsewhere"),
        lambda: hybrid_cases.push(hybrid_cases.craft()).plot("height"),
        lambda: panels({"a": [Curve(label="", x=np.zeros(1), y=np.zeros(1))]}, x="t", ax=[]),
    ],
)
def test_what_cannot_be_drawn_is_said_in_one_line(ask) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(GreyboxError) as told:
        ask()
    assert "\n" not in str(told.value)
    matplotlib.pyplot.close("all")
