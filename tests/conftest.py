"""Settings for the whole test suite.

On CI, property tests draw the same examples every time; what is compiled is compiled quickly unless
CC is set; Ctrl-C reaches the programs that tests start. Tests are marked by their rooms.
"""

from __future__ import annotations

import fcntl
import os
import shlex
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import settings

from codegen.cache import Cache

ROOMS = {
    "compiled": (
        *("codegen", "faults", "fuzz", "hybrid_opt", "studies"),
        "symbolic/functions/test_candidate.py",
    ),
    "process": (
        *("faults", "hybrid_opt/test_workers.py", "studies/programs", "studies/study"),
        *("fuzz/test_memory.py", "fuzz/test_programs.py", "hybrid_opt/campaign/test_search.py"),
        *("studies/test_program.py", "symbolic/read/test_xacro_file.py", "test_docs.py"),
    ),
    "browser": (
        "hybrid_opt/display/test_view.py",
        "hybrid_opt/extras/workbench/test_live_page.py",
        "studies/report/test_report_browser.py",
    ),
    "heavy": (
        "symbolic/contact/test_even_grasp.py",
        "symbolic/contact/test_grasp.py",
        "symbolic/contact/test_payload_load.py",
        "symbolic/geometry/test_clearance.py",
        "symbolic/read/test_machines.py",
        "symbolic/robot/test_branches.py",
    ),
}
"""Files and folders by what their tests need beside this process, or that they take long: whole
models and conic programs. Single tests say so themselves."""

PLAIN = (
    "hybrid_opt/extras/calibrating",
    "hybrid_opt/display/test_solids.py",
    "hybrid_opt/display/test_table.py",
    "hybrid_opt/indicators/test_metrics.py",
    "hybrid_opt/metaheuristics/test_run.py",
    "hybrid_opt/metaheuristics/test_mopso.py",
    "hybrid_opt/polishing/test_climbing.py",
    "hybrid_opt/extras/proposing/test_problem.py",
    "hybrid_opt/timing/test_adapter.py",
    "studies/test_options.py",
)
"""What compiles nothing in rooms where most tests do."""

TESTS = Path(__file__).parent

settings.register_profile("local", deadline=None, print_blob=True, max_examples=25)
settings.register_profile("ci", settings.get_profile("local"), derandomize=True, database=None)
settings.register_profile("night", settings.get_profile("local"), max_examples=400)
settings.load_profile("ci" if os.environ.get("CI") else "local")

# By its text, not its path, which is part of the key of what it makes: checkouts share a cache.
os.environ.setdefault("CC", shlex.join(["bash", "-c", (TESTS / "quick-cc").read_text(), "cc"]))

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell that starts pytest in the background has it ignore Ctrl-C, which children inherit.
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_configure(config: pytest.Config) -> None:
    """Where tests that compile are left out, there is no compiler: what lacks the mark fails."""
    expression = str(config.option.markexpr)
    if expression.startswith("not") and "compiled" in expression:
        os.environ["CC"] = "none-without-the-mark-compiled"


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests by their rooms; those that take long begin, so that no worker is left alone with
    them in the end."""
    for item in items:
        path = item.path.relative_to(TESTS)
        places = {path.as_posix(), *(folder.as_posix() for folder in path.parents)}
        for mark, rooms in ROOMS.items():
            if places & set(rooms) and not (mark == "compiled" and places & set(PLAIN)):
                item.add_marker(mark)
    items.sort(key=lambda item: not any(item.get_closest_marker(mark) for mark in ROOMS))


Once = Callable[[str, Callable[[Path], None]], Path]
"""Gives the folder of a name that one of a run's processes makes for all of them."""


@pytest.fixture(scope="session")
def memoise(tmp_path_factory: pytest.TempPathFactory) -> Once:
    """What is made once for all processes of a run, in folders that no test changes."""
    base = tmp_path_factory.getbasetemp()
    # Each worker of pytest-xdist has a folder of its own in the run's.
    common = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def made(name: str, make: Callable[[Path], None]) -> Path:
        folder, done = common / name, common / f"{name}.done"
        with open(common / f"{name}.lock", "w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not done.exists():
                shutil.rmtree(folder, ignore_errors=True)
                make(folder)
                done.touch()
        return folder

    return made


@pytest.fixture(scope="session")
def polished_study(memoise: Once) -> Path:
    """Results folder of a small polished and timed study of the rack, without a report."""

    def make(folder: Path) -> None:
        # Not imported at the top: the quick tests need none of it.
        from hybrid_opt.campaign import CampaignSettings, ExecutionSettings
        from hybrid_opt.polishing.settings import (
            DrivableSettings,
            FillSettings,
            PolishSettings,
            ProbeSettings,
        )
        from hybrid_opt.progress import Progress
        from studies.programs.study import StudySettings, run_study
        from symbolic.read.cell import load
        from tests.symbolic.cells import RACK

        campaign = CampaignSettings(
            {"nsga2": {"population": 20}}, evaluations=120, replicas=2, seed=4
        )
        polish = PolishSettings(
            attempts=3,
            rounds=3,
            fill=FillSettings(solved=4, members=4, attempts=1),
            probe=ProbeSettings(2, 2, rounds=2),
            drivable=DrivableSettings(first_rounds=2, rounds=1, members=2),
        )
        execution = ExecutionSettings(folder, jobs=1)
        wanted = StudySettings(polish, drivable_replicas=1, report=False)
        run_study(load(RACK), campaign, execution, Progress(shown=False), wanted)

    return memoise("polished", make)


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Cache:
    """An empty cache of compiled functions, also the default one of the test."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("DUAL_ARM_CACHE", str(folder))
    return Cache(folder)
