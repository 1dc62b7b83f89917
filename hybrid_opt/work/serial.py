"""Work in this process, one request after the other."""

from __future__ import annotations

from functools import partial

from hybrid_opt.work.job import Answer, Context, Job, Ledger, Request


class SerialExecutor:
    """Answers all requests in this process, which nothing shields from what the work does."""

    def run(self, job: Job[Context, Request, Answer], ledger: Ledger[Request, Answer]) -> None:
        """See `hybrid_opt.work.job.Executor`."""
        if len(ledger) == 0:
            return
        context = job.make_context()
        for index in range(len(ledger)):
            answer = job.answer(context, ledger.request(index), partial(ledger.heard, index))
            ledger.answered(index, answer)
