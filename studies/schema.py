"""Print the JSON Schema of workcell files, for editors: `dual-arm-carry schema`.

An editor with a TOML language server completes keys and marks wrong values of a workcell file whose
first line names the schema: `#:schema ./workcell.schema.json`.
"""

from __future__ import annotations

import argparse
import json

from studies.program import Parser, Program


def _add_options(parser: Parser) -> None:
    pass


def _run(options: argparse.Namespace) -> int:
    from symbolic.read.schema import workcell_schema

    print(json.dumps(workcell_schema(), indent=2))
    return 0


main = Program("schema", __doc__, _add_options, _run)


if __name__ == "__main__":
    main.start()
