"""Any scene that is read, by what is in its file."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from symbolic import outside
from symbolic.errors import OutsideError, SceneError
from symbolic.read.scenes.bodies import Gathered, Scene
from symbolic.read.scenes.moveit import read_moveit, read_moveit_text
from symbolic.read.scenes.sdf import read_sdf


def read_scene(path: Path) -> Scene:
    """The obstacles of SDF (a world or a model), or of a planning scene of MoveIt (its message in
    YAML, or its own text, .scene).

    Raises:
        SceneError: the file cannot be read, is no scene, or is wrong; every problem with its
            place.
    """
    found = Gathered()
    try:
        _reader(path)(path, found)
    except OutsideError as error:
        raise SceneError(f"{path.name}: {error}") from error
    if found.problems.found:
        told = "".join(f"\n  - {problem}" for problem in found.problems.messages())
        raise SceneError(f"{path.name}: cannot be read as a scene{told}")
    if not found.bodies and not found.left_out:
        raise SceneError(f"{path.name}: holds no obstacle")
    return Scene(tuple(found.bodies), tuple(found.left_out), tuple(found.notes), found.files)


def _reader(path: Path) -> Callable[[Path, Gathered], None]:
    """What reads a file, by what is in it."""
    text = outside.text(outside.read_bytes(path, outside.URDF_BYTES))
    head = re.match(r"\s*(?:(?:<\?.*?\?>|<!--.*?-->)\s*)*<([A-Za-z]\w*)", text, re.DOTALL)
    if head and head[1] == "sdf":
        return read_sdf
    by_name = {".yaml": read_moveit, ".yml": read_moveit, ".scene": read_moveit_text}
    if not head and path.suffix.lower() in by_name:
        return by_name[path.suffix.lower()]
    raise OutsideError(
        "is no scene that is read; allowed are SDF (<sdf>) and planning scenes of MoveIt, .yaml or "
        ".scene"
    )
