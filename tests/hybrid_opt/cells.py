"""Cells that ship, loaded once per test process: models and compiled functions are shared."""

from __future__ import annotations

from functools import cache

from hybrid_opt.cell import Cell
from tests.symbolic.cells import RACK


@cache
def shipped(name: str) -> Cell:
    """A cell of `studies/workcells`."""
    return Cell.load(RACK.with_name(f"{name}.toml"))


@cache
def drivable(name: str) -> Cell:
    """The same as robots drive it."""
    return shipped(name).drivable()
