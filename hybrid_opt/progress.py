"""Progress of work: lines on standard error, a bar, or a function of the caller's."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Literal, NoReturn, Protocol, TypeVar

from tqdm import TqdmWarning, tqdm

T = TypeVar("T")

ShowProgress = Literal[False, True] | Callable[[int, int], None]
"""Whether to show a bar, or what is called with the units done and those in all."""


class Advance(Protocol):
    """Takes the number of further units done, and the total if it has changed."""

    def __call__(self, count: int, total: int | None = None, /) -> None:
        """Advance the progress."""


@contextmanager
def progress_bar(progress: ShowProgress, what: str, total: int) -> Iterator[Advance]:
    """Count the units of a call.

    Args:
        what: stands before the bar.
        total: units in all.
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
    """Adapt an open progress bar to a `progress(done, total)` callback."""
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
    """Yield the items of a call, counting each when the next is requested."""
    with progress_bar(progress, what, len(items)) as advance:
        for item in items:
            yield item
            advance(1)


_QUIET_SECONDS = 10.0
"""Between lines where the terminal is none, as in a log."""


class Progress:
    """Shows one stage at a time as a line on standard error.

    Attributes:
        shown: False to show nothing.
        of: name in front of the stages' titles.
    """

    def __init__(self, shown: bool = True, of: str = "") -> None:
        self.shown = shown
        self.of = of

    @contextmanager
    def stage(
        self, title: str, total: int, unit: str, done: int = 0, delay: float = 0.0
    ) -> Iterator[Advance]:
        """Show a line during the `with` block.

        Args:
            title: the current work.
            total: units in all.
            unit: name of a counted unit.
            done: units that an earlier attempt did.
            delay: shorter work is not shown [s].
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
        """Print a line of its own."""
        if self.shown:
            tqdm.write(text, file=sys.stderr)
