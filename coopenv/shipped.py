"""What ships with the package: its version, environments and agents. Light, so that the start-up can use it."""

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
    package = Path(__file__).resolve().parent
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
