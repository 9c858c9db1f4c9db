"""Compile kernels once per precision, keep them on disk, replay their launches, and split them over threads.

Each kernel has its own Warp module per precision, so that it is compiled once and then found in the cache,
independent of the program. A generic kernel in a shared module would be rebuilt for every new combination.

Warp's cache on the disk: damaged modules are rebuilt, a folder that cannot be written is one error line, and a module
that several processes need is compiled by one of them.
"""

import os
import re
import shutil
import tempfile
from collections.abc import Callable, Hashable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from glob import escape
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from coopenv.base.errors import CoopenvError, shown
from coopenv.base.files import lock, muted_errors
from coopenv.base.installation import available_cores
from coopenv.world.warp_internals import SOURCE_RULES, cpu_features, field_types, lanes_guest, replay_of

ATTEMPTS = 3
"""Attempts to load a module: the second rebuilds it, the third is for two processes that rebuild the same one."""
PROBE_BYTES = 5 << 20  # as much as the source and the code of a large module have
LONGEST_COMPILATION = 120.0  # s; a process that holds a lock for longer is taken for suspended (Ctrl-Z)
SHIPPED = Path(__file__).resolve().parents[1] / "data" / "kernels"  # no other folder: it has machine code
"""Compiled modules of the wheel; of a checkout those of `python -m benchmarks.kernels`."""
_MODULE, _LOCKS = "wp_", "locks"
"""Prefix of the folders of modules; folder of the locks."""
_loaded: set[str] = set()  # names of modules that this process has loaded


class KernelCacheError(CoopenvError):
    """Compiled kernels cannot be kept where they should go."""


@contextmanager
def _written() -> Iterator[None]:
    """State the folder of the compiled kernels, and the remedy."""
    try:
        yield
    except OSError as error:
        raise KernelCacheError(
            f"cannot keep compiled kernels in {cache_folder()}: {error.strerror or error}; set the variable "
            "WARP_CACHE_PATH to a folder that can be written"
        ) from None


def launch(kernel: wp.Kernel, **options: Any) -> Any:
    """Launch as `wp.launch` a kernel that is in memory, in the cache, damaged there, or not compiled yet."""
    name = kernel.module.name
    if name in _loaded:
        try:
            return wp.launch(kernel, **options)
        except Exception:  # one of its functions was redefined, and its cached build is damaged
            _loaded.discard(name)
    with _locked(name):
        done = _launch(kernel, options)
    _loaded.add(name)
    return done


def _launch(kernel: wp.Kernel, options: dict[str, Any]) -> Any:
    folders = f"{_MODULE}{escape(kernel.module.name)}_{'[0-9a-f]' * 7}"
    for module in SHIPPED.glob(folders):
        if not (cached := cache_folder() / module.name).exists():
            with suppress(OSError):  # it is compiled instead
                shutil.copytree(module, cached)
    for attempt in range(ATTEMPTS):
        kept = list(cache_folder().glob(folders))
        if not kept:
            probe()  # LLVM ends the process where it cannot write
        try:
            return wp.launch(kernel, **options)
        except Exception:  # Warp raises OSError, ValueError, RuntimeError and Exception itself
            for module in kept:
                shutil.rmtree(module, ignore_errors=True)
            probe()
            if not kept or attempt == ATTEMPTS - 1:
                raise
            kernel.module.unload()  # forgets the failure
    return None


@contextmanager
def _locked(name: str) -> Iterator[None]:
    """Let one process at a time load a module, so that other processes find the compiled module."""
    path, descriptor = cache_folder() / _LOCKS / name, None
    with suppress(OSError):  # a cache that is only read, or on a disk without locks
        path.mkdir(parents=True, exist_ok=True)
        descriptor = lock(path, LONGEST_COMPILATION)
    try:
        yield
    finally:
        if descriptor is not None:
            os.close(descriptor)


def cache_folder() -> Path:
    """Return the folder of the cache of this version of Warp."""
    return Path(wp.config.kernel_cache_dir or "")


def modules() -> set[str]:
    """Return the names of the folders of compiled modules, including modules that are being compiled."""
    try:
        return {entry.name for entry in cache_folder().iterdir() if entry.name.startswith(_MODULE)}
    except OSError:
        return set()


def probe() -> None:
    """Make sure that the cache can be written. Raises KernelCacheError: it cannot."""
    with _written(), tempfile.TemporaryFile(dir=cache_folder()) as stream:
        stream.write(bytes(PROBE_BYTES))


Function = Callable[..., None] | wp.Kernel
Call = tuple[wp.Kernel, list[Any]]  # a kernel with its arguments
WORLDS_PER_BLOCK, BLOCK_BYTES = 16, 2**20
"""Worlds that go through a decision together, and bytes of their state: at most, so that it stays in the cache."""
WORLDS_PER_THREAD = 32  # smaller shares are not worth the handing over between threads
VEHICLES_PER_THREAD = 64
"""Vehicles of a world per thread. With `riccati`, two threads run one world of 64, 128, 256 and 1,024 vehicles 1.3,
1.4, 1.6 and 1.9 times as fast as one, by the CPU time of the slower thread."""
THREADS_PER_BLOCK = 32
"""Threads per block on a GPU: one warp, so that a small batch keeps all multiprocessors busy. 4,096 worlds run twice
as fast on an H200 as with blocks of 256, 65,536 worlds equally fast."""
VEHICLES_PER_LEVEL = 8  # and lane; smaller levels (`coopenv.world.step.Turns`) are taken in turn


@cache
def start_warp() -> None:
    """Initialise Warp, which makes the folder of the cache, without its banner.

    The notice of its library about a missing GPU driver is suppressed, too.

    Raises:
        KernelCacheError: the folder cannot be made.
    """
    wp.config.log_level = wp.LOG_ERROR
    wp.config.cuda_output = wp.config.cuda_output or "cubin"  # code of the device itself, which `make cuda-check` makes
    with muted_errors(), _written():
        wp.init()


@cache
def kernel(function: Function, precision_name: str, differentiable: bool = False) -> wp.Kernel:
    """Return a plain Python function as a Warp kernel whose module serves one precision only.

    Its module has the options that its file sets with `wp.set_module_options`. A `wp.Kernel` is returned unchanged.
    """
    if isinstance(function, wp.Kernel):
        return function
    kind = ".differentiable" if differentiable else ""
    module = wp.get_module(f"{function.__module__}.{function.__name__}.{precision_name}{kind}")
    module.options.update(wp.get_module(function.__module__).options)
    module.options.update(_own_options(), enable_backward=differentiable)
    return wp.Kernel(func=function, key=function.__name__, module=module)


def module_kernels(name: str, p: Any, *functions: Callable[..., None], **options: Any) -> dict[str, wp.Kernel]:
    """Return functions, whose arguments have Warp types, as the kernels of one module, by name.

    Args:
        name: of the module, besides the precision.
        p: the `Precision` that it serves.
        functions: as for `wp.kernel`.
        options: of the module.
    """
    module = wp.get_module(f"coopenv.{name}.{p.name}")
    module.options.update({**_own_options(), **options}, enable_backward=False)
    return {function.__name__: wp.Kernel(func=function, key=function.__name__, module=module) for function in functions}


def _own_options() -> dict[str, Any]:
    """Return the options of this package's modules."""
    return {**compiler_options(), "block_dim": THREADS_PER_BLOCK, "source_rules": SOURCE_RULES}


INLINE_THRESHOLD = 2000
"""Cost up to which LLVM inlines a function. Warp's 9000 compiles longer and runs no faster; 1000 makes steps a tenth
slower."""
X86_64_V3 = frozenset({"avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe"})
"""Features of processors that share compiled kernels, those of a wheel among them. AVX-512 makes no step faster."""


def compiler_options() -> dict[str, Any]:
    """Return the compiler's options of all kernels; flags that the user has set are kept.

    The same for all modules, because Warp's headers are parsed once for each set of flags. LLVM keeps its own depth of
    vectorisation: Warp's smaller one slows large observers down.
    """
    flags = (wp.config.cpu_compiler_flags or "").split()
    if not any("-inline-threshold" in flag for flag in flags):
        return {}
    start_warp()
    kept = [flag for flag in flags if not flag.startswith("-mllvm")]
    if "-march=native" in kept and cpu_features() >= X86_64_V3:
        kept = [*(flag for flag in kept if flag != "-march=native"), "-target-cpu", "x86-64-v3"]
    threshold = f"-mllvm=-inline-threshold={INLINE_THRESHOLD}"
    return {"cpu_compiler_flags": " ".join([*kept, threshold])}


MOST_THREADS = 1024


def default_threads() -> int:
    """Return the largest number of threads of a launch on the CPU: all cores, or COOPENV_THREADS."""
    wanted = os.environ.get("COOPENV_THREADS", "")
    if wanted and not (re.fullmatch("[0-9]{1,4}", wanted) and 0 < int(wanted) <= MOST_THREADS):
        raise CoopenvError(f"COOPENV_THREADS must be a whole number from 1 to {MOST_THREADS}, got {shown(wanted)}")
    return int(wanted or available_cores())


def threads_and_lanes(worlds: int, vehicles: int, device: str, threads: int | None = None) -> tuple[int, int]:
    """Return the number of threads of a batch, and the number of lanes of each of its worlds.

    One of them is 1: a thread takes some of the worlds, or some of the vehicles of every world; the choice keeps more
    threads busy. A GPU has a thread per world, or per vehicle of every world.
    """
    by_world = worlds if threads is not None else worlds // WORLDS_PER_THREAD
    by_vehicle = vehicles // VEHICLES_PER_THREAD
    if device != "cpu":
        return 1, vehicles if by_vehicle > max(worlds // WORLDS_PER_THREAD, 1) else 1
    most = default_threads() if threads is None else threads
    if min(by_vehicle, most) > min(by_world, most):
        return 1, min(by_vehicle, most)
    return max(min(by_world, most), 1), 1


def width_of_lanes(device: str, precision_name: str) -> int:
    """Return how many worlds kernels of a device and precision can take at once (`coopenv.lanes`); 0: one by one."""
    guest = lanes_guest() if (device, precision_name) == ("cpu", "float32") else None
    if guest is None:
        return 0
    start_warp()
    return int(guest.WIDTH) if cpu_features() >= X86_64_V3 else 0


@dataclass(frozen=True)
class PerWorld:
    """Marks a kernel argument whose arrays have the world as leading axis."""

    value: Any

    def part(self, share: tuple[int, int], worlds: int) -> Any:
        """Return the argument for a range of the worlds, sharing memory."""
        if share == (0, worlds):
            return self.value
        if isinstance(self.value, wp.array):
            return self.value[slice(*share)] if self.value.size > 0 else self.value  # Warp cannot slice an empty array
        part = type(self.value)()
        for name in field_types(self.value):
            value = getattr(self.value, name)
            setattr(part, name, PerWorld(value).part(share, worlds) if isinstance(value, wp.array) else value)
        return part


@dataclass(frozen=True)
class PerLane:
    """Marks a kernel argument with one record per lane on the CPU: records that differ in their scratch."""

    values: Sequence[Any]


class Launcher:
    """Launches kernels whose grid is (worlds, ...) on one device.

    The first launch under a key is recorded and later ones replay it in about a microsecond, so a key must always come
    with the same arguments. On the CPU the batch may be split over threads: worlds are independent, so the
    result does not depend on the split. Launches release the interpreter lock.

    In place of the batch its worlds may be split, over `lanes` (`threads_and_lanes`): every lane has some vehicles of
    all worlds. Work of vehicles in parallel then uses `by_lane` and `by_vehicle`.
    """

    def __init__(
        self, worlds: int, device: str, precision_name: str, threads: int = 1, lanes: int = 1, size: int = 1
    ) -> None:
        self._per_block = min(max(BLOCK_BYTES // size, 1), WORLDS_PER_BLOCK)  # a world has `size` bytes
        self._worlds, self._device, self._precision = worlds, device, precision_name
        self.lanes = lanes
        self._lane_threads = lanes if device == "cpu" else 1
        self._shares = _split(0, worlds, threads)
        self._recorded: dict[Hashable, list[list[Callable[[], Any]]]] = {}
        self._pool: ThreadPoolExecutor | None = None
        self._pool_owner = 0

    def __call__(self, key: Hashable, function: Function, arguments: list[Any], inner: tuple[int, ...] = ()) -> None:
        """Run a kernel over the grid (worlds, *inner)."""
        if key not in self._recorded:
            self._recorded[key] = [[self._record(function, arguments, share, inner)] for share in self._shares]
        self._run(self._recorded[key])

    def by_vehicle(self, key: Hashable, function: Function, arguments: list[Any], vehicles: int) -> None:
        """Run a kernel over the grid (worlds, vehicles); its last argument is the number of the first vehicle."""
        if key not in self._recorded:
            self._recorded[key] = [
                [self._record(function, [*arguments, first], share, (last - first,), lane)]
                for share in self._shares
                for lane, (first, last) in enumerate(_split(0, vehicles, self._lane_threads))
            ]
        self._run(self._recorded[key])

    def by_lane(self, key: Hashable, *calls: Call) -> None:
        """Run kernels over the grid (worlds, lanes), in each lane one after the other.

        Their last arguments are the first lane and how many there are.
        """
        if key not in self._recorded:
            width = self.lanes // self._lane_threads
            self._recorded[key] = [
                [self._record(f, [*arguments, lane, self.lanes], share, (width,), lane) for f, arguments in calls]
                for share in self._shares
                for lane in range(self._lane_threads)
            ]
        self._run(self._recorded[key])

    def decision(self, key: Hashable, ticks: int, first: Call, *tick: Call) -> None:
        """Run a kernel, and then others in turn by one lane, a number of times; on the CPU a few worlds at a time."""
        if key not in self._recorded:
            self._recorded[key] = [self._record_decision(ticks, first, tick, share) for share in self._shares]
        self._run(self._recorded[key])

    def _record_decision(
        self, ticks: int, first: Call, tick: Sequence[Call], share: tuple[int, int]
    ) -> list[Callable[[], Any]]:
        blocks = (share[1] - share[0]) // self._per_block if self._device == "cpu" else 1
        launches = []
        for block in _split(*share, max(1, blocks)):
            launches.append(self._record(*first, block))
            of_tick = [self._record(function, [*arguments, 0, 1], block, (1,)) for function, arguments in tick]
            launches.extend(of_tick * ticks)
        return launches

    def _record(
        self,
        function: Function,
        arguments: list[Any],
        share: tuple[int, int],
        inner: tuple[int, ...] = (),
        lane: int = 0,
    ) -> Callable[[], Any]:
        """Return the recorded launch of a kernel for a share of the worlds."""
        given = [a.values[lane] if isinstance(a, PerLane) else a for a in arguments]
        command = launch(
            kernel(function, self._precision),
            dim=(share[1] - share[0], *inner),
            inputs=[a.part(share, self._worlds) if isinstance(a, PerWorld) else a for a in given],
            device=self._device,
            block_dim=1 if self._device == "cpu" else THREADS_PER_BLOCK,
            record_cmd=True,
        )
        return replay_of(command)

    def _run(self, shares: list[list[Callable[[], Any]]]) -> None:
        first, *rest = shares
        others = [self._workers().submit(_run_all, launches) for launches in rest]
        _run_all(first)
        for other in others:
            other.result()

    def _workers(self) -> ThreadPoolExecutor:
        """Return this process's threads: a parent's threads do not exist after a fork."""
        if self._pool is None or self._pool_owner != os.getpid():
            threads = max(len(self._shares), self._lane_threads)
            self._pool, self._pool_owner = ThreadPoolExecutor(threads - 1), os.getpid()
        return self._pool

    def close(self) -> None:
        """End the threads; a later launch starts new ones."""
        if self._pool is not None and self._pool_owner == os.getpid():
            self._pool.shutdown(wait=False)
        self._pool = None


def _split(start: int, stop: int, parts: int) -> list[tuple[int, int]]:
    """Return the ranges of indices into which a range is split, empty ones left out."""
    bounds = np.linspace(start, stop, parts + 1).round().astype(int).tolist()
    return [(a, b) for a, b in pairwise(bounds) if b > a]


def _run_all(launches: list[Callable[[], Any]]) -> None:
    for launch in launches:
        launch()
