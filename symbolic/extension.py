"""The project's modules compiled from C++: their import, and the message if that fails."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from symbolic.errors import BridgeError

REMEDY = "run `pip install -e .` in the project's folder to compile it for this environment"


def require_same_minor(built: dict[str, str], installed: dict[str, str]) -> None:
    """Check that the versions of libraries agree in major and minor number.

    Args:
        built: version of each library with which the module was compiled, by name of the library.
        installed: version of each library that is installed, by name of the library.

    Raises:
        BridgeError: versions differ; the message names every such library.
    """
    different = [
        f"{library} {installed[library]} is installed, {version} was compiled against"
        for library, version in built.items()
        if installed[library].split(".")[:2] != version.split(".")[:2]
    ]
    if different:
        raise BridgeError(
            f"the compiled modules do not fit: {'; '.join(different)}; {REMEDY}", code="versions"
        )


def compiled_module(name: str, part: str) -> Any:
    """Import one of the project's compiled modules and return it.

    Args:
        name: name of the module; the libraries that it links to must have been loaded already.
        part: description of the module in the message, such as 'the compiled part of the polish'.

    Raises:
        BridgeError: the module is missing or cannot be loaded.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise BridgeError(
            f"{part} cannot be loaded ({error}); {REMEDY}", code="not-loadable"
        ) from error
