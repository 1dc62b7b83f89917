"""Errors of reports."""

from symbolic.errors import DualArmError


class ReportError(DualArmError):
    """A report, picture or animation cannot be made."""
