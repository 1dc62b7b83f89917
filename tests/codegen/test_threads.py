"""Compiled functions in several threads, and in a forked child."""

from __future__ import annotations

import os
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from codegen.build import compile_function
from codegen.cache import Cache
from codegen.compiled import CompiledFunction
from tests.codegen.samples import random_function, small


def test_many_threads_share_one_function(cache: Cache) -> None:
    function = compile_function(random_function(np.random.default_rng(2), ca.MX), cache)
    rng = np.random.default_rng(3)
    cases = [[rng.standard_normal(s) for s in function.input_shapes] for _ in range(400)]
    expected = [function(*case) for case in cases]
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(lambda case: function(*case), cases))
    for one, other in zip(expected, found, strict=True):
        for name in function.output_names:
            np.testing.assert_array_equal(one[name], other[name])


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
