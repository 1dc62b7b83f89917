"""The project's own version."""

from importlib.metadata import PackageNotFoundError, version


def own_version() -> str:
    """As installed; run from its sources alone it has none."""
    try:
        return version("dual-arm-carry")
    except PackageNotFoundError:
        return "not installed"
