"""Compare observers on a public recording of ranges: one robot with wheel odometry among four UWB anchors.

    python examples/uwb_ranges.py FOLDER

FOLDER has `Indoor_UWB_Input.txt` and `Indoor_UWB_GT.txt` of the Labyrinth data set (Tim Pfeifer, TU Chemnitz, CC BY-SA
4.0), which is `datasets/Indoor_UWB` of the repository TUC-ProAut/libRSF. Its description and its numbers disagree:
dead reckoning fits the true positions (2.4 cm RMS over 9 m) if the first wheel is the left one, the robot drives
backwards, and the track is twice the distance that is stated. Noise is what the file states; how far ranges are off per
anchor, and the scales of the wheels, are declared and not fitted.
"""

import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from coopenv.base.errors import DataError
from coopenv.measurements.sensor import MAP, Sensor
from coopenv.observers import Recording
from coopenv.observers.contract import SensorNoise
from coopenv.observers.runner import run

TICK = 0.016  # s, an eighth of the time between two rows
RANGE_BIAS = 0.15  # m: reflections lengthen ranges, by some cm to dm
FLOOR, UNKNOWN = 0.01, 1e3  # rad and m, of what a level floor shows, and of what it does not


def rows(path: Path, word: str, columns: int) -> np.ndarray:
    """Return the numbers (n, columns) of the lines that begin with a word, time first. Raises DataError."""
    try:
        lines = [line.split() for line in path.read_text(encoding="utf-8").splitlines()]
        found = np.array([[float(x) for x in line[1 : columns + 1]] for line in lines if line[:1] == [word]])
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: {error}") from None
    if found.shape[1:] != (columns,) or len(found) < 2 or not (np.diff(found[:, 0]) > 0.0).all():
        raise DataError(f"{path}: expected lines '{word}' with {columns} numbers, their times rising")
    return found


def read(folder: Path) -> Recording:
    """Return the recording: ticks of 16 ms, a row's odometry held until the next, a range at the next tick."""
    odometry = rows(folder / "Indoor_UWB_Input.txt", "odom2diff", 8)
    ranges = rows(folder / "Indoor_UWB_Input.txt", "range2", 6)
    truth = rows(folder / "Indoor_UWB_GT.txt", "point2", 3)
    t = np.arange(odometry[0, 0], odometry[-1, 0], TICK)
    count, anchors = len(t), np.unique(ranges[:, 3:6], axis=0)

    held = odometry[np.searchsorted(odometry[:, 0], t[1:] - TICK / 2, side="right") - 1]
    velocity, turning = np.zeros((count, 1, 3)), np.zeros((count, 1, 3))
    velocity[1:, 0, 0] = -(held[:, 1] + held[:, 2]) / 2.0
    turning[1:, 0, 2] = (held[:, 2] - held[:, 1]) / (2.0 * held[:, 4])

    measured = np.full((count, 1, len(anchors) + 1, 1), np.nan)
    ticks = np.searchsorted(t, ranges[:, 0])
    which = np.argmin(np.abs(anchors[:, 2] - ranges[:, 5:6]), axis=1)
    inside = ticks < count
    measured[ticks[inside], 0, which[inside], 0] = ranges[inside, 1]
    level, height = np.full((2, count, 1, 1, 3), np.nan)
    level[1::50], height[1::50] = 0.0, 0.0

    position = np.stack([*(np.interp(t, truth[:, 0], truth[:, n]) for n in (1, 2)), 0.0 * t], axis=-1)[:, None]
    heading = first_heading(np.cumsum(turning[:, 0, 2]) * TICK, velocity[:, 0, 0] * TICK, position[:, 0, :2])
    start = Rotation.from_euler("z", heading).as_matrix()
    place, floor = (np.zeros(3), np.eye(3)), np.array([FLOOR, FLOOR, UNKNOWN])
    return Recording.from_arrays(
        dt=TICK,
        landmarks=np.column_stack([anchors[:, :2], np.zeros(len(anchors))]),
        velocity=velocity,
        angular_velocity=turning,
        bearings=np.full((count, 1, len(anchors) + 1, 3), np.nan),
        truth_position=position,
        start_position=position[0],
        start_rotation=start[None],
        start_std=(0.1, 0.1),
        noise=SensorNoise(
            velocity=float(np.sqrt(odometry[0, 5] / 2.0)),
            angular_velocity=float(np.sqrt(2.0 * odometry[0, 5]) / (2.0 * odometry[0, 4])),
            odometry_period=8 * TICK,
            bearing=1.0,
            odometry_scale=0.02,
            turn_scale=0.02,
        ),
        sensors=(
            Sensor("range", "range", np.sqrt(ranges[:1, 2]), np.arange(len(anchors)), *place, bias=(RANGE_BIAS,)),
            Sensor("level", "attitude", floor, np.array([MAP]), *place),
            Sensor("height", "position", floor[::-1], np.array([MAP]), *place),
        ),
        readings={"range": measured, "level": level, "height": height},
    )


def first_heading(turned: np.ndarray, path: np.ndarray, position: np.ndarray) -> float:
    """Return the heading at the start by which the reckoned way (path and turn per tick) points as the true one."""
    way = np.cumsum(path * np.exp(1j * turned))
    true = (position - position[0]) @ [1.0, 1.0j]
    return float(np.angle(np.vdot(way, true)))


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    try:
        recording = read(Path(sys.argv[1]))
    except DataError as error:
        sys.exit(f"error: {error}")
    print("observer            RMSE [m]  worst [m]   (after 5 s; the true heading is not recorded)")
    for name in ("dead_reckoning", "mekf_covariance", "schmidt_kalman", "self_calibrating", "robust"):
        estimated = run(name, recording)
        error = np.linalg.norm(estimated.position - recording.truth.position, axis=-1)[estimated.t > 5.0]
        print(f"{name:18s} {np.sqrt(np.mean(error**2)):9.3f} {error.max():10.3f}   {estimated.failure}")
