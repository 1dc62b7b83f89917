from __future__ import annotations

import tomllib

import pytest

from hybrid_opt.proposing.problem import completed, merged
from symbolic.errors import SettingsError

TEXT = """# A cell.
name = "cell"   # its name

[[robots]]
name = "a"

[[robots.tool]]
name = "pad"

[[robots]]
name = "b"

[task]
start = [0.0, 1.0]
initial = [[1.0]]

# What stands there.
[[environment]]
name = "post"
"""


def test_comments_stay_and_values_are_set() -> None:
    changes = {
        "robots": [{"start_branch": 2}, {"base": {"xyz": [0.0, 0.0, 1.0]}}],
        "task": {"initial": None, "waypoints": [{"lower": [0.0]}, {"lower": [1.0]}]},
    }
    found = completed(TEXT, tomllib.loads(TEXT), changes)
    assert "# A cell." in found
    assert '"cell"   # its name' in found
    assert "# What stands there." in found
    said = tomllib.loads(found)
    assert said["robots"][0] == {"name": "a", "start_branch": 2, "tool": [{"name": "pad"}]}
    assert said["robots"][1] == {"name": "b", "base": {"xyz": [0.0, 0.0, 1.0]}}
    assert said["task"] == {"start": [0.0, 1.0], "waypoints": [{"lower": [0.0]}, {"lower": [1.0]}]}
    assert said["environment"] == [{"name": "post"}]


def test_without_text_all_of_it_is_written() -> None:
    data = tomllib.loads(TEXT)
    assert tomllib.loads(completed("", data, {"task": {"goal": [1.0]}})) == merged(
        data, {"task": {"goal": [1.0]}}
    )


def test_lists_of_tables_of_another_length_are_replaced() -> None:
    assert merged({"a": [{"x": 1}]}, {"a": [{"y": 1}, {"y": 2}]}) == {"a": [{"y": 1}, {"y": 2}]}
    assert merged({"a": [{"x": 1}]}, {"a": [{"y": 1}]}) == {"a": [{"x": 1, "y": 1}]}


def test_text_that_says_something_else_is_refused() -> None:
    with pytest.raises(SettingsError, match="cannot be completed"):
        completed(TEXT, {"name": "another"}, {})
