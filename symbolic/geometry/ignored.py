"""The pairs of bodies that the workcell file or a robot's SRDF takes out of collision checking."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product

from symbolic.errors import CollisionModelError
from symbolic.geometry.bodies import CollisionBody
from symbolic.robot.machine import one_machine
from symbolic.robot.srdf_file import read_srdf
from symbolic.workcell.patterns import matching
from symbolic.workcell.records import Workcell


def ignored_pairs(
    workcell: Workcell, bodies: Sequence[CollisionBody]
) -> Mapping[frozenset[str], str]:
    """The reason of every pair that is left out, by the names of its bodies.

    What the workcell file says counts before an SRDF. A link that an SRDF names and that has no
    collision shape is passed over.

    Raises:
        CollisionModelError: a name or pattern of `collision.ignored` matches no body.
        UrdfError: an SRDF cannot be read.
    """
    names = [body.name for body in bodies]
    pairs: dict[frozenset[str], str] = {}
    for robot in workcell.robots:
        if robot.srdf is None:
            continue
        owners = workcell.robots if one_machine(workcell.robots) else (robot,)
        for disabled in read_srdf(robot.srdf):
            said = f": {disabled.reason}" if disabled.reason else ""
            for pair in product(owners, owners):
                links = zip(pair, (disabled.first, disabled.second), strict=True)
                named = frozenset(f"{owner.name}/{link}" for owner, link in links)
                pairs[named] = f"disabled in {robot.srdf.name}{said}"
    for ignored in workcell.collision.ignored:
        sides = []
        for pattern in (ignored.first, ignored.second):
            found = matching(pattern, names)
            if not found:
                raise CollisionModelError(
                    f"collision.ignored names {pattern!r}; the bodies are "
                    f"{', '.join(sorted(names))}"
                )
            sides.append(found)
        for first in sides[0]:
            for second in sides[1]:
                pairs[frozenset((first, second))] = f"ignored in the file: {ignored.reason}"
    return pairs
