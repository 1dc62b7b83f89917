"""The witness of a case: the box as it really is, under forces that were commanded before."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybrid_opt.witness.scene import SimulationSettings
from hybrid_opt.witness.simulate import Witness
from symbolic.array import Array
from symbolic.records import Contact, Workcell


def witness_of_case(
    workcell: Workcell, case: Array, settings: SimulationSettings | None = None
) -> Witness:
    """A witness whose box, friction and pads are those of a case.

    Args:
        case: (15,), see `symbolic.contact.worst_cases.CASE_SIZES`.

    Raises:
        WitnessError: MuJoCo is not installed.
    """
    return Witness(workcell_of_case(workcell, case), settings, case[8:11])


def workcell_of_case(workcell: Workcell, case: Array) -> Workcell:
    """The workcell as it is in a case (15,), but for the disturbance."""
    payload = workcell.payload
    mass, centre = float(case[4]), case[5:8]
    # The inertia is known about the nominal centre of mass: Steiner's theorem takes it to the true.
    d = centre - payload.centre_of_mass
    facing, planes = workcell.has_facing_pads, [c.T_box_pad[:3, :2] for c in workcell.contacts]
    planes[1] = planes[0] if facing else planes[1]
    inertia = mass / payload.mass * payload.inertia - mass * (d @ d * np.eye(3) - np.outer(d, d))
    first, second = (
        _displaced(contact, float(case[i]), float(case[2 + i]), plane @ case[11 + 2 * i :][:2])
        for i, (contact, plane) in enumerate(zip(workcell.contacts, planes, strict=True))
    )
    return replace(
        workcell,
        payload=replace(payload, mass=mass, centre_of_mass=centre, inertia=inertia),
        contacts=(first, second),
    )


def _displaced(contact: Contact, friction: float, radius: float, by: Array) -> Contact:
    T_box_pad = contact.T_box_pad.copy()
    T_box_pad[:3, 3] += by
    further = tuple(_displaced(pad, friction, pad.patch_radius, by) for pad in contact.further)
    return replace(
        contact, T_box_pad=T_box_pad, friction=friction, patch_radius=radius, further=further
    )
