"""The live view as its user has it: the program in its own process, a real browser, a mouse."""

from __future__ import annotations

import io
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from selenium import webdriver
from selenium.common.exceptions import TimeoutException
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import WebDriverWait

import hybrid_opt as ho
from tests.symbolic.cells import RACK
from tests.waiting import HANGS

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
DRIVER = shutil.which("chromedriver")

if not (BROWSER and DRIVER) and not os.environ.get("CI"):
    pytest.skip("chromium and chromium-driver are not installed", allow_module_level=True)

DRAGGED = "pallet in front"
UPWARDS = np.array([0x20, 0x80, 0xFF])
"""Colour of the arrow along z."""

WAY = (*(1, 2, 3, 4, 5, 6, 5, 4, 3, 2, 1, 0), *(1, 2, 3, 4, 5, 6, 5, 4, 3, 4, 3, 4))
"""Of the mouse while it drags [pixels upwards], 8 mm each."""

SLOWEST, LONGEST = 0.1, 120.0
"""Verdicts per second, and seconds of a search: a hundredth and forty times what a machine with
nothing else to do has. Without a graphics card and beside other programs the browser draws one
picture per second, and the mouse waits for it."""

SEEN = """
window.verdicts = [];
new MutationObserver(() => {
  const text = document.body.innerText.match(/judged in [0-9.]+ ms/);
  if (text && text[0] !== window.verdicts.at(-1)?.[1])
    window.verdicts.push([performance.now(), text[0]]);
}).observe(document.body, {subtree: true, childList: true, characterData: true});
"""


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Where the program serves the rack."""
    command = [sys.executable, "-m", "studies.live", str(RACK), "--port", "18190"]
    program = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert program.stderr is not None
    found = next(filter(None, (re.search(r"Open (\S+)", line) for line in program.stderr)), None)
    assert found is not None, "it ended before"
    yield found[1]
    program.send_signal(signal.SIGINT)
    assert program.wait(HANGS) == 0


@pytest.fixture(scope="module")
def browser(page: str) -> Iterator[webdriver.Chrome]:
    options = webdriver.ChromeOptions()
    assert BROWSER, "CI has to install chromium"
    assert DRIVER, "CI has to install chromium-driver"
    options.binary_location = BROWSER
    for argument in (
        *("--headless=new", "--no-sandbox", "--disable-dev-shm-usage"),
        *("--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
        *("--force-device-scale-factor=1", "--window-size=1000,800"),
    ):
        options.add_argument(argument)
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
    driver.get(page)
    until(driver, lambda: "judged in" in text(driver))
    driver.execute_script(SEEN)
    yield driver
    driver.quit()


def until(browser: webdriver.Chrome, condition: Callable[[], Any]) -> Any:
    return WebDriverWait(browser, HANGS).until(lambda _: condition())


def text(browser: webdriver.Chrome) -> str:
    found: str = browser.find_element(By.TAG_NAME, "body").text
    return found


def arrow(browser: webdriver.Chrome) -> tuple[int, int] | None:
    """The tip of the arrow along z on the page, None while there is none, or no picture."""
    try:
        png = browser.get_screenshot_as_png()
    except TimeoutException:  # after ten seconds, on a crowded machine
        return None
    picture = np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))
    scene = picture[150:, :620].astype(int)
    rows, columns = np.nonzero(np.abs(scene - UPWARDS).max(axis=2) < 40)
    if not len(rows):
        return None
    top = int(rows.argmin())
    return int(columns[top]), int(rows[top]) + 150


def grasped(browser: webdriver.Chrome) -> tuple[int, int]:
    """Where the mouse holds that arrow: what it drags there is judged."""
    x, tip = until(browser, lambda: arrow(browser))
    for below in (3, 6, 1, 9, 12):
        browser.execute_script("window.verdicts = []")
        mouse = ActionChains(browser, duration=25)
        pointer: Any = mouse.w3c_actions.pointer_action
        pointer.move_to_location(x, tip + below)
        pointer.pointer_down()
        pointer.move_to_location(x, tip + below - 1)
        mouse.perform()
        time.sleep(3.0)
        if browser.execute_script("return window.verdicts.length"):
            return x, tip + below
        ActionChains(browser).release().perform()
    raise AssertionError("no arrow along z was found")


def pressed(browser: webdriver.Chrome, label: str) -> None:
    (button,) = [b for b in browser.find_elements(By.TAG_NAME, "button") if b.text == label]
    browser.execute_script("arguments[0].click()", button)


@pytest.mark.slow
def test_what_is_dragged_is_judged_meanwhile_and_made_better(
    browser: webdriver.Chrome, tmp_path: Path
) -> None:
    choice = browser.find_element(By.CSS_SELECTOR, "input[role=combobox][value=nothing]")
    choice.click()
    chosen = f"//*[@role='option'][.='{DRAGGED}']"
    until(browser, lambda: browser.find_elements(By.XPATH, chosen))
    browser.find_element(By.XPATH, chosen).click()
    x, y = grasped(browser)
    browser.execute_script("window.verdicts = []")
    mouse = ActionChains(browser, duration=25)
    pointer: Any = mouse.w3c_actions.pointer_action
    for up in WAY:
        pointer.move_to_location(x, y - up)
    pointer.pointer_up()
    began = time.monotonic()
    mouse.perform()
    took = time.monotonic() - began
    seen = browser.execute_script("return window.verdicts")
    rate = len(seen) / took
    print(f"\n{len(WAY)} moves, {len(seen)} verdicts in {took:.1f} s, the last {seen[-1][1]}")
    assert rate > SLOWEST
    # The cell on the screen is the one that is saved: the obstacle is where it was dragged to.
    field = browser.find_element(By.CSS_SELECTOR, "input[value=live]")
    field.send_keys(Keys.CONTROL, "a")
    field.send_keys(str(tmp_path / "mine"))
    time.sleep(1.0)
    pressed(browser, "save the cell")
    until(browser, lambda: "saved:" in text(browser))
    (file,) = (tmp_path / "mine").rglob("*.toml")
    before, after = (
        next(body.pose for body in cell.workcell.environment if body.name == DRAGGED)
        for cell in (ho.Cell.load(RACK), ho.Cell.load(file))
    )
    moved = after[:3, 3] - before[:3, 3]
    print(f"dragged by {moved}")
    assert 0.005 < moved[2] < 0.08
    np.testing.assert_allclose(moved[:2], 0.0, atol=1e-9)
    began = time.monotonic()
    pressed(browser, "optimise from here")
    until(browser, lambda: "judged in" in text(browser))
    took = time.monotonic() - began
    print(f"optimised in {took:.1f} s")
    assert took < LONGEST
    told = next(line for line in text(browser).splitlines() if "feasible" in line)
    assert told.startswith("feasible, "), told
