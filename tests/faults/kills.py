"""Studies that are killed at random moments of every stage, resumed, and compared with one that is
left in peace.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from tests.symbolic.cells import ROOT

CELL = ROOT / "studies" / "workcells" / "transfer.toml"
SMALL = (
    *("--evaluations", "60", "--replicas", "2", "--polish-attempts", "1", "--seed", "3"),
    *("--population", "nsga2=20", "--population", "mopso=20", "--jobs", "2"),
)
STAGES = ("search", "polish", "drivable", "recommendation", "summary", "timing", "report")
BEGINNING = "beginning"
"""Before the first stage: the cell is read and its functions are compiled or loaded."""

TIMES = {
    "seconds",
    "evaluation_seconds",
    "median_attempt_seconds",
    "equivalent_evaluations",
}
"""Figures that are times, or follow from them."""

ENDS = {0, 2, 130, -signal.SIGINT, -signal.SIGKILL, -signal.SIGTERM}
PATIENCE = 300.0
ORPHANS_END = 60.0
"""So many seconds [s] after its parent's death a worker may still be there."""


def study(output: Path, resume: bool, report: bool) -> list[str]:
    """The command of a study."""
    options = ["--resume"] if resume else []
    options += ["--report" if report else "--no-report"]
    where = ["--quiet", "--output", str(output)]
    return [sys.executable, "-m", "studies.run", str(CELL), *SMALL, *where, *options]


def started(command: list[str], said: Path) -> subprocess.Popen[bytes]:
    """A program in a session of its own, so that all it starts can be found."""
    with said.open("wb") as messages:
        return subprocess.Popen(
            command,
            cwd=ROOT,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=messages,
            start_new_session=True,
        )


def session(leader: int) -> list[int]:
    """The living processes of a session, other than its leader."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal() and int(entry.name) != leader:
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if int(fields[3]) == leader and fields[0] != "Z":
                found.append(int(entry.name))
    return found


def strike(process: subprocess.Popen[bytes], way: str, rng: random.Random) -> None:
    """Let a program die in this way, or lose a worker where it has any."""
    others, number = session(process.pid), signal.SIGKILL
    struck = [process.pid, *others]
    match way:
        case "kill":
            struck = [process.pid]
        case "interrupt":  # as a terminal does it: all of the foreground hear it
            number = signal.SIGINT
        case "terminate":
            struck, number = [process.pid], signal.SIGTERM
        case "kill a worker":
            struck = rng.sample(others, min(1, len(others)))
    for one in struck:
        with suppress(ProcessLookupError):
            os.kill(one, number)


def ended(process: subprocess.Popen[bytes], said: Path) -> int:
    """Wait for a program's end and hold it to its promises; the exit code."""
    code = process.wait(timeout=PATIENCE)
    words = said.read_text(errors="replace")
    assert code in ENDS, f"exit code {code}, said:\n{words[-4000:]}"
    assert "Traceback" not in words, words[-4000:]
    assert words.strip() or code not in (2, 130, -signal.SIGINT), f"exit code {code}, no message"
    begin = time.monotonic()
    while session(process.pid):
        assert time.monotonic() - begin < ORPHANS_END, "workers outlive their program"
        time.sleep(0.1)
    return code


def running(output: Path) -> str:
    """The stage that a study is at."""
    return next((stage for stage in STAGES if _status(output, stage) == "running"), "between")


def _status(output: Path, stage: str) -> str:
    with suppress(OSError, ValueError, KeyError):
        return str(json.loads((output / "stages" / f"{stage}.json").read_text())["status"])
    return ""


def wait_for(stage: str, output: Path, process: subprocess.Popen[bytes]) -> None:
    """Wait until a stage is running or done, or the program has ended."""
    while process.poll() is None and _status(output, stage) not in ("running", "done"):
        time.sleep(0.01)


def linger(seconds: float, stage: str, output: Path, process: subprocess.Popen[bytes]) -> None:
    """Let a stage run for a while, but neither into the next one nor to the program's end."""
    end = time.monotonic() + seconds
    while time.monotonic() < end and process.poll() is None and _status(output, stage) != "done":
        time.sleep(0.005)


def contents(root: Path) -> dict[str, Any]:
    """Every file of a results folder; of JSON the values, without times."""
    found: dict[str, Any] = {}
    for path in sorted(root.rglob("*")):
        name = path.relative_to(root).as_posix()
        if path.is_file() and not any(part.startswith(".") for part in name.split("/")):
            content = path.read_bytes()
            found[name] = _timeless(json.loads(content)) if path.suffix == ".json" else content
    return found


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _timeless(inner) for key, inner in value.items() if key not in TIMES}
    return [_timeless(inner) for inner in value] if isinstance(value, list) else value


def differences(first: dict[str, Any], second: dict[str, Any]) -> list[str]:
    """Names of files that are missing on one side or differ."""
    return sorted(
        name for name in first.keys() | second.keys() if first.get(name) != second.get(name)
    )


def undisturbed(folder: Path, report: bool) -> tuple[dict[str, Any], dict[str, float]]:
    """The contents of a study left in peace, and what its stages took [s]."""
    folder.mkdir()
    output, said = folder / "results", folder / "said"
    assert ended(started(study(output, False, report), said), said) == 0, said.read_text()
    stages = [path for stage in STAGES if (path := output / "stages" / f"{stage}.json").exists()]
    took = {path.stem: float(json.loads(path.read_text())["seconds"]) for path in stages}
    return contents(output), took | {BEGINNING: took["search"]}
