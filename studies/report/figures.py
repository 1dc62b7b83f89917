"""The list of a report's figures: name, caption, and how to draw each from the data."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from matplotlib.figure import Figure

from studies.report import (
    figures_carry,
    figures_cell,
    figures_fronts,
    figures_robust,
    figures_search,
    figures_simulation,
)
from studies.report.records import DrawnCarry, ReportData
from studies.report.style import in_style, settled


@dataclass(frozen=True)
class ReportFigure:
    """One figure of the report.

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


def report_figures(data: ReportData) -> Iterator[ReportFigure]:
    """All figures that the data allows, in the paper's order, then those beyond the paper."""
    geometry = data.geometry
    yield ReportFigure(
        "fig04_reachable_regions",
        "Reach of both pads (positions, sampled within the joint limits), the common region of the "
        "box centre, and the bounds of the free waypoints (paper Figure 4).",
        lambda: figures_cell.reachable_regions(geometry, data.reach, data.initial),
    )
    yield ReportFigure(
        "fig05_cell",
        "The cell at the start of the carry (paper Figure 5).",
        lambda: figures_cell.environment(geometry, data.initial),
    )
    yield ReportFigure(
        "fig06_arm",
        f"The arm {data.workcell.robots[0].name} as its collision shapes, and the reach of its pad "
        "(paper Figure 6).",
        lambda: figures_cell.arm_and_reach(geometry, data.reach, data.initial),
    )
    if data.solved:
        yield from _search_figures(data)
    yield ReportFigure(
        "infeasibility",
        "What made candidates infeasible: the constraint violated first, over all replicas, and "
        "where on the path.",
        lambda: figures_search.infeasibility(data),
    )
    yield from _carry_figures(data)


def _search_figures(data: ReportData) -> Iterator[ReportFigure]:
    if len(data.objective_titles) >= 2:
        yield ReportFigure(
            "fig07_fronts",
            "Feasible candidates and non-dominated ones of each algorithm's run with the largest "
            "hypervolume (paper Figure 7). The star is the level payload at rest.",
            lambda: figures_fronts.fronts(data),
        )
    yield ReportFigure(
        "fig08_best_so_far",
        "Best feasible value of each objective so far, in the same runs; the inset enlarges the "
        "second half (paper Figure 8).",
        lambda: figures_search.histories(data),
    )
    if len(data.objective_titles) == 2:
        yield ReportFigure(
            "attainment",
            "Empirical attainment surfaces: what a quarter, half and three quarters of the "
            "replicas reached or bettered.",
            lambda: figures_fronts.attainment(data),
        )
    yield ReportFigure(
        "indicators",
        "Indicators of every replica, with medians and quartiles.",
        lambda: figures_search.indicators(data),
    )
    if data.has_hybrid and len(data.objective_titles) >= 2:
        yield ReportFigure(
            "polish",
            "Fronts before and after the polish, and the hypervolume of every replica.",
            lambda: figures_fronts.polish(data),
        )


def _carry_figures(data: ReportData) -> Iterator[ReportFigure]:
    yield ReportFigure(
        "fig09_normal_forces",
        "Normal contact forces along the selected trajectories (paper Figure 9).",
        lambda: figures_carry.normal_forces(data),
    )
    yield ReportFigure(
        "fig10_joint_torques",
        "Largest joint torque over its maximum: of the contact wrench alone, and with the arm's "
        "own weight and motion (paper Figure 10).",
        lambda: figures_carry.joint_torques(data),
    )
    yield ReportFigure(
        "fig11_pressure_shift",
        "Shift of the centres of pressure that balances the moments, and the radius of the contact "
        "patch (paper Figure 11).",
        lambda: figures_carry.pressure_shift(data),
    )
    yield ReportFigure(
        "residual_moments",
        "Moment that is missing with forces at the nominal contact points, and with the centres of "
        "pressure shifted.",
        lambda: figures_carry.residual_moments(data),
    )
    yield ReportFigure(
        "fig12_payload",
        "Largest contact force of each robot against the payload's mass, for unchanged motion "
        "(paper Figure 12).",
        lambda: figures_carry.payload(data),
    )
    yield ReportFigure(
        "fig13_paths",
        "Paths of the box centre (paper Figure 13).",
        lambda: figures_cell.paths(
            data.geometry,
            tuple((carry, look.colour, look.line) for carry, look in figures_carry.styled(data)),
        ),
    )
    for algorithm in data.solved:
        carry = algorithm.best
        assert carry is not None
        yield _motion(data, carry, f"motion_{algorithm.name}")
    if data.timings:
        yield ReportFigure(
            "duration_against_force",
            "Drivable durations against the limit on the normal forces: single paths timed anew "
            "at every limit, and the members of the drivable fronts. All other limits hold "
            "throughout.",
            lambda: figures_carry.duration_against_force(data),
        )
    yield from _price_figure(data)
    if any(len(found.time) for found in data.simulations):
        yield ReportFigure(
            "simulated_forces",
            "Normal forces in the simulated cell, arms under force control, beside those that were "
            "predicted for how the carries were pressed there.",
            lambda: figures_simulation.simulated_forces(data),
        )


def _price_figure(data: ReportData) -> Iterator[ReportFigure]:
    choice = data.summary.recommendation
    if choice is not None and choice.price is not None:
        price = choice.price
        whose = "the workcell's [uncertainty]" if price.stated else "a usual set of cases"
        yield ReportFigure(
            "robust_price",
            "The price of robustness: largest normal forces of the recommended carry that hold in "
            f"every case of {whose} ({price.text}), times a factor.",
            lambda: figures_robust.robust_price(data, price),
        )


def _motion(data: ReportData, carry: DrawnCarry, name: str) -> ReportFigure:
    return ReportFigure(
        name,
        f"The trajectory selected from {carry.label} at 0, 33, 66 and 100 % of its duration (paper "
        "Figures 14 and 15).",
        lambda: figures_cell.motion_sequence(data.geometry, carry),
    )
