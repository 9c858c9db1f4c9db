"""Checks of what cameras see of the map: markers, map, mounting, lens and motion capture against each other.

Every cause is a change of one stream. The cause counts under which bearings fit best, if it removes most of the misfit.
"""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from coopenv.base.errors import listed
from coopenv.cars.bags.clocks import CAMERAS
from coopenv.cars.calibration.calibrate import INTRINSICS
from coopenv.cars.calibration.drives import LEAST_SECONDS
from coopenv.cars.calibration.resection import misfits, seen_from
from coopenv.cars.doctor.finding import Change, Diagnosis, Finding, Treatment, with_error
from coopenv.cars.doctor.motion import NAMED, turning_factor, velocity_relations
from coopenv.cars.doctor.streams import OF_TRUTH, CarStreams, Planar
from coopenv.cars.messages.vision import Calibration, rays
from coopenv.cars.settings.profile import Role
from coopenv.estimation.lens import distort
from coopenv.estimation.poses import Array

FEWEST, MOST = 12, 300  # sightings
BAD = 0.004
"""Mean misfit, of angles of 3.6 deg, above which a coarse cause is looked for; smaller ones are calibration's."""
OFF_DEG, LARGEST_DEG, MOST_OFF = 3.6, 12.0, 0.8
"""Angles of a ray that is off, and beyond which it counts no more, deg; share of the rays to a landmark elsewhere."""
AS_GIVEN = 0.3
"""Share of their angles by which bearings may be nearer to other landmarks than to those of their markers."""
REMOVED = 0.35
"""Share of the misfit that the cause leaves at most."""
SMALL_DEG, SMALL_LOG, SMALL_M = 6.0, math.log(1.2), 0.3
"""Mountings (deg), focal lengths (logarithm of factors) and places (m) from which calibration finds the right ones."""
OTHERS, MEETING = 3, 1e-3
"""Landmarks beside one that may be elsewhere; least ratio of the axes of the ellipsoid in which its lines meet."""
LATE = (-0.4, -0.2, -0.1, 0.1, 0.2, 0.4)
"""s, offsets of clocks that are tried beside other causes; the clocks themselves are looked at elsewhere."""


@dataclass(frozen=True)
class PosedSightings:
    """Sightings with the poses by motion capture at their times."""

    place: Planar
    yaw: Array
    ray: Array  # (m, 3) unit vectors, body
    ahead: Array
    """(m, 3) from the camera to the markers in the body frame, m."""
    target: NDArray[np.int64]

    def off_deg(self) -> Array:
        """Return the angles (m,) between rays and markers, deg."""
        cosine = (self.ray * self.ahead).sum(axis=-1) / np.linalg.norm(self.ahead, axis=-1)
        return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))

    def off_share(self) -> float:
        """Return the share of the rays that are off by more than `OFF_DEG`."""
        return float((self.off_deg() > OFF_DEG).mean())

    def misfit(self) -> float:
        """Return the mean of (2 sin(angle / 2))^2 up to 0.04 between rays and markers."""
        return float(misfits(self.ray, self.ahead))

    def misplaced(self) -> list[int]:
        """Return the landmarks, by number, most of whose rays are off."""
        counts, off = np.bincount(self.target), np.bincount(self.target, self.off_deg() > OFF_DEG)
        found: list[int] = np.flatnonzero((off > MOST_OFF * counts) & (counts >= FEWEST)).tolist()
        return found


def thinned(car: CarStreams) -> CarStreams | None:
    """Return a car with few of its sightings, all with a pose; None: too few, or the map has a single place."""
    if len(car.places) < 2 or not np.ptp(car.places, axis=0).any() or car.truth_signals is None:
        return None
    rows = np.arange(len(car.time))[:: max(1, len(car.time) // MOST)]
    pose = np.column_stack([signal.over(car.time[rows], car.time[rows], level=True) for signal in car.truth_signals])
    rows = rows[np.isfinite(pose).all(axis=1)]
    if len(rows) < FEWEST:
        return None
    return replace(car, time=car.time[rows], target=car.target[rows], ray=car.ray[rows])


def sight_of(car: CarStreams) -> PosedSightings:
    """Return the sightings of a thinned car with its poses by motion capture."""
    assert car.truth_signals is not None
    track, heading = car.truth_signals
    time = np.clip(car.time, track.times[0], track.times[-1])
    x, y = track.over(time, time, level=True).T
    yaw, point = heading.over(time, time, level=True)[:, 0], car.places[car.target]
    there = np.isfinite(x) & np.isfinite(yaw)  # a change of the time moves some into a hole
    place, yaw, point = (x + 1j * y)[there], yaw[there], point[there]
    flat = np.exp(-1j * yaw) * (point[:, 0] + 1j * point[:, 1] - place)
    ahead = np.stack([flat.real, flat.imag, point[:, 2] - car.height], axis=-1) - car.lever
    return PosedSightings(place, yaw, car.ray[there] @ car.mounting.T, ahead, car.target[there])


@dataclass(frozen=True)
class Cause:
    """A change of a stream that would explain a misfit."""

    subject: str  # empty: a clock, which is looked at elsewhere
    text: str
    change: Change
    size: float | None = None
    error: float | None = None
    key: str = ""
    free: int = 0  # numbers that were fitted
    parts: tuple[str, ...] = ()  # constants among these, as of a `Diagnosis`
    small: bool = False  # whether a calibration begins near enough to find it, among other constants


UNITS = {"mm": 0.001, "cm": 0.01, "inch": 0.0254, "feet": 0.3048}
MIRRORS = {"x has the other sign": (-1.0, 1.0), "y has the other sign": (1.0, -1.0)}


def of_map(matrix: Any) -> Change:
    """Return the change of all places by a matrix (3, 3)."""
    return lambda car: replace(car, places=car.places @ np.asarray(matrix).T)


def of_truth(place: Callable[[Planar], Planar], yaw: Callable[[Array], Array]) -> Change:
    """Return the change of places and headings by motion capture."""
    return lambda car: car.with_tracks(truth=place(car.tracks["truth"]), truth_yaw=yaw(car.tracks["truth_yaw"]))


def of_image(across: float, down: float) -> Change:
    """Return the change of pixels by signs, about the middle of the image."""

    def change(car: CarStreams) -> CarStreams:
        if car.lens is None:
            return replace(car, ray=car.ray * [across, down, 1.0])
        middle = 0.5 * (np.array(car.lens.image_size) - 1.0)
        pixels = middle + (car.lens.pixels(car.ray) - middle) * [across, down]
        ray, there = rays(pixels, replace(car.lens, image_size=(100_000, 100_000)))
        return replace(car, ray=np.where(there[:, None], ray, car.ray * [across, down, 1.0]))

    return change


def of_lens(right: Calibration) -> Change:
    """Return the change to another lens, by the same pixels."""

    def change(car: CarStreams) -> CarStreams:
        if car.lens is None:
            return car
        ray, there = rays(car.lens.pixels(car.ray), replace(right, image_size=(100_000, 100_000)))
        return replace(car, ray=np.where(there[:, None], ray, car.ray), lens=right)

    return change


def causes(car: CarStreams, every: bool = True) -> Iterator[Cause]:
    """Yield the possible causes; not `every`: those without a search."""
    if every:
        yield from _of_numbers(car)
    for unit, metres in UNITS.items():
        yield Cause("landmarks", f"positions of landmarks are in {unit}, and not in m", of_map(metres * np.eye(3)))
    for what, signs in MIRRORS.items():
        yield Cause("landmarks", f"the map is mirrored: {what}", of_map(np.diag([*signs, 1.0])))
    yield Cause("landmarks", "the map has x and y exchanged", of_map([[0, 1, 0], [1, 0, 0], [0, 0, 1]]))
    yield from _of_truth(car)
    if every:
        yield _of_frame(car)
        yield from _of_places(car)
    yield from _of_camera(car)
    role = next((role for role in CAMERAS if role in car.topics), CAMERAS[0])
    for seconds in LATE:
        yield Cause("", "", lambda car, s=seconds: car.shifted(role, s), free=1)  # type: ignore[misc]


def _of_numbers(car: CarStreams) -> Iterator[Cause]:
    """Yield the assignment of marker numbers to landmarks in which bearings are least off, if it is another one."""
    right, given = np.arange(len(car.places)), sight_of(car).target
    toward = (sight_of(replace(car, target=np.full_like(car.target, n))).off_deg() for n in right)
    off = np.array([np.bincount(given, np.minimum(angles, LARGEST_DEG), len(right)) for angles in toward]).T
    seen = np.flatnonzero(np.bincount(given, minlength=len(right)) >= FEWEST)
    right[seen] = linear_sum_assignment((off * (1.0 - AS_GIVEN * np.eye(len(right))))[seen])[1]
    moved = [n for n in seen.tolist() if right[n] != n]
    if moved:
        others = {n: number for n, number in car.numbers.items() if n not in {*seen, *right[seen]}}
        numbers = {**others, **{int(right[n]): number for n, number in car.numbers.items() if n in seen}}
        key = f"markers = {{ {', '.join(f'{car.names[k]} = {number}' for k, number in sorted(numbers.items()))} }}"
        names, places = ([car.names[n] for n in some] for some in (moved, right[moved]))
        text = f"markers {listed(names)} stand at {listed(places)}"
        if {*names} == {*places} and len(names) == 2:
            text = f"markers {names[0]} and {names[1]} are exchanged"
        yield Cause("markers", text, lambda car: replace(car, target=right[car.target]), key=key)


def _of_truth(car: CarStreams) -> Iterator[Cause]:
    topic = car.topic([Role.TRUTH])
    for unit, metres in UNITS.items():
        yield Cause(topic, f"it is in {unit}, and not in m", of_truth(lambda p, k=metres: k * p, _same))  # type: ignore[misc]
    yield Cause(topic, "it is mirrored: y has the other sign", of_truth(np.conj, np.negative))
    for what, (x, y) in MIRRORS.items():
        mirrored = of_truth(lambda p, x=x, y=y: x * p.real + 1j * y * p.imag, _same)  # type: ignore[misc]
        yield Cause(topic, f"{what}, and its heading is right", mirrored)
    yield Cause(topic, "its heading has the other sign", of_truth(_same, np.negative))
    for deg in (90.0, -90.0, 180.0):
        turned = of_truth(_same, lambda yaw, d=deg: yaw + math.radians(d))  # type: ignore[misc]
        yield Cause(topic, f"its body is turned by {-deg:g} deg", turned, -deg)


def _of_frame(car: CarStreams) -> Cause:
    """Return the frame of motion capture in which bearings fit best."""
    topic, sight = car.topic([Role.TRUTH]), sight_of(car)
    turn = Rotation.from_euler("z", sight.yaw[:, None])
    origin = np.stack([sight.place.real, sight.place.imag, 0.0 * sight.yaw], axis=-1)
    lever, unit = origin + turn.apply(car.lever), turn.apply(sight.ray)
    point = origin + turn.apply(sight.ahead + car.lever)
    _, angle, shift = seen_from(unit, lever, point)
    degrees = (math.degrees(angle) + 180.0) % 360.0 - 180.0
    key = (
        f"frames.truth = {{ position = [{shift.real:.3f}, {shift.imag:.3f}, 0.0], yaw = {math.radians(degrees):.4f} }}"
    )
    text = f"its frame is {degrees:.1f} deg and {abs(shift):.2f} m from that of the map"
    moved = of_truth(lambda p: np.exp(1j * angle) * p + shift, lambda yaw: yaw + angle)
    return Cause(topic, text, moved, degrees, None, key, 3, ("frame of motion capture",))


def _of_places(car: CarStreams) -> Iterator[Cause]:
    """Yield the places at which the lines of sight to a landmark meet, least squares, if there are others."""
    sight = sight_of(car)
    turn = Rotation.from_euler("z", sight.yaw[:, None])
    camera = np.stack([sight.place.real, sight.place.imag, car.height + 0.0 * sight.yaw], axis=-1)
    camera, unit = camera + turn.apply(car.lever), turn.apply(sight.ray)
    counts = np.bincount(sight.target, minlength=len(car.places))
    for k in np.flatnonzero(counts >= FEWEST).tolist() if (counts >= FEWEST).sum() > OTHERS else ():
        rows = sight.target == k
        across = np.eye(3) - unit[rows, :, None] * unit[rows, None, :]
        if np.linalg.cond(across.sum(axis=0)) > 1.0 / MEETING:
            continue
        place = np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, camera[rows]))
        places, distance = car.places.copy(), float(np.linalg.norm(place - car.places[k]))
        places[k] = place
        text = f"landmark {car.names[k]} stands at {_listed(place, 2)} m, {distance:.2f} m from its place on the map"
        small, parts = distance < SMALL_M, (f"marker {car.names[k]}: position",)
        moved = partial(replace, places=places)
        yield Cause("landmarks", text, moved, distance, None, "", 3, parts, small)


def _same(values: Any) -> Any:
    return values


def _of_camera(car: CarStreams) -> Iterator[Cause]:
    camera, sight = f"camera of {car.name}", sight_of(car)
    yield Cause(camera, "its image is mirrored", of_image(-1.0, 1.0))
    yield Cause(camera, "its image is upside down", of_image(-1.0, -1.0))
    reversed_ray = "its bearings point from the target to the camera"
    yield Cause(camera, reversed_ray, lambda car: replace(car, ray=-car.ray))
    expected = sight.ahead / np.linalg.norm(sight.ahead, axis=-1, keepdims=True)
    kept, optical = np.ones(len(expected), dtype=bool), sight.ray @ car.mounting
    for _ in range(3):
        turn, _ = Rotation.align_vectors(expected[kept], optical[kept])
        off = np.linalg.norm(turn.apply(optical) - expected, axis=-1)
        kept = off <= 3.0 * np.median(off) + 1e-9
    wrong = (turn * Rotation.from_matrix(car.mounting).inv()).as_rotvec(degrees=True)
    text = f"its mounting is {np.linalg.norm(wrong):.1f} deg from the given one (roll, pitch, yaw {_listed(wrong)} deg)"
    quaternion = _listed(turn.as_quat()[[3, 0, 1, 2]], 4)
    key = f"overrides.vehicles.{car.vehicle}.camera.orientation = [{quaternion}]"
    matrix = turn.as_matrix()
    parts = (f"{car.name}: camera orientation", f"{car.name}: camera position")
    yield Cause(
        *(camera, text, lambda car: replace(car, mounting=matrix), float(np.linalg.norm(wrong))),
        None,
        key,
        3,
        parts,
        float(np.linalg.norm(wrong)) < SMALL_DEG,
    )
    if car.lens is not None:
        yield from _intrinsics(car, car.lens, camera, optical, expected @ car.mounting)
    if car.lens is not None and any(car.lens.distortion):
        flat = replace(car.lens, distortion=(0.0,) * len(car.lens.distortion))
        text = "its lens is corrected already: pixels of rectified images, or bearings without distortion"
        yield Cause(camera, text, of_lens(flat), key="vision.rectified = true")


def _intrinsics(car: CarStreams, lens: Calibration, camera: str, ray: Array, expected: Array) -> Iterator[Cause]:
    """Yield other focal lengths and principal points: lines through pixels by those of the right ones."""
    rows = np.flatnonzero((expected[:, 2] > 0.3) & (ray[:, 2] > 0.2))
    if len(rows) < 2 * FEWEST:
        return
    flat, pixel = distort(expected[rows, :2] / expected[rows, 2:], lens.distortion), lens.pixels(ray[rows])
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
    factor = lens.focal_length[0] / fx
    width, height = (round(side / factor) for side in lens.image_size)
    right = replace(lens, focal_length=(fx, fy), principal_point=(cx, cy), image_size=(width, height))
    size = with_error(factor, factor * error / fx)
    text = f"its focal length is {size} times that of its images (another size, binning or region of interest?)"
    key = f"corrections.{car.name} = {{ focal_length = [{fx:.1f}, {fy:.1f}], principal_point = [{cx:.1f}, {cy:.1f}] }}"
    parts = tuple(f"{car.name}: {part}" for part in INTRINSICS)
    small = abs(math.log(factor)) < SMALL_LOG
    yield Cause(camera, text, of_lens(right), factor, factor * error / fx, key, 4, parts, small)


def _listed(values: Any, digits: int = 1) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values)


FAR = 10.0
"""Times the extent of the landmarks, beyond which motion capture is at another place, or in another unit."""


def of_sight(given: CarStreams) -> Iterator[Diagnosis]:
    """Yield the causes, at most two, of a coarse misfit between bearings, map and motion capture.

    A short drive has none: from one place many look alike.
    """
    if (car := thinned(given)) is None:
        return
    sight, lasts = sight_of(car), np.ptp(car.time) > LEAST_SECONDS
    if (few := sight.misfit() < BAD) and not sight.misplaced():
        return
    topic, found, changed = car.topic([Role.TRUTH]), explanation(car) if lasts else [], car
    if few and lasts and not found:
        names = listed([car.names[k] for k in sight.misplaced()])
        text = f"most bearings of {car.name} to landmark {names} are off by more than {OFF_DEG} deg: is it elsewhere?"
        yield Diagnosis(Finding("landmarks", text, car=car.name, explained=False))
        return
    for cause in found:
        changed = cause.change(changed)
    rest = f", and {sight_of(changed).off_share():.0%} with that mended" if found else ""
    ask = " (are heading, unit and frames.truth right?)"
    for cause in found or [_unexplained(given, sight) if lasts else Cause(topic, NO_CAUSE, _same)]:
        off = f"{sight.off_share():.0%} of the bearings are off by more than {OFF_DEG} deg{rest}"
        text = f"{cause.text}: {off}"
        treatment = Treatment.REFUSED if found or cause.subject == "landmarks" else Treatment.USED
        if cause.subject == topic:
            off = f"{np.median(sight.off_deg()):.0f} deg off the bearings to landmarks (median)"
            text = f"motion capture of {car.name}, topic {topic}, is {_far(car, sight) or off}: {cause.text}{ask}"
            treatment = Treatment.USED
        if cause.subject and not cause.small:
            about = Finding(cause.subject, text, cause.size, cause.error, cause.key, treatment, car.name, bool(found))
            yield Diagnosis(about, cause.change if found else None, cause.parts)


NO_CAUSE, MINOR = "no single cause explains it", 0.5
"""Words of a misfit without a cause, and share of bearings that are off below which most of them fit."""


def _unexplained(car: CarStreams, sight: PosedSightings) -> Cause:
    """Return the streams that are to blame for a misfit without a cause.

    If most bearings fit, it is detections; if wheels and gyro follow motion capture, it is the map or the camera.
    """
    assert car.truth_signals is not None
    if sight.off_share() < MINOR:
        text = "most bearings fit: false detections, a marker or a camera that moved, or jumps of motion capture?"
        return Cause(car.topic(CAMERAS), text, _same)
    turned, (moved, _) = turning_factor(car, car.truth_signals[1]), velocity_relations(car, *car.truth_signals)
    if turned is not None and moved is not None and max(abs(r.factor - 1.0) for r in (turned, moved)) < NAMED:
        text = f"wheels and gyro follow motion capture, and bearings do not fit (map, markers or camera?): {NO_CAUSE}"
        return Cause("landmarks", text, _same)
    return Cause(car.topic([Role.TRUTH]), NO_CAUSE, _same)


TRIED = 4  # first causes to which every second one is tried; to the others those that need no search


def explanation(car: CarStreams) -> list[Cause]:
    """Return the cause, or the two together, that remove the misfit of a thinned car; none: no two do."""
    given, first = sight_of(car).misfit(), _ranked(car, causes(car))
    least, best, changed = first[0]
    if sight_of(changed).misfit() < min(REMOVED * given, BAD) or (best.small and least < REMOVED * given):
        return [best]
    pairs = []
    for n, (_, one, other) in enumerate(first):
        seconds: Iterable[Cause] = causes(other, n < TRIED) if n < TRIED or not one.free else ()
        if n >= TRIED and one.subject == "markers":  # frames are searched with all bearings, mountings with most
            seconds = [_of_frame(other)]
        pairs += [(one, *second) for second in _ranked(other, seconds)[:1]]
    one, _, two, changed = min(pairs, key=lambda pair: pair[1])
    if sight_of(changed).misfit() < min(REMOVED * REMOVED * given, BAD):
        return [one, two]
    return [best] if least < REMOVED * given else []


def _ranked(car: CarStreams, some: Iterable[Cause]) -> list[tuple[float, Cause, CarStreams]]:
    """Return misfits, more for each number that was fitted, causes, and a car without each; the best first."""
    tried = ((cause, cause.change(car)) for cause in some)
    found = [(sight_of(other).misfit() * (1.0 + 0.2 * cause.free), cause, other) for cause, other in tried]
    return sorted(found, key=lambda entry: entry[0])


def _far(car: CarStreams, sight: PosedSightings) -> str:
    """Return how far motion capture is from all landmarks; nothing where it is near."""
    flat = car.places[:, :2]
    width = float(np.linalg.norm(np.ptp(flat, axis=0)))
    away = float(np.median(np.abs(sight.place[:, None] - (flat[:, 0] + 1j * flat[:, 1])).min(axis=1)))
    return f"{away:.3g} m from landmarks that span {width:.3g} m" if width and away > FAR * width else ""


def exchanged_bodies(one: CarStreams, other: CarStreams) -> list[CarStreams]:
    """Return two cars with each other's motion capture, if bearings of both misfit and fit with that; or none."""
    given = [thinned(one), thinned(other)]
    if not all(car is not None and sight_of(car).misfit() > BAD for car in given):
        return []
    right = [a.with_tracks(**{name: b.tracks[name] for name in OF_TRUTH}) for a, b in ((one, other), (other, one))]
    fitting = [thinned(car) for car in right]
    return right if all(car is not None and sight_of(car).misfit() < BAD for car in fitting) else []
