"""Executors of tasks: processes of this machine, or an existing Ray cluster.

An executor maps one function over tasks. What comes out depends on neither the executor nor its number of workers.
Tasks in parts are ended one by one when they use more time or memory than they may. The parent measures: a limit of the
system on the address space would end numerical libraries as well. Processes end within two seconds of a signal, or with
their parent.
"""

import os
import pickle
import socket
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from time import monotonic
from typing import Any, TypeVar

import psutil

from coopenv.base.errors import CoopenvError, error_text, shown
from coopenv.base.installation import (
    ONE_THREAD,
    available_cores,
    environment,
    install_command,
    load_reference,
    needing,
)
from coopenv.base.interrupts import end_with_parent
from coopenv.base.processes import ChildProcess

POLL = 0.1  # s between two looks at the processes
PATIENCE = 10.0
"""Seconds of the clock per second of processor time: a process that waits for ever needs none."""
NOT_RUN = "; its remaining records were not run"
"""End of a reason for which an observer is started on no further record."""


@dataclass(frozen=True)
class ProcessLimits:
    """Time and memory limits of an observer on one record."""

    seconds: float = 1800.0
    """Limit of processor time, s."""
    mebibytes: float = 8192.0
    """Limit of memory, MiB, besides the earlier use of its process."""


def _work(pipe: Connection) -> None:
    """Do tasks as they come: send (part,) each, then () or the exception that ended the task.

    What tasks print goes to standard error: standard output is the parent's document.
    """
    end_with_parent()
    os.dup2(2, 1)
    while True:
        try:
            task, done, ended = pipe.recv()
        except EOFError:  # the parent was interrupted before it sent a task
            return
        try:
            for part in task.parts(done, ended):
                pipe.send((part,))
            pipe.send(())
        except BaseException as error:
            try:
                pipe.send(error)
            except Exception:  # of a class that cannot be sent
                pipe.send(CoopenvError(error_text(error)))


class _Worker(ChildProcess):
    """A process, and how far it is with a task."""

    def __init__(self) -> None:
        super().__init__(_work)
        self.number = -1  # of its task; negative: it is idle
        self.started = False  # whether the parts have begun
        self.before = (0.0, 0.0, 0.0)  # as `measured`, when the present part began

    def measured(self) -> tuple[float, float, float]:
        """Return the processor time and the clock, s, and the memory, MiB, its own processes included."""
        family = [self.usage, *self.usage.children(recursive=True)]
        times = [member.cpu_times() for member in family]
        memory = sum(member.memory_info().rss for member in family) / 2**20
        return sum(time.user + time.system for time in times), monotonic(), memory

    def excess(self, limits: ProcessLimits, where: str) -> tuple[str, str] | None:
        """Return the limit that the present part exceeds, in words, and the end of the reason; None: no limit."""
        with suppress(psutil.Error):  # it has ended, and its pipe with it
            time, clock, memory = (now - then for now, then in zip(self.measured(), self.before, strict=True))
            if time > limits.seconds or clock > PATIENCE * limits.seconds:
                return f"more than {limits.seconds:g} s{where} (--seconds)", NOT_RUN
            if memory > limits.mebibytes:
                return f"more than {limits.mebibytes:g} MiB of memory (--memory)", ""
        return None


class Pool:
    """Workers, and the tasks that wait for one."""

    def __init__(self, tasks: Sequence[Any], jobs: int, limits: ProcessLimits | None) -> None:
        """Take tasks such as `judge.Task`; without limits whatever a part raises ends all."""
        self.tasks, self.jobs, self.limits = tasks, jobs, limits
        self.waiting = deque(range(len(tasks)))
        self.results: list[list[Any]] = [[] for _ in tasks]
        """Results of the finished parts of each task."""
        self.ended: list[tuple[str, Any, str]] = []
        """Observers that are not started again, the world in which (None: everywhere), and why."""
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
            number = self.waiting.popleft()
            idle[0].number, idle[0].started, task = number, False, self.tasks[number]
            ended = {name: reason for name, world, reason in self.ended if world in (None, task.world)}
            idle[0].pipe.send((task, len(self.results[number]), ended))

    def _look(self) -> bool:
        """Receive the workers' results, and end workers above a limit; return whether a task is finished."""
        finished, ready = False, wait([worker.pipe for worker in self._busy], POLL)
        for worker in self._busy:
            if worker.pipe in ready:
                try:
                    message = worker.pipe.recv()
                except (EOFError, OSError):
                    self._fail(worker, "")
                else:
                    finished = self._take(worker, message) or finished
            elif worker.started and self.limits is not None:
                where = "" if isinstance(self.tasks[worker.number], _Whole) else " on one record"
                if excess := worker.excess(self.limits, where):
                    self._fail(worker, *excess)
        return finished

    def _take(self, worker: _Worker, message: Any) -> bool:
        """Take a message of a worker; return whether its task is finished."""
        if isinstance(message, BaseException):
            if not worker.started or self.limits is None or isinstance(self.tasks[worker.number], _Whole):
                raise message
            self._fail(worker, str(message) if isinstance(message, CoopenvError) else error_text(message))
        elif message:
            with suppress(psutil.Error):
                worker.before = worker.measured()
            if worker.started:
                self.results[worker.number] += message
            worker.started = True
        else:
            worker.number = -1
        return worker.number < 0

    def _fail(self, worker: _Worker, reason: str, end: str = "") -> None:
        """End a worker, and its observer in this world, or with `NOT_RUN` everywhere; the rest of its task waits."""
        number, ended = worker.number, worker.end()
        self.workers.remove(worker)
        if not worker.started or self.limits is None:
            raise CoopenvError(f"a process died: out of memory, or killed, or an observer ended it ({ended})")
        if isinstance(task := self.tasks[number], _Whole):
            raise CoopenvError(f"'{task.task}' cannot be loaded: {reason or ended}")
        observer, world = [*task.observers][len(self.results[number])], None if end else task.world
        self.ended.append((observer, world, f"with seed {task.seed}: {reason or ended}{end}"))
        self.waiting.appendleft(number)


T = TypeVar("T")
R = TypeVar("R")

AUTO = "auto"
EXECUTORS = ("local", "ray")
CLUSTER_PATIENCE = 30.0  # s, to reach a cluster


@dataclass(frozen=True)
class Local:
    """Processes of this machine, or this very process where one is enough."""

    jobs: int
    limits: ProcessLimits | None = None
    """Limits of observers, in `coopenv.bench.observers.judge.judge_all`; None: no limits, and they may run here."""

    def __post_init__(self) -> None:
        if not isinstance(self.jobs, int) or self.jobs < 1:
            raise CoopenvError(f"jobs: expected a whole number from 1 on, got {shown(self.jobs)}")

    def map(self, function: Callable[[T], R], tasks: Sequence[T], on_done: Callable[[int], None]) -> list[R]:
        """Return function(task) of every task."""
        if min(self.jobs, len(tasks)) > 1:
            return [
                result for [result] in Pool([_Whole(function, task) for task in tasks], self.jobs, None).run(on_done)
            ]
        results = []
        for task in tasks:
            results.append(function(task))
            on_done(len(results))
        return results


@dataclass(frozen=True)
class _Whole:
    """A task in one part."""

    function: Callable[[Any], Any]
    task: Any

    def parts(self, done: int, ended: Mapping[str, str]) -> Iterator[Any]:
        yield None
        yield self.function(self.task)


@dataclass(frozen=True)
class Ray:
    """Tasks of an existing Ray cluster, whose nodes have coopenv installed; one core each."""

    address: str

    def map(self, function: Callable[[T], R], tasks: Sequence[T], on_done: Callable[[int], None]) -> list[R]:
        """Return function(task) of every task; Ray repeats those whose node was lost."""
        ray = self.connect()
        remote = ray.remote(num_cpus=1, max_retries=3)(lambda task: function(task))  # Ray takes no `partial`
        work = {remote.remote(task): n for n, task in enumerate(tasks)}
        results: dict[int, R] = {}
        waiting = list(work)
        while waiting:
            (done,), waiting = ray.wait(waiting, num_returns=1)
            try:
                results[work[done]] = ray.get(done)
            except ray.exceptions.RayTaskError as error:
                raise error.cause or error from None
            on_done(len(results))
        return [results[n] for n in range(len(tasks))]

    def connect(self) -> Any:
        """Return Ray, connected to the cluster.

        Raises:
            CoopenvError: Ray is not installed, or the cluster does not answer in time.
        """
        os.environ.setdefault("RAY_BACKEND_LOG_LEVEL", "fatal")  # a failure is one line, printed here
        with needing(f"--engine ray needs Ray: {install_command('ray')}"):
            import ray
        if ray.is_initialized():
            return ray
        failure: list[BaseException | None] = []

        def attempt() -> None:
            try:
                options = {"runtime_env": {"env_vars": dict(ONE_THREAD)}, "log_to_driver": False}
                ray.init(address=self.address, configure_logging=False, **options)
                failure.append(None)
            except Exception as error:
                failure.append(error)

        # In a thread that may be left behind: something that accepts and never answers would hold up Ray for ever.
        thread = threading.Thread(target=attempt, daemon=True)
        thread.start()
        thread.join(CLUSTER_PATIENCE)
        if not failure or failure[0] is not None:
            reason = str(failure[0]).strip().splitlines()[0] if failure else f"no answer within {CLUSTER_PATIENCE:g} s"
            raise CoopenvError(
                f"no Ray cluster at '{self.address}': {reason} (one with tokens needs RAY_AUTH_MODE=token and "
                "RAY_AUTH_TOKEN_PATH)"
            )
        return ray


Executor = Local | Ray


def _load(reference: str) -> None:
    load_reference(reference)


def check_imports(executor: Executor, observers: Sequence[str], load: Callable[[str], Any] = _load) -> list[Any]:
    """Load observers in other processes first, under the limits of an executor that has some; return what `load` does.

    Raises:
        CoopenvError: one cannot be loaded, ends its process or exceeds a limit.
    """
    if not isinstance(executor, Local) or executor.limits is None:
        return []
    tasks = [_Whole(load, name) for name in observers]
    return [found for [found] in Pool(tasks, executor.jobs, executor.limits).run(lambda done: None)]


def find_executor(
    name: str,
    jobs: int | None = None,
    address: str | None = None,
    seconds: float | None = None,
    mebibytes: float | None = None,
) -> Executor:
    """Return an executor that is ready, by its name and the options of `bench observers`.

    One job has no limits unless they are given: it is this very process, which takes any observer.

    Raises:
        CoopenvError: no such executor, an option of the other one, or it is not ready.
    """
    if name not in EXECUTORS:
        raise CoopenvError(f"--engine {name}: known are {', '.join(EXECUTORS)}")
    if name == "local":
        if address is not None:
            raise CoopenvError(f"--address {address}: only --engine ray has an address")
        both = {"seconds": seconds, "mebibytes": mebibytes}
        given = {key: value for key, value in both.items() if value is not None}
        return Local(jobs or available_cores(), ProcessLimits(**given) if given or jobs != 1 else None)
    for option, value in (("--jobs", jobs), ("--seconds", seconds), ("--memory", mebibytes)):
        if value is not None:
            raise CoopenvError(f"{option} {value:g}: with --engine ray the cluster decides")
    if address not in (None, AUTO):
        reach(address)
    executor = Ray(address or AUTO)
    executor.connect()
    return executor


def reach(address: str) -> None:
    """Make sure that something listens at HOST:PORT.

    Raises:
        CoopenvError: nothing does, or that is no such address.
    """
    host, _, port = address.rpartition(":")
    if not host or not port.isdigit():
        raise CoopenvError(f"--address {address}: expected HOST:PORT or {AUTO}")
    try:
        socket.create_connection((host, int(port)), timeout=10.0).close()
    except (OSError, OverflowError) as error:
        raise CoopenvError(f"no Ray cluster at '{address}': {error}") from None
