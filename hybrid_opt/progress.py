"""How far a call is: a bar in the terminal or notebook, or a function of the caller's."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Literal

Progress = Literal[False, True] | Callable[[int, int], None]
"""Whether to show a bar, or what is called with the units done and those in all."""


@contextmanager
def counted(progress: Progress, what: str, total: int) -> Iterator[Callable[[int], None]]:
    """Count the units of a call.

    Args:
        what: stands before the bar.
        total: units in all.

    Yields:
        What tells that so many more are done.
    """
    if progress is True:
        from tqdm.auto import tqdm

        with tqdm(total=total, desc=what, dynamic_ncols=True) as bar:
            yield lambda count: (bar.update(count), None)[1]
        return
    done = 0

    def advance(count: int) -> None:
        nonlocal done
        done += count
        if callable(progress):
            progress(done, total)

    yield advance
