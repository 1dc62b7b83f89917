"""A cache of its own for every test."""

from __future__ import annotations

from pathlib import Path

import pytest

from codegen.cache import Cache


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Cache:
    """An empty cache, also the default one of the test."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("DUAL_ARM_CACHE", str(folder))
    return Cache(folder)
