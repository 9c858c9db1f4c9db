"""Trajectories as TUM files, which evo reads: a line per tick, `timestamp tx ty tz qx qy qz qw`."""

from pathlib import Path

import numpy as np

from coopenv.base.files import replace_text, writing
from coopenv.estimation.poses import quaternion_wxyz
from coopenv.estimation.trajectory import Trajectory


def write_tum(trajectory: Trajectory, folder: str | Path) -> list[Path]:
    """Write `VEHICLE_truth.tum` and `VEHICLE_estimate.tum` of every vehicle, and return their paths.

    Poses are of the body in the map frame, m; ticks at which a pose is not finite are left out.

    Raises:
        OutputError: the folder cannot be made or written to.
    """
    folder = Path(folder)
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for i, name in enumerate(trajectory.vehicles.tolist()):
        poses = {
            "truth": (trajectory.position[:, i], trajectory.rotation[:, i]),
            "estimate": (trajectory.position_estimate[:, i], trajectory.rotation_estimate[:, i]),
        }
        for kind, (position, rotation) in poses.items():
            paths.append(folder / f"{name}_{kind}.tum")
            replace_text(paths[-1], tum_text(trajectory.t, position, rotation))
    return paths


def tum_text(t: np.ndarray, position: np.ndarray, rotation: np.ndarray) -> str:
    """Return poses of times (K,) s, positions (K, 3) m and rotations (K, 3, 3), body to map, as a TUM file."""
    known = np.isfinite(position).all(axis=1) & np.isfinite(rotation).all(axis=(1, 2))
    quaternion = quaternion_wxyz(rotation[known])[:, [1, 2, 3, 0]]
    rows = np.column_stack([t[known], position[known], quaternion])
    return "".join(" ".join(f"{value:.9f}" for value in row) + "\n" for row in rows.tolist())
