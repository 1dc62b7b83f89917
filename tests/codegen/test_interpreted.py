"""Instructions over many samples at once, against CasADi's own interpreter."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import casadi as ca
import numpy as np
import pytest

from codegen.interpreted import InterpretedFunction, compiled_tape, tape_of
from symbolic.array import Array
from symbolic.errors import BridgeError
from tests.refusals import refused

X = ca.SX.sym("x", 3, 2)
Y = ca.SX.sym("y", 2)
UNUSUAL = [np.nan, np.inf, -np.inf, 0.0, -0.0, 1.0, -1.0, 1e-300, 1e300]


def every_operation() -> ca.Function:
    """Apply every operation that the tape knows to what may be any number."""
    x, y = X[0], X[1]
    single = [
        -x, x**2, 2 * x, 1 / x, ca.sqrt(x), ca.fabs(x), ca.sign(x), ca.logic_not(x), ca.sin(x),
        ca.cos(x), ca.tan(x), ca.asin(x), ca.acos(x), ca.atan(x), ca.exp(x), ca.log(x),
        ca.floor(x), ca.ceil(x), x**3.5, ca.SX(0.25),
    ]  # fmt: skip
    double = [
        x + y, x - y, x * y, x / y, ca.fmin(x, y), ca.fmax(x, y), x < y, x <= y, x == y, x != y,
        ca.logic_and(x, y), ca.logic_or(x, y), ca.if_else(x, y, 0), ca.atan2(x, y), x**y,
    ]  # fmt: skip
    several = ca.vertcat(*single, *double) * Y[0]
    return ca.Function("every", [X, Y], [several, X.T + Y[1]], ["x", "y"], ["several", "turned"])


def one_by_one(function: ca.Function, x: Array, y: Array) -> list[Array]:
    """Evaluate samples (n, 2, 3) and (n, 2) by CasADi."""
    rows = [function(a.T, b) for a, b in zip(x, y, strict=True)]
    return [np.array([np.array(row[k]) for row in rows]) for k in (0, 1)]


@pytest.mark.parametrize("n", [2, 31, 32, 33, 100])
def test_instructions_over_samples_give_the_bits_of_casadi(n: int) -> None:
    function, rng = every_operation(), np.random.default_rng(n)
    assert tape_of(function) is not None
    x, y = rng.normal(0.0, 2.0, (n, 2, 3)), rng.normal(0.0, 2.0, (n, 2))
    x.flat[::2] = rng.choice(UNUSUAL, x.flat[::2].shape)
    expected = one_by_one(function, x, y)
    found = InterpretedFunction(function).batch(x, y)
    np.testing.assert_array_equal(found["several"], expected[0][:, :, 0])
    np.testing.assert_array_equal(found["turned"], expected[1].swapaxes(1, 2))


def test_an_input_may_have_one_value_for_all_samples() -> None:
    function, rng = every_operation(), np.random.default_rng(0)
    x, y = rng.normal(size=(40, 2, 3)), rng.normal(size=2)
    found = InterpretedFunction(function).batch(x, y)
    expected = one_by_one(function, x, np.tile(y, (40, 1)))
    np.testing.assert_array_equal(found["several"], expected[0][:, :, 0])


def test_of_prepared_samples_the_first_are_evaluated() -> None:
    function, rng = every_operation(), np.random.default_rng(0)
    batch = InterpretedFunction(function).prepared(50)
    x, y = rng.normal(size=(50, 2, 3)), rng.normal(size=(50, 2))
    batch.inputs["x"][:], batch.inputs["y"][:] = x, y
    batch(20)
    expected = one_by_one(function, x[:20], y[:20])
    np.testing.assert_array_equal(batch.outputs["several"][:20], expected[0][:, :, 0])
    assert not batch.outputs["several"][20:].any()


def test_what_is_no_function_of_known_scalars_is_left_to_casadi() -> None:
    unknown = ca.Function("unknown", [X], [ca.erf(X)], ["x"], ["y"])
    matrices = ca.MX.sym("x", 3, 3)
    whole = ca.Function("whole", [matrices], [ca.inv(matrices)], ["x"], ["y"])
    assert tape_of(unknown) is None
    assert tape_of(whole) is None
    x = np.random.default_rng(0).normal(size=(5, 3, 3))
    found = InterpretedFunction(whole).batch(x)["y"]
    np.testing.assert_allclose(found, np.linalg.inv(x), rtol=1e-12)


@pytest.mark.parametrize("wrong", [(99, 0, 0), (4, 5, 0), (4, 0, 5), (4, -1, 0)])
def test_instructions_outside_the_work_memory_are_refused(wrong: tuple[int, int, int]) -> None:
    operation, result, operand = wrong
    with pytest.raises(IndexError):
        compiled_tape().Tape([operation], [result], [operand], [0], [0.0], 2)


@pytest.fixture
def fresh_tape() -> Iterator[None]:
    """Forget the module that was loaded, before and after."""
    compiled_tape.cache_clear()
    yield
    compiled_tape.cache_clear()


@pytest.mark.usefixtures("fresh_tape")
def test_a_missing_module_is_told_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "codegen._tape", None)
    with refused(BridgeError, "bridge", "pip install -e ."):
        tape_of(every_operation())
