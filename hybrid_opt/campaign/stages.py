"""Stages of a study, each run once and marked as done; the cells that stages load in any process;
and the parallel build of all compiled functions.

A stage reads the results of earlier stages in the results folder and writes files of its own. Its
marker, `stages/NAME.json`, is written when the stage begins and again when it is done. A stage runs
again if its marker is missing or does not say 'done', or if its files are damaged. A long stage
continues from files that it has already written. When a stage runs, all later stages run too.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol, TypeVar

import numpy as np

from codegen.build import compiler_of
from codegen.cache import Cache, source_digest
from codegen.compiler import interruptible
from codegen.errors import CodegenError
from codegen.native import one_thread
from hybrid_opt.branches import BranchCompetition, search_branches
from hybrid_opt.campaign.folder import (
    CampaignFolder,
    ExecutionSettings,
    open_folder,
    require_usable,
)
from hybrid_opt.campaign.settings import (
    BRANCHES,
    CONFIGURATION,
    DRIVABLE,
    STAGES,
    CampaignSettings,
    StageMark,
    StageStatus,
)
from hybrid_opt.cell import Cell
from hybrid_opt.errors import ResultsError
from hybrid_opt.evaluate.objectives import force_kind
from hybrid_opt.job.plan import JobCollisions, JobModel, job_model
from hybrid_opt.progress import Progress, ShowProgress, as_callback
from hybrid_opt.store.files import read_record, to_json, write_atomically, write_json
from symbolic.contact.registry import command_model
from symbolic.errors import DualArmError
from symbolic.read.cell import load
from symbolic.read.cell_files import CellFiles, drivable_files, unpack_cell
from symbolic.records import SEARCHED_BRANCH, Workcell


@dataclass(frozen=True)
class Stage:
    """One step of a study.

    Attributes:
        name: unique name, also of the stage's marker.
        run: function that does the work of the stage.
        settings: settings that determine the stage's results, in addition to the campaign's, as
            JSON values.
        whole: function that returns True if the results exist and are undamaged; it is called for a
            stage that is done.
    """

    name: str
    run: Callable[[CampaignFolder, Progress], None]
    settings: Mapping[str, Any] = field(default_factory=dict)
    whole: Callable[[CampaignFolder], bool] = lambda folder: True


def run_stages(folder: CampaignFolder, stages: Sequence[Stage], progress: Progress) -> None:
    """Run the stages of a study in order, except those that are done and have undamaged files.

    Once a stage has run, all later stages run as well.

    Args:
        folder: the open results folder.
        stages: all stages of the study, in order.
        progress: display of progress.

    Raises:
        ResultsError: a stage began with other settings.
        DualArmError: a stage failed.
    """
    check_stages(folder, stages)
    for number, stage in enumerate(stages):
        marker = _marker(folder, stage)
        if _is_done(marker) and stage.whole(folder):
            continue
        # First of all, so that no moment exists at which they look done and are out of date.
        for later in stages[number + 1 :]:
            if _is_done(_marker(folder, later)):
                _mark(folder, later, "outdated", 0.0)
        spent = marker.seconds if marker is not None and marker.status == "running" else 0.0
        _mark(folder, stage, "running", spent)
        begin = time.perf_counter()
        try:
            stage.run(folder, progress)
        except BaseException:
            _mark(folder, stage, "running", spent + time.perf_counter() - begin)
            raise
        _mark(folder, stage, "done", spent + time.perf_counter() - begin)


def _path(folder: CampaignFolder, stage: Stage) -> Path:
    return folder.root / STAGES / f"{stage.name}.json"


def _marker(folder: CampaignFolder, stage: Stage) -> StageMark | None:
    """Return the marker of a stage, a file with its status, from a results folder; None if the
    stage never began.
    """
    path = _path(folder, stage)
    return (
        read_record(StageMark, path, "delete it to run the stage again") if path.exists() else None
    )


def _is_done(marker: StageMark | None) -> bool:
    return marker is not None and marker.status == "done"


def _mark(folder: CampaignFolder, stage: Stage, status: StageStatus, seconds: float) -> None:
    write_json(_path(folder, stage), to_json(StageMark(status, dict(stage.settings), seconds)))


def check_stages(folder: CampaignFolder, stages: Sequence[Stage]) -> None:
    """Check, before any work, that every stage that has begun had the present settings.

    Args:
        folder: the open results folder.
        stages: all stages of the study.

    Raises:
        ResultsError: a stage began with other settings.
    """
    for stage in stages:
        marker = _marker(folder, stage)
        if marker is not None and marker.settings != dict(stage.settings):
            raise ResultsError(
                f"{folder.root}: the stage '{stage.name}' was run with {marker.settings}, now "
                f"asked for is {dict(stage.settings)}; choose another --output, or begin anew with "
                "--overwrite",
                code="another-stage-setting",
            )


DRIVABLE_REPLICAS = 3
"""Largest number of replicas per algorithm of a drivable experiment beside another one. It answers
one question, which carry to run, and the fronts of its replicas differ by about one per cent."""


def drivable_settings(settings: CampaignSettings, replicas: int | None = None) -> CampaignSettings:
    """Return the settings of a study's drivable experiment, from those of its first experiment.

    They differ in the number of replicas and in the objectives, which are the duration and the peak
    force. The force is the robust force if the first experiment minimises robust forces, else the
    planned force.

    Args:
        settings: settings of the first experiment.
        replicas: number of replicas per algorithm; None for the number of the first experiment, but
            at most `DRIVABLE_REPLICAS`.

    Raises:
        SettingsError: the number of replicas is not allowed.
    """
    if replicas is None:
        replicas = min(settings.replicas, DRIVABLE_REPLICAS)
    objectives = force_kind(settings.objectives).drivable
    return replace(settings, objectives=objectives, replicas=replicas)


def drivable_stage(stages: Sequence[Stage], replicas: int | None = None) -> Stage:
    """Return the stage of a study that runs the drivable experiment.

    The experiment is a complete campaign of the drivable variant of the study's cell, in the
    subfolder `drivable/`.

    Args:
        stages: stages of the drivable experiment.
        replicas: number of replicas per algorithm; None for the number of the study, but at most
            `DRIVABLE_REPLICAS`.
    """

    def run(folder: CampaignFolder, progress: Progress) -> None:
        root = folder.root / DRIVABLE
        resume = (root / CONFIGURATION).exists()
        execution = replace(folder.execution, output=root, resume=resume, overwrite=False)
        with TemporaryDirectory() as files:
            workcell = unpack_cell(drivable_files(folder.files), Path(files))
            settings = drivable_settings(folder.settings, replicas)
            with open_folder(settings, execution, workcell, folder.workers) as inner:
                run_stages(inner, stages, Progress(progress.shown, DRIVABLE))

    inside = {stage.name: dict(stage.settings) for stage in stages}
    return Stage(DRIVABLE, run, {"replicas": replicas, **inside})


_ANEW = "start the study anew"

COMPETITION_REPLICAS = 2
"""A competition of start branches may use as many evaluations as so many replicas."""


def decided_cell(
    workcell: Workcell, settings: CampaignSettings, execution: ExecutionSettings
) -> tuple[Workcell, BranchCompetition | None]:
    """Choose the start branches of a workcell whose file leaves them to a search.

    A campaign that is continued keeps its first choice.

    Args:
        workcell: the workcell.
        settings: settings of the campaign.
        execution: settings of the execution, with the results folder.

    Returns:
        Workcell with fixed start branches; and the competition that chose them, None if the
        workcell file states the branches.

    Raises:
        DualArmError: no pair of branches can carry the box on any trajectory, or the stored choice
            is damaged.
    """
    if SEARCHED_BRANCH not in workcell.start_branch:
        return workcell, None
    competition = read_branches(execution.output) if execution.resume else None
    if competition is None:
        require_usable(execution)
        cell = Cell(workcell, settings.objectives)
        rng = np.random.default_rng(settings.seed)
        competition = search_branches(
            cell, evaluations=COMPETITION_REPLICAS * settings.evaluations, rng=rng
        )
    return load(workcell.source, decided=competition.winner, text=workcell.text), competition


def read_branches(root: Path) -> BranchCompetition | None:
    """Read from a results folder the competition that chose a study's start branches; None if the
    workcell file states them.

    Args:
        root: the results folder.

    Raises:
        ResultsError: the stored competition is damaged.
    """
    stored = root / BRANCHES
    return read_record(BranchCompetition, stored, _ANEW) if stored.exists() else None


def store_branches(root: Path, competition: BranchCompetition | None) -> str:
    """Store the competition that chose the start branches in a results folder.

    Args:
        root: the results folder.
        competition: the competition; None if there was none.

    Returns:
        Text of the competition for a terminal; '' for None.
    """
    if competition is None:
        return ""
    write_json(root / BRANCHES, to_json(competition))
    return f"{str(competition).capitalize()}.\n\n"


Argument = TypeVar("Argument")
ArgumentIn = TypeVar("ArgumentIn", contravariant=True)


class ReplicaFunction(Protocol[ArgumentIn]):
    """Function that computes the content of a replica's file in any process."""

    def __call__(self, argument: ArgumentIn, progress: ShowProgress = False, /) -> bytes:
        """Compute one replica, or its polished front, and return the content of its file.

        Args:
            argument: request for one replica.
            progress: True for a progress bar, or a function of the finished and the total number of
                units.
        """


def store_results(
    folder: CampaignFolder,
    progress: Progress,
    stage: tuple[str, str, int],
    function: ReplicaFunction[Argument],
    left: Mapping[Path, Argument],
    done: int,
) -> None:
    """Compute the missing files of a stage, and store each as soon as it is computed.

    The workers of the folder compute the files in parallel. The file of a stage with only one file
    is computed in this process, which shows the progress within it.

    Args:
        folder: the results folder.
        progress: display of progress.
        stage: title of the work, unit of its progress, and number of units per file.
        function: function that computes the content of a file from an argument.
        left: argument of `function` for each missing file.
        done: number of files that already exist.
    """
    title, unit, each = stage
    paths = list(left)
    with progress.stage(title, (done + len(left)) * each, unit, done * each) as advance:

        def store(index: int, content: bytes) -> None:
            write_atomically(paths[index], content)
            advance(each)

        if done + len(left) == 1:
            for path, argument in left.items():
                with one_thread():
                    content = function(argument, as_callback(advance))
                write_atomically(path, content)
        else:
            folder.workers.map(function, list(left.values()), store)


@lru_cache(maxsize=2)
def loaded_cell(files: CellFiles, objectives: tuple[str, ...]) -> Cell:
    """Return the cell of stored workcell files. Each process caches the last cells.

    Candidates are evaluated by a single thread, because several workers share the cores.

    Args:
        files: files of the workcell.
        objectives: names of the objectives.
    """
    return Cell.from_files(files, objectives, threads=1)


Made = TypeVar("Made")


def with_cell(of_workcell: Callable[[Workcell], Made], files: CellFiles) -> Made:
    """Call a function of a workcell whose files are only in memory, and return its result.

    The files are unpacked to a temporary folder, which exists only during the call.

    Args:
        of_workcell: function of the workcell.
        files: content of the workcell's files.
    """
    with TemporaryDirectory() as folder:
        return of_workcell(unpack_cell(files, Path(folder)))


@dataclass(frozen=True)
class ReadyCell:
    """A cell with its compiled functions for evaluation, timing and jobs loaded.

    Attributes:
        cell: the cell.
        jobs: planner of the cell's jobs; `jobs.timing` times its paths.
    """

    cell: Cell
    jobs: JobModel

    @classmethod
    def of(cls, objectives: tuple[str, ...], workcell: Workcell) -> ReadyCell:
        """Load a cell with all compiled functions at once, because its files may be temporary.

        Args:
            objectives: names of the cell's objectives.
            workcell: the workcell, whose files exist during the call.
        """
        # Not imported at the top: other stages time nothing.
        from hybrid_opt.timing.candidates import search_carry, search_timing

        cell = Cell(workcell, objectives)
        cell.carry(cell.initial)
        search_carry(cell.timing_model, cell.initial)
        if workcell.task.law.is_drivable and cell.force_kind.robust:
            search_timing(cell.timing_model, cell.initial)
        return cls(cell, job_model(cell.timing_model))


Cells = tuple[tuple[CellFiles, tuple[str, ...]], ...]
"""Files of cells, each with its objectives. The last one is the drivable cell."""


def cells_of(files: CellFiles, objectives: tuple[str, ...], driven: bool) -> Cells:
    """Return the files and objectives of an experiment's cell and of its drivable variant, in which
    carries are timed from rest to rest within all limits.

    The contact models of the two may differ.

    Args:
        files: files of the experiment's cell.
        objectives: names of the experiment's objectives.
        driven: True if the experiment's cell is already drivable; it is then the only entry.
    """
    own = (files, objectives)
    if driven:
        return (own,)
    return (own, (drivable_files(files), force_kind(objectives).drivable))


@lru_cache(maxsize=1)
def ready_cells(cells: Cells) -> tuple[ReadyCell, ...]:
    """Load the compiled functions of cells, after building those that are missing. Each process
    caches the latest result.

    Args:
        cells: files and names of the objectives of each cell.

    Returns:
        The cells, in the same order.
    """
    return tuple(with_cell(partial(ReadyCell.of, names), files) for files, names in cells)


# --- what is compiled ---

Maker = Callable[[], object]
"""Function that loads or builds compiled functions."""

_ELAPSED_INTERVAL = 1.0
"""Interval at which the display of elapsed time is updated [s]."""


def build_study(cell: Cell, progress: Progress, polish: bool = True, drivable: bool = True) -> None:
    """Load the compiled functions of a study, after building those that are missing with several
    compilers in parallel.

    Functions of clearances between the arms are compiled later, during a polish. A function that
    cannot be built raises its error where it is used first.

    Args:
        cell: a cell that was read from a file.
        progress: display of progress.
        polish: True if fronts are polished.
        drivable: True if drivable carries are searched as well.
    """
    cache = cell.compiled.cache or Cache()
    what = (str(cell.force_kind), str(polish), str(drivable), compiler_of(cache).identity)
    # With comments: other ones cost a look at all sets, digests without them a parse of everything.
    sources = source_digest("codegen", "hybrid_opt")
    key = cell.compiled.key("study", *what, version("casadi"), sources)
    if cache.read_record(key) is not None:
        return
    # Drivable cells have the longest functions.
    drivable &= not cell.workcell.task.law.is_drivable
    cells = [cell.drivable(), cell] if drivable else [cell]
    makers = [make for each in cells for make in _makers(each, polish)]
    failures = build_all(makers, progress)
    if not any(isinstance(failure, CodegenError) for failure in failures):
        cache.write_record(key, {"built": True})


def build_all(makers: Sequence[Maker], progress: Progress) -> list[DualArmError]:
    """Load or build compiled functions in parallel.

    A function that cannot be built raises no error here, but where it is called first. Ctrl-C ends
    all compilers. Finished libraries are kept; threads that build expressions are not waited for.

    Args:
        makers: functions without arguments, each of which loads or builds compiled functions.
        progress: display of the number of finished makers.

    Returns:
        Errors of the makers that failed, in the order of `makers`.
    """
    # Each waits for its compilers most of the time; expressions are made by one after the other.
    pool = ThreadPoolExecutor(len(makers))
    try:
        with (
            interruptible(),
            progress.stage("compiling", len(makers), "sets", delay=_ELAPSED_INTERVAL) as told,
        ):
            futures = [pool.submit(make) for make in makers]
            left = set(futures)
            while left:
                done, left = wait(left, _ELAPSED_INTERVAL, FIRST_COMPLETED)
                told(len(done))
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
    failures = []
    for future in futures:
        try:
            future.result()
        except DualArmError as failure:
            # Callers that need a function report why a cell cannot have it.
            failures.append(failure)
    return failures


def _makers(cell: Cell, polish: bool) -> Iterator[Maker]:
    # Not imported at the top: who builds a few functions needs none of it.
    from hybrid_opt.carry import at_rest
    from hybrid_opt.polishing.drive import is_polishable
    from hybrid_opt.robust.force import robust_model
    from hybrid_opt.timing.model import TimingModel
    from hybrid_opt.timing.solve import PATH_INTERVALS

    compiled, workcell = cell.compiled, cell.workcell
    driven = workcell.task.law.is_drivable
    known = (
        is_polishable(workcell, cell.force_kind.robust)
        if driven
        else command_model(workcell).has_scalar_squeeze
    )
    yield lambda: cell.evaluator
    if polish and known:
        yield lambda: cell.polish_functions
    if driven:
        yield lambda: cell.path_timer
        yield lambda: TimingModel(compiled, PATH_INTERVALS)
    yield lambda: cell.timing_model
    yield lambda: JobCollisions(compiled)
    yield lambda: robust_model(workcell).nominal(at_rest())  # some are built when first asked
