"""Obstacles of another program's scene as bodies of a workcell: `python -m studies.scene SCENE`.

SCENE is SDF (a world or a model), MJCF, or a planning scene of MoveIt (its message in YAML, or the
text that its panel saves, .scene). Prints the `[[environment]]` tables, or adds them to a workcell
or problem file, whose comments stay. Exit code 1 where something in the scene cannot be a
body: it is named, with the reason.
"""

from __future__ import annotations

import sys
from pathlib import Path

from studies.program import Parser, Program, later, run_program


def _add_options(parser: Parser) -> None:
    parser.add_argument("scene", metavar="SCENE", type=Path, help="the scene's file")
    parser.add_argument(
        "--into",
        metavar="WORKCELL",
        type=Path,
        help="the workcell or problem file that gets the bodies (default: they are printed, meshes "
        "relative to this folder)",
    )


main = Program("scene", __doc__, _add_options, later("studies.programs.scene.add_scene"))


if __name__ == "__main__":
    sys.exit(run_program(main))
