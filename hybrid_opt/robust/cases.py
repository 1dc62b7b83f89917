"""Cases of an uncertainty: the worst cases, random cases, and the cases that decide the forces.

A case is one set of true values of friction, mass and the other uncertain quantities. The worst
cases follow from the least squeeze that holds a case:

- The least squeeze falls with friction, because the friction cones grow. So both friction
  coefficients are least.
- It is proportional to the mass. So the mass is largest.
- It is convex in the required force and moment. These are affine in the centre of mass and in the
  disturbance separately (`symbolic.contact.worst_cases`). So it is largest at vertices of both
  ranges.
- If two pads with opposite normals are both displaced by e [m], the centre of mass shifts by e
  relative to them. Pads displaced in opposite directions turn the squeeze N [N] into a moment. A
  difference of the tangential forces of up to 2 e N / L each balances this moment, L being the
  distance of the pads [m]. A coefficient of friction that is lower by 2 e / L covers it. To apply
  the shift and the lower friction at once costs at most 0.3 % of the force. The error of the arms'
  relative pose adds to 2 e.
- For pads with any normals the corners of squares around the discs of displacements are used. To
  first order in e no displacement between them is worse; random cases check the rest.
- A pad tilted by an angle t against its face presses along its own axis. The cone about that axis
  within the face's friction cone has the coefficient tan(atan mu - t), with mu the friction
  coefficient; it is exact in the worst direction.
- The commanded force grows with the share of it that may be missing, and with the tangential force
  between the arms, called opposed force (`symbolic.contact.worst_cases`).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from symbolic.array import Array
from symbolic.contact.model import ContactModel
from symbolic.records import Uncertainty, Workcell

LEADER, FOLLOWER = 0, 1
"""Indices of the arm that keeps its place, and of the arm whose force is commanded."""


def nominal_case(workcell: Workcell) -> Array:
    """Return the nominal case (18,) of the workcell: friction, patches and payload as described,
    nothing displaced or disturbed.

    The entries are laid out by `symbolic.contact.worst_cases.CASE_SIZES`.
    """
    contacts, payload = workcell.contacts, workcell.payload
    return np.concatenate(
        [
            [contact.friction for contact in contacts],
            [contact.patch_radius for contact in contacts],
            [payload.mass],
            payload.centre_of_mass,
            np.zeros(10),
        ]
    )


def worst_cases(contact: ContactModel, uncertainty: Uncertainty, leader: int = 0) -> Array:
    """Return the worst cases (k, 18) of an uncertainty.

    A squeeze (pair of opposite normal forces) that holds the box in all of these cases holds it in
    every case within the ranges. Each row states friction, mass and the other uncertain quantities,
    in the order of `symbolic.contact.worst_cases.CASE_SIZES`.

    Args:
        contact: contact model of the workcell's commanded forces.
        uncertainty: ranges of the uncertain quantities.
        leader: index of the position-controlled robot, whose force is not commanded.
    """
    case = nominal_case(contact.workcell)
    case[0:2] = contact.least_friction(uncertainty)
    case[4] *= 1.0 + uncertainty.mass
    case[16 - leader] = uncertainty.tracking
    case[17] = uncertainty.opposed_force
    centre, places = contact.worst_displacements(uncertainty)
    ranges = np.concatenate([centre, uncertainty.disturbance])
    corners = product(*[(-width, width) if width > 0.0 else (0.0,) for width in ranges])
    return np.array(
        [
            case + np.concatenate([np.zeros(5), at, place, np.zeros(3)])
            for at in corners
            for place in places
        ]
    )


def random_cases(
    workcell: Workcell, uncertainty: Uncertainty, n: int, rng: np.random.Generator, leader: int = 0
) -> Array:
    """Draw n random cases (n, 18) of an uncertainty.

    Quantities are uniformly distributed in their ranges; displacements of pads are uniformly
    distributed in discs on the faces.

    Args:
        workcell: the cell with the nominal values.
        uncertainty: ranges of the uncertain quantities.
        n: number of cases.
        rng: random generator.
        leader: index of the position-controlled robot, whose force is not commanded.
    """
    cases = np.tile(nominal_case(workcell), (n, 1))
    cases[:, 0:2] *= 1.0 + uncertainty.friction * rng.uniform(-1.0, 1.0, (n, 2))
    cases[:, 4] *= 1.0 + uncertainty.mass * rng.uniform(-1.0, 1.0, n)
    cases[:, 5:8] += uncertainty.centre_of_mass * rng.uniform(-1.0, 1.0, (n, 3))
    cases[:, 8:11] = uncertainty.disturbance * rng.uniform(-1.0, 1.0, (n, 3))
    cases[:, 11:15] = _in_discs(rng, uncertainty.pad_position, n, 2).reshape(n, 4)
    turned = uncertainty.turned * rng.random((n, 2))
    cases[:, 0:2] = np.tan(np.arctan(cases[:, 0:2]) - turned)
    apart = _in_discs(rng, uncertainty.apart / 2.0, n, 1)[:, 0]
    cases[:, 11:15] += np.hstack([apart, -apart])
    cases[:, 16 - leader] = uncertainty.tracking * rng.random(n)
    cases[:, 17] = uncertainty.opposed_force * rng.random(n)
    return cases


def _in_discs(rng: np.random.Generator, radius: float, n: int, discs: int) -> Array:
    """Draw points (n, discs, 2) [m], uniformly distributed in discs about the origin.

    Args:
        rng: random generator.
        radius: radius of the discs [m].
        n: number of draws.
        discs: number of discs, with one point each per draw.
    """
    angle = rng.uniform(0.0, 2.0 * np.pi, (n, discs))
    reach = radius * np.sqrt(rng.random((n, discs)))
    return np.stack([reach * np.cos(angle), reach * np.sin(angle)], axis=2)


@dataclass(frozen=True)
class GoverningCases:
    """Worst cases that decide the normal forces at n samples of a motion.

    Cases are indices of rows of `worst_cases`. One arm is position controlled, the other arm is
    force controlled.

    Attributes:
        leader: index of the position-controlled arm.
        force: (n, 2) normal force of each robot [N]: the commanded force of the force-controlled
            arm, and the largest force of the position-controlled arm that results from it in any
            case.
        commanded: (n,) index of the case that needs the largest commanded force.
        leading: (n,) index of the case in which the position-controlled arm's force exceeds the
            commanded force most.
        share: (n,) share of this excess that acts on the position-controlled arm, see
            `transmitted_share`.
        leading_share: rise of the position-controlled arm's force per newton of commanded force.
    """

    leader: int
    force: Array
    commanded: NDArray[np.intp]
    leading: NDArray[np.intp]
    share: Array
    leading_share: float

    def at(self, rows: NDArray[np.intp]) -> GoverningCases:
        """Return the cases that decide the forces at some of the samples.

        Args:
            rows: (m,) indices of the samples.
        """
        cases = self.commanded[rows], self.leading[rows]
        found = self.force[rows], *cases, self.share[rows]
        return GoverningCases(self.leader, *found, self.leading_share)

    def slopes(self, commanded: Array, leading: Array) -> Array:
        """Compute the derivatives (n, 2, m) of `force` with respect to m inputs, such as the box
        pose.

        Args:
            commanded: (n, 2, m) derivatives of both robots' least forces at each sample, in the
                case whose index is `self.commanded`.
            leading: (n, 2, m) the same derivatives in the case whose index is `self.leading`.
        """
        follower, share = 1 - self.leader, self.leading_share
        found = np.empty_like(commanded)
        found[:, follower] = commanded[:, follower]
        step = leading[:, self.leader] - share * leading[:, follower]
        found[:, self.leader] = share * commanded[:, follower] + self.share[:, None] * step
        return found


def transmitted_share(difference: Array, uncertainty: Uncertainty) -> Array:
    """Compute the factor on a difference of both arms' normal forces, stated for the largest
    payload mass, that gives it for the mass that loads the position-controlled arm most.

    The difference is proportional to the mass. Where it is positive, the largest mass loads the arm
    most, and the factor is 1. Where it is negative, the least mass does, and the factor is (1 - s)
    / (1 + s) with the relative uncertainty s of the mass.

    Args:
        difference: force of the position-controlled arm minus the commanded force of the other arm,
            for the largest mass [N], of any shape.
        uncertainty: ranges of the uncertain quantities.

    Returns:
        Factor between 0 and 1, in the shape of `difference`.
    """
    lightest = (1.0 - uncertainty.mass) / (1.0 + uncertainty.mass)
    return np.where(difference > 0.0, 1.0, lightest)


def governing_cases(
    worst: Array,
    uncertainty: Uncertainty,
    leader: int,
    difference: Array | None = None,
    leading_share: float = 1.0,
) -> GoverningCases:
    """Find for each of n samples the two worst cases that decide the normal forces.

    - The case with the largest commanded force.
    - The case that adds most to the position-controlled arm's force. This force is `leading_share`
      times the commanded force plus a difference, which the motion and the case determine. The
      difference is proportional to the mass and does not depend on the squeeze.

    Args:
        worst: (k, n, 2) least normal forces of both robots in k cases at n samples [N].
        uncertainty: ranges of the uncertain quantities.
        leader: index of the position-controlled arm.
        difference: (k, n) the difference [N]; None to compute it from `worst`.
        leading_share: rise of the position-controlled arm's force per newton of commanded force.
    """
    follower, every = 1 - leader, np.arange(worst.shape[1])
    if difference is None:
        difference = worst[:, :, leader] - leading_share * worst[:, :, follower]
    share = transmitted_share(difference, uncertainty)
    commanded = worst[:, :, follower].argmax(axis=0)
    leading = (share * difference).argmax(axis=0)
    force = np.empty(worst.shape[1:])
    force[:, follower] = worst[commanded, every, follower]
    force[:, leader] = leading_share * force[:, follower] + (share * difference)[leading, every]
    return GoverningCases(leader, force, commanded, leading, share[leading, every], leading_share)
