"""The type of a symbolic expression: every model function takes CasADi's SX or MX alike."""

from __future__ import annotations

from typing import TypeAlias

import casadi as ca

Expression: TypeAlias = ca.SX | ca.MX


def reciprocal(x: ca.SX) -> ca.SX:
    """1 / x, to be multiplied with: CasADi makes a division of x * (1 / y), and a processor takes
    ten times as long for that as for the product."""
    return 2.0 / (x + x)
