"""Warp's cache of compiled kernels on the disk.

What is damaged is built again, what cannot be written is one line, and what several processes need is compiled by one.
"""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from glob import escape
from pathlib import Path
from typing import Any

import warp as wp

from coopenv.base.errors import CoopenvError
from coopenv.base.files import lock

ATTEMPTS = 3
"""Attempts to load a module. The second builds it anew; a third is for two processes that mend the same one."""
PROBE_BYTES = 5 << 20  # as much as the source and the code of a large module have
LONGEST_COMPILATION = 120.0  # s; who holds a module for longer has been stopped, by Ctrl-Z for example
_MODULE, _LOCKS = "wp_", "locks"
"""How names of folders of modules begin; the folder of the locks."""
_loaded: set[str] = set()  # names of modules that this process has loaded


class KernelCacheError(CoopenvError):
    """Compiled kernels cannot be kept where they should go."""


@contextmanager
def _written() -> Iterator[None]:
    """Say where compiled kernels should have gone, and what to do."""
    try:
        yield
    except OSError as error:
        raise KernelCacheError(
            f"cannot keep compiled kernels in {cache_folder()}: {error.strerror or error}; set the variable "
            "WARP_CACHE_PATH to a folder that can be written"
        ) from None


def start() -> None:
    """Initialise Warp, which makes the folder of the cache. Raises KernelCacheError: it cannot."""
    with _written():
        wp.init()


def launch(kernel: wp.Kernel, **options: Any) -> Any:
    """Do what `wp.launch` does with a kernel that is in memory, in the cache, damaged there, or not compiled yet."""
    name = kernel.module.name
    if name in _loaded:
        try:
            return wp.launch(kernel, **options)
        except Exception:  # a function of it has been defined anew, and what the cache has of that is damaged
            _loaded.discard(name)
    with _alone(name):
        done = _launch(kernel, options)
    _loaded.add(name)
    return done


def _launch(kernel: wp.Kernel, options: dict[str, Any]) -> Any:
    for attempt in range(ATTEMPTS):
        kept = list(cache_folder().glob(f"{_MODULE}{escape(kernel.module.name)}_{'[0-9a-f]' * 7}"))
        if not kept:
            probe()  # LLVM ends the process where it cannot write
        try:
            return wp.launch(kernel, **options)
        except Exception:  # Warp raises what it has: OSError, ValueError, RuntimeError, Exception itself
            for module in kept:
                shutil.rmtree(module, ignore_errors=True)
            probe()
            if not kept or attempt == ATTEMPTS - 1:
                raise
            kernel.module.unload()  # forgets the failure
    return None


@contextmanager
def _alone(name: str) -> Iterator[None]:
    """Let one process at a time load a module, so that the others find what it has compiled."""
    place, descriptor = cache_folder() / _LOCKS / name, None
    with suppress(OSError):  # a cache that is only read, or on a disk without locks
        place.mkdir(parents=True, exist_ok=True)
        descriptor = lock(place, LONGEST_COMPILATION)
    try:
        yield
    finally:
        if descriptor is not None:
            os.close(descriptor)


def cache_folder() -> Path:
    """Return the folder of the cache of this version of Warp."""
    return Path(wp.config.kernel_cache_dir or "")


def modules() -> set[str]:
    """Return the names of the folders of compiled modules; those that are being compiled have one, too."""
    try:
        return {entry.name for entry in cache_folder().iterdir() if entry.name.startswith(_MODULE)}
    except OSError:
        return set()


def probe() -> None:
    """Make sure that the cache can be written. Raises KernelCacheError: it cannot."""
    with _written(), tempfile.TemporaryFile(dir=cache_folder()) as stream:
        stream.write(bytes(PROBE_BYTES))
