"""Obstacles of another program's scene as bodies of a workcell: `dual-arm-carry scene SCENE`.

SCENE is SDF (a world or a model), MJCF, or a planning scene of MoveIt (its message in YAML, or the
text that its panel saves, .scene). Prints the `[[environment]]` tables, or adds them to a workcell
or problem file, whose comments stay. Exit code 1 where something in the scene cannot be a
body: it is named, with the reason.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from studies.options import INPUT_FILE
from studies.program import FAULT, Parser, Program
from symbolic import safe_io
from symbolic.errors import OutsideError, SceneError
from symbolic.safe_io import replace_file

if TYPE_CHECKING:
    from symbolic.read.scene_bodies import ImportedScene


def _add_options(parser: Parser) -> None:
    parser.add_argument("scene", metavar="SCENE", type=INPUT_FILE, help="the scene's file")
    parser.add_argument(
        "--into",
        metavar="WORKCELL",
        type=INPUT_FILE,
        help="the workcell or problem file that gets the bodies (default: they are printed, meshes "
        "relative to this folder)",
    )


def add_scene(options: argparse.Namespace) -> int:
    """Print the bodies of a scene, or add them to a workcell file. Return the exit code."""
    from symbolic.read.editing import completed
    from symbolic.read.scenes import read_scene

    scene = read_scene(options.scene)
    for told in scene.notes:
        print(f"note: {told}", file=sys.stderr)
    for told in scene.left_out:
        print(f"left out: {told}", file=sys.stderr)
    if options.into:
        _add(scene, options.into)
        count = len(scene.bodies)
        print(f"{options.into}: {count} bod{'y' if count == 1 else 'ies'} added to its environment")
    elif scene.files:
        raise SceneError(
            f"{options.scene}: holds meshes of its own, which become files beside a workcell; name "
            "that by --into"
        )
    elif scene.bodies:
        folder = Path.cwd()
        print(completed("", {}, {"environment": scene.tables(folder, folder)}), end="")
    return FAULT if scene.left_out else 0


def _add(scene: ImportedScene, path: Path) -> None:
    from symbolic.read.editing import extended

    try:
        content = safe_io.read_bytes(path, safe_io.WORKCELL_BYTES)
        data = safe_io.toml_tables(content)
    except OutsideError as error:
        raise SceneError(f"{path}: {error}") from error
    meshes = path.absolute().with_name(f"{path.stem}-meshes")
    tables = scene.tables(path.parent, meshes)
    taken = {str(each.get("name")) for each in (*_entries(data, "robots"), *_entries(data))}
    again = sorted(taken & {table["name"] for table in tables})
    if again:
        raise SceneError(
            f"{path}: has bodies or robots called {', '.join(map(repr, again[:5]))} already; "
            "remove those that came from this scene before, or rename them"
        )
    text = extended(content.decode(), data, "environment", tables)
    for name, mesh in scene.files.items():
        meshes.mkdir(exist_ok=True)
        replace_file(meshes / name, mesh)
    replace_file(path, text.encode())


def _entries(data: Mapping[str, Any], key: str = "environment") -> list[Mapping[str, Any]]:
    found = data.get(key, [])
    return [each for each in found if isinstance(each, dict)] if isinstance(found, list) else []


main = Program("scene", __doc__, _add_options, "studies.scene.add_scene")


if __name__ == "__main__":
    main.start()
