"""A browser without a window and a report for it, as fixtures that tests import."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from selenium import webdriver
from selenium.webdriver.support.ui import WebDriverWait

from studies.report.data import ReportData
from studies.report.generate import write_report

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
DRIVER = shutil.which("chromedriver")
WIDE, NARROW = (1500, 1000), (420, 900)
SECONDS = 60.0

if not (BROWSER and DRIVER) and not os.environ.get("CI"):
    pytest.skip("chromium and chromium-driver are not installed", allow_module_level=True)


@pytest.fixture(scope="module")
def report(data: ReportData, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_report(tmp_path_factory.mktemp("page"), data, with_paper=False)


@pytest.fixture(scope="module")
def browser() -> Iterator[webdriver.Chrome]:
    assert BROWSER, "CI has to install chromium"
    assert DRIVER, "CI has to install chromium-driver"
    options = webdriver.ChromeOptions()
    options.binary_location = BROWSER
    for argument in (
        "--headless=new",
        "--no-sandbox",
        "--disable-dev-shm-usage",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        "--force-device-scale-factor=1",
    ):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
    yield driver
    driver.quit()


def opened(browser: webdriver.Chrome, report: Path, size: tuple[int, int] = WIDE) -> None:
    browser.set_window_size(*size)
    browser.get(report.as_uri())
    until(browser, lambda: browser.execute_script("return document.documentElement.dataset.ready"))


def until(browser: webdriver.Chrome, condition: Callable[[], Any]) -> Any:
    return WebDriverWait(browser, SECONDS).until(lambda _: condition())


def logged(browser: webdriver.Chrome, kind: str) -> list[dict[str, Any]]:
    """The browser's log since it was last read."""
    entries: list[dict[str, Any]] = browser.get_log(kind)  # type: ignore[no-untyped-call]
    return entries


def state(browser: webdriver.Chrome) -> dict[str, Any]:
    found: dict[str, Any] = browser.execute_script(
        "const s = report.state; return {selected: s.selected, share: s.share, playing: s.playing}"
    )
    return found
