"""The C that stands around generated functions, from the folder `c` of this package."""

from __future__ import annotations

import re
from functools import cache
from importlib.resources import files

_INCLUDE = re.compile(r'^#include "([^"]+)"$', re.MULTILINE)


@cache
def runtime(name: str) -> str:
    """The text of a file of `codegen/c`, those that it includes filled in."""
    text = files("codegen").joinpath("c", name).read_text()
    return _INCLUDE.sub(lambda found: runtime(found[1]), text)
