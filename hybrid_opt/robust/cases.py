"""Cases of an uncertainty set: the worst ones, and random ones.

Which are worst follows from the least squeeze that a case asks for:

- it falls with friction, whose cones grow, so that both coefficients are at their least;
- it is proportional to the mass, which is at its largest;
- it is a convex function of the required force and moment, and these are affine in the centre of
  mass and in the disturbance, each for itself (`symbolic.contact.worst_cases`), so that it is
  largest at vertices of both ranges;
- a disc of radius r - e about the nominal pad lies within every disc of radius r displaced by at
  most e, so that a patch smaller by e stands for all displaced ones. This one is sufficient, not
  exact. A rectangle shrinks in proportion, so that its shorter side shrinks by e.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from symbolic.array import Array
from symbolic.contact.worst_cases import least_reaches
from symbolic.records import Uncertainty, Workcell


def nominal_case(workcell: Workcell) -> Array:
    """(15,) the case that the workcell describes, laid out by `worst_cases.CASE_SIZES`."""
    contacts, payload = workcell.contacts, workcell.payload
    return np.concatenate(
        [
            [contact.friction for contact in contacts],
            [contact.patch_radius for contact in contacts],
            [payload.mass],
            payload.centre_of_mass,
            np.zeros(7),
        ]
    )


def worst_cases(workcell: Workcell, uncertainty: Uncertainty) -> Array:
    """(k, 15) cases that ask for as much squeeze as any within the ranges, or a little more."""
    case = nominal_case(workcell)
    case[0:2] *= 1.0 - uncertainty.friction
    case[2:4] *= 1.0 - uncertainty.pad_position / np.array(least_reaches(workcell))
    case[4] *= 1.0 + uncertainty.mass
    ranges = np.concatenate([uncertainty.centre_of_mass, uncertainty.disturbance])
    corners = product(*[(-width, width) if width > 0.0 else (0.0,) for width in ranges])
    return np.array([case + np.concatenate([np.zeros(5), at, np.zeros(4)]) for at in corners])


def random_cases(
    workcell: Workcell, uncertainty: Uncertainty, n: int, rng: np.random.Generator
) -> Array:
    """(n, 15) cases drawn evenly from the ranges, pads from discs."""
    cases = np.tile(nominal_case(workcell), (n, 1))
    cases[:, 0:2] *= 1.0 + uncertainty.friction * rng.uniform(-1.0, 1.0, (n, 2))
    cases[:, 4] *= 1.0 + uncertainty.mass * rng.uniform(-1.0, 1.0, n)
    cases[:, 5:8] += uncertainty.centre_of_mass * rng.uniform(-1.0, 1.0, (n, 3))
    cases[:, 8:11] = uncertainty.disturbance * rng.uniform(-1.0, 1.0, (n, 3))
    angle = rng.uniform(0.0, 2.0 * np.pi, (n, 2))
    reach = uncertainty.pad_position * np.sqrt(rng.random((n, 2)))
    displaced = np.stack([reach * np.cos(angle), reach * np.sin(angle)], axis=2)
    cases[:, 11:15] = displaced.reshape(n, 4)
    return cases
