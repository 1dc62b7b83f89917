"""Estimates from holds, steps of force and slips: pure functions of arrays.

**Loads.** While a box is held still, what its pads give balances its weight. With the readings
(f, m) of arm i about its pad, free of offsets, N the normal force among them, and c the share of N
that the sensor shows along the pad's x and y as well (crosstalk),

    sum_i f_i - N_i (c_xi, c_yi, 0) = m g                                                     (1)
    sum_i m_i + p_i x (f_i - N_i (c_xi, c_yi, 0)) = (m c) x g                                 (2)

in the frame of the box. That is linear in the mass m, the mass's moment m c, the four numbers of
crosstalk and what the tares left of offsets: weighted least squares over all holds, each with the
sensors' noise. Every unknown has a width before; what the singular values of the problem leave near
a wide one was not seen.

**Friction.** The ratio of a hold is the coefficient of both pads with which soft fingers
(`symbolic.contact.soft_finger`) just hold what was measured, torsion included.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from scipy.optimize import brentq
from scipy.signal import correlate

from symbolic.array import Array
from symbolic.contact.soft_finger import SoftPatch, torsion_capacity
from symbolic.records import Workcell
from symbolic.records.poses import skew

NOISE = np.array([0.3] * 3 + [0.03] * 3)
"""Noise of a sensor's mean over a hold, with drift [N, N m]. The fit's residual may raise it."""

WIDTHS = np.array([1e3, *[1e2] * 3, *[0.3] * 4, *NOISE, *NOISE])
"""Prior widths of the unknowns: mass [kg], mass times centre [kg m], crosstalk, and what tares left
of both arms' offsets."""

SOUGHT = 8
"""Number of unknowns before the offsets: mass, mass times centre, and crosstalk."""

WEIGHED = 0.01
"""Standard deviation of the mass from a scale [kg]."""

SEEN_MASS, SEEN_CENTRE, SEEN_CROSSTALK = 0.05, 0.005, 0.02
"""Largest standard deviations with which the mass (as a share), the centre of mass [m] and the
crosstalk count as determined."""


# --- mass, centre of mass, crosstalk ---


@dataclass(frozen=True)
class MeasuredHold:
    """A box held still by both pads: measured values, averaged over a short time.

    Attributes:
        pads: (2, 4, 4) poses of the pads in the box frame.
        gravity: (3,) gravity in the box frame [m/s^2].
        wrench: (2, 6) force and moment on each arm, about the pad's centre along the pad's axes,
            without the sensor's offset [N, N m].
        mass: weighed mass of the box [kg]; None if the box was not weighed.
    """

    pads: Array
    gravity: Array
    wrench: Array
    mass: float | None = None

    @property
    def normal(self) -> Array:
        """Normal force (2,) of each arm [N]."""
        return -self.wrench[:, 2]


@dataclass(frozen=True)
class Load:
    """Payload and crosstalk of the force sensors, estimated from holds. A standard deviation is
    infinite if the holds do not determine the value.

    Attributes:
        mass: mass of the box [kg].
        centre: (3,) centre of mass in the box frame [m].
        crosstalk: (2, 2) for each arm, force along the pad's x and y axes that the sensor shows per
            newton of normal force.
        deviations: (8,) standard deviations: mass [kg], centre (3) [m], crosstalk (4).
        residual: root mean square of the force that the estimate leaves unexplained in Eq. (1) [N].
    """

    mass: float
    centre: Array
    crosstalk: Array
    deviations: Array
    residual: float

    @property
    def is_mass_observable(self) -> bool:
        """True if the measurements of the held box determine the mass accurately."""
        return bool(self.deviations[0] <= SEEN_MASS * abs(self.mass))

    @property
    def observable_centre(self) -> Array:
        """(3,) True for each box axis along which the measurements of the held box determine the
        centre of mass accurately.
        """
        return np.asarray(self.deviations[1:4] <= SEEN_CENTRE)

    @property
    def observable_crosstalk(self) -> Array:
        """(2, 2) True for each entry of `crosstalk` that the measurements of the held box determine
        accurately.
        """
        return np.asarray(self.deviations[4:].reshape(2, 2) <= SEEN_CROSSTALK)


def fit_load(holds: Sequence[MeasuredHold], moments: bool = True) -> Load:
    """Estimate the payload's mass and centre of mass and the sensors' crosstalk from holds, by
    least squares.

    Args:
        holds: at least one hold, the measurement of a box held still.
        moments: True if the sensors measure moments; the centre of mass is unknown without them.
    """
    rows, values, forces = [], [], []
    for hold in holds:
        matrix, value, noise = _balance(hold)
        forces.append((matrix[:3], value[:3]))
        keep = slice(None) if moments else slice(0, 3)
        white = np.linalg.inv(np.linalg.cholesky(noise[keep, keep]))
        rows.append(white @ matrix[keep])
        values.append(white @ value[keep])
    weighed = {hold.mass for hold in holds if hold.mass is not None}
    for mass in sorted(weighed):
        rows.append(np.eye(1, len(WIDTHS)) / WEIGHED)
        values.append(np.array([mass / WEIGHED]))
    scaled, right = np.concatenate(rows) * WIDTHS, np.concatenate(values)
    u, singular, v = np.linalg.svd(scaled, full_matrices=False)
    x = WIDTHS * (v.T @ (singular / (singular**2 + 1.0) * (u.T @ right)))
    spare = max(len(right) - SOUGHT, 1)
    worse = max(1.0, float(np.sum((scaled @ (x / WIDTHS) - right) ** 2)) / spare)
    information = np.full(len(WIDTHS), 1.0)
    information[: len(singular)] += singular**2 / worse
    basis = np.linalg.svd(scaled, full_matrices=True)[2]
    covariance = np.outer(WIDTHS, WIDTHS) * ((basis.T / information) @ basis)
    mass = x[0] if abs(x[0]) > 1e-6 else 1e-6
    centre = x[1:4] / mass
    # d centre = (d moment - centre d mass) / mass
    slope = np.hstack([-centre[:, None], np.eye(3)]) / mass
    spread = np.sqrt(np.diag(slope @ covariance[:4, :4] @ slope.T))
    own = np.sqrt(np.diag(covariance))[:SOUGHT]
    left = [matrix @ x - value for matrix, value in forces]
    residual = float(np.sqrt(np.mean(np.sum(np.square(left), axis=1))))
    deviations = np.concatenate([own[:1], spread, own[4:]])
    return Load(float(x[0]), centre, x[4:SOUGHT].reshape(2, 2), deviations, residual)


def _balance(hold: MeasuredHold) -> tuple[Array, Array, Array]:
    """Build the linear system of the balance of forces and moments on a box that is held still.

    Its rows are three equations of forces [N], then three of moments [N m]. The unknowns are mass,
    centre of mass and crosstalk, as in `Load`.

    Args:
        hold: the measurement.

    Returns:
        Matrix (6, unknowns), right side (6,), and covariance (6, 6) of the right side.
    """
    matrix, value, noise = np.zeros((6, len(WIDTHS))), np.zeros(6), np.zeros((6, 6))
    matrix[:3, 0] = hold.gravity
    matrix[3:, 1:4] = -skew(hold.gravity)
    for i, T_box_pad in enumerate(hold.pads):
        R = T_box_pad[:3, :3]
        to_box = np.zeros((6, 6))
        to_box[:3, :3] = to_box[3:, 3:] = R
        to_box[3:, :3] = skew(T_box_pad[:3, 3]) @ R
        matrix[:, 4 + 2 * i : 6 + 2 * i] = hold.normal[i] * to_box[:, :2]
        matrix[:, SOUGHT + 6 * i : SOUGHT + 6 * (i + 1)] = to_box
        value += to_box @ hold.wrench[i]
        noise += (to_box * NOISE**2) @ to_box.T
    return matrix, value, noise


def without_crosstalk(wrench: Array, crosstalk: Array) -> Array:
    """Subtract the crosstalk of the normal force from measured wrenches.

    Args:
        wrench: (..., 2, 6) force and moment on each arm about the pad's centre, along the pad's
            axes [N, N m].
        crosstalk: (2, 2) crosstalk along x and y of each arm, as in `Load`.
    """
    found = np.array(wrench)
    found[..., :2] += wrench[..., 2:3] * crosstalk
    return found


# --- delays ---


GRID_STEP = 0.005
"""Step of the grid on which signals are compared [s]."""

LARGEST_GRID = 2_000_000
"""Largest number of points of that grid; no delay is computed for longer recordings."""

SMOOTHED = 0.05
"""Time over which the rates of signals are averaged [s]."""

LEAST_LIKENESS = 0.5
"""Least correlation of two signals' rates with which one counts as the delayed other."""

CLEARER = 1.05
"""Least ratio of 1 - correlation without a delay to 1 - correlation with the delay that was found.
Noise alone reaches 1.04."""


def delay(
    time: Array, first: Array, second: Array, most: float = 1.0, apart: float | None = None
) -> float | None:
    """Estimate the delay of one signal relative to another [s], by the correlation of their time
    derivatives.

    Args:
        time: (n,) times of the samples [s].
        first: (n,) the reference signal, in any unit.
        second: (n,) the delayed signal, in any unit.
        most: largest magnitude of the delay that is considered [s].
        apart: largest magnitude of a delay that counts as none [s]. Signals that fit nearly as well
            with such a delay give None, so that noise alone does not appear as a delay. None to
            accept every delay.

    Returns:
        Delay with the largest correlation; negative if `second` is ahead of `first`. None if the
        signals are too short or too long, if the largest correlation is below `LEAST_LIKENESS`, or
        if the best delay is itself at most `apart`. Also None if it is hardly better than a delay
        up to `apart`: if 1 - correlation is smaller by less than the factor `CLEARER`.
    """
    wide = round(SMOOTHED / GRID_STEP)
    if not 4 * wide < (time[-1] - time[0]) / GRID_STEP < LARGEST_GRID:
        return None
    grid = np.arange(time[0], time[-1], GRID_STEP)
    kernel = np.ones(wide) / wide

    def rate(signal: Array) -> Array:
        smooth = np.convolve(np.interp(grid, time, signal), kernel, "valid")
        found = smooth[wide:] - smooth[:-wide]
        return np.asarray(found - found.mean())

    a, b = rate(first), rate(second)
    n = len(a)
    reach = min(round(most / GRID_STEP), n // 2)
    lags = np.arange(-reach, reach + 1)
    product = correlate(b, a, method="fft")[n - 1 + lags]
    # Only what overlaps counts, else a long delay's fewer samples would count against it.
    energy_a, energy_b = (np.append(0.0, np.cumsum(each**2)) for each in (a, b))
    own = energy_a[np.minimum(n - lags, n)] - energy_a[np.maximum(-lags, 0)]
    other = energy_b[np.minimum(n + lags, n)] - energy_b[np.maximum(lags, 0)]
    size = np.sqrt(own * other)
    near = np.divide(product, size, out=np.zeros(len(lags)), where=size > 0.0)
    best = int(np.argmax(near))
    if near[best] < LEAST_LIKENESS:
        return None
    if apart is not None:
        without = near[np.abs(lags) * GRID_STEP <= apart].max()
        if 1.0 - without <= CLEARER * (1.0 - near[best]):
            return None
    return (best - reach) * GRID_STEP


# --- friction ---


LARGEST_RATIO = 20.0


class FrictionRatio:
    """Function that computes the friction coefficient with which evenly pressing pads would just
    hold measured wrenches.

    Args:
        workcell: cell with the contact patches.
    """

    def __init__(self, workcell: Workcell) -> None:
        grip, tangent = ca.SX.sym("grip"), ca.SX.sym("tangent", 2)
        self._capacity = []
        for contact in workcell.contacts:
            # In the axes of its own pad.
            patch = SoftPatch.of(contact, contact.T_box_pad[:3, :3])
            carried, _ = torsion_capacity(grip, tangent, patch)
            self._capacity.append(ca.Function("capacity", [grip, tangent], [carried]))

    def __call__(self, wrench: Array) -> float:
        """Compute the friction coefficient, equal for both pads, with which the pads just transmit
        measured wrenches.

        Args:
            wrench: (2, 6) force and moment on each arm about the pad's centre, along the pad's
                axes, without offset and crosstalk [N, N m].

        Returns:
            The coefficient; infinite if a pad does not press or none up to `LARGEST_RATIO`
            suffices.
        """
        normal, tangent = -wrench[:, 2], wrench[:, :2]
        # Both moments act about the same line, their normals being opposite.
        torsion = abs(float(wrench[0, 5] - wrench[1, 5]))
        if normal.min() <= 0.0:
            return np.inf
        pulled = np.linalg.norm(tangent, axis=1)
        least = float((pulled / normal).max())

        def spare(ratio: float) -> float:
            grips = np.sqrt(np.maximum((ratio * normal) ** 2 - pulled**2, 0.0))
            carried = [
                float(capacity(grips[i], tangent[i])) for i, capacity in enumerate(self._capacity)
            ]
            return sum(carried) - torsion

        if spare(least) >= 0.0:
            return least
        if spare(LARGEST_RATIO) < 0.0:
            return np.inf
        return float(brentq(spare, least, LARGEST_RATIO))
