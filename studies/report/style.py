"""One style for every figure: print sizes, colours that survive grey and colour blindness."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hybrid_opt.store.files import write_atomically

MM = 1.0 / 25.4
FULL_WIDTH = 180.0 * MM
"""Text width of a journal page [inch]."""

PNG_DPI = 200

RC: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 8.0,
    "axes.titlesize": 8.0,
    "axes.labelsize": 8.0,
    "legend.fontsize": 7.0,
    "xtick.labelsize": 7.0,
    "ytick.labelsize": 7.0,
    "axes.linewidth": 0.6,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.linewidth": 0.4,
    "grid.color": "#d9d9d9",
    "lines.linewidth": 1.3,
    "lines.markersize": 4.0,
    "legend.frameon": True,
    "legend.framealpha": 0.9,
    "legend.edgecolor": "#cccccc",
    "legend.fancybox": False,
    "patch.linewidth": 0.6,
    "text.parse_math": False,
    "pdf.fonttype": 42,
    # Layout is worked out at the resolution that it is drawn at, and only where it is asked for.
    "figure.dpi": PNG_DPI,
    "figure.autolayout": False,
    "figure.constrained_layout.use": False,
}


@dataclass(frozen=True)
class LineStyle:
    """How one trajectory or algorithm is drawn everywhere."""

    colour: str
    line: Any
    marker: str
    hatch: str

    @property
    def drawn(self) -> dict[str, Any]:
        """Of a line, for Matplotlib."""
        return {"color": self.colour, "linestyle": self.line}

    def marks(self, size: float, edge: str = "black", opened: bool = False) -> dict[str, Any]:
        """Of marks without a line, open ones in the colour alone, for Matplotlib."""
        return {
            "marker": self.marker,
            "linestyle": "none",
            "color": self.colour,
            "markersize": size,
            "markerfacecolor": "none" if opened else self.colour,
            "markeredgecolor": self.colour if opened else edge,
            "markeredgewidth": 0.6,
        }


HAND_MADE = LineStyle("#555555", ":", "s", "....")
"""Style of the hand-made trajectory."""

SERIES = (
    LineStyle("#0072B2", "-", "o", ""),
    LineStyle("#E69F00", "--", "^", "////"),
    LineStyle("#009E73", "-.", "D", "xxxx"),
    LineStyle("#CC79A7", (0, (5, 1, 1, 1, 1, 1)), "v", "\\\\\\\\"),
    LineStyle("#D55E00", (0, (1, 1)), "P", "++++"),
)
"""Styles of the algorithms in order (Okabe and Ito's colours, distinct for the colour-blind)."""

ARMS = ("#3b6ea8", "#a8733b")
"""Colours of the two robots in pictures of the cell."""

PAYLOAD = "#c9a227"
OBSTACLE = "#9aa3ab"
GROUND = "#e8e8e4"
MARKED = "#b00020"


def series(index: int) -> LineStyle:
    """Style of the algorithm at a position."""
    return SERIES[index % len(SERIES)]


def shortened(name: str, length: int = 24) -> str:
    """A name of the workcell that leaves room for the rest of a label."""
    return name if len(name) <= length else f"{name[: length - 1]}\N{HORIZONTAL ELLIPSIS}"


def spread(count: int, most: int) -> list[int]:
    """At most `most` of `count` rows, both ends among them."""
    rows = np.linspace(0, count - 1, min(count, most)).round().astype(int)
    return [int(row) for row in np.unique(rows)]


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of this size [inch]; draw it inside `in_style`."""
    return Figure(figsize=(width, height), layout="constrained")


@contextmanager
def in_style() -> Iterator[None]:
    """Whatever is drawn in the `with` block has the common style."""
    with mpl.rc_context(RC):
        yield


def settled(figure: Figure) -> Figure:
    """The figure with its layout worked out for good: all files of it show the same."""
    with in_style():
        engine = figure.get_layout_engine()
        assert engine is not None
        # Panels that keep their shape shift in the room of the first pass.
        for _ in range(2 if any(_keeps_shape(axes) for axes in figure.axes) else 1):
            engine.execute(figure)
        # Otherwise every file would be drawn twice, once for the layout alone.
        figure.set_layout_engine(None)
    return figure


def _keeps_shape(axes: Axes) -> bool:
    return axes.get_aspect() != "auto"


def legend_below(figure: Figure, axes: Axes, columns: int = 0) -> None:
    """The legend of a panel below the whole figure, in one row unless columns are given."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=columns or len(handles))


def limit_line(axes: Axes, level: float, label: str | None = None, across: bool = True) -> None:
    """A limit as a dashed line, across or up the panel."""
    draw = axes.axhline if across else axes.axvline
    draw(level, color="black", linestyle="--", linewidth=0.9, label=label)


def rest_line(axes: Axes, level: float, label: str, across: bool = True) -> None:
    """What holds the payload still as a line, across or up the panel."""
    draw = axes.axhline if across else axes.axvline
    draw(level, color=MARKED, linewidth=0.8, linestyle=(0, (2, 2)), label=label)


def panel_label(axes: Axes, letter: str, text: str) -> None:
    """'(a) text' above a panel's left corner."""
    axes.set_title(f"({letter}) {text}", loc="left")


def files_of(figure: Figure, pdf: bool = True) -> dict[str, bytes]:
    """A settled figure as files, by suffix: PNG, and PDF where it is wanted."""
    wanted = {"png": {"Software": None}} | ({"pdf": {"CreationDate": None}} if pdf else {})
    files = {}
    with in_style():
        for suffix, metadata in wanted.items():
            file = io.BytesIO()
            figure.savefig(file, format=suffix, dpi=PNG_DPI, metadata=metadata)
            files[suffix] = file.getvalue()
    return files


def save(figure: Figure, folder: Path, name: str) -> tuple[Path, ...]:
    """Write a settled figure as PNG and PDF; returns the files."""
    paths = []
    for suffix, content in files_of(figure).items():
        paths.append(folder / f"{name}.{suffix}")
        write_atomically(paths[-1], content)
    return tuple(paths)
