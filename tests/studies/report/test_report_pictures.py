"""Every figure of a report: units, legends, nothing clipped, nothing empty, nothing overlapping;
what pictures of a cell are made of; animations and the live view."""

from __future__ import annotations

import urllib.request
from collections.abc import Iterable
from dataclasses import replace
from itertools import combinations, pairwise
from pathlib import Path
from threading import Thread

import imageio_ffmpeg  # type: ignore[import-untyped]
import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.axes._base import _AxesBase
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox
from PIL import Image
from PIL.ImageSequence import Iterator

from hybrid_opt.display.solids import cell_solids
from studies.program import ReportError
from studies.report import PAGE, looks
from studies.report.__main__ import main
from studies.report.data import ReportData, ReportRun
from studies.report.drawing import (
    FRONT_VIEW,
    HAND_MADE_STYLE,
    MAX_EDGE,
    SERIES,
    SIDE,
    CutCell,
    View,
    in_style,
    oblique,
    save,
)
from studies.report.generate import ReportPicture, report_pictures
from studies.report.looks import (
    FRAMES_PER_SECOND,
    Film,
    frames,
    page_of,
    page_server,
    write_animation,
)
from studies.report.pictures_carry import joint_torques
from studies.report.pictures_cell import facing, planes
from symbolic.array import Array
from symbolic.read.cell import load
from tests.refusals import refused
from tests.studies.conftest import TRANSFER

NAMES = (
    "duration_against_force",
    "motion_recommended",
    "robust_price",
    "simulated_forces",
    "fig04_reachable_regions",
    "fig05_cell",
    "fig06_arm",
    "fig07_fronts",
    "fig08_best_so_far",
    "attainment",
    "indicators",
    "polish",
    "infeasibility",
    "fig09_normal_forces",
    "fig10_joint_torques",
    "fig11_pressure_shift",
    "residual_moments",
    "fig12_payload",
    "fig13_paths",
    "motion_nsga2",
    "motion_mopso",
)

HYBRID = ("polish", "simulated_forces")
"""What `hybrid_data` has besides."""


NONE = np.empty((0, 2))

Drawn = dict[str, tuple[ReportPicture, Figure]]


@pytest.fixture(scope="module")
def drawn(hybrid_data: ReportData) -> Drawn:
    figures = {}
    with in_style():
        for entry in report_pictures(hybrid_data):
            figure = entry.draw()
            FigureCanvasAgg(figure).draw()  # type: ignore[no-untyped-call]
            figures[entry.name] = (entry, figure)
    return figures


def visible_texts(figure: Figure) -> list[Text]:
    """Texts that are shown, without tick labels outside of their axis' limits."""
    texts = [t for t in figure.findobj(Text) if t.get_visible() and t.get_text().strip()]
    hidden: set[Text] = set()
    # A second scale beside a panel is no `Axes`, but what both are.
    for axes in figure.findobj(_AxesBase):
        if not axes.axison:
            hidden |= {*axes.get_xticklabels(), *axes.get_yticklabels()}
            hidden |= {axes.xaxis.label, axes.yaxis.label}
            continue
        if getattr(axes, "name", "rectilinear") != "rectilinear":
            continue
        for axis, limits in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
            low, high = sorted(limits)
            slack = 1e-6 * (high - low)
            for which in ("major", "minor"):
                places = axis.get_ticklocs(minor=which == "minor")
                labels = axis.get_ticklabels(which=which)
                hidden |= {
                    label
                    for place, label in zip(places, labels, strict=False)
                    if not low - slack <= place <= high + slack
                }
    return [text for text in texts if text not in hidden]


@pytest.mark.parametrize("name", ["rack", "tiago"])
def test_the_first_arm_reaches_towards_the_eye(name: str) -> None:
    """The TIAGo's arms reach ahead; from behind, its torso hides them."""
    cell = load(TRANSFER.with_name(f"{name}.toml"))
    way = cell.task.waypoints[0].lower[:3] - cell.robots[0].T_world_base[:3, 3]
    level = facing(way).towards * (1.0, 1.0, 0.0)
    assert level @ way > 0.0


def test_the_report_has_every_figure(drawn: Drawn) -> None:
    assert tuple(drawn) == NAMES


def test_without_a_polish_there_is_no_figure_of_it(data: ReportData) -> None:
    names = [entry.name for entry in report_pictures(data)]
    assert tuple(names) == tuple(name for name in NAMES if name not in HYBRID)


def test_without_a_feasible_candidate_the_rest_is_drawn(data: ReportData) -> None:
    failed = tuple(
        replace(
            algorithm,
            best=None,
            runs=tuple(
                replace(run, front=replace(run.front, x=run.front.x[:0], objectives=NONE))
                for run in algorithm.runs
            ),
        )
        for algorithm in data.algorithms
    )
    shown = replace(data, algorithms=failed, timings=data.timings[:1])
    names = [entry.name for entry in report_pictures(shown)]
    assert "fig07_fronts" not in names
    for entry in report_pictures(shown):
        assert entry.draw().axes


def test_joint_torques_have_one_scale(drawn: Drawn) -> None:
    panels = drawn["fig10_joint_torques"][1].get_axes()
    assert len(panels) == 4
    assert len({axes.get_ylim() for axes in panels}) == 1


def test_an_arm_of_unknown_torques_has_an_empty_panel_that_says_so(
    hybrid_data: ReportData,
) -> None:
    cell = hybrid_data.workcell
    unknown = replace(cell.robots[0], torque_max=np.full(6, np.inf))
    data = replace(hybrid_data, workcell=replace(cell, robots=(unknown, cell.robots[1])))
    panels = joint_torques(data).get_axes()
    told = ["unknown" in panel.get_title() for panel in panels]
    assert told == [True, False, True, False]
    for panel, is_empty in zip(panels, told, strict=True):
        assert np.isnan(panel.lines[0].get_ydata()).all() == is_empty


@pytest.mark.parametrize(
    ("extent", "names"),
    [
        ((0.5, 0.01, 0.4), ("x–z plane", "x–y plane")),
        ((0.02, 0.6, 0.4), ("y–z plane", "x–y plane")),
        ((0.3, 0.6, 0.01), ("x–y plane", "y–z plane")),
    ],
)
def test_paths_are_seen_edge_on_once_at_most(
    extent: tuple[float, float, float], names: tuple[str, str]
) -> None:
    points = np.vstack([np.zeros(3), extent])
    first, second = planes(points)
    assert (first[1], second[1]) == names
    seen = np.ptp(first[0].flat(points), axis=0)
    np.testing.assert_allclose(np.sort(seen), np.sort(extent)[1:])


def clipped(figure: Figure) -> list[str]:
    """Texts that leave the figure."""
    width, height = figure.bbox.width + 1, figure.bbox.height + 1
    boxes = [(text.get_text(), text.get_window_extent()) for text in visible_texts(figure)]
    return [
        name for name, box in boxes if min(box.x0, box.y0) < -1 or box.x1 > width or box.y1 > height
    ]


def overlapping(boxes: Iterable[tuple[str, Bbox]]) -> list[tuple[str, str]]:
    """Texts that cover one another."""
    return [(a[0], b[0]) for a, b in combinations(boxes, 2) if a[1].overlaps(b[1])]


GAP = 6.0
"""Between tick labels [pixel of 1/200 inch]; a digit is twelve wide."""


def overlapping_ticks(figure: Figure) -> list[tuple[str, str]]:
    """Tick labels of the same axis that cover one another, or leave no gap to be told apart by."""
    shown, found = set(visible_texts(figure)), []
    for axes in figure.findobj(Axes):
        if axes.name != "rectilinear" or not axes.axison:
            continue
        for labels in (axes.get_xticklabels(), axes.get_yticklabels()):
            seen = [label for label in labels if label in shown and not labels[0].get_rotation()]
            boxes = [(label.get_text(), label.get_window_extent()) for label in seen]
            found += overlapping((text, box.padded(GAP / 2.0)) for text, box in boxes)
    return found


@pytest.mark.parametrize("name", NAMES)
def test_nothing_is_clipped_and_no_texts_overlap(name: str, drawn: Drawn) -> None:
    _, figure = drawn[name]
    assert clipped(figure) == []
    assert overlapping_ticks(figure) == []
    marked = []
    for axes in figure.findobj(Axes):
        titles = [axes.title, axes._left_title]  # type: ignore[attr-defined]
        labels = [axes.xaxis.label, axes.yaxis.label] if axes.axison else []
        texts = [text for text in (*titles, *labels) if text.get_text().strip()]
        marked += [(text.get_text(), text.get_window_extent()) for text in texts]
    assert overlapping(marked) == []
    for legend in figure.legends:
        box = legend.get_window_extent()
        assert [name for name, place in marked if place.overlaps(box)] == []


@pytest.mark.parametrize("span", [0.0012, 0.018])
def test_tick_labels_of_narrow_fronts_do_not_overlap(hybrid_data: ReportData, span: float) -> None:
    def squeezed(points: Array) -> Array:
        return np.asarray(0.4133 + span * (points - points.min()) / np.ptp(points))

    def moved(run: ReportRun) -> ReportRun:
        front, hybrid = (replace(f, objectives=squeezed(f.objectives)) for f in run.fronts)
        return replace(run, front=front, hybrid=hybrid)

    algorithms = tuple(
        replace(algorithm, runs=tuple(moved(run) for run in algorithm.runs))
        for algorithm in hybrid_data.algorithms
    )
    shown = replace(hybrid_data, algorithms=algorithms, at_rest=None)
    for entry in report_pictures(shown):
        if entry.name in ("fig07_fronts", "attainment", "polish"):
            with in_style():
                figure = entry.draw()
                FigureCanvasAgg(figure).draw()  # type: ignore[no-untyped-call]
                assert overlapping_ticks(figure) == []


@pytest.mark.parametrize("name", NAMES)
def test_every_axis_says_its_unit_and_shows_something(name: str, drawn: Drawn) -> None:
    _, figure = drawn[name]
    for axes in figure.axes:
        if axes.name == "polar":
            assert "[% of maximum]" in axes.get_title()
        elif axes.axison:
            named = {axes.get_xlabel(), axes.get_ylabel()} - {""}
            assert all("[" in label for label in named)
            siblings = axes.get_shared_y_axes().get_siblings(axes)
            if not any(other.get_ylabel() for other in siblings):
                assert axes.get_yticklabels()[0].get_text().isalpha(), named
    # No panel is empty.
    pixels = np.asarray(figure.canvas.buffer_rgba())[:, :, :3]  # type: ignore[attr-defined]
    for axes in figure.axes:
        box = axes.get_window_extent()
        height = pixels.shape[0]
        rows = slice(int(height - box.y1) + 3, int(height - box.y0) - 3)
        columns = slice(int(box.x0) + 3, int(box.x1) - 3)
        panel = pixels[rows, columns].reshape(-1, 3)
        # Grid lines and background alone are grey.
        coloured = np.ptp(panel.astype(int), axis=1) > 25
        assert coloured.mean() > 1e-4


def test_print_and_screen_files_repeat_to_the_byte(drawn: Drawn, tmp_path: Path) -> None:
    entry, figure = drawn["fig09_normal_forces"]
    png, pdf = save(figure, tmp_path, "figure")
    width, height = Image.open(png).size
    assert width == pytest.approx(180 / 25.4 * 200, abs=2)
    assert height > 400
    assert pdf.read_bytes().startswith(b"%PDF")
    assert b"/FontFile2" in pdf.read_bytes()  # real fonts, no outlines: editable text
    for path, again in zip((png, pdf), save(entry.draw(), tmp_path, "again"), strict=True):
        assert path.read_bytes() == again.read_bytes()


def luminance(colour: str) -> float:
    """Relative luminance (WCAG 2), 0 black to 1 white."""
    linear = [
        c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4
        for c in mpl.colors.to_rgb(colour)
    ]
    return float(np.dot([0.2126, 0.7152, 0.0722], linear))


def test_looks_differ_without_colour() -> None:
    looks = (HAND_MADE_STYLE, *SERIES)
    assert len({str(look.line) for look in looks}) == len(looks)
    assert len({look.marker for look in looks}) == len(looks)
    # Contrast of 2 in luminance is seen side by side: of the paper's two algorithms.
    first, second = (luminance(look.colour) for look in SERIES[:2])
    assert (second + 0.05) / (first + 0.05) > 2.0


def test_faces_are_small_and_leave_no_cracks(data: ReportData) -> None:
    solids = cell_solids(data.geometry)
    for solid, cut in zip(solids, CutCell.of(data.geometry, solids).faces, strict=True):
        following = np.roll(cut.triangles, -1, axis=1)
        lengths = np.linalg.norm(following - cut.triangles, axis=2)
        assert solid.is_ground or lengths.max() <= MAX_EDGE
        # Every edge is once that of either neighbour, the other way round.
        edges = np.concatenate([cut.triangles, following], axis=2).reshape(-1, 6).round(9) + 0.0
        ways = {tuple(edge) for edge in edges.tolist()}
        assert ways == {(*edge[3:], *edge[:3]) for edge in ways}
        areas = [
            np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
            for a, b, c in (
                np.moveaxis(each, 1, 0) for each in (solid.vertices[solid.faces], cut.triangles)
            )
        ]
        assert areas[1] == pytest.approx(areas[0], rel=1e-9)


@pytest.mark.parametrize("view", [FRONT_VIEW, SIDE, oblique(0.3, 0.5), oblique(-2.0, -0.4)])
def test_views_are_rotations(view: View) -> None:
    axes = np.array([view.right, view.up, view.towards])
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)


def test_reach_holds_the_carry_and_ends_where_the_arm_does(data: ReportData) -> None:
    reach = data.reach
    assert reach is not None
    for pose in data.initial.timed.pose[::10]:
        cube = tuple(((pose[:3] - reach.lower) / reach.step).astype(int))
        assert reach.common[cube]
    for i, arm in enumerate(data.geometry.arms):
        shoulder = (arm.T_world_root @ arm.origins[0])[:3, 3]
        cubes = np.argwhere(reach.pads[i])
        centres = reach.lower + (cubes + 0.5) * reach.step
        pad = arm.T_joint_box @ data.workcell.contacts[i].T_box_pad
        stretched = np.linalg.norm(arm.origins[1:, :3, 3], axis=1).sum()
        longest = stretched + np.linalg.norm(pad[:3, 3]) + 2.0 * reach.step
        distances = np.linalg.norm(centres - shoulder, axis=1)
        assert distances.max() <= longest
        assert distances.max() >= 0.85 * longest


def test_animations_play_the_motion_in_real_time(
    data: ReportData, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Files of any format are written from the same pictures, of the middle of a carry."""
    whole = Film.of(data.initial)
    third = slice(len(whole.time) // 3, 2 * len(whole.time) // 3)
    film = Film("", whole.time[third], whole.pose[third], whole.q[third])
    pictures = list(frames(data.geometry, film))
    assert len(pictures) == round(film.duration * FRAMES_PER_SECOND) + 1
    assert {picture.shape for picture in pictures} == {(400, 640, 3)}
    steps = [np.abs(a.astype(int) - b).mean() for a, b in pairwise(pictures)]
    assert max(steps) > 0.1
    monkeypatch.setattr(looks, "frames", lambda geometry, film: iter(pictures))
    gif, mp4 = tmp_path / "made" / "carry.gif", tmp_path / "carry.mp4"
    write_animation(data.geometry, film, gif)
    image = Image.open(gif)
    shown = [(f.info["duration"], np.asarray(f.convert("RGB"), int)) for f in Iterator(image)]
    # GIF counts hundredths of a second, so a frame of 66.7 ms is written as 60 or 70.
    duration = sum(duration for duration, _ in shown[:-1]) / 1000
    assert duration == pytest.approx(film.duration, rel=0.12)
    assert gif.stat().st_size < 2_000_000
    assert (np.abs(shown[len(shown) // 2][1] - shown[0][1]).max(axis=2) > 40).mean() > 0.01
    write_animation(data.geometry, film, mp4)
    count, seconds = imageio_ffmpeg.count_frames_and_secs(str(mp4))
    assert count == len(pictures)
    assert seconds == pytest.approx(film.duration, abs=2.0 / FRAMES_PER_SECOND)
    with refused(ReportError, "animation-format", "carry.avi"):
        write_animation(data.geometry, film, tmp_path / "carry.avi")


def test_the_program_animates_a_results_folder(
    study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(looks, "FRAMES_PER_SECOND", 2)
    path = tmp_path / "chosen.gif"
    assert main([str(study), "--animation", str(path)]) == 0
    assert Image.open(path).n_frames > 4  # type: ignore[attr-defined]


def test_a_browser_is_given_the_report(own_study: Path) -> None:
    """Or, where there is none, a page that plays a trajectory."""
    (own_study / PAGE).write_text("<p>the report</p>")
    report = page_of(own_study)
    (own_study / PAGE).unlink()
    for page, words in ((report, "<p>the report</p>"), (page_of(own_study), "CellScene")):
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
