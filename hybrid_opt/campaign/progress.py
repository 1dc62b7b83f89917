"""Progress of a long computation on the terminal, with the remaining time."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from tqdm import tqdm

Advance = Callable[[int], None]
"""Tells how many more units are done."""

_QUIET_SECONDS = 10.0
"""Between lines where the terminal is none, as in a log."""


class Progress:
    """Shows one stage at a time as a line on standard error.

    Attributes:
        shown: False to show nothing.
        of: what the stages belong to, in front of their titles.
    """

    def __init__(self, shown: bool = True, of: str = "") -> None:
        self.shown = shown
        self.of = of

    @contextmanager
    def stage(
        self, title: str, total: int, unit: str, done: int = 0, delay: float = 0.0
    ) -> Iterator[Advance]:
        """A line for the time of the `with` block.

        Args:
            title: what is being done.
            total: units in all.
            unit: what is counted.
            done: units that an earlier attempt did.
            delay: what is over sooner is not shown [s].
        """
        bar = tqdm(
            total=total,
            initial=done,
            desc=f"{self.of} {title}".strip(),
            unit=f" {unit}",
            file=sys.stderr,
            mininterval=0.2 if sys.stderr.isatty() else _QUIET_SECONDS,
            miniters=0,  # to tell of nothing new tells how long it has been going on
            delay=delay,
            dynamic_ncols=True,
            disable=not self.shown,
            bar_format="{desc}: {n_fmt} of {total_fmt}{unit} [{elapsed} gone, {remaining} left]",
        )
        with bar:

            def advance(count: int) -> None:
                bar.update(count)

            yield advance

    def note(self, text: str) -> None:
        """A line of its own."""
        if self.shown:
            tqdm.write(text, file=sys.stderr)
