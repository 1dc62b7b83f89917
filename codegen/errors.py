"""What can go wrong between an expression and its compiled function."""

from symbolic.errors import DualArmError


class CodegenError(DualArmError):
    """C code could not be generated, compiled, cached or loaded."""
