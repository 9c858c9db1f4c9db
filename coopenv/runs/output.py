"""The folder that a run is written to."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from coopenv.errors import OutputError
from coopenv.estimation.metrics import json_ready
from coopenv.estimation.trajectory import Trajectory

METRICS_FILE = "metrics.json"
TRAJECTORY_FILE = "trajectory.npz"


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn the system's refusal to write `path` into an `OutputError`."""
    try:
        yield
    except OSError as error:
        raise OutputError(f"cannot write to {path}: {error.strerror or error}") from None


def prepare_folder(folder: Path, names: Iterable[str] = (METRICS_FILE, TRAJECTORY_FILE)) -> None:
    """Make the folder, and make sure that files of these names can be written into it.

    Raises:
        OutputError: it cannot be made or written to, or what has one of the names cannot be replaced.
    """
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"cannot write to {folder}: it is not a folder")
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    for path in (folder / name for name in names):
        if path.is_dir():
            raise OutputError(f"cannot write to {path}: it is a folder")
        if path.is_file():
            with writing(path), path.open("ab"):
                pass


def write_results(folder: Path, trajectory: Trajectory, metrics: dict[str, Any]) -> list[Path]:
    """Write `metrics.json` and `trajectory.npz` and return their paths.

    Raises:
        OutputError: a file cannot be written.
    """
    with writing(folder / METRICS_FILE):
        text = json.dumps(json_ready(metrics), indent=2, default=str) + "\n"
        (folder / METRICS_FILE).write_text(text, encoding="utf-8")
    with writing(folder / TRAJECTORY_FILE):
        trajectory.save(folder / TRAJECTORY_FILE)
    return [folder / METRICS_FILE, folder / TRAJECTORY_FILE]
