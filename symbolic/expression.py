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
    """Return an expression of 1 / x to multiply by. CasADi would otherwise turn x * (1 / y) into a
    division, which costs ten times as much as a product."""
    return 2.0 / (x + x)


def named_function(
    name: str, inputs: Mapping[str, Any], outputs: Mapping[str, Any], cse: bool = True
) -> ca.Function:
    """Build a CasADi function with named inputs and outputs, in the order of the mappings.

    Args:
        name: of the function.
        inputs: symbols by name.
        outputs: expressions by name.
        cse: whether common subexpressions are computed once.
    """
    sides = [*inputs.values()], [*outputs.values()], [*inputs], [*outputs]
    return ca.Function(name, *sides, {"cse": cse})


def number(value: Any) -> Any:
    """Return a number or an array of a record as a CasADi expression. Symbols are returned
    unchanged."""
    return value if isinstance(value, ca.SX | ca.MX) else ca.DM(value)


def sx_parameters(*records: Any) -> dict[str, ca.SX]:
    """Return the symbolic parameters in records as vectors by the name of their group; empty for
    records of plain numbers."""
    groups = (group for record in records if (group := getattr(record, "given", None)) is not None)
    return {group.name: group.symbols for group in groups}


def mx_parameters(*records: Any) -> dict[str, ca.MX]:
    """Return new MX symbols for the parameter groups in records, by name. Functions of MX use them
    as inputs and pass them on to functions of SX."""
    return mx_symbols(sx_parameters(*records))


def mx_symbols(given: Mapping[str, ca.SX]) -> dict[str, ca.MX]:
    """Return new MX symbols of the same sizes for parameter groups, by name."""
    return {name: ca.MX.sym(name, symbols.numel()) for name, symbols in given.items()}


def select_parameters(handed: Mapping[str, ca.MX], *records: Any) -> dict[str, ca.MX]:
    """Return those of the symbols `handed` whose parameter groups occur in the given records."""
    return {name: handed[name] for name in sx_parameters(*records)}


def as_mx(value: ca.SX, given: Mapping[str, ca.SX], handed: Mapping[str, ca.MX]) -> ca.MX:
    """Convert an SX expression of parameters to an MX expression.

    Args:
        value: the expression.
        given: the SX parameters by group.
        handed: the MX symbols by group, from `mx_parameters`.
    """
    if not given:
        return ca.MX(ca.evalf(value))
    return ca.Function("numbers", list(given.values()), [value])(*handed.values())


def tile(given: Mapping[str, ca.MX], n: int) -> list[ca.MX]:
    """Return the parameter groups repeated n times side by side, as the n calls of
    `casadi.Function.map` need them."""
    return [ca.repmat(symbols, 1, n) for symbols in given.values()]
