"""Force closure: whether pads with any normals can hold a payload under every motion.

They can if an internal squeeze exists that lies strictly within every patch's cone: enough squeeze
then balances any load (Bicchi and Kumar, Robotic grasping and contact: a review, ICRA 2000).

Pads press evenly (`symbolic.contact.soft_finger`), so the only moment of a pad is torsion about its
normal. The state of a pad, along its axes with z into the payload, is N, T / mu and M / (mu r):
normal force N, tangential force T (2,), moment M about the normal through the patch's centre, and r
the patch's radius or half diagonal.

`derive_grasp_numbers` computes the constants in the formulas of such pads: the initial squeeze, and
the maps that balance a load.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from symbolic.array import Array
from symbolic.contact.soft_finger import SoftPatch, torsion_capacity
from symbolic.errors import SettingsError
from symbolic.records import Contact, Workcell
from symbolic.records.numbered import GraspNumbers
from symbolic.records.poses import box_rotation, skew
from symbolic.records.quantities import GRAVITY

WRENCH_SIZE = 6
"""Number of entries of a pad's wrench: N, T (2,) [N], the first moment of the pressure (2,) and M
[N m]."""

EVEN = (0, 1, 2, 5)
"""Indices of the entries of a wrench that a patch under even pressure can bear. They form its
state."""

TANGENTIAL = (1, 2, 3)
"""Indices of the entries of a state that friction bears."""

DIRECTIONS, TORSIONS = 24, 4
"""Number of directions of friction, and of shares of torsion in each direction, with which a
patch's cone is sampled."""

CLOSURE_NEWTON_STEPS = 100
BALANCED = 1e-6
"""Newton decrement at which the search for weights ends. A projection then removes the residual
load."""

LEAST_SQUEEZE_SHARE = 0.05
"""Least share of the friction for which a squeeze is sought."""

SQUEEZE_BISECTIONS = 6

PARALLEL = 1.0 - 1e-6
"""Two normals count as equal if the cosine of the angle between them exceeds this."""

SPARE_FRICTION = 0.95
"""Share of their friction with which pads have to close their grasp."""

LOAD_SIZE = 6
"""Number of entries of a load: force and moment about the box frame's origin, along the box's axes
[N, N m]."""

MOMENT_ARM = 0.1
"""Lever that converts moments to forces in the scale of a load [m]: about half a payload."""

LEAST_NEW = 0.1
"""A component is selected if this share of its effect lies outside the span of the components
selected before."""


@dataclass(frozen=True)
class InternalForce:
    """Internal squeeze of a grasp: pad forces within the friction cones that balance one another.

    Attributes:
        states: for each pad its scaled state (4,) at the nominal friction; the normal forces of all
            pads sum to one.
        least_share: least share of the nominal friction coefficients with which an internal squeeze
            exists, at least `LEAST_SQUEEZE_SHARE`.
    """

    states: tuple[Array, ...]
    least_share: float


def closing_squeeze(workcell: Workcell) -> InternalForce | None:
    """Find an internal squeeze of a workcell's pads: pad forces inside the friction cones that
    balance one another.

    The squeeze lies inside the cones with a margin: it is computed with friction coefficients times
    a factor, the geometric mean of `SPARE_FRICTION` and of the smallest factor with which a squeeze
    exists.

    Returns:
        The squeeze; None if there is none with the factor `SPARE_FRICTION`.
    """
    if _balanced_states(workcell, SPARE_FRICTION) is None:
        return None
    low, high = LEAST_SQUEEZE_SHARE, SPARE_FRICTION
    if _balanced_states(workcell, low) is not None:
        high = low
    else:
        for _ in range(SQUEEZE_BISECTIONS):
            middle = float(np.sqrt(low * high))
            if _balanced_states(workcell, middle) is None:
                low = middle
            else:
                high = middle
    states = _balanced_states(workcell, float(np.sqrt(high * SPARE_FRICTION)))
    assert states is not None
    return InternalForce(states, high)


def has_force_closure(workcell: Workcell) -> bool:
    """Return True if a workcell's pads can hold the payload under every motion, provided they press
    strongly enough. Friction coefficients are reduced by the factor `SPARE_FRICTION` for this test.
    """
    return _balanced_states(workcell, SPARE_FRICTION) is not None


def equal_pressure_rows(workcell: Workcell) -> Array:
    """Return a matrix (k, pads) that states which pads press with equal pressure: its product with
    the pads' normal forces is zero if they do.

    Pads of one arm with the same normal have to press with equal pressure, because the arm keeps
    the orientation of their common plane. Each of the k rows compares two of them. Pads with
    different normals have no row: they press as the motion requires.
    """
    pads, robots, rows = workcell.pads, workcell.pad_robots, []
    for k in range(1, len(pads)):
        first = robots.index(robots[k])
        normals = [pads[i].T_box_pad[:3, 2] for i in (first, k)]
        if first != k and normals[0] @ normals[1] > PARALLEL:
            row = np.zeros(len(pads))
            row[first], row[k] = 1.0, -pads[first].area / pads[k].area
            rows.append(row)
    return np.array(rows).reshape(-1, len(pads))


def balance_maps(workcell: Workcell, in_units: bool = False) -> list[Array]:
    """Return one matrix (6 + k, 4) per pad that maps the pad's state to its terms in the equations
    of balance.

    The first six rows give the pad's force and moment about the box frame's origin, along the box's
    axes. The other k rows give its terms in the k conditions of `equal_pressure_rows`.

    Args:
        workcell: cell with the pads.
        in_units: True for states of normal force, tangential force (2,) [N] and torsion [N m];
            False for states scaled by friction and patch radius.
    """
    alike, found = equal_pressure_rows(workcell), []
    for i, pad in enumerate(workcell.pads):
        if in_units:
            pad = replace(pad, friction=1.0, patch_radius=1.0, half_sides=None)
        to_box = state_to_box(pad)
        rows = np.zeros((len(alike), to_box.shape[1]))
        rows[:, 0] = alike[:, i]
        found.append(np.vstack([to_box, rows]))
    return found


def _balanced_states(workcell: Workcell, share: float) -> tuple[Array, ...] | None:
    """Find a scaled state (4,) of each of a workcell's pads such that the wrenches of all pads sum
    to zero; None if there are no such states.

    Each state lies within the pad's friction cone for `share` times the friction coefficient.
    """
    maps = balance_maps(workcell)
    lessened = [_with_friction(_generators(pad), share) for pad in workcell.pads]
    columns = np.vstack([rows @ A.T for rows, A in zip(lessened, maps, strict=True)])
    weights = _weights(columns / np.abs(columns).max(axis=0))
    if weights is None:
        return None
    ends = np.cumsum([len(rows) for rows in lessened])[:-1]
    parts = np.split(weights, ends)
    stacked = np.concatenate([part @ rows for part, rows in zip(parts, lessened, strict=True)])
    whole = np.hstack(maps)
    stacked -= np.linalg.pinv(whole) @ (whole @ stacked)
    return tuple(np.split(stacked, np.cumsum([A.shape[1] for A in maps])[:-1]))


def _weights(columns: Array) -> Array | None:
    """Find n positive weights with sum one, such that the weighted sum of n vectors is zero; None
    if there are none.

    Such weights exist exactly if the polytope of all y with 1 + a_j . y > 0, for every vector a_j,
    has an analytic centre. At the centre they are proportional to 1 / (1 + a_j . y).

    Args:
        columns: (n, m) the vectors a_j as rows.
    """
    if np.linalg.matrix_rank(columns) < columns.shape[1]:
        return None
    y = np.zeros(columns.shape[1])
    for _ in range(CLOSURE_NEWTON_STEPS):
        weights = 1.0 / (1.0 + columns @ y)
        scaled = weights[:, None] * columns
        gradient = -scaled.sum(axis=0)
        step = -np.linalg.lstsq(scaled.T @ scaled, gradient, rcond=None)[0]
        decrement = float(np.sqrt(max(-gradient @ step, 0.0)))
        if decrement < BALANCED:
            return np.asarray(weights / weights.sum())
        y = y + step / (1.0 + decrement)  # which stays within the polytope
    return None


def state_to_box(contact: Contact) -> Array:
    """Return the matrix (6, 4) that maps a pad's scaled state to force [N] and moment [N m] about
    the box frame's origin, along the box's axes.

    The state holds the normal force, the tangential force (2,) over the friction coefficient, and
    the torsion over friction coefficient times patch radius [N].
    """
    mu, r = contact.friction, contact.patch_radius
    local = np.zeros((WRENCH_SIZE, WRENCH_SIZE))
    local[[0, 1, 2], [1, 2, 0]] = mu, mu, 1.0
    # A normal force N n at d turns about d x n = (d_y, -d_x).
    local[[3, 4, 5], [4, 3, 5]] = r, -r, mu * r
    return np.asarray(wrench_to_box(contact) @ local[:, list(EVEN)])


def wrench_to_box(contact: Contact) -> Array:
    """Return the matrix (6, 6) that maps a wrench about a pad's origin, along the pad's axes, to
    the wrench about the box frame's origin, along the box's axes."""
    R, p = contact.T_box_pad[:3, :3], contact.T_box_pad[:3, 3]
    return np.block([[R, np.zeros((3, 3))], [skew(p) @ R, R]])


def _with_friction(states: Array, share: float) -> Array:
    lessened = states.copy()
    lessened[:, list(TANGENTIAL)] *= share
    return lessened


def scaled_patch(contact: Contact) -> SoftPatch:
    """Return the patch of a contact with all lengths divided by the patch radius, along the pad's
    axes. Discs of all sizes give equal results."""
    if contact.half_sides is None:
        return SoftPatch(2.0 / 3.0, np.eye(2))
    own = SoftPatch.of(contact, contact.T_box_pad[:3, :3])
    return SoftPatch(own.twist / contact.patch_radius, own.spread / contact.patch_radius)


def _generators(contact: Contact) -> Array:
    """Return n scaled states (n, 4) on the boundary of a patch's friction cone, all with normal
    force 1. Their sums with positive weights fill nearly the whole cone."""
    patch, rows = scaled_patch(contact), []
    for angle in 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS:
        for share in np.linspace(0.0, 1.0, TORSIONS + 1)[:-1]:
            tangent = share * np.array([np.cos(angle), np.sin(angle)])
            grip = ca.DM(np.sqrt(1.0 - share**2))
            torsion = float(torsion_capacity(grip, ca.DM(tangent), patch)[0])
            rows += [[1.0, *tangent, sign * torsion] for sign in (1.0, -1.0)]
    return np.array(rows)


# --- constants of a grasp's formulas ---


def dependent_components(workcell: Workcell) -> tuple[int, ...]:
    """Select the components of all pads' states that follow from the load and from the other
    components. Return their indices in the array of all states, one pad after the other.

    The choice takes forces before moments, in the order of the pads, until the selected components
    can balance every load. It depends on neither friction nor sizes, and small displacements of the
    pads do not change it.
    """
    effects = np.hstack(balance_maps(workcell, in_units=True)).astype(float)
    effects[3:LOAD_SIZE] /= MOMENT_ARM
    effects /= np.linalg.norm(effects, axis=0)
    moments = np.arange(effects.shape[1]) % len(EVEN) == len(EVEN) - 1
    order, least = np.argsort(moments, kind="stable").tolist(), LEAST_NEW
    while len(taken := _new_columns(effects, order, least)) < len(effects) and least > 1e-9:
        least *= 0.1
    return tuple(sorted(taken))


def _new_columns(matrix: Array, order: Sequence[int], least: float) -> list[int]:
    """Select linearly independent columns of a matrix, and return their indices in the order of
    selection.

    Args:
        matrix: the matrix.
        order: indices of its columns in the order of trial.
        least: a column is selected if its part outside the span of those selected before is longer.
    """
    taken: list[int] = []
    span = np.zeros((len(matrix), 0))
    for k in order:
        beyond = matrix[:, k] - span @ (span.T @ matrix[:, k])
        length = np.linalg.norm(beyond)
        if length > least and len(taken) < len(matrix):
            taken.append(k)
            span = np.column_stack([span, beyond / length])
    return taken


def derive_grasp_numbers(workcell: Workcell, reach: float = 1.0) -> GraspNumbers:
    """Compute the matrices and the internal squeeze of a grasp by pads. The fields `rest` and
    `rest_slopes`, which describe the box at rest, stay None.

    Args:
        workcell: cell with the pads.
        reach: factor, at most 1, on the sizes of the patches for which the internal squeeze is
            computed. With a smaller factor the squeeze leaves the patches more torsion in reserve.

    Raises:
        SettingsError: no internal squeeze exists.
    """
    left = np.array(dependent_components(workcell))
    cell = workcell if reach == 1.0 else smaller_patches(workcell, reach)
    squeeze = closing_squeeze(cell)
    if squeeze is None:
        raise SettingsError(
            "the pads do not close their grasp: no internal squeeze lies within their friction "
            "cones; raise the friction or turn them towards one another",
            code="no-grasp",
        )
    # The least-norm states that balance a load, inside the cones or not.
    whole, in_units = (np.hstack(balance_maps(cell, units)) for units in (False, True))
    free = np.setdiff1d(np.arange(in_units.shape[1]), left)
    to_left = np.linalg.inv(in_units[:, left]).astype(float)
    return GraspNumbers(
        left=tuple(left.tolist()),
        squeeze=np.concatenate(squeeze.states),
        spread=np.linalg.pinv(whole)[:, :LOAD_SIZE],
        load_to_left=_cleaned(to_left[:, :LOAD_SIZE]),
        free_to_left=_cleaned(to_left @ in_units[:, free]),
        to_robots=robot_wrenches(workcell),
        shapes=tuple(_shape(pad) for pad in workcell.pads),
        load_at_rest=_load_at_rest(workcell),
        rest=None,
        rest_slopes=None,
        reach=reach,
    )


def grasp_shapes(workcell: Workcell) -> dict[str, Any]:
    """Return the shape of every array of `GraspNumbers` by the field's name. The field `shapes` has
    one shape per pad."""
    pads = workcell.pads
    b, n = len(dependent_components(workcell)), len(EVEN) * len(pads)
    return {
        "squeeze": (n,),
        "spread": (n, LOAD_SIZE),
        "load_to_left": (b, LOAD_SIZE),
        "free_to_left": (b, n - b),
        "to_robots": (LOAD_SIZE, WRENCH_SIZE * len(pads)),
        "shapes": tuple(_shape(pad).shape for pad in pads),
        "load_at_rest": (LOAD_SIZE,),
        "rest": (n,),
        "rest_slopes": (n, LOAD_SIZE),
        "reach": (),
    }


def _shape(pad: Contact) -> Array:
    """Return the shape of a pad's patch as three lengths (3,), each over the patch radius: the mean
    distance of the points from the centre, and the diagonal entries of `SoftPatch.spread`. The
    array is empty for a disc."""
    if pad.half_sides is None:
        return np.zeros(0)
    patch = scaled_patch(pad)
    return np.array([patch.twist, *np.diag(patch.spread)])


def least_distance(workcell: Workcell) -> float:
    """Compute the least distance between the origins of two pads of different robots [m]."""
    places = [
        np.array([pad.T_box_pad[:3, 3] for pad in (contact, *contact.further)])
        for contact in workcell.contacts
    ]
    return float(np.linalg.norm(places[0][:, None] - places[1], axis=2).min())


def smaller_patches(workcell: Workcell, share: float) -> Workcell:
    """Return the workcell with the size of every contact patch multiplied by `share`. The pads keep
    their poses."""

    def smaller(contact: Contact) -> Contact:
        sides = contact.half_sides
        return replace(
            contact,
            patch_radius=share * contact.patch_radius,
            half_sides=None if sides is None else (share * sides[0], share * sides[1]),
            further=tuple(smaller(pad) for pad in contact.further),
        )

    first, second = (smaller(contact) for contact in workcell.contacts)
    return replace(workcell, contacts=(first, second))


def robot_wrenches(workcell: Workcell) -> Array:
    """Return a matrix (6, 6 k) that maps the wrenches of k pads to force [N] and moment [N m] along
    the axes of contact 1.

    Each pad has six columns. The moment is taken about the nominal contact point of the pad's
    robot, so that the sum over a robot's pads is the wrench of this robot. A pad's wrench holds,
    along the pad's axes, normal force, tangential force (2,), the normal force times the shift (2,)
    of the centre of pressure, and torsion.
    """
    axes, columns = workcell.contacts[0].T_box_pad[:3, :3], []
    for pad, robot in zip(workcell.pads, workcell.pad_robots, strict=True):
        force, moment = np.zeros((2, 3, WRENCH_SIZE))
        force[[0, 1, 2], [1, 2, 0]] = 1.0
        # A normal force N n at d turns about d x n = (d_y, -d_x).
        moment[[0, 1, 2], [4, 3, 5]] = 1.0, -1.0, 1.0
        beside = pad.T_box_pad[:3, 3] - workcell.contacts[robot].T_box_pad[:3, 3]
        to_axes = axes.T @ pad.T_box_pad[:3, :3]
        force = to_axes @ force
        moment = to_axes @ moment + skew(axes.T @ beside) @ force
        columns.append(np.vstack([force, moment]))
    return np.hstack(columns)


def _load_at_rest(workcell: Workcell) -> Array:
    """Return force and moment (6,) about the box frame's origin, box axes, that hold the payload at
    rest in its start pose, divided by the size of this load."""
    turn = box_rotation(workcell.task.orientation, workcell.task.waypoints[0].lower)
    force = -turn.T @ np.array(GRAVITY)
    moment = np.cross(workcell.payload.centre_of_mass, force)
    load = np.concatenate([force, moment])
    return np.asarray(load / np.hypot(np.linalg.norm(force), np.linalg.norm(moment) / MOMENT_ARM))


def _cleaned(matrix: Array) -> Array:
    """Return a matrix with zeros in place of entries that differ from zero only by rounding."""
    return np.where(np.abs(matrix) < 1e-14 * np.abs(matrix).max(), 0.0, matrix)
