"""The page in a real browser: nothing leaves the machine, the star is the recommended carry,
nothing is cut."""

from __future__ import annotations

from pathlib import Path

import pytest
from selenium import webdriver
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By

from tests.studies.report.browsing import browser, opened, report, state, until

__all__ = ["browser", "report"]


def test_nothing_on_the_page_offers_to_leave_the_machine(
    browser: webdriver.Chrome, report: Path
) -> None:
    opened(browser, report)
    titles = browser.execute_script(
        "return [...document.querySelectorAll('.modebar-btn')].map((b) => b.dataset.title)"
    )
    assert titles
    assert not [title for title in titles if "hare" in title or "loud" in title]
    contexts = browser.execute_script(
        "return [...document.querySelectorAll('.js-plotly-plot')].map((plot) => "
        "[plot._context.showSendToCloud, plot._context.plotlyServerURL])"
    )
    assert contexts == [[False, ""]] * 4
    addresses = "return [...document.querySelectorAll('[href], [action]')].map((e) => e.outerHTML)"
    assert browser.execute_script(addresses) == []


def test_the_star_is_the_recommended_carry(browser: webdriver.Chrome, report: Path) -> None:
    opened(browser, report)
    star = browser.execute_script(
        "return report.data.views[0].data.find((t) => t.marker?.symbol === 'star').customdata[0]"
    )
    lists = browser.execute_script("return report.data.lists")
    assert lists[0] == {"label": "Recommended", "members": [star]}
    other = next(group["members"][0] for group in lists if group["label"] != "Recommended")
    browser.execute_script("report.select(arguments[0])", other)
    marks = "#front-plot .scatterlayer .trace:nth-of-type({}) .point"
    traces = browser.execute_script(
        "return document.getElementById('front-plot').data.map((t) => [t.name, t.marker && "
        "t.marker.symbol])"
    )
    place = next(k for k, (name, _) in enumerate(traces) if name == "Recommended")
    assert place == len(traces) - 2  # above all but the ring around what is chosen
    assert [name for name, symbol in traces if symbol == "star"] == ["Recommended"]
    target = browser.find_element(By.CSS_SELECTOR, marks.format(place + 1))
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", target)
    ActionChains(browser).move_to_element(target).pause(0.2).click().perform()
    until(browser, lambda: state(browser)["selected"] == star)
    # The star means nothing else in the other picture either.
    browser.find_elements(By.CSS_SELECTOR, "#views button[data-view]")[1].click()
    assert "star" not in browser.execute_script(
        "return document.getElementById('front-plot').data.map((t) => t.marker && t.marker.symbol)"
    )


@pytest.mark.parametrize("width", [1440, 1100])
def test_no_phase_and_no_table_is_cut(browser: webdriver.Chrome, report: Path, width: int) -> None:
    opened(browser, report, (width, 1000))
    names = browser.execute_script(
        "return [...document.querySelectorAll('#phases button')].map((b) => "
        "[b.textContent, b.scrollWidth - b.clientWidth])"
    )
    assert len(names) > 3
    assert [name for name, hidden in names if hidden > 0] == []
    if width < 1440:
        return
    cut = browser.execute_script(
        "return [...document.querySelectorAll('.scroll')].filter((e) => "
        "e.scrollWidth > e.clientWidth + 1).map((e) => e.textContent.slice(0, 60))"
    )
    assert cut == []
