"""Compiled and interpreted functions: the same laws, against CasADi; from many threads."""

from __future__ import annotations

import ctypes
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from codegen.build import compile_function
from codegen.cache import Cache
from codegen.errors import CodegenError
from codegen.function import NumericFunction
from codegen.interpreted import (
    InterpretedFunction,
    compare,
    directional_derivative,
    relative_difference,
)
from codegen.native import CompiledFunction
from symbolic.array import Array
from tests.codegen.samples import random_function, small
from tests.refusals import refused

Make = Callable[[ca.Function], NumericFunction]


@pytest.fixture(params=["compiled", "interpreted"])
def make(request: pytest.FixtureRequest, cache: Cache) -> Make:
    """Make a numeric function of either kind."""
    if request.param == "interpreted":
        return lambda function: InterpretedFunction(function)
    return lambda function: compile_function(function, cache)


@pytest.mark.parametrize("symbol", [ca.SX, ca.MX])
@settings(max_examples=1, suppress_health_check=list(HealthCheck))
@given(seed=st.integers(0, 2**32 - 1))
def test_compiled_equals_interpreted(cache: Cache, seed: int, symbol: Any) -> None:
    rng = np.random.default_rng(seed)
    function = random_function(rng, symbol)
    for checked in (function, directional_derivative(function), function.jacobian()):
        compiled = compile_function(checked, cache)
        assert isinstance(compiled, CompiledFunction)
        inputs = [rng.standard_normal(shape) for shape in compiled.input_shapes]
        found = compiled(*inputs)
        # CasADi's (r, c) is NumPy's (c, r): transpose in, transpose out.
        reference = checked.call([ca.DM(i.T if i.ndim == 2 else i) for i in inputs])
        for name, expected in zip(compiled.output_names, reference, strict=True):
            plain = np.array(ca.densify(expected)).T.reshape(found[name].shape)
            assert relative_difference(plain, found[name]) <= 1e-10


def test_shapes_follow_the_convention(make: Make) -> None:
    function = make(small())
    assert function.input_shapes == ((3,), (4, 2))
    assert function.output_shapes == ((4, 2), (3,), ())
    x, y = np.arange(3.0), np.arange(8.0).reshape(4, 2)
    found = function(x, y)
    np.testing.assert_array_equal(found["a"], 2.0 * y)
    np.testing.assert_array_equal(found["b"], 5.0 * x)
    assert found["c"] == 3.0
    assert [found[name].shape for name in "abc"] == list(function.output_shapes)


def test_batch_equals_loop_to_the_bit(make: Make) -> None:
    rng = np.random.default_rng(1)
    function = make(random_function(rng, ca.MX))
    matrices = rng.standard_normal((37, *function.input_shapes[0]))
    vector = rng.standard_normal(function.input_shapes[1])
    singles = [function(matrix, vector) for matrix in matrices]
    for threads in (1, 2, 3, 0):
        found = function.batch(matrices, vector, threads=threads)
        for k, single in enumerate(singles):
            for name in function.output_names:
                np.testing.assert_array_equal(found[name][k], single[name])


def test_a_prepared_batch_equals_a_batch_to_the_bit(make: Make) -> None:
    """Also on arrays that it is given."""
    rng = np.random.default_rng(1)
    function = make(random_function(rng, ca.MX))
    name, rows = function.output_names[0], slice(2, 13)
    matrices = np.zeros((15, *function.input_shapes[0]))
    own = np.zeros((15, *function.output_shapes[0]))
    prepared = function.prepared(11, ["vector"], {"matrix": matrices[rows], name: own[rows]})
    for count in (11, 4, 1, 0, 11):
        matrices[2 : 2 + count] = rng.standard_normal((count, *function.input_shapes[0]))
        vector = rng.standard_normal(function.input_shapes[1])
        prepared.inputs["vector"][...] = vector
        found = prepared(count)
        expected = function.batch(matrices[2 : 2 + count], vector)
        for each in function.output_names:
            np.testing.assert_array_equal(found[each][:count], expected[each])
        np.testing.assert_array_equal(own[2 : 2 + count], expected[name])
    assert prepared() is found
    assert not own[:2].any()
    assert not own[13:].any()
    with refused(CodegenError, "too-many-evaluations", 11):
        prepared(12)
    with refused(CodegenError, "wrong-array", "matrix"):
        function.prepared(4, ["vector"], {"matrix": matrices[rows]})


def test_c_evaluates_a_prepared_batch_as_python_does(cache: Cache) -> None:
    rng = np.random.default_rng(4)
    function = compile_function(random_function(rng, ca.MX), cache)
    prepared = function.prepared(9)
    for array in prepared.inputs.values():
        array[...] = rng.standard_normal(array.shape)
    expected = {name: array.copy() for name, array in prepared().items()}
    for array in prepared.outputs.values():
        array[...] = np.nan
    native = prepared.native
    assert native is not None
    run = ctypes.CFUNCTYPE(ctypes.c_longlong, *[ctypes.c_void_p] * 2, *[ctypes.c_longlong] * 2)
    assert run(native.one)(native.ports, native.work, 0, 4) == -1
    lanes = (native.lanes, native.lane_work) if native.lanes else (native.one, native.work)
    assert run(lanes[0])(native.ports, lanes[1], 4, 9) == -1
    for name, wanted in expected.items():
        np.testing.assert_array_equal(prepared.outputs[name], wanted)


def test_what_is_empty_stays_empty(make: Make) -> None:
    found = make(small()).batch(np.empty((0, 3)), np.zeros((4, 2)))
    shapes = {name: array.shape for name, array in found.items()}
    assert shapes == {"a": (0, 4, 2), "b": (0, 3), "c": (0,)}
    x, nothing = ca.MX.sym("x", 2), ca.MX.sym("nothing", 0, 1)
    function = make(ca.Function("f", [x, nothing], [nothing, 3.0 * x], ["x", "n"], ["n2", "y"]))
    found = function(np.ones(2), np.empty(0))
    assert found["n2"].shape == (0,)
    np.testing.assert_array_equal(found["y"], [3.0, 3.0])


def test_sparse_becomes_dense(make: Make) -> None:
    lower = ca.MX.sym("lower", ca.Sparsity.lower(3))
    x = ca.MX.sym("x", 3)
    product = ca.Function("product", [lower, x], [lower @ x, lower], ["L", "x"], ["y", "copy"])
    function = make(product)
    matrix = np.arange(1.0, 10.0).reshape(3, 3)
    found = function(matrix.T, np.array([1.0, -2.0, 0.5]))
    np.testing.assert_allclose(found["y"], np.tril(matrix) @ [1.0, -2.0, 0.5], rtol=1e-15)
    np.testing.assert_array_equal(found["copy"].T, np.tril(matrix))


def test_nan_and_infinity_pass_through(make: Make) -> None:
    found = make(small())(np.array([np.nan, 1.0, 2.0]), np.full((4, 2), np.inf))
    assert np.isnan(found["b"]).all()
    assert np.isnan(found["c"])
    assert np.isposinf(found["a"]).all()


LAYOUTS: dict[str, Any] = {
    "strided": np.arange(6.0)[::2],
    "integers": np.array([0, 2, 4]),
    "single precision": np.array([0.0, 2.0, 4.0], np.float32),
    "big endian": np.array([0.0, 2.0, 4.0], ">f8"),
    "unaligned": np.frombuffer(b"\0" + np.array([0.0, 2.0, 4.0]).tobytes(), np.float64, 3, 1),
    "list": [0.0, 2.0, 4.0],
}


def test_any_layout_is_taken(make: Make) -> None:
    function = make(small())
    for layout, x in LAYOUTS.items():
        found = function(x, np.asfortranarray(np.arange(8.0).reshape(4, 2)))
        np.testing.assert_array_equal(found["b"], [0.0, 40.0, 80.0], err_msg=layout)
        np.testing.assert_array_equal(found["a"], 2.0 * np.arange(8.0).reshape(4, 2))


VECTOR, MATRIX, LOCKED = np.zeros(3), np.zeros((4, 2)), np.zeros((5, 4, 2))
LOCKED.flags.writeable = False
WRONG: list[tuple[tuple[Any, ...], str]] = [
    ((VECTOR,), "input-count"),
    ((np.zeros(4), MATRIX), "input-shape"),
    ((VECTOR, np.zeros((2, 4))), "input-shape"),
    ((np.zeros(3, complex), MATRIX), "input-type"),
    ((["a", "b", "c"], MATRIX), "input-type"),
    (([[1.0], [1.0, 2.0], []], MATRIX), "input-type"),
]
WRONG_BATCHES: list[tuple[tuple[Array, Array], int, str]] = [
    ((VECTOR, MATRIX), 1, "no-leading-axis"),
    ((np.zeros((5, 3)), np.zeros((6, 4, 2))), 1, "candidate-count"),
    ((np.zeros((5, 4)), MATRIX), 1, "input-shape"),
    ((np.zeros((5, 3)), MATRIX), -1, "threads"),
]


def test_wrong_inputs_batches_and_memory_are_told(make: Make) -> None:
    function = make(small())
    for inputs, code in WRONG:
        with refused(CodegenError, code):
            function(*inputs)
    for batches, threads, code in WRONG_BATCHES:
        with refused(CodegenError, code):
            function.batch(*batches, threads=threads)
    wrong: Any
    for wrong in (LOCKED, LOCKED.astype(np.float32), np.empty((5, 4, 4))[:, :, ::2], np.empty(40)):
        with refused(CodegenError, "wrong-array", "'a'"):
            function.prepared(5, given={"a": wrong})


def test_maximum_and_minimum_yield_to_numbers(cache: Cache) -> None:
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    function = ca.Function("extremes", [x, y], [ca.fmax(x, y), ca.fmin(x, y)])
    compiled = compile_function(function, cache)
    values = np.array([-np.inf, -1.5, 0.0, 2.0, np.inf, np.nan])
    for a in values:
        for b in values:
            high, low = compiled(a, b).values()
            np.testing.assert_array_equal(high, np.fmax(a, b))
            np.testing.assert_array_equal(low, np.fmin(a, b))


@pytest.mark.parametrize(
    ("reference", "other", "expected"),
    [
        ([2.0, 1.0], [2.0, 1.5], 0.25),
        ([np.nan, 4.0], [np.nan, 3.0], 0.25),
        ([np.nan, 4.0], [0.0, 4.0], np.inf),
        ([0.0, 4.0], [np.nan, 4.0], np.inf),
        ([np.inf], [-np.inf], np.inf),
        ([], [], 0.0),
        ([0.0], [1e-17], 1e-11),
    ],
)
def test_relative_difference(reference: list[float], other: list[float], expected: float) -> None:
    found = relative_difference(np.array(reference), np.array(other))
    assert found == pytest.approx(expected)


def test_another_function_is_told_apart(cache: Cache) -> None:
    x = ca.SX.sym("x", 2)
    function = ca.Function("f", [x], [ca.sin(x)], ["x"], ["y"])
    shifted = ca.Function("f", [x], [ca.sin(x) + 1e-9], ["x"], ["y"])
    bounds = {"x": (np.full(2, 0.5), np.full(2, 1.0))}
    rng = np.random.default_rng(0)
    same = compare(function, compile_function(function, cache), bounds, rng, cache=cache)
    assert same.agrees
    other = compare(function, compile_function(shifted, cache), bounds, rng, cache=cache)
    assert not other.agrees
    assert other.worst_output == "y"
    assert 1e-9 <= other.outputs < 3e-9


def test_inputs_stay_within_their_bounds(cache: Cache) -> None:
    """Outside the bounds this function is NaN, which would hide every difference."""
    x = ca.SX.sym("x", 2)
    inside = ca.if_else(ca.logic_and(x[0] > 3.0, x[0] < 4.0), x[0], 1e3)
    function = ca.Function("f", [x], [inside], ["x"], ["y"])
    other = ca.Function("f", [x], [x[0]], ["x"], ["y"])
    bounds = {"x": (np.full(2, 3.0), np.full(2, 4.0))}
    rng = np.random.default_rng(0)
    assert compare(function, compile_function(other, cache), bounds, rng, cache=cache).agrees
    loose = {"x": (np.full(2, 2.0), np.full(2, 5.0))}
    assert not compare(function, compile_function(other, cache), loose, rng, cache=cache).agrees


def test_many_threads_share_one_function(cache: Cache) -> None:
    rng = np.random.default_rng(3)
    function = compile_function(random_function(np.random.default_rng(2), ca.MX), cache)
    cases = [[rng.standard_normal(s) for s in function.input_shapes] for _ in range(400)]
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(lambda case: function(*case), cases))
    for case, one in zip(cases, found, strict=True):
        for name, value in function(*case).items():
            np.testing.assert_array_equal(one[name], value)


def test_other_threads_run_during_a_batch(cache: Cache) -> None:
    """The interpreter's lock is free while candidates are computed, so that cores add up."""
    x = ca.SX.sym("x")
    step = ca.Function("step", [x], [ca.sin(x) + 0.5])
    slow = compile_function(step.mapaccum("slow", 1000), cache)
    with ThreadPoolExecutor(1) as pool:
        running = pool.submit(slow.batch, np.zeros(40_000))
        turns = 0
        while not running.done():
            time.sleep(0.001)
            turns += 1
    # The lock held, this thread would get a turn before and one after.
    assert turns > 10


def test_functions_with_memory_in_threads(cache: Cache, capfd: pytest.CaptureFixture[str]) -> None:
    """A solver keeps state in its generated code, without a guard of its own."""
    x, target = ca.SX.sym("x", 2), ca.SX.sym("p", 2)
    solver = ca.nlpsol(
        "solver",
        "sqpmethod",
        {"x": x, "p": target, "f": ca.sumsqr(x - target) + ca.sumsqr(x) ** 2},
        {
            "qpsol": "qrqp",
            "print_header": False,
            "print_iteration": False,
            "print_time": False,
            "print_status": False,
            "qpsol_options": {"print_iter": False, "print_header": False, "print_info": False},
        },
    )
    p = ca.MX.sym("p", 2)
    function = compile_function(
        ca.Function("nearest", [p], [solver(x0=[0.0, 0.0], p=p)["x"]], ["p"], ["x"]), cache
    )
    assert isinstance(function, CompiledFunction)
    points = np.random.default_rng(4).standard_normal((20_000, 2))
    serial = function.batch(points, threads=1)["x"]
    parallel = function.batch(points, threads=4)["x"]
    capfd.readouterr()
    np.testing.assert_array_equal(serial, parallel)
    gradient = 2.0 * (serial - points) + 4.0 * np.sum(serial**2, axis=1, keepdims=True) * serial
    assert np.abs(gradient).max() < 1e-5


def test_a_forked_child_has_threads_of_its_own(cache: Cache, tmp_path: Path) -> None:
    function = compile_function(small(), cache)
    inputs = (np.ones((16, 3)), np.ones((4, 2)))
    expected = function.batch(*inputs, threads=2)["b"]
    reply = tmp_path / "reply.npy"
    child = os.fork()
    if child == 0:
        np.save(reply, function.batch(*inputs, threads=2)["b"])
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
    np.testing.assert_array_equal(np.load(reply), expected)
