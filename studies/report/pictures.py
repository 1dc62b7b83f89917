"""The list of a report's pictures: name, caption, and how to draw each from the data."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from matplotlib.figure import Figure

from studies.report import (
    pictures_carry,
    pictures_cell,
    pictures_fronts,
)
from studies.report.data import DrawnCarry, ReportData
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
        """It in the common style."""
        with in_style():
            return settled(self.make())


def report_pictures(data: ReportData) -> Iterator[ReportPicture]:
    """All pictures that the data allows, in the paper's order, then those beyond the paper."""
    geometry = data.geometry
    yield ReportPicture(
        "fig04_reachable_regions",
        "Reach of both pads (positions, sampled within the joint limits), the common region of the "
        "box centre, and the bounds of the free waypoints (paper Figure 4).",
        lambda: pictures_cell.reachable_regions(geometry, data.reach, data.initial),
    )
    yield ReportPicture(
        "fig05_cell",
        "The cell at the start of the carry (paper Figure 5).",
        lambda: pictures_cell.environment(geometry, data.initial),
    )
    yield ReportPicture(
        "fig06_arm",
        f"The arm {data.workcell.robots[0].name} as its collision shapes, and the reach of its pad "
        "(paper Figure 6).",
        lambda: pictures_cell.arm_and_reach(geometry, data.reach, data.initial),
    )
    if data.solved:
        yield from _search_pictures(data)
    yield ReportPicture(
        "infeasibility",
        "What made candidates infeasible: the constraint violated first, over all replicas, and "
        "where on the path.",
        lambda: pictures_fronts.infeasibility(data),
    )
    yield from _carry_pictures(data)


def _search_pictures(data: ReportData) -> Iterator[ReportPicture]:
    if len(data.objective_titles) >= 2:
        yield ReportPicture(
            "fig07_fronts",
            "Feasible candidates and non-dominated ones of each algorithm's run with the largest "
            "hypervolume (paper Figure 7). The cross is the level payload at rest.",
            lambda: pictures_fronts.fronts(data),
        )
    yield ReportPicture(
        "fig08_best_so_far",
        "Best feasible value of each objective so far, in the same runs; the inset enlarges the "
        "second half (paper Figure 8).",
        lambda: pictures_fronts.histories(data),
    )
    if len(data.objective_titles) == 2:
        yield ReportPicture(
            "attainment",
            "Empirical attainment surfaces: what a quarter, half and three quarters of the "
            "replicas reached or bettered.",
            lambda: pictures_fronts.attainment(data),
        )
    yield ReportPicture(
        "indicators",
        "Indicators of every replica, with medians and quartiles.",
        lambda: pictures_fronts.indicators(data),
    )
    if data.has_hybrid and len(data.objective_titles) >= 2:
        yield ReportPicture(
            "polish",
            "Fronts before and after the polish, and the hypervolume of every replica.",
            lambda: pictures_fronts.polish(data),
        )


def _carry_pictures(data: ReportData) -> Iterator[ReportPicture]:
    yield ReportPicture(
        "fig09_normal_forces",
        "Normal contact forces along the selected trajectories (paper Figure 9).",
        lambda: pictures_carry.normal_forces(data),
    )
    yield ReportPicture(
        "fig10_joint_torques",
        "Largest joint torque over its maximum: of the contact wrench alone, and with the arm's "
        "own weight and motion (paper Figure 10).",
        lambda: pictures_carry.joint_torques(data),
    )
    yield ReportPicture(
        "fig11_pressure_shift",
        "Shift of the centres of pressure that balances the moments, and the radius of the contact "
        "patch (paper Figure 11).",
        lambda: pictures_carry.pressure_shift(data),
    )
    yield ReportPicture(
        "residual_moments",
        "Moment that is missing with forces at the nominal contact points, and with the centres of "
        "pressure shifted.",
        lambda: pictures_carry.residual_moments(data),
    )
    yield ReportPicture(
        "fig12_payload",
        "Largest contact force of each robot against the payload's mass, for unchanged motion "
        "(paper Figure 12).",
        lambda: pictures_carry.payload(data),
    )
    yield ReportPicture(
        "fig13_paths",
        "Paths of the box centre (paper Figure 13).",
        lambda: pictures_cell.paths(
            data.geometry,
            tuple((carry, look.colour, look.line) for carry, look in pictures_carry.styled(data)),
        ),
    )
    for algorithm in data.solved:
        carry = algorithm.best
        assert carry is not None
        yield _motion(data, carry, f"motion_{algorithm.name}")
    if any(timed.force_curve is not None for _, timed in data.timings):
        yield ReportPicture(
            "duration_against_force",
            f"Drivable durations against the {data.force_kind.title}: single paths timed anew "
            "at every limit, and the members of the drivable fronts. All other limits hold "
            "throughout.",
            lambda: pictures_fronts.duration_against_force(data),
        )
    yield from _price_picture(data)
    if any(len(found.time) for found in data.simulations):
        yield ReportPicture(
            "simulated_forces",
            "Normal forces in the simulated cell, arms under force control, beside those that were "
            "predicted for how the carries were pressed there.",
            lambda: pictures_carry.simulated_forces(data),
        )


def _price_picture(data: ReportData) -> Iterator[ReportPicture]:
    choice = data.summary.recommendation
    if choice is not None and choice.price is not None:
        price = choice.price
        whose = (
            "the workcell's [uncertainty]" if price.uncertainty.stated else "the usual uncertainty"
        )
        yield ReportPicture(
            "robust_price",
            "The price of robustness: largest normal forces of the recommended carry that hold in "
            f"every case of {whose} ({price.uncertainty}), times a factor.",
            lambda: pictures_carry.robust_price(data, price),
        )


def _motion(data: ReportData, carry: DrawnCarry, name: str) -> ReportPicture:
    return ReportPicture(
        name,
        f"The trajectory selected from {carry.label} at 0, 33, 66 and 100 % of its duration (paper "
        "Figures 14 and 15).",
        lambda: pictures_cell.motion_sequence(data.geometry, carry),
    )
