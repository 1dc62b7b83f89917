"""Independent work in forked children, which inherit all that they need and send back results.

Forking suits what follows a search: data is large, libraries and compiled functions are loaded,
and it lasts for seconds. Nothing that is called may need a thread that was started before the fork.
"""

from __future__ import annotations

import gc
import multiprocessing
import os
import traceback
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkProcess
from typing import Any, TypeVar

from codegen.function import available_cores
from hybrid_opt.errors import WorkerError
from hybrid_opt.work.executor import start_shielded
from symbolic.errors import DualArmError

Result = TypeVar("Result")

_TICKET = 2
"""Bytes of a call's number. A pipe hands them to one reader, whoever comes first, without a lock
that a dying child could keep."""


def in_children(
    calls: Sequence[Callable[[], Result]], jobs: int, done: Callable[[], None] = lambda: None
) -> list[Result]:
    """Results of independent calls, in their order.

    Args:
        calls: what to do; results can be pickled.
        jobs: processes, 0 for one per core; with 1 all is done in this process.
        done: called in this process after every call.

    Raises:
        DualArmError: what a call raised, with its text.
        WorkerError: a child died.
    """
    count = min(jobs or available_cores(), len(calls))
    if count <= 1:
        return [_finished(call(), done) for call in calls]
    tickets, issue = os.pipe()
    os.write(issue, b"".join(k.to_bytes(_TICKET) for k in range(len(calls))))
    os.close(issue)
    children = [_Child(calls, tickets) for _ in range(count)]
    os.close(tickets)
    results: dict[int, Result] = {}
    try:
        open_ends = {child.connection for child in children}
        while open_ends:
            for connection in wait(open_ends):
                assert isinstance(connection, Connection)
                try:
                    kind, index, content = connection.recv()
                except (EOFError, OSError):
                    open_ends.remove(connection)
                    continue
                if kind != "result":
                    raise DualArmError(content) if kind == "error" else RuntimeError(content)
                results[index] = _finished(content, done)
    finally:
        for child in children:
            child.end()
    if len(results) < len(calls):
        raise WorkerError(
            "a worker process died (killed from outside, or out of memory?); what was computed is "
            "kept: continue with --resume, perhaps with fewer --jobs"
        )
    return [results[index] for index in range(len(calls))]


def _finished(result: Result, done: Callable[[], None]) -> Result:
    done()
    return result


class _Child:
    """A forked process and this side of its pipe."""

    def __init__(self, calls: Sequence[Callable[[], Any]], tickets: int) -> None:
        fork = multiprocessing.get_context("fork")
        self.connection, theirs = fork.Pipe(duplex=False)
        self._process: ForkProcess = fork.Process(
            target=_serve, args=(calls, tickets, theirs), name="study worker", daemon=True
        )
        start_shielded(self._process)
        theirs.close()

    def end(self) -> None:
        self._process.terminate()
        self._process.join()
        self.connection.close()


def _serve(calls: Sequence[Callable[[], Any]], tickets: int, connection: Connection) -> None:
    """A child's life: ends when no call is left, or nobody listens any more."""
    # What was inherited stays: looking through it again would take time and copy its memory.
    gc.freeze()
    while ticket := os.read(tickets, _TICKET):
        index = int.from_bytes(ticket)
        try:
            answer = ("result", index, calls[index]())
        except DualArmError as error:
            answer = ("error", index, str(error))
        except Exception:
            answer = ("failure", index, traceback.format_exc())
        try:
            connection.send(answer)
        except OSError:
            return
