"""Processes in which observers run and are ended, one by one, when they use more time or memory than they may.

The parent measures them: a limit of the system on address space would end numerical libraries as well.
"""

import multiprocessing
import pickle
import signal
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from time import monotonic
from typing import Any, Protocol, Self, TypeVar

import psutil

from coopenv.base.errors import CoopenvError, error_text
from coopenv.base.installation import ONE_THREAD, environment
from coopenv.base.interrupts import end_with_parent, held

POLL = 0.1  # s between two looks at the processes
PATIENCE = 10.0
"""Seconds of the clock per second of processor time: a process that waits for ever needs none."""


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

    def ending(self, other: Self, part: int, reason: str) -> Self:
        """Return the task, in which what has ended in a part of another one is not started, but fails as well."""


D = TypeVar("D", bound=Divided)


@contextmanager
def deaf_children() -> Iterator[None]:
    """Let processes that are started meanwhile not hear Ctrl-C, which a terminal sends to all: the parent decides."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def check_sendable(task: object) -> None:
    """Refuse what cannot be sent to another process, most likely an observer that is defined within a function."""
    try:
        pickle.dumps(task)
    except Exception as error:
        raise CoopenvError(
            f"cannot be sent to another process: {error} (define observers at the top level of a module, or use "
            "--jobs 1)"
        ) from None


def _work(pipe: Connection) -> None:
    """Do tasks as they come: send (part,) each, then () or the exception that ended the task."""
    end_with_parent()
    while True:
        task = pipe.recv()
        try:
            for part in task.parts():
                pipe.send((part,))
            pipe.send(())
        except BaseException as error:
            pipe.send(error if isinstance(error, CoopenvError) else CoopenvError(error_text(error)))


@dataclass
class _Worker:
    """A process, and how far it is with a task."""

    pipe: Connection
    process: Any
    usage: psutil.Process
    number: int = -1
    """Of its task; negative: it is idle."""
    started: bool = False
    """Whether the parts have begun."""
    before: tuple[float, float, float] = field(default=(0.0, 0.0, 0.0))
    """Processor time and clock, s, and memory, MiB, when the present part began."""

    def measured(self) -> tuple[float, float, float]:
        """Return its processor time and the clock, s, and its memory, MiB, with those of its own processes."""
        family = [self.usage, *self.usage.children(recursive=True)]
        times = [member.cpu_times() for member in family]
        memory = sum(member.memory_info().rss for member in family) / 2**20
        return sum(time.user + time.system for time in times), monotonic(), memory

    def excess(self, limits: Limits) -> str:
        """Return the limit that the present part exceeds, in words; empty: none."""
        with suppress(psutil.Error):  # it has ended, which its pipe tells
            time, clock, memory = (now - then for now, then in zip(self.measured(), self.before, strict=True))
            if time > limits.seconds or clock > PATIENCE * limits.seconds:
                return f"more than {limits.seconds:g} s on one record (--seconds)"
            if memory > limits.mebibytes:
                return f"more than {limits.mebibytes:g} MiB of memory (--memory)"
        return ""

    def end(self) -> int:
        """Kill it and the processes that it has started, and return its exit status."""
        with suppress(psutil.Error):
            for child in self.usage.children(recursive=True):
                child.kill()
        self.process.kill()
        self.process.join()
        self.pipe.close()
        return int(self.process.exitcode)


def _new_worker() -> _Worker:
    context = multiprocessing.get_context("spawn")
    pipe, other = context.Pipe()
    process = context.Process(target=_work, args=(other,), daemon=False)
    with held(), deaf_children():
        process.start()
    other.close()
    return _Worker(pipe, process, psutil.Process(process.pid))


def watched(
    tasks: Sequence[D], jobs: int, limits: Limits, on_done: Callable[[int], None] = lambda done: None
) -> list[list[Any]]:
    """Return the results of all parts of every task.

    Raises:
        CoopenvError: a task could not be made ready, or its process died meanwhile.
    """
    check_sendable(tasks[0])
    pool = _Pool([*tasks], limits)
    try:
        with environment(ONE_THREAD):  # matrices here are small: threads would only get in the way
            while pool.waiting or pool.busy:
                pool.assign(jobs)
                if pool.look():
                    on_done(len(tasks) - len(pool.waiting) - len(pool.busy))
    finally:
        for worker in pool.workers:
            worker.end()
    return pool.results


class _Pool:
    """Workers, and the tasks that wait for one."""

    def __init__(self, tasks: list[Any], limits: Limits) -> None:
        self.tasks, self.limits = tasks, limits
        self.waiting = deque(range(len(tasks)))
        self.results: list[list[Any]] = [[] for _ in tasks]
        self.done = [0] * len(tasks)
        """Parts of the present rest of each task that have come."""
        self.workers: list[_Worker] = []

    @property
    def busy(self) -> list[_Worker]:
        return [worker for worker in self.workers if worker.number >= 0]

    def assign(self, jobs: int) -> None:
        """Give idle and new workers the tasks that wait."""
        idle = [worker for worker in self.workers if worker.number < 0]
        while self.waiting and (idle or len(self.workers) < jobs):
            if not idle:
                idle.append(_new_worker())
                self.workers.append(idle[-1])
            worker = idle.pop()
            worker.number, worker.started = self.waiting.popleft(), False
            worker.pipe.send(self.tasks[worker.number])

    def look(self) -> bool:
        """Take what the workers send, and end those above a limit; return whether a task has been finished."""
        finished = False
        ready = wait([worker.pipe for worker in self.busy], POLL)
        for worker in self.busy:
            if worker.pipe in ready:
                try:
                    finished = self._take(worker, worker.pipe.recv()) or finished
                except (EOFError, OSError):
                    self._fail(worker, "")
            elif worker.started and (reason := worker.excess(self.limits)):
                self._fail(worker, reason)
        return finished

    def _take(self, worker: _Worker, message: Any) -> bool:
        """Take a message of a worker; return whether its task is finished."""
        if isinstance(message, CoopenvError):
            if not worker.started:
                raise message
            self._fail(worker, str(message))
            return False
        if message:
            with suppress(psutil.Error):
                worker.before = worker.measured()
            if worker.started:
                self.results[worker.number] += message
                self.done[worker.number] += 1
            worker.started = True
            return False
        worker.number = -1
        return True

    def _fail(self, worker: _Worker, reason: str) -> None:
        """End a worker; what remains of its task waits for another one."""
        number, status = worker.number, worker.end()
        self.workers.remove(worker)
        if not reason:
            ended = signal.Signals(-status).name if status < 0 else f"status {status}"
            reason = f"its process ended with {ended}"
        if not worker.started:
            raise CoopenvError(f"a process died while it made a record: out of memory, or killed ({reason})")
        task, part = self.tasks[number], self.done[number]
        self.tasks[number] = task.ending(task, part, reason).rest(part)
        self.done[number] = 0
        for other in self.waiting:
            self.tasks[other] = self.tasks[other].ending(task, part, reason)
        self.waiting.appendleft(number)
