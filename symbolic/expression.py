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
    """1 / x, to be multiplied with: CasADi makes a division of x * (1 / y), and a processor takes
    ten times as long for that as for the product."""
    return 2.0 / (x + x)


def named_function(
    name: str, inputs: Mapping[str, Any], outputs: Mapping[str, Any], cse: bool = True
) -> ca.Function:
    """A function by the names of what it takes and gives, in order.

    Args:
        cse: whether what occurs several times is computed once.
    """
    sides = [*inputs.values()], [*outputs.values()], [*inputs], [*outputs]
    return ca.Function(name, *sides, {"cse": cse})


def number(value: Any) -> Any:
    """A number or an array of a record as an expression; symbols as they are."""
    return value if isinstance(value, ca.SX | ca.MX) else ca.DM(value)


def sx_given(*records: Any) -> dict[str, ca.SX]:
    """The groups of numbers of some records by the names of the inputs, without repetition; none of
    plain records."""
    groups = (group for record in records if (group := getattr(record, "given", None)) is not None)
    return {group.name: group.symbols for group in groups}


def mx_given(*records: Any) -> dict[str, ca.MX]:
    """The same as new symbols, of functions that only hand them on."""
    return mx_symbols(sx_given(*records))


def mx_symbols(given: Mapping[str, ca.SX]) -> dict[str, ca.MX]:
    """Symbols that hand on groups of numbers."""
    return {name: ca.MX.sym(name, symbols.numel()) for name, symbols in given.items()}


def of(handed: Mapping[str, ca.MX], *records: Any) -> dict[str, ca.MX]:
    """Those of `mx_given` that belong to some of its records."""
    return {name: handed[name] for name in sx_given(*records)}


def as_mx(value: ca.SX, given: Mapping[str, ca.SX], handed: Mapping[str, ca.MX]) -> ca.MX:
    """An expression of numbers as one of the symbols of `mx_given`."""
    if not given:
        return ca.MX(ca.evalf(value))
    return ca.Function("numbers", list(given.values()), [value])(*handed.values())


def repeated(given: Mapping[str, ca.MX], n: int) -> list[ca.MX]:
    """Numbers as `casadi.Function.map` takes them: once per column."""
    return [ca.repmat(symbols, 1, n) for symbols in given.values()]
