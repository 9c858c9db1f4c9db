"""The installed package: its version, its shipped files, and the machine it runs on."""

import os
import platform
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from importlib import metadata
from pathlib import Path

SCENES = ("lane", "roots", "tree", "random", "ring")
"""Kinds of scenes that are made to measure, `lane:20`; see `coopenv.scenario.scenes`."""


@cache
def data_directory(kind: str) -> Path:
    """Return the folder of a `kind`, inside the installed wheel, else beside the checkout's package.

    Kinds are `envs`, `agents` and `examples/fleet`.
    """
    package = Path(__file__).resolve().parents[1]
    shipped = package / "data" / kind
    return shipped if shipped.is_dir() else package.parent / kind


def list_envs() -> list[str]:
    """Return the names of the environments that ship with coopenv: the file stems of `envs/`."""
    return sorted(path.stem for path in data_directory("envs").glob("*.toml"))


def list_agents() -> list[str]:
    """Return the names of the drivers that ship with coopenv: the folders of `agents/`."""
    return sorted(path.parent.name for path in data_directory("agents").glob("*/agent.toml"))


def version() -> str:
    """Return the installed version, or `unknown` in a checkout that is not installed."""
    try:
        return metadata.version("coopenv")
    except metadata.PackageNotFoundError:
        return "unknown"


ONE_THREAD: Mapping[str, str] = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS"), "1"
)
"""Environment variables that numerical libraries read when they are loaded, here for one thread each."""


def available_cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def versions(*distributions: str) -> dict[str, str]:
    """Return the versions of Python and of those of the distributions that are installed."""
    found = {"python": platform.python_version()}
    for name in distributions:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


@contextmanager
def environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Let processes that are started meanwhile see these environment variables."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
