"""Identity of a campaign: all that its results depend on; a results folder has only one."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Iterator, Mapping
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from codegen.cache import source_digest
from hybrid_opt.campaign.settings import CampaignSettings
from hybrid_opt.errors import ResultsError
from hybrid_opt.version import own_version
from symbolic.records import Workcell

FORMAT = "dual-arm-carry campaign"
VERSION = 1

_PACKAGES = ("casadi", "moocore", "numpy", "pin", "pymoo", "python-fcl", "scipy", "trimesh")


@cache
def environment() -> Mapping[str, str]:
    """Versions of everything that takes part in a search, and a digest of our own sources."""
    versions = {name: version(name) for name in _PACKAGES}
    versions["dual-arm-carry"] = own_version()  # beside the digest of the sources
    versions["sources"] = source_digest("symbolic", "codegen", "hybrid_opt")
    versions["python"] = platform.python_version()
    versions["machine"] = platform.machine()
    return versions


def identity(settings: CampaignSettings, root: Path, workcell: Workcell) -> dict[str, Any]:
    """The identity as JSON values.

    Args:
        settings: the campaign's.
        root: the results folder.
        workcell: the folder's copy.
    """
    file = workcell.source.relative_to(root.resolve()).as_posix()
    return {
        "format": FORMAT,
        "version": VERSION,
        "workcell": {"name": workcell.name, "file": file, "digest": workcell.digest},
        "settings": settings.effective(),
        "environment": dict(environment()),
    }


def replica_identity(campaign: Mapping[str, Any], algorithm: str, replica: int) -> bytes:
    """32 bytes that identify one replica of a campaign."""
    text = json.dumps([campaign, algorithm, replica], sort_keys=True)
    return hashlib.sha256(text.encode()).digest()


def require_equal(stored: Any, wanted: Mapping[str, Any], where: str) -> None:
    """Refuse to continue a campaign of another identity.

    Raises:
        ResultsError: with every value that differs.
    """
    listed = "\n".join(
        f"  - {key}: stored {json.dumps(old)}, now {json.dumps(new)}"
        for key, old, new in differences(stored, dict(wanted))
    )
    if listed:
        raise ResultsError(
            f"{where}: holds results of something else, and they are never mixed; choose another "
            "--output, remove them with --overwrite, or repeat the command with what they were "
            f"made with:\n{listed}"
        )


def differences(first: Any, second: Any, key: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Where two trees of JSON values differ: keys joined by points, and both values, None where one
    has none."""
    if isinstance(first, dict) and isinstance(second, dict):
        for name in dict.fromkeys((*first, *second)):
            inner = f"{key}.{name}" if key else name
            yield from differences(first.get(name), second.get(name), inner)
    elif first != second:
        yield key, first, second
