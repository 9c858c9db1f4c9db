"""Input of a calibration from a drive: image points, odometry and motion capture of each car, from bags and logs."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from coopenv.base.errors import DataError
from coopenv.cars.doctor.streams import CarStreams, Streams
from coopenv.cars.messages.readings import yaw_of
from coopenv.cars.messages.vision import Calibration, rays
from coopenv.cars.settings.profile import Role
from coopenv.cars.settings.sensors import Correction
from coopenv.estimation.poses import Array, log_so3
from coopenv.scenario import Scenario

if TYPE_CHECKING:
    from coopenv.observers.recording import Recording

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
class CarDrive:
    """Measurements of one car; times in s on one clock, planar vectors as complex numbers x + iy."""

    name: str
    vehicle: int
    mounting: Array  # (3, 3) camera to body, as given
    lever: Array  # (3,) optical centre in the body, as given, m
    lens: Calibration | None  # as given; None: bearings without pixels
    time: Array  # (n,) of sightings
    target: NDArray[np.int64]  # (n,) landmark
    ray: Array  # (n, 3) unit vectors, optical frame, by the given lens
    pixel: Array  # (n, 2); of no use without a lens
    wheel_time: Array
    wheel: NDArray[np.complex128]  # m/s, body
    gyro_time: Array
    gyro: Array  # rad/s
    truth_time: Array
    truth: NDArray[np.complex128]  # m, map
    truth_yaw: Array  # rad
    height: float  # m, of the body's origin
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


def car_of(
    scenario: Scenario, name: str, vehicle: int, lens: Calibration | None, ray: Array, where: str, **measured: Any
) -> CarDrive:
    """Return a car with the sightings that are of use.

    Left out are those at the rim of the image, where a marker is cut off, and of each landmark all but the first within
    a step of the motion: while a car stands, pixels repeat the same rounding. Raises DataError: too few sightings.
    """
    camera, start = scenario.cameras[vehicle], scenario.vehicles[vehicle].initial_pose
    pixel = np.zeros((len(ray), 2)) if lens is None else np.round(lens.pixels(ray), 3)
    place: dict[str, Any] = {"mounting": camera.to_body(), "lever": np.array(camera.position), "pixel": pixel}
    place["height"] = start.position[2] if start is not None and start.position is not None else 0.0
    car = CarDrive(name=name, vehicle=vehicle, lens=lens, ray=ray, **(place | measured))
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


def _of_car(streams: Streams, car: CarStreams, where: str) -> CarDrive:
    added, name = streams.added, car.name
    topics = [next((added[name, role] for role in roles if (name, role) in added), ("", 0.0)) for roles in ROLES]
    right = streams.corrections.get(name, Correction())
    tracks = {key: value for key, value in car.tracks.items() if "command" not in key}
    found = {"time": car.time, "target": car.target, "topics": tuple(topics[:3]), "gyro_added": topics[3][1], **tracks}
    found["height"] = car.height
    found |= {"corrected": (right.wheel_scale, right.gyro_bias), "mounting": car.mounting, "lever": car.lever}
    return car_of(streams.binding.scenario, name, car.vehicle, car.lens, car.ray, where, **found)


def drive_of_recording(recording: "Recording", path: Path) -> CalibrationDrive:
    """Return the drive of a log of coopenv. Raises DataError: it is not one of cars, or a car has too few sightings."""
    r = recording
    if r.scenario is None or r.pan is not None:
        raise DataError(f"{path}: calibrate needs a log with its environment and with cameras that do not turn")
    static = np.flatnonzero(np.ptp(r.landmarks, axis=0).max(axis=-1, initial=0.0) < 1e-9)
    names = tuple(r.setups[0].target_names[i] for i in static)
    return CalibrationDrive(tuple(_of_vehicles(r, r.scenario, static, path)), names, r.landmarks[0, static], r.scenario)


def _of_vehicles(r: "Recording", scenario: Scenario, static: NDArray[np.int64], path: Path) -> Iterator[CarDrive]:
    for i, setup in enumerate(r.setups):
        turn, speed = np.array([log_so3(R) for R in r.rotation[1:, i]]) / r.dt, r.translation[1:, i] / r.dt
        if abs(float(speed[:, 2].mean())) > CLIMB or np.abs(turn[:, :2].mean(axis=0)).max() > TILT:
            raise DataError(f"{path}: {setup.name} leaves the plane; calibrate is for cars")
        camera, middle = scenario.cameras[i], r.t[1:] - 0.5 * r.dt
        tick, target = np.nonzero(r.visible[:, i, static])
        ray = r.bearings[tick, i, static[target]] @ camera.to_body()
        lens = Calibration.of(camera) if camera.model == "pinhole" else None
        if lens is not None and not camera.undistort:  # bearings of pixels whose distortion was left in
            ray = rays(replace(lens, distortion=(0.0,) * 5).pixels(ray), lens)[0]
        known = np.flatnonzero(r.truth.known[:, i])
        place = r.truth.position[known, i]
        found = {
            "time": r.t[tick] - r.filled("bearing_age")[tick, i],
            "target": target,
            "wheel_time": middle,
            "wheel": (speed[:, 0] + 1j * speed[:, 1]) * np.exp(-0.5j * turn[:, 2] * r.dt),
            "gyro_time": middle,
            "gyro": turn[:, 2],
            "truth_time": r.t[known],
            "truth": place[:, 0] + 1j * place[:, 1],
            "truth_yaw": np.array([yaw_of(R) for R in r.truth.rotation[known, i]]),
            **({"height": float(np.median(place[:, 2]))} if len(place) else {}),
        }
        yield car_of(scenario, setup.name, i, lens, ray, str(path), **found)
