"""What is known of paths between their samples, so that none is certified twice.

Carries of different force limits often share a path, on which alone their collisions depend.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from symbolic.array import Array

MOST_KNOWN = 4096
"""Paths that are remembered; then it begins anew."""


class KnownProofs:
    """Remembers where paths fail. A resource: one per evaluator and start postures."""

    def __init__(self) -> None:
        self._known: dict[bytes, float | None] = {}

    def failures(
        self, paths: Array, find: Callable[[NDArray[np.intp]], list[float | None]]
    ) -> list[float | None]:
        """Path parameter where each of some paths (n, n_path) fails, None where none does.

        Args:
            find: answers for some of their rows, no path twice.
        """
        keys = [path.tobytes() for path in np.ascontiguousarray(paths)]
        new = {key: row for row, key in enumerate(keys) if key not in self._known}
        if new:
            found = find(np.array(list(new.values())))
            if len(self._known) + len(new) > MOST_KNOWN:
                self._known = {key: self._known[key] for key in keys if key in self._known}
            self._known.update(zip(new, found, strict=True))
        return [self._known[key] for key in keys]
