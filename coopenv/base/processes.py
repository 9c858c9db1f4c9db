"""A process that is started anew, not forked, with a pipe to it. Ctrl-C does not reach it."""

import multiprocessing
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection

import psutil

from coopenv.base.interrupts import held


@contextmanager
def _deaf_children() -> Iterator[None]:
    """Start processes that ignore Ctrl-C, which a terminal sends to all: the parent decides."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # would start with the first process, and lets signals through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class ChildProcess:
    """A process that runs a function of its end of a pipe."""

    def __init__(self, work: Callable[[Connection], None]) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, other = context.Pipe()
        self.process = context.Process(target=work, args=(other,))
        with held(), _deaf_children():
            self.process.start()
        other.close()
        self.usage = psutil.Process(self.process.pid)

    def end(self) -> str:
        """Kill it and the processes that it has started, and return how it ended."""
        with suppress(psutil.Error):
            for child in self.usage.children(recursive=True):
                child.kill()
        self.process.kill()
        self.process.join()
        self.pipe.close()
        status = int(self.process.exitcode or 0)
        return f"its process ended with {signal.Signals(-status).name if status < 0 else f'status {status}'}"
