"""Errors of results and of their computation."""

from symbolic.errors import DualArmError, DualArmWarning


class ResultsError(DualArmError):
    """Stored results are missing, damaged, or belong to another configuration."""


class DamagedResultsWarning(DualArmWarning):
    """A stored result is damaged and is computed anew, to the same bits."""


class DisplayError(DualArmError):
    """An object cannot be shown: a graphics library is missing, or a file cannot be written."""


class WorkerError(DualArmError):
    """Worker processes or remote workers were lost, or have other software."""


class SimulationError(DualArmError):
    """The simulator is not installed, or cannot simulate the cell or the motion."""


class NoCarryError(ResultsError):
    """A study found no carry to recommend; the message says why."""


class JobError(DualArmError):
    """The box cannot be gripped, lifted, set down or let go as the workcell asks."""


class ProposalError(DualArmError):
    """No carry was found for a problem file; the message names the obstacle."""


class NoHoldError(ProposalError):
    """No way was found to hold the box at start and goal, so no path was searched for."""
