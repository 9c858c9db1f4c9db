"""What a run writes into its folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from coopenv.estimation.trajectory import Trajectory
from coopenv.files import replace_text
from coopenv.jsonable import json_text
from coopenv.viz import FORMATS

METRICS_FILE = "metrics.json"
TRAJECTORY_FILE = "trajectory.npz"
VIDEO_FILES = ("video.mp4", "video.gif")


def result_names() -> list[str]:
    """Return the names of all files that a run can write."""
    from coopenv.viz.figures import FIGURE_NAMES

    figures = [f"{name}.{file_format}" for name in FIGURE_NAMES for file_format in FORMATS]
    return [METRICS_FILE, TRAJECTORY_FILE, *figures, *VIDEO_FILES]


def write_results(folder: Path, trajectory: Trajectory, metrics: dict[str, Any]) -> list[Path]:
    """Write `metrics.json` and `trajectory.npz` and return their paths.

    Raises:
        OutputError: a file cannot be written.
    """
    replace_text(folder / METRICS_FILE, json_text(metrics))
    trajectory.save(folder / TRAJECTORY_FILE)
    return [folder / METRICS_FILE, folder / TRAJECTORY_FILE]
