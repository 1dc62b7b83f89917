"""Cases of an uncertainty set: the worst ones, random ones, and those that decide both robots'
forces.

Which are worst follows from the least squeeze that a case asks for:

- it falls with friction, whose cones grow, so that both coefficients are at their least;
- it is proportional to the mass, which is at its largest;
- it is a convex function of the required force and moment, and these are affine in the centre of
  mass and in the disturbance, each for itself (`symbolic.contact.worst_cases`), so that it is
  largest at vertices of both ranges;
- pads press evenly about their displaced places. Two with opposite normals, displaced
  alike by e, leave the centre of mass as much beside them. Displaced apart, they turn the squeeze
  into a moment, which a difference of their tangential forces of up to 2 e N / L each carries, L
  being their distance: a coefficient of friction that is lower by 2 e / L stands for it. Both at
  once suffice within 0.3 % of the force. What the arms' places are off one another adds to 2 e.
  Of pads anywhere the corners of squares about the discs of displacements are taken; that nothing
  between them is worse is true to first order in e, and what random cases check;
- a pad that is tilted by t against its face presses along its own axis: the cone about that axis
  which lies within the face's own has the coefficient tan(atan mu - t), exact in the worst
  direction;
- the force that is commanded grows with the share of it that may be missing, and with the opposed
  force (`symbolic.contact.worst_cases`).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from symbolic.array import Array
from symbolic.contact.registry import command_model
from symbolic.records import Uncertainty, Workcell

LEADER, FOLLOWER = 0, 1
"""The arm that keeps its place, and the other, whose force is commanded."""


def nominal_case(workcell: Workcell) -> Array:
    """Return the nominal case (18,) of the workcell, laid out by `worst_cases.CASE_SIZES`."""
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


def worst_cases(workcell: Workcell, uncertainty: Uncertainty, leader: int = 0) -> Array:
    """Return the cases (k, 18) that require as much squeeze as any within the ranges, or slightly
    more.

    Args:
        leader: index of the robot whose force is not commanded.
    """
    case = nominal_case(workcell)
    case[0:2] = command_model(workcell).least_friction(uncertainty)
    case[4] *= 1.0 + uncertainty.mass
    case[16 - leader] = uncertainty.tracking
    case[17] = uncertainty.opposed_force
    centre, places = command_model(workcell).worst_displacements(uncertainty)
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
    """Draw cases (n, 18) uniformly from the ranges, pads from discs."""
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
    """Draw points (n, discs, 2) uniformly from discs of a radius [m]."""
    angle = rng.uniform(0.0, 2.0 * np.pi, (n, discs))
    reach = radius * np.sqrt(rng.random((n, discs)))
    return np.stack([reach * np.cos(angle), reach * np.sin(angle)], axis=2)


@dataclass(frozen=True)
class RulingCases:
    """The worst cases that decide the forces; n samples.

    Attributes:
        leader: index of the arm that keeps its place.
        force: (n, 2) what is commanded of the force-controlled arm, and the largest that the other
            feels [N].
        commanded: (n,) the case that decides the first.
        felt: (n,) the case in which the leading arm feels most beyond it.
        share: (n,) of the difference of both forces there that it feels.
        leading_share: rise of the leading arm's force per newton of the commanded one.
    """

    leader: int
    force: Array
    commanded: NDArray[np.intp]
    felt: NDArray[np.intp]
    share: Array
    leading_share: float

    def at(self, rows: NDArray[np.intp]) -> RulingCases:
        """Return the cases at some of the samples."""
        cases = self.commanded[rows], self.felt[rows]
        found = self.force[rows], *cases, self.share[rows]
        return RulingCases(self.leader, *found, self.leading_share)

    def slopes(self, commanded: Array, felt: Array) -> Array:
        """Compute the derivatives (n, 2, m) of `force` from those of both robots' forces (n, 2, m)
        in the cases `commanded` and `felt`."""
        follower, share = 1 - self.leader, self.leading_share
        found = np.empty_like(commanded)
        found[:, follower] = commanded[:, follower]
        step = felt[:, self.leader] - share * felt[:, follower]
        found[:, self.leader] = share * commanded[:, follower] + self.share[:, None] * step
        return found


def felt_share(difference: Array, uncertainty: Uncertainty) -> Array:
    """Compute the largest share that the leading arm feels of the differences between leading and
    commanded force under the largest mass: all of a difference that loads it, the least mass's
    share of one that relieves it."""
    lightest = (1.0 - uncertainty.mass) / (1.0 + uncertainty.mass)
    return np.where(difference > 0.0, 1.0, lightest)


def ruling_cases(
    worst: Array,
    uncertainty: Uncertainty,
    leader: int,
    difference: Array | None = None,
    leading_share: float = 1.0,
) -> RulingCases:
    """Find the cases that decide among the least normal forces (k, n, 2) [N] of the worst ones.

    The difference of both forces is the motion's, whatever the squeeze, and proportional to the
    mass.

    Args:
        difference: (k, n) leading less commanded force [N], where `worst` does not tell all.
        leading_share: what the leading arm presses more for each newton more that is commanded.
    """
    follower, every = 1 - leader, np.arange(worst.shape[1])
    if difference is None:
        difference = worst[:, :, leader] - leading_share * worst[:, :, follower]
    share = felt_share(difference, uncertainty)
    commanded = worst[:, :, follower].argmax(axis=0)
    felt = (share * difference).argmax(axis=0)
    force = np.empty(worst.shape[1:])
    force[:, follower] = worst[commanded, every, follower]
    force[:, leader] = leading_share * force[:, follower] + (share * difference)[felt, every]
    return RulingCases(leader, force, commanded, felt, share[felt, every], leading_share)
