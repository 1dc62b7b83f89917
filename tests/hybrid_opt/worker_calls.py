"""Calls that are made in workers."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_info

from symbolic.errors import DualArmError, UrdfError


def machine() -> dict[str, str]:
    """Describe the software of this process."""
    return {"numpy": np.__version__}


def numbers(seed: int) -> bytes:
    """Draw from a generator, and solve linear equations."""
    values = np.random.default_rng(seed).normal(size=(50, 50))
    return np.linalg.solve(values, values.T).tobytes()


def process(_: object) -> int:
    """Return the process's number."""
    return os.getpid()


def threads(_: object) -> list[int]:
    """Return the threads of every linear algebra library that is loaded."""
    np.linalg.norm(np.eye(2))
    return [int(found["num_threads"]) for found in threadpool_info() if found["user_api"] == "blas"]


def misuse(_: object) -> None:
    """Raise an error of this project that cannot be pickled as it is."""
    raise UrdfError("arm.urdf", ("misused",))


def mistake(_: object) -> None:
    """Raise an error that is none of this project's."""
    raise OSError("own-file")


def killed_once(file: Path) -> str:
    """Be killed with -9 where the file is missing."""
    if not file.exists():
        file.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return "alive"


def moody(mood: str) -> str:
    """Die, hang or answer."""
    if mood == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    if mood == "hang":
        time.sleep(600.0)
    if mood == "error":
        raise DualArmError("this cannot be done")
    return mood
