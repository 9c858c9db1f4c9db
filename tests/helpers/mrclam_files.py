"""Small recordings in MR.CLAM's format, whose truth is known: five robots on circles, in sight of landmarks."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

ORIGIN = 1248444187.0
LANDMARKS = {6: (0.0, 4.0), 7: (4.0, 0.0), 8: (-4.0, 0.0), 9: (0.0, -4.0), 10: (3.0, 3.0)}
BARCODES = {subject: 100 + 3 * subject for subject in range(1, 21)}
HEADER = (
    "# UTIAS Multi-Robot Cooperative Localization and Mapping Dataset\n# produced for a test\n# Format:\n# Columns\n"
)


def pose(robot: int, t: np.ndarray) -> np.ndarray:
    """Return (N, 3) x, y, heading of a robot on its circle, exactly as v and omega say."""
    v, omega = command(robot)
    heading = 0.6 * robot + omega * t
    radius = v / omega
    x = 0.8 * np.cos(robot) + radius * (np.sin(heading) - np.sin(0.6 * robot))
    y = 0.8 * np.sin(robot) - radius * (np.cos(heading) - np.cos(0.6 * robot))
    return np.stack([x, y, (heading + np.pi) % (2 * np.pi) - np.pi], axis=-1)


def command(robot: int) -> tuple[float, float]:
    """Return v m/s and omega rad/s."""
    return 0.1 + 0.01 * robot, 0.1 * (-1) ** robot


def write(parent: Path, number: int = 6, seconds: float = 40.0) -> Path:
    """Write a sub-dataset without noise and return its folder."""
    folder = parent / f"MRCLAM_Dataset{number}"
    folder.mkdir()
    put(folder / "Barcodes.dat", [f"{s:3d} \t {b:4d}" for s, b in BARCODES.items()])
    rows = [f" {s:2d} \t {x:.8f} \t {y:.8f} \t 0.00004570 \t 0.00027395" for s, (x, y) in LANDMARKS.items()]
    put(folder / "Landmark_Groundtruth.dat", rows)
    for robot in range(1, 6):
        t = np.arange(0, seconds, 0.02)
        stamped = np.column_stack([ORIGIN + t, pose(robot, t)])
        rows = [f"{a:.3f} \t {x:.8f} \t {y:.8f} \t {h:.8f}" for a, x, y, h in stamped]
        put(folder / f"Robot{robot}_Groundtruth.dat", rows)
        v, omega = command(robot)
        t = np.arange(0.1, seconds - 0.5, 0.02)
        put(folder / f"Robot{robot}_Odometry.dat", [f"{ORIGIN + a:.3f} \t {v:.8f} \t {omega:.8f}" for a in t])
        put(folder / f"Robot{robot}_Measurement.dat", _sightings(robot, seconds))
    return folder


def _sightings(robot: int, seconds: float) -> list[str]:
    rows = []
    for t in np.arange(1.0 + 0.01 * robot, seconds - 1, 0.5):
        time = float(f"{t:.3f}")
        x, y, heading = pose(robot, np.array([time]))[0]
        targets = {s: np.array(p) for s, p in LANDMARKS.items()}
        targets |= {s: pose(s, np.array([time]))[0, :2] for s in range(1, 6) if s != robot}
        for subject, point in targets.items():
            dx, dy = point - (x, y)
            bearing = (np.arctan2(dy, dx) - heading + np.pi) % (2 * np.pi) - np.pi
            if abs(bearing) < 1.0:
                row = f"{ORIGIN + time:.3f} \t {BARCODES[subject]:4d} \t {np.hypot(dx, dy):.8f} \t {bearing:.8f}"
                rows.append(row)
    return rows


def put(path: Path, rows: list[str]) -> None:
    """Write rows below the usual header of four lines."""
    path.write_text(HEADER + "".join(row + "\n" for row in rows))


def real_folder() -> Path | None:
    """Return a parent of recorded sub-datasets: what COOPENV_DATA says, or shared/data of a folder above."""
    named = os.environ.get("COOPENV_DATA")
    candidates = [Path(named)] if named else []
    candidates += [above / "shared" / "data" for above in Path(__file__).resolve().parents]
    return next((c for c in candidates if (c / "MRCLAM_Dataset6" / "Barcodes.dat").is_file()), None)
