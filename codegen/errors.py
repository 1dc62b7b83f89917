"""Errors between an expression and its compiled function."""

from symbolic.errors import DualArmError, DualArmWarning


class CodegenError(DualArmError):
    """C code could not be generated, compiled, cached or loaded."""


class FormError(CodegenError):
    """CasADi wrote a form of C that has no form in lanes."""


class SlowerWarning(DualArmWarning, RuntimeWarning):
    """Functions are not evaluated in the fastest way."""
