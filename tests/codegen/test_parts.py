"""Texts in parts and pieces: the bits of the whole, one object file wherever the same function
stands, and a text that is cut where it is long only."""

from __future__ import annotations

import re

import casadi as ca
import numpy as np
import pytest

from codegen import parts
from codegen.build import build, compile_function
from codegen.cache import Cache
from codegen.parts import PIECE, in_parts, in_pieces
from codegen.source import c_source, dense, generated_c

STEPS = 150
"""Of a function that is long enough to be compiled apart."""


def leaf(name: str) -> ca.Function:
    """Scalars only, with everything that parts bring along: roots, angles, choices, signs."""
    x = ca.SX.sym("x", 4)
    values = ca.vertsplit(x)
    for k in range(STEPS):
        chosen = ca.fmax(values[k], ca.fmin(values[-1], 0.3)) + ca.sign(values[-2])
        values.append(ca.sin(chosen) * ca.sqrt(ca.fabs(values[-1])) + values[k // 2] ** 2)
    return ca.Function(name, [x], [ca.vertcat(*values[-4:])])


def caller(name: str, inner: ca.Function) -> ca.Function:
    """Calls that cannot be merged: the second needs what the first gives."""
    x = ca.MX.sym("x", 4)
    return ca.Function(name, [x], [inner(inner(x)) + 1.0])


@pytest.mark.parametrize("lanes", [1, 2, 4, 0])
def test_parts_give_the_bits_of_the_whole(
    cache: Cache, monkeypatch: pytest.MonkeyPatch, lanes: int
) -> None:
    function = caller("outer", leaf("inner"))
    x = np.random.default_rng(0).normal(size=(11, 4))
    _, apart = in_parts(c_source(dense(function), lanes), lanes)
    assert len(apart) == (1 if lanes == 1 else 2)
    parted = compile_function(function, cache, lanes=lanes).batch(x)
    assert len(list(cache.folder.glob("*.o"))) == len(apart)
    monkeypatch.setattr(parts, "LEAST_BYTES", 10**9)
    whole = compile_function(function, cache, lanes=lanes).batch(x)
    assert len(list(cache.folder.glob("*.so"))) == 2
    for name, values in whole.items():
        np.testing.assert_array_equal(values.view(np.int64), parted[name].view(np.int64))


def test_what_several_functions_call_is_compiled_once(cache: Cache) -> None:
    # Of equal content under other names, called from texts that number their functions otherwise.
    y = ca.MX.sym("y", 4)
    other = leaf("other")
    more = ca.Function("more", [y], [ca.norm_2(other(other(y))) * other(y)])
    built = build({"first": caller("first", leaf("inner")), "second": more}, cache)
    assert len(list(cache.folder.glob("*.o"))) == 1
    x = np.array([0.1, -0.4, 0.7, 1.3])
    inner = compile_function(leaf("inner"), cache)
    once = next(iter(inner(x).values()))
    twice = next(iter(inner(once).values()))
    first, second = (next(iter(function(x).values())) for function in built.functions.values())
    np.testing.assert_array_equal(first, twice + 1.0)
    np.testing.assert_allclose(second, np.linalg.norm(twice) * once, rtol=1e-14)


def test_a_damaged_object_file_is_made_anew(cache: Cache) -> None:
    build({"first": caller("first", leaf("inner"))}, cache)
    (kept,) = cache.folder.glob("*.o")
    kept.write_bytes(b"damaged")
    built = build({"second": caller("second", leaf("inner"))}, cache)
    assert np.isfinite(next(iter(built.functions["second"](np.ones(4)).values()))).all()


def test_what_calls_others_or_is_short_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parts, "LEAST_BYTES", 0)
    x = ca.MX.sym("x", 3, 3)
    matrices = ca.Function("f", [x], [ca.mtimes(x, x) + 1.0])
    text = c_source(dense(matrices))
    assert in_parts(text, 1) == (text, ())
    monkeypatch.setattr(parts, "LEAST_BYTES", 10**9)
    text = c_source(leaf("inner"))
    assert in_parts(text, 1) == (text, ())


CUT, LINE = 1000, 300
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
    function = long_function(LINE)
    monkeypatch.setattr(parts, "LONG", CUT)
    x = np.random.default_rng(0).normal(size=(11, 6))
    cut = compile_function(function, cache, level=1, lanes=lanes).batch(x)
    monkeypatch.setattr(parts, "LONG", 10**9)
    whole = compile_function(function, cache, level=1, lanes=lanes).batch(x)
    for name, values in whole.items():
        np.testing.assert_array_equal(values.view(np.int64), cut[name].view(np.int64))


def test_every_statement_stays_in_its_order_and_no_piece_is_longer_than_allowed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(parts, "LONG", CUT)
    text = generated_c([dense(long_function(LINE))])
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
