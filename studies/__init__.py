"""Programs: `python -m studies.rack` and others, with the cells they need."""

from __future__ import annotations

import sys
from types import TracebackType

import hybrid_opt as hybrid_opt  # refuses packages of other projects that hide its own


def _tell(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    if issubclass(kind, KeyboardInterrupt):
        print("\ninterrupted", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)


if sys.argv[:1] == ["-m"]:
    # A program is about to be imported, which takes a second; Ctrl-C may come meanwhile.
    sys.excepthook = _tell
