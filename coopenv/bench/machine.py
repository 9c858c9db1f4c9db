"""On what a measurement was made: processor, system, versions. No names, no paths."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from coopenv.bench.cases import COOPENV, Library, all_threads


def machine() -> dict[str, Any]:
    """Return what a reader needs to place the figures."""
    return {
        "processor": processor(),
        "cores_available": len(os.sched_getaffinity(0)),
        "threads_of_a_large_batch": all_threads(),
        "memory_bytes": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        "system": f"{platform.system()} {platform.machine()}",
        "load_average_at_start": os.getloadavg()[0],
    }


def processor() -> str:
    """Return the processor's name."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def versions(libraries: list[Library]) -> dict[str, str]:
    """Return the versions of Python and of the libraries' distributions that are installed."""
    found = {"python": platform.python_version()}
    for name in (name for library in (COOPENV, *libraries) for name in library.distributions):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
