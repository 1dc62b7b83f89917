"""Jobs whose every turn is known, and a ledger that keeps all that it is told."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_opt.work.service import Emit, Executor, Service
from symbolic.errors import DualArmError


def machine() -> dict[str, str]:
    """What a worker's environment has to be."""
    return {"numpy": np.__version__}


def context() -> dict[str, int]:
    return {"requests": 0}


def echo(context: dict[str, int], request: int, emit: Emit) -> tuple[int, int]:
    """Emits so many messages."""
    context["requests"] += 1
    for number in range(request):
        emit(bytes([number]))
    return request, context["requests"]


def numbers(context: dict[str, int], seed: int, emit: Emit) -> bytes:
    """Draws from a generator of its own."""
    values = np.random.default_rng(seed).normal(size=(50, 50))
    emit(values[:2].tobytes())
    return np.linalg.solve(values, values.T).tobytes()


def process(context: dict[str, int], request: int, emit: Emit) -> int:
    return os.getpid()


def misuse(context: dict[str, int], request: int, emit: Emit) -> None:
    raise DualArmError("this cannot be done")


def mistake(context: dict[str, int], request: int, emit: Emit) -> None:
    raise OSError("a file of the request's own is missing")


def killed_once(context: dict[str, int], request: Path, emit: Emit) -> str:
    """Killed with -9 where the file is missing."""
    emit(b"begun")
    if not request.exists():
        request.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return "alive"


def killed_step_by_step(context: dict[str, int], known: int, emit: Emit) -> int:
    """Killed after each of five messages, unless it is known."""
    if known < 5:
        emit(bytes([known]))
        time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGKILL)
    return known


def moody(context: dict[str, int], mood: str, emit: Emit) -> str:
    """Dies, hangs or answers, as it is told."""
    if mood == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    if mood == "hang":
        time.sleep(600.0)
    return mood


class MessageLedger:
    """Keeps messages, answers and losses; a lost request is replaced by another one."""

    def __init__(self, requests: list[Any], instead: Any = None) -> None:
        self.requests, self._instead = requests, instead
        self.messages: dict[int, list[bytes]] = {k: [] for k in range(len(requests))}
        self.answers: list[Any] = [None] * len(requests)
        self.losses: list[tuple[int, str]] = []

    def __len__(self) -> int:
        return len(self.requests)

    def request(self, index: int) -> Any:
        return self.requests[index]

    def heard(self, index: int, message: bytes) -> None:
        self.messages[index].append(message)

    def answered(self, index: int, answer: Any) -> None:
        self.answers[index] = answer

    def lost(self, index: int, reason: str) -> None:
        self.losses.append((index, reason))
        self.requests[index] = self._instead


def run(
    executor: Executor,
    work: Any,
    requests: list[Any],
    patience: float | None = None,
    instead: Any = None,
) -> MessageLedger:
    ledger = MessageLedger(requests, instead)
    executor.run(Service(context, work, patience), ledger)
    return ledger
