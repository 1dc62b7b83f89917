"""Options that are no number, or none of the range, are refused before any work."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Literal, get_args, get_origin

import pytest

from studies import robust
from studies.__main__ import programs
from studies.options import PathType, force, number, seed, stated, whole
from tests.symbolic.cells import ROOT

CAMPAIGN = (
    *("evaluations", "replicas", "seed"),
    *("constraint_handling", "first_generation"),
)
"""Settings whose defaults `studies.run` tells."""

ODD = ("", " ", "a", "nan", "1e400", "-1", "9" * 5000, "\ud800", "1_000_000_000_000_000_000_000")


@pytest.mark.parametrize("text", ODD)
@pytest.mark.parametrize("kind", [whole(0, 10**6), number(0.0, 1e6), seed, force])
def test_odd_values_are_refused_in_one_line(kind: Callable[[str], object], text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError) as caught:
        kind(text)
    said = str(caught.value)
    assert said.startswith("found ")
    assert "; allowed " in said
    assert said.isprintable()
    assert len(said) < 120


def test_the_ends_belong_to_the_range() -> None:
    assert [whole(2, 5)(text) for text in ("2", "5")] == [2, 5]
    assert [number(-0.5, 1e3)(text) for text in ("-0.5", "1e3")] == [-0.5, 1e3]
    for text in ("1", "6", "3.0"):
        with pytest.raises(argparse.ArgumentTypeError):
            whole(2, 5)(text)


def test_the_source_states_what_the_module_says() -> None:
    """Of every default and choice that an option of a program takes from the source."""
    asked = {
        name
        for path in (ROOT / "studies").rglob("*.py")
        for name in re.findall(r"""\bstated\(\s*["']([\w.]+)["']""", path.read_text("utf-8"))
    }
    asked |= {f"hybrid_opt.campaign.settings.CampaignSettings.{name}" for name in CAMPAIGN}
    assert len(asked) > 15
    for name in asked:
        owner, _, last = name.rpartition(".")
        package, _, kind = owner.rpartition(".")
        within = getattr(import_module(package), kind) if kind[0].isupper() else None
        value = getattr(within or import_module(owner), last)
        if get_origin(value) is Literal:
            value = get_args(value)
        elif isinstance(value, Mapping):
            value = tuple(value)
        assert stated(name) == value


def test_what_the_source_does_not_state_is_an_error() -> None:
    with pytest.raises(LookupError):
        stated("hybrid_opt.campaign.settings.CampaignSettings.wishes")


CHECKED = {
    **dict.fromkeys(
        ("rack", "run"),
        {"--evaluations", "--replicas", "--seed", "--jobs", "--polish-attempts"}
        | {"--drivable-replicas"},
    ),
    "export": {"--squeeze", "--smoothing", "--step", "--stiffness", "--skew"},
    "replay": {"--force-curve"},
    "research.algorithms": {"--seeds", "--evaluations", "--population"},
    "research.control": {"--evaluations"},
}
"""Numbers by program that are checked where they are used, mostly by a settings record."""


@pytest.mark.parametrize("name", programs())
def test_numbers_of_a_program_have_ranges(name: str) -> None:
    bare = set()
    for action in import_module(programs()[name][0]).main.parser()._actions:
        if action.type in (int, float) and action.choices is None:
            bare.add(action.option_strings[0])
        elif action.type not in (None, int, float) and not isinstance(action.type, PathType):
            for text in ODD:
                with pytest.raises(argparse.ArgumentTypeError, match=r"found .*; allowed "):
                    action.type(text)
    assert bare == CHECKED.get(name, set())


def test_programs_say_what_is_allowed(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        robust.main(["t.json", "--cases", "0"])
    assert caught.value.code == 2
    assert "--cases: found '0'" in capsys.readouterr().err
