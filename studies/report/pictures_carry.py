"""Pictures of selected trajectories: forces, joint torques, pressure shift, payload, timing."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from hybrid_opt.timing.robustness import KILOGRAM_FORCE
from studies.report.records import DrawnCarry, ReportData
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
    split = [len(data.workcell.robots[0].torque_max)]
    kinds = (("contact wrench alone", "contact_torque"), ("with the arm", "torque"))
    uses = {
        (row, carry.label): np.split(torque_use(limit, getattr(carry.timed, name)), split)
        for row, (_, name) in enumerate(kinds)
        for carry, _ in styled(data)
    }
    # One scale for all panels, so that they can be compared.
    top = max(float(use.max()) for both in uses.values() for use in both)
    for row, (text, _) in enumerate(kinds):
        for i, robot in enumerate(data.workcell.robots):
            axes = panels[row, i]
            joints = len(robot.torque_max)
            angles = np.linspace(0.0, 2.0 * np.pi, joints + 1)
            most = np.zeros(joints)
            for carry, look in styled(data):
                use = uses[row, carry.label][i]
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
            _label_rings(axes, most, top)
            letter = "abcd"[2 * row + i]
            axes.set_title(f"({letter}) {shortened(robot.name)!r}: {text} [% of maximum]", pad=12)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(handles))
    return figure


def _label_rings(axes: Axes, most: Array, top: float) -> None:
    """Round values up to `top` [%] on the rings, written between the two neighbouring joints that
    leave most room: most (n,) is the largest use of each [%]."""
    rings = MaxNLocator(6, steps=[1, 2, 5, 10]).tick_values(0.0, 1.02 * top)
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
