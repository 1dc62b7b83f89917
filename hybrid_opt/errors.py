"""Errors of results and of their computation."""

from symbolic.errors import DualArmError, DualArmWarning


class ResultsError(DualArmError):
    """Stored results are missing, damaged, or belong to another configuration."""


class DamagedResultsWarning(DualArmWarning):
    """A stored result is damaged and is computed anew, to the same bits."""


class DisplayError(DualArmError):
    """An object cannot be shown: a library that draws is missing, or a file not writable."""


class WorkerError(DualArmError):
    """Worker processes or machines were lost, or their software differs."""


class SimulationError(DualArmError):
    """The simulator is missing, or cannot answer."""


class NoCarryError(ResultsError):
    """A study found no carry to recommend; the text says why."""


class JobError(DualArmError):
    """The box cannot be gripped, lifted, set down or let go as the workcell asks."""


class ProposalError(DualArmError):
    """No carry was found for a problem; the text names the obstacle."""


class NoHoldError(ProposalError):
    """No way was found to hold the box at start and goal, so that no path was sought."""
