"""Errors between an expression and its compiled function."""

from symbolic.errors import DualArmError, DualArmWarning


class CodegenError(DualArmError):
    """Error of generating, compiling, caching, loading or calling C code."""


class FormError(CodegenError):
    """Error for C code of CasADi that cannot be translated to lanes."""


class SlowerWarning(DualArmWarning, RuntimeWarning):
    """Warning that functions are not evaluated in the fastest way."""
