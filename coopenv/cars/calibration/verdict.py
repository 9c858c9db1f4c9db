"""Which constants of a drive are wrong, and by how much.

Every group of constants that may be wrong together is a hypothesis: a camera's yaw, its height, its mounting, its
distortion, one marker. From the fit with all of them as given, the linearised gain ranks the hypotheses; the best ones
are fitted. The one that lowers the cost most, less a penalty per constant (BIC), is accepted, and the search goes on
from there until none is worth its penalty.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import log

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from coopenv.cars.calibration.batch import (
    BIAS,
    CAMERA_TIME,
    LENS,
    LEVER,
    NUISANCE,
    PER_CAR,
    ROT,
    SCALE,
    TRUTH_TIME,
    Batch,
    Fit,
)
from coopenv.cars.calibration.drives import Drive
from coopenv.estimation.poses import Array

TRIED = 7  # hypotheses that are fitted in each round
MOST = 4  # accepted hypotheses
LEAST_GAIN = 15.0  # of the cost, beyond the penalty
SIGNIFICANT = 3.0  # standard errors
FINEST = {"deg": 0.0035, "m": 0.004, "px": 1.0, "": 0.01, "rad/s": 0.002, "s": 0.008}
"""By unit (rad for deg), the least deviation that counts as wrong."""


@dataclass(frozen=True)
class Row:
    """A constant."""

    name: str
    unit: str
    given: float
    value: float
    std: float
    determined: bool
    wrong: bool


@dataclass(frozen=True)
class Calibrated:
    """The result."""

    batch: Batch
    given: Fit  # with all constants as given
    fit: Fit  # with the wrong ones corrected
    rows: tuple[Row, ...]
    verdict: tuple[str, ...]
    overrides: dict[str, list[float] | float]  # dotted keys of the environment


def hypotheses(batch: Batch) -> Iterator[tuple[str, NDArray[np.int64]]]:
    """Yield the names and constants of what may be wrong."""
    for c, car in enumerate(batch.cars):
        own = np.arange(len(batch.kinds))[batch.own(c)]
        groups = {
            **{kind.name: own[[n]] for n, kind in enumerate(PER_CAR[:6])},
            "camera orientation": own[ROT],
            "camera position": own[LEVER],
            "camera mounting": own[:6],
            "camera focal length": own[6:8],
            "camera principal point": own[8:10],
            "camera distortion": own[10:15],
            "camera intrinsics": own[LENS],
            **{kind.name: own[[n]] for n, kind in enumerate(PER_CAR) if kind.unit == "s"},
            "camera and truth offset": own[[CAMERA_TIME, TRUTH_TIME]],
            "truth.body_yaw": own[[20]],
            "truth body position": own[21:23],
        }
        yield from ((f"{car.name}: {name.replace('.', ' ')}", columns) for name, columns in groups.items())
    for i, name in enumerate(batch.drive.landmarks):
        yield f"marker {name}", np.arange(len(batch.kinds))[batch.marker(i)]
    if any(batch.truth):
        yield "frame of motion capture", np.arange(batch.frame, len(batch.kinds))


def exchanged(batch: Batch) -> list[tuple[int, int]]:
    """Return pairs of markers that are exchanged, and exchange their places in the batch."""
    found: list[tuple[int, int]] = []
    seen = [i for i in range(len(batch.places)) if batch.known[batch.marker(i)].any()]
    for _ in range(2):
        pairs = list(combinations(seen, 2))
        labels = np.arange(len(batch.places))
        best, now = None, batch.misfit(labels)
        least = now
        for i, j in pairs:
            other = labels.copy()
            other[[i, j]] = j, i
            if (misfit := batch.misfit(other)) < least:
                best, least = (i, j), misfit
        if best is None or least > 0.7 * now:
            break
        batch.places = batch.places.copy()
        batch.places[[*best]] = batch.places[[*best[::-1]]]
        found.append(best)
    return found


def calibrate(drive: Drive, truth: bool = True) -> Calibrated:
    """Return constants and verdict of a drive; `truth`: whether motion capture counts.

    Raises:
        DataError: no pose can be found.
    """
    batch = Batch(drive, truth)
    pairs = exchanged(batch)
    given = fit = batch.fit(batch.begin())
    count = sum(len(batch.times(c)) for c in range(len(batch.cars)))
    accepted: list[tuple[str, NDArray[np.int64]]] = []
    groups = [(name, columns) for name, columns in hypotheses(batch) if batch.known[columns].all()]
    while len(accepted) < MOST:
        ranked = sorted(
            ((gain - penalty(columns, fit, count), name, columns) for gain, name, columns in gains(batch, fit, groups)),
            key=lambda entry: -entry[0],
        )
        tried = []
        for _, name, columns in ranked[:TRIED]:
            free = fit.free.copy()
            free[columns] = True
            tried.append((name, columns, batch.fit(replace(fit, free=free))))
        if not tried:
            break
        sigma = np.min([fit.sigma, *(found.sigma for *_, found in tried)], axis=0)
        costs = [batch.cost(f.x, f.poses, sigma, f.free) + penalty(columns, fit, count) for _, columns, f in tried]
        best = int(np.argmin(costs))
        name, columns, found = tried[best]
        if batch.cost(fit.x, fit.poses, sigma, fit.free) - costs[best] < LEAST_GAIN:
            break
        accepted.append((name, columns))
        fit = found
    return _result(batch, given, fit, accepted, pairs)


def penalty(columns: NDArray[np.int64], fit: Fit, count: int) -> float:
    """Return by how much constants have to lower the cost."""
    return 0.5 * log(count) * int((~fit.free[columns]).sum())


def gains(
    batch: Batch, fit: Fit, groups: Sequence[tuple[str, NDArray[np.int64]]]
) -> Iterator[tuple[float, str, NDArray[np.int64]]]:
    """Yield by how much each group would lower the cost if the residuals were linear."""
    columns = np.flatnonzero(batch.known)
    system = batch.solved(fit, columns)
    place = {int(column): n for n, column in enumerate(columns)}
    base = [place[int(n)] for n in np.flatnonzero(fit.free)]
    for name, group in groups:
        more = [place[int(n)] for n in group if not fit.free[n]]
        if more:
            both = base + more
            gain = 0.5 * float(system.g[both] @ np.linalg.solve(system.S[np.ix_(both, both)], system.g[both]))
            yield gain, name, group


def _result(
    batch: Batch,
    given: Fit,
    fit: Fit,
    accepted: Sequence[tuple[str, NDArray[np.int64]]],
    pairs: Sequence[tuple[int, int]],
) -> Calibrated:
    own = batch.solved(fit, np.flatnonzero(fit.free))
    error = np.full(len(fit.x), np.inf)
    error[own.columns] = np.sqrt(own.covariance(batch.prior).diagonal())
    for c, car in enumerate(batch.cars):  # a stamp may mean the begin or the end of a sample's period
        period = np.median(np.diff(car.wheel_time)) / np.sqrt(12.0)
        error[batch.own(c)][[CAMERA_TIME, TRUTH_TIME]] = np.hypot(error[batch.own(c)][[CAMERA_TIME, TRUTH_TIME]], period)
    finest = np.array([FINEST[kind.unit] for kind in batch.kinds])
    wrong = fit.free & (np.abs(fit.x) > np.maximum(SIGNIFICANT * error, finest))
    print([(n, fit.x[c], error[c]) for n, c in accepted], pairs)
    return wrong
