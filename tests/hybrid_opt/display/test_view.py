"""A carry in three dimensions: safe with hostile names, complete, and played in a real browser."""

from __future__ import annotations

import base64
import html
import json
import os
import re
import shutil
import subprocess
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybrid_opt.carry import Carry
from hybrid_opt.display import scene
from hybrid_opt.errors import DisplayError
from symbolic.read.cell import load
from tests.hybrid_opt.campaign.fake import RACK
from tests.hybrid_opt.cells import shipped
from tests.refusals import refused
from tests.waiting import HANGS

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
EVIL = "</title></script><script>window.broken = 1</script>"


@cache
def carry() -> Carry:
    cell = shipped("rack")
    return cell.carry(cell.initial)


@given(st.recursive(st.text() | st.integers(), lambda inner: st.lists(inner, max_size=3)))
def test_embedded_json_reads_back_and_ends_no_element(value: object) -> None:
    embedded = scene.embedded_json([value, "</script>", "<!--"])
    assert not set("<>&\u2028\u2029") & set(embedded)
    assert json.loads(embedded)[0] == value


def test_the_page_holds_the_carry() -> None:
    page = carry().view().page()
    found = re.search(r'id="carry">(.*?)</script>', page, flags=re.DOTALL)
    assert found is not None
    data = json.loads(found[1])
    samples = np.frombuffer(base64.b64decode(data["samples"]), "<f4").reshape(-1, data["width"])
    expected = np.column_stack([carry().time, carry().pose, carry().q])
    np.testing.assert_allclose(samples[[0, -1]], expected[[0, -1]], atol=1e-5)
    assert [len(arm["axes"]) for arm in data["arms"]] == [6, 6]
    assert "://" not in re.sub(r"<script>.*?</script>", "", page, flags=re.DOTALL)


def test_hostile_names_stay_text() -> None:
    workcell = replace(load(RACK), name=EVIL)
    view = replace(carry(), workcell=workcell).view()
    assert EVIL not in view.page()
    frame = view._repr_html_()
    assert frame.count("<") == 2
    assert html.unescape(frame.split('srcdoc="')[1].split('"')[0]) == view.page()


def test_a_page_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    with refused(DisplayError, "not-writable"):
        carry().view().save(tmp_path / "no folder" / "view.html")


@pytest.mark.skipif(
    BROWSER is None and not os.environ.get("CI"), reason="chromium is not installed"
)
def test_it_draws_in_a_browser(tmp_path: Path) -> None:
    assert BROWSER is not None, "CI has to install chromium"
    carry().view().save(tmp_path / "view.html")
    command = [BROWSER, "--headless=new", "--no-sandbox", "--disable-dev-shm-usage"]
    command += ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--dump-dom"]
    command += ["--virtual-time-budget=20000", (tmp_path / "view.html").as_uri()]
    run = subprocess.run(command, capture_output=True, text=True, timeout=HANGS, check=True)
    assert 'data-ready="yes"' in run.stdout
    assert f"0.00 / {carry().duration:.2f} s" in run.stdout
    assert "<canvas" in run.stdout
