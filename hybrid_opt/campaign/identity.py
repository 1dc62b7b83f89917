"""Identity of a campaign: all that its results depend on; a results folder has only one."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from codegen.cache import source_digest
from hybrid_opt.campaign.settings import CampaignSettings
from hybrid_opt.errors import ResultsError
from symbolic.records import Workcell

FORMAT = "dual-arm-carry campaign"
VERSION = 1

_PACKAGES = ("casadi", "moocore", "numpy", "pin", "pymoo", "python-fcl", "scipy", "trimesh")


@cache
def environment() -> Mapping[str, str]:
    """Versions of everything that takes part in a search, and a digest of our own sources."""
    versions = {name: version(name) for name in _PACKAGES}
    try:
        versions["dual-arm-carry"] = version("dual-arm-carry")
    except PackageNotFoundError:  # run from its sources, which the digest tells
        versions["dual-arm-carry"] = "not installed"
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
    differences = list(_differences(stored, dict(wanted), ""))
    if differences:
        listed = "\n".join(f"  - {line}" for line in differences)
        raise ResultsError(
            f"{where}: holds results of something else, and they are never mixed; choose another "
            "--output, remove them with --overwrite, or repeat the command with what they were "
            f"made with:\n{listed}"
        )


def _differences(stored: Any, wanted: Any, key: str) -> list[str]:
    if isinstance(stored, dict) and isinstance(wanted, dict):
        return [
            line
            for name in dict.fromkeys((*stored, *wanted))
            for line in _differences(
                stored.get(name), wanted.get(name), f"{key}.{name}" if key else name
            )
        ]
    if stored == wanted:
        return []
    return [f"{key}: stored {json.dumps(stored)}, now {json.dumps(wanted)}"]
