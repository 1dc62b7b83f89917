"""The benchmark: honest ratios, sensible derived cells, the promised speed."""

from __future__ import annotations

import json
import time
from typing import Any

import numpy as np
import pytest

from studies.research import benchmark, costs, side_by_side, turns
from studies.research.costs import report
from studies.research.turns import SLICE, Evaluate, interleaved, summary
from symbolic.array import Array
from tests.symbolic.cells import RACK, hand_cell

PROMISED_RATIO = 1000.0
"""How many times faster than the plain version the compiled evaluator has to be."""

PROMISED_RATIO_WITH_COLLISIONS = 1000.0


def busy(milliseconds: float) -> Evaluate:
    """A way that uses the processor for a given time."""

    def evaluate(_: Array) -> None:
        end = time.thread_time() + 1e-3 * milliseconds
        while time.thread_time() < end:
            pass

    return evaluate


def test_ratios_are_those_of_the_ways() -> None:
    x = np.zeros((2, 2))
    ways = {"compiled": busy(0.5), "interpreted": busy(2.0), "plain": busy(10.0)}
    result = summary(interleaved(ways, dict.fromkeys(ways, x), 2))
    assert result["plain_over_compiled"] == pytest.approx(20.0, rel=0.1)
    assert result["interpreted_over_compiled"] == pytest.approx(4.0, rel=0.1)
    assert result["compiled_ms"] == pytest.approx(0.5, rel=0.1)


def test_every_way_sees_every_candidate_in_every_round() -> None:
    seen: dict[str, list[float]] = {"a": [], "b": []}

    def recorder(name: str) -> Evaluate:
        def evaluate(x: Array) -> None:
            seen[name].append(float(x[0]))
            busy(1.1e3 * SLICE)(x)  # longer than a slice: once per round

        return evaluate

    x = np.arange(3.0)[:, None]
    times = interleaved({n: recorder(n) for n in seen}, dict.fromkeys(seen, x), 2)
    for name, values in seen.items():
        # Two evaluations come before the rounds: a first one, and one to choose the repetitions.
        assert values[2:] == [0.0, 1.0, 2.0] * 2
        assert times[name].shape == (6,)


def test_fast_ways_go_on_with_the_next_candidates_within_a_round() -> None:
    seen: list[float] = []

    def fast(x: Array) -> None:
        seen.append(float(x[0]))
        busy(1e3 * SLICE / 2.5)(x)

    interleaved({"fast": fast}, {"fast": np.arange(4.0)[:, None]}, 1)
    # Three calls fill a slice; two evaluations come before the rounds.
    assert seen[2:] == [0.0, 1.0, 2.0, 1.0, 2.0, 3.0, 2.0, 3.0, 0.0, 3.0, 0.0, 1.0]


@pytest.mark.parametrize("count", range(1, 9))
def test_derived_tasks_keep_the_ends_and_stay_on_the_trajectory(count: int) -> None:
    task = hand_cell().task
    derived = costs.with_free_waypoints(task, count)
    assert derived.n_var == 6 * count
    assert derived.waypoints[0] is task.waypoints[0]
    assert derived.waypoints[-1] is task.waypoints[-1]
    middle = (derived.lower + derived.upper) / 2.0
    np.testing.assert_allclose(middle, derived.initial.reshape(-1), atol=1e-15)
    if count == len(task.initial):
        np.testing.assert_allclose(derived.initial, task.initial, atol=1e-15)


@pytest.mark.slow
def test_compares_cells(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The pandas are meshes; a ratio is that of the times."""
    monkeypatch.setattr(side_by_side, "EVALUATIONS", 60)
    pandas = str(RACK.with_name("pandas.toml"))
    arguments = [str(RACK), "--beside", pandas, "--json", "--candidates", "2", "--repeats", "1"]
    assert benchmark.main(arguments) == 0
    rack, other = json.loads(capsys.readouterr().out)
    assert (rack["near"], rack["random"], rack["search"], rack["hulls"]) == (1.0, 1.0, 1.0, 0)
    assert other["hulls"] > 10
    for what in ("near", "random"):
        assert other[what] == pytest.approx(other[f"{what}_ms"] / rack[f"{what}_ms"])
        assert other[what] < 4.0
    assert other["search"] == other["search_s"] / rack["search_s"]


@pytest.mark.slow
def test_measures_the_rack_and_keeps_its_promises(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(costs, "SAMPLE_COUNTS", (25, 50, 100))
    monkeypatch.setattr(costs, "WAYPOINTS", (1, 3))
    monkeypatch.setattr(turns, "TURN_EVALUATIONS", 200)
    arguments = [str(RACK), "--json", "--candidates", "5", "--repeats", "2"]
    assert benchmark.main(arguments) == 0
    result: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert result["plain_over_compiled"] > PROMISED_RATIO
    assert result["interpreted_over_compiled"] > 1.0
    assert result["compiled_ms"] < result["interpreted_ms"] < result["plain_ms"]
    collisions = result["with_collisions"]
    for figures in (collisions, collisions["random"]):
        assert figures["plain_over_compiled"] > PROMISED_RATIO_WITH_COLLISIONS
        assert result["compiled_ms"] < figures["compiled_ms"] < figures["interpreted_ms"]
        assert figures["plain_ms"] > result["plain_ms"]
        assert sum(figures["shares"].values()) == pytest.approx(1.0)
        assert all(0.0 < share < 1.0 for share in figures["shares"].values())
    assert 0.01 < collisions["share_of_peak"] < 1.0
    assert collisions["feasible_share"] > collisions["random"]["feasible_share"]
    scaling = result["scaling"]
    assert [entry["samples"] for entry in scaling["samples"]] == [25, 50, 100]
    assert [entry["waypoints"] for entry in scaling["waypoints"]] == [1, 3]
    assert scaling["samples_line"]["largest_relative_deviation"] < 0.25
    assert report(result).startswith(result["workcell"])
