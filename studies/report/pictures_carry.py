"""Pictures of selected trajectories: forces, joint torques, pressure shift, payload, timing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from hybrid_opt.campaign.recommended import StoredRecommendation
from hybrid_opt.timing.robustness import KILOGRAM_FORCE
from studies.drivable import POLISHED
from studies.report.page_views import drive_look, limits
from studies.report.records import DrawnCarry, DrivableReport, ReportData
from studies.report.style import (
    FULL_WIDTH,
    HAND_MADE,
    LineStyle,
    new_figure,
    panel_label,
    series,
    shortened,
)
from symbolic.array import Array

STATIC_COLOUR = "#b00020"


def styled(data: ReportData) -> tuple[tuple[DrawnCarry, LineStyle], ...]:
    """The hand-made trajectory and each algorithm's best one, with their looks."""
    best = [(a.best, series(a.index)) for a in data.algorithms]
    return (
        (data.initial, HAND_MADE),
        *((carry, look) for carry, look in best if carry is not None),
    )


def normal_forces(data: ReportData) -> Figure:
    """Normal force of each robot along the carries (paper Figure 9)."""
    figure = new_figure(FULL_WIDTH, 0.46 * FULL_WIDTH)
    panels = figure.subplots(1, 2, sharey=True)
    task = data.workcell.task
    for i, (axes, robot) in enumerate(zip(panels, data.workcell.robots, strict=True)):
        for carry, look in styled(data):
            axes.plot(
                carry.timed.time,
                carry.timed.normal_force[:, i],
                color=look.colour,
                linestyle=look.line,
                label=carry.label,
            )
        if np.isfinite(data.static[:2]).all():
            axes.axhline(
                data.static[i] * task.reference_force[i],
                color=STATIC_COLOUR,
                linewidth=0.8,
                linestyle=(0, (2, 2)),
                label="level payload at rest",
            )
        axes.set_xlabel("time [s]")
        panel_label(axes, "ab"[i], f"robot {shortened(robot.name)!r}")
    panels[0].set_ylabel("normal contact force [N]")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(handles))
    return figure


def torque_use(workcell_torque: Array, torque: Array) -> Array:
    """(all joints,) largest use of each joint's torque in percent."""
    return np.asarray(100.0 * np.abs(torque).max(axis=0) / workcell_torque)


def joint_torques(data: ReportData) -> Figure:
    """Largest joint torque over its maximum, contact wrench alone and with the arm (Figure 10)."""
    figure = new_figure(FULL_WIDTH, 0.98 * FULL_WIDTH)
    panels = figure.subplots(2, 2, subplot_kw={"projection": "polar"})
    limit = np.concatenate([robot.torque_max for robot in data.workcell.robots])
    first = len(data.workcell.robots[0].torque_max)
    for row, (text, own) in enumerate((("contact wrench alone", False), ("with the arm", True))):
        for i, robot in enumerate(data.workcell.robots):
            axes = panels[row, i]
            own_joints = slice(0, first) if i == 0 else slice(first, None)
            joints = len(robot.torque_max)
            angles = np.linspace(0.0, 2.0 * np.pi, joints + 1)
            most = np.zeros(joints)
            for carry, look in styled(data):
                torque = carry.timed.torque if own else carry.timed.contact_torque
                use = torque_use(limit, torque)[own_joints]
                most = np.maximum(most, use)
                axes.plot(
                    angles,
                    [*use, use[0]],
                    color=look.colour,
                    linestyle=look.line,
                    marker=look.marker,
                    markersize=3,
                    label=carry.label,
                )
            axes.set_xticks(angles[:-1], [f"joint {j + 1}" for j in range(joints)])
            axes.tick_params(axis="x", pad=4)
            _label_rings(axes, most)
            letter = "abcd"[2 * row + i]
            axes.set_title(f"({letter}) {shortened(robot.name)!r}: {text} [% of maximum]", pad=12)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(handles))
    return figure


def _label_rings(axes: Axes, most: Array) -> None:
    """Round values on the rings, written between the two neighbouring joints that leave most
    room: most (n,) is the largest use of each [%]."""
    rings = MaxNLocator(6, steps=[1, 2, 5, 10]).tick_values(0.0, 1.02 * float(most.max()))
    axes.set_ylim(0.0, rings[-1])
    axes.set_yticks(rings[1:-1], [f"{ring:g} %" for ring in rings[1:-1]], va="center", ha="center")
    step = 360.0 / len(most)
    place = step / 2.0 + step * int(np.argmin(most + np.roll(most, -1)))
    axes.set_rlabel_position(place)  # type: ignore[attr-defined]


def pressure_shift(data: ReportData) -> Figure:
    """Shift of the centres of pressure and the patch radius (paper Figure 11)."""
    figure = new_figure(FULL_WIDTH, 0.46 * FULL_WIDTH)
    panels = figure.subplots(1, 2, sharey=True)
    for i, (axes, robot) in enumerate(zip(panels, data.workcell.robots, strict=True)):
        for carry, look in styled(data):
            axes.plot(
                carry.timed.time,
                1e3 * carry.timed.pressure_shift[:, i],
                color=look.colour,
                linestyle=look.line,
                label=carry.label,
            )
        axes.axhline(
            1e3 * data.workcell.contacts[i].patch_radius,
            color="black",
            linestyle="--",
            linewidth=0.9,
            label="patch radius",
        )
        axes.set_ylim(bottom=0.0)
        axes.set_xlabel("time [s]")
        panel_label(axes, "ab"[i], f"robot {shortened(robot.name)!r}")
    panels[0].set_ylabel("shift of the centre of pressure [mm]")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(handles))
    return figure


def residual_moments(data: ReportData) -> Figure:
    """Moment missing with point contacts; in the legend, with the centres of pressure shifted."""
    figure = new_figure(FULL_WIDTH, 0.42 * FULL_WIDTH)
    axes = figure.subplots()
    for carry, look in styled(data):
        point = np.linalg.norm(carry.timed.point_moment_residual, axis=1)
        shifted = float(np.linalg.norm(carry.timed.moment_residual, axis=1).max())
        axes.plot(
            carry.timed.time,
            point,
            color=look.colour,
            linestyle=look.line,
            label=f"{carry.label} (shifted: at most {shifted:.1e} N m)",
        )
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("residual moment [N m]")
    figure.legend(loc="outside lower center", ncols=2)
    return figure


def payload(data: ReportData) -> Figure:
    """Largest force of each robot against the payload's mass (paper Figure 12)."""
    figure = new_figure(FULL_WIDTH, 0.5 * FULL_WIDTH)
    panels = figure.subplots(1, 2, sharey=True)
    reference = data.workcell.task.reference_force
    limits = np.concatenate([c.sensitivity.mass_by_resultant for c, _ in styled(data)])
    masses = np.array([0.75 * limits.min(), 1.1 * limits.max()])
    for i, (axes, robot) in enumerate(zip(panels, data.workcell.robots, strict=True)):
        for carry, look in styled(data):
            force = carry.sensitivity.force_at(masses)[:, i] / KILOGRAM_FORCE
            limit = float(carry.sensitivity.mass_by_resultant[i])
            axes.plot(masses, force, color=look.colour, linestyle=look.line, label=f"{carry.label}")
            axes.plot(
                limit,
                reference[i] / KILOGRAM_FORCE,
                look.marker,
                color=look.colour,
                markeredgecolor="black",
                markeredgewidth=0.5,
            )
        axes.axhline(
            reference[i] / KILOGRAM_FORCE,
            color="black",
            linestyle="--",
            linewidth=0.9,
            label="reference force",
        )
        axes.set_xlabel("payload mass [kg]")
        axes.set_xlim(*masses)
        panel_label(axes, "ab"[i], f"robot {shortened(robot.name)!r}")
        _note_limits(axes, data, i)
    panels[0].set_ylabel("largest contact force [kgf]")
    newton = panels[1].secondary_yaxis(
        "right", functions=(lambda v: v * KILOGRAM_FORCE, lambda v: v / KILOGRAM_FORCE)
    )
    newton.set_ylabel("largest contact force [N]")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(handles))
    return figure


def _note_limits(axes: Axes, data: ReportData, i: int) -> None:
    """Payloads at the reference force as text in the free corner."""
    lines = [
        f"{carry.label}: {carry.sensitivity.mass_by_resultant[i]:.2f} kg"
        for carry, _ in styled(data)
    ]
    axes.text(
        0.97,
        0.05,
        "payload at the limit\n" + "\n".join(lines),
        fontsize=6.5,
        ha="right",
        va="bottom",
        transform=axes.transAxes,
        bbox={"facecolor": "white", "edgecolor": "#cccccc", "linewidth": 0.5},
    )


def duration_against_force(data: ReportData) -> Figure:
    """Durations for each limit on the normal forces: of single paths, and of the drivable fronts
    where there are any: members at their peak forces, and the fastest of a replica's paths at
    every force (median and range of the replicas)."""
    figure = new_figure(FULL_WIDTH, 0.5 * FULL_WIDTH)
    axes = figure.subplots()
    looks: Sequence[LineStyle] = [look for _, look in styled(data)]
    curves = []
    for selection, look in zip(data.timings, looks, strict=True):
        known = np.isfinite(selection.curve.duration)
        curves.append(np.stack([selection.curve.force, selection.curve.duration], axis=1)[known])
        axes.plot(
            *curves[-1].T,
            color=look.colour,
            linestyle=look.line,
            marker="" if data.drivable else look.marker,
            markersize=3.5,
            label=_curve_label(data, selection.label),
        )
    if data.drivable is not None:
        curves += _draw_fronts(axes, data.drivable)
        curves += _draw_replicas(axes, data.drivable, data.summary.recommendation)
    chosen = _draw_still(axes, data)
    _look_at(axes, np.concatenate(curves), chosen)
    axes.set_xlabel("largest normal force [N]")
    axes.set_ylabel("duration [s]")
    axes.legend(loc="upper right")
    return figure


def _curve_label(data: ReportData, label: str) -> str:
    """A curve's label beside fronts: a selected path is that of least force."""
    if data.drivable is None or label == data.initial.label:
        return label
    return f"{label}: least-force path"


def _draw_fronts(axes: Axes, drivable: DrivableReport) -> list[Array]:
    """Members of the drivable fronts, and the carry to run; returns their points."""
    polished = any(entry.front.polished for entry in drivable.fronts)
    found = []
    for entry in drivable.fronts:
        look = series(entry.index)
        opened = polished and not entry.front.polished
        axes.plot(
            entry.force,
            entry.duration,
            look.marker,
            markersize=4.0,
            markerfacecolor="none" if opened else look.colour,
            markeredgecolor=look.colour if opened else "black",
            markeredgewidth=0.6,
            label=entry.front.label,
        )
        found.append(np.stack([entry.force, entry.duration], axis=1))
    return found


def _draw_replicas(
    axes: Axes, drivable: DrivableReport, recommendation: StoredRecommendation | None
) -> list[Array]:
    """Durations of the best fronts' paths at the same forces; returns the points of the medians."""
    if recommendation is None:
        return []
    looks = {entry.front.label: series(entry.index) for entry in drivable.fronts}
    polished = any(entry.front.polished for entry in drivable.fronts)
    table = recommendation.durations
    drawn = []
    for row in table.rows:
        if row.label not in looks or (polished and not row.label.endswith(POLISHED)):
            continue
        look = looks[row.label]
        force = np.array(table.forces)
        median, least, largest = (
            np.array(values, dtype=float) for values in (row.median, row.least, row.largest)
        )
        axes.plot(
            force,
            median,
            color=look.colour,
            linestyle="-",
            linewidth=0.9,
            label=f"{row.label}: {row.replicas} replicas",
        )
        axes.fill_between(force, least, largest, color=look.colour, alpha=0.2, linewidth=0.0)
        drawn.append(np.stack([force, median], axis=1)[np.isfinite(median)])
    return drawn


def _draw_still(axes: Axes, data: ReportData) -> Array:
    """The carry to run, whose point (k, 2) is returned, and the force that holds the payload
    still."""
    choice = data.summary.recommendation
    if choice is not None:
        axes.plot(
            choice.force_limit,
            choice.duration,
            "*",
            color=STATIC_COLOUR,
            markersize=11.0,
            label="recommended",
        )
    still = max(data.summary.static_hold.normal_force)
    axes.axvline(still, color=STATIC_COLOUR, linewidth=0.8, linestyle=(0, (2, 2)), label="at rest")
    return np.array([] if choice is None else [choice.force_limit, choice.duration]).reshape(-1, 2)


def _look_at(axes: Axes, points: Array, always: Array) -> None:
    """Limits of the axes around what a reader chooses between, and what is always seen (k, 2)."""
    if len(points) == 0:
        return
    (low, high), (least, most) = limits(drive_look(points, always))
    axes.set_xlim(low, high)
    axes.set_ylim(least, most)
