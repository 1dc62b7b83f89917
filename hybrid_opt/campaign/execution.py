"""How a campaign is carried out: where its files go and who does the work."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from hybrid_opt.campaign.identity import environment
from hybrid_opt.campaign.settings import require_whole
from hybrid_opt.work.dask_cluster import DaskExecutor
from hybrid_opt.work.processes import local_executor
from hybrid_opt.work.service import Executor
from symbolic.errors import SettingsError

ExecutorName = Literal["processes", "dask"]


@dataclass(frozen=True)
class ExecutionSettings:
    """How a campaign is carried out; nothing here changes its results.

    Attributes:
        output: the results folder.
        jobs: worker processes, 0 for one per core that this process may use.
        executor: 'processes' of this machine, or 'dask' for a cluster.
        scheduler: address of the Dask scheduler, only with 'dask'.
        resume: continue what the results folder holds.
        overwrite: remove what a study left in the results folder, and begin anew.
    """

    output: Path
    jobs: int = 0
    executor: ExecutorName = "processes"
    scheduler: str | None = None
    resume: bool = False
    overwrite: bool = False

    def __post_init__(self) -> None:
        """Check every value.

        Raises:
            SettingsError: with the value, and what is allowed.
        """
        require_whole("jobs", self.jobs, 0, 4096)
        if self.resume and self.overwrite:
            raise SettingsError("--resume keeps results and --overwrite removes them: give one")
        if self.executor not in get_args(ExecutorName):
            raise SettingsError(
                f"executor {self.executor!r}; known are {', '.join(get_args(ExecutorName))}"
            )
        if (self.executor == "dask") != bool(self.scheduler):
            raise SettingsError(
                "the executor 'dask' needs a scheduler's address, and only it takes one: "
                "--executor dask --scheduler tcp://HOST:8786"
            )


def executor_for(execution: ExecutionSettings) -> Executor:
    """The executor that the settings ask for."""
    if execution.executor == "dask":
        assert execution.scheduler is not None
        return DaskExecutor(execution.scheduler, environment(), environment)
    return local_executor(execution.jobs)
