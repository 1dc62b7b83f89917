"""One style for every figure (print sizes, colours that survive grey and colour blindness), and
orthographic pictures of a cell on Matplotlib axes, faces sorted from back to front."""

from __future__ import annotations

import io
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hybrid_opt.carry import Carry
from hybrid_opt.display.objects import ARM_COLOURS
from hybrid_opt.display.solids import Solid, frame_placements
from hybrid_opt.store.files import write_atomically
from symbolic.array import Array
from symbolic.geometry.bodies import Frame
from symbolic.geometry.pairs import CellGeometry

if TYPE_CHECKING:
    from hybrid_opt.timing.robustness import PayloadSensitivity

FULL_WIDTH = 180.0 / 25.4
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
    # Layout is computed at the drawing resolution, and only on request.
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
        """Keywords of a line, for Matplotlib."""
        return {"color": self.colour, "linestyle": self.line}

    def marks(self, size: float, edge: str = "black", opened: bool = False) -> dict[str, Any]:
        """Return Matplotlib's keywords of marks without a line; open ones have a coloured edge
        alone."""
        return {
            "marker": self.marker,
            "linestyle": "none",
            "color": self.colour,
            "markersize": size,
            "markerfacecolor": "none" if opened else self.colour,
            "markeredgecolor": self.colour if opened else edge,
            "markeredgewidth": 0.6,
        }


MARKED = "#b00020"
"""Colour of what stands out."""

HAND_MADE_STYLE = LineStyle("#555555", ":", "s", "....")
"""Style of the hand-made trajectory."""

RECOMMENDED_STYLE = LineStyle(MARKED, "-", "*", "")
"""Style of the recommended carry."""

SERIES = (
    LineStyle("#0072B2", "-", "o", ""),
    LineStyle("#E69F00", "--", "^", "////"),
    LineStyle("#009E73", "-.", "D", "xxxx"),
    LineStyle("#CC79A7", (0, (5, 1, 1, 1, 1, 1)), "v", "\\\\\\\\"),
    LineStyle("#D55E00", (0, (1, 1)), "P", "++++"),
)
"""Styles of the algorithms in order (Okabe and Ito's colours, distinct for the colour-blind)."""

PAYLOAD_COLOUR = "#c9a227"
OBSTACLE = "#9aa3ab"
GROUND_COLOUR = "#e8e8e4"


def series(index: int) -> LineStyle:
    """Return the style of the algorithm at a position."""
    return SERIES[index % len(SERIES)]


def shortened(name: str, length: int = 24) -> str:
    """Shorten a name of the workcell to fit a label."""
    return name if len(name) <= length else f"{name[: length - 1]}\N{HORIZONTAL ELLIPSIS}"


def new_figure(share: float) -> Figure:
    """Create an empty figure as wide as a journal's page, its height a share of that; draw it
    inside `in_style`."""
    return Figure(figsize=(FULL_WIDTH, share * FULL_WIDTH), layout="constrained")


@contextmanager
def in_style() -> Iterator[None]:
    """Draw with the common style in the `with` block."""
    with mpl.rc_context(RC):
        yield


def settled(figure: Figure) -> Figure:
    """Fix the figure's layout, so that all its files show the same."""
    with in_style():
        engine = figure.get_layout_engine()
        assert engine is not None
        # Panels that keep their shape shift in the room of the first pass.
        for _ in range(2 if any(axes.get_aspect() != "auto" for axes in figure.axes) else 1):
            engine.execute(figure)
        # Otherwise every file would be drawn twice, once for the layout alone.
        figure.set_layout_engine(None)
    return figure


def legend_below(figure: Figure, axes: Axes, columns: int = 0) -> None:
    """Draw the legend of a panel below the whole figure, in one row unless columns are given."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=columns or len(handles))


def limit_line(axes: Axes, level: float, label: str, across: bool = True) -> None:
    """Draw a limit as a dashed line, across or up the panel."""
    draw = axes.axhline if across else axes.axvline
    draw(level, color="black", linestyle="--", linewidth=0.9, label=label)


def rest_line(axes: Axes, level: float, label: str) -> None:
    """Draw the static forces as a line across the panel."""
    axes.axhline(level, color="black", linewidth=0.8, linestyle=(0, (7, 2, 1, 2)), label=label)


def panel_label(axes: Axes, letter: str, text: str, bare: bool = False) -> None:
    """Write '(a) text' above a panel's left corner.

    Args:
        bare: whether nothing else is above the panel: to look for it takes half of a layout.
    """
    axes.set_title(f"({letter}) {text}", loc="left", y=1.0 if bare else None)


def files_of(figure: Figure, pdf: bool = True) -> dict[str, bytes]:
    """Return a settled figure as files, by suffix: PNG, and PDF on request."""
    wanted = {"png": {"Software": None}} | ({"pdf": {"CreationDate": None}} if pdf else {})
    files = {}
    with in_style():
        for suffix, metadata in wanted.items():
            file = io.BytesIO()
            figure.savefig(file, format=suffix, dpi=PNG_DPI, metadata=metadata)
            files[suffix] = file.getvalue()
    return files


def save(figure: Figure, folder: Path, name: str, pdf: bool = True) -> tuple[Path, ...]:
    """Write a settled figure as PNG, and as PDF where it is wanted; returns the files."""
    paths = []
    for suffix, content in files_of(figure, pdf).items():
        paths.append(folder / f"{name}.{suffix}")
        write_atomically(paths[-1], content)
    return tuple(paths)


MAX_EDGE = 0.12
"""Faces are cut to this size, so that sorting them by their middle is right [m]."""

LIGHT = np.array([-0.45, 0.35, 0.82]) / np.linalg.norm([-0.45, 0.35, 0.82])


@dataclass(frozen=True)
class DrawnCarry:
    """One judged trajectory under the search's timing.

    Attributes:
        label: in legends.
        timed: the trajectory.
        look: of its lines.
        source: whose it is, with its replica where there are several.
    """

    label: str
    timed: Carry
    look: LineStyle = HAND_MADE_STYLE
    source: str = ""

    @property
    def x(self) -> Array:
        """(n_var,) decision vector."""
        return self.timed.x

    @cached_property
    def sensitivity(self) -> PayloadSensitivity:
        """Its forces against the payload's mass."""
        # Not imported at the top: pictures of a cell need no timing.
        from hybrid_opt.timing.robustness import payload_sensitivity

        return payload_sensitivity(self.timed)


@dataclass(frozen=True)
class View:
    """A camera at infinity.

    Attributes:
        right, up: (3,) unit vectors of the picture in the world.
        x_label, y_label: of the axes, '' where the picture's axes are not the world's.
        mirrored: whether the horizontal axis runs to the left in the world's coordinate.
    """

    right: Array
    up: Array
    x_label: str = ""
    y_label: str = ""
    mirrored: bool = False

    @property
    def towards(self) -> Array:
        """(3,) unit vector from the scene to the eye."""
        return np.cross(self.right, self.up)

    def flat(self, points: Array) -> Array:
        """Return (..., 2) picture coordinates of world points (..., 3)."""
        return np.stack([points @ self.right, points @ self.up], axis=-1)


_X, _Y, _Z = np.eye(3)

FRONT_VIEW = View(-_Y, _Z, "y [m]", "z [m]", mirrored=True)
"""View from -x, as one stands before the rack."""

SIDE = View(_X, _Z, "x [m]", "z [m]")
"""View from -y."""


def oblique(azimuth: float, elevation: float) -> View:
    """Return a view from a direction: azimuth about z from +x, elevation above the ground [rad]."""
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    towards = np.array(
        [
            np.cos(azimuth) * np.cos(elevation),
            np.sin(azimuth) * np.cos(elevation),
            np.sin(elevation),
        ]
    )
    return View(right, np.cross(towards, right))


ISOMETRIC = oblique(np.deg2rad(-152.0), np.deg2rad(26.0))
"""View from -x, a little to the right and above."""


@dataclass(frozen=True)
class Faces:
    """Triangles in the frame of a solid, cut to size, with what colours them."""

    frame: Frame
    triangles: Array
    normals: Array
    colour: tuple[float, float, float]
    is_ground: bool


@dataclass(frozen=True)
class CutCell:
    """A cell, and the faces of it that are drawn."""

    geometry: CellGeometry
    faces: tuple[Faces, ...]

    @classmethod
    def of(
        cls, geometry: CellGeometry, solids: Sequence[Solid], marked: Collection[str] = ()
    ) -> CutCell:
        """Cut some of the cell's solids to triangles of at most `MAX_EDGE`, coloured by group,
        those of the marked names in red."""
        corners = [solid.vertices[solid.faces] for solid in solids]
        numbers = np.repeat(np.arange(len(solids)), [len(each) for each in corners])
        limits = np.array([np.inf if solid.is_ground else MAX_EDGE for solid in solids])
        small, of = _cut(np.concatenate(corners), numbers, limits)
        normals = np.cross(small[:, 1] - small[:, 0], small[:, 2] - small[:, 0])
        length = np.linalg.norm(normals, axis=1)
        keep = length > 0.0
        small, of, normals = small[keep], of[keep], normals[keep] / length[keep, None]
        faces = []
        for k, solid in enumerate(solids):
            own = of == k
            colour = to_rgb(MARKED if solid.name in marked else _colour(solid))
            faces.append(Faces(solid.frame, small[own], normals[own], colour, solid.is_ground))
        return cls(geometry, tuple(faces))


def _cut(corners: Array, of: NDArray[np.intp], limits: Array) -> tuple[Array, NDArray[np.intp]]:
    """Halve triangles (n, 3, 3) across their longest edges until none exceeds the limit of its
    solid; return them and the indices of their solids. Neighbours share the places of their cuts.
    """
    while True:
        lengths = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
        long = lengths.max(axis=1) > limits[of]
        if not long.any():
            return corners, of
        order = (lengths[long].argmax(axis=1)[:, None] + np.arange(3)) % 3
        a, b, c = np.moveaxis(np.take_along_axis(corners[long], order[:, :, None], 1), 1, 0)
        middle = (a + b) / 2.0
        halves = (np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1))
        corners = np.concatenate([corners[~long], *halves])
        of = np.concatenate([of[~long], of[long], of[long]])


def _colour(solid: Solid) -> str:
    if solid.is_ground:
        return GROUND_COLOUR
    colours = {"robot 1": ARM_COLOURS[0], "robot 2": ARM_COLOURS[1], "payload": PAYLOAD_COLOUR}
    return colours.get(solid.group, OBSTACLE)


def draw_cell(
    axes: Axes,
    cell: CutCell,
    view: View,
    pose: Array,
    q: Array,
    hidden: tuple[str, ...] = (),
) -> None:
    """Draw the cell at one sample: pose (6,), q (12,). hidden: kinds of frames left out."""
    placed = frame_placements(cell.geometry, pose[None], q[None])
    corners, colours = [], []
    ground_corners = []
    for part in cell.faces:
        if part.frame.kind in hidden:
            continue
        T = placed[part.frame][0]
        normals = part.normals @ T[:3, :3].T
        front = normals @ view.towards > 1e-9
        points = part.triangles[front] @ T[:3, :3].T + T[:3, 3]
        if part.is_ground:
            ground_corners.append(view.flat(points))
            continue
        shade = 0.62 + 0.38 * np.clip(normals[front] @ LIGHT, 0.0, 1.0)
        corners.append(points)
        colours.append(np.asarray(part.colour) * shade[:, None])
    if ground_corners:
        flat = np.concatenate(ground_corners)
        axes.add_collection(
            _polygons(flat, facecolors=GROUND_COLOUR, edgecolors=GROUND_COLOUR, zorder=1.0),
            autolim=False,
        )
    points, colour = np.concatenate(corners), np.concatenate(colours)
    order = np.argsort(points.mean(axis=1) @ view.towards)
    flat = view.flat(points[order])
    axes.add_collection(
        _polygons(
            flat,
            facecolors=colour[order],
            edgecolors=colour[order],
            linewidths=0.5,
            zorder=2.0,
            rasterized=True,
        ),
        autolim=False,
    )


def _polygons(flat: Array, **style: Any) -> PolyCollection:
    """Return polygons (n, k, 2) unchanged: Matplotlib takes one array faster than the sequence of
    its stubs."""
    return PolyCollection(flat, **style)  # type: ignore[arg-type]


def draw_path(axes: Axes, view: View, points: Array, **style: object) -> None:
    """Draw a line through world points (n, 3), above the bodies."""
    flat = view.flat(points)
    axes.plot(flat[:, 0], flat[:, 1], zorder=4.0, **style)  # type: ignore[arg-type]


def draw_box_edges(axes: Axes, view: View, lower: Array, upper: Array, **style: object) -> None:
    """Draw the twelve edges of a box along the world axes."""
    flat = view.flat(box_corners(lower, upper))
    # Corners whose numbers differ in one bit are neighbours.
    edges = [flat[[i, i | bit]] for i in range(8) for bit in (1, 2, 4) if not i & bit]
    axes.add_collection(LineCollection(edges, zorder=5.0, **style), autolim=False)


MARGIN = 0.06
"""Of a picture around what it shows [m]."""


def frame_axes(axes: Axes, view: View, points: Array, margin: float = MARGIN) -> None:
    """Fit the limits to world points (n, 3) at equal scales; world axes get labels."""
    flat = view.flat(points)
    lower, upper = flat.min(axis=0) - margin, flat.max(axis=0) + margin
    axes.set_xlim(lower[0], upper[0])
    axes.set_ylim(lower[1], upper[1])
    axes.set_aspect("equal")
    axes.grid(visible=False)
    if view.mirrored:
        axes.xaxis.set_major_formatter(_negated)
    if view.x_label:
        axes.set_xlabel(view.x_label)
        axes.set_ylabel(view.y_label)
    else:
        axes.set_axis_off()


def _negated(value: float, _: object) -> str:
    return f"{0.0 - value:g}".replace("-", "\N{MINUS SIGN}")


def aspect(view: View, points: Array) -> float:
    """Compute width over height of world points (n, 3) in a view."""
    width, height = np.ptp(view.flat(points), axis=0)
    return float(width / height)


def box_corners(lower: Array, upper: Array) -> Array:
    """Return the corners (8, 3) of a box along the world axes."""
    return np.array(list(product(*zip(lower, upper, strict=True))))
