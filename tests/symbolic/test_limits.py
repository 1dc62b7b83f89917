"""The table of limits fits the records, the layouts and the C of the passes that follow from it."""

from __future__ import annotations

import re
from dataclasses import fields
from importlib.resources import files

import numpy as np

from hybrid_opt.timing.records import TimingLimits
from symbolic.limits import LIMITS, limit_layout, limits_of_block, passes_enumeration
from symbolic.path_motion import ARM_OUTPUTS, BOX_OUTPUTS
from symbolic.smooth.driven import driven_layout
from tests.symbolic.cells import hand_cell


def test_names_and_symbols_are_unique() -> None:
    assert len({limit.name for limit in LIMITS}) == len(LIMITS)
    assert len({limit.symbol for limit in LIMITS}) == len(LIMITS)


def test_every_symbol_and_group_stands_in_the_passes() -> None:
    text = files("hybrid_opt.timing").joinpath("c/passes.c").read_text()
    declared = passes_enumeration()
    for limit in LIMITS:
        assert re.search(rf"\b{limit.symbol}\b", declared)
    # The second cone is the one after the first.
    used = [limit.symbol for limit in LIMITS if limit.symbol != "BOX_TURN_ACCELERATION"]
    assert all(re.search(rf"\b{symbol}\b", text) for symbol in used)
    first, second = (limit.symbol for limit in limits_of_block("cone"))
    assert f"{first}, {second}" in declared


def test_options_bounds_and_quantities_exist() -> None:
    cell, options = hand_cell(), {field.name for field in fields(TimingLimits)}
    outputs = {*ARM_OUTPUTS, *BOX_OUTPUTS, "pose_first", "pose_second"}
    holders = {"joint": cell.robots, "payload": (cell.payload,), "robot": cell.contacts}
    for limit in LIMITS:
        assert not limit.option or limit.option in options
        if limit.bound:
            bounds = [getattr(holder, limit.bound) for holder in holders[limit.scope]]
            assert all(np.all(np.asarray(bound) > 0.0) for bound in bounds)
        if limit.path:
            assert {f"{limit.path}_first", f"{limit.path}_second"} <= outputs


def test_layouts_have_the_blocks_of_the_limits() -> None:
    blocks = {limit.block for limit in LIMITS}
    # The passes find torque and pressure from wrenches.
    assert blocks - set(limit_layout(hand_cell()).sizes) == {"pressure"}
    assert blocks <= set(driven_layout(hand_cell()).sizes)
