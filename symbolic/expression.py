"""The type of a symbolic expression: every model function takes CasADi's SX or MX alike."""

from __future__ import annotations

from typing import TypeAlias

import casadi as ca

Expression: TypeAlias = ca.SX | ca.MX
