"""Display of the progress of work: as lines on standard error, as a bar, or by a function that the
caller gives.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Literal, NoReturn, Protocol, TypeVar

from tqdm import TqdmWarning, tqdm

T = TypeVar("T")

ShowProgress = Literal[False, True] | Callable[[int, int], None]
"""True for a progress bar, False for none, or a function that is called with the number of units
done and the total."""


class Advance(Protocol):
    """Function with which work reports its progress to a display."""

    def __call__(self, count: int, total: int | None = None, /) -> None:
        """Report further progress.

        Args:
            count: number of units that were done since the last report.
            total: new total number of units; None if it has not changed.
        """


@contextmanager
def progress_bar(progress: ShowProgress, what: str, total: int) -> Iterator[Advance]:
    """Show the progress of a call inside the `with` block. Yield the function by which the call
    reports progress.

    Args:
        progress: True for a bar, False for none, or a function of the finished and the total number
            of units.
        what: text in front of the bar.
        total: number of units in all.
    """
    if progress is True:
        with warnings.catch_warnings():
            # A notebook without ipywidgets gets a bar of text, and needs no advice for it.
            warnings.simplefilter("ignore", TqdmWarning)
            from tqdm.auto import tqdm

        with tqdm(total=total, desc=what, dynamic_ncols=True) as bar:

            def show(count: int, total: int | None = None) -> None:
                _set_total(bar, total)
                bar.update(count)

            yield show
        return
    done = 0

    def advance(count: int, now: int | None = None) -> None:
        nonlocal done, total
        done, total = done + count, total if now is None else now
        if callable(progress):
            progress(done, total)

    yield advance


def as_callback(advance: Advance) -> Callable[[int, int], None]:
    """Return a function of the finished and the total number of units that reports to an open
    display.

    Args:
        advance: function that reports progress to the display.
    """
    before = 0

    def tell(done: int, total: int) -> None:
        nonlocal before
        advance(done - before, total)
        before = done

    return tell


def _set_total(bar: tqdm[NoReturn], total: int | None) -> None:
    if total is not None and total != bar.total:
        bar.total = total
        bar.refresh()


def track(progress: ShowProgress, what: str, items: Sequence[T]) -> Iterator[T]:
    """Yield items and show progress: an item counts as done when the next one is requested.

    Args:
        progress: True for a bar, False for none, or a function of the finished and the total number
            of items.
        what: text in front of the bar.
        items: items to yield.
    """
    with progress_bar(progress, what, len(items)) as advance:
        for item in items:
            yield item
            advance(1)


_QUIET_SECONDS = 10.0
"""Least time between two progress lines where standard error is not a terminal, as in a log [s]."""


class Progress:
    """Display of the progress of a program's current stage, in one line on standard error.

    Attributes:
        shown: False to show nothing.
        of: text in front of the titles of stages.
    """

    def __init__(self, shown: bool = True, of: str = "") -> None:
        self.shown = shown
        self.of = of

    @contextmanager
    def stage(
        self, title: str, total: int, unit: str, done: int = 0, delay: float = 0.0
    ) -> Iterator[Advance]:
        """Show a line of progress inside the `with` block, and yield the function that reports
        progress.

        Args:
            title: name of the stage.
            total: number of units in all.
            unit: name of the units, as 'replicas'.
            done: number of units that were finished before this stage began, as by an interrupted
                run.
            delay: time before the line appears, so that short work shows none [s].
        """
        bar = tqdm(
            total=total,
            initial=done,
            desc=f"{self.of} {title}".strip(),
            unit=f" {unit}",
            file=sys.stderr,
            mininterval=0.2 if sys.stderr.isatty() else _QUIET_SECONDS,
            miniters=0,  # the time goes on where nothing new is done
            delay=delay,
            dynamic_ncols=True,
            disable=not self.shown,
            bar_format="{desc}: {n_fmt} of {total_fmt}{unit} [{elapsed} gone, {remaining} left]",
        )
        with bar:

            def advance(count: int, total: int | None = None) -> None:
                _set_total(bar, total)
                if bar.total is not None and bar.n + count > bar.total:
                    bar.total = None  # more than expected: the rest is unknown
                bar.update(count)

            yield advance

    def note(self, text: str) -> None:
        """Print a text on a line of its own, without disturbing the line of progress."""
        if self.shown:
            tqdm.write(text, file=sys.stderr)
