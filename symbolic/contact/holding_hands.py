"""Hands that hold without a squeeze: cups, magnets and grippers, each with its own holding force.

A hand pulls the payload against itself with the holding force G. It bears a share of the load
(`symbolic.contact.elastic.layer_shares`): the normal force N, positive if it presses, the
tangential force T, moments M_x and M_y about the tangents, and the torsion tau. Its patch presses
with G + N. The hand holds if

    G >= |M| / kern - N                                             so that no rim lifts off,    (1)
    G >= sqrt(|T|^2 + t^2 + kappa |T| t) / mu - N,  t = |tau| / c,  so that nothing slides.      (2)

The kern is the shift of the centre of pressure at which the pressure at a rim vanishes; for a
rectangle the ratios of both axes add up. c is the mean distance of the patch's points from its
centre. kappa makes (2) safe against the limit curve of a patch under even pressure (Howe and
Cutkosky, IJRR 1996): a disc requires 0 to 2.1 % more than exact, the ring of a cup's lip 0 to 3.0
%, a rectangle 0 to 11 % up to sides of 2 to 1, and up to 21 % at 5 to 1. Both right sides are
convex in the load and of degree one: a multiple of a load requires the same multiple of the force,
and a sum of loads at most the sum of the forces.

If a hand would slide first, the others take over a part of its load along the patch: it yields by
less than a millimetre, and the layers of all hands share what it does not bear (`yielded`). All
hands together then still balance the load, and conditions (1) and (2) are asked of these wrenches.
A hand whose rim lifts is not relieved: a cup that lifts leaks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from typing import Any

import casadi as ca
import numpy as np

from symbolic.array import Array
from symbolic.contact.elastic import kern, layer_shares, layer_stiffness
from symbolic.contact.force_closure import wrench_to_box
from symbolic.contact.model import (
    HELD_FLOOR,
    ContactLoad,
    ContactModel,
    HeldLoad,
    ImplicitVariables,
    Problem,
)
from symbolic.contact.soft_finger import SoftPatch
from symbolic.expression import Expression, number
from symbolic.records import Contact
from symbolic.records.cell import Uncertainty
from symbolic.records.numbered import NumberedContact
from symbolic.records.quantities import GRAVITY

KAPPA_DISC, KAPPA_RING = 0.3, 0.5
"""Coefficients kappa of a disc and of a ring in (2): the smallest with one digit that never require
less than the limit curve."""

KAPPA_RECTANGLE = (0.75, 0.7)
"""Numbers a and b in kappa = 1 - 1 / (a + b q) of a rectangle whose sides are as q to 1: 0.31 for a
square, 1 for a line."""

LEAST_MEAN_NORMAL = 0.1
"""If the mean of the normals of an arm's hands is shorter than this, the hands are fingers around
an edge."""

HAND_PARAMETERS = ("share", "opposed", "weaker")
"""Fields of `NumberedContact` that hands have in addition."""

BALANCES = np.geomspace(1e-3, 1e3, 121)
"""Weights of the tangential force against the torsion, of which the best bounds a product of both
to 0.2 %."""

FLOOR = 1e-9
"""Added in squares to forces [N] and moments [N m], so that lengths have derivatives at zero."""


YIELDING = 1.5
"""Multiple of what a hand bears beyond its capacity that it passes on to all hands, itself
included. Near this value, the simulator's and the model's forces for random carries agree best."""

GATE = 3.0
"""Slope with which hands begin to yield. They do not yield while lifting decides; they yield as
said if sliding needs half as much again as lifting."""

ALONG = [0, 1, 5]
"""Entries of a hand's wrench along its patch: the tangential force and the torsion."""

LARGER_CUP = 5e-3
"""Growth of the radius of cups whose effect is stated [m]."""


@dataclass(frozen=True)
class HandPatch:
    """Lengths of a hand's contact patch, which enter the conditions (1) and (2) of the module.

    Attributes:
        kern: shifts of the centre of pressure along the hand's x and y axes at which the pressure
            at a rim vanishes [m].
        is_round: True for a disc or a ring.
        twist: mean distance c of the patch's points from its centre [m].
        kappa: coefficient kappa of (2), dimensionless.
    """

    kern: tuple[Expression, Expression]
    is_round: bool
    twist: Expression
    kappa: Expression

    @classmethod
    def of(cls, hand: Contact) -> HandPatch:
        """Return the patch of the contact `hand`. Its lengths are symbols if the contact's lengths
        are symbols."""
        is_round = hand.half_sides is None
        twist = hand.patch_radius if hand.is_ring else SoftPatch.of(hand, np.eye(3)).twist
        kappa: Expression = KAPPA_RING if hand.is_ring else KAPPA_DISC
        if hand.half_sides is not None:
            x, y = hand.half_sides
            offset, slope = KAPPA_RECTANGLE
            kappa = 1.0 - 1.0 / (offset + slope * ca.fmax(x, y) / ca.fmin(x, y))
        return cls(kern(hand), is_round, number(twist), kappa)


def required_holding_forces(
    wrench: Expression, friction: Expression, patch: HandPatch
) -> tuple[Expression, Expression]:
    """Compute two least holding forces of a hand [N]: the first keeps its rim from lifting off, the
    second keeps it from sliding.

    A negative result means that the load presses the hand onto the payload strongly enough.

    Args:
        wrench: (6,) wrench of the hand on the payload about the hand's origin, along the hand's
            axes: tangential force (2,) and normal force [N], moments about the two tangents and
            torsion [N m].
        friction: Coulomb coefficient of the hand.
        patch: patch of the hand.
    """
    normal = wrench[2]
    # A moment about x shifts the pressure along y.
    tilting = wrench[3] / patch.kern[1], wrench[4] / patch.kern[0]
    lifting = _length(*tilting) if patch.is_round else sum(map(_length, tilting))
    tangential, torsion = _length(wrench[0], wrench[1]), _length(wrench[5] / patch.twist)
    sliding = ca.sqrt(tangential**2 + torsion**2 + patch.kappa * tangential * torsion)
    return lifting - normal, sliding / friction - normal


def _length(*components: Expression) -> Expression:
    return ca.sqrt(sum(component**2 for component in components) + FLOOR**2)


@dataclass(frozen=True)
class SharingHand:
    """One of several hands that share a load.

    Attributes:
        share: its matrix (6, 6) of `layer_shares`.
        to_box: matrix (6, 6) from its wrench to the wrench about the box frame.
        friction: Coulomb coefficient.
        patch: its patch.
    """

    share: Expression
    to_box: Expression
    friction: Expression
    patch: HandPatch

    def needs(self, wrench: Expression) -> tuple[Expression, Expression]:
        """Return the forces of `required_holding_forces` for a wrench (6,) of the hand [N]."""
        return required_holding_forces(wrench, self.friction, self.patch)


def yielded(load: Expression, hands: Sequence[SharingHand]) -> list[Expression]:
    """Compute the wrenches (6,) with which hands balance a load, if hands that would slide first
    yield a little and pass load on to all hands.

    A hand's capacity along its patch is the friction under the mean of the holding forces that all
    hands need against sliding. Of the load along the patch it passes on `YIELDING` times the excess
    over the capacity, less if lifting requires nearly as much force as sliding. The elastic layers
    of all hands share what is passed on.

    Args:
        load: (6,) force and moment about the box frame, box axes [N, N m].
        hands: all hands of both arms.

    Returns:
        One wrench per hand on the payload, about the hand's origin along its axes [N, N m].
    """
    own = [ca.mtimes(hand.share, load) for hand in hands]
    needs = [hand.needs(wrench) for hand, wrench in zip(hands, own, strict=True)]
    lifting, sliding = (reduce(ca.fmax, values) for values in zip(*needs, strict=True))
    gate = GATE * (sliding - lifting) / ca.fmax(ca.fabs(sliding), FLOOR)
    gate = ca.fmin(ca.fmax(gate, 0.0), 1.0)
    mean = sum(slide for _, slide in needs) / len(hands)
    passed = []
    for k, (hand, (_, slide)) in enumerate(zip(hands, needs, strict=True)):
        # Loads along the patch over the friction coefficient.
        bearable = ca.fmax(mean + own[k][2], 0.0)
        borne = slide + own[k][2]
        beyond = YIELDING * gate * ca.fmax(1.0 - bearable / ca.fmax(borne, FLOOR), 0.0)
        yields = beyond * own[k][ALONG]
        own[k][ALONG] -= yields
        passed.append(ca.mtimes(hand.to_box[:, ALONG], yields))
    return [
        wrench + ca.mtimes(hand.share, sum(passed)) for hand, wrench in zip(hands, own, strict=True)
    ]


def internal_force_wrenches(pads: Sequence[Contact], robots: Sequence[int]) -> Array:
    """Compute the wrench on the payload of each hand if the hands of its arm push the payload
    against the other arm.

    The push results from an error of the arms' relative position; the elastic layers of the two
    arms are springs in series.

    Args:
        pads: the n hands of both arms.
        robots: index of the arm of each hand.

    Returns:
        (n, 6, 3) matrices from the push of the arm's hands, box frame [N], to the hand's wrench
        about its origin along its axes [N, N m].
    """
    maps, stiff = [wrench_to_box(pad) for pad in pads], [layer_stiffness(pad) for pad in pads]
    wholes = [np.zeros((6, 6)), np.zeros((6, 6))]
    for A, K, i in zip(maps, stiff, robots, strict=True):
        wholes[i] += A @ K @ A.T
    softness = [np.linalg.inv(whole) for whole in wholes]
    series = np.linalg.inv(softness[0] + softness[1])[:, :3]
    wrench = series @ np.linalg.inv(series[:3])
    each = zip(maps, stiff, robots, strict=True)
    return np.array([K @ A.T @ softness[i] @ wrench for A, K, i in each])


def internal_force_needs(pads: Sequence[Contact], robots: Sequence[int]) -> Array:
    """Compute how much more holding force each hand needs if the arms push against each other, per
    newton of the push.

    Consider a push of 1 N along the unit vector f (`internal_force_wrenches`). At a hand it adds
    the normal force n . f. It also adds g(f): the tilting moment over the kern, or the sliding load
    over the friction coefficient, as in the conditions (1) and (2) of the module. The hand then
    needs g(f) - n . f more. The square of this is at most max(g)^2 + 2 g(n) + n . n for any
    direction f.

    Args:
        pads: the n hands of both arms.
        robots: index of the arm of each hand.

    Returns:
        (n, 4) dimensionless numbers a, b, c, d for each hand. Against sliding the additional
        holding force is sqrt(a / mu^2 + b / mu + c), with the friction coefficient mu; against
        lifting off it is d.
    """
    found = []
    for pad, own in zip(pads, internal_force_wrenches(pads, robots), strict=True):
        patch = HandPatch.of(pad)
        along, n, torsion = own[:2], own[2], own[5] / float(patch.twist)
        tilting = own[3:5] / np.array(patch.kern[::-1], dtype=float)[:, None]
        t, s = np.linalg.norm(along @ n), abs(torsion @ n)
        sliding = np.sqrt(t**2 + s**2 + patch.kappa * t * s)
        if patch.is_round:
            most, lifting = np.linalg.norm(tilting, 2), np.linalg.norm(tilting @ n)
        else:
            most = max(np.linalg.norm(tilting[0] + sign * tilting[1]) for sign in (1.0, -1.0))
            lifting = np.abs(tilting @ n).sum()
        off = np.sqrt(most**2 + 2.0 * lifting + n @ n)
        found.append([_most_sliding(along, torsion, patch.kappa), 2.0 * sliding, n @ n, off])
    return np.array(found)


def _most_sliding(along: Array, torsion: Array, kappa: float) -> float:
    """Compute an upper bound of the squared sliding load of condition (2), for a force of 1 N in
    the worst direction.

    A force along the unit vector f (3,) causes the tangential force t = |`along` f| and the torsion
    s = |`torsion` . f|. The bound is one of t^2 + s^2 + kappa t s over all f. For every q > 0 the
    product t s is at most half of q t^2 + s^2 / q. The result is the least bound over several q.

    Args:
        along: (2, 3) tangential force per unit of f.
        torsion: (3,) torsion over the mean distance of the patch's points from its centre, per unit
            of f.
        kappa: coefficient of the patch in condition (2).
    """
    first, second = along.T @ along, np.outer(torsion, torsion)
    bounds = (
        np.linalg.eigvalsh((1.0 + kappa * q / 2.0) * first + (1.0 + kappa / q / 2.0) * second)[-1]
        for q in BALANCES
    )
    return float(min(bounds))


class HoldingHands(ContactModel):
    """Contact model of hands (cups, magnets, grippers) on both arms, of any number and with any
    normals.

    The normal force of an arm is the largest holding force that one of its hands needs. It is
    stated for the weakest hand: the need of a stronger hand is multiplied by the weakest hand's own
    holding force over the stronger hand's. No force is commanded. In worst cases, one force limit
    applies to the hands of both arms together.
    """

    assumption = "hands that hold by themselves, on arms that keep their poses"
    is_squeeze = False
    holders = "hands that hold by themselves"
    order = "hold with"
    relief = ""
    closing = ("grip_on", "load")
    opening = ("unload", "grip_off")

    @cached_property
    def pad_parameters(self) -> list[dict[str, Any]]:
        """One dictionary per hand with the fields that `NumberedContact` adds for hands: 'share'
        (6, 6), the hand's matrix of `layer_shares`; 'opposed' (4,), the hand's row of
        `internal_force_needs`; and 'weaker', the least holding force of all hands divided by the
        hand's own."""
        pads = self.workcell.pads
        if isinstance(pads[0], NumberedContact):
            return [{name: getattr(pad, name) for name in HAND_PARAMETERS} for pad in pads]
        own = np.array([pad.holding_force for pad in pads])
        values = (
            layer_shares(pads),
            internal_force_needs(pads, self.workcell.pad_robots),
            own.min() / np.maximum(own, FLOOR),
        )
        return [dict(zip(HAND_PARAMETERS, each, strict=True)) for each in zip(*values, strict=True)]

    @property
    def problem(self) -> Problem | None:
        """Reason why this contact model does not apply, as (key of the workcell file, message).
        None if all contacts are hands; a pad has no holding force of its own."""
        pads = [f"contacts[{i}]" for i, c in enumerate(self.workcell.contacts) if c.kind == "pad"]
        if pads:
            return (
                pads[0],
                "is a pad, which only a squeeze holds; holding hands need kind = 'cup', 'magnet' "
                "or 'fingers' and a holding_force on both arms",
            )
        return None

    @property
    def level_force(self) -> float:
        """Largest of the holding forces [N] that the hands of both arms need for a payload at rest,
        with the z axis of the box vertical."""
        payload, contacts = self.workcell.payload, self.workcell.contacts
        centre = payload.centre_of_mass
        load = ContactLoad(
            ca.DM(-payload.mass * np.array(GRAVITY)),
            ca.DM.zeros(3),
            tuple(ca.DM(contact.T_box_pad[:3, 3] - centre) for contact in contacts),
            ca.DM(contacts[0].T_box_pad[:3, :3]),
            ca.DM([contact.friction for contact in contacts]),
        )
        return float(ca.evalf(ca.mmax(self.hold(load).normal)))

    def limited_force(self, normal: Array, whole: Array) -> Array:
        """Return for each arm the force (2,) [N] that must not exceed the arm's reference force.
        For hands it is the holding force that the load needs.

        Args:
            normal: (2,) holding force that the load needs from each arm's hands [N]; returned
                unchanged.
            whole: not used.
        """
        return normal

    def friction_use(self, normal: Array, tangential: Array) -> Array:
        """Compute for each of n motions how much of the hands' friction is used: the largest ratio,
        over samples and arms, of the tangential force to friction coefficient times reference
        force, (n,).

        Args:
            normal: not used.
            tangential: (n, samples, 2) tangential force of each arm's hands as in `hold` [N].
        """
        task, contacts = self.workcell.task, self.workcell.contacts
        bearing = task.reference_force * [contact.friction for contact in contacts]
        return np.asarray((tangential / bearing).max(axis=(1, 2)))

    def hold(
        self,
        load: ContactLoad,
        implicit: ImplicitVariables | None = None,
        displaced: bool = False,
    ) -> HeldLoad:
        """Compute the least holding forces for a load, and the wrench with which each arm's hands
        balance it.

        In the result, `normal` is the least holding force of each arm's hands, stated for the
        weakest hand. `tangential` is the part of the load that the friction under this holding
        force has to bear; it is at most friction times `normal`.

        Args:
            load: load on the hands of both arms.
            implicit: not used.
            displaced: not used.
        """
        workcell = self.workcell
        places = [number(contact.T_box_pad[:3, 3]) for contact in workcell.contacts]
        # The axes of the box, along those of the load.
        box = ca.mtimes(load.axes, number(workcell.contacts[0].T_box_pad[:3, :3]).T)
        in_box = ca.mtimes(box.T, load.force)
        centre = places[0] - ca.mtimes(box.T, load.arms[0])
        about = ca.mtimes(box.T, load.moment) + ca.cross(centre, in_box)
        whole = ca.vertcat(in_box, about)
        hands = self.sharing(load.friction)
        weaker = [own["weaker"] for own in self.pad_parameters]
        needed, rubbed = [ca.SX(0.0), ca.SX(0.0)], [ca.SX(0.0), ca.SX(0.0)]
        forces, moments = ([ca.SX.zeros(3), ca.SX.zeros(3)] for _ in range(2))
        for pad, i, hand, share, own in zip(
            workcell.pads,
            workcell.pad_robots,
            hands,
            weaker,
            yielded(whole, hands),
            strict=True,
        ):
            needed[i] = ca.fmax(needed[i], share * ca.fmax(*hand.needs(own)))
            beyond = _length(own[0], own[1]) - hand.friction * own[2]
            rubbed[i] = ca.fmax(rubbed[i], share * beyond)
            turn = ca.mtimes(box, number(pad.T_box_pad[:3, :3]))
            force = ca.mtimes(turn, own[:3])
            lever = ca.mtimes(box, number(pad.T_box_pad[:3, 3]) - places[i])
            forces[i] += force
            moments[i] += ca.mtimes(turn, own[3:]) + ca.cross(lever, force)
        point = load.moment - sum(
            ca.cross(arm, force) for arm, force in zip(load.arms, forces, strict=True)
        )
        none = ca.SX.zeros(3)
        return HeldLoad(
            ca.vertcat(*needed),
            ca.vertcat(*rubbed),
            (forces[0], forces[1]),
            (none, none),
            (moments[0], moments[1]),
            point,
            point - moments[0] - moments[1],
        )

    def sharing(self, friction: Expression) -> list[SharingHand]:
        """Return all hands of both arms, in the order of `Workcell.pads`, each with the data from
        which its share of a load and its needed holding force follow.

        Args:
            friction: (2,) Coulomb coefficients of the arms' hands.
        """
        pads = zip(self.workcell.pads, self.workcell.pad_robots, self.pad_parameters, strict=True)
        return [
            SharingHand(
                number(own["share"]),
                _to_box(number(pad.T_box_pad)),
                friction[i],
                HandPatch.of(pad),
            )
            for pad, i, own in pads
        ]

    def squeeze_wrenches(self, leader: int) -> Array:
        """Return zeros (2, 6) for any leader: a hand's holding force acts between hand and payload
        alone, so more of it does not change the wrench on the payload."""
        return np.zeros((2, 6))

    @property
    def strength(self) -> float:
        """Holding force of the weakest hand [N]."""
        return min(contact.holding_force for contact in self.workcell.contacts)

    @property
    def own_changes(self) -> dict[str, Callable[[Contact], Contact]]:
        """Changes of the contacts that may be proposed to the user. If all hands are cups, this is
        one change: a larger cup at the same vacuum, whose `strength` is higher. Otherwise there are
        none. Keys are texts of the changes, values are functions that take a contact and return its
        changed copy."""
        if any(contact.kind != "cup" for contact in self.workcell.contacts):
            return {}
        return {f"cups {2e3 * LARGER_CUP:.0f} mm larger across at the same vacuum": larger_cup}

    def follower(self, leader: int) -> int | None:
        """Return None for any leader: hands hold by their own force, so no arm controls a force."""
        return None

    def friction_lost(self, apart: Array) -> Array:
        """Return k zeros: displaced hands lose no friction, because they need no squeeze that a
        displacement could turn into a moment.

        Args:
            apart: (k,) displacements of the two arms' hands relative to each other [m].
        """
        return 0.0 * apart

    def worst_displacements(self, uncertainty: Uncertainty) -> tuple[Array, Array]:
        """Return how displaced hands enter the worst cases of an uncertainty: as an opposite
        displacement of the centre of mass, while the hands themselves stay in place.

        Args:
            uncertainty: ranges of the centre of mass and of the hands' displacements, among others.

        Returns:
            Half-widths (3,) of the range of the centre of mass along the box axes, the hands'
            displacements included [m]; and one case of displaced hands, zeros (1, 4) [m].
        """
        off = uncertainty.pad_position + uncertainty.apart / 2.0
        return uncertainty.centre_of_mass + off, np.zeros((1, 4))

    def leading_excess(self, load: ContactLoad, opposed: Expression) -> Expression:
        """Return zero for any arguments: the force of robot 1 has no part beside `leading_share`
        times the commanded force, because the hands of both arms hold with the same force."""
        return ca.SX(0.0)

    def commanded_forces(
        self, normal: Expression, friction: Expression, tracking: Expression, opposed: Expression
    ) -> Expression:
        """Compute the holding force [N] that the hands of both arms need in one case of the
        uncertainty, as two equal entries (2,). The force is that of the weakest hand; a stronger
        hand holds with more, in proportion to its own holding force.

        Args:
            normal: (2,) least holding force of each arm's weakest hand [N].
            friction: (2,) Coulomb coefficients of the arms' hands.
            tracking: (2,) share of each arm's holding force that may be missing, for example of a
                vacuum.
            opposed: force with which the arms may push against each other [N].
        """
        needed = ca.fmax(normal[0], normal[1]) + opposed * self._opposed_need(friction)
        needed /= 1.0 - ca.fmax(tracking[0], tracking[1])
        return ca.vertcat(needed, needed)

    def approach(self, arm: int) -> Array:
        """Return the unit direction (3,) in which the hands of arm `arm` approach the payload, box
        frame.

        Hands approach along their mean normal. If the normals cancel, the hands are fingers that
        grip an edge from both sides; they approach perpendicular to their normals, from outside the
        payload.
        """
        of_arm = zip(self.workcell.pads, self.workcell.pad_robots, strict=True)
        T = np.array([pad.T_box_pad for pad, robot in of_arm if robot == arm])
        normals, middle = T[:, :3, 2], T[:, :3, 3].mean(axis=0)
        way = normals.mean(axis=0)
        if np.linalg.norm(way) < LEAST_MEAN_NORMAL:
            way = (middle @ normals[0]) * normals[0] - middle
        return np.asarray(way / np.linalg.norm(way))

    def held_with(self, commanded: Array) -> Array:
        """Return the holding force of the weakest hand [N], repeated to the shape (n, 2) of
        `commanded`. Hands hold by their own force, so the values of `commanded` are not used."""
        return np.full(commanded.shape, self.strength)

    def force_use(self, commanded: Array, least: Array) -> dict[str, Array]:
        """Compute how much of the available holding force the needed holding forces use.

        Args:
            commanded: (n, 2) holding forces needed in every case of the uncertainty [N].
            least: (n, 2) holding forces needed without uncertainty [N].

        Returns:
            Ratios (n, 2) of `commanded` and of `least` to the holding force of the weakest hand,
            under the names 'holding force' and 'least normal force'.
        """
        held = np.maximum(self.held_with(commanded), HELD_FLOOR)
        return {"holding force": commanded / held} | super().force_use(commanded, least)

    def raised(self, planned: Array, extra: Array, leader: int) -> Array:
        """Compute the holding forces (n, 2) [N] after a rise of the force of the robot other than
        `leader`. Both columns equal this robot's raised force, because the hands of both arms hold
        with the same share of their holding forces.

        Args:
            planned: (n, 2) planned holding forces [N].
            extra: (n,) rise of the force of the robot other than `leader` [N].
            leader: index of a robot.
        """
        return np.repeat((planned[:, 1 - leader] + extra)[:, None], 2, axis=1)

    def pulled_apart(self, along: Array, across: Array, stiffness: float) -> tuple[Array, Array]:
        """Compute how a displacement of the hands of both arms against each other changes the
        forces. Both arms count as springs of equal stiffness in series.

        Args:
            along, across: (n,) displacement of one arm's hands relative to the other's, along their
                normal and across it [m].
            stiffness: stiffness of each arm at its hands [N/m].

        Returns:
            Changes (n,) of the holding forces, which are zero; and rises (n,) of the least holding
            forces for the worst direction of the displacement [N].
        """
        friction = ca.DM([contact.friction for contact in self.workcell.contacts])
        most = float(ca.evalf(self._opposed_need(friction)))
        return 0.0 * along, stiffness / 2.0 * np.hypot(along, across) * most

    def _opposed_need(self, friction: Expression) -> Expression:
        """Compute the additional holding force that the hands need if the arms push against each
        other, per newton of the push. It is the largest over all hands, each stated for the weakest
        hand.

        Args:
            friction: (2,) Coulomb coefficients of the arms' hands.
        """
        most = ca.SX(0.0)
        for i, own in zip(self.workcell.pad_robots, self.pad_parameters, strict=True):
            a, b, c, lifting = ca.vertsplit(ca.vec(number(own["opposed"])))
            sliding = ca.sqrt(a / friction[i] ** 2 + b / friction[i] + c + FLOOR**2)
            most = ca.fmax(most, own["weaker"] * ca.fmax(sliding, lifting))
        return most


def _to_box(T: Expression) -> Expression:
    """Return the matrix (6, 6) that converts the wrench of a hand to the box frame. The wrench is
    about the hand's origin, along its axes; the result is about the box frame's origin, along the
    box's axes.

    Args:
        T: (4, 4) pose of the hand in the box frame.
    """
    R, p = T[:3, :3], T[:3, 3]
    return ca.blockcat([[R, ca.DM(3, 3)], [ca.mtimes(ca.skew(p), R), R]])


def larger_cup(cup: Contact) -> Contact:
    """Return a copy of a suction cup whose radius is larger by `LARGER_CUP` [m] and whose holding
    force is larger in proportion to its area."""
    radius = cup.patch_radius + LARGER_CUP
    force = cup.holding_force * (radius / cup.patch_radius) ** 2
    return replace(cup, patch_radius=radius, holding_force=force)
