"""A sub-dataset of MR.CLAM as a `Recording` of vehicles in space, with ranges, a level floor and calibrated odometry.

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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coopenv.estimation.poses import Array, about_z
from coopenv.measurements.sensor import MAP, Sensor
from coopenv.mrclam.dataset import ROBOTS, Dataset, HeldCommands, Robot, arc
from coopenv.mrclam.recording import TICK_S, Variant, recording_of, seen_by, start_of
from coopenv.mrclam.wheels import IROBOT_CREATE, TURNING_RATE
from coopenv.observers.contract import SensorNoise
from coopenv.observers.recording import Recording, check_recording

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


def spatial_recording_of(dataset: Dataset, variant: Variant) -> Recording:
    """Return a sub-dataset as `recording_of` does, but with calibrated odometry and with sensors beside the camera.

    Raises:
        DataError: as for `recording_of`.
    """
    plane = recording_of(dataset, variant)
    K, N, T = plane.visible.shape
    subjects = [*sorted(dataset.landmarks), *ROBOTS]
    column = np.zeros(max(subjects) + 1, dtype=np.int64)
    column[subjects] = np.arange(T)
    readings = {"range": np.full((K, N, T, 1), np.nan)}
    for name in ("level", "height"):
        readings[name] = np.full((K, N, 1, 3), np.nan)
        readings[name][1::FLOOR_PERIOD_TICKS] = 0.0
    moved: dict[str, Any] = {name: np.zeros((K, N, 3)) for name in ("translation", "velocity", "angular_velocity")}
    rotation, start = np.tile(np.eye(3), (K, N, 1, 1)), np.zeros((N, 3))
    R, position = plane.truth.rotation, plane.truth.position
    pose = np.concatenate([position[..., :2], np.arctan2(R[..., 1, 0], R[..., 0, 0])[..., None]], axis=-1)
    for i, robot in enumerate(dataset.robots):
        turn, path = _motion(robot, plane.t)
        moved["velocity"][1:, i, 0], moved["angular_velocity"][1:, i, 2] = path / TICK_S, turn / TICK_S
        moved["translation"][1:, i, :2] = arc(np.zeros_like(turn), path, turn)
        rotation[1:, i] = about_z(turn)
        k, seen, _, ranges = seen_by(robot, variant, HeldCommands(robot), plane.t)
        readings["range"][k, i, column[seen], 0] = (ranges - RANGE_OFFSET) / RANGE_SCALE
        start[i], _ = start_of(robot, _reckoned(turn, path), pose[:, i], plane.t)
    setups = tuple(replace(of, noise=NOISE, planar=False, sensors=_sensors(of.targets)) for of in plane.setups)
    recording = replace(
        plane,
        setups=setups,
        rotation=rotation,
        start_rotation=about_z(start[:, 2]),
        start_position=np.insert(start[:, :2], 2, 0.0, axis=1),
        readings=readings,
        **moved,
    )
    check_recording(recording, dataset.name)
    return recording


def _sensors(targets: NDArray[np.int64]) -> tuple[Sensor, ...]:
    """Return the sensors of a robot beside its camera, in the body's origin."""
    place = np.zeros(3), np.eye(3)
    floor, the_map = np.full(3, FLOOR_STD), np.array([MAP])
    distance = Sensor("range", "range", np.array([RANGE_STD]), targets, *place)
    return (
        replace(distance, std_by_distance=RANGE_STD_BY_DISTANCE, bias=RANGE_BIAS, scale=RANGE_SCALE_STD),
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


def _reckoned(turn: Array, path: Array) -> Array:
    """Return x, y, heading (K, 3) at the ticks, seen from the pose at tick 0."""
    heading = np.concatenate([[0.0], np.cumsum(turn)])
    steps = np.concatenate([np.zeros((1, 2)), np.cumsum(arc(heading[:-1], path, turn), axis=0)])
    return np.column_stack([steps, heading])
