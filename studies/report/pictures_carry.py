"""Pictures of selected trajectories: forces, joint torques, pressure shift, payload, simulation."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from hybrid_opt.display.table import UNPUBLISHED
from hybrid_opt.robust.price import RobustPrice
from hybrid_opt.timing.robustness import KILOGRAM_FORCE
from studies.report.data import ReportData
from studies.report.drawing import (
    HAND_MADE_STYLE,
    MARKED,
    legend_below,
    limit_line,
    new_figure,
    panel_label,
    rest_line,
    series,
    shortened,
)
from studies.report.page_carries import joint_torque_use
from symbolic.array import Array

PREDICTED: dict[str, Any] = {"color": "black", "linestyle": (0, (2, 1.5)), "linewidth": 0.8}
"""Matplotlib's keyword arguments for predicted curves in the picture of a simulation."""


def _per_robot(
    data: ReportData, titles: tuple[str, str], draw: Callable[[Axes, int], None], columns: int = 0
) -> Figure:
    """Return a figure with one panel per robot, common axes and one legend.

    Args:
        data: what the report shows, with the names of the robots.
        titles: titles of both axes.
        draw: function that draws into the panel of the robot with index 0 or 1.
        columns: number of columns of the legend; 0 for one row.
    """
    figure = new_figure(0.48)
    panels = figure.subplots(1, 2, sharey=True)
    for i, (axes, robot) in enumerate(zip(panels, data.workcell.robots, strict=True)):
        draw(axes, i)
        axes.set_xlabel(titles[0])
        panel_label(axes, "ab"[i], f"robot {shortened(robot.name)!r}")
    panels[0].set_ylabel(titles[1])
    legend_below(figure, panels[0], columns)
    return figure


def normal_forces(data: ReportData) -> Figure:
    """Draw normal contact forces along the selected trajectories (paper Figure 9)."""

    def draw(axes: Axes, i: int) -> None:
        for carry in data.drawn:
            force = carry.timed.normal_force[:, i]
            axes.plot(carry.timed.time, force, **carry.look.drawn, label=carry.label)
        if data.at_rest is not None:
            still = data.at_rest[i] * data.workcell.task.reference_force[i]
            rest_line(axes, still, "level payload at rest")

    return _per_robot(data, ("time [s]", "normal contact force [N]"), draw)


def pressure_shift(data: ReportData) -> Figure:
    """Draw the shift of the centres of pressure that balances the moments, and the radius of the
    contact patch (paper Figure 11).
    """

    def draw(axes: Axes, i: int) -> None:
        for carry in data.drawn:
            shift = 1e3 * carry.timed.pressure_shift[:, i]
            axes.plot(carry.timed.time, shift, **carry.look.drawn, label=carry.label)
        limit_line(axes, 1e3 * data.workcell.contacts[i].patch_radius, "patch radius")
        axes.set_ylim(bottom=0.0)

    return _per_robot(data, ("time [s]", "shift of the centre of pressure [mm]"), draw)


def payload(data: ReportData) -> Figure:
    """Draw the largest contact force of each robot against the payload's mass, for unchanged motion
    (paper Figure 12)."""
    reference = data.workcell.task.reference_force / KILOGRAM_FORCE
    limits = np.concatenate([c.sensitivity.mass_by_resultant for c in data.drawn])
    masses = np.array([0.75 * limits.min(), 1.1 * limits.max()])

    def draw(axes: Axes, i: int) -> None:
        known = []
        for carry in data.drawn:
            force = carry.sensitivity.force_at(masses)[:, i] / KILOGRAM_FORCE
            limit = float(carry.sensitivity.mass_by_resultant[i])
            axes.plot(masses, force, **carry.look.drawn, label=carry.label)
            axes.plot(limit, reference[i], **carry.look.marks(4.0))
            known.append(f"{carry.label}: {limit:.2f} kg")
        limit_line(axes, reference[i], "reference force")
        axes.set_xlim(*masses)
        axes.text(
            0.97,
            0.05,
            "\n".join(["payload at the limit", *known]),
            fontsize=6.5,
            ha="right",
            va="bottom",
            transform=axes.transAxes,
            bbox={"facecolor": "white", "edgecolor": "#cccccc", "linewidth": 0.5},
        )

    figure = _per_robot(data, ("payload mass [kg]", "largest contact force [kgf]"), draw)
    newton = figure.axes[1].secondary_yaxis(
        "right",
        functions=(
            partial(np.multiply, KILOGRAM_FORCE),
            partial(np.multiply, 1.0 / KILOGRAM_FORCE),
        ),
    )
    newton.set_ylabel("largest contact force [N]")
    return figure


def simulated_forces(data: ReportData) -> Figure:
    """Draw normal forces in the simulated cell, with arms under force control, beside the predicted
    ones."""
    looks, number = [], 0
    for found in data.simulations:
        # The hand-made trajectory looks as everywhere, the others by their order.
        own = found.label == data.initial.label
        looks.append(HAND_MADE_STYLE if own else series(number))
        number += not own
    drawn = [(f, look) for f, look in zip(data.simulations, looks, strict=True) if len(f.time)]

    def draw(axes: Axes, i: int) -> None:
        for found, look in drawn:
            label = f"{found.label}, simulated"
            axes.plot(
                found.time, found.simulated[:, i], color=look.colour, linewidth=0.9, label=label
            )
            told = "predicted" if found is drawn[-1][0] else None
            axes.plot(found.time, found.predicted[:, i], **PREDICTED, label=told)

    return _per_robot(data, ("time [s]", "normal contact force [N]"), draw, 3)


def joint_torques(data: ReportData) -> Figure:
    """Draw the largest joint torque over its maximum: of the contact wrench alone, and with the
    arm's own weight and motion (paper Figure 10)."""
    figure = new_figure(0.98)
    panels = figure.subplots(2, 2, subplot_kw={"projection": "polar"})
    split = [len(data.workcell.robots[0].torque_max)]
    kinds = (("contact wrench alone", "contact_torque"), ("with the arm", "torque"))
    uses = {
        (row, carry.label): np.split(joint_torque_use(data.workcell, torque), split)
        for row, (_, name) in enumerate(kinds)
        for carry in data.drawn
        for torque in [getattr(carry.timed, name)]
    }
    # One scale for all panels, so that they can be compared.
    known = [use.max() for both in uses.values() for use in both if np.isfinite(use).all()]
    top = float(max(known, default=100.0))
    for row, (text, _) in enumerate(kinds):
        for i, robot in enumerate(data.workcell.robots):
            axes, joints = panels[row, i], len(robot.torque_max)
            angles, most = np.linspace(0.0, 2.0 * np.pi, joints + 1), np.zeros(joints)
            for carry in data.drawn:
                use = uses[row, carry.label][i]
                most = np.fmax(most, use)
                looks = {**carry.look.drawn, "marker": carry.look.marker, "markersize": 3}
                axes.plot(angles, [*use, use[0]], **looks, label=carry.label)
            axes.set_xticks(angles[:-1], [f"joint {j + 1}" for j in range(joints)])
            axes.tick_params(axis="x", pad=4)
            _label_rings(axes, most, top)
            letter = "abcd"[2 * row + i]
            unit = "% of maximum" if np.isfinite(robot.torque_max).all() else UNPUBLISHED
            axes.set_title(f"({letter}) {shortened(robot.name)!r}: {text} [{unit}]", pad=12)
    legend_below(figure, panels[0, 0])
    return figure


def _label_rings(axes: Axes, most: Array, top: float) -> None:
    """Label the rings of a polar plot at round values. The labels stand between those two
    neighbouring joints whose values have the smallest sum.

    Args:
        axes: the polar plot, with one direction per joint.
        most: (n,) largest use of each joint's torque [%].
        top: largest value of the plot [%].
    """
    rings = MaxNLocator(6, steps=[1, 2, 5, 10]).tick_values(0.0, 1.02 * top)
    axes.set_ylim(0.0, rings[-1])
    axes.set_yticks(rings[1:-1], [f"{ring:g} %" for ring in rings[1:-1]], va="center", ha="center")
    step = 360.0 / len(most)
    place = step / 2.0 + step * int(np.argmin(most + np.roll(most, -1)))
    axes.set_rlabel_position(place)  # type: ignore[attr-defined]


def residual_moments(data: ReportData) -> Figure:
    """Draw the moment that the contact forces leave unbalanced if they act at the nominal contact
    points. The legend states what is left with the centres of pressure shifted.
    """
    figure = new_figure(0.42)
    axes = figure.subplots()
    for carry in data.drawn:
        point = np.linalg.norm(carry.timed.point_moment_residual, axis=1)
        shifted = float(np.linalg.norm(carry.timed.moment_residual, axis=1).max())
        label = f"{carry.label} (shifted: at most {shifted:.1e} N m)"
        axes.plot(carry.timed.time, point, **carry.look.drawn, label=label)
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("residual moment [N m]")
    figure.legend(loc="outside lower center", ncols=2)
    return figure


def robust_price(data: ReportData, price: RobustPrice) -> Figure:
    """Draw the peak normal forces that hold the recommended carry in every case of the uncertainty,
    against a factor on the uncertainty.
    """
    figure = new_figure(0.5)
    axes = figure.subplots()
    for i, robot in enumerate(data.workcell.robots):
        look = series(i)
        label = shortened(robot.name)
        axes.plot(price.factors, price.peak[:, i], **look.drawn, marker=look.marker, label=label)
    stated = "stated uncertainty" if price.uncertainty.stated else "usual uncertainty"
    axes.axvline(1.0, color="black", linewidth=0.8, linestyle=(0, (2, 2)), label=stated)
    if float(price.limit.min()) <= 1.25 * float(price.peak.max()):
        limit_line(axes, float(price.limit.min()), "reference force")
        if 0.0 < price.largest_factor < np.inf:
            label = f"largest multiple within it: {price.largest_factor:.2f}"
            axes.axvline(price.largest_factor, color=MARKED, linewidth=0.8, label=label)
    axes.set_xlabel("multiple of the uncertainty [-]")
    axes.set_ylabel("peak normal force [N]")
    axes.legend(loc="upper left")
    return figure
