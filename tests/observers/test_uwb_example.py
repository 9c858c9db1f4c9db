"""The example that reads a public recording of ranges, on files of the same format from a drive of one's own."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from coopenv.base.errors import DataError
from coopenv.observers.runner import run

EXAMPLE = runpy.run_path(str(Path(__file__).parents[2] / "examples/uwb_ranges.py"))
ANCHORS = {105: (0.0, 0.0), 107: (0.0, 3.0), 108: (4.0, 3.0), 109: (4.0, 0.0)}
PERIOD, HALF_TRACK, SPEED, RATE = 0.128, 0.0785, 0.2, 0.1  # s, m, m/s, rad/s


def drive(folder: Path, count: int = 120) -> None:
    """Write a drive along a circle, backwards by the wheels' signs, the left wheel first, with exact ranges."""
    t = PERIOD * np.arange(1, count + 1)
    heading = 0.3 + RATE * (t - t[0])
    radius = SPEED / RATE
    position = [2.0, 1.0] + radius * (
        np.column_stack([np.sin(heading), -np.cos(heading)]) - [np.sin(0.3), -np.cos(0.3)]
    )
    left, right = -SPEED - RATE * HALF_TRACK, -SPEED + RATE * HALF_TRACK
    lines, true = [], []
    for k, when in enumerate(t):
        number = list(ANCHORS)[k % 4]
        x, y = ANCHORS[number]
        distance = np.hypot(position[k, 0] - x, position[k, 1] - y)
        lines += [f"range2 {when:.6f} {distance:.6f} 0.01 {x} {y} {number} 0"]
        lines += [f"odom2diff {when:.6f} {left:.6f} {right:.6f} 0 {HALF_TRACK} 0.0001 0.0001 0.0001"]
        true += [f"point2 {when:.6f} {position[k, 0]:.6f} {position[k, 1]:.6f} 0 0 0 0"]
    (folder / "Indoor_UWB_Input.txt").write_text("\n".join(lines), encoding="utf-8")
    (folder / "Indoor_UWB_GT.txt").write_text("\n".join(true), encoding="utf-8")


def test_a_drive_is_read_as_it_was(tmp_path: Path) -> None:
    drive(tmp_path)
    recording = EXAMPLE["read"](tmp_path)
    reckoned = run("dead_reckoning", recording).position
    assert_allclose(reckoned, recording.truth.position, atol=0.01)
    (_, there, anchor, _) = np.nonzero(np.isfinite(recording.readings["range"]))
    assert set(anchor) == {0, 1, 2, 3}
    ranges = recording.readings["range"][np.isfinite(recording.readings["range"])]
    ticks = np.nonzero(np.isfinite(recording.readings["range"]))[0]
    line = recording.landmarks[0, anchor] - recording.truth.position[ticks, there]
    assert_allclose(np.linalg.norm(line, axis=-1), ranges, atol=SPEED * EXAMPLE["TICK"] + 1e-3)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("Indoor_UWB_GT.txt", None, "No such file"),
        ("Indoor_UWB_GT.txt", "point2 0.1 x 0.0", "could not convert"),
        ("Indoor_UWB_GT.txt", "point2 0.2 1 1\npoint2 0.1 1 1", "'point2' with 3 numbers, their times rising"),
        ("Indoor_UWB_Input.txt", "range2 0.1 1.0 0.01 0 0 105 0", "'odom2diff' with 8 numbers"),
    ],
)
def test_other_files_are_refused_in_a_line(tmp_path: Path, name: str, text: Any, said: str) -> None:
    drive(tmp_path)
    if text is None:
        (tmp_path / name).unlink()
    else:
        (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(DataError, match=said) as raised:
        EXAMPLE["read"](tmp_path)
    assert name in str(raised.value)
