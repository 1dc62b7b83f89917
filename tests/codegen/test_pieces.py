"""Long functions in pieces: the bits of the whole, and a text that is cut where it is long only."""

from __future__ import annotations

import re

import casadi as ca
import numpy as np
import pytest

from codegen import pieces
from codegen.build import compile_function
from codegen.cache import Cache
from codegen.pieces import PIECE, in_pieces
from codegen.source import dense, generated_c

CUT, STEPS = 1000, 300
"""Statements from which on the tests cut, and steps of a function that is longer."""


def long_function(steps: int) -> ca.Function:
    """Statements that use others from far back, so that variables live across pieces."""
    x = ca.SX.sym("x", 6)
    values = ca.vertsplit(x)
    for k in range(steps):
        values.append(ca.sin(values[k]) * values[-1] - values[-5] / (1.0 + values[k // 2] ** 2))
    return ca.Function("long_line", [x], [ca.vertcat(*values[-7:]), values[steps // 2]])


@pytest.mark.parametrize("lanes", [1, 0])
def test_pieces_give_the_bits_of_the_whole(
    cache: Cache, monkeypatch: pytest.MonkeyPatch, lanes: int
) -> None:
    function = long_function(STEPS)
    monkeypatch.setattr(pieces, "LONG", CUT)
    x = np.random.default_rng(0).normal(size=(11, 6))
    cut = compile_function(function, cache, level=1, lanes=lanes).batch(x)
    monkeypatch.setattr(pieces, "LONG", 10**9)
    whole = compile_function(function, cache, level=1, lanes=lanes).batch(x)
    for name, values in whole.items():
        np.testing.assert_array_equal(values.view(np.int64), cut[name].view(np.int64))


def test_every_statement_stays_in_its_order_and_no_piece_is_longer_than_allowed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(pieces, "LONG", CUT)
    text = generated_c([dense(long_function(STEPS))])
    cut = in_pieces(text)
    bodies = re.findall(
        r"__attribute__\(\(noinline\)\) void \w+\([^)]*\) \{\n(.*?)^\}", cut, re.S | re.M
    )
    assert len(bodies) > 1

    def statements(body: str) -> list[str]:
        lines = re.findall(r"^  (?:a\d+\s*=|if).*$", body, re.M)
        return [line for line in lines if not re.match(r"  a\d+=kept\[", line)]

    (whole,) = re.findall(r"^static int casadi_f0\([^)]*\) \{\n(.*?)^\}", text, re.S | re.M)
    assert [line for body in bodies for line in statements(body)] == statements(whole)
    assert max(len(statements(body)) for body in bodies) == PIECE


def test_short_functions_and_functions_of_matrices_stay_as_they_are() -> None:
    x = ca.MX.sym("x", 3, 3)
    matrices = ca.Function("f", [x], [ca.mtimes(x, x) + 1.0])
    for function in (long_function(20), dense(matrices)):
        text = generated_c([function])
        assert in_pieces(text) == text
