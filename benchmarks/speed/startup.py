"""Delays before the first step: imports, and the compiling of kernels."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from statistics import median

from benchmarks.speed.cases import COOPENV, Library
from benchmarks.speed.measure import OnProgress
from benchmarks.speed.workers import VARIABLES

IMPORT = "import time; start = time.perf_counter(); import {module}; print(time.perf_counter() - start)"
FIRST_STEP = """
import time, numpy, coopenv.api.vector_env
start = time.perf_counter()
env = coopenv.make_vec({environment!r}, num_worlds=1, dtype={dtype!r}, overrides={overrides!r})
env.reset(seed=0)
env.step(numpy.zeros((env.num_envs, 2), dtype=numpy.float32))
print(time.perf_counter() - start)
"""


@dataclass
class Startup:
    """Times in s, each of a fresh process; absent when not measured."""

    imports: dict[str, float] = field(default_factory=dict)
    """Per library."""
    compiling: dict[str, float] = field(default_factory=dict)
    """Per precision: build, reset and first step of one world with an empty kernel cache."""
    cached: dict[str, float] = field(default_factory=dict)
    """The same with the kernels in the cache."""


def units_of_work(libraries: list[Library], dtypes: tuple[str, ...], repeats: int) -> int:
    """Return how often `measure_startup` reports progress."""
    return len(libraries) * repeats + 2 * len(dtypes)


def measure_startup(
    libraries: list[Library],
    environment: str,
    overrides: dict[str, object],
    dtypes: tuple[str, ...],
    repeats: int,
    on_progress: OnProgress = lambda text: None,
) -> Startup:
    """Import every library in fresh processes, alternating, and compile coopenv's kernels of some precisions."""
    times: dict[str, list[float]] = {library.name: [] for library in libraries}
    for _ in range(repeats):
        for library in libraries:
            on_progress(f"importing {library.name}")
            seconds = _fresh_process(IMPORT.format(module=library.module), {})
            if seconds is not None:
                times[library.name].append(seconds)
    result = Startup({name: median(seconds) for name, seconds in times.items() if seconds})
    with tempfile.TemporaryDirectory() as cache:
        for dtype in dtypes:
            script = FIRST_STEP.format(environment=environment, dtype=dtype, overrides=overrides)
            for kind, found in ((f"compiling {dtype}", result.compiling), (f"loading {dtype}", result.cached)):
                on_progress(f"{COOPENV.name}: {kind}")
                seconds = _fresh_process(script, {"WARP_CACHE_PATH": cache})
                if seconds is not None:
                    found[dtype] = seconds
    return result


def _fresh_process(script: str, variables: dict[str, str]) -> float | None:
    """Return the last number that a script prints, None when it fails."""
    done = subprocess.run(
        [sys.executable, "-P", "-W", "ignore", "-c", script],
        env={**os.environ, **VARIABLES, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), **variables},
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
    )
    lines = done.stdout.split()
    return float(lines[-1]) if done.returncode == 0 and lines else None
