"""Checks of what cameras see of the map: markers, map, mounting, lens and motion capture against each other.

Every cause is a change of one stream. The cause counts under which bearings fit best, if it removes most of the misfit.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from coopenv.cars.calibration.batch import misfit, seen_from
from coopenv.cars.doctor.finding import Finding, Treatment, with_error
from coopenv.cars.doctor.motion import truth_signals
from coopenv.cars.doctor.streams import CarStreams, Streams
from coopenv.cars.messages.vision import Calibration, rays
from coopenv.cars.settings.profile import Role
from coopenv.estimation.lens import distort
from coopenv.estimation.poses import Array

FEWEST, MOST = 12, 400  # sightings
BAD = 0.004
"""Mean misfit, of angles of 3.6 deg, above which a coarse cause is looked for; smaller ones are calibration's."""
OFF_DEG = 3.6
REMOVED = 0.35
"""Share of the misfit that the cause leaves at most."""


@dataclass(frozen=True)
class PosedSightings:
    """Sightings with the poses by motion capture at their times."""

    place: NDArray[np.complex128]
    yaw: Array
    ray: Array  # (m, 3) optical
    point: Array  # (m, 3) m
    target: NDArray[np.int64]
    places: Array  # (L, 3) m
    mounting: Array
    lever: Array
    height: float

    def ahead(self) -> Array:
        """Return the vectors (m, 3) from the camera to the markers in the body frame, m."""
        flat = np.exp(-1j * self.yaw) * (self.point[:, 0] + 1j * self.point[:, 1] - self.place)
        return np.stack([flat.real, flat.imag, self.point[:, 2] - self.height], axis=-1) - self.lever

    def off_deg(self) -> Array:
        """Return the angles (m,) between rays and markers, deg."""
        ahead = self.ahead()
        cosine = ((self.ray @ self.mounting.T) * ahead).sum(axis=-1) / np.linalg.norm(ahead, axis=-1)
        return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))

    def off_share(self) -> float:
        """Return the share of the rays that are off by more than `OFF_DEG`."""
        return float((self.off_deg() > OFF_DEG).mean())

    def misfit(self) -> float:
        """Return the mean of (2 sin(angle / 2))^2 up to 0.04 between rays and markers."""
        return misfit(self.ray @ self.mounting.T, self.ahead())


def sight_of(streams: Streams, car: CarStreams, height: float) -> PosedSightings | None:
    """Return the sightings of a car with its poses by motion capture; None: too few, or the map has a single place."""
    truth = truth_signals(car)
    if len(streams.places) < 2 or not np.ptp(streams.places, axis=0).any() or truth is None or len(car.time) < FEWEST:
        return None
    rows = np.arange(len(car.time))[:: max(1, len(car.time) // MOST)]
    pose = np.column_stack([signal.over(car.time[rows], car.time[rows], level=True) for signal in truth])
    rows, pose = rows[np.isfinite(pose).all(axis=1)], pose[np.isfinite(pose).all(axis=1)]
    if len(rows) < FEWEST:
        return None
    camera, places, target = streams.binding.scenario.cameras[car.vehicle], streams.places, car.target[rows]
    return PosedSightings(
        *(pose[:, 0] + 1j * pose[:, 1], pose[:, 2], car.ray[rows], places[target], target, places),
        *(camera.to_body(), np.array(camera.position), height),
    )


@dataclass(frozen=True)
class Cause:
    """A change of a stream that would explain a misfit."""

    subject: str
    text: str
    changed: PosedSightings
    size: float | None = None
    error: float | None = None
    key: str = ""
    free: int = 0  # numbers that were fitted
    rigid: bool = False  # whether motions stay what they are


UNITS = {"mm": 0.001, "cm": 0.01, "inch": 0.0254, "feet": 0.3048}
MIRRORS = {"x has the other sign": (-1.0, 1.0), "y has the other sign": (1.0, -1.0)}


def causes(sight: PosedSightings, car: CarStreams, names: list[str], numbers: dict[int, int]) -> Iterator[Cause]:
    """Yield the possible causes; `names` of the landmarks, `numbers` of the markers by landmark."""
    for i, j in combinations(sorted(set(sight.target.tolist())), 2):
        swapped = np.where(sight.target == i, j, np.where(sight.target == j, i, sight.target))
        right = {i: numbers.get(j), j: numbers.get(i)}
        entries = (f"{names[k]} = {right.get(k, number)}" for k, number in sorted(numbers.items()))
        key = f"markers = {{ {', '.join(entries)} }}"
        text = f"markers {names[i]} and {names[j]} are exchanged"
        yield Cause("markers", text, replace(sight, point=sight.places[swapped]), key=key)
    yield from _of_map(sight)
    yield from _of_truth(sight, car)
    yield from _of_camera(sight, car)


def _of_map(sight: PosedSightings) -> Iterator[Cause]:
    def moved(point: Array) -> PosedSightings:
        return replace(sight, point=point)

    for unit, metres in UNITS.items():
        yield Cause(
            "landmarks", f"positions of landmarks are in {unit}, and not in m", moved(metres * sight.point), metres
        )
    for what, signs in MIRRORS.items():
        yield Cause("landmarks", f"the map is mirrored: {what}", moved(sight.point * [*signs, 1.0]))
    yield Cause("landmarks", "the map has x and y exchanged", moved(sight.point[:, [1, 0, 2]]))


def _of_truth(sight: PosedSightings, car: CarStreams) -> Iterator[Cause]:
    topic = car.topic([Role.TRUTH])
    for unit, metres in UNITS.items():
        text = f"it is in {unit}, and not in m"
        yield Cause(topic, text, replace(sight, place=metres * sight.place), metres)
    mirrored = replace(sight, place=sight.place.conj(), yaw=-sight.yaw)
    yield Cause(topic, "it is mirrored: y has the other sign", mirrored)
    yield Cause(topic, "its heading has the other sign", replace(sight, yaw=-sight.yaw))
    for deg in (90.0, -90.0, 180.0):
        turned = replace(sight, yaw=sight.yaw + math.radians(deg))
        yield Cause(topic, f"its body is turned by {-deg:g} deg", turned, -deg)
    turn = Rotation.from_euler("z", sight.yaw[:, None])
    origin = np.stack([sight.place.real, sight.place.imag, 0.0 * sight.yaw], axis=-1)
    lever, unit = origin + turn.apply(sight.lever), turn.apply(sight.ray @ sight.mounting.T)
    _, angle, shift = seen_from(unit, lever, sight.point - [0.0, 0.0, sight.height])
    place, degrees = np.exp(1j * angle) * sight.place + shift, (math.degrees(angle) + 180.0) % 360.0 - 180.0
    key = (
        f"frames.truth = {{ position = [{shift.real:.3f}, {shift.imag:.3f}, 0.0], yaw = {math.radians(degrees):.4f} }}"
    )
    text = f"its frame is {degrees:.1f} deg and {abs(shift):.2f} m from that of the map"
    yield Cause(topic, text, replace(sight, place=place, yaw=sight.yaw + angle), degrees, None, key, 3, True)


def _of_camera(sight: PosedSightings, car: CarStreams) -> Iterator[Cause]:
    camera = f"camera of {car.name}"

    def seen(ray: Array) -> PosedSightings:
        return replace(sight, ray=ray)

    yield Cause(camera, "its image is mirrored", seen(sight.ray * [-1.0, 1.0, 1.0]))
    yield Cause(camera, "its image is upside down", seen(sight.ray * [-1.0, -1.0, 1.0]))
    yield Cause(camera, "its bearings point from the target to the camera", seen(-sight.ray))
    expected = sight.ahead() / np.linalg.norm(sight.ahead(), axis=-1, keepdims=True)
    kept = np.ones(len(expected), dtype=bool)
    for _ in range(3):
        turn, _ = Rotation.align_vectors(expected[kept], sight.ray[kept])
        off = np.linalg.norm(turn.apply(sight.ray) - expected, axis=-1)
        kept = off <= 3.0 * np.median(off) + 1e-9
    wrong = (turn * Rotation.from_matrix(sight.mounting).inv()).as_rotvec(degrees=True)
    text = f"its mounting is {np.linalg.norm(wrong):.1f} deg from the given one (roll, pitch, yaw {_listed(wrong)} deg)"
    quaternion = _listed(turn.as_quat()[[3, 0, 1, 2]], 4)
    key = f"overrides.vehicles.{car.vehicle}.camera.orientation = [{quaternion}]"
    turned = replace(sight, mounting=turn.as_matrix())
    yield Cause(camera, text, turned, float(np.linalg.norm(wrong)), None, key, 3)
    if car.lens is not None:
        yield from _intrinsics(sight, car, car.lens, camera, expected @ sight.mounting)
    if car.lens is not None and any(car.lens.distortion):
        flat = replace(car.lens, distortion=(0.0,) * len(car.lens.distortion))
        text = "its lens is corrected already: pixels of rectified images, or bearings without distortion"
        yield Cause(camera, text, seen(rays(car.lens.pixels(sight.ray), flat)[0]), key="vision.rectified = true")


def _intrinsics(
    sight: PosedSightings, car: CarStreams, lens: Calibration, camera: str, optical: Array
) -> Iterator[Cause]:
    """Yield other focal lengths and principal points: lines through pixels by those of the right ones."""
    rows = np.flatnonzero((optical[:, 2] > 0.3) & (sight.ray[:, 2] > 0.2))
    if len(rows) < 2 * FEWEST:
        return
    flat, pixel = distort(optical[rows, :2] / optical[rows, 2:], lens.distortion), lens.pixels(sight.ray[rows])
    lines = []
    for axis in range(2):
        columns, kept = np.column_stack([flat[:, axis], np.ones(len(rows))]), np.ones(len(rows), dtype=bool)
        for _ in range(4):
            line = np.linalg.lstsq(columns[kept], pixel[kept, axis])[0]
            off = np.abs(pixel[:, axis] - columns @ line)
            kept = off <= 3.0 * np.median(off) + 0.5
        spread = float(np.std(flat[kept, 0])) * math.sqrt(kept.sum() / 10.0)
        lines.append((*line, float(np.std((pixel[:, axis] - columns @ line)[kept])) / max(spread, 1e-9)))
    (fx, cx, error), (fy, cy, _) = lines
    if min(fx, fy) < 10.0:
        return
    right = replace(lens, focal_length=(fx, fy), principal_point=(cx, cy), image_size=(100_000, 100_000))
    ray, there = rays(lens.pixels(sight.ray), right)
    factor = lens.focal_length[0] / fx
    size = with_error(factor, factor * error / fx)
    text = f"its focal length is {size} times that of its images (another size, binning or region of interest?)"
    key = f"corrections.{car.name} = {{ focal_length = [{fx:.1f}, {fy:.1f}], principal_point = [{cx:.1f}, {cy:.1f}] }}"
    ray = np.where(there[:, None], ray, sight.ray)
    yield Cause(camera, text, replace(sight, ray=ray), factor, factor * error / fx, key, 4)


def _listed(values: Any, digits: int = 1) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values)


FAR = 10.0
"""Times the extent of the landmarks, beyond which motion capture is at another place, or in another unit."""


def of_sight(sight: PosedSightings, car: CarStreams, names: list[str], numbers: dict[int, int]) -> Iterator[Finding]:
    """Yield the causes, at most two, of a coarse misfit between bearings, map and motion capture."""
    given, topic = sight.misfit(), car.topic([Role.TRUTH])
    if given < BAD:
        return
    found = explanation(sight, car, names, numbers)
    explained = bool(found)
    ask = " (are heading, unit and frames.truth right?)"
    for cause in found or [Cause(topic, "no single cause explains it", sight)]:
        rest = f", and {found[-1].changed.off_share():.0%} with that mended" if found else ""
        off = f"{sight.off_share():.0%} of the bearings are off by more than {OFF_DEG} deg{rest}"
        text, treatment = f"{cause.text}: {off}", Treatment.REFUSED
        if cause.subject == topic:
            off = f"{np.median(sight.off_deg()):.0f} deg off the bearings to landmarks (median)"
            text = f"motion capture of {car.name}, topic {topic}, is {_far(sight) or off}: {cause.text}{ask}"
            treatment = Treatment.USED
        yield Finding(cause.subject, text, cause.size, cause.error, cause.key, treatment, car.name, explained)


TRIED = 5  # first causes to which a second one is looked for


def explanation(sight: PosedSightings, car: CarStreams, names: list[str], numbers: dict[int, int]) -> list[Cause]:
    """Return the cause, or the two together, that remove a misfit; none: no two do."""

    def ranked(of: PosedSightings) -> list[tuple[float, Cause]]:
        tried = [(c.changed.misfit() * (1.0 + 0.2 * c.free), c) for c in causes(of, car, names, numbers)]
        return sorted(tried, key=lambda pair: pair[0])

    given, first = sight.misfit(), ranked(sight)
    if first[0][1].changed.misfit() < min(REMOVED * given, BAD):
        return [first[0][1]]
    pairs = [(misfit, one, two) for _, one in first[:TRIED] for misfit, two in ranked(one.changed)[:1]]
    _, one, two = min(pairs, key=lambda pair: pair[0])
    if two.changed.misfit() < min(REMOVED * REMOVED * given, BAD):
        return [one, two]
    return [first[0][1]] if first[0][1].changed.misfit() < REMOVED * given else []


def _far(sight: PosedSightings) -> str:
    """Return how far motion capture is from all landmarks; nothing where it is near."""
    flat = sight.places[:, :2]
    width = float(np.linalg.norm(np.ptp(flat, axis=0)))
    away = float(np.median(np.abs(sight.place[:, None] - (flat[:, 0] + 1j * flat[:, 1])).min(axis=1)))
    return f"{away:.3g} m from landmarks that span {width:.3g} m" if width and away > FAR * width else ""
