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
"""Width of the text on a journal's page [inch]."""

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
    """Style with which one trajectory or algorithm is drawn in all pictures.

    Attributes:
        colour: colour of lines and markers, as '#rrggbb'.
        line: Matplotlib's line style.
        marker: Matplotlib's marker.
        hatch: Matplotlib's hatch.
    """

    colour: str
    line: Any
    marker: str
    hatch: str

    @property
    def drawn(self) -> dict[str, Any]:
        """Matplotlib's keyword arguments for a line in this style."""
        return {"color": self.colour, "linestyle": self.line}

    def marks(self, size: float, edge: str = "black", opened: bool = False) -> dict[str, Any]:
        """Return Matplotlib's keyword arguments for markers without a line.

        Args:
            size: size of the markers [points].
            edge: colour of the markers' edges.
            opened: True for markers without filling, with edges in the colour of the style.
        """
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
"""Colour of what a picture points at: the recommended carry and colliding bodies."""

HAND_MADE_STYLE = LineStyle("#555555", ":", "s", "....")
"""Line style of the hand-made trajectory."""

RECOMMENDED_STYLE = LineStyle(MARKED, "-", "*", "")
"""Line style of the recommended carry."""

SERIES = (
    LineStyle("#0072B2", "-", "o", ""),
    LineStyle("#E69F00", "--", "^", "////"),
    LineStyle("#009E73", "-.", "D", "xxxx"),
    LineStyle("#CC79A7", (0, (5, 1, 1, 1, 1, 1)), "v", "\\\\\\\\"),
    LineStyle("#D55E00", (0, (1, 1)), "P", "++++"),
)
"""Line styles of the algorithms in the order of a campaign, in colours by Okabe and Ito that
colour-blind readers can tell apart."""

PAYLOAD_COLOUR = "#c9a227"
OBSTACLE = "#9aa3ab"
GROUND_COLOUR = "#e8e8e4"


def series(index: int) -> LineStyle:
    """Return the line style of the algorithm with this index in a campaign."""
    return SERIES[index % len(SERIES)]


def shortened(name: str, length: int = 24) -> str:
    """Cut a name of the workcell file to `length` characters, the last one an ellipsis."""
    return name if len(name) <= length else f"{name[: length - 1]}\N{HORIZONTAL ELLIPSIS}"


def new_figure(share: float) -> Figure:
    """Create an empty figure as wide as a journal's page, with a height of `share` times the width.
    Call this function, and draw the figure, inside `in_style`.
    """
    return Figure(figsize=(FULL_WIDTH, share * FULL_WIDTH), layout="constrained")


@contextmanager
def in_style() -> Iterator[None]:
    """Apply the common style of all figures inside the `with` block."""
    with mpl.rc_context(RC):
        yield


def settled(figure: Figure) -> Figure:
    """Compute and fix the layout of a figure, so that all its files look the same. Return the
    figure."""
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
    """Draw the legend of one panel below the whole figure.

    Args:
        axes: the panel.
        columns: number of columns; 0 for one row.
    """
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=columns or len(handles))


def limit_line(axes: Axes, level: float, label: str, across: bool = True) -> None:
    """Draw a limit as a dashed line through a panel.

    Args:
        axes: the panel.
        level: value of the limit on the axis that the line crosses.
        label: name in the legend.
        across: True for a horizontal line at y = `level`, False for a vertical one at x = `level`.
    """
    draw = axes.axhline if across else axes.axvline
    draw(level, color="black", linestyle="--", linewidth=0.9, label=label)


def rest_line(axes: Axes, level: float, label: str) -> None:
    """Draw the normal force that holds the payload at rest as a horizontal line.

    Args:
        axes: the panel.
        level: the force, in the unit of the vertical axis.
        label: name in the legend.
    """
    axes.axhline(level, color="black", linewidth=0.8, linestyle=(0, (7, 2, 1, 2)), label=label)


def panel_label(axes: Axes, letter: str, text: str, bare: bool = False) -> None:
    """Write '(letter) text' above the left corner of a panel.

    Args:
        axes: the panel.
        letter: the letter.
        text: the text.
        bare: True if nothing else stands above the panel. The label then has a fixed height, and
            Matplotlib need not search for free room, which takes half the time of a layout.
    """
    axes.set_title(f"({letter}) {text}", loc="left", y=1.0 if bare else None)


def files_of(figure: Figure, pdf: bool = True) -> dict[str, bytes]:
    """Return the contents of the files of a figure with fixed layout, by suffix: 'png', and 'pdf'
    if `pdf`."""
    wanted = {"png": {"Software": None}} | ({"pdf": {"CreationDate": None}} if pdf else {})
    files = {}
    with in_style():
        for suffix, metadata in wanted.items():
            file = io.BytesIO()
            figure.savefig(file, format=suffix, dpi=PNG_DPI, metadata=metadata)
            files[suffix] = file.getvalue()
    return files


def save(figure: Figure, folder: Path, name: str, pdf: bool = True) -> tuple[Path, ...]:
    """Write a figure with fixed layout to a folder as PNG, and as PDF if `pdf`. Return the paths.

    Args:
        figure: the figure.
        folder: the folder.
        name: name of the files, without suffix.
        pdf: True to write a PDF too.
    """
    paths = []
    for suffix, content in files_of(figure, pdf).items():
        paths.append(folder / f"{name}.{suffix}")
        write_atomically(paths[-1], content)
    return tuple(paths)


MAX_EDGE = 0.12
"""Longest edge of drawn triangles [m]; larger ones are cut, so that sorting triangles by their
middle draws them in the right order."""

LIGHT = np.array([-0.45, 0.35, 0.82]) / np.linalg.norm([-0.45, 0.35, 0.82])


@dataclass(frozen=True)
class DrawnCarry:
    """An evaluated carry, and how pictures draw it.

    Attributes:
        label: name in legends.
        timed: the carry with the timing that pictures show.
        look: style of its lines.
        source: search that found the carry, with its replica if there are several.
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
        """Contact forces of the carry as a function of the payload mass, with path and timing
        unchanged.
        """
        # Not imported at the top: pictures of a cell need no timing.
        from hybrid_opt.timing.robustness import payload_sensitivity

        return payload_sensitivity(self.timed)


@dataclass(frozen=True)
class View:
    """A direction of parallel projection from the world to a picture.

    Attributes:
        right, up: (3,) unit vectors in the world frame that point to the right and up in the
            picture.
        x_label, y_label: titles of the picture's axes; '' if they are no axes of the world.
        mirrored: True if the world coordinate on the horizontal axis increases to the left.
    """

    right: Array
    up: Array
    x_label: str = ""
    y_label: str = ""
    mirrored: bool = False

    @property
    def towards(self) -> Array:
        """(3,) unit vector in the world frame from the scene to the viewer."""
        return np.cross(self.right, self.up)

    def flat(self, points: Array) -> Array:
        """Project points (..., 3) of the world to picture coordinates (..., 2) [m]."""
        return np.stack([points @ self.right, points @ self.up], axis=-1)


_X, _Y, _Z = np.eye(3)

FRONT_VIEW = View(-_Y, _Z, "y [m]", "z [m]", mirrored=True)
"""View along the x axis from negative x, as a person stands before the rack."""

SIDE = View(_X, _Z, "x [m]", "z [m]")
"""View along the y axis from negative y."""


def oblique(azimuth: float, elevation: float) -> View:
    """Return the view from a direction in the world.

    Args:
        azimuth: angle about z from +x to the horizontal direction towards the viewer [rad].
        elevation: angle of the direction towards the viewer above the horizontal [rad].
    """
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
"""View from negative x, a little from the right and from above."""


@dataclass(frozen=True)
class Faces:
    """Triangles of one solid. Except those of ground, they are small enough to be sorted by depth.

    Attributes:
        frame: frame of the solid.
        triangles: (k, 3, 3) corners in this frame [m]; edges are at most `MAX_EDGE` long unless the
            solid is ground.
        normals: (k, 3) unit normals in this frame.
        colour: red, green and blue in [0, 1].
        is_ground: True for ground.
    """

    frame: Frame
    triangles: Array
    normals: Array
    colour: tuple[float, float, float]
    is_ground: bool


@dataclass(frozen=True)
class CutCell:
    """A cell whose solids are cut into small triangles, so that they can be sorted by depth.

    Attributes:
        geometry: geometry of the cell.
        faces: triangles of each drawn solid.
    """

    geometry: CellGeometry
    faces: tuple[Faces, ...]

    @classmethod
    def of(
        cls, geometry: CellGeometry, solids: Sequence[Solid], marked: Collection[str] = ()
    ) -> CutCell:
        """Cut solids of a cell into small triangles, which can be drawn in the order of their
        depth. The colour of a solid depends on its group.

        Args:
            geometry: geometry of the cell.
            solids: the solids to draw.
            marked: names of solids that are drawn in red.
        """
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
    """Halve triangles across their longest edges until no edge is longer than the limit of its
    solid. Triangles with a common edge are cut at the same place.

    Args:
        corners: (n, 3, 3) corners of the triangles [m].
        of: (n,) index of each triangle's solid.
        limits: longest allowed edge for each solid [m].

    Returns:
        Corners (k, 3, 3) of the small triangles, and (k,) index of each one's solid.
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
    """Draw the cell at one sample of a motion.

    Args:
        axes: axes to draw into.
        cell: the cell, cut into triangles.
        view: direction from which the cell is seen.
        pose: (6,) pose of the box [m, rad].
        q: (joints,) joint positions of both arms, the first arm first [rad or m].
        hidden: values of `frame.kind`, such as 'world', whose solids are left out.
    """
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
    """Return n polygons with k corners each as a Matplotlib collection.

    One array is faster than a list of polygons, but unknown to Matplotlib's type stubs.

    Args:
        flat: (n, k, 2) corners in picture coordinates [m].
        style: keyword arguments of Matplotlib for the polygons.
    """
    return PolyCollection(flat, **style)  # type: ignore[arg-type]


def draw_path(axes: Axes, view: View, points: Array, **style: object) -> None:
    """Draw a line through points (n, 3) of the world [m], in front of all bodies.

    Args:
        axes: axes to draw into.
        view: direction from which the points are seen.
        points: (n, 3) points.
        style: keyword arguments of Matplotlib for the line.
    """
    flat = view.flat(points)
    axes.plot(flat[:, 0], flat[:, 1], zorder=4.0, **style)  # type: ignore[arg-type]


def draw_box_edges(axes: Axes, view: View, lower: Array, upper: Array, **style: object) -> None:
    """Draw the twelve edges of a box along the world's axes.

    Args:
        axes: axes to draw into.
        view: direction from which the box is seen.
        lower, upper: (3,) corners with the least and largest coordinates [m].
        style: keyword arguments of Matplotlib for the lines.
    """
    flat = view.flat(box_corners(lower, upper))
    # Corners whose numbers differ in one bit are neighbours.
    edges = [flat[[i, i | bit]] for i in range(8) for bit in (1, 2, 4) if not i & bit]
    axes.add_collection(LineCollection(edges, zorder=5.0, **style), autolim=False)


MARGIN = 0.06
"""Free margin around the content of a picture of the cell [m]."""


def frame_axes(axes: Axes, view: View, points: Array, margin: float = MARGIN) -> None:
    """Set the limits of a picture such that it contains given points, with equal scales.

    The axes are hidden if the view has no titles for them.

    Args:
        axes: axes of the picture.
        view: direction from which the points are seen.
        points: (n, 3) points in the world [m].
        margin: distance of the points from the border [m].
    """
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
    """Return width over height of the picture of points (n, 3) of the world in a view."""
    width, height = np.ptp(view.flat(points), axis=0)
    return float(width / height)


def box_corners(lower: Array, upper: Array) -> Array:
    """Return the 8 corners (8, 3) of a box along the axes [m].

    Args:
        lower, upper: (3,) corners with the least and largest coordinates [m].
    """
    return np.array(list(product(*zip(lower, upper, strict=True))))
