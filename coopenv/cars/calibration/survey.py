"""The map from a drive: places of the markers that cameras have seen, an environment and a map of topics for them.

Every marker starts where its lines of sight meet, from the poses of motion capture, or of dead reckoning without it.
One batch least squares then estimates all places, poses and what each drive has anew; without motion capture the pose
of the first car at the begin is the origin. A marker whose lines of sight do not meet belongs to a car, or moves.
Source: Hartley and Sturm, Triangulation, Computer Vision and Image Understanding 68(2), 1997 (iterated linear method).
"""

from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment, minimize_scalar

from coopenv.base.errors import DataError, listed
from coopenv.base.files import replace_text
from coopenv.cars.bags.bag import open_bags
from coopenv.cars.bags.files import BagFile
from coopenv.cars.bags.topics import cars_of, examined, markers_of
from coopenv.cars.calibration.batch import LATE, Batch, Fit
from coopenv.cars.calibration.calibrate import errors
from coopenv.cars.calibration.drives import CalibrationDrive, CarDrive, drive_of_streams
from coopenv.cars.calibration.parameters import BIAS, CAMERA_TIME, NUISANCE, ROT
from coopenv.cars.settings.profile import Role
from coopenv.cars.settings.toml import toml_text
from coopenv.estimation.poses import Array, about_z
from coopenv.scenario import Scenario, load_scenario

LEAST_FRAMES = 50  # in which a marker must be seen
FITTING, MEETING = 0.8, 0.03  # share of the lines of sight that pass a marker that stands within an angle, rad
TRIPLES = 20  # of lines of sight that meet somewhere, of which the best is the start
MUCH_BETTER = 0.5  # share of the angles at 0, above which first constants are 0
ENOUGH = 100  # lines of sight to a marker, for first constants
VAGUE = 0.1  # m, standard deviation of a place by its lines of sight, from which it is not known
BIASES = np.linspace(-0.3, 0.3, 31)  # rad/s, gyro biases that are tried without motion capture
OWN = 0.3  # rad, median angle between lines of sight to a marker on a car and to the car's origin
UNKNOWN_PLACE = 10.0  # m, prior of a place
LARGEST_ERROR = (0.1, 0.02)  # m, standard, of a place that is of use, without motion capture and with it
SAME = 0.3  # m, to a landmark of the environment that gives the name
KEPT = ("rates", "camera", "noise", "map", "topology", "v2x", "observer", "dynamics")
"""Sections of an environment that the new one takes over."""


@dataclass(frozen=True)
class SurveyedMarker:
    """A marker."""

    number: int
    name: str  # of a landmark, or of the car that carries it; empty: neither
    frames: int
    position: tuple[float, ...] = ()  # m, map; empty: not solved
    error: tuple[float, ...] = ()  # m, standard; without motion capture about the markers' middle and mean direction
    finding: str = ""


@dataclass(frozen=True)
class Survey:
    """The result, whose files are written."""

    markers: tuple[SurveyedMarker, ...]
    sightings: tuple[float, ...]  # standard deviation by car, px or rad
    truth: bool
    files: tuple[Path, Path]


def meeting_point(origin: Array, ray: Array) -> tuple[Array, float, float]:
    """Return the point (3,) nearest to lines from origins (n, 3), m, along unit rays, their angle to it, and its std.

    Of the angles a share `FITTING` is smaller. Lines count by their angle: the distance from a line is divided by that
    from its origin, and outliers count less.
    """
    across = np.eye(3) - ray[:, :, None] * ray[:, None, :]

    def meeting(weight: Array) -> tuple[Array, Array]:
        W = weight[:, None, None] * across
        information = W.sum(axis=0) + 1e-9 * np.eye(3)
        return np.linalg.solve(information, (W @ origin[:, :, None]).sum(axis=0)[:, 0]), information

    triples = np.linspace(0, len(ray) - 1, TRIPLES + 2).astype(int)
    starts = [meeting(np.isin(np.arange(len(ray)), triples[k : k + 3]).astype(float))[0] for k in range(TRIPLES)]
    point = min(starts, key=lambda start: float(np.median(angles(ray, start - origin))))
    scale, information = 1.0, np.eye(3)
    for _ in range(20):
        line = point - origin
        distance = np.maximum(np.linalg.norm(line, axis=-1), 0.1)
        angle = angles(ray, line)
        scale = max(float(np.median(angle)), 1e-3)
        point, information = meeting(1.0 / (distance * (1.0 + (angle / (3.0 * scale)) ** 2)) ** 2)
    angle = angles(ray, point - origin)
    return point, float(np.quantile(angle, FITTING)), scale / float(np.sqrt(np.linalg.eigvalsh(information)[0]))


def angles(ray: Array, line: Array) -> Array:
    """Return the angles (n,) between unit rays and lines (n, 3) of any length, rad."""
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(ray, line), axis=-1), (ray * line).sum(axis=-1)))


def lines_of_sight(car: CarDrive, place: Array, yaw: Array) -> tuple[Array, Array]:
    """Return the cameras (n, 3), m, and unit rays (n, 3) of a car's sightings, map, by its places (complex) and yaw."""
    R = about_z(yaw)
    at = np.stack([place.real, place.imag, np.full(len(yaw), car.height)], axis=-1)
    return at + R @ car.lever, (R @ (car.ray @ car.mounting.T)[:, :, None])[..., 0]


def first_constants(batch: Batch) -> Array:
    """Return the constants (G,) by which the lines of sight of known cars meet best, zero but for one of each car.

    With motion capture it is the time of a car's sightings, and without it the gyro bias of the first car.
    """
    x = np.zeros(len(batch.kinds))
    for c in known_cars(batch):
        tried, place = (LATE, CAMERA_TIME) if any(batch.truth) else (BIASES, BIAS)
        constant = batch.own(c).start + place

        def missed(value: float, c: int = c, constant: int = constant) -> float:
            x[constant] = value
            pose = keyframe_poses(batch, c, x)
            lines = [_seen(batch, c, x, pose, target) for target in np.unique(batch.cars[c].target)]
            some = [[part[:: 1 + len(part) // ENOUGH] for part in line] for line in lines]
            return float(np.median([meeting_point(origin, ray)[1] for origin, ray in some]))

        best, step = min(tried.tolist(), key=missed), float(tried[1] - tried[0])
        best = best if missed(best) < MUCH_BETTER * missed(0.0) else 0.0
        bounds = best - step, best + step
        x[constant] = minimize_scalar(missed, bounds=bounds, method="bounded", options={"xatol": 0.02 * step}).x
    return x


def known_cars(batch: Batch) -> list[int]:
    """Return the cars with motion capture; without any the first one, which is known by dead reckoning."""
    return [c for c, has in enumerate(batch.truth) if has] or [0]


def keyframe_poses(batch: Batch, c: int, x: Array) -> Array:
    """Return the poses (M, 3) of a car at the keyframes: of motion capture, or dead reckoning from the origin."""
    car, keys = batch.cars[c], batch.keys[c]
    if batch.truth[c]:
        yaw = np.interp(keys, car.truth_time, np.unwrap(car.truth_yaw))
        place = np.interp(keys, car.truth_time, car.truth)
    else:
        place, yaw = batch.path(c, x).step(np.full(len(keys), keys[0]), keys)
    return np.stack([place.real, place.imag, yaw], axis=-1)


def solved(drive: CalibrationDrive, truth: bool, begun: Array) -> tuple[Batch, Fit, Array, Array]:
    """Return the batch of a drive, its fit with all markers free, places (L, 3) of markers and starts (C, 3) of cars.

    The sightings of known cars give the first places, and these the first poses of other cars.

    Args:
        drive: its cars and markers.
        truth: whether motion capture counts.
        begun: the first constants of its cars, as of `first_constants`; those of markers are not read.
    """
    batch = Batch(replace(drive, places=drive.places.copy()), truth)
    x, counted = np.zeros(len(batch.kinds)), known_cars(batch)
    x[: batch.markers] = begun[: batch.markers]
    poses = [keyframe_poses(batch, c, x) for c in range(len(batch.cars))]
    for i in range(len(batch.places)):
        origin, ray = _seen_by(batch, counted, x, poses, i)
        if len(ray):
            batch.places[i] = meeting_point(origin, ray)[0]
    batch.base[batch.markers : batch.frame] = batch.places.ravel()
    for c in range(len(batch.cars)):
        if c not in counted:
            poses[c] = batch.resected(c, np.arange(len(batch.places)))[0]
    free = np.zeros(len(x), dtype=bool)
    free[batch.markers : batch.frame] = batch.known[batch.markers : batch.frame]
    batch.prior[batch.markers : batch.frame] = UNKNOWN_PLACE
    for c in range(len(batch.cars)):
        free[batch.own(c).start + np.array(NUISANCE)] = True
        if batch.truth[c]:  # by which the camera and its clock show
            free[batch.own(c)][[ROT.start, ROT.start + 1, ROT.start + 2, CAMERA_TIME]] = True
    fit = batch.fit(Fit(x, tuple(poses), batch.scales(x, poses), free))
    places = batch.places + fit.x[batch.markers : batch.frame].reshape(-1, 3)
    starts = np.array([pose[0] for pose in fit.poses])
    if not any(batch.truth):  # the first car's start becomes the origin
        at, back = starts[0, 0] + 1j * starts[0, 1], np.exp(-1j * starts[0, 2])
        for table in (places, starts):
            flat = back * (table[:, 0] + 1j * table[:, 1] - at)
            table[:, 0], table[:, 1] = flat.real, flat.imag
        starts[:, 2] -= starts[0, 2]
    return batch, fit, places, starts


def _seen(batch: Batch, c: int, x: Array, pose: Array, target: int) -> tuple[Array, Array]:
    """Return the lines of sight of a car to a target, by constants (G,) and its poses at keyframes."""
    car, keys = batch.cars[c], batch.keys[c]
    of = car.target == target
    time = car.time[of] + x[batch.own(c).start + CAMERA_TIME]
    place = np.interp(time, keys, pose[:, 0] + 1j * pose[:, 1])
    cut = replace(car, ray=car.ray[of], time=time, target=car.target[of])
    return lines_of_sight(cut, place, np.interp(time, keys, pose[:, 2]))


def _seen_by(batch: Batch, cars: Sequence[int], x: Array, poses: Sequence[Array], target: int) -> tuple[Array, Array]:
    """Return the lines of sight of some cars to a target, see `_seen`."""
    found = [_seen(batch, c, x, poses[c], target) for c in cars]
    origin, ray = (np.concatenate(part) for part in zip(*found, strict=True))
    return origin, ray


@dataclass(frozen=True)
class Room:
    """An environment and a map of topics that are being written."""

    raw: Mapping[str, Any]  # sections of the environment that it follows
    title: str
    cars: Mapping[str, Mapping[Role, str]]  # topics of every car
    folder: Path

    @property
    def files(self) -> tuple[Path, Path]:
        """The environment and the map."""
        return self.folder / "environment.toml", self.folder / "topics.toml"

    def write(
        self, starts: Array, places: Mapping[str, Sequence[float]], markers: Mapping[str, int], own: Mapping[str, int]
    ) -> None:
        """Write starts (C, 3) of the cars, places of landmarks, their markers and those of cars."""
        kept = ("body", "marker", "initial_estimate")
        shared = {key: value for key, value in self.raw["vehicles"][0].items() if key in kept and value}
        poses = [{"position": [x, y, 0.0], "yaw": yaw} for x, y, yaw in np.round(starts, 4).tolist()]
        environment = {
            "title": f"Drive of {self.title}",
            "horizon": self.raw["horizon"],
            **{name: self.raw[name] for name in KEPT if self.raw.get(name)},
            "landmarks": [{"name": name, "position": list(place)} for name, place in places.items()],
            "vehicles": [{"initial_pose": pose, **shared} for pose in poses],
        }
        rows = [
            {"name": car, "marker": own.get(car), "topics": {role.value: topic for role, topic in topics.items()}}
            for car, topics in self.cars.items()
        ]
        topics = {"environment": self.files[0].name, "names": "none", "markers": markers, "cars": rows}
        for file, table in zip(self.files, (environment, topics), strict=True):
            replace_text(file, f"# Proposed from {self.title}.\n{toml_text(table)}")


def survey(bags: Sequence[Path], like: str, folder: Path, truth: bool = True) -> Survey:
    """Solve the places of all markers of a drive, and write `environment.toml` and `topics.toml` into a folder.

    Args:
        bags: of one drive.
        like: environment whose cameras, noise and observer count.
        folder: where the files go.
        truth: whether motion capture counts.

    Raises:
        CoopenvError: a bag cannot be read, or the drive does not determine the places.
    """
    template, title = load_scenario(like), listed([path.name for path in bags])
    with ExitStack() as stack:
        files = [stack.enter_context(BagFile(path)) for path in bags]
        rows, _ = examined(files)
        cars = cars_of(rows)
        seen = markers_of(files, {name for topics in cars.values() for name in topics.values()})
    numbers = sorted(number for number, frames in seen.items() if frames >= LEAST_FRAMES)
    if not numbers:
        raise DataError(f"{title}: no marker is in {LEAST_FRAMES} frames; frames with tags need a map")
    raw = template.model_dump(mode="json", exclude_unset=True)
    raw["horizon"] = float(np.ceil(max(row.messages / row.rate for row in rows if row.rate)))
    room, apart = Room(raw, title, cars, folder), np.zeros((len(cars), 3))
    apart[:, 0] = 10.0 * np.arange(len(cars))
    unnamed = {f"M{number}": number for number in numbers}
    with TemporaryDirectory() as scratch:  # an environment in which every marker has some place, to read the bags
        unsolved = replace(room, folder=Path(scratch))
        unsolved.write(apart, dict.fromkeys(unnamed, (0.0, 0.0, 0.0)), unnamed, {})
        bag = open_bags(bags, {}, unsolved.files[1])
        drive = drive_of_streams(bag.streams, bag.where)
    begun = first_constants(batch := Batch(drive, truth))
    own, standing, notes = sorted_markers(batch, begun, numbers)
    _check_some(title, standing, notes)
    batch, fit, places, starts = solved(only(drive, [numbers.index(n) for n in standing]), truth, begun)
    error, has_truth = place_errors(batch, fit), any(batch.truth)
    names = {number: f"M{number}" for number in standing} | {number: car for car, number in own.items()}
    names |= same_names(template, standing, places) if has_truth else {}
    for number, std in zip(standing, error.max(axis=1).tolist(), strict=True):
        if std > LARGEST_ERROR[has_truth]:
            notes[number] = f"left out: known to {100.0 * std:.0f} cm; drive nearer, or past it"
    known = {n: (tuple(places[k].round(4).tolist()), tuple(error[k].tolist())) for k, n in enumerate(standing)}
    solution = {number: entry for number, entry in known.items() if number not in notes}
    if not has_truth:  # its frame is another one
        truths = {Role.TRUTH}
        room = replace(room, cars={car: {r: of[r] for r in of.keys() - truths} for car, of in cars.items()})
    _check_some(title, solution, notes)
    marks = {names[number]: number for number in solution}
    room.write(starts, {name: solution[number][0] for name, number in marks.items()}, marks, own)
    markers = (
        SurveyedMarker(n, names.get(n, ""), seen[n], *solution.get(n, ((), ())), notes.get(n, "")) for n in numbers
    )
    return Survey(tuple(markers), tuple(fit.sigma[:, 0].tolist()), has_truth, room.files)


def _check_some(title: str, found: Collection[int], notes: Mapping[int, str]) -> None:
    """Raise DataError, with the reasons, if there is no marker."""
    if not found:
        why = "; ".join(f"marker {number}: {text}" for number, text in notes.items())
        raise DataError(f"{title}: {why}. Are camera and mounting those of --like, and turn rates right?")


def only(drive: CalibrationDrive, kept: Sequence[int]) -> CalibrationDrive:
    """Return a drive with some of its markers alone."""
    number = np.full(len(drive.landmarks), -1)
    number[list(kept)] = np.arange(len(kept))
    cars = []
    for car in drive.cars:
        of = number[car.target] >= 0
        columns = {key: getattr(car, key)[of] for key in ("time", "ray", "pixel")}
        cars.append(replace(car, target=number[car.target[of]], **columns))
    return replace(
        drive,
        cars=tuple(cars),
        landmarks=tuple(drive.landmarks[i] for i in kept),
        places=drive.places[list(kept)].copy(),
    )


def sorted_markers(batch: Batch, x: Array, numbers: Sequence[int]) -> tuple[dict[str, int], list[int], dict[int, str]]:
    """Return the markers that cars carry, by car, those that stand still, and why others are left out.

    Args:
        batch: of the drive.
        x: (G,) first constants.
        numbers: of the markers, in the order of the drive.
    """
    poses, counted = [keyframe_poses(batch, c, x) for c in range(len(batch.cars))], known_cars(batch)
    own: dict[str, int] = {}
    standing, notes = [], {}
    for i, number in enumerate(numbers):
        origin, ray = _seen_by(batch, counted, x, poses, i)
        if len(ray) < LEAST_FRAMES // 2:
            notes[number] = "too few sightings while the car moves"
            continue
        _, angle, deviation = meeting_point(origin, ray)
        if carrier := _carrier(batch, x, poses, counted, i):
            own[carrier] = number
            notes[number] = f"carried by {carrier}"
        elif angle > (MEETING if any(batch.truth) else 5.0 * MEETING):
            notes[number] = f"lines of sight miss each other by {np.degrees(angle):.1f} deg: it moves, or two are alike"
        elif deviation > VAGUE:
            notes[number] = "seen from one side alone: its distance is not known"
        else:
            standing.append(number)
    return own, standing, notes


def _carrier(batch: Batch, x: Array, poses: Sequence[Array], counted: Sequence[int], target: int) -> str:
    """Return the car that carries a marker: the one at which others look when they see it; empty without one."""
    best, carrier = OWN, ""
    for other in counted if any(batch.truth) else ():
        off = []
        for c in counted:
            car = batch.cars[c]
            if c == other or not (of := car.target == target).any():
                continue
            origin, ray = _seen(batch, c, x, poses[c], target)
            there = np.interp(
                car.time[of] + x[batch.own(c).start + CAMERA_TIME],
                batch.keys[other],
                poses[other][:, 0] + 1j * poses[other][:, 1],
            )
            line = np.stack([there.real, there.imag, origin[:, 2]], axis=-1) - origin
            off.append(np.abs(np.angle((ray[:, 0] + 1j * ray[:, 1]) / (line[:, 0] + 1j * line[:, 1]))))
        seen_by_itself = (batch.cars[other].target == target).any()
        if off and not seen_by_itself and (angle := float(np.median(np.concatenate(off)))) < best:
            best, carrier = angle, batch.cars[other].name
    return carrier


def place_errors(batch: Batch, fit: Fit) -> Array:
    """Return the standard errors (L, 3) of places, m.

    Without motion capture nothing shows where the frame lies: its place and direction are projected out. Source: the
    S-transformation of Baarda, Publications on Geodesy 5(1), 1973.
    """
    found = errors(batch, fit)[batch.markers : batch.frame].reshape(-1, 3)
    if any(batch.truth):
        return found
    columns = np.flatnonzero(fit.free)
    of = (columns >= batch.markers) & (columns < batch.frame)
    places = (batch.places.ravel() + fit.x[batch.markers : batch.frame]).reshape(-1, 3)
    moved = np.zeros((len(places), 3, 3))
    moved[:, 0, 0] = moved[:, 1, 1] = 1.0
    moved[:, 0, 2], moved[:, 1, 2] = -places[:, 1], places[:, 0]
    T = moved.reshape(-1, 3)[columns[of] - batch.markers]
    rest = np.eye(len(T)) - T @ np.linalg.pinv(T)
    C = rest @ np.linalg.inv(batch.solved(fit, columns).S)[np.ix_(of, of)] @ rest.T
    found[:] = 0.0
    found.ravel()[columns[of] - batch.markers] = np.sqrt(np.maximum(C.diagonal(), 0.0))
    return found


def same_names(template: Scenario, numbers: Sequence[int], places: Array) -> dict[int, str]:
    """Return the names of landmarks of an environment by the numbers of markers that stand at their places."""
    marks = [mark for mark in template.landmarks if mark.motion.kind == "static"]
    if not marks:
        return {}
    apart = np.linalg.norm(places[:, None] - np.array([mark.position for mark in marks]), axis=-1)
    pairs = zip(*linear_sum_assignment(apart), strict=True)
    return {numbers[k]: marks[m].name for k, m in pairs if apart[k, m] < SAME}
