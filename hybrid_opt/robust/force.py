"""Least commanded forces that hold the box in every case of an uncertainty, and the largest
uncertainty that the arms' forces allow.

One arm is position controlled; its normal force follows from the motion. The other arm is force
controlled; its normal force is commanded beforehand, the same in all cases. The motion and the case
fix N_1 - N_2, so the commanded force decides the squeeze. Pads press evenly in every case
(`symbolic.contact.worst_cases`), whichever contact model the plan uses.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache, partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from codegen.function import NumericFunction
from hybrid_opt.carry import (
    BoxMotion,
    Carry,
    HeldMotion,
    box_motion,
    motion_inputs,
    tile_motion,
)
from hybrid_opt.compiled_cell import CACHED_WORKCELLS, contact_function
from hybrid_opt.robust.cases import governing_cases, nominal_case, random_cases, worst_cases
from symbolic.array import Array, Count, evenly
from symbolic.contact.model import ContactModel
from symbolic.contact.registry import command_model
from symbolic.contact.worst_cases import case_slack_function, case_squeeze_function
from symbolic.errors import SettingsError
from symbolic.records import Uncertainty, Workcell

if TYPE_CHECKING:
    import casadi as ca

BATCH = 100_000
"""Number of samples that are evaluated together."""

SCREENING_SAMPLES, GOVERNING_CASES = 3, 4
"""Number of samples at which governing cases are sought, and number of these cases at each
sample."""

LATEST_SETS = 8
"""Uncertainty sets whose worst cases are remembered."""

BISECTIONS = 30
LARGEST_FACTOR, FACTOR_ERROR = 20.0, 1e-6
"""Largest multiple of an uncertainty that is considered, and the error of a result."""

SCREENED = 0.97
"""Share of the commanded force with which a fast test, without a solver, clears most cases."""

SCREEN_SHARE = 0.99
"""Share of the friction left by displaced pads that this test assumes: the coefficient that
represents displacements is accurate to 0.3 %."""

HOLDS = 1e-6
"""Excess of a needed force over the commanded force that counts as rounding, as a share."""


SAMPLES = 100
"""Number of evenly spread samples of a carry that are evaluated, besides those of its largest
forces."""


@dataclass(frozen=True)
class RobustForce:
    """Normal forces at n samples that hold the box in every case of an uncertainty.

    Attributes:
        leader: index of the position-controlled arm.
        uncertainty: ranges of the uncertain quantities.
        nominal: (n, 2) least normal force of each robot if nothing is uncertain [N].
        commanded: (n,) normal force of the force-controlled arm [N].
        leading: (n,) largest normal force of the position-controlled arm in any case [N].
    """

    leader: int
    uncertainty: Uncertainty
    nominal: Array
    commanded: Array
    leading: Array

    @property
    def peak(self) -> Array:
        """Largest normal force (2,) of each robot [N]."""
        peaks = [float(self.commanded.max())] * 2
        peaks[self.leader] = float(self.leading.max())
        return np.array(peaks)


@dataclass(frozen=True)
class SampledCheck:
    """Result of a check of commanded forces in random cases of an uncertainty.

    Attributes:
        cases: number of random cases, each checked at all samples of the carry.
        failing: number of cases that need more than the commanded force at some sample.
        closest: largest ratio, over cases and samples, of the force that a case needs to the
            commanded force; smaller ratios than `SCREENED` are stated as `SCREENED`.
    """

    cases: Count
    failing: Count
    closest: float

    @property
    def holds(self) -> bool:
        """True if the commanded forces hold the box in every checked case."""
        return self.failing == 0

    @property
    def hardest(self) -> str:
        """Ratio `closest` in percent, as text; with 'at most' before it if only an upper bound is
        known.
        """
        most = "at most " if self.closest == SCREENED else ""
        return f"{most}{100.0 * self.closest:.2f} %"


class RobustModel:
    """Computes the normal forces that hold a workcell's box in every case of an uncertainty.

    A case is a row (18,) of true values of friction, mass and the other uncertain quantities, laid
    out by `symbolic.contact.worst_cases.CASE_SIZES`. The argument `leader` is always the index of
    the position-controlled arm; the force of the other arm is commanded.

    Attributes:
        workcell: the cell.
    """

    def __init__(
        self, workcell: Workcell, load: Callable[..., NumericFunction] = contact_function
    ) -> None:
        """Load or build the compiled functions.

        They are loaded at once if the normal force of one pad determines that of the other pad,
        else on first use.

        Args:
            workcell: the workcell.
            load: function that loads or builds a compiled function; it has the arguments of
                `contact_function`.

        Raises:
            SettingsError: the box cannot be held in some cases, however hard the pads press.
            DualArmError: a function cannot be built.
        """
        if problem := command_model(workcell).problem:
            raise SettingsError(": ".join(problem))
        self._load, self._one = load, command_model(workcell).has_scalar_squeeze
        self._squeeze, self._slack = cache(self._squeeze_function), cache(self._slack_function)
        self._describe(command_model(workcell))
        if self._one:
            self._squeeze(1, True)
            self._squeeze(1, False)
            self._slack(1)

    def with_workcell(self, workcell: Workcell) -> RobustModel:
        """Return a model of another workcell with the same compiled functions.

        Args:
            workcell: workcell that differs only in friction, mass and uncertainty.
        """
        other = copy(self)
        other._describe(self._contact.with_workcell(workcell))
        return other

    def _describe(self, contact: ContactModel) -> None:
        """Store a contact model, its workcell and its nominal case, and forget the cached worst
        cases.
        """
        self.workcell, self._contact = contact.workcell, contact
        self._nominal = nominal_case(contact.workcell)[None]
        self._worst: dict[tuple[int, int], tuple[Uncertainty, Array]] = {}

    def _squeeze_function(self, commanded: int, displaced: bool) -> NumericFunction:
        # Functions of pads with any normals depend on the robot, and always allow displacements.
        commanded, displaced = (1, displaced) if self._one else (commanded, True)
        name = f"case_squeeze_function {commanded} {displaced}"
        make = partial(case_squeeze_function, commanded=commanded, displaced=displaced)
        return self._load(self.workcell, name, make, lanes=0)

    def _slack_function(self, commanded: int) -> NumericFunction:
        make = partial(case_slack_function, commanded=commanded)
        return self._load(self.workcell, f"case_slack_function {commanded}", make, lanes=0)

    def has_worst_cases(self, uncertainty: Uncertainty) -> bool:
        """Return True if an uncertainty leaves friction, contact patches, mass and transmitted
        force, so that `worst_cases` exist."""
        return _has_positive_remainders(self._contact, uncertainty)

    def worst_cases(self, uncertainty: Uncertainty, leader: int) -> Array:
        """Return the worst cases (k, 18) of an uncertainty, read-only. A force that holds the box
        in all of them holds it in every case within the ranges.

        Args:
            uncertainty: ranges of the uncertain quantities.
            leader: index of the position-controlled arm.

        Raises:
            SettingsError: the uncertainty leaves no friction or contact patch.
        """
        key = id(uncertainty), leader
        if key not in self._worst:
            if not self.has_worst_cases(uncertainty):
                raise SettingsError(
                    "the uncertainty leaves no friction or no patch; make its shares, tilt or "
                    f"displacements smaller ({uncertainty})",
                    code="no-friction",
                )
            cases = worst_cases(self._contact, uncertainty, leader)
            cases.flags.writeable = False
            # A few sets serve many motions; each is kept alive, so that no other takes its id.
            self._worst = dict([*self._worst.items()][-LATEST_SETS + 1 :])
            self._worst[key] = uncertainty, cases
        return self._worst[key][1]

    def least(
        self, motion: HeldMotion, cases: Array, leader: int, threads: int, displaced: bool
    ) -> Array:
        """Compute the least normal forces (m, 2) [N] that hold the box at m samples, each in a case
        of its own.

        The least commanded force is computed; the force of the position-controlled arm results from
        it.

        Args:
            motion: box motion at m samples.
            cases: (m, 18) the case at each sample.
            leader: index of the position-controlled arm.
            threads: number of threads, 0 for one per core.
            displaced: True if any case displaces a pad; False is faster.
        """
        function = self._squeeze(1 - leader, displaced)
        return function.batch(*motion_inputs(motion), cases, threads=threads)["normal_force"]

    def slack(
        self, motion: HeldMotion, cases: Array, force: Array, leader: int, threads: int = 1
    ) -> Array:
        """Test fast whether commanded forces hold the box at m samples, each in a case of its own,
        by the compiled function `case_slack_function`. `least` decides the cases that the test
        leaves open.

        Args:
            motion: box motion at m samples.
            cases: (m, 18) the case at each sample.
            force: (m,) commanded normal forces [N].
            leader: index of the position-controlled arm.
            threads: number of threads, 0 for one per core.

        Returns:
            Slack (m,), of which only the sign counts. A positive slack proves that the force holds
            the box in the case; a negative slack proves nothing.
        """
        given = *motion_inputs(motion), cases, force
        return self._slack(1 - leader).batch(*given, threads=threads)["slack"].ravel()

    def least_squeeze(self, motion: HeldMotion, cases: Array, leader: int = 0) -> Array:
        """Compute the least normal forces (k, n, 2) [N] that hold the box in each of k cases at
        each of n samples.

        Args:
            motion: box motion at n samples.
            cases: (k, 18) cases, each applied to all samples.
            leader: index of the position-controlled arm; its force results from the commanded force
                of the other arm.
        """
        displaced = bool(cases[:, 11:15].any())
        n = len(motion.pose)
        found = np.empty((len(cases), n, 2))
        step = max(1, BATCH // n)
        for start in range(0, len(cases), step):
            some = cases[start : start + step]
            every, moved = np.repeat(some, n, axis=0), tile_motion(motion, len(some))
            forces = self.least(moved, every, leader, 1, displaced)
            found[start : start + step] = forces.reshape(len(some), n, 2)
        return found

    def nominal(self, motion: HeldMotion, leader: int = 0) -> Array:
        """Compute the least normal forces (n, 2) [N] with which both robots hold the box if nothing
        is uncertain.

        Args:
            motion: box motion at n samples.
            leader: index of the position-controlled arm.
        """
        return np.asarray(self.least_squeeze(motion, self._nominal, leader)[0])

    @cached_property
    def leading_share(self) -> Array:
        """Rise of the position-controlled arm's normal force per newton of commanded force, (2,):
        element i holds if arm i is position-controlled."""
        return self._contact.leading_share

    def hold(
        self,
        motion: HeldMotion,
        uncertainty: Uncertainty,
        leader: int = 0,
        rows: NDArray[np.intp] | None = None,
    ) -> tuple[Array, Array]:
        """Compute the least commanded force that holds the box in every case of an uncertainty, and
        the force of the position-controlled arm that results from it.

        Args:
            motion: box motion at n samples.
            uncertainty: ranges of the uncertain quantities.
            leader: index of the position-controlled arm.
            rows: indices of the rows of `worst_cases` to consider; None for all.

        Returns:
            Commanded normal force (n,) [N], and the largest normal force (n,) of the
            position-controlled arm in any case [N]. Both are infinite at samples where no force
            holds the box in every case.

        Raises:
            SettingsError: the uncertainty leaves no friction or contact patch.
        """
        cases = self.worst_cases(uncertainty, leader)
        worst = self.least_squeeze(motion, cases if rows is None else cases[rows], leader)
        follower, share = 1 - leader, float(self.leading_share[leader])
        force = governing_cases(worst, uncertainty, leader, leading_share=share).force
        force[np.isnan(force)] = np.inf
        return force[:, follower], force[:, leader]

    def governing_rows(
        self, motion: HeldMotion, uncertainty: Uncertainty, leader: int = 0
    ) -> NDArray[np.intp]:
        """Return indices of the rows of `worst_cases` that need the largest forces at any sample.

        For each sample these are `GOVERNING_CASES` cases with the largest commanded forces, and as
        many in which the position-controlled arm's force exceeds the commanded force most.

        Args:
            motion: box motion at n samples.
            uncertainty: ranges of the uncertain quantities.
            leader: index of the position-controlled arm.
        """
        worst = self.least_squeeze(motion, self.worst_cases(uncertainty, leader), leader)
        command = worst[:, :, 1 - leader]
        beyond = worst[:, :, leader] - float(self.leading_share[leader]) * command
        return np.unique([(-each).argsort(axis=0)[:GOVERNING_CASES] for each in (command, beyond)])

    def commanded(
        self,
        motion: HeldMotion,
        uncertainty: Uncertainty,
        leader: int = 0,
        above: Array | float = 0.0,
    ) -> Array:
        """Compute the least commanded normal force (n,) [N] that holds the box in every case of an
        uncertainty, in less time than `hold`; infinite at samples where no force does.

        At most `SAMPLES` samples are checked in all cases, the others only in the cases that need
        the largest forces at these samples. `slack` proves for most cases that they do not need the
        largest force, so only few forces are computed.

        Args:
            motion: box motion at n samples.
            uncertainty: ranges of the uncertain quantities.
            leader: index of the position-controlled arm.
            above: lower bound of the result, one per sample (n,) or one for all samples [N].
        """
        cases, n = self.worst_cases(uncertainty, leader), len(motion.pose)
        few = evenly(n, SCREENING_SAMPLES)
        at_few = box_motion(motion).at(few)
        planned = self.least_squeeze(at_few, self._nominal, leader)[0, :, 1 - leader]
        rows, every = tile_motion(at_few, len(cases)), np.repeat(cases, len(few), axis=0)
        slack = self.slack(rows, every, np.tile(planned, len(cases)), leader)
        governing = np.unique(slack.reshape(len(cases), -1).argsort(axis=0)[:GOVERNING_CASES])
        needed = self.least_squeeze(motion, cases[governing], leader)[:, :, 1 - leader]
        force: Array = np.maximum(needed.max(axis=0), above)
        others = np.delete(cases, governing, axis=0)
        thin = evenly(n, SAMPLES)
        held, step, last = force[thin], max(1, BATCH // len(thin)), [others[:0]]
        for start in range(0, len(others), step):
            some = others[start : start + step]
            share = self._shares(box_motion(motion).at(thin), held, some, 1.0, leader)
            last.append(some[np.unique(share.argmax(axis=0)[share.max(axis=0) > 1.0])])
            held *= share.max(axis=0)
        force[thin], more = held, np.concatenate(last)
        if n > len(thin) and len(more):
            needed = self.least_squeeze(motion, more, leader)[:, :, 1 - leader]
            force = np.maximum(force, needed.max(axis=0))
        force[np.isnan(force)] = np.inf
        return force

    def peak(self, motion: HeldMotion, uncertainty: Uncertainty, leader: int = 0) -> Array:
        """Compute the largest normal force (2,) [N] that each robot exerts over a motion in any
        case of an uncertainty.

        The result is the maximum of the forces of `hold`, which are computed only at the few
        samples where the maximum can lie.

        Args:
            motion: box motion at n samples.
            uncertainty: ranges of the uncertain quantities.
            leader: index of the position-controlled arm.
        """
        force, planned = self.commanded(motion, uncertainty, leader), self.nominal(motion, leader)
        share = self.leading_share[leader]
        leading = share * force + planned[:, leader] - share * planned[:, 1 - leader]
        most = np.unique([force.argmax(), leading.argmax()])
        peaks = np.full(2, force.max())
        peaks[leader] = self.hold(box_motion(motion).at(most), uncertainty, leader)[1].max()
        return peaks

    def robust_force(
        self, motion: HeldMotion, uncertainty: Uncertainty | None = None, leader: int = 0
    ) -> RobustForce:
        """Compute the least commanded forces that hold the box in every case of an uncertainty.

        Args:
            motion: motion at n samples.
            uncertainty: the ranges of the cases; None for the workcell's.
            leader: index of the position-controlled arm.

        Raises:
            SettingsError: the uncertainty leaves no friction or patch, or no force holds
                the box in every case.
        """
        chosen = self.workcell.uncertainty if uncertainty is None else uncertainty
        commanded, leading = self.hold(motion, chosen, leader)
        if not np.isfinite(commanded).all():
            raise SettingsError(
                f"no force was found that holds every case ({chosen}); make its ranges smaller",
                code="no-force",
            )
        return RobustForce(leader, chosen, self.nominal(motion, leader), commanded, leading)

    def check(
        self,
        motion: HeldMotion,
        force: RobustForce,
        n: int,
        rng: np.random.Generator,
        threads: int = 1,
    ) -> SampledCheck:
        """Check commanded forces in random cases of their uncertainty, at every sample of a motion.

        Args:
            motion: box motion for which the forces were computed.
            force: the commanded forces with their uncertainty.
            n: number of random cases.
            rng: random generator that draws the cases.
            threads: number of threads, 0 for one per core. The result does not depend on it.
        """
        failing, closest, left = 0, SCREENED, n
        step = max(1, BATCH // len(motion.pose))
        while left:
            cases = random_cases(
                self.workcell, force.uncertainty, min(step, left), rng, force.leader
            )
            # Shares below the closest so far need no solver; all shares beyond 1 are counted.
            enough, leader = min(closest, 1.0), force.leader
            share = self._shares(motion, force.commanded, cases, enough, leader, threads)
            share = share.max(axis=1)
            failing += int((share > 1.0 + HOLDS).sum())
            closest = max(closest, float(share.max()))
            left -= len(cases)
        return SampledCheck(n, failing, closest)

    def _shares(
        self,
        motion: HeldMotion,
        force: Array,
        cases: Array,
        screened: float,
        leader: int,
        threads: int = 1,
    ) -> Array:
        """Compute the ratio of needed to commanded force in each of k cases at n samples.

        Args:
            motion: box motion at n samples.
            force: (n,) commanded normal forces [N].
            cases: (k, 18) cases of the uncertainty, each applied to all samples.
            screened: ratios below this one are not computed; the result has this value in their
                place.
            leader: index of the position-controlled arm.
            threads: number of threads, 0 for one per core.

        Returns:
            (k, n) ratios; above 1 the commanded force does not hold the box.
        """
        n, k = len(motion.pose), len(cases)
        displaced = bool(cases[:, 11:15].any())
        level = screened * (self._friction_left(cases) if displaced and self._one else 1.0)
        rows = tile_motion(motion, k)
        every, commanded = np.repeat(cases, n, axis=0), np.tile(force, k)
        left = ~(self.slack(rows, every, level * commanded, leader, threads) > 0.0)
        share = np.full(n * k, screened)
        if left.any():
            needed = self.least(rows.at(left), every[left], leader, threads, displaced)
            share[left] = np.maximum(screened, needed[:, 1 - leader] / commanded[left])
        return share.reshape(k, n)

    def _friction_left(self, cases: Array) -> float:
        """Compute a lower bound of the share of the friction coefficient that remains if pads are
        displaced, for all of k cases.

        `slack` ignores displacements. Forces are multiplied by this share before the test, so that
        it remains a proof.

        Args:
            cases: (k, 18) cases of the uncertainty.
        """
        apart = np.linalg.norm(cases[:, 11:13] - cases[:, 13:15], axis=1)
        lost = self._contact.friction_lost(apart) / cases[:, :2].min(axis=1)
        return SCREEN_SHARE * max(0.0, 1.0 - float(lost.max()))

    def largest_factor(self, motion: HeldMotion, limit: Array, leader: int = 0) -> float:
        """Find the largest factor on the workcell's uncertainty with which the forces of `peak`
        stay within limits.

        Args:
            motion: box motion.
            limit: (2,) largest allowed normal force of each robot [N].
            leader: index of the position-controlled arm.

        Returns:
            Factor from 0 to `LARGEST_FACTOR`; 0 if the forces without uncertainty exceed the
            limits.
        """
        chosen = self.workcell.uncertainty
        end = allowed_factor(self.workcell, chosen)

        def beyond(factor: float) -> float:
            return 1.0 - float((limit / self.peak(motion, chosen.scaled(factor), leader)).min())

        if beyond(0.0) > 0.0:
            return 0.0
        return end if beyond(end) <= 0.0 else float(brentq(beyond, 0.0, end, xtol=FACTOR_ERROR))


def allowed_factor(workcell: Workcell, uncertainty: Uncertainty) -> float:
    """Find the largest factor on the ranges of an uncertainty, at most `LARGEST_FACTOR`, with which
    friction, contact patches and mass remain positive in every case.

    Args:
        workcell: the cell.
        uncertainty: ranges of the uncertain quantities.
    """
    low, high, contact = 0.0, LARGEST_FACTOR, command_model(workcell)
    if _has_positive_remainders(contact, uncertainty.scaled(high)):
        return high
    for _ in range(BISECTIONS):
        middle = (low + high) / 2.0
        leaves = _has_positive_remainders(contact, uncertainty.scaled(middle))
        low, high = (middle, high) if leaves else (low, middle)
    return low


def _has_positive_remainders(contact: ContactModel, uncertainty: Uncertainty) -> bool:
    """Return True if friction coefficients, contact patches, mass and transmitted force remain
    positive at the worst ends of the ranges.

    Args:
        contact: contact model with the nominal values.
        uncertainty: ranges of the uncertain quantities.
    """
    shares = [1.0 - uncertainty.mass, 1.0 - uncertainty.tracking]
    left = [*contact.least_friction(uncertainty), contact.displacement_margin(uncertainty), *shares]
    return bool(min(left) > 0.0)


robust_model = lru_cache(maxsize=CACHED_WORKCELLS)(RobustModel)
"""Return the robust model of a workcell. Repeated calls with the same record return the same
model."""


def interpreted_robust_model(workcell: Workcell) -> RobustModel:
    """Return a `RobustModel` whose functions CasADi interprets. Nothing is compiled, so it is ready
    sooner, but slower for many samples.
    """
    # Not imported at the top: what is compiled already needs no CasADi.
    from codegen.interpreted import interpret

    def load(
        cell: Workcell, name: str, make: Callable[[Workcell], ca.Function], lanes: int
    ) -> NumericFunction:
        return interpret(make(cell))

    return RobustModel(workcell, load)


def subsample(carry: Carry) -> tuple[NDArray[np.intp], BoxMotion]:
    """Return the indices of some samples of a carry, and the box motion at these samples.

    The samples are `SAMPLES` evenly spread ones and, for each robot, the one with its largest
    normal force.
    """
    rows = np.union1d(evenly(len(carry), SAMPLES), carry.normal_force.argmax(axis=0))
    return rows, box_motion(carry).at(rows)
