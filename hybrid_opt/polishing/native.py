"""Loader of the polish's C++: `rows.cpp`, `solvers/dense.cpp`, `solvers/quadratic.cpp`.

It is the same for every cell and compiled at installation, for every processor of the machine's
kind.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import Any

from symbolic.errors import BridgeError
from symbolic.robot.bridge import REMEDY


@cache
def native() -> Any:
    """Return the compiled module.

    Raises:
        BridgeError: the module is missing or cannot be loaded.
    """
    try:
        return import_module("hybrid_opt.polishing._native")
    except ImportError as error:
        raise BridgeError(
            f"the compiled part of the polish cannot be loaded ({error}); {REMEDY}"
        ) from error
