"""The list of a report's pictures: name, caption, and how to draw each from the data."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

from matplotlib.figure import Figure

from studies.report import pictures_carry, pictures_cell, pictures_fronts
from studies.report.data import ReportData
from studies.report.drawing import in_style, settled


@dataclass(frozen=True)
class ReportPicture:
    """One picture of the report.

    Attributes:
        name: of its files, without suffix.
        caption: what it shows, one or two sentences of plain text.
        make: draws it, without style.
    """

    name: str
    caption: str
    make: Callable[[], Figure]

    def draw(self) -> Figure:
        """The figure in the common style."""
        with in_style():
            return settled(self.make())


def _of(name: str, draw: Callable[..., Figure], *given: Any, caption: str = "") -> ReportPicture:
    """A picture whose caption is the docstring of what draws it, where there is no other."""
    text = caption or inspect.getdoc(draw) or ""
    return ReportPicture(name, " ".join(text.split()), partial(draw, *given))


def report_pictures(data: ReportData) -> Iterator[ReportPicture]:
    """All pictures that the data allows, in the paper's order, then those beyond the paper."""
    cell, arm = (data.geometry, data.reach, data.initial), data.workcell.robots[0].name
    arm = f"Collision shapes of the arm {arm!r}, and the reach of its pad (paper Figure 6)."
    yield _of("fig04_reachable_regions", pictures_cell.reachable_regions, *cell)
    yield _of("fig05_cell", pictures_cell.environment, data.geometry, data.initial)
    yield _of("fig06_arm", pictures_cell.arm_and_reach, *cell, caption=arm)
    if data.solved:
        yield from _search_pictures(data)
    yield _of("infeasibility", pictures_fronts.infeasibility, data)
    yield _of("fig09_normal_forces", pictures_carry.normal_forces, data)
    yield _of("fig10_joint_torques", pictures_carry.joint_torques, data)
    yield _of("fig11_pressure_shift", pictures_carry.pressure_shift, data)
    yield _of("residual_moments", pictures_carry.residual_moments, data)
    yield _of("fig12_payload", pictures_carry.payload, data)
    yield _of("fig13_paths", pictures_cell.paths, data.geometry, pictures_carry.styled(data))
    paper = " (paper Figures 14 and 15)"
    drawn = [
        (a.name, a.best, f"The trajectory selected from {a.best.label},", paper)
        for a in data.algorithms
        if a.best is not None
    ]
    if (driven := data.recommended_carry) is not None:
        drawn.append((driven.label, driven, "The recommended carry", ""))
    for name, carry, whose, source in drawn:
        text = f"{whose} at 0, 33, 66 and 100 % of its duration{source}."
        sequence = pictures_cell.motion_sequence
        yield _of(f"motion_{name}", sequence, data.geometry, carry, caption=text)
    if any(timed.force_curve is not None for _, timed in data.timings):
        text = (
            f"Drivable durations against the {data.force_kind.title}: single paths timed anew at "
            "every limit, and the members of the drivable fronts, whose lines are the fastest path "
            "at every force (median and range of the replicas). All other limits hold throughout, "
            "those on jerk only for the star."
        )
        draw_curves = pictures_fronts.duration_against_force
        yield _of("duration_against_force", draw_curves, data, caption=text)
    choice = data.summary.recommendation
    if choice is not None and choice.price is not None:
        found = choice.price.uncertainty
        whose = "the workcell's [uncertainty]" if found.stated else "the usual uncertainty"
        text = (
            "The price of robustness: largest normal forces of the recommended carry that hold in "
            f"every case of a multiple of {whose} ({found})."
        )
        yield _of("robust_price", pictures_carry.robust_price, data, choice.price, caption=text)
    if any(len(found.time) for found in data.simulations):
        yield _of("simulated_forces", pictures_carry.simulated_forces, data)


def _search_pictures(data: ReportData) -> Iterator[ReportPicture]:
    objectives = len(data.objective_titles)
    if objectives >= 2:
        yield _of("fig07_fronts", pictures_fronts.fronts, data)
    yield _of("fig08_best_so_far", pictures_fronts.histories, data)
    if objectives == 2:
        yield _of("attainment", pictures_fronts.attainment, data)
    yield _of("indicators", pictures_fronts.indicators, data)
    if data.has_hybrid and objectives >= 2:
        yield _of("polish", pictures_fronts.polish, data)
