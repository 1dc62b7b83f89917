"""The type of a symbolic expression: every model function takes CasADi's SX or MX alike.

Numbers of a cell are constants of a formula or, of records with symbols
(`symbolic.records.numbered`), inputs of its functions.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import casadi as ca

Expression: TypeAlias = ca.SX | ca.MX


def reciprocal(x: ca.SX) -> ca.SX:
    """Compute 1 / x for multiplication: CasADi turns x * (1 / y) into a division, which costs ten
    times as much as a product."""
    return 2.0 / (x + x)


def named_function(
    name: str, inputs: Mapping[str, Any], outputs: Mapping[str, Any], cse: bool = True
) -> ca.Function:
    """Build a function from named inputs and outputs, in order.

    Args:
        cse: whether common subexpressions are computed once.
    """
    sides = [*inputs.values()], [*outputs.values()], [*inputs], [*outputs]
    return ca.Function(name, *sides, {"cse": cse})


def number(value: Any) -> Any:
    """Return a number or an array of a record as an expression; symbols unchanged."""
    return value if isinstance(value, ca.SX | ca.MX) else ca.DM(value)


def sx_parameters(*records: Any) -> dict[str, ca.SX]:
    """Return the parameter groups of some records by input name, each once; empty for plain
    records."""
    groups = (group for record in records if (group := getattr(record, "given", None)) is not None)
    return {group.name: group.symbols for group in groups}


def mx_parameters(*records: Any) -> dict[str, ca.MX]:
    """Return the groups of `sx_parameters` as new MX symbols, for functions that pass them on."""
    return mx_symbols(sx_parameters(*records))


def mx_symbols(given: Mapping[str, ca.SX]) -> dict[str, ca.MX]:
    """Return MX symbols for parameter groups."""
    return {name: ca.MX.sym(name, symbols.numel()) for name, symbols in given.items()}


def select_parameters(handed: Mapping[str, ca.MX], *records: Any) -> dict[str, ca.MX]:
    """Select the symbols of `mx_parameters` that belong to some records."""
    return {name: handed[name] for name in sx_parameters(*records)}


def as_mx(value: ca.SX, given: Mapping[str, ca.SX], handed: Mapping[str, ca.MX]) -> ca.MX:
    """Return an SX expression of parameters as an MX expression of the symbols of
    `mx_parameters`."""
    if not given:
        return ca.MX(ca.evalf(value))
    return ca.Function("numbers", list(given.values()), [value])(*handed.values())


def tile(given: Mapping[str, ca.MX], n: int) -> list[ca.MX]:
    """Repeat parameters once per column, as `casadi.Function.map` takes them."""
    return [ca.repmat(symbols, 1, n) for symbols in given.values()]
