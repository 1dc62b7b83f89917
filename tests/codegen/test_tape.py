"""Tapes against CasADi's own interpreter, and against what is compiled in lanes."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

from codegen.build import compile_function, load_or_build
from codegen.cache import Cache
from codegen.interpreted import InterpretedFunction, interpret
from codegen.native import Tape, TapeFunction, compiled_tape
from symbolic.array import Array
from symbolic.errors import BridgeError
from tests.refusals import refused

X = ca.SX.sym("x", 3, 2)
Y = ca.SX.sym("y", 2)
UNUSUAL = [np.nan, np.inf, -np.inf, 0.0, -0.0, 1.0, -1.0, 1e-300, 1e300]


def every_operation(angles: bool = True) -> ca.Function:
    """Apply every operation that the tape knows to what may be any number.

    Args:
        angles: False leaves sine and cosine out, of which the tape has its own.
    """
    x, y = X[0], X[1]
    single = [
        -x, x**2, 2 * x, 1 / x, ca.sqrt(x), ca.fabs(x), ca.sign(x), ca.logic_not(x), ca.tan(x),
        ca.asin(x), ca.acos(x), ca.atan(x), ca.exp(x), ca.log(x),
        ca.floor(x), ca.ceil(x), x**3.5, ca.SX(0.25),
    ]  # fmt: skip
    double = [
        x + y, x - y, x * y, x / y, ca.fmin(x, y), ca.fmax(x, y), x < y, x <= y, x == y, x != y,
        ca.logic_and(x, y), ca.logic_or(x, y), ca.if_else(x, y, 0), ca.atan2(x, y), x**y,
    ]  # fmt: skip
    turned = [ca.sin(x), ca.cos(x), ca.sin(1e6 * y)] if angles else []
    several = ca.vertcat(*single, *double, *turned) * Y[0]
    return ca.Function("every", [X, Y], [several, X.T + Y[1]], ["x", "y"], ["several", "turned"])


def one_by_one(function: ca.Function, x: Array, y: Array) -> list[Array]:
    """Evaluate samples (n, 2, 3) and (n, 2) by CasADi."""
    rows = [function(a.T, b) for a, b in zip(x, y, strict=True)]
    return [np.array([np.array(row[k]) for row in rows]) for k in (0, 1)]


def samples(rng: np.random.Generator, n: int) -> tuple[Array, Array]:
    """Draw inputs (n, 2, 3) and (n, 2), a part of which is unusual."""
    x, y = rng.normal(0.0, 2.0, (n, 2, 3)), rng.normal(0.0, 2.0, (n, 2))
    x.flat[::2] = rng.choice(UNUSUAL, x.flat[::2].shape)
    return x, y


def taped(function: ca.Function) -> TapeFunction:
    tape = Tape.of(function)
    assert tape is not None
    return TapeFunction(tape)


@pytest.mark.parametrize("n", [1, 2, 8, 9, 31, 32, 33, 40, 100])
def test_a_tape_gives_the_bits_of_casadi(n: int) -> None:
    function = every_operation(angles=False)
    x, y = samples(np.random.default_rng(n), n)
    expected = one_by_one(function, x, y)
    found = taped(function).batch(x, y)
    np.testing.assert_array_equal(found["several"], expected[0][:, :, 0])
    np.testing.assert_array_equal(found["turned"], expected[1].swapaxes(1, 2))


def test_sine_and_cosine_are_those_of_casadi_but_for_the_last_place() -> None:
    function = every_operation()
    x, y = samples(np.random.default_rng(1), 500)
    expected = one_by_one(function, x, y)[0][:, :, 0]
    found = taped(function).batch(x, y)["several"]
    np.testing.assert_allclose(found, expected, rtol=5e-16, atol=0.0)


@pytest.mark.parametrize("n", [1, 9, 40])
def test_a_tape_gives_the_bits_of_what_is_compiled_in_lanes(cache: Cache, n: int) -> None:
    """Also of slopes, and one by one: a function may be compiled or taped."""
    every = every_operation()
    x, y = samples(np.random.default_rng(n), n)
    for function in (every, every.forward(1)):
        tape, compiled = taped(function), compile_function(function, cache, lanes=0)
        rng = np.random.default_rng(0)
        rest = [rng.normal(size=(n, *shape)) for shape in tape.input_shapes[2:]]
        found, expected = tape.batch(x, y, *rest), compiled.batch(x, y, *rest)
        for name in tape.output_names:
            np.testing.assert_array_equal(found[name], expected[name])
        first = [array[0] for array in (x, y, *rest)]
        for name, values in tape(*first).items():
            np.testing.assert_array_equal(values, found[name][0])


def test_sparse_outputs_and_inputs_are_dense_in_numpy() -> None:
    x = ca.SX.sym("x", ca.Sparsity.lower(3))
    function = ca.Function("f", [x], [2.0 * x, ca.diag(ca.diag(x))], ["x"], ["twice", "diagonal"])
    given = np.random.default_rng(0).normal(size=(5, 3, 3))
    found = taped(function).batch(given)
    # CasADi's lower triangle is the upper one of its transpose.
    np.testing.assert_array_equal(found["twice"], 2.0 * np.triu(given))
    expected = np.einsum("nii,ij->nij", given, np.eye(3))
    np.testing.assert_array_equal(found["diagonal"], expected)


def test_an_input_may_have_one_value_for_all_samples() -> None:
    function, rng = every_operation(), np.random.default_rng(0)
    x, y = rng.normal(size=(40, 2, 3)), rng.normal(size=2)
    found = taped(function).batch(x, y)
    expected = taped(function).batch(x, np.tile(y, (40, 1)))
    np.testing.assert_array_equal(found["several"], expected["several"])


def test_of_prepared_samples_the_first_are_evaluated() -> None:
    function, rng = every_operation(), np.random.default_rng(0)
    batch = taped(function).prepared(50)
    x, y = rng.normal(size=(50, 2, 3)), rng.normal(size=(50, 2))
    batch.inputs["x"][:], batch.inputs["y"][:] = x, y
    batch(20)
    expected = taped(function).batch(x[:20], y[:20])
    np.testing.assert_array_equal(batch.outputs["several"][:20], expected["several"])
    assert not batch.outputs["several"][20:].any()


def test_what_is_no_function_of_known_scalars_is_left_to_casadi() -> None:
    unknown = ca.Function("unknown", [X], [ca.erf(X)], ["x"], ["y"])
    matrices = ca.MX.sym("x", 3, 3)
    whole = ca.Function("whole", [matrices], [ca.inv(matrices)], ["x"], ["y"])
    assert Tape.of(unknown) is None
    assert Tape.of(whole) is None
    assert isinstance(interpret(every_operation()), TapeFunction)
    found = interpret(whole)
    assert isinstance(found, InterpretedFunction)
    x = np.random.default_rng(0).normal(size=(5, 3, 3))
    np.testing.assert_allclose(found.batch(x)["y"], np.linalg.inv(x), rtol=1e-12)


def test_a_set_is_loaded_from_its_tapes_and_libraries(
    cache: Cache, monkeypatch: pytest.MonkeyPatch
) -> None:
    matrices = ca.MX.sym("x", 3, 3)
    whole = ca.Function("whole", [matrices], [ca.inv(matrices)], ["x"], ["y"])
    functions = {"scalars": every_operation(), "matrices": whole}
    made = load_or_build("set", lambda: functions, cache, lanes=1, taped=True)
    stored = sorted(path.suffix for path in cache.folder.iterdir() if path.suffix != ".lock")
    assert (stored.count(".npy"), stored.count(".so")) == (1, 1)

    def never() -> dict[str, ca.Function]:
        raise AssertionError

    again = load_or_build("set", never, cache, lanes=1, taped=True)
    x, y = samples(np.random.default_rng(0), 7)
    for name, value in again["scalars"].batch(x, y).items():
        np.testing.assert_array_equal(value, made["scalars"].batch(x, y)[name])
    other = SimpleNamespace(OPERATIONS=compiled_tape().OPERATIONS[::-1])
    with monkeypatch.context() as patched:
        # Numbers of operations mean others in another version of the module.
        patched.setattr("codegen.build.compiled_tape", lambda: other)
        with pytest.raises(AssertionError):
            load_or_build("set", never, cache, lanes=1, taped=True)
    (tape,) = (path for path in cache.folder.iterdir() if path.suffix == ".npy")
    tape.write_bytes(tape.read_bytes()[:-8])
    with pytest.raises(AssertionError):
        load_or_build("set", never, cache, lanes=1, taped=True)


@pytest.mark.parametrize("wrong", [(99, 0, 0), (4, 5, 0), (4, 0, 5), (4, -1, 0)])
def test_instructions_outside_the_work_memory_are_refused(wrong: tuple[int, int, int]) -> None:
    operation, result, operand = wrong
    with pytest.raises(IndexError):
        compiled_tape().Tape(np.array([[operation, result, operand, 0]]), np.zeros(1), 1, 2)


@pytest.fixture
def fresh_tape() -> Iterator[None]:
    """Forget the module that was loaded, before and after."""
    compiled_tape.cache_clear()
    yield
    compiled_tape.cache_clear()


@pytest.mark.usefixtures("fresh_tape")
def test_a_missing_module_is_told_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "codegen._tape", None)
    with refused(BridgeError, "not-loadable", "pip install -e ."):
        Tape.of(every_operation())
