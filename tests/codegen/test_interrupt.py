"""Ctrl-C while compilers work."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from codegen.build import build
from codegen.cache import Cache
from tests.codegen.test_build import SET, functions
from tests.waiting import HANGS, soon, until


@pytest.mark.parametrize("to_all", [True, False])
def test_ctrl_c_ends_the_compilers_and_keeps_what_is_compiled(
    cache: Cache, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, to_all: bool
) -> None:
    """As a terminal sends it, to the whole group of processes, and to this process alone."""
    compiler, left = tmp_path / "slow-cc", tmp_path / "left"
    compiler.write_text(
        '#!/bin/sh\ncase "$*" in -v|*" -E "*|*square*) exec gcc "$@" ;; esac\n'
        f'echo $$ > "{left}"\nsleep 600\n'
    )
    compiler.chmod(0o755)
    monkeypatch.setenv("CC", str(compiler))
    program = (
        "import signal\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n"
        + SET
        + "from codegen.build import build, load_or_build\n"
        "build({'square': functions['square']})\n"
        "try:\n    load_or_build('cell', lambda: functions)\n"
        "except KeyboardInterrupt:\n    print('interrupted')\n"
        "print(build({'square': functions['square']}, rebuild=True).reports[0].from_cache)\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    until(lambda: left.exists() and bool(left.read_text()), process)
    with soon():  # of the 600 s that the compiler would take
        (os.killpg if to_all else os.kill)(process.pid, signal.SIGINT)
        # Compilers begin again with what is asked for next.
        assert process.communicate(timeout=HANGS) == ("interrupted\nFalse\n", "")
        until(lambda: not is_left(int(left.read_text())))
    assert build({"square": functions()["square"]}, cache).reports[0].from_cache


def is_left(group: int) -> bool:
    """Whether any process of a group is."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True
