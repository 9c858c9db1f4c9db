"""Input of a calibration from a drive: image points, odometry and motion capture of each car, from bags and logs."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from coopenv.base.errors import DataError
from coopenv.cars.doctor.streams import CarSight, CarStreams, Streams
from coopenv.cars.messages.readings import yaw_of
from coopenv.cars.messages.vision import Calibration, rays
from coopenv.cars.settings.profile import Role
from coopenv.cars.settings.sensors import Correction
from coopenv.estimation.poses import Array, log_so3
from coopenv.observers.recording import Recording
from coopenv.scenario import Scenario

NS = 1e-9
LEAST_SIGHTINGS, LEAST_SECONDS = 50, 5.0
"""Sightings of landmarks and duration that a car needs."""
STEP, TURNING, SMOOTH = 0.002, 0.2, 0.5
"""Motion (m) that makes a further sighting of a landmark count, m of it per rad, and s over which it is averaged."""
CLIMB, TILT = 0.05, 0.1
"""Mean vertical velocity, m/s, and mean rate of roll and pitch, rad/s, above which a vehicle is no car."""
ROLES = (
    *((Role.DETECTIONS, Role.BEARINGS), (Role.WHEEL, Role.ODOMETRY), (Role.TRUTH,)),
    (Role.IMU, Role.ODOMETRY, Role.WHEEL),
)
"""Roles of the topics of camera, wheels, motion capture and turn rates."""


@dataclass(frozen=True, kw_only=True)
class CarDrive(CarSight):
    """Measurements of one car, its camera as given; planar vectors are complex numbers x + iy."""

    pixel: Array  # (m, 2) of sightings; of no use without a lens
    wheel_time: Array
    wheel: NDArray[np.complex128]  # m/s, body
    gyro_time: Array
    gyro: Array  # rad/s
    truth_time: Array
    truth: NDArray[np.complex128]  # m, map
    truth_yaw: Array  # rad
    topics: tuple[tuple[str, float], ...] = (("", 0.0),) * 3
    """Topics of camera, wheels and motion capture, and s that were added to their stamps."""
    gyro_added: float = 0.0  # s that were added to the stamps of turn rates, against which all offsets count
    corrected: tuple[float, float] = (0.0, 0.0)  # wheel scale and gyro bias (rad/s) that are removed already


@dataclass(frozen=True)
class CalibrationDrive:
    """Input of a calibration."""

    cars: tuple[CarDrive, ...]
    landmarks: tuple[str, ...]  # (L,) names of the static ones
    places: Array  # (L, 3) as given, m
    scenario: Scenario


def averaged(values: NDArray[Any], period: float) -> Any:
    """Return values at a regular period, s, as means over `SMOOTH`."""
    return uniform_filter1d(values, max(1, round(SMOOTH / period)), mode="nearest")


def car_of(car: CarStreams, where: str, **more: Any) -> CarDrive:
    """Return the sightings of a car that are of use, its other streams, and what else is known of it.

    Left out are those at the rim of the image, where a marker is cut off, and of each landmark all but the first within
    a step of the motion: while a car stands, pixels repeat the same rounding. Raises DataError: too few sightings.
    """
    pixel = np.zeros((len(car.ray), 2)) if car.lens is None else np.round(car.lens.pixels(car.ray), 3)
    known = {field.name for field in fields(CarDrive)}
    tracks = {key: value for key, value in car.tracks.items() if key in known}
    same = {field.name: getattr(car, field.name) for field in fields(CarSight)}
    return _of_use(CarDrive(pixel=pixel, **tracks, **same, **more), where)


def _of_use(car: CarDrive, where: str) -> CarDrive:
    """Return a car without sightings that are of no use. Raises DataError: too few are left."""
    name, lens, ray, pixel = car.name, car.lens, car.ray, car.pixel
    rows = np.arange(len(ray))
    if lens is not None:
        rows = np.flatnonzero(((pixel > 1.5) & (pixel < np.array(lens.image_size) - 2.5)).all(axis=-1))
    if min(len(car.wheel_time), len(car.gyro_time)) < 3:
        raise DataError(f"{where}: {name} has too few velocities or turn rates for a calibration")
    if len(rows):
        time = np.arange(car.time.min(), car.time.max() + SMOOTH, SMOOTH)
        speed, turn = (
            np.abs(np.interp(time, t, averaged(v, float(np.median(np.diff(t))))))
            for t, v in ((car.wheel_time, car.wheel.real), (car.gyro_time, car.gyro))
        )
        moved = SMOOTH * np.cumsum(speed + TURNING * turn)
        step = (np.interp(car.time[rows], time, moved) / STEP).astype(np.int64)
        rows = rows[np.sort(np.unique(np.stack([car.target[rows], step]), axis=1, return_index=True)[1])]
    car = replace(car, **{key: getattr(car, key)[rows] for key in ("time", "target", "ray", "pixel")})
    seconds = float(np.ptp(car.time)) if len(rows) else 0.0
    if len(rows) < LEAST_SIGHTINGS or seconds < LEAST_SECONDS:
        raise DataError(
            f"{where}: {name} has {len(rows)} sightings of static landmarks in {seconds:.3g} s; "
            f"a calibration needs {LEAST_SIGHTINGS} in {LEAST_SECONDS:g} s"
        )
    return car


def drive_of_streams(streams: Streams, where: str, chosen: Sequence[CarStreams] | None = None) -> CalibrationDrive:
    """Return the drive of some cars, None: of all. Raises DataError, which begins with `where`: too few sightings."""
    streamed = [streams.car(name) for name in streams.binding.cars] if chosen is None else chosen
    cars = tuple(_of_car(streams, car, where) for car in streamed)
    return CalibrationDrive(cars, streamed[0].names, streamed[0].places, streams.binding.scenario)


def drive_of_car(streams: Streams, car: CarStreams) -> CalibrationDrive:
    """Return the drive of a car alone, as `drive_of_streams` does."""
    return drive_of_streams(streams, car.name, [car])


def _of_car(streams: Streams, car: CarStreams, where: str) -> CarDrive:
    added, name = streams.added, car.name
    topics = [next((added[name, role] for role in roles if (name, role) in added), ("", 0.0)) for roles in ROLES]
    right = streams.corrections.get(name, Correction())
    known = {"topics": tuple(topics[:3]), "gyro_added": topics[3][1]}
    return car_of(car, where, corrected=(right.wheel_scale, right.gyro_bias), **known)


def drive_of_recording(recording: Recording, path: Path) -> CalibrationDrive:
    """Return the drive of a log of coopenv. Raises DataError: it is not one of cars, or a car has too few sightings."""
    r = recording
    if r.scenario is None or r.pan is not None:
        raise DataError(f"{path}: calibrate needs a log with its environment and with cameras that do not turn")
    streamed = streams_of_recording(r)
    for car in streamed:
        climb = abs(float(r.translation[1:, car.vehicle, 2].mean())) / r.dt
        if climb > CLIMB or np.abs(car.turning[:, :2].mean(axis=0)).max() > TILT:
            raise DataError(f"{path}: {car.name} leaves the plane; calibrate is for cars")
    cars = tuple(car_of(car, str(path)) for car in streamed)
    return CalibrationDrive(cars, streamed[0].names, streamed[0].places, r.scenario)


def streams_of_recording(recording: Recording) -> list[CarStreams]:
    """Return the streams of the vehicles of a recording, whose cameras do not turn.

    Without an environment, rays are those of the body frame.
    """
    static = np.flatnonzero(np.ptp(recording.landmarks, axis=0).max(axis=-1, initial=0.0) < 1e-9)
    return [_of_vehicle(recording, i, static) for i in range(len(recording.setups))]


def _of_vehicle(r: Recording, i: int, static: NDArray[np.int64]) -> CarStreams:
    setup, scenario, middle = r.setups[i], r.scenario, r.t[1:] - 0.5 * r.dt
    camera = None if scenario is None else scenario.cameras[i]
    mounting = np.eye(3) if camera is None else camera.to_body()
    turn, speed = np.array([log_so3(R) for R in r.rotation[1:, i]]) / r.dt, r.translation[1:, i] / r.dt
    tick, target = np.nonzero(r.visible[:, i, static])
    ray = r.bearings[tick, i, static[target]] @ mounting
    lens = Calibration.of(camera) if camera is not None and camera.model == "pinhole" else None
    if lens is not None and camera is not None and not camera.undistort:  # bearings with the lens's distortion
        ray = rays(replace(lens, distortion=(0.0,) * 5).pixels(ray), lens)[0]
    known, none = np.flatnonzero(r.truth.known[:, i]), np.zeros(0)
    place = r.truth.position[known, i]
    tracks = {
        "wheel_time": middle,
        "wheel": (speed[:, 0] + 1j * speed[:, 1]) * np.exp(-0.5j * turn[:, 2] * r.dt),
        "gyro_time": middle,
        "gyro": turn[:, 2],
        "truth_time": r.t[known],
        "truth": place[:, 0] + 1j * place[:, 1],
        "truth_yaw": np.array([yaw_of(R) for R in r.truth.rotation[known, i]]),
        "truth_pose": np.concatenate([r.truth.rotation[known, i], place[:, :, None]], axis=-1),
        **dict.fromkeys(("command_time", "command_speed", "command_steering"), none),
    }
    start = None if scenario is None else scenario.vehicles[i].initial_pose
    height = start.position[2] if start is not None and start.position is not None else 0.0
    return CarStreams(
        name=setup.name,
        vehicle=i,
        topics={role: f"/{setup.name}/{role.value}" for role in (Role.DETECTIONS, Role.ODOMETRY, Role.TRUTH)},
        samples=(),
        tracks=tracks,
        turning=turn,
        pose_time=none,
        pose=none.astype(np.complex128),
        pose_yaw=none,
        time=r.t[tick] - r.filled("bearing_age")[tick, i],
        target=target,
        ray=ray,
        lens=lens,
        mounting=mounting,
        lever=np.array(setup.lever_arm),
        height=float(np.median(place[:, 2])) if len(place) else height,
        places=r.landmarks[0, static],
        names=tuple(setup.target_names[n] for n in static),
        numbers={},
        wheelbase=math.inf if scenario is None else scenario.limits[i].wheelbase,
        scale_noise=setup.noise.odometry_scale,
        noise={"gyro": setup.noise.angular_velocity, "wheel": setup.noise.velocity},
        odometry_rate=1.0 / setup.noise.odometry_period,
    )
