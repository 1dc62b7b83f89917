"""Cases of a cell's uncertainty for simulated hands: random ones, and the worst of the model."""

from __future__ import annotations

from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from hybrid_opt.carry import Carry, motion_inputs
from hybrid_opt.extras.simulation.box import (
    CarriageMotion,
    Threshold,
    bisected,
    workcell_of_case,
)
from hybrid_opt.extras.simulation.hand_bodies import ArmStiffness
from hybrid_opt.extras.simulation.hands import HandOutcome, HandSimulation
from hybrid_opt.extras.simulation.scene import SimulationSettings
from hybrid_opt.robust.cases import LEADER, random_cases
from hybrid_opt.robust.force import RobustModel, subsample
from symbolic.array import Array
from symbolic.contact.holding_hands import HoldingHands, internal_force_wrenches, yielded
from symbolic.contact.worst_cases import case_origin_load_function
from symbolic.records import Workcell

PUSH_DIRECTIONS = 1000
"""Number of directions in which the arms are tried to push against each other."""

LOW_SHARE, HIGH_SHARE = 0.25, 1.25
"""Multiples of the commanded forces with which hands lose the payload in the worst case, and hold
it."""

SHARE_BISECTIONS = 8
"""Number of bisections between them, to 0.4 %."""

ARM_REACH = 0.5
"""Root of the ratio of an arm's angular stiffness to its linear one [m], if only the latter is
known: both come from joints about so far from the hands (assumed)."""


@dataclass(frozen=True)
class HandCase:
    """One case of a cell's uncertainty.

    Attributes:
        workcell: cell with the payload, friction and hands of the case.
        disturbance: (3,) acceleration beside the motion's, world frame [m/s^2].
        opposed: (3,) force of the second arm's hands on the payload with which the arms work
            against each other, box frame [N].
        left: share of the holding force that is not missing.
        turned: (3,) rotation of the second arm, box frame [rad].
    """

    workcell: Workcell
    disturbance: Array
    opposed: Array
    left: float
    turned: Array = field(default_factory=lambda: np.zeros(3))

    @classmethod
    def of(cls, workcell: Workcell, case: Array, direction: Array, turned: Array) -> HandCase:
        """Build a case from a row of values of the uncertain quantities.

        Args:
            workcell: the nominal cell.
            case: (18,) values in the order of `symbolic.contact.worst_cases.CASE_SIZES`.
            direction: (3,) unit vector along which the arms work against each other, box frame.
            turned: (3,) rotation of the second arm, box frame [rad].
        """
        left, opposed = 1.0 - float(case[15:17].max()), case[17] * direction
        return cls(workcell_of_case(workcell, case), case[8:11], opposed, left, turned)

    def simulate(
        self, motion: CarriageMotion, holding: Array, factor: float, settings: SimulationSettings
    ) -> HandOutcome:
        """Simulate a carry in this case.

        Args:
            motion: motion of the carriage, the body that bears all hands.
            holding: (2,) nominal holding force of each robot's hands [N]. In this case only the
                share `left` of it acts.
            factor: further number by which the holding forces are multiplied.
            settings: settings of the simulation.
        """
        stiffness = self.workcell.uncertainty.stiffness
        arms = ArmStiffness(stiffness, stiffness * ARM_REACH**2) if stiffness else None
        simulation = HandSimulation(
            self.workcell, settings, self.disturbance, self.opposed, self.turned, arms
        )
        return simulation.simulate(motion, self.left * holding, factor)


def random_hand_cases(workcell: Workcell, n: int, rng: np.random.Generator) -> list[HandCase]:
    """Draw n random cases of a cell's uncertainty. The directions of the force between the arms and
    of the rotation axis are uniformly distributed.

    Args:
        workcell: the cell.
        n: number of cases.
        rng: random generator.
    """
    doubt, found = workcell.uncertainty, list[HandCase]()
    for case in random_cases(workcell, doubt, n, rng):
        along, about = (way / np.linalg.norm(way) for way in rng.normal(size=(2, 3)))
        turned = doubt.relative_angle * rng.random() * about
        found.append(HandCase.of(workcell, case, along, turned))
    return found


def worst_hand_case(carry: Carry, model: RobustModel) -> HandCase:
    """Return the case of a cell's uncertainty in which its contact model needs the largest holding
    force along a carry.

    The arms push against each other in the direction that raises the needed force of a hand most,
    at the sample with the largest needed force.

    Args:
        carry: the carry.
        model: computes the holding forces that are needed in the cases of the cell's uncertainty.
    """
    workcell = carry.workcell
    cases, motion = model.worst_cases(workcell.uncertainty, LEADER), subsample(carry)[1]
    needed = model.least_squeeze(motion, cases, LEADER).max(axis=2)
    which, at = np.unravel_index(needed.argmax(), needed.shape)
    case = cases[which]
    states = (values[at] for values in motion_inputs(motion))
    load = np.array(case_origin_load_function(workcell)(*states, case)).ravel()
    directions = _directions(PUSH_DIRECTIONS)
    share = _needed_share(workcell, case, load, directions)
    return HandCase.of(workcell, case, directions[share.argmax()], np.zeros(3))


def hand_case_threshold(
    case: HandCase, motion: CarriageMotion, holding: Array, settings: SimulationSettings
) -> Threshold[HandOutcome]:
    """Find the least multiple of holding forces that holds the payload in a case.

    Args:
        case: the case.
        motion: motion of the carriage.
        holding: (2,) holding force of each robot's hands [N].
        settings: settings of the simulation.

    Raises:
        SimulationError: the payload slips or lifts at `HIGH_SHARE`, or it holds at `LOW_SHARE`.
    """
    return bisected(
        lambda factor: case.simulate(motion, holding, factor, settings),
        LOW_SHARE,
        HIGH_SHARE,
        SHARE_BISECTIONS,
    )


def _needed_share(workcell: Workcell, case: Array, load: Array, directions: Array) -> Array:
    """Compute the largest ratio (n,) of needed to available holding force over all hands in a case,
    for each of n directions in which the arms work against each other.

    Args:
        workcell: the cell.
        case: (18,) values in the order of `symbolic.contact.worst_cases.CASE_SIZES`.
        load: (6,) force and moment on the hands about the box frame, box axes [N, N m].
        directions: (n, 3) unit vectors of the force of the second arm on the payload, box frame.
    """
    pads, robots = workcell.pads, workcell.pad_robots
    hands = HoldingHands(workcell).sharing(ca.DM(case[:2]))
    wrenches, pushes = yielded(ca.DM(load), hands), internal_force_wrenches(pads, robots)
    found = np.zeros(len(directions))
    for pad, robot, hand, own, push in zip(pads, robots, hands, wrenches, pushes, strict=True):
        # The second arm's hands push along the direction, the first arm's against it.
        opposed = float(case[17]) * (2 * robot - 1) * push @ directions.T
        wrench = ca.SX.sym("wrench", 6)
        needed = ca.Function("needed", [wrench], [ca.fmax(*hand.needs(wrench))])
        each = np.array(needed(np.array(own) + opposed)).ravel()
        found = np.maximum(found, each / pad.holding_force)
    return found


def _directions(n: int) -> Array:
    """Return n unit vectors (n, 3) that are spread evenly, on a spiral of the golden angle."""
    height = (2.0 * np.arange(n) + 1.0) / n - 1.0
    angle = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(n)
    level = np.sqrt(1.0 - height**2)
    return np.column_stack([level * np.cos(angle), level * np.sin(angle), height])
