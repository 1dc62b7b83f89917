"""Functions to compile, random expression graphs among them, and compilers that are scripts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

BINARY = [
    lambda a, b: a + b,
    lambda a, b: a * b,
    lambda a, b: a - ca.cos(b),
    lambda a, b: a / (1.0 + b * b),
    lambda a, b: ca.atan2(a, 1.0 + b * b),
    lambda a, b: ca.if_else(a > b, ca.sin(a), ca.sqrt(1.0 + b * b)),
    lambda a, b: ca.fmax(a, ca.fabs(b)),
]


def random_function(rng: np.random.Generator, symbol: Any) -> ca.Function:
    """A random expression graph of a matrix and a vector, as SX or MX, with three outputs."""
    matrix, vector = symbol.sym("matrix", 2, 3), symbol.sym("vector", 3)
    terms = [matrix @ vector, matrix[:, 0] * vector[0], ca.sin(vector[1:])]
    for _ in range(rng.integers(5, 40)):
        first, second = rng.integers(len(terms), size=2)
        terms.append(BINARY[rng.integers(len(BINARY))](terms[first], terms[second]))
    tail = terms[-3:]
    return ca.Function(
        "random_graph",
        [matrix, vector],
        [tail[0], ca.horzcat(*tail), ca.dot(tail[1], tail[2])],
        ["matrix", "vector"],
        ["column", "table", "number"],
    )


def small() -> ca.Function:
    x, y = ca.MX.sym("x", 3), ca.MX.sym("y", 2, 4)
    return ca.Function(
        "small", [x, y], [2.0 * y, ca.sumsqr(x) * x, ca.sum1(x)], ["x", "y"], ["a", "b", "c"]
    )


def square() -> dict[str, ca.Function]:
    x = ca.SX.sym("x")
    return {"square": ca.Function("square", [x], [x**2], ["x"], ["y"])}


ASKED = 'case "$*" in -v|*" -E "*) exec gcc "$@" ;; esac\n'
"""Beginning of a compiler that answers questions as gcc does."""


def odd_compiler(folder: Path, monkeypatch: pytest.MonkeyPatch, script: str) -> None:
    """Let CC name a compiler that is this script."""
    path = folder / "odd-cc"
    path.write_text(f"#!/bin/sh\n{script}")
    path.chmod(0o755)
    monkeypatch.setenv("CC", str(path))
