"""Where the work is done: in processes of this machine, or on an existing Ray cluster.

An executor maps one function over tasks. What comes out depends on neither the executor nor its number of workers.
"""

import os
import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from coopenv.base.errors import CoopenvError
from coopenv.base.installation import ONE_THREAD, available_cores, install_command, needing
from coopenv.bench.watched import Limits, Pool

T = TypeVar("T")
R = TypeVar("R")

AUTO = "auto"
EXECUTORS = ("local", "ray")
PATIENCE = 30.0  # s, to reach a cluster


@dataclass(frozen=True)
class Local:
    """Processes of this machine, or this very process where one is enough."""

    jobs: int
    limits: Limits | None = None
    """Of observers, in `coopenv.bench.observers.judge.judge_all`; None: none, and they may run in this process."""

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

    def parts(self) -> Iterator[Any]:
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
        thread.join(PATIENCE)
        if not failure or failure[0] is not None:
            reason = str(failure[0]).strip().splitlines()[0] if failure else f"no answer within {PATIENCE:g} s"
            raise CoopenvError(
                f"no Ray cluster at '{self.address}': {reason} (one with tokens needs RAY_AUTH_MODE=token and "
                "RAY_AUTH_TOKEN_PATH)"
            )
        return ray


Executor = Local | Ray


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
        return Local(jobs or available_cores(), Limits(**given) if given or jobs != 1 else None)
    for option, value in (("--jobs", jobs), ("--seconds", seconds), ("--memory", mebibytes)):
        if value is not None:
            raise CoopenvError(f"{option} {value:g}: with --engine ray the cluster decides")
    if address not in (None, AUTO):
        reach(address)
    executor = Ray(address or AUTO)
    executor.connect()
    return executor


def reach(address: str, patience: float = 10.0) -> None:
    """Make sure that something listens at HOST:PORT.

    Raises:
        CoopenvError: nothing does, or that is no such address.
    """
    host, _, port = address.rpartition(":")
    if not host or not port.isdigit():
        raise CoopenvError(f"--address {address}: expected HOST:PORT or {AUTO}")
    try:
        socket.create_connection((host, int(port)), timeout=patience).close()
    except (OSError, OverflowError) as error:
        raise CoopenvError(f"no Ray cluster at '{address}': {error}") from None
