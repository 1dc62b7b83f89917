"""A carry in three dimensions, played in a notebook's cell or in a page of its own."""

from __future__ import annotations

import html
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from string import Template

import numpy as np

from hybrid_opt.carry import Carry
from hybrid_opt.display.objects import heading_of
from hybrid_opt.display.scene import embedded_json, packed, scene_data, scene_js, three_js
from hybrid_opt.errors import DisplayError
from symbolic.geometry.pairs import build_geometry

MAX_SAMPLES = 200
"""Samples of a carry that are played."""


@dataclass(frozen=True)
class Look:
    """A place of a carry worth looking at.

    Attributes:
        sample: number of the sample.
        text: what is to be seen there.
        bodies: names of those that are shown in red.
    """

    sample: int
    text: str
    bodies: tuple[str, ...] = ()


@dataclass(frozen=True, repr=False)
class CarryView:
    """A self-contained page that plays a carry; drag orbits, right-drag pans, the wheel zooms.

    Attributes:
        carry: the carry.
        height: of the notebook's cell [px].
        look: where it begins, None for the first sample.
    """

    carry: Carry
    height: int = 480
    look: Look | None = None

    def page(self) -> str:
        """The page's text: no network, nothing but its own scripts."""
        carry = self.carry
        rows = np.unique(np.linspace(0, len(carry) - 1, min(len(carry), MAX_SAMPLES)).astype(int))
        columns = [carry.time[:, None] - carry.time[0], carry.pose, carry.q]
        samples = np.concatenate(columns, axis=1)[rows]
        look = self.look or Look(0, "")
        document = scene_data(build_geometry(carry.workcell), carry, look.bodies) | {
            "samples": packed(samples, np.float32),
            "width": samples.shape[1],
            "numbers": rows.tolist(),
            "begin": float(carry.time[look.sample] - carry.time[0]),
        }
        return Template(_own("view.html")).substitute(
            title=html.escape(heading_of(carry)),
            note=html.escape(look.text),
            data=embedded_json(document),
            three=three_js().replace("</script", "<\\/script"),
            scene=scene_js(),
            player=_own("view.js"),
        )

    def save(self, path: str | Path) -> None:
        """Write the page into a file.

        Raises:
            DisplayError: the file cannot be written.
        """
        try:
            Path(path).write_text(self.page(), encoding="utf-8")
        except OSError as error:
            raise DisplayError(f"{path}: cannot be written ({error.strerror})") from error

    def __repr__(self) -> str:
        return (
            f"View of: {heading_of(self.carry)} (shown in a notebook; save('view.html') elsewhere)"
        )

    def _repr_html_(self) -> str:
        page = html.escape(self.page(), quote=True)
        return (
            f'<iframe srcdoc="{page}" sandbox="allow-scripts" '
            f'style="width:100%;height:{self.height}px;border:0"></iframe>'
        )


def _own(name: str) -> str:
    return (files("hybrid_opt.display") / name).read_text("utf-8")
