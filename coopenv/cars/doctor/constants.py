"""Checks of constants by the least squares of `coopenv calibrate`, of which a score test finds those worth a fit."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from coopenv.base.errors import DataError
from coopenv.cars.calibration.batch import Batch, Fit
from coopenv.cars.calibration.calibrate import (
    INTRINSICS,
    MOST,
    corrected,
    errors,
    exchanged,
    parts_of,
    row_of,
    unexplained,
    wrong,
)
from coopenv.cars.calibration.drives import CalibrationDrive, CarDrive
from coopenv.cars.doctor.finding import Finding, Treatment
from coopenv.cars.doctor.motion import SPEED_FACTORS
from coopenv.cars.doctor.sight import BAD, MIRRORS, REMOVED, UNITS
from coopenv.cars.messages.vision import rays

ROUNDS = 3  # times that a cause is looked for without motion capture
TOGETHER = 2
"""Parts that may be wrong at the same time; more of them imitate a fault that is none of a constant."""
ANY = "bearings contradict wheels and gyro, and no single cause explains it (gyro, wheels, map, markers or camera?)"
TURNS, FINER = (0.5, 0.65, 0.8, 1.0, 1.2, 1.5, 2.0), (0.86, 0.9, 0.93, 0.97, 1.0, 1.03, 1.07, 1.1, 1.14)
"""Scales of a gyro that are tried without motion capture, and multiples of the best one that are tried then."""
TRIED = 2  # hypotheses that are fitted in a round
GAIN = 5.0
"""Gain of the linearised cost from which a hypothesis is fitted: a third of the gain that calibration accepts."""
SIGHTINGS, POSES = 1200, 25.0
"""Sightings, and poses of motion capture in a second, that are enough: what counts as wrong is coarser."""
BLIND = 0.25 * BAD
"""Mean misfit above which a coarse cause is looked for without motion capture."""
COARSE = 2.0
"""Times the deviation that counts as wrong in a calibration, below which constants are no finding here."""


def of_constants(drive_of: Callable[[], CalibrationDrive]) -> Iterator[Finding]:
    """Yield wrong constants of the car of a drive, and of its markers: camera, wheels, gyro, clocks."""
    try:
        drive = drive_of()
        drive = replace(drive, cars=(thinned(drive.cars[0]),))
        name = drive.cars[0].name
        if len(drive.places) < 2 or not np.ptp(drive.places, axis=0).any():
            return
        batch = Batch(drive, True)
        blind = not any(batch.truth)
        for finding, changed in _coarse(drive, name) if blind else ():
            drive, batch = changed, Batch(changed, True)
            yield finding
        given = batch.fit(batch.begin())
        fit = corrected(batch, given, TRIED, GAIN, TOGETHER + 1 if blind else MOST)
        if lines := [*unexplained(batch, fit)]:
            cause = next(_coarse(drive, name, 0.0), None) if blind else None
            text = lines[0].partition(": ")[2]
            text = f"{ANY}: {text}" if blind else text
            yield cause[0] if cause else Finding(name, text, car=name, explained=False)
            return
        found = [*_wrong(batch, fit, name)]
        if blind and len({_group(each) for each in found}) > TOGETHER:
            parts = ", ".join(each.subject.removeprefix(f"{name}: ") for each in found)
            yield Finding(name, f"{ANY}; constants that would have to be wrong together: {parts}", car=name)
        else:
            yield from found
    except (DataError, np.linalg.LinAlgError):  # too short a drive, or one that determines no pose
        return


def _group(finding: Finding) -> str:
    """Return what a part with wrong constants belongs to; a lens is one thing."""
    return INTRINSICS[0] if finding.subject.endswith(INTRINSICS) else finding.subject


def thinned(car: CarDrive) -> CarDrive:
    """Return a car with few enough sightings and poses of motion capture, which are in even steps of their order."""
    rows = slice(None, None, 1 + len(car.time) // SIGHTINGS)
    kept = {name: getattr(car, name)[rows] for name in ("time", "target", "ray", "pixel")}
    late = slice(None, None, 1 + len(car.truth_time) // max(1, round(POSES * float(np.ptp(car.time)))))
    kept |= {name: getattr(car, name)[late] for name in ("truth_time", "truth", "truth_yaw")}
    return replace(car, **kept)


def _wrong(batch: Batch, fit: Fit, name: str) -> Iterator[Finding]:
    """Yield a finding per part of the car or the map with wrong constants."""
    error = errors(batch, fit)
    bad, _ = wrong(batch, fit, error, COARSE)
    for title, part in parts_of(batch).items():
        if rows := [n for n in part if bad[n]]:
            worst = max(rows, key=lambda n: abs(fit.x[n]) / error[n])
            text = f"a wrong constant: {', '.join(row_of(batch, n, fit.x, error).change for n in rows)}"
            key = "the file of `coopenv calibrate` (calibration = ...)"
            yield Finding(title, text, float(fit.x[worst]), float(error[worst]), key, car=name)


def _coarse(drive: CalibrationDrive, name: str, bad: float = BLIND) -> Iterator[tuple[Finding, CalibrationDrive]]:
    """Yield causes of misfits above `bad` without motion capture, and the drive without each and those before.

    Poses follow a wrong stream in part, so that less of its misfit is left. Then the cause has to remove more of it.
    """
    for _ in range(ROUNDS):
        (car,), batch = drive.cars, Batch(replace(drive, places=drive.places.copy()), False)
        if (given := _windows(drive)) < bad:
            return
        pairs, refused = exchanged(batch), Treatment.REFUSED
        tried = [
            ([Finding(name, text, treatment=refused, car=name)], replace(drive, cars=(car,), places=places))
            for text, car, places in _changes(drive, car)
        ]
        texts = [f"markers {drive.landmarks[i]} and {drive.landmarks[j]} are exchanged" for i, j in pairs]
        found = [Finding("markers", text, treatment=refused, car=name) for text in texts]
        tried += [(found, replace(drive, places=batch.places))] if pairs else []
        least, n = min((_windows(changed), n) for n, (_, changed) in enumerate(tried))
        if least > given * (REMOVED if given > BAD else REMOVED * REMOVED):
            if not pairs:
                return
            n = len(tried) - 1  # with a criterion of its own
        found, drive = tried[n]
        yield from ((about, drive) for about in found)


def _windows(drive: CalibrationDrive) -> float:
    """Return the mean misfit of bearings in windows of dead reckoning."""
    return Batch(drive, False).resected(0, np.arange(len(drive.places)))[1]


def _turning(drive: CalibrationDrive) -> float:
    """Return the scale of turn rates with which bearings misfit least."""
    (car,), best = drive.cars, 1.0
    for scales in (TURNS, FINER):
        tried = best * np.array(scales)
        misfit = [_windows(replace(drive, cars=(replace(car, gyro=car.gyro / k),))) for k in tried]
        best = float(tried[int(np.argmin(misfit))])
    return best


def _changes(drive: CalibrationDrive, car: CarDrive) -> Iterator[tuple[str, CarDrive, np.ndarray]]:
    """Yield causes, and the streams and the map without them."""
    places = drive.places
    factor = _turning(drive)
    text = f"the turn rate of {car.name} is about {factor:.2g} times that by bearings"
    yield text, replace(car, gyro=car.gyro / factor), places
    for what, factor in SPEED_FACTORS.items():
        text = f"the velocity of {car.name} is {factor:.4g} times that by bearings ({what})"
        yield text, replace(car, wheel=car.wheel / factor), places
    for what, signs in (("image is mirrored", [-1.0, 1.0, 1.0]), ("image is upside down", [-1.0, -1.0, 1.0])):
        yield f"its {what}", replace(car, ray=car.ray * signs), places
    for factor, lens in ((factor, car.lens) for factor in (0.5, 2.0) if car.lens is not None):
        fx, fy, cx, cy = (factor * value for value in (*lens.focal_length, *lens.principal_point))
        right = replace(lens, focal_length=(fx, fy), principal_point=(cx, cy), image_size=(100_000, 100_000))
        ray, there = rays(car.pixel, right)
        seen: dict[str, Any] = {name: getattr(car, name)[there] for name in ("time", "target", "pixel")}
        changed = replace(car, ray=ray[there], lens=right, **seen)
        yield f"its focal length is {1.0 / factor:g} times that of its images", changed, places
    for what, sign in MIRRORS.items():
        yield f"the map is mirrored: {what}", car, places * [*sign, 1.0]
    for unit, metres in UNITS.items():
        yield f"positions of landmarks are in {unit}, and not in m", car, places * metres
