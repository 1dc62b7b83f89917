"""What can go wrong between an expression and its compiled function."""

from symbolic.errors import DualArmError, DualArmWarning


class CodegenError(DualArmError):
    """C code could not be generated, compiled, cached or loaded."""


class SlowerWarning(DualArmWarning, RuntimeWarning):
    """Functions are not evaluated in the fastest way."""
