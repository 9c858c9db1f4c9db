"""Calibration of cars from one drive: constants by one batch least squares; which of them are wrong, and by how much.

Every group of constants that may be wrong together is a hypothesis: a camera's yaw, its height, its mounting, its
distortion, one marker. From the fit with all of them as given, the linearised gain ranks the hypotheses; the best ones
are fitted. The one that lowers the cost most, less a penalty per constant (BIC), is accepted, and the search goes on
from there until none is worth its penalty.
Source: Schwarz, Estimating the dimension of a model, Annals of Statistics 6, 1978.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import log

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from coopenv.base.errors import DataError
from coopenv.cars.calibration.batch import Batch, Fit, standard_errors, stated_rate
from coopenv.cars.calibration.drives import CalibrationDrive
from coopenv.cars.calibration.parameters import BIAS, CAMERA_TIME, LEVER, ROT, SCALE, TRUTH_TIME, WHEEL_TIME
from coopenv.estimation.lens import PLUMB_BOB
from coopenv.estimation.poses import Array
from coopenv.estimation.validity import Mask

TRIED = 7  # hypotheses that are fitted in each round
MOST = 4  # accepted hypotheses
LEAST_GAIN = 15.0  # of the cost, beyond the penalty
SIGNIFICANT = 3.0  # standard errors
FINEST = {"deg": 0.0035, "m": 0.004, "px": 1.0, "": 0.01, "rad/s": 0.002, "s": 0.008}
"""By unit (rad for deg), the least deviation that counts as wrong."""
LARGEST_PIXEL, LARGEST_ANGLE, LARGEST_PLACE = 4.0, 0.02, 0.1
"""Standard deviations of residuals (pixels; rad without pixels; m of motion capture) above which nothing fits."""
WITHIN = "within the environment's noise"
TIGHT = {"marker": 0.01, "truth.frame": 0.01}
"""By the begin of a name, the prior (m, rad) in the estimate of all constants together: the map is surveyed."""


@dataclass(frozen=True)
class ConstantRow:
    """A constant."""

    name: str
    unit: str
    given: float
    value: float
    error: float  # standard
    finding: str = ""  # "wrong", "not determined by this drive", `WITHIN` or nothing

    @property
    def change(self) -> str:
        """Given and estimated value, with its standard error."""
        numbers = f"{self.given:.5g} -> {self.value:.5g} +- {self.error:.2g} {self.unit}"
        return f"{self.name.split('.', 1)[1]} {numbers}".rstrip()


@dataclass(frozen=True)
class Calibrated:
    """The result."""

    batch: Batch
    given: Fit  # with all constants as given
    fit: Fit  # with the wrong ones corrected
    rows: tuple[ConstantRow, ...]
    findings: tuple[str, ...]  # a line per finding
    notes: tuple[str, ...]  # which stamps import has moved
    noise: dict[str, float]  # measured, by key of an environment; none where residuals are not explained
    explained: bool = True  # whether constants explain the residuals


INTRINSICS = ("focal length", "principal point", "lens distortion")
TOGETHER = (
    *(("camera orientation", "camera position"), ("camera orientation", "lens distortion")),
    *(INTRINSICS[:2], INTRINSICS),
)
"""Parts of a car that may be wrong at the same time."""


def parts_of(batch: Batch) -> dict[str, list[int]]:
    """Return the constants that one finding names together, by its title."""
    found: dict[str, list[int]] = {}
    for n, kind in enumerate(batch.kinds):
        if kind.prior:  # coefficients that the model of the lens does not have are without
            found.setdefault(kind.part, []).append(n)
    return found


def hypotheses(batch: Batch) -> list[NDArray[np.int64]]:
    """Return the groups of constants that may be wrong."""
    parts = parts_of(batch)
    groups = [*parts.values()]
    for c, car in enumerate(batch.cars):
        groups += [[n for title in titles for n in parts.get(f"{car.name}: {title}", ())] for titles in TOGETHER]
        groups.append([batch.own(c).start + n for n in (CAMERA_TIME, TRUTH_TIME)])
    groups += [[n] for n, kind in enumerate(batch.kinds[: batch.markers]) if kind.unit in ("deg", "m", "s")]
    return [np.array(group) for group in groups if batch.known[group].all()]


def exchanged(batch: Batch) -> list[tuple[int, int]]:
    """Return pairs of markers that are exchanged, and exchange their places in the batch."""
    found: list[tuple[int, int]] = []
    labels = np.arange(len(batch.places))
    seen = [i for i in labels.tolist() if batch.known[batch.marker(i)].any()]
    others = {(i, j): np.where(labels == i, j, np.where(labels == j, i, labels)) for i, j in combinations(seen, 2)}
    for _ in range(2 if others else 0):
        misfit, best = min((batch.misfit(other), pair) for pair, other in others.items())
        if misfit > 0.7 * batch.misfit(labels):
            break
        batch.places = batch.places[others[best]]
        batch.base[batch.markers : batch.frame] = batch.places.ravel()
        found.append(best)
    return found


def calibrate(drive: CalibrationDrive, truth: bool = True) -> Calibrated:
    """Return constants and findings of a drive; `truth`: whether motion capture counts.

    Raises:
        DataError: the poses of a car are not determined.
    """
    try:
        batch = Batch(drive, truth)
        pairs = exchanged(batch)
        given = batch.fit(batch.begin())
        return _result(batch, given, corrected(batch, given), pairs)
    except np.linalg.LinAlgError as error:
        names = ", ".join(car.name for car in drive.cars)
        raise DataError(f"{names}: the drive does not determine the poses ({error})") from None


def corrected(batch: Batch, given: Fit, tried_most: int = TRIED, least: float = -np.inf, rounds: int = MOST) -> Fit:
    """Return the fit with the wrong constants corrected, from one with all as given.

    Args:
        batch: the least squares.
        given: fit with all constants as given.
        tried_most: hypotheses that are fitted in each round.
        least: linearised gain at which one is fitted.
        rounds: hypotheses that may be wrong at the same time.
    """
    fit, groups = given, hypotheses(batch)
    penalty = 0.5 * log(sum(len(batch.times(c)) for c in range(len(batch.cars))))
    for _ in range(rounds):
        ranked = sorted(gains(batch, fit, groups, penalty), key=lambda entry: -entry[0])[:tried_most]
        ranked = [entry for entry in ranked if entry[0] >= least]
        tried = [batch.fit(replace(fit, free=fit.free | np.isin(np.arange(len(fit.x)), group))) for _, group in ranked]
        if not tried:
            break
        sigma = np.min([found.sigma for found in (fit, *tried)], axis=0)
        costs = [batch.cost(f.x, f.poses, sigma, f.free) + penalty * int((f.free & ~fit.free).sum()) for f in tried]
        best = int(np.argmin(costs))
        if batch.cost(fit.x, fit.poses, sigma, fit.free) - costs[best] < LEAST_GAIN:
            break
        fit = tried[best]
    error = errors(batch, fit)
    kept = given.free | wrong(batch, fit, error)[0]
    for title, part in parts_of(batch).items():  # coefficients of a lens are right or wrong together
        if title.endswith(INTRINSICS):
            kept[part] = kept[part].any()
    return batch.fit(replace(fit, free=kept, x=np.where(kept, fit.x, 0.0)))


def gains(
    batch: Batch, fit: Fit, groups: Sequence[NDArray[np.int64]], penalty: float
) -> Iterator[tuple[float, NDArray[np.int64]]]:
    """Yield by how much each group would lower the cost, less a penalty per constant, if the residuals were linear."""
    columns = np.flatnonzero(batch.known)
    system = batch.solved(fit, columns)
    for group in groups:
        both = np.flatnonzero(fit.free[columns] | np.isin(columns, group))
        if (more := ~fit.free[group]).any():
            gain = 0.5 * float(system.g[both] @ np.linalg.solve(system.S[np.ix_(both, both)], system.g[both]))
            yield gain - penalty * int(more.sum()), group


def errors(batch: Batch, fit: Fit) -> Array:
    """Return the standard errors (G,) of the free constants; infinite for others."""
    columns = np.flatnonzero(fit.free)
    system = batch.solved(fit, columns)
    error = np.full(len(fit.x), np.inf)
    error[columns] = standard_errors(system.S, system.scores, batch.prior[columns])
    for c, car in enumerate(batch.cars):  # a stamp may mean the begin or the end of a sample's period
        period = float(np.median(np.diff(car.wheel_time))) / np.sqrt(12.0)
        times = batch.own(c).start + np.array([CAMERA_TIME, WHEEL_TIME, TRUTH_TIME])
        error[times] = np.hypot(error[times], period)
    return error


def wrong(batch: Batch, fit: Fit, error: Array, coarse: float = 1.0) -> tuple[Mask, Mask]:
    """Return which constants are wrong, and which are off, yet within the noise by which the environment draws them.

    Args:
        batch: the least squares.
        fit: with the constants that may be wrong as free ones.
        error: (G,) standard errors.
        coarse: times the deviations and standard errors that count as wrong.
    """
    finest = coarse * np.array([FINEST[kind.unit] for kind in batch.kinds])
    off, drawn = fit.free & (np.abs(fit.x) > np.maximum(coarse * SIGNIFICANT * error, finest)), np.zeros(len(finest))
    for c, car in enumerate(batch.cars):
        noise = batch.drive.scenario.noises[car.vehicle]
        drawn[batch.own(c).start + np.array([SCALE, BIAS])] = noise.odometry_scale, float(np.max(noise.gyro_bias))
    expected = np.abs(fit.x) <= SIGNIFICANT * drawn
    return off & ~expected, off & expected


def _result(batch: Batch, given: Fit, fit: Fit, pairs: Sequence[tuple[int, int]]) -> Calibrated:
    """Return the wrong constants with the others as given, and the others estimated all together."""
    reasons = list(unexplained(batch, fit))
    fit = given if reasons else fit
    error, wide = errors(batch, fit), batch.prior
    bad, within = (found & (not reasons) for found in wrong(batch, fit, error))
    tight = [next((std for begin, std in TIGHT.items() if kind.name.startswith(begin)), np.inf) for kind in batch.kinds]
    batch.prior = np.where(fit.free, wide, np.minimum(tight, wide))
    whole = batch.fit(replace(fit, free=batch.known))
    x, error = np.where(fit.free, fit.x, whole.x), np.where(fit.free, error, errors(batch, whole))
    loose = error > batch.prior / np.sqrt(2.0)  # by the drive alone it exceeds the prior
    batch.prior = wide
    rows = {}
    for n in np.flatnonzero(batch.known):
        judged = ((bad, "wrong"), (loose, "not determined by this drive"), (within, WITHIN))
        finding = next((words for found, words in judged if found[n]), "")
        rows[int(n)] = row_of(batch, int(n), x, error, finding)
    names = batch.drive.landmarks
    lines = [*reasons, *(f"markers {names[i]} and {names[j]} are exchanged" for i, j in pairs)]
    for title, part in parts_of(batch).items():
        changes = [rows[n].change for n in part if bad[n]]
        lines += [f"{title} is wrong: {', '.join(changes)}"] if changes else []
    topics = ((car.name, topic, added) for car in batch.cars for topic, added in car.topics if abs(added) > FINEST["s"])
    notes = tuple(f"{name}: import has moved the stamps of {topic} by {added:+.3f} s" for name, topic, added in topics)
    for c, car in enumerate(batch.cars):
        late = batch.own(c).start + np.array([CAMERA_TIME, TRUTH_TIME])
        if bad[late].all() and abs(np.diff(x[late])[0]) < SIGNIFICANT * np.hypot(*error[late]):
            lines.append(f"{car.name}: camera and motion capture agree, so that the stamps of wheels and IMU are wrong")
    noise = {} if reasons else _noise(batch, fit)
    return Calibrated(batch, given, fit, tuple(rows.values()), tuple(lines), notes, noise, not reasons)


def row_of(batch: Batch, n: int, x: Array, error: Array, finding: str = "") -> ConstantRow:
    """Return the row of a constant by deviations and standard errors (G,) of all."""
    kind, factor = batch.kinds[n], np.degrees(1.0) if batch.kinds[n].unit == "deg" else 1.0
    given, value, std = (factor * float(v) for v in (batch.base[n], batch.base[n] + x[n], error[n]))
    return ConstantRow(kind.name, kind.unit, given, value, std, finding)


def unexplained(batch: Batch, fit: Fit) -> Iterator[str]:
    """Yield a line per car whose residuals no constant explains."""
    for car, (seen, place, _), truth in zip(batch.cars, fit.sigma, batch.truth, strict=True):
        unit, most = ("rad", LARGEST_ANGLE) if car.lens is None else ("px", LARGEST_PIXEL)
        if seen > most or (truth and place > LARGEST_PLACE):
            off = f"{seen:.3g} {unit}" + (f" and {place:.3g} m of motion capture" if truth else "")
            check = "check landmarks, markers, frames, units and clocks (of a bag: coopenv doctor)"
            yield f"{car.name}: no constant explains the residuals ({off}): {check}"


def _noise(batch: Batch, fit: Fit) -> dict[str, float]:
    """Return the noise that was measured, by key of an environment."""
    rate = stated_rate(batch.drive.scenario, batch.cars[0].vehicle)
    focal = [1.0 if car.lens is None else car.lens.focal_length[0] for car in batch.cars]
    return {
        "noise.bearing.scale": float(np.mean(fit.sigma[:, 0] / focal)),
        "noise.velocity": float(np.sqrt(np.mean([d[0] for d in batch.measured]) * rate)),
        "noise.angular_velocity": float(np.sqrt(np.mean([d[1] for d in batch.measured]) * rate)),
    }


Constants = dict[str, float | list[float]]


def overrides(result: Calibrated) -> Constants:
    """Return dotted keys of the environment with the calibrated cameras, landmarks and noise; none without result."""
    batch, found = result.batch, Constants()
    if not result.explained:
        return found
    value = batch.base + result.fit.x
    for c, car in enumerate(batch.cars):
        key, own = f"vehicles.{car.vehicle}.camera.", value[batch.own(c)]
        quaternion = Rotation.from_matrix(Rotation.from_rotvec(own[ROT]).as_matrix() @ car.mounting).as_quat()
        found[key + "orientation"] = quaternion[[3, 0, 1, 2]].tolist()
        found[key + "position"] = own[LEVER].tolist()
        if car.lens is not None and len(car.lens.distortion) == len(PLUMB_BOB):  # the model of the environment
            found |= {key + name: numbers for name, numbers in intrinsics(batch, c, value).items()}
    moved = batch.places + result.fit.x[batch.markers : batch.frame].reshape(-1, 3) - batch.drive.places
    for mark in batch.drive.scenario.landmarks:
        if mark.name in batch.drive.landmarks and (step := moved[batch.drive.landmarks.index(mark.name)]).any():
            found[f"landmarks.{mark.name}.position"] = (np.array(mark.position) + step).tolist()
    return {name: np.round(values, 7).tolist() for name, values in (found | result.noise).items()}


def intrinsics(batch: Batch, c: int, value: Array) -> Constants:
    """Return the intrinsics of the camera of a car by values of all constants."""
    fx, fy, cx, cy, *bent = value[batch.lens(c)].tolist()
    return {"focal_length": [fx, fy], "principal_point": [cx, cy], "distortion": bent}


def toml_text(result: Calibrated) -> str:
    """Return overrides, leads of topics, corrections and all constants with their standard errors as TOML.

    A lead is against the turn rates of the same car: offsets of a car's clock and of motion capture are of one drive.
    """
    batch, leads, tables = result.batch, dict[str, float](), dict[str, Mapping[str, object]]()
    value = batch.base + result.fit.x
    for c, car in enumerate(batch.cars if result.explained else ()):
        own, times = value[batch.own(c)], [CAMERA_TIME, WHEEL_TIME]
        pairs = zip(car.topics[:2], own[times], batch.base[batch.own(c)][times], strict=True)
        leads |= {t: round(float(v), 5) for (t, _), v, given in pairs if t and (given or abs(v) > FINEST["s"])}
        if car.topics[0][0]:  # of a bag
            found: Constants = {"wheel_scale": float(own[SCALE]), "gyro_bias": float(own[BIAS])}
            found |= {} if car.lens is None else intrinsics(batch, c, value)
            tables[f"corrections.{car.name}"] = {name: np.round(v, 7).tolist() for name, v in found.items()}
    first = "Written by coopenv calibrate, for the key `calibration` of a bag's map or a deployment file."
    return tables_text(first, {"overrides": overrides(result), "clocks.leads": leads, **tables}, result.rows)


def tables_text(first: str, tables: Mapping[str, Mapping[str, object]], rows: Sequence[ConstantRow]) -> str:
    """Return tables, and one of constants, as TOML after a comment."""
    lines = [f"# {first}"]
    for name, table in tables.items():
        lines += ["", f"[{name}]", *(f'"{key}" = {value}' for key, value in table.items())]
    lines += ["", "[constants]"]
    for row in rows:
        numbers = f"given = {row.given:.7g}, value = {row.value:.7g}, standard_error = {row.error:.3g}"
        lines.append(f'"{row.name}" = {{ {numbers}, unit = "{row.unit}", finding = "{row.finding}" }}')
    return "\n".join(lines) + "\n"
