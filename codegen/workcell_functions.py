"""The compiled functions of a workcell, built once and then found by content."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from functools import cache
from importlib.metadata import version
from importlib.resources import files

from codegen.build import CompiledFunction, load_or_build
from symbolic.cell_functions import cell_functions
from symbolic.workcell import Workcell


def workcell_functions(workcell: Workcell) -> Mapping[str, CompiledFunction]:
    """Compiled functions of a workcell by name (see `symbolic.cell_functions`).

    A warm start finds them by the workcell's digest, the text of the symbolic package and the
    versions of the libraries that write the expressions, and builds no expression.

    Raises:
        DualArmError: the model or its code cannot be built.
    """
    return load_or_build(
        f"{workcell.digest}-{_model_digest()}", lambda: cell_functions(workcell)
    )


@cache
def _model_digest() -> str:
    """SHA-256 over the symbolic package's sources and the expression libraries' versions."""
    digest = hashlib.sha256()
    sources = sorted(
        (path for path in files("symbolic").iterdir() if path.name.endswith(".py")),
        key=lambda path: path.name,
    )
    for path in sources:
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    for library in ("casadi", "pin", "scipy"):
        digest.update(f"{library} {version(library)}\0".encode())
    return digest.hexdigest()
