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
    """Return the expression 2 / (x + x) for 1 / x, as a factor of products. CasADi would turn x *
    (1 / y) into a division, which costs ten times as much as a product."""
    return 2.0 / (x + x)


def named_function(
    name: str, inputs: Mapping[str, Any], outputs: Mapping[str, Any], cse: bool = True
) -> ca.Function:
    """Build a CasADi function with named inputs and outputs, in the order of the mappings.

    Args:
        name: name of the function.
        inputs: symbols by name.
        outputs: expressions by name.
        cse: True to compute common subexpressions once.
    """
    sides = [*inputs.values()], [*outputs.values()], [*inputs], [*outputs]
    return ca.Function(name, *sides, {"cse": cse})


def number(value: Any) -> Any:
    """Return a number or an array as a CasADi matrix (DM). CasADi symbols and expressions are
    returned unchanged."""
    return value if isinstance(value, ca.SX | ca.MX) else ca.DM(value)


def sx_parameters(*records: Any) -> dict[str, ca.SX]:
    """Return the symbolic parameters of parts of a cell: one SX vector per parameter group, by name
    of the group.

    Args:
        records: parts of the cell's description, such as task, robots and payload. A part with
            symbols (`symbolic.records.numbered`) names its group; parts that name the same group
            give one vector. A part of plain numbers gives none.
    """
    groups = (group for record in records if (group := getattr(record, "given", None)) is not None)
    return {group.name: group.symbols for group in groups}


def mx_parameters(*records: Any) -> dict[str, ca.MX]:
    """Return a new MX vector for each parameter group of parts of a cell, by name of the group. An
    MX function takes these vectors as inputs and passes them to SX functions.

    Args:
        records: parts of the cell's description, as for `sx_parameters`. Parts that name the same
            group give one vector.
    """
    return mx_symbols(sx_parameters(*records))


def mx_symbols(given: Mapping[str, ca.SX]) -> dict[str, ca.MX]:
    """Return a new MX vector for each of the SX vectors `given`, of equal size and by the same
    name."""
    return {name: ca.MX.sym(name, symbols.numel()) for name, symbols in given.items()}


def select_parameters(groups: Mapping[str, ca.MX], *records: Any) -> dict[str, ca.MX]:
    """Return those entries of `groups` whose parameter groups occur in the records.

    Args:
        groups: MX vectors by name of the parameter group.
        records: parts of the cell's description, as for `sx_parameters`.
    """
    return {name: groups[name] for name in sx_parameters(*records)}


def as_mx(value: ca.SX, given: Mapping[str, ca.SX], groups: Mapping[str, ca.MX]) -> ca.MX:
    """Convert an SX expression of parameters to an MX expression.

    Args:
        value: SX expression; it depends only on the parameters `given`.
        given: SX vectors of the parameters by group; empty if value is constant.
        groups: MX vectors by group, from `mx_parameters`, that replace them.
    """
    if not given:
        return ca.MX(ca.evalf(value))
    return ca.Function("numbers", list(given.values()), [value])(*groups.values())


def tile(given: Mapping[str, ca.MX], n: int) -> list[ca.MX]:
    """Return each parameter vector (k,) repeated as n equal columns (k, n), as
    `casadi.Function.map` takes inputs of n calls.

    Args:
        given: parameter vectors by group.
        n: number of calls.
    """
    return [ca.repmat(symbols, 1, n) for symbols in given.values()]
