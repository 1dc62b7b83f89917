"""Batches in lanes: the bits of single evaluations, for every width, batch and function."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from codegen import native
from codegen.build import build, compile_function, load_or_build, load_or_build_program
from codegen.cache import Cache
from codegen.errors import FormError, SlowerWarning
from codegen.lanes import FORMS, KEPT_FORMS, lane_text
from codegen.native import CompiledFunction
from symbolic.array import Array
from tests.codegen.samples import odd_compiler, random_function

WIDTHS = (2, 4, 8)


def in_lanes(function: ca.Function, cache: Cache, lanes: int = 0) -> CompiledFunction:
    made = compile_function(function, cache, lanes=lanes)
    assert isinstance(made, CompiledFunction)
    assert made.lanes > 1
    return made


def same_bits(a: dict[str, Array], b: dict[str, Array]) -> None:
    for name in a:
        np.testing.assert_array_equal(a[name].view(np.int64), b[name].view(np.int64))


@pytest.mark.parametrize("symbol", [ca.SX, ca.MX])
@pytest.mark.parametrize("seed", [0, 1])
def test_every_width_and_batch_gives_the_same_bits(cache: Cache, seed: int, symbol: Any) -> None:
    function = random_function(np.random.default_rng(seed), symbol)
    rng = np.random.default_rng(seed)
    made = {lanes: in_lanes(function, cache, lanes) for lanes in WIDTHS}
    matrices, vector = rng.standard_normal((19, *made[2].input_shapes[0])), rng.standard_normal(3)
    whole = made[2].batch(matrices, vector)
    for lanes, one in made.items():
        assert one.lanes == lanes
        for n in (1, 2, 3, 7, 8, 9, 19):
            same_bits({k: v[:n] for k, v in whole.items()}, one.batch(matrices[:n], vector))
        for k in (0, 18):
            same_bits({k_: v[k] for k_, v in whole.items()}, one(matrices[k], vector))


def test_results_do_not_depend_on_the_other_lanes(cache: Cache) -> None:
    x = ca.SX.sym("x", 2)
    function = ca.Function("f", [x], [ca.fmax(x[0], ca.sqrt(x[1])), ca.sin(x[0]) / x[1]])
    made = in_lanes(function, cache)
    x_bad = np.array([[1.0, 2.0], [np.nan, 1.0], [1e9, -1.0], [np.inf, 0.0], [0.3, 4.0]])
    together = made.batch(x_bad)
    for k, row in enumerate(x_bad):
        for name, value in made(row).items():
            np.testing.assert_array_equal(together[name][k], value)


@pytest.mark.parametrize("lanes", WIDTHS)
def test_sine_and_cosine_are_right_to_a_unit_in_the_last_place(cache: Cache, lanes: int) -> None:
    x = ca.SX.sym("x")
    made = in_lanes(ca.Function("waves", [x], [ca.sin(x), ca.cos(x)]), cache, lanes)
    rng = np.random.default_rng(0)
    quarters = np.arange(-200, 200) * (np.pi / 2.0)
    angles = np.concatenate(
        [
            rng.uniform(-np.pi, np.pi, 20_000),
            rng.uniform(-1e5, 1e5, 20_000),
            quarters,
            np.nextafter(quarters, np.inf),
            10.0 ** rng.uniform(-300.0, 0.0, 1000),
            [1e5, np.nextafter(1e5, np.inf), -1e7, 1e22],
        ]
    )
    found = made.batch(angles)
    for value, exact in zip(
        found.values(),
        (np.sin(angles.astype(np.longdouble)), np.cos(angles.astype(np.longdouble))),
        strict=True,
    ):
        unit = np.spacing(np.abs(exact.astype(float)))
        assert (np.abs(value - exact) <= unit).all()
    for value in made.batch(np.array([np.nan, np.inf, -np.inf])).values():
        assert np.isnan(value).all()


@pytest.mark.parametrize("lanes", WIDTHS)
def test_rounding_up_and_down_is_exact(cache: Cache, lanes: int) -> None:
    x = ca.SX.sym("x")
    made = in_lanes(ca.Function("rounded", [x], [ca.ceil(x), ca.floor(x)]), cache, lanes)
    rng = np.random.default_rng(0)
    special = [0.0, -0.0, 0.5, -0.5, 1.0, -1.0, 2.0**52 + 0.5, -(2.0**53), np.inf, -np.inf]
    numbers = np.concatenate([special, rng.normal(0.0, 3.0, 100), rng.normal(0.0, 1e17, 20)])
    found = list(made.batch(numbers).values())
    same_bits({"up": found[0]}, {"up": np.ceil(numbers)})
    same_bits({"down": found[1]}, {"down": np.floor(numbers)})
    assert np.isnan([made.batch(np.full(3, np.nan))[name] for name in made.output_names]).all()


def test_a_branch_runs_where_a_lane_wants_it(cache: Cache) -> None:
    x, y = ca.SX.sym("x", 2), ca.SX.sym("y")
    double = ca.Function("double", [x, y], [2.0 * x, y])
    other = ca.Function("other", [x, y], [x - 1.0, ca.sqrt(y)])
    choice = ca.Function.if_else("choice", double, other)
    a, b = ca.MX.sym("a", 2), ca.MX.sym("b")
    function = ca.Function("branching", [a, b], choice(a[0] > 0.0, a, b), ["a", "b"], ["c", "d"])
    made = in_lanes(function, cache, 4)
    rng = np.random.default_rng(0)
    a_values, b_values = rng.standard_normal((23, 2)), rng.uniform(0.0, 1.0, 23)
    a_values[:4, 0], a_values[4:8, 0] = 1.0, -1.0
    found = made.batch(a_values, b_values)
    wants = a_values[:, 0] > 0.0
    np.testing.assert_array_equal(
        found["c"], np.where(wants[:, None], 2.0 * a_values, a_values - 1.0)
    )
    np.testing.assert_array_equal(found["d"], np.where(wants, b_values, np.sqrt(b_values)))


def test_what_has_no_form_in_lanes_is_told(cache: Cache, monkeypatch: pytest.MonkeyPatch) -> None:
    x, p = ca.SX.sym("x"), ca.SX.sym("p")
    finder = ca.rootfinder("finder", "fast_newton", {"x": x, "p": p, "g": x**2 - p})
    q = ca.MX.sym("q")
    function = ca.Function("root", [q], [finder(x0=1.0, p=q)["x"]], ["q"], ["root"])
    monkeypatch.setattr(native, "_warned", False)
    with pytest.warns(RuntimeWarning, match="lanes=1"):
        made = compile_function(function, cache, lanes=0)
    assert made.lanes == 1
    with pytest.raises(FormError):
        load_or_build_program("root", "root", lambda: {"root": function}, "", cache)
    np.testing.assert_allclose(made.batch(np.array([4.0, 9.0]))["root"], [2.0, 3.0])


@pytest.mark.parametrize("example", [example for example, *_ in (*FORMS, *KEPT_FORMS)])
def test_every_form_is_taken_and_none_beside_them(example: str) -> None:
    def text(line: str) -> str:
        return (
            "static int casadi_f0(const casadi_real** arg, int mem) {\n"
            f"  {line}\n  return 0;\n}}\n"
            "  return casadi_f0(arg, res, iw, w, mem);\n"
        )

    assert "own_f0" in lane_text(text(example), "own").text
    for unknown in (f"{example} a0=(a0>a1);", f"{example} casadi_qp(w1);"):
        with pytest.raises(FormError) as told:
            lane_text(text(unknown), "own")
        assert unknown in str(told.value)


def test_a_text_without_an_entry_is_told() -> None:
    with pytest.raises(FormError):
        lane_text("int main(void) { return 0; }\n", "own")


def test_wrong_code_of_lanes_is_not_used(
    cache: Cache, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wrong = "s/lanes_sq(lanes_real x) { return x \\* x; }/lanes_sq(lanes_real x) { return x + x; }/"
    each = f'case "$file" in *.c) sed -i \'{wrong}\' "$file" ;; esac'
    odd_compiler(tmp_path, monkeypatch, f'for file in "$@"; do {each}; done\nexec gcc "$@"\n')
    monkeypatch.setattr(native, "_warned", False)
    x = ca.SX.sym("x", 3)
    square = ca.Function("square", [x], [x**2 + ca.sin(x)], ["x"], ["y"])
    cube = ca.Function("cube", [x], [x * x**2], ["x"], ["y"])
    with pytest.warns(SlowerWarning) as told:
        made = [compile_function(function, cache, lanes=0) for function in (square, cube)]
    assert len(told) == 1
    values = np.random.default_rng(0).standard_normal((9, 3))
    for one, expected in zip(made, (values**2 + np.sin(values), values**3), strict=True):
        assert isinstance(one, CompiledFunction)
        assert one.lanes == 1
        np.testing.assert_allclose(one.batch(values)["y"], expected, rtol=1e-14)


def test_sets_with_and_without_lanes_are_kept_apart(cache: Cache) -> None:
    x = ca.SX.sym("x")
    functions = {"f": ca.Function("f", [x], [ca.sin(x)])}
    build(functions, cache, key="set", lanes=2)

    def missing() -> dict[str, ca.Function]:
        raise AssertionError("made again")

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = load_or_build("set", missing, cache, lanes=2)["f"]
    assert isinstance(found, CompiledFunction)
    assert found.lanes == 2
    with pytest.raises(AssertionError, match="made again"):
        load_or_build("set", missing, cache)
