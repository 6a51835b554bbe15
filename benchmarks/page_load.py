"""How long is a reader's browser busy until a report is drawn?

Each kind of report in headless Chromium, from the start of the navigation to the end of its load event [s]; the fastest of
five counts. Needs Chromium, its driver, selenium (extra `test`) and the tests.

    python -m benchmarks.page_load
"""

from __future__ import annotations

import tempfile
from pathlib import Path

TIMES = 5


def main() -> None:
    """Print one row per kind of report: seconds and size of the file."""
    from selenium.webdriver.support.ui import WebDriverWait

    from tests.report.test_pages_work_in_a_real_browser import PAGES, headless

    # The browser sets the end of the load event only after the handlers of the event have run.
    loaded = "return performance.getEntriesByType('navigation')[0].loadEventEnd / 1000"
    with tempfile.TemporaryDirectory() as folder:
        browser = headless(Path(folder) / "profile")
        try:
            for name, page in PAGES.items():
                path = Path(folder) / f"{name}.html"
                path.write_text(page(), encoding="utf-8")
                seconds = []
                for _ in range(TIMES):
                    browser.get(path.as_uri())
                    seconds.append(WebDriverWait(browser, 60).until(lambda b: b.execute_script(loaded)))
                print(f"{name:10} {min(seconds):6.2f} s {path.stat().st_size / 1024:8.0f} KiB", flush=True)
        finally:
            browser.quit()


if __name__ == "__main__":
    main()
