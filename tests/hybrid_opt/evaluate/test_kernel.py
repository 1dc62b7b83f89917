"""Evaluation in lanes: the one-by-one evaluator's verdicts, for every width and batch."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from codegen import compiled as compiled_module
from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.evaluations import Evaluations
from hybrid_opt.evaluate.kernel import Kernel, SampledVerdicts, load_kernel, one_by_one
from symbolic.array import Array
from symbolic.functions import SAMPLE_NAMES, force_sizes
from symbolic.read.cell import load
from symbolic.records.task import initial_decision
from tests.hybrid_opt.evaluate.test_evaluation import TRANSFER, candidates
from tests.symbolic.cells import RACK

UNEVEN = RACK.parent / "uneven.toml"

FIELDS = ("objectives", "penalised", "feasible", "reason", "position", "violation_time")


@cache
def fused(
    path: Path, objectives: tuple[str, ...] = ("peak_force_1", "peak_force_2")
) -> CandidateEvaluator:
    made = CandidateEvaluator(load(path), objectives)
    assert made._kernel is not None
    return made


@cache
def stepwise(
    path: Path, objectives: tuple[str, ...] = ("peak_force_1", "peak_force_2")
) -> CandidateEvaluator:
    workcell = load(path)
    made = CandidateEvaluator(workcell, objectives, functions=CompiledCell(workcell).evaluators)
    assert made._kernel is None
    return made


def kernel(path: Path, lanes: int) -> Kernel:
    ours = fused(path)
    made = load_kernel(ours.compiled, ours.checker, ours.outputs, lanes=lanes)
    assert made is not None
    assert made.lanes == lanes or lanes == 0
    return made


def mixed(path: Path, n: int, seed: int) -> Array:
    """Candidates within the bounds, and some far beyond them, which lose the path."""
    workcell = load(path)
    parts = [candidates(workcell, n - 2 * (n // 4), seed, 1.0)]
    parts += [candidates(workcell, n // 4, seed + 1, widening) for widening in (3.0, 8.0)]
    x = np.concatenate(parts)
    np.random.default_rng(seed).shuffle(x)
    return x


def assert_same(found: Evaluations, expected: Evaluations) -> None:
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), name)
    np.testing.assert_array_equal(found.violation, expected.violation)


def assert_same_samples(found: SampledVerdicts, expected: SampledVerdicts) -> None:
    for name, values in found.outputs.items():
        np.testing.assert_array_equal(values, expected.outputs[name], name)
    for name in ("first_sample", "first_reason", "colliding"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), name)


@pytest.mark.parametrize("path", [RACK, TRANSFER], ids=["rack", "transfer"])
def test_verdicts_are_those_of_one_by_one(path: Path) -> None:
    x = mixed(path, 400, 1)
    found = fused(path).evaluate(x)
    assert_same(found, stepwise(path).evaluate(x))
    assert len(set(found.reason.tolist())) >= 4


@pytest.mark.slow
def test_verdicts_of_twenty_thousand_candidates_are_those_of_one_by_one() -> None:
    """Half uniform, half near good carries, as a search's are."""
    workcell = load(RACK)
    x = mixed(RACK, 10_000, 2)
    verdicts = fused(RACK).evaluate(x)
    best = x[np.argsort(verdicts.penalised.sum(axis=1))[:200]]
    rng = np.random.default_rng(0)
    width = workcell.task.upper - workcell.task.lower
    near = best[rng.integers(0, 200, 10_000)] + 0.05 * width * rng.standard_normal(
        (10_000, len(width))
    )
    for some in (x, near):
        assert_same(fused(RACK).evaluate(some), stepwise(RACK).evaluate(some))


@pytest.mark.parametrize(
    "lanes", [0, 2, *(pytest.param(lanes, marks=pytest.mark.slow) for lanes in (4, 8))]
)
def test_every_width_and_batch_gives_the_same_bits(lanes: int) -> None:
    x = mixed(RACK, 27, 3)
    ours = fused(RACK)
    whole = one_by_one(ours.outputs(x), ours.checker)
    made = kernel(RACK, lanes)
    assert_same_samples(made.evaluate(x, tuple(SAMPLE_NAMES)), whole)
    for n in (1, 2, 9):
        part = made.evaluate(x[:n], ("normal_force",))
        np.testing.assert_array_equal(
            part.outputs["normal_force"], whole.outputs["normal_force"][:n]
        )
        np.testing.assert_array_equal(part.colliding, whole.colliding[:n])
    empty = made.evaluate(x[:0], ("q_1",))
    assert empty.colliding.shape == (0, 100)
    assert empty.outputs["q_1"].shape == (0, 100, 6)


def test_threads_and_small_rooms_change_nothing() -> None:
    x = mixed(RACK, 60, 4)
    made = kernel(RACK, 0)
    expected = made.evaluate(x, ("q_2",))
    assert_same_samples(made.evaluate(x, ("q_2",), threads=3), expected)
    # Room for one pass at a time: the kernel hands its open pairs on after every few candidates.
    made._room -= 4000
    assert_same_samples(made.evaluate(x, ("q_2",)), expected)


def test_a_candidate_that_is_no_number_disturbs_no_other() -> None:
    x = mixed(RACK, 9, 5)
    expected = fused(RACK).evaluate(x)
    x_bad = np.insert(x, 4, np.nan, axis=0)
    found = fused(RACK).evaluate(x_bad)
    assert not found.feasible[4]
    assert np.isfinite(found.penalised).all()
    assert_same(found[np.arange(10) != 4], expected)


@pytest.mark.parametrize(
    "objectives",
    [("mean_force", "duration"), ("peak_torque_use", "force_imbalance", "friction_use")],
)
def test_every_objective_gets_what_it_needs(objectives: tuple[str, ...]) -> None:
    x = mixed(RACK, 30, 6)
    assert_same(fused(RACK, objectives).evaluate(x), stepwise(RACK, objectives).evaluate(x))


@pytest.mark.parametrize("lanes", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_forces_that_come_last_are_those_of_one_by_one(lanes: int) -> None:
    """Where a program finds them: of all where that is wanted, else of what violates nothing."""
    x, ours, made = mixed(UNEVEN, 21, 7), fused(UNEVEN), kernel(UNEVEN, lanes)
    x[::4] = initial_decision(ours.workcell.task)
    whole, names = one_by_one(ours.outputs(x), ours.checker), tuple(SAMPLE_NAMES)
    assert_same_samples(made.evaluate(x, names, all_forces=True), whole)
    found = made.evaluate(x, names, threads=2)
    kept = (found.first_reason < 0) & ~found.colliding.any(axis=1)
    assert 5 < np.count_nonzero(kept) < 21
    for name in force_sizes(ours.workcell).keys() & SAMPLE_NAMES:
        np.testing.assert_array_equal(found.outputs[name][kept], whole.outputs[name][kept], name)
        assert not found.outputs[name][~kept].any(), name
    for name in ("violation", "violation_time", "q_1", "constraint"):
        np.testing.assert_array_equal(found.outputs[name][kept], whole.outputs[name][kept], name)
    np.testing.assert_array_equal(found.colliding, whole.colliding)
    verdicts, expected = ours.evaluate(x), stepwise(UNEVEN).evaluate(x)
    for name in ("penalised", "feasible", "reason", "position", "violation", "violation_time"):
        np.testing.assert_array_equal(getattr(verdicts, name), getattr(expected, name), name)


def test_a_kernel_that_differs_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    ours = fused(RACK)
    monkeypatch.setattr(compiled_module, "_warned", False)

    def others(x: Array) -> dict[str, Array]:
        outputs = ours.outputs(x)
        return outputs | {"q_1": np.nextafter(outputs["q_1"], np.inf)}

    with pytest.warns(RuntimeWarning, match="it differs from the functions"):
        assert load_kernel(ours.compiled, ours.checker, others) is None
