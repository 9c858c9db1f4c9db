"""A sub-dataset of MR.CLAM as a `Recording`: five robots with odometry and cameras, and motion capture that judges.

Five planar vehicles (z = 0, yaw only) among 15 landmarks. Ticks are 0.05 s apart; tick 0 is the first odometry sample
of any robot. A camera frame counts at the next tick; its bearings are turned by the odometry's rotation in between.
All robots receive from all others: at tick k the last message of tick k - 1 or before.

`coopenv.mrclam.in_space` has the form for observers of vehicles in space.
"""

import math
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from coopenv.base.errors import DataError, suggest
from coopenv.estimation.poses import Array, about_z
from coopenv.mrclam.dataset import MAX_TRUTH_GAP_S, ROBOTS, Dataset, HeldCommands, Robot, load_dataset
from coopenv.observers.contract import Gains, SensorNoise, Setup
from coopenv.observers.recording import Recording, check_recording, received_by_all
from coopenv.observers.sensed import Truth

__all__ = ["VARIANTS", "Dataset", "Variant", "load_dataset", "recording_of"]


Variant = Literal["landmarks", "landmarks+robots", "blind"]
VARIANTS: tuple[Variant, ...] = get_args(Variant)
BLIND_ROBOTS = (3, 4, 5)
# The next constants were tuned on sub-dataset 6 (docs/data.md).
TICK_S = 0.05
MESSAGE_PERIOD_TICKS = 2  # 10 Hz, as V2X radios send
NOISE = SensorNoise(velocity=0.15, angular_velocity=0.3, odometry_period=TICK_S, bearing=0.03)
"""Noise of all sub-datasets. The commands' errors are lasting, not sensor noise; as white noise they amount to
0.03 m and 0.07 rad per square root of a second."""
GAINS = (1.0, 10.0, (0.1, 1.0), (0.01, 0.01), 0.1)  # k, q, V, P0, largest turn of a sub-step
START_STD = (0.01, 0.01)  # rad, m
DRIFT_STD = (0.05, 0.1)  # rad and m per square root of a second without truth before the start


def check_variant(name: str) -> Variant:
    """Return the variant of that name. Raises DataError: there is none."""
    if name not in VARIANTS:
        raise DataError(f"unknown variant {name!r}{suggest(str(name), VARIANTS)}; there are {', '.join(VARIANTS)}")
    return name


def recording_of(dataset: Dataset, variant: Variant) -> Recording:
    """Put a sub-dataset on ticks, for observers on a plane.

    Truth is NaN where motion capture is not valid. Every robot starts at its true pose; one that motion capture sees
    later starts at the pose of backward dead reckoning from there. In the variant `landmarks` no robot sees another, in
    `landmarks+robots` everything counts, and in `blind` robots 3 to 5 see robots only.

    Raises:
        DataError: unknown variant, motion capture never sees a robot, or its data make no sense.
    """
    check_variant(variant)
    subjects = [*sorted(dataset.landmarks), *ROBOTS]
    L, N = len(dataset.landmarks), len(ROBOTS)
    T = L + N
    t = np.arange(int(dataset.duration_s / TICK_S) + 1, dtype=np.float64) * TICK_S
    K = len(t)
    column = np.zeros(max(subjects) + 1, dtype=np.int64)
    column[subjects] = np.arange(T)
    arrays: dict[str, Any] = {
        "rotation": np.broadcast_to(np.eye(3), (K, N, 3, 3)).copy(),
        **{name: np.zeros((K, N, 3)) for name in ("translation", "velocity", "angular_velocity")},
        "bearings": np.full((K, N, T, 3), np.nan),
        "visible": np.zeros((K, N, T), bool),
        "start_covariance": np.zeros((N, 6, 6)),
    }
    pose, start = np.zeros((K, N, 3)), np.zeros((N, 3))
    for i, robot in enumerate(dataset.robots):
        held = HeldCommands(robot)
        reckoned = held.pose(t)
        turn = np.diff(reckoned[:, 2])
        arrays["velocity"][:, i, 0], arrays["angular_velocity"][:, i, 2] = held.commands(t)
        arrays["translation"][1:, i, :2] = _turned(np.diff(reckoned[:, :2], axis=0), -reckoned[:-1, 2])
        arrays["rotation"][1:, i] = about_z(turn)
        k, seen, vectors, _ = seen_by(robot, variant, held, t)
        arrays["bearings"][k, i, column[seen]], arrays["visible"][k, i, column[seen]] = vectors, True
        pose[:, i] = _truth(robot, held, t)
        start[i], arrays["start_covariance"][i] = start_of(robot, reckoned, pose[:, i], t)
    points = np.array([[*dataset.landmarks[subject], 0.0] for subject in sorted(dataset.landmarks)])
    arrays["landmarks"] = np.broadcast_to(points, (K, L, 3))
    arrays["start_rotation"], arrays["start_position"] = about_z(start[:, 2]), np.insert(start[:, :2], 2, 0.0, axis=1)
    recording = Recording(
        setups=_setups(sorted(dataset.landmarks)),
        order=tuple(range(N)),
        dt=TICK_S,
        inbox_tick=received_by_all(K, N, MESSAGE_PERIOD_TICKS),
        period=MESSAGE_PERIOD_TICKS,
        staleness=math.inf,
        due=np.ones(K, bool),
        truth=Truth(about_z(pose[..., 2]), np.concatenate([pose[..., :2], 0.0 * pose[..., :1]], axis=-1)),
        **arrays,
    )
    check_recording(recording, dataset.name)
    return recording


def _setups(subjects: list[int]) -> tuple[Setup, ...]:
    known = [f"landmark_{s}" for s in subjects]
    names, landmarks = (*known, *(f"vehicle_{s}" for s in ROBOTS)), len(known)
    k, q, V, P0, max_turn = GAINS
    gains = Gains(k, np.full(len(names), q), V, P0, max_turn)
    return tuple(
        Setup(
            vehicle=i,
            name=f"vehicle_{robot}",
            target_names=names,
            landmarks=landmarks,
            targets=np.delete(np.arange(len(names)), landmarks + i),
            lever_arm=np.zeros(3),
            marker=np.zeros(3),
            noise=NOISE,
            gains=gains,
            planar=True,
        )
        for i, robot in enumerate(ROBOTS)
    )


def counted(robot: Robot, variant: Variant) -> NDArray[np.bool_]:
    """Return (n,) which of a robot's detections an observer gets in a variant."""
    who = robot.detections[:, 1]
    keep: NDArray[np.bool_] = who != robot.subject  # its own barcode is a misreading
    if variant == "landmarks":
        keep &= who > len(ROBOTS)
    elif variant == "blind" and robot.subject in BLIND_ROBOTS:
        keep &= who <= len(ROBOTS)
    return keep


def seen_by(
    robot: Robot, variant: Variant, held: HeldCommands, t: Array
) -> tuple[NDArray[Any], NDArray[Any], Array, Array]:
    """Return of what one robot's camera saw the ticks, the subjects, unit vectors (n, 3), and ranges (n,) in m.

    A recorded range is a depth along the optical axis: it is derived from the height of a barcode's image.
    """
    time, who, depth, angle = robot.detections[counted(robot, variant)].T
    k = np.maximum(np.searchsorted(t, time), 1)
    inside = k < len(t)
    k = k[inside]
    beta = angle[inside] - (held.pose(t[k]) - held.pose(time[inside]))[:, 2]
    vectors = np.array([(math.cos(b), math.sin(b), 0.0) for b in beta.tolist()]).reshape(-1, 3)
    ahead = np.where(np.cos(angle) > 0.0, np.cos(angle), np.nan)
    return k, who[inside].astype(np.int64), vectors, (depth / ahead)[inside]


def _truth(robot: Robot, held: HeldCommands, t: Array) -> Array:
    """Return x, y, heading (K, 3) at the ticks, NaN where not valid.

    A row that stands alone (the next more than 0.5 s away) counts at the tick next to it, moved on by the odometry.
    """
    position, heading, valid, heading_valid = robot.truth.at(t)
    pose = np.column_stack([position, heading])
    rows = robot.truth.t
    gap = np.diff(rows, prepend=-np.inf, append=np.inf) > MAX_TRUTH_GAP_S
    alone = np.flatnonzero(gap[:-1] & gap[1:] & (rows >= 0) & (rows <= t[-1]))
    k = np.rint(rows[alone] / TICK_S).astype(int)
    alone, k = alone[k < len(t)], k[k < len(t)]
    at_rows = np.column_stack([robot.truth.position[alone], robot.truth.heading[alone]])
    pose[k] = _moved(at_rows, held.pose(rows[alone]), held.pose(t[k]))
    valid[k] = True
    heading_valid[k] = robot.truth.at(rows[alone])[3]
    pose[~valid] = np.nan
    pose[~heading_valid, 2] = np.nan
    return pose


def start_of(robot: Robot, reckoned: Array, pose: Array, t: Array) -> tuple[Array, Array]:
    """Return the pose (3,) at tick 0 and its covariance (6, 6), LEFT coordinates.

    Args:
        robot: whose error names it.
        reckoned: (K, 3) x, y in m and heading in rad by odometry alone, from anywhere.
        pose: (K, 3) true ones, NaN where not known.
        t: (K,) s, of the ticks.

    Raises:
        DataError: no true pose is known.
    """
    known = np.flatnonzero(np.isfinite(pose).all(axis=1))
    if known.size == 0:
        raise DataError(f"robot {robot.subject}: no ground truth while it records odometry")
    first = known[:1]
    variances = np.square(START_STD) + np.square(DRIFT_STD) * t[first]
    return _moved(pose[first], reckoned[first], reckoned[:1])[0], np.diag(np.repeat(variances, 3))


def _moved(pose: Array, before: Array, after: Array) -> Array:
    """Return poses (K, 3) x, y, heading after the motion that leads from some poses to others."""
    position = pose[:, :2] + _turned(after[:, :2] - before[:, :2], pose[:, 2] - before[:, 2])
    return np.column_stack([position, pose[:, 2] + (after[:, 2] - before[:, 2])])


def _turned(vectors: Array, angle: Array) -> Array:
    """Return vectors (K, 2) turned by angles (K,)."""
    return np.asarray((about_z(angle)[:, :2, :2] @ vectors[..., None])[..., 0])
