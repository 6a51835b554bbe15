"""Public objects print at most twelve lines, show escaped HTML, hand over their table and plot into
matplotlib axes."""

from __future__ import annotations

import functools
import html.parser
import inspect
import sys
import tempfile
import typing
from pathlib import Path

import matplotlib
import numpy as np
import pytest

import greybox as gb
from greybox.commands.chain.front_door import Identified
from greybox.data import Dataset
from greybox.data.inspection import inspect_log
from greybox.discovery.certificate import Certificate
from greybox.discovery.name import LOG10, Name
from greybox.discovery.result import Discovery
from greybox.errors import GreyboxError, MissingExtraError
from greybox.estimation.fit import Fit
from greybox.estimation.profile import Profile
from greybox.linear.fit import LinearFit, Record
from greybox.model.identified import IdentifiedModel
from greybox.model.plausibility import check_vehicle
from greybox.plots import Curve, panels
from greybox.shown import LINES, Row, Shown, columns_of, html_table, shortened
from greybox.validation.worth import Worth
from mpc_export.bundle import ExportBundle, write_bundle
from scenarios.plants.linear_systems import random_system, simulate
from tests import simulated
from tests.mpc_export import predictor_cases
from tests.residual import hybrid_cases
from tests.simulators.identified import identified as nominal

matplotlib.use("Agg")


@functools.cache
def flight() -> Dataset:
    return simulated.flights(1, 4.0)


@functools.cache
def fitted() -> Fit:
    model = gb.build_model(simulated.vehicle(), flight().channels, ("motor_lag",))
    return gb.fit(model, flight(), use_compiler=False)


@functools.cache
def linear() -> LinearFit:
    u, y = simulate(np.random.default_rng(0), random_system(np.random.default_rng(1), 2, 1, 1), 300)
    return gb.fit_linear([Record(u=u, y=y)], 2, dt=0.01)


def discovery() -> Discovery:
    """Three causes with what was said of them, as a search would give them."""

    def name(cause: str, status: typing.Any, log10_e: float, worth: Worth | None) -> Name:
        rivals = {(): log10_e * LOG10}
        certificate = Certificate(name=cause, rivals=rivals)
        return Name(name=cause, status=status, certificate=certificate, worth=worth, reason="said")

    worth = Worth(share=0.4, seen=True, group="velocity", horizon=0.5, log_e=9.0, seconds=20)
    return Discovery(
        verdict="stopped",
        omega_known=False,
        seconds=1.0,
        bar=3.0 * LOG10,
        names=(
            name("rotor_drag", "certified", 12.0, worth),
            name("wind", "not certified", -1.0, None),
            name("center_of_mass_offset", "trace", 4.0, None),
        ),
    )


def profile() -> Profile:
    grid = np.linspace(0.02, 0.04, 5)
    return Profile(
        name="motor_lag.tau",
        flight=None,
        unit="s",
        estimate=0.03,
        grid=grid,
        cost=(grid - 0.03) ** 2 * 1e5,
        converged=np.ones(5, dtype=bool),
        level=0.95,
        limit=1.92,
        lower=0.022,
        upper=0.038,
    )


@functools.cache
def validation() -> typing.Any:
    return gb.validate(fitted().model, flight(), horizons=(0.01, 0.1))


def inspection() -> Shown:
    log = gb.examples.flight_path("nanobench", "B2_circle_slow_rep1")
    return inspect_log(log, gb.read_vehicle(gb.examples.vehicle_path("nanobench")))


@functools.cache
def plan() -> typing.Any:
    """The shortest plan that can be: one manoeuvre of one flight, for one effect."""
    return gb.plan(simulated.vehicle(), effects=["motor_lag"], seconds=4.0, piece=4.0)


@functools.cache
def bundle() -> ExportBundle:
    folder = tempfile.mkdtemp(prefix="bundle")
    return write_bundle(fitted().model, folder, targets=["casadi"])


def identified() -> Identified:
    model = fitted().model
    return Identified(
        verdict=None,
        model=model,
        why="of fit",
        fit=model,
        discovery=None,
        learned=None,
        folder=Path("out"),
    )


SHOWN: dict[str, typing.Callable[[], typing.Any]] = {
    "vehicle": simulated.vehicle,
    "vehicle check": lambda: check_vehicle(simulated.vehicle()),
    "dataset": flight,
    "flight": lambda: flight().flights[0],
    "segment": lambda: flight().segments[0],
    "inspection": inspection,
    "check": lambda: gb.check(flight(), simulated.vehicle()),
    "physics": lambda: fitted().model.dynamics,
    "augmented": lambda: fitted().problem.dynamics,
    "hybrid": hybrid_cases.hybrid,
    "identified model": lambda: fitted().model,
    "fit": fitted,
    "validation": validation,
    "horizons": lambda: validation().table,
    "profile": profile,
    "discovery": discovery,
    "plan": plan,
    "bundle": bundle,
    "identified": identified,
    "gp": lambda: hybrid_cases.push(hybrid_cases.craft()),
    "gp of pieces": predictor_cases.pieced,
    "linear fit": linear,
    "linear model": lambda: linear().model,
    "output hybrid": lambda: predictor_cases.hybrid(
        predictor_cases.axes(), ("p", "q", "phi[t-1]", "u1[t-1]")
    ),
    "twin": lambda: gb.twin(nominal({"motor_lag.tau": 0.05}), ["rotorpy", "numpy"]),
}


@functools.cache
def shown(name: str) -> Shown:
    return SHOWN[name]()


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


@pytest.mark.parametrize("name", SHOWN)
def test_twelve_lines_html_and_a_table(name: str) -> None:
    it = shown(name)
    text = repr(it)
    assert 1 <= len(text.splitlines()) <= LINES
    assert "object at 0x" not in text
    page = _Balanced()
    page.feed(it._repr_html_())
    assert page.open == []
    assert text.splitlines()[0] in page.text
    assert len(columns_of(it._shown_rows())) > 1


@pytest.mark.parametrize("name", SHOWN)
def test_every_object_has_a_summary_as_fits_and_checks_have(name: str) -> None:
    told = shown(name).summary()
    assert isinstance(told, str) and told.strip()


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


@pytest.mark.parametrize("name", SHOWN)
def test_a_frame_has_a_column_of_every_cell(name: str) -> None:
    it = shown(name)
    frame = it.to_frame()
    assert list(frame.columns) == list(columns_of(it._shown_rows()))
    assert len(frame) == len(it._shown_rows())


def test_without_pandas_one_line_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MissingExtraError, match=r'pip install "greybox-sysid\[notebook\]"'):
        flight().to_frame()


def test_whatever_a_public_function_gives_back_shows_itself() -> None:
    silent = []
    for name in gb.__all__:
        thing = getattr(gb, name)
        if not inspect.isfunction(thing):
            continue
        source = sys.modules[thing.__module__]
        given = inspect.signature(thing).return_annotation
        for part in str(given).split(" | "):
            if part in ("str", "Path", "CompareDocument") or part.startswith("tuple["):
                continue
            kind = getattr(source, part, None) or _type_checking(source, part)
            silent += [] if issubclass(kind, Shown) else [f"{name}: {part}"]
    assert silent == []


def _type_checking(source: typing.Any, name: str) -> type:
    """A class that a module imports only for types."""
    from greybox.baselines.output_residual import OutputHybrid
    from greybox.estimation.profile import Profile
    from greybox.linear.frf_result import FrequencyResponse
    from greybox.model.linear import LinearModel

    return {
        k.__name__: k
        for k in (FrequencyResponse, IdentifiedModel, LinearModel, OutputHybrid, Profile)
    }[name]


def test_plots_give_axes_with_names() -> None:
    for it in (flight().flights[0], validation().table, discovery(), profile(), plan()):
        axes = np.atleast_1d(it.plot())
        assert all(isinstance(a, matplotlib.axes.Axes) for a in axes)
        assert axes[-1].get_xlabel()
    bars = discovery().plot()
    assert [b.get_width() for b in bars.patches] == [12.0, -1.0, 4.0]
    assert bars.lines[0].get_xdata()[0] == pytest.approx(3.0)
    with pytest.raises(GreyboxError, match="nothing to plot"):
        Discovery(verdict="bad_data", omega_known=False, seconds=0.0).plot()
    matplotlib.pyplot.close("all")


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
