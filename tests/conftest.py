"""Settings for the whole test suite: on CI, property tests draw the same examples every time, what
is compiled is compiled quickly unless CC is set, and Ctrl-C reaches the programs that tests start.
"""

from __future__ import annotations

import os
import shlex
import signal
from pathlib import Path

import pytest
from hypothesis import settings

from codegen.cache import Cache

settings.register_profile("local", deadline=None, print_blob=True, max_examples=40)
settings.register_profile("ci", settings.get_profile("local"), derandomize=True, database=None)
settings.register_profile("night", settings.get_profile("local"), max_examples=400)
settings.load_profile("ci" if os.environ.get("CI") else "local")

os.environ.setdefault("CC", shlex.join(["bash", str(Path(__file__).with_name("quick-cc"))]))

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell that starts pytest in the background has it ignore Ctrl-C, which children inherit.
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Cache:
    """An empty cache of compiled functions, also the default one of the test."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("DUAL_ARM_CACHE", str(folder))
    return Cache(folder)
