"""Views of a study's trajectories: an animation file (GIF through Pillow, MP4 through imageio's
ffmpeg), or a browser page served on this machine alone."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from hybrid_opt.display.scene import CarryView
from hybrid_opt.display.solids import cell_solids, motion_points
from studies.program import ReportError
from studies.report import PAGE
from studies.report.data import gather_carries
from studies.report.drawing import (
    ISOMETRIC,
    CutCell,
    DrawnCarry,
    draw_cell,
    draw_path,
    frame_axes,
    in_style,
)
from symbolic.array import Array, interpolated
from symbolic.geometry.pairs import CellGeometry

FRAMES_PER_SECOND = 15
FRAME_SIZE = (6.4, 4.0)
"""Size of a frame [inch]."""

DPI = 100
HOLD_SECONDS = 0.7
"""Time that a GIF rests at its last frame before it starts again [s]."""

GIF_COLOURS = 128
"""Number of colours in a GIF's palette."""


@dataclass(frozen=True, eq=False)
class Film:
    """A motion of box and arms, to be animated.

    Attributes:
        label: text above the picture.
        time: (n,) times of the samples [s].
        pose: (n, 6) pose of the box [m, rad].
        q: (n, joints) joint positions of both arms side by side [rad].
    """

    label: str
    time: Array
    pose: Array
    q: Array

    @classmethod
    def of(cls, carry: DrawnCarry) -> Film:
        """Return the film of a carry with the timing `carry.timed`."""
        return cls(carry.label, carry.timed.time, carry.timed.pose, carry.timed.q)

    @property
    def duration(self) -> float:
        """Time from the first to the last sample [s]."""
        return float(self.time[-1] - self.time[0])


def follow_looks(root: Path, options: argparse.Namespace) -> None:
    """Show a study as the command line requests: write an animation, and serve a page until Ctrl-C.

    The animation shows the first selected trajectory, or else the hand-made one. The page is the
    report, or without a report a page that plays the last selected trajectory.

    Args:
        root: the results folder.
        options: parsed options of `studies.options.add_looks`.

    Raises:
        DualArmError: the results are incomplete, the animation's suffix is unknown, a library is
            missing, or no port is free.
    """
    if options.animation:
        geometry, carries = gather_carries(root)
        write_animation(geometry, Film.of(carries[min(1, len(carries) - 1)]), options.animation)
    if options.view:
        server = page_server(page_of(root), options.port)
        told = f"Open http://{HOST}:{server.server_port} in a browser; Ctrl-C ends it."
        print(told, file=sys.stderr)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            server.server_close()


def write_animation(geometry: CellGeometry, film: Film, path: Path) -> None:
    """Write an animation in real time to a file.

    Args:
        geometry: geometry of the cell.
        film: the motion.
        path: path of the file; its suffix, .gif or .mp4, decides the format.

    Raises:
        ReportError: the suffix is neither, or the MP4 writer is not installed.
    """
    suffix = path.suffix.lower()
    if suffix not in (".gif", ".mp4"):
        raise ReportError(
            f"animation {path.name!r}: the name must end in .gif or .mp4", code="animation-format"
        )
    writer = _write_gif if suffix == ".gif" else _write_mp4
    path.parent.mkdir(parents=True, exist_ok=True)
    writer(frames(geometry, film), path)


def frames(geometry: CellGeometry, film: Film) -> Iterator[NDArray[np.uint8]]:
    """Yield the pictures (height, width, 3) of an animation, evenly spaced in time.

    Args:
        geometry: geometry of the cell.
        film: the motion to animate.
    """
    cell = CutCell.of(geometry, cell_solids(geometry))
    points = motion_points(geometry, film.pose, film.q)
    count = max(2, round(film.duration * FRAMES_PER_SECOND) + 1)
    moments = np.linspace(film.time[0], film.time[-1], count)
    pose, q = (interpolated(moments, film.time, each) for each in (film.pose, film.q))
    for k, moment in enumerate(moments):
        with in_style():
            figure = Figure(figsize=FRAME_SIZE, dpi=DPI)
            axes = figure.add_axes((0.0, 0.0, 1.0, 0.93))
            draw_cell(axes, cell, ISOMETRIC, pose[k], q[k])
            draw_path(axes, ISOMETRIC, pose[: k + 1, :3], color="#b00020", linewidth=1.2)
            frame_axes(axes, ISOMETRIC, points)
            text = f"{film.label}    t = {moment - film.time[0]:5.2f} s"
            figure.text(0.02, 0.95, text, fontsize=10)
            yield _pixels(figure)


def _pixels(figure: Figure) -> NDArray[np.uint8]:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # type: ignore[no-untyped-call]
    pixels = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
    return np.ascontiguousarray(pixels[:, :, :3])


def _write_gif(pictures: Iterator[NDArray[np.uint8]], path: Path) -> None:
    images = [Image.fromarray(pixels) for pixels in pictures]
    # One palette for all frames, so that colours do not flicker.
    palette = images[len(images) // 2].quantize(GIF_COLOURS, Image.Quantize.MEDIANCUT)
    coded = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    step = round(1000 / FRAMES_PER_SECOND)
    durations = [step] * (len(coded) - 1) + [step + round(1000 * HOLD_SECONDS)]
    coded[0].save(
        path, save_all=True, append_images=coded[1:], duration=durations, loop=0, optimize=False
    )


def _write_mp4(pictures: Iterator[NDArray[np.uint8]], path: Path) -> None:
    try:
        import imageio_ffmpeg  # type: ignore[import-untyped]
    except ModuleNotFoundError as error:
        raise ReportError(
            'MP4 needs imageio-ffmpeg: pip install "dual-arm-carry[video]", or write a .gif'
        ) from error
    first = next(pictures)
    height, width = first.shape[:2]
    writer: Any = imageio_ffmpeg.write_frames(
        str(path), (width, height), fps=FRAMES_PER_SECOND, macro_block_size=2
    )
    writer.send(None)
    try:
        writer.send(first)
        for pixels in pictures:
            writer.send(pixels)
    finally:
        writer.close()


HOST = "127.0.0.1"


def page_of(root: Path) -> bytes:
    """Return the HTML page of the results folder `root`, encoded: the report, or a page that plays
    the last selected trajectory if there is no report.

    Raises:
        DualArmError: the results are incomplete.
    """
    if (root / PAGE).exists():
        return (root / PAGE).read_bytes()
    _, carries = gather_carries(root)
    return CarryView(carries[-1].timed).page().encode()


def page_server(page: bytes, port: int) -> ThreadingHTTPServer:
    """Return a server that answers browsers of this machine with one page.

    Args:
        page: the page.
        port: port of the server; if it is in use, a free one is taken.

    Raises:
        ReportError: no port is free.
    """

    class Handler(BaseHTTPRequestHandler):
        """Answers every request with the page."""

        def do_GET(self) -> None:
            """Answer a GET request with the page."""
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(page)))
            self.end_headers()
            self.wfile.write(page)

        def log_message(self, *_: object) -> None:
            """Write no log of requests."""

    for number in (port, 0):
        try:
            return ThreadingHTTPServer((HOST, number), Handler)
        except OSError as error:
            problem = error.strerror
    raise ReportError(f"nothing can be served at {HOST}: {problem}; open {PAGE} in a browser")
