"""Start branches that are searched for, in the text of a workcell file."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from symbolic.workcell.records import SEARCHED

_SEARCH = re.compile(rb"""(\bstart_branch["']?\s*=\s*)(["'])search\2""")


def with_branches(content: bytes, data: Mapping[str, Any], decided: tuple[int, int]) -> bytes:
    """A workcell file's text with start branches in the place of "search", where decided."""
    robots = data.get("robots")
    for robot, branch in zip(robots if isinstance(robots, list) else (), decided, strict=False):
        if not isinstance(robot, Mapping) or robot.get("start_branch") != "search":
            continue
        if branch != SEARCHED:
            content = _SEARCH.sub(rb"\g<1>%d" % branch, content, count=1)
    return content
