"""Animation files, and the page that a browser is given."""

from __future__ import annotations

import urllib.request
from itertools import pairwise
from pathlib import Path
from threading import Thread

import imageio_ffmpeg  # type: ignore[import-untyped]
import numpy as np
import pytest
from PIL import Image, ImageSequence

from studies.errors import ReportError
from studies.report.__main__ import main
from studies.report.data import DrawnCarry, ReportData
from studies.report.looks import (
    FRAMES_PER_SECOND,
    Film,
    frames,
    page_of,
    page_server,
    write_animation,
)
from studies.report.stage import PAGE


@pytest.fixture(scope="module")
def carry(data: ReportData) -> DrawnCarry:
    return data.initial


def test_a_gif_plays_in_real_time(data: ReportData, carry: DrawnCarry, tmp_path: Path) -> None:
    path = tmp_path / "made" / "carry.gif"
    write_animation(data.geometry, Film.of(carry), path)
    image = Image.open(path)
    durations = [frame.info["duration"] for frame in ImageSequence.Iterator(image)]
    # GIF counts hundredths of a second, so a frame of 66.7 ms is written as 60 or 70.
    assert sum(durations[:-1]) / 1000 == pytest.approx(carry.timed.duration, rel=0.12)
    assert path.stat().st_size < 5_000_000
    image.seek(0)
    first = np.asarray(image.convert("RGB"), dtype=int)
    image.seek(len(durations) // 2)
    assert (
        np.abs(np.asarray(image.convert("RGB"), dtype=int) - first).max(axis=2) > 40
    ).mean() > 0.01


def test_frames_show_the_motion_from_start_to_goal(data: ReportData, carry: DrawnCarry) -> None:
    pictures = list(frames(data.geometry, Film.of(carry)))
    assert len(pictures) == round(carry.timed.duration * FRAMES_PER_SECOND) + 1
    assert {picture.shape for picture in pictures} == {(400, 640, 3)}
    steps = [np.abs(a.astype(int) - b).mean() for a, b in pairwise(pictures)]
    assert max(steps) > 0.1


def test_an_mp4_plays_in_real_time(data: ReportData, carry: DrawnCarry, tmp_path: Path) -> None:
    path = tmp_path / "carry.mp4"
    write_animation(data.geometry, Film.of(carry), path)
    count, seconds = imageio_ffmpeg.count_frames_and_secs(str(path))
    assert count == round(carry.timed.duration * FRAMES_PER_SECOND) + 1
    assert seconds == pytest.approx(carry.timed.duration, abs=2.0 / FRAMES_PER_SECOND)


def test_another_suffix_is_refused(data: ReportData, carry: DrawnCarry, tmp_path: Path) -> None:
    with pytest.raises(ReportError, match=r"\.gif or \.mp4"):
        write_animation(data.geometry, Film.of(carry), tmp_path / "carry.avi")


def test_the_program_animates_a_results_folder(study: Path, tmp_path: Path) -> None:
    path = tmp_path / "chosen.gif"
    assert main([str(study), "--animation", str(path)]) == 0
    assert Image.open(path).n_frames > 10  # type: ignore[attr-defined]


def test_the_program_tells_what_is_no_results_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(tmp_path)]) == 2
    assert "configuration.json is missing" in capsys.readouterr().err


def test_a_browser_is_given_the_report(study: Path, own_study: Path) -> None:
    """Or, where there is none, a page that plays a trajectory."""
    (own_study / PAGE).write_text("<p>the report</p>")
    for page, words in ((page_of(own_study), "<p>the report</p>"), (page_of(study), "CellScene")):
        server = page_server(page, 0)
        Thread(target=server.serve_forever, daemon=True).start()
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{server.server_port}") as answer:
                assert words in answer.read().decode()
            other = page_server(page, server.server_port)
            assert other.server_port != server.server_port
            other.server_close()
        finally:
            server.shutdown()
            server.server_close()
