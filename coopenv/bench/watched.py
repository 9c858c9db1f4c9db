"""Tasks in processes of this machine, whose parts are ended one by one when they use more time or memory than they may.

The parent measures: a limit of the system on the address space would end numerical libraries as well. Processes end
within two seconds of a signal, or with their parent.
"""

import multiprocessing
import pickle
import signal
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from time import monotonic
from typing import Any, Protocol, Self

import psutil

from coopenv.base.errors import CoopenvError, error_text
from coopenv.base.installation import ONE_THREAD, environment
from coopenv.base.interrupts import end_with_parent, held

POLL = 0.1  # s between two looks at the processes
PATIENCE = 10.0
"""Seconds of the clock per second of processor time: a process that waits for ever needs none."""
NOT_RUN = "; its remaining records were not run"
"""End of a reason for which an observer is started on no further record."""


@dataclass(frozen=True)
class Limits:
    """What an observer may use on one record."""

    seconds: float = 1800.0
    """Of processor time."""
    mebibytes: float = 8192.0
    """Of memory, besides what its process had before."""


class Divided(Protocol):
    """A task in parts that may fail one by one."""

    def parts(self) -> Iterator[Any]:
        """Yield None when everything is ready, then the result of each part."""

    def rest(self, done: int) -> Self:
        """Return the task without its first parts."""

    def ending(self, other: Self, part: int, reason: str, everywhere: bool) -> Self:
        """Return the task; what ended in a part of another fails unstarted, everywhere or in tasks that are alike."""


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


def _work(pipe: Connection) -> None:
    """Do tasks as they come: send (part,) each, then () or the exception that ended the task."""
    end_with_parent()
    while True:
        try:
            task = pipe.recv()
        except EOFError:  # the parent was interrupted before it sent a task
            return
        try:
            for part in task.parts():
                pipe.send((part,))
            pipe.send(())
        except BaseException as error:
            try:
                pipe.send(error)
            except Exception:  # of a class that cannot be sent
                pipe.send(CoopenvError(error_text(error)))


class _Worker:
    """A process, and how far it is with a task."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, other = context.Pipe()
        self.process = context.Process(target=_work, args=(other,))
        with held(), _deaf_children():
            self.process.start()
        other.close()
        self.usage = psutil.Process(self.process.pid)
        self.number = -1  # of its task; negative: it is idle
        self.started = False  # whether the parts have begun
        self.before = (0.0, 0.0, 0.0)  # as `measured`, when the present part began

    def measured(self) -> tuple[float, float, float]:
        """Return the processor time and the clock, s, and the memory, MiB, its own processes included."""
        family = [self.usage, *self.usage.children(recursive=True)]
        times = [member.cpu_times() for member in family]
        memory = sum(member.memory_info().rss for member in family) / 2**20
        return sum(time.user + time.system for time in times), monotonic(), memory

    def excess(self, limits: Limits) -> tuple[str, bool] | None:
        """Return the limit that the present part exceeds, in words, and whether it ends all like it; None: no limit."""
        with suppress(psutil.Error):  # it has ended, and its pipe with it
            time, clock, memory = (now - then for now, then in zip(self.measured(), self.before, strict=True))
            if time > limits.seconds or clock > PATIENCE * limits.seconds:
                return f"more than {limits.seconds:g} s on one record (--seconds){NOT_RUN}", True
            if memory > limits.mebibytes:
                return f"more than {limits.mebibytes:g} MiB of memory (--memory)", False
        return None

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


class Pool:
    """Workers, and the tasks that wait for one."""

    def __init__(self, tasks: Sequence[Any], jobs: int, limits: Limits | None) -> None:
        """Take tasks, `Divided`; without limits whatever a part raises ends all."""
        self.tasks, self.jobs, self.limits = [*tasks], jobs, limits
        self.waiting = deque(range(len(tasks)))
        self.results: list[list[Any]] = [[] for _ in tasks]
        self.done = [0] * len(tasks)  # parts of the present rest of each task that have come
        self.workers: list[_Worker] = []

    @property
    def _busy(self) -> list[_Worker]:
        return [worker for worker in self.workers if worker.number >= 0]

    def run(self, on_done: Callable[[int], None]) -> list[list[Any]]:
        """Return the results of all parts of every task.

        Raises:
            CoopenvError: a task cannot be sent or made ready, or its process died.
        """
        try:
            pickle.dumps(self.tasks[:1])
        except Exception as error:
            raise CoopenvError(
                f"cannot be sent to another process: {error} (define observers at the top level of a module, or use "
                "--jobs 1)"
            ) from None
        try:
            with environment(ONE_THREAD):  # matrices here are small: threads would only get in the way
                while self.waiting or self._busy:
                    self._assign()
                    if self._look():
                        on_done(len(self.tasks) - len(self.waiting) - len(self._busy))
        finally:
            for worker in self.workers:
                worker.end()
        return self.results

    def _assign(self) -> None:
        """Give idle and new workers the tasks that wait."""
        while self.waiting:
            idle = [worker for worker in self.workers if worker.number < 0]
            if not idle and len(self.workers) == self.jobs:
                return
            if not idle:
                idle.append(_Worker())
                self.workers.append(idle[0])
            idle[0].number, idle[0].started = self.waiting.popleft(), False
            idle[0].pipe.send(self.tasks[idle[0].number])

    def _look(self) -> bool:
        """Take what the workers send, and end those above a limit; return whether a task is finished."""
        finished, ready = False, wait([worker.pipe for worker in self._busy], POLL)
        for worker in self._busy:
            if worker.pipe in ready:
                try:
                    message = worker.pipe.recv()
                except (EOFError, OSError):
                    self._fail(worker, "")
                else:
                    finished = self._take(worker, message) or finished
            elif worker.started and self.limits is not None and (excess := worker.excess(self.limits)):
                self._fail(worker, *excess)
        return finished

    def _take(self, worker: _Worker, message: Any) -> bool:
        """Take a message of a worker; return whether its task is finished."""
        if isinstance(message, BaseException):
            if not worker.started or self.limits is None:
                raise message
            self._fail(worker, str(message) if isinstance(message, CoopenvError) else error_text(message))
        elif message:
            with suppress(psutil.Error):
                worker.before = worker.measured()
            if worker.started:
                self.results[worker.number] += message
                self.done[worker.number] += 1
            worker.started = True
        else:
            worker.number = -1
        return worker.number < 0

    def _fail(self, worker: _Worker, reason: str, everywhere: bool = False) -> None:
        """End a worker; what remains of its task waits for another one. `everywhere` as for `Divided.ending`."""
        number, ended = worker.number, worker.end()
        self.workers.remove(worker)
        if not worker.started or self.limits is None:
            raise CoopenvError(f"a process died: out of memory, or killed, or an observer ended it ({ended})")
        task, part, reason = self.tasks[number], self.done[number], reason or ended
        for other in (number, *self.waiting):
            self.tasks[other] = self.tasks[other].ending(task, part, reason, everywhere)
        self.tasks[number], self.done[number] = self.tasks[number].rest(part), 0
        self.waiting.appendleft(number)
