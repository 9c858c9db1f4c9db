"""A sub-dataset of MR.CLAM as a `Recording`: five robots with odometry and cameras, and motion capture that judges.

Five robots on a level floor (z = 0) among 15 landmarks. Ticks are 0.05 s apart; tick 0 is the first odometry sample
of any robot. A camera frame counts at the next tick; its bearings are turned by the odometry's rotation in between.
All robots receive from all others: at tick k the last message of tick k - 1 or before.

The camera's bearings are those of the recording. Its ranges are derived from the size of a barcode's image, which is in
inverse proportion to the depth along the optical axis, and so the recorded ranges are depths; divided by the cosine of
the bearing they are readings of a sensor `range`. All measurements lie in the plane, so that by symmetry an estimate on
the plane stays there. Two more sensors bound the variances of what the robots cannot do: `level` measures roll and
pitch, `height` measures z.

Odometry is the commands, which a nominal calibration turns into motion. `SensorNoise` declares what the calibration of
one robot may differ by, so that a filter can estimate it (`coopenv.observers.lasting_errors`).
"""

import math
from dataclasses import replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from coopenv.base.errors import DataError, suggest
from coopenv.estimation.poses import Array, about_z
from coopenv.measurements.sensor import MAP, Sensor
from coopenv.mrclam.dataset import MAX_TRUTH_GAP_S, ROBOTS, Dataset, HeldCommands, Robot, arc, load_dataset
from coopenv.mrclam.wheels import IROBOT_CREATE, TURNING_RATE
from coopenv.observers.contract import Gains, SensorNoise, Setup
from coopenv.observers.recording import Recording, check_recording, received_by_all
from coopenv.observers.sensed import Truth

__all__ = ["VARIANTS", "Dataset", "Variant", "load_dataset", "recording_of"]


Variant = Literal["landmarks", "landmarks+robots", "blind"]
VARIANTS: tuple[Variant, ...] = get_args(Variant)
BLIND_ROBOTS = (3, 4, 5)
TICK_S = 0.05
MESSAGE_PERIOD_TICKS = 2  # 10 Hz, as V2X radios send

# The next constants were tuned on sub-dataset 6 (docs/data.md).
LEAD_S = 0.15  # by which commands are ahead of the wheels' response
TURN_SCALE = 0.936  # motion over the turn that the wheels' response gives
STRAIGHT_RATE = 0.005  # rad/s, the commanded rate at which a robot drives straight
TURNING_LOSS = 1.0  # s/rad, share of the speed that a robot loses per commanded rate of turn
RANGE_SCALE, RANGE_OFFSET = 1.022, 0.045  # of recorded ranges over distances, and m
NOISE = SensorNoise(
    velocity=0.002 / math.sqrt(TICK_S),
    angular_velocity=0.008 / math.sqrt(TICK_S),
    odometry_period=TICK_S,
    bearing=0.025,
    odometry_scale=0.05,
    camera_orientation=0.02,
    turn_scale=0.25,
    curvature=0.05,
    turning_loss=0.6,
    odometry_lead=0.1,
    velocity_by_speed=0.12 / math.sqrt(TICK_S),
    angular_velocity_by=(0.1 / math.sqrt(TICK_S), 0.2 / math.sqrt(TICK_S)),
)
"""Noise of all sub-datasets."""
WHEELS = IROBOT_CREATE
RANGE_STD, RANGE_STD_BY_DISTANCE = 0.03, 0.03
"""m, and m per m. Without a robot's own scale and offset, errors of ranges have a standard deviation of 0.008 m per m
(of robot 5: 0.016), and a correlation time of 6 s, by which at 2 Hz they average as white noise of 0.04 m per m."""
RANGE_BIAS, RANGE_SCALE_STD = 0.05, 0.02  # m, and relative, by which robots differ
FLOOR_STD = 0.01  # rad and m, of the level floor
UNKNOWN_STD = 1e3  # rad and m, of what the floor does not show: heading, x and y
FLOOR_PERIOD_TICKS = 40
GAINS = (1.0, 10.0, (0.1, 1.0), (0.01, 0.01), 0.1)  # k, q, V, P0, largest turn of a sub-step
START_STD = (0.01, 0.01)  # rad, m
DRIFT_STD = (0.05, 0.1)  # rad and m per square root of a second without truth before the start


def check_variant(name: str) -> Variant:
    """Return the variant of that name. Raises DataError: there is none."""
    if name not in VARIANTS:
        raise DataError(f"unknown variant {name!r}{suggest(str(name), VARIANTS)}; there are {', '.join(VARIANTS)}")
    return name


def recording_of(dataset: Dataset, variant: Variant) -> Recording:
    """Put a sub-dataset on ticks.

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
    readings = {
        "range": np.full((K, N, T, 1), np.nan),
        "level": np.full((K, N, 1, 3), np.nan),
        "height": np.full((K, N, 1, 3), np.nan),
    }
    for name in ("level", "height"):
        readings[name][1::FLOOR_PERIOD_TICKS] = 0.0
    pose, start = np.zeros((K, N, 3)), np.zeros((N, 3))
    for i, robot in enumerate(dataset.robots):
        held = HeldCommands(robot)
        turn, path = _motion(robot, t)
        arrays["velocity"][1:, i, 0], arrays["angular_velocity"][1:, i, 2] = path / TICK_S, turn / TICK_S
        arrays["translation"][1:, i, :2] = arc(np.zeros_like(turn), path, turn)
        arrays["rotation"][1:, i] = about_z(turn)
        k, seen, vectors, ranges = _seen(robot, variant, held, t)
        readings["range"][k, i, column[seen], 0] = (ranges - RANGE_OFFSET) / RANGE_SCALE
        arrays["bearings"][k, i, column[seen]], arrays["visible"][k, i, column[seen]] = vectors, True
        pose[:, i] = _truth(robot, held, t)
        start[i], arrays["start_covariance"][i] = _start(robot, _reckoned(turn, path), pose[:, i], t)
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
        readings=readings,
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
            sensors=_sensors(np.delete(np.arange(len(names)), landmarks + i)),
        )
        for i, robot in enumerate(ROBOTS)
    )


def _sensors(targets: NDArray[np.int64]) -> tuple[Sensor, ...]:
    """Return the sensors of a robot beside its camera, in the body's origin."""
    place = np.zeros(3), np.eye(3)
    floor, the_map = np.full(3, FLOOR_STD), np.array([MAP])
    distance = Sensor("range", "range", np.array([RANGE_STD]), targets, *place)
    return (
        replace(distance, std_by_distance=RANGE_STD_BY_DISTANCE, bias=(RANGE_BIAS,), scale=RANGE_SCALE_STD),
        Sensor("level", "attitude", np.where([False, False, True], UNKNOWN_STD, floor), the_map, *place),
        Sensor("height", "position", np.where([True, True, False], UNKNOWN_STD, floor), the_map, *place),
    )


def _nominal(robot: Robot) -> HeldCommands:
    """Return the motion that a robot's commands lead to, before lead and delay."""
    t, v, omega = robot.odometry.T
    gain = np.array([WHEELS.gain(*command) for command in zip(v.tolist(), omega.tolist(), strict=True)])
    turning = np.where(np.abs(omega) > TURNING_RATE, omega - STRAIGHT_RATE, 0.0)
    moved = np.column_stack([t, v * (1.0 - TURNING_LOSS * np.abs(omega)), TURN_SCALE * gain * turning])
    return HeldCommands(replace(robot, odometry=moved))


def _motion(robot: Robot, t: Array) -> tuple[Array, Array]:
    """Return the turns (K - 1,) rad and paths (K - 1,) m between ticks, by the nominal calibration of commands."""
    nominal = _nominal(robot)
    sums = [share * nominal.sums(t - LEAD_S - delay) for delay, share in zip(WHEELS.delay, WHEELS.share, strict=True)]
    turn, path = np.diff(sum(sums), axis=0).T
    return turn, path


def counted(robot: Robot, variant: Variant) -> NDArray[np.bool_]:
    """Return (n,) which of a robot's detections an observer gets in a variant."""
    who = robot.detections[:, 1]
    keep: NDArray[np.bool_] = who != robot.subject  # its own barcode is a misreading
    if variant == "landmarks":
        keep &= who > len(ROBOTS)
    elif variant == "blind" and robot.subject in BLIND_ROBOTS:
        keep &= who <= len(ROBOTS)
    return keep


def _seen(
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


def _reckoned(turn: Array, path: Array) -> Array:
    """Return x, y, heading (K, 3) at the ticks, seen from the pose at tick 0."""
    heading = np.concatenate([[0.0], np.cumsum(turn)])
    steps = np.concatenate([np.zeros((1, 2)), np.cumsum(arc(heading[:-1], path, turn), axis=0)])
    return np.column_stack([steps, heading])


def _start(robot: Robot, reckoned: Array, pose: Array, t: Array) -> tuple[Array, Array]:
    """Return the pose (3,) at tick 0 and its covariance (6, 6), LEFT coordinates."""
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
