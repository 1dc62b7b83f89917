"""The whole cell."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from symbolic.workcell.handling import Handling
from symbolic.workcell.identity import Reading, digest_of
from symbolic.workcell.records.payload import Contact, Payload, Uncertainty
from symbolic.workcell.records.robot import Robot
from symbolic.workcell.records.shapes import Body
from symbolic.workcell.records.task import Task

SEARCHED = -2
"""`Workcell.start_branch` of a robot whose branches compete."""


@dataclass(frozen=True)
class IgnoredPair:
    """Bodies that collision checking leaves out against one another, with the user's reason.

    Attributes:
        first, second: names of bodies, or patterns with `*` and `?` that stand for several.
        reason: shown wherever pairs are listed.
    """

    first: str
    second: str
    reason: str


@dataclass(frozen=True)
class CollisionSettings:
    """How collisions are judged.

    Attributes:
        tolerance: bodies closer than this count as colliding [m].
        ignored: pairs left out by the user.
        most_pieces: most convex pieces of all bodies together that are worked with.
    """

    tolerance: float = 0.0
    ignored: tuple[IgnoredPair, ...] = ()
    most_pieces: int = 500


@dataclass(frozen=True)
class Workcell:
    """A dual-arm cell and its task.

    Attributes:
        name: title for reports.
        robots: the two arms; robot i holds contact i.
        payload, contacts, task, environment, collision, uncertainty, handling: see their records.
        start_branch: (2,) per robot the index of the start branch among the ranked branches,
            -1 for the stated criterion's choice, or `SEARCHED`: all compete, see
            `hybrid_opt.branches`, and until then it is the criterion's choice.
        source: the file it came from.
        reading: what it was like when it was read from `source`.
    """

    name: str
    robots: tuple[Robot, Robot]
    payload: Payload
    contacts: tuple[Contact, Contact]
    task: Task
    environment: tuple[Body, ...]
    collision: CollisionSettings = field(default_factory=CollisionSettings)
    start_branch: tuple[int, int] = (-1, -1)
    source: Path = Path()
    reading: Reading | None = None
    uncertainty: Uncertainty = field(default_factory=Uncertainty)
    handling: Handling = field(default_factory=Handling)

    @property
    def has_facing_pads(self) -> bool:
        """Whether two round pads with opposite normals hold the payload: what the paper's
        allocation and all closed forms are for."""
        return self.has_opposite_pads and not any(c.half_sides for c in self.contacts)

    @property
    def has_opposite_pads(self) -> bool:
        """Whether two pads with opposite normals hold the payload, whatever their patches."""
        first, second = (contact.T_box_pad[:3, 2] for contact in self.contacts)
        opposite = np.allclose(first, -second, atol=1e-9)
        return opposite and not any(contact.further for contact in self.contacts)

    @property
    def pads(self) -> tuple[Contact, ...]:
        """All pads: those of the first robot, then those of the second."""
        return tuple(pad for contact in self.contacts for pad in (contact, *contact.further))

    @property
    def pad_robots(self) -> tuple[int, ...]:
        """Per pad the index of the robot that holds it."""
        return tuple(i for i, c in enumerate(self.contacts) for _ in range(1 + len(c.further)))

    @cached_property
    def digest(self) -> str:
        """Identifies the cell in caches and results: SHA-256 over the file and every file it names
        (URDF, meshes), and over its values where it was changed in memory; '' without files."""
        return digest_of(self, self.reading)
