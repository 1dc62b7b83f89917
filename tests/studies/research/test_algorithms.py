"""Research programs: algorithms on analytic problems, reference fronts, locked joints."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from hybrid_opt.cell import Cell
from hybrid_opt.errors import ResultsError
from hybrid_opt.indicators.statistics import summarise
from studies.research import algorithms
from studies.research.analytic import judge
from studies.research.best_front import ReferenceFront, encode, read_reference_front
from studies.research.locked_joints import as_text, compare, locks
from symbolic.errors import SettingsError
from symbolic.read.cell import load
from tests.odd_cells import free_pandas
from tests.refusals import refused
from tests.symbolic.read.samples import RACK


@pytest.mark.parametrize(
    ("values", "reference", "higher_is_better", "verdict"),
    [
        ([0.9, 1.0, 1.1], 1.0, True, "inside"),
        ([0.9, 1.0, 1.1], 1.2, True, "inside"),
        ([0.9, 1.0, 1.1], 1.4, True, "worse"),
        ([0.9, 1.0, 1.1], 1.4, False, "better"),
        ([0.9, 1.0, 1.1], 0.6, False, "worse"),
        ([0.0, 0.0], 0.0, True, "inside"),
        ([1.0], 1.0, True, None),
    ],
)
def test_verdicts(
    values: list[float], reference: float, higher_is_better: bool, verdict: str | None
) -> None:
    # Three standard errors of .1 against the same spread of ten: 3 * .1 * sqrt(1/3 + 1/10) = .197.
    # With 1.2 the difference .2 lies outside, so that case states its own spread.
    std = 0.2 if reference == 1.2 else None
    assert (
        judge(summarise(values), reference, higher_is_better=higher_is_better, std=std) == verdict
    )


ARGUMENTS = ["--seeds", "2", "--evaluations", "200", "--problems", "tnk", "shifted-zdt1"]


def test_json_repeats_to_the_digit(capsys: pytest.CaptureFixture[str]) -> None:
    documents = []
    for _ in range(2):
        assert algorithms.main([*ARGUMENTS, "--json"]) == 0
        document = json.loads(capsys.readouterr().out)
        for score in document["scores"]:
            assert score.pop("overhead_us") > 0.0
        documents.append(document)
    assert documents[0] == documents[1]
    assert [score["algorithm"] for score in documents[0]["scores"]] == ["mopso", "nsga2"] * 2


@pytest.mark.parametrize(
    ("arguments", "quoted"),
    [
        (["--problems", "zdt9"], "'zdt9'"),
        (["--algorithms", "pso"], "'pso'"),
        (["--seeds", "0"], " 1 "),
        (["--evaluations", "99"], "100 evaluations"),
        (["--population", "0", "--problems", "tnk"], "swarm is 0"),
    ],
)
def test_wrong_arguments(
    arguments: list[str], quoted: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert algorithms.main(arguments) == 2
    error = capsys.readouterr().err
    assert quoted in error
    assert len(error.splitlines()) == 1


HEAD = b"# made with: a\n# workcell: b\npeak_force_1,peak_force_2,x_1\n"


def test_a_front_comes_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    front = ReferenceFront("0" * 64, rng.random((5, 2)), rng.random((5, 18)))
    path = tmp_path / "front.csv"
    path.write_bytes(encode(front, "a command"))
    found = read_reference_front(path)
    assert found.digest == front.digest
    np.testing.assert_array_equal(found.objectives, front.objectives)
    np.testing.assert_array_equal(found.x, front.x)
    assert not found.x.flags.writeable


@pytest.mark.parametrize(
    "content",
    [
        b"",
        HEAD,
        HEAD + b"1,2\n",
        HEAD + b"1,2,3\n4,5\n",
        HEAD + b"1,2,nan\n",
        HEAD + b"1,2,1e999\n",
        HEAD + b"1,2,a\n",
        HEAD + b"1,2,\xff\n",
        HEAD + b"1,2,3\n" * 400_000,
    ],
)
def test_what_is_none_is_told(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "front.csv"
    path.write_bytes(content)
    with refused(ResultsError, "no-reference-front", path) as caught:
        read_reference_front(path)
    assert "\n" not in str(caught.value)


def test_locks_are_a_grid_within_the_bounds(tmp_path: Path) -> None:
    task = free_pandas(tmp_path, "initial = 0.1, lower = [-1.0, -0.2, 0.0], upper = 1.0").task
    found = np.array(locks(task, 16))
    assert found.shape == (16, 2)
    np.testing.assert_allclose(np.unique(found[:, 0]), [-0.75, -0.25, 0.25, 0.75])
    assert len({tuple(row) for row in found.tolist()}) == 16
    assert len(locks(task, 10)) == 16


@pytest.mark.slow
def test_a_small_comparison(tmp_path: Path) -> None:
    cell = Cell(free_pandas(tmp_path, "initial = 0.1"))
    (one,) = compare(cell, 4, 1, 60, 1)
    assert len(one.locked) == 4
    assert one.best == locks(cell.workcell.task, 4)[int(np.argmax(one.locked))]
    better = int(one.free > max(one.locked))
    assert re.search(rf"\b{better} of 1\b", as_text([one]).splitlines()[-1])


def test_a_cell_without_redundant_joints_has_nothing_to_compare() -> None:
    with refused(SettingsError, "nothing-redundant"):
        compare(Cell(load(RACK)), 16, 1, 60, 1)
