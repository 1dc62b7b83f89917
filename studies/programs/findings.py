"""What a program finds out, as JSON values and as lines for people, printed as it comes."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class Finding:
    """One thing that a program found out.

    Attributes:
        values: by name, for JSON; records are left to `dataclasses.asdict`.
        lines: the same for people.
    """

    values: Mapping[str, Any]
    lines: tuple[str, ...] = ()


def print_findings(findings: Iterable[Finding], as_json: bool) -> None:
    """Print each when it is found, or all at once as one JSON object."""
    values: dict[str, Any] = {}
    for finding in findings:
        values |= finding.values
        for line in () if as_json else finding.lines:
            print(line, flush=True)
    if as_json:
        print(json.dumps(values, default=asdict, indent=2))
