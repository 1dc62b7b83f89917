"""`python -m studies.research.algorithms`."""

from __future__ import annotations

import json

import pytest

from hybrid_opt.indicators.statistics import summarise
from studies.research import algorithms
from studies.research.analytic import judge


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
    ("arguments", "message"),
    [
        (["--problems", "zdt9"], "unknown test problem 'zdt9'"),
        (["--algorithms", "pso"], "unknown algorithm 'pso'"),
        (["--seeds", "0"], "at least 1 seed"),
        (["--evaluations", "99"], "100 evaluations (the population)"),
        (["--population", "0", "--problems", "tnk"], "swarm is 0"),
    ],
)
def test_wrong_arguments(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert algorithms.main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error
    assert len(error.splitlines()) == 1
