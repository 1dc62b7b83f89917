"""Print where the build environment's wheels keep their CMake configurations (for CMake)."""

from __future__ import annotations

import importlib.util
import sysconfig
from pathlib import Path


def prefixes() -> list[Path]:
    """Return the existing folders in which CMake finds the configurations of CasADi, Pinocchio and
    pybind11, in order of preference."""
    found = [Path(folder) for folder in sysconfig.get_paths().values()]
    for package in ("casadi", "cmeel", "pybind11"):
        spec = importlib.util.find_spec(package)
        if spec is not None and spec.origin is not None:
            found.append(Path(spec.origin).parent.parent)
    sites = dict.fromkeys(found)
    candidates = [site / part for site in sites for part in ("cmeel.prefix", "casadi", "pybind11")]
    return [folder for folder in candidates if folder.is_dir()]


if __name__ == "__main__":
    print(";".join(str(folder) for folder in prefixes()))
