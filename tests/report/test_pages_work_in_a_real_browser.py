"""Reports in headless Chromium: no console errors, nothing cut off at phone width, both colour
schemes, keyboard, paper."""

from __future__ import annotations

import base64
import importlib.util
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from greybox.report.discover_report import discover_report
from greybox.report.fit_report import fit_report
from greybox.report.identify_report import identify_report
from greybox.report.learn_report import learn_report
from tests.discovery.test_the_report_tells_every_verdict import content as discovery
from tests.mpc_export.mission.test_mpc_flights_are_counted_honestly import watched_page
from tests.report.identified import identified
from tests.report.synthetic_fit import make_fit, make_flights, make_validation
from tests.report.test_the_page_shows_how_outputs_follow_commands import answers
from tests.residual.test_learn_report_says_what_was_learned import content as learned

pytestmark = pytest.mark.skipif(
    not (shutil.which("chromium") and shutil.which("chromedriver"))
    or importlib.util.find_spec("selenium") is None,
    reason="Chromium, its driver or selenium (extra `test`) is not installed",
)
PAGES = {
    "identify": lambda: identify_report(identified(), {}, links={}, validation=make_validation()),
    "fit": lambda: fit_report(make_fit(), make_flights(), make_validation(), responses=answers()),
    "discover": lambda: discover_report(discovery()),
    "learn": lambda: learn_report(learned()),
    "mpc": watched_page,
}
AXE = os.environ.get("AXE_CORE")
"""axe.min.js of the package axe-core."""
USED = """
const key = (e, k) => e.dispatchEvent(new KeyboardEvent('keydown', {key: k, bubbles: true}));
document.querySelectorAll('details').forEach(d => { d.open = true; });
document.querySelectorAll('svg[data-axes]').forEach(s => { key(s, '+'); key(s, 'ArrowRight'); });
document.querySelectorAll('input[type=range]').forEach(r => {
  r.value = (Number(r.min) + Number(r.max)) / 2; r.dispatchEvent(new Event('input', {bubbles: true})); });
document.querySelectorAll('.controls button').forEach(b => b.click());
"""
PHONE, DESKTOP = (390, 844), (1280, 900)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = str(shutil.which("chromium"))
    for flag in (
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-quic",
        "--no-first-run",
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-sync",
        "--disable-dev-shm-usage",
        f"--user-data-dir={tmp_path_factory.mktemp('chromium')}",
    ):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(
        options=options, service=webdriver.ChromeService(str(shutil.which("chromedriver")))
    )
    yield driver
    driver.quit()


@pytest.fixture(scope="module", params=PAGES)
def page(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, browser: Any
) -> Any:
    path = tmp_path_factory.mktemp("page") / f"{request.param}.html"
    path.write_text(PAGES[request.param](), encoding="utf-8")
    browser.get(path.as_uri())
    return browser


def size(browser: Any, width: int, height: int) -> None:
    browser.execute_cdp_cmd(
        "Emulation.setDeviceMetricsOverride",
        {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600},
    )


def scheme(browser: Any, name: str) -> None:
    features = [{"name": "prefers-color-scheme", "value": name}]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "screen", "features": features})


def test_the_console_stays_empty_and_nothing_is_fetched(page: Any):
    assert [entry["message"] for entry in page.get_log("browser")] == []
    fetched = page.execute_script(
        "return performance.getEntriesByType('resource').map(e => e.name)"
    )
    assert [f for f in fetched if not f.startswith("data:")] == []


@pytest.mark.parametrize("screen", [PHONE, DESKTOP], ids=["phone", "desktop"])
def test_nothing_is_wider_than_the_screen(page: Any, screen: tuple[int, int]):
    size(page, *screen)
    wide, texts = page.execute_script(
        "const small = [...document.querySelectorAll('svg text')].map(t => "
        "t.getBoundingClientRect().height).filter(h => h);"
        "return [document.documentElement.scrollWidth, small]"
    )
    assert wide <= screen[0]
    # Letters of the plots, as they are seen on the screen [CSS pixels].
    assert not texts or sorted(texts)[len(texts) // 10] >= 7


def luminance(colour: str) -> float:
    r, g, b = (float(v) / 255 for v in colour[colour.index("(") + 1 : -1].split(",")[:3])
    r, g, b = (v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in (r, g, b))
    return 0.2126 * r + 0.7152 * g + 0.0722 * b


@pytest.mark.parametrize("name", ["light", "dark"])
def test_text_has_contrast_in_both_colour_schemes(page: Any, name: str):
    size(page, *DESKTOP)
    scheme(page, name)
    text, ground = page.execute_script(
        "const s = getComputedStyle(document.body), h = getComputedStyle(document.documentElement);"
        "const clear = 'rgba(0, 0, 0, 0)';"
        "return [s.color, s.backgroundColor === clear ? h.backgroundColor : s.backgroundColor]"
    )
    a, b = sorted((luminance(text), luminance(ground)))
    assert (b + 0.05) / (a + 0.05) >= 4.5  # WCAG 2.1, 1.4.3
    assert (luminance(ground) < 0.2) == (name == "dark")


def test_the_keyboard_reaches_every_link_fold_and_table_that_scrolls(page: Any):
    from selenium.webdriver.common.by import By
    from selenium.webdriver.common.keys import Keys

    size(page, *DESKTOP)
    wanted = page.execute_script(
        "const all = [...document.querySelectorAll('a[href], summary, button, input, select, "
        '[tabindex="0"]\')];'
        "window.wanted = all.filter(e => e.checkVisibility()); return window.wanted.length"
    )
    page.execute_script(
        "document.activeElement.blur(); window.scrollTo({top: 0, behavior: 'instant'})"
    )
    seen = set()
    for _ in range(wanted + 5):
        page.find_element(By.TAG_NAME, "body").send_keys(Keys.TAB)
        seen.add(page.execute_script("return window.wanted.indexOf(document.activeElement)"))
    assert wanted > 0
    assert seen >= set(range(wanted))


@pytest.mark.slow
def test_it_is_there_within_a_second(page: Any):
    from selenium.webdriver.support.ui import WebDriverWait

    # The end of the load event is set after its handlers, perhaps later than a script runs.
    loaded = "return performance.getEntriesByType('navigation')[0].loadEventEnd / 1000"
    seconds = [
        (page.refresh(), WebDriverWait(page, 60).until(lambda b: b.execute_script(loaded)))[1]
        for _ in range(3)
    ]
    assert min(seconds) < 1.0


@pytest.mark.skipif(
    AXE is None, reason="axe-core is not there: npm install axe-core, AXE_CORE=.../axe.min.js"
)
def test_axe_finds_nothing_serious(page: Any):
    """Rules of WCAG 2.1, as axe-core judges them. The page's own policy forbids scripts of others:
    it is lifted here."""
    page.execute_cdp_cmd("Page.setBypassCSP", {"enabled": True})
    page.refresh()
    for colours in ("light", "dark"):
        scheme(page, colours)
        page.execute_script(Path(str(AXE)).read_text(encoding="utf-8"))
        found = page.execute_async_script(
            "const done = arguments[0]; axe.run().then(r => done(r.violations))"
        )
        serious = [v for v in found if v["impact"] in ("serious", "critical")]
        assert [(v["id"], v["nodes"][0]["html"][:200]) for v in serious] == []
        # The same with everything open, curves zoomed with a cursor, sliders moved and the replay
        # running.
        page.execute_script(USED)
    page.execute_cdp_cmd("Page.setBypassCSP", {"enabled": False})
    page.refresh()


def test_the_first_screen_is_the_headline(page: Any):
    """What the page says first, its figure and what to do next are seen without scrolling."""
    size(page, *DESKTOP)
    ends = page.execute_script(
        "window.scrollTo({top: 0, behavior: 'instant'}); const end = e => e.getBoundingClientRect().bottom;const next = "
        "[...document.querySelectorAll('h3')].find(h => h.textContent === 'What to do next');"
        "return [end(document.querySelector('.good, .bad')), "
        "end(document.querySelector('figure')), end(next)]"
    )
    assert ends == sorted(ends)
    assert ends[-1] < DESKTOP[1]


def flight_figures(page: Any) -> list[Any]:
    """The curves of the first flight on the page of a fit."""
    if page.title != "Fit of quadrotor":
        pytest.skip("another page")
    size(page, *DESKTOP)
    found = page.find_elements("css selector", "details svg[data-axes]")
    page.execute_script("arguments[0].scrollIntoView({behavior: 'instant'})", found[0])
    return found


LABELS = "return [...arguments[0].querySelectorAll('.own text')].map(t => t.textContent)"


def test_a_drag_zooms_all_figures_of_the_same_time_and_a_double_click_takes_it_back(page: Any):
    from selenium.webdriver import ActionChains

    figures = flight_figures(page)
    first, beside = figures[0], figures[1]
    assert page.execute_script(LABELS, first) == []
    paths = "return arguments[0].querySelector('.axes > .curve > path').getAttribute('d')"
    before = page.execute_script(paths, beside)
    ActionChains(page).move_to_element_with_offset(first, -40, 0).click_and_hold().move_by_offset(
        90, 0
    ).release().perform()
    assert len(page.execute_script(LABELS, first)) > 6
    assert page.execute_script(LABELS, beside) != []
    assert page.execute_script(paths, beside) != before
    assert page.execute_script(LABELS, figures[3]) == []  # the whole flight keeps its own range
    ActionChains(page).double_click(first).perform()
    assert page.execute_script(LABELS, beside) == []
    assert page.execute_script(paths, beside) == before
    assert page.get_log("browser") == []


def test_a_drag_past_the_figure_or_marked_text_does_not_keep_the_next_from_zooming(page: Any):
    """A drag that begins in marked text would carry the text, not zoom."""
    from selenium.webdriver import ActionChains

    first = flight_figures(page)[0]
    marked = "return String(getSelection())"

    def drag(right: int, down: int) -> None:
        chain = ActionChains(page).move_to_element_with_offset(first, -40, 0).click_and_hold()
        chain.move_by_offset(right, down).release().perform()

    drag(90, 300)
    assert page.execute_script(marked) == ""
    for mark in ("", "getSelection().selectAllChildren(document.body)"):
        page.execute_script(mark)
        drag(90, 0)
        assert page.execute_script(LABELS, first) != [], mark
        ActionChains(page).double_click(first).perform()
        assert page.execute_script(LABELS, first) == []


def test_a_bode_figure_zooms_with_its_band_and_its_points(page: Any):
    """Where a curve goes on the drawing of a range, its band and its markers go too."""
    flight_figures(page)
    bode = next(
        f
        for f in page.find_elements("css selector", "svg[data-axes]")
        if "over" in f.get_attribute("aria-label")
    )
    places = (
        "const a = arguments[0].querySelector('.axes'), box = e => e.getBoundingClientRect();const "
        "at = s => [...a.querySelectorAll(':scope > ' + s)].map(box);return [at('.curve > g "
        "use').map(r => r.x + r.width / 2), ...['.band path', '.curve > path'].map(s => "
        "at(s).map(r => [r.left, r.right, r.top, r.bottom]))]"
    )
    page.execute_script(
        "arguments[0].scrollIntoView({behavior: 'instant'}); arguments[0].focus()", bode
    )
    before = page.execute_script(places, bode)
    for view in ("whole", "zoomed"):
        dots, bands, curves = now = page.execute_script(places, bode)
        for left, right, *_ in bands:  # a band ends at points of the curve
            assert min(abs(left - x) for x in dots) < 0.5, view
            assert min(abs(right - x) for x in dots) < 0.5, view
        assert bands[0][2] - 1 <= curves[1][2], view  # and holds it
        bode.send_keys("+")
    for old, new in zip((before[1][0], before[2][0]), (now[1][0], now[2][0]), strict=True):
        assert new[1] - new[0] == pytest.approx(2 * (old[1] - old[0]), rel=0.02)
    bode.send_keys("0")
    assert page.execute_script(places, bode)[1][0] == pytest.approx(before[1][0], abs=0.1)


def test_the_cursor_tells_by_mouse_and_by_keyboard_what_the_curves_are_there(page: Any):
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.keys import Keys

    figures = flight_figures(page)
    ActionChains(page).move_to_element(figures[0]).perform()
    shown = [
        f
        for f in figures
        if page.execute_script("return !!arguments[0].querySelector('.cursor')", f)
    ]
    assert len(shown) == 6  # three panels of the liveliest seconds, three of the whole flight
    page.execute_script("arguments[0].focus()", figures[3])
    figures[3].send_keys(Keys.ARROW_RIGHT)
    said = page.execute_script("return document.querySelector('.said').textContent")
    at, *values = re.findall("[\N{MINUS SIGN}]?\\d+\\.?\\d*", said.replace(" [m]", ""))
    assert said.startswith("time [s] ")
    x = next(iter(make_flights().values())).channels["x"].measured
    near = x[round(float(at) * 100) - 15 : round(float(at) * 100) + 15]
    assert near.min() - 0.1 <= float(values[0].replace("\N{MINUS SIGN}", "-")) <= near.max() + 0.1
    figures[3].send_keys("+")
    assert page.execute_script(LABELS, figures[3]) != []
    figures[3].send_keys("0")
    assert page.execute_script(LABELS, figures[3]) == []


def test_the_ghost_is_where_the_model_said_and_its_distance_is_right(page: Any):
    flight_figures(page)
    move = (
        "const r = document.querySelector('.replay'), [t, h] = r.querySelectorAll('input');t.value "
        "= arguments[0]; h.value = arguments[1];t.dispatchEvent(new Event('input')); "
        "h.dispatchEvent(new Event('input'));const c = r.querySelector('canvas');return "
        "[r.querySelector('output').textContent, c.toDataURL().length, c.width]"
    )
    # The made-up model is 0.3 h^2 m off after h seconds, and turned by 10 h degrees.
    for horizon, off, angle in ((0.5, 7.5, 5.0), (1.0, 30.0, 10.0)):
        said, drawn, width = page.execute_script(move, 12.0, horizon)
        numbers = [float(v) for v in re.findall(r"\d+\.\d+", said)]
        assert numbers == [
            12.0,
            horizon,
            pytest.approx(off, abs=0.3),
            pytest.approx(angle, abs=0.2),
        ]
        assert drawn > 5000
        assert width > 600
    assert page.get_log("browser") == []


@pytest.mark.parametrize("width", [1200, 1280])
def test_no_table_of_the_page_is_cut_off_on_a_desk(page: Any, width: int):
    size(page, width, 900)
    cut = page.execute_script(
        "document.querySelectorAll('details').forEach(d => { d.open = true; });"
        "return [...document.querySelectorAll('.scroll')].filter(e => e.scrollWidth > "
        "e.clientWidth + 1)"
        ".map(e => e.textContent.slice(0, 60))"
    )
    page.refresh()
    assert cut == []


def test_it_prints_to_paper(page: Any):
    for folds in ("closed", "open"):
        printed = base64.b64decode(
            page.execute_cdp_cmd("Page.printToPDF", {"printBackground": True})["data"]
        )
        assert printed[:5] == b"%PDF-"
        assert 5_000 < len(printed) < 4_000_000, folds
        page.execute_script("document.querySelectorAll('details').forEach(d => { d.open = true; })")
    page.refresh()


def test_it_is_under_three_megabytes_and_says_what_to_do_next(page: Any):
    source = page.page_source
    assert len(source.encode()) < 3_000_000
    assert "What to do next" in source
