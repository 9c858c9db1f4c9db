"""What a calibration reads of a drive: image points, odometry and motion capture of each car, from bags and logs."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from coopenv.base.errors import DataError
from coopenv.cars.profile import Role
from coopenv.cars.readings import Calibration, CarPose, Detections, Sample, Twist, rays
from coopenv.estimation.lens import distort
from coopenv.estimation.poses import Array
from coopenv.scenario import Scenario
from coopenv.scenario.base import rotation_of

if TYPE_CHECKING:
    from coopenv.cars.bags import Bag
    from coopenv.observers.recording import Recording

NS = 1e-9
ROLES = ((Role.DETECTIONS, Role.BEARINGS), (Role.WHEEL, Role.ODOMETRY), (Role.TRUTH,))
"""Of the topics of camera, wheels and motion capture."""
LEAST_SIGHTINGS, LEAST_SECONDS = 50, 5.0
"""Sightings of landmarks and duration that a car needs."""
STEP, TURNING, SMOOTH = 0.002, 0.2, 0.5
"""Motion (m) that makes a further sighting of a landmark count, m of it per rad, and s over which it is averaged."""
CLIMB, TILT = 0.05, 0.1
"""Mean vertical velocity, m/s, and mean rate of roll and pitch, rad/s, above which a vehicle is no car."""


@dataclass(frozen=True)
class CarDrive:
    """What one car measured; times in s on one clock, planar vectors as complex numbers x + iy."""

    name: str
    vehicle: int
    mounting: Array  # (3, 3) camera to body, as given
    lever: Array  # (3,) optical centre in the body, as given, m
    lens: Calibration | None  # as given; None: bearings without pixels
    time: Array  # (n,) of sightings
    target: NDArray[np.int64]  # (n,) landmark
    ray: Array  # (n, 3) unit vectors, optical frame, by the given lens
    pixel: Array  # (n, 2); NaN without a lens
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


@dataclass(frozen=True)
class Drive:
    """What a calibration reads."""

    cars: tuple[CarDrive, ...]
    landmarks: tuple[str, ...]  # (L,) names of the static ones
    places: Array  # (L, 3) as given, m
    scenario: Scenario


def _image(ray: Array, lens: Calibration) -> Array:
    """Return the pixels (n, 2) of rays (n, 3) in the optical frame."""
    flat = distort(ray[:, :2] / ray[:, 2:], lens.distortion)
    return np.asarray(flat * lens.focal_length + np.asarray(lens.principal_point))


def _checked(car: CarDrive, where: str) -> CarDrive:
    """Return a car with the sightings that are of use.

    Left out are those at the rim of the image, where a marker is cut off, and of each landmark all but the first within
    a step of the motion: while a car stands, pixels repeat the same rounding. Raises DataError: too few sightings.
    """
    rows = np.arange(len(car.time))
    if car.lens is not None:
        rows = np.flatnonzero(((car.pixel > 1.5) & (car.pixel < np.array(car.lens.image_size) - 2.5)).all(axis=-1))
    if len(rows) and len(car.wheel_time) > 1 and len(car.gyro_time) > 1:
        time = np.arange(car.time.min(), car.time.max() + SMOOTH, SMOOTH)
        speed, turn = np.interp(time, car.wheel_time, _smooth(car.wheel_time, car.wheel.real)), _smooth(car.gyro_time, car.gyro)
        moving = np.abs(speed) + TURNING * np.abs(np.interp(time, car.gyro_time, turn))
        step = (np.interp(car.time[rows], time, SMOOTH * np.cumsum(moving)) / STEP).astype(np.int64)
        rows = rows[np.sort(np.unique(np.stack([car.target[rows], step]), axis=1, return_index=True)[1])]
    car = replace(car, **{name: getattr(car, name)[rows] for name in ("time", "target", "ray", "pixel")})
    count = len(car.time)
    seconds = float(np.ptp(car.time)) if count else 0.0
    if count < LEAST_SIGHTINGS or seconds < LEAST_SECONDS:
        raise DataError(
            f"{where}: {car.name} has {count} sightings of static landmarks in {seconds:.3g} s; "
            f"a calibration needs {LEAST_SIGHTINGS} in {LEAST_SECONDS:g} s"
        )
    return car


def _smooth(time: Array, values: Array) -> Array:
    size = max(1, round(SMOOTH / float(np.median(np.diff(time)))))
    return np.convolve(values, np.ones(size) / size, "same")


def drive_of_bag(bag: "Bag") -> Drive:
    """Return the drive of bags. Raises DataError: a car has too few sightings."""
    scenario, binding = bag.scenario, bag.binding
    static = [i for i, mark in enumerate(scenario.landmarks) if mark.motion.kind == "static" and not mark.is_drawn]
    static = [i for i in static if i not in binding.leaders.values()]
    marks = [scenario.landmarks[i] for i in static]
    places = np.array([np.array(m.position) + rotation_of(m.yaw, None) @ np.array(m.marker) for m in marks])
    number = {marker: static.index(i) for marker, i in binding.targets.items() if i in static}
    cars = []
    for name, vehicle in binding.cars.items():
        own = [s for s in bag.log.samples if s.car == name]
        cars.append(_checked(_of_samples(bag, name, vehicle, own, number), bag.where))
    return Drive(tuple(cars), tuple(m.name for m in marks), places.reshape(-1, 3), scenario)


def _of_samples(bag: "Bag", name: str, vehicle: int, samples: Sequence[Sample], number: dict[int, int]) -> CarDrive:
    camera, lens = bag.scenario.cameras[vehicle], bag.log.lenses.get(name)
    rows: list[tuple[int, int, Array]] = []
    wheel: list[tuple[int, complex]] = []
    gyro: list[tuple[int, float]] = []
    truth: list[tuple[int, complex, float]] = []
    begin = samples[0].stamp
    for s in samples:
        value, t = s.value, s.stamp - begin
        if isinstance(value, Detections):
            pairs = zip(value.markers, value.bearings, strict=True)
            rows += [(t, number[marker], ray) for marker, ray in pairs if marker in number]
        elif isinstance(value, Twist):
            if value.linear is not None:
                wheel.append((t, complex(value.linear[0], value.linear[1])))
            if value.angular is not None:
                gyro.append((t, float(value.angular[2])))
        elif isinstance(value, CarPose) and value.rotation is not None and s.role is Role.TRUTH:
            truth.append((t, complex(*value.position[:2]), _yaw(value.rotation)))
    ray = np.array([row[2] for row in rows], dtype=np.float64).reshape(-1, 3)
    return CarDrive(
        name=name,
        vehicle=vehicle,
        mounting=camera.to_body(),
        lever=np.array(camera.position),
        lens=lens,
        time=NS * np.array([row[0] for row in rows], dtype=np.float64),
        target=np.array([row[1] for row in rows], dtype=np.int64),
        ray=ray,
        pixel=np.round(_image(ray, lens), 3) if lens is not None else np.full((len(ray), 2), np.nan),
        height=_height(bag.scenario, vehicle),
        topics=tuple(
            next((bag.log.added[name, role] for role in roles if (name, role) in bag.log.added), ("", 0.0))
            for roles in ROLES
        ),
        **_tracks(wheel, gyro, truth),
    )


def _tracks(wheel: Sequence[Any], gyro: Sequence[Any], truth: Sequence[Any]) -> dict[str, Array]:
    names = (("wheel_time", "wheel"), ("gyro_time", "gyro"), ("truth_time", "truth", "truth_yaw"))
    found = {}
    for columns, rows in zip(names, (wheel, gyro, truth), strict=True):
        values = [np.array(column) for column in zip(*rows, strict=True)] or [np.zeros(0) for _ in columns]
        found.update(zip(columns, [NS * values[0], *values[1:]], strict=True))
    return found


def _height(scenario: Scenario, vehicle: int) -> float:
    start = scenario.vehicles[vehicle].initial_pose
    return start.position[2] if start is not None and start.position is not None else 0.0


def _yaw(rotation: Array) -> float:
    return float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def drive_of_recording(recording: "Recording", path: Path) -> Drive:
    """Return the drive of a log of coopenv. Raises DataError: it is not one of cars, or a car has too few sightings."""
    r = recording
    if r.scenario is None or r.pan is not None:
        raise DataError(f"{path}: calibrate needs a log with its environment and with cameras that do not turn")
    L = r.landmarks.shape[1]
    static = np.flatnonzero(np.ptp(r.landmarks, axis=0).max(axis=-1, initial=0.0) < 1e-9)
    names = tuple(r.setups[0].target_names[i] for i in static)
    cars = tuple(_checked(car, str(path)) for car in _of_vehicles(r, static, path, L))
    return Drive(cars, names, r.landmarks[0, static], r.scenario)


def _of_vehicles(r: "Recording", static: NDArray[np.int64], path: Path, L: int) -> Iterator[CarDrive]:
    middle = r.t[1:] - 0.5 * r.dt
    for i, setup in enumerate(r.setups):
        turn = np.array([_rotation_vector(R) for R in r.rotation[1:, i]]) / r.dt
        speed = r.translation[1:, i] / r.dt
        if abs(float(speed[:, 2].mean())) > CLIMB or np.abs(turn[:, :2].mean(axis=0)).max() > TILT:
            raise DataError(f"{path}: {setup.name} leaves the plane; calibrate is for cars")
        camera = r.scenario.cameras[i] if r.scenario is not None else None
        assert camera is not None
        tick, column = np.nonzero(r.visible[:, i, static])
        ray = r.bearings[tick, i, static[column]] @ camera.to_body()
        lens = Calibration.of(camera) if camera.model == "pinhole" else None
        if lens is not None and not camera.undistort:  # bearings of pixels whose distortion was left in
            ray = rays(_image(ray, replace(lens, distortion=(0.0,) * 5)), lens)[0]
        known = np.flatnonzero(r.truth.known[:, i])
        place = r.truth.position[known, i]
        yield CarDrive(
            name=setup.name,
            vehicle=i,
            mounting=camera.to_body(),
            lever=np.array(camera.position),
            lens=lens,
            time=r.t[tick],
            target=column,
            ray=ray,
            pixel=_image(ray, lens) if lens is not None else np.full((len(ray), 2), np.nan),
            wheel_time=middle,
            wheel=(speed[:, 0] + 1j * speed[:, 1]) * np.exp(-0.5j * turn[:, 2] * r.dt),
            gyro_time=middle,
            gyro=turn[:, 2],
            truth_time=r.t[known],
            truth=place[:, 0] + 1j * place[:, 1],
            truth_yaw=np.array([_yaw(R) for R in r.truth.rotation[known, i]]),
            height=float(np.median(place[:, 2])) if len(place) else _height(r.scenario, i),
        )


def _rotation_vector(R: Array) -> Array:
    return 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])  # small turns of one tick
