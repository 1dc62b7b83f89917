"""The page of a session, in a real browser: what is typed and dragged is judged on it."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

import hybrid_opt as ho
from hybrid_opt.workbench.browser import Workbench
from hybrid_opt.workbench.session import handles
from tests.hybrid_opt.cells import shipped
from tests.waiting import HANGS

pytestmark = pytest.mark.skipif(
    not (shutil.which("chromium") and shutil.which("chromedriver")), reason="no Chromium"
)


@pytest.fixture(scope="module")
def bench() -> Iterator[Workbench]:
    page = ho.live(shipped("rack"), port=18080)
    yield page
    page.close()


def waited(holds: Callable[[], bool], what: str) -> None:
    end = time.monotonic() + HANGS
    while not holds():
        assert time.monotonic() < end, what
        time.sleep(0.02)


def test_what_is_typed_is_judged_on_the_page(bench: Workbench, tmp_path: Path) -> None:
    from selenium import webdriver
    from selenium.webdriver.common.by import By
    from selenium.webdriver.common.keys import Keys

    options = webdriver.ChromeOptions()
    for flag in (
        "--headless=new",
        "--no-sandbox",
        "--window-size=640,480",
        "--use-gl=swiftshader",
    ):
        options.add_argument(flag)
    driver = webdriver.Chrome(options=options)
    try:
        driver.get(bench.url)

        def page() -> str:
            return str(driver.find_element(By.TAG_NAME, "body").text)

        waited(lambda: "feasible" in page() and "press with" in page(), "the first verdict")
        field = next(
            one
            for one in driver.find_elements(By.TAG_NAME, "input")
            if one.get_attribute("value") == "10"
        )
        field.send_keys(Keys.CONTROL, "a")
        field.send_keys("11", Keys.ENTER)
        waited(lambda: bench.session.cell.workcell.payload.mass == 11.0, "the mass")
        force = bench.session.verdict.squeeze
        assert force is not None
        waited(lambda: f"press with {force.force:.1f} N" in page(), "its verdict")
        driver.save_screenshot(str(tmp_path / "live.png"))
        assert not [
            entry
            for entry in driver.get_log("browser")  # type: ignore[no-untyped-call]
            if entry["level"] == "SEVERE"
        ]
    finally:
        driver.quit()


def test_dragging_never_queues_and_ends_where_it_was_let_go(bench: Workbench) -> None:
    (pallet,) = [one for one in handles(bench.session.cell.workcell) if "pallet" in one.key]
    for k in range(50):
        z = pallet.pose[2, 3] + 0.001 * k
        bench.ask({f"{pallet.key}.xyz": [*pallet.pose[:2, 3].tolist(), z]})
    end = pallet.pose[2, 3] + 0.049

    def there() -> bool:
        body = next(b for b in bench.session.cell.workcell.environment if b.name == pallet.title)
        return bool(abs(body.pose[2, 3] - end) < 1e-9)

    waited(there, "the last place")
    assert np.isfinite(bench.session.verdict.seconds)
