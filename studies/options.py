"""Types of command line options: what a number may be is said before any work begins."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable

LARGEST_SEED = 2**63 - 1


def whole(low: int, high: int) -> Callable[[str], int]:
    """A type of options that takes whole numbers of a range, ends included."""

    def read(text: str) -> int:
        try:
            value = int(text)
        except ValueError:  # also from thousands of digits
            value = low - 1
        if not low <= value <= high:
            raise _refusal(text, f"a whole number {low} to {high}")
        return value

    return read


def number(low: float, high: float) -> Callable[[str], float]:
    """A type of options that takes finite numbers of a range, ends included."""

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise _refusal(text, f"a number {low:g} to {high:g}")
        return value

    return read


seed = whole(0, LARGEST_SEED)
"""The type of seeds."""


force = number(1e-3, 1e6)
"""The type of normal forces [N]."""


def add_leader(parser: argparse._ActionsContainer) -> None:
    """Add which arm keeps its place while the other is force-controlled; counted from 1."""
    parser.add_argument(
        "--leader",
        type=int,
        choices=(1, 2),
        default=1,
        help="the arm that keeps its place (default: %(default)s)",
    )


def _refusal(text: str, allowed: str) -> argparse.ArgumentTypeError:
    shown = ascii(text) if len(text) <= 40 else f"{text[:37]!a}..."
    return argparse.ArgumentTypeError(f"found {shown}; allowed is {allowed}")
