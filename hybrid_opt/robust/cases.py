"""Cases of an uncertainty set: the worst ones, and random ones.

Which are worst follows from the least squeeze that a case asks for:

- it falls with friction, whose cones grow, so that both coefficients are at their least;
- it is proportional to the mass, which is at its largest;
- it is a convex function of the required force and moment, and these are affine in the centre of
  mass and in the disturbance, each for itself (`symbolic.contact.worst_cases`), so that it is
  largest at vertices of both ranges;
- a disc of radius r - e about the nominal pad lies within every disc of radius r displaced by at
  most e, so that a patch smaller by e stands for all displaced ones. This one is sufficient, not
  exact. A rectangle shrinks in proportion, so that its shorter side shrinks by e;
- soft fingers press about their displaced places. Displaced alike by e, both leave the centre of
  mass as much beside them. Displaced apart, they turn the squeeze into a moment, which a difference
  of their tangential forces of up to 2 e N / L each carries, L being their distance: a coefficient
  of friction that is lower by 2 e / L stands for it. Both at once are sufficient, not exact.
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
    case, off = nominal_case(workcell), uncertainty.pad_position
    case[0:2] *= 1.0 - uncertainty.friction
    case[4] *= 1.0 + uncertainty.mass
    centre = uncertainty.centre_of_mass
    if workcell.task.allocation == "soft-finger":
        case[0:2] -= off * friction_by_displacement(workcell)
        normal = workcell.contacts[0].T_box_pad[:3, 2]
        centre = centre + off * np.sqrt(np.maximum(1.0 - normal**2, 0.0))
    else:
        case[2:4] *= 1.0 - off / np.array(least_reaches(workcell))
    ranges = np.concatenate([centre, uncertainty.disturbance])
    corners = product(*[(-width, width) if width > 0.0 else (0.0,) for width in ranges])
    return np.array([case + np.concatenate([np.zeros(5), at, np.zeros(4)]) for at in corners])


def friction_by_displacement(workcell: Workcell) -> float:
    """What soft fingers lose of their coefficients of friction by being displaced apart [1/m]."""
    first, second = (contact.T_box_pad for contact in workcell.contacts)
    return 2.0 / abs(float((first[:3, 3] - second[:3, 3]) @ first[:3, 2]))


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
