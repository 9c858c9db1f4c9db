"""One batch least squares over the poses of all cars and the constants of their sensors.

States are planar poses at keyframes, ten per second. Odometry carries them to the times of sightings and of motion
capture, so that wheel scale, gyro bias and time offsets act within a keyframe too. All derivatives are differences: a
residual depends on the pose of one keyframe, or of two neighbours, so that six evaluations give those by all poses.
The poses are eliminated by a banded factor (Schur complement). Sightings and motion capture have the loss of
Geman and McClure, whose scale follows from the residuals; odometry has the density of its own noise.

Time offsets act on motion that is averaged over half a second: otherwise they would fit the noise of odometry, and
its derivative would count as information.

Standard errors are the larger of those by the information and of those by the spread of the scores of stretches of a
second ("sandwich"): whole pixels give residuals that are correlated in time.
Source: Geman and McClure, Statistical methods for tomographic image reconstruction, Bulletin of the International
Statistical Institute 52, 1987; White, Maximum likelihood estimation of misspecified models, Econometrica 50, 1982.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid
from scipy.linalg import solveh_banded
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from coopenv.base.errors import DataError
from coopenv.cars.calibration.drives import CalibrationDrive, CarDrive, averaged
from coopenv.cars.calibration.parameters import (
    BIAS,
    BODY,
    CAMERA_TIME,
    FRAME,
    LENS,
    LEVER,
    NUISANCE,
    PER_CAR,
    ROT,
    SCALE,
    TRUTH_TIME,
    WHEEL_TIME,
    kinds_of,
)
from coopenv.cars.calibration.resection import misfits, seen_from
from coopenv.estimation.lens import distort, largest_radius
from coopenv.estimation.poses import Array
from coopenv.estimation.validity import Mask
from coopenv.scenario import Scenario

KEYFRAME = 0.1  # s
GRID = 0.005  # s, of dead reckoning
LOSS = 4.0  # standard deviations where the loss of Geman and McClure bends
STRETCH = 1.0  # s, over which scores are summed
LEAST_PIXEL, LEAST_ANGLE, LEAST_PLACE, LEAST_YAW = 0.2, 5e-4, 1e-3, 2e-3
"""Least standard deviations of a sighting (pixels; rad without pixels) and of motion capture (m, rad)."""
LEAST_SPEED, LEAST_TURN = 1e-6, 1e-7  # m^2/s and rad^2/s, least densities of odometry noise
WINDOW = 6.0  # s of sightings from which a first pose is found
LATE = np.arange(-0.5, 0.51, 0.05)  # s, offsets of motion capture that are tried


class Path(NamedTuple):
    """Dead reckoning, and its averaged rates."""

    time: Array
    yaw: Array
    place: NDArray[np.complex128]
    turn: Array
    speed: NDArray[np.complex128]

    def step(self, begin: Array, end: Array, late: float = 0.0) -> tuple[NDArray[np.complex128], Array]:
        """Return the motion from times to others and a little later, s, in the body at the first: m, rad."""
        yaw = np.interp(begin, self.time, self.yaw)
        moved = np.interp(end, self.time, self.place) - np.interp(begin, self.time, self.place)
        turned = np.interp(end, self.time, self.yaw) - yaw
        if late:
            turn = late * np.interp(end + 0.5 * late, self.time, self.turn)
            speed = np.interp(end + 0.5 * late, self.time, self.speed)
            moved, turned = moved + late * speed * np.exp(1j * (yaw + turned + 0.5 * turn)), turned + turn
        return np.exp(-1j * yaw) * moved, turned


@dataclass(frozen=True)
class Fit:
    """Result of a fit."""

    x: Array  # (G,) deviations of all constants
    poses: tuple[Array, ...]  # per car (M, 3): x, y, yaw at keyframes
    sigma: Array  # (C, 3) sightings, places and yaws of motion capture
    free: Mask  # (G,)


class Batch:
    """The least squares of a drive."""

    def __init__(self, drive: CalibrationDrive, truth: bool) -> None:
        """Prepare it; `truth`: whether motion capture counts. Raises DataError: odometry or geometry is lacking."""
        self.drive, self.places = drive, drive.places
        self.truth = [truth and len(car.truth_time) > 1 for car in drive.cars]
        none: dict[str, Any] = dict.fromkeys(("truth_time", "truth", "truth_yaw"), np.zeros(0))
        self.cars = [car if has else replace(car, **none) for car, has in zip(drive.cars, self.truth, strict=True)]
        self.kinds = kinds_of(self.cars, drive.landmarks)
        self.markers = len(PER_CAR) * len(self.cars)
        self.frame = len(self.kinds) - len(FRAME)
        self.prior = np.array([kind.prior or 1.0 for kind in self.kinds])
        self.steps = np.array([kind.step for kind in self.kinds])
        self.known = np.ones(len(self.kinds), dtype=bool)
        for c, car in enumerate(self.cars):
            mine = self.known[self.own(c)]
            mine[LENS] = False
            self.known[self.lens(c)] = car.lens is not None
            mine[WHEEL_TIME] = not np.array_equal(car.wheel_time, car.gyro_time)
            mine[TRUTH_TIME] = mine[BODY] = self.truth[c]
        self.known[self.frame :] = any(self.truth)
        seen = {int(t) for car in self.cars for t in np.unique(car.target)}
        for i in range(len(self.places)):
            self.known[self.marker(i)] = i in seen
        self.keys = [np.arange(car.time.min() - KEYFRAME, car.time.max() + 2 * KEYFRAME, KEYFRAME) for car in self.cars]
        self.measured = [
            (density(car.wheel_time, car.wheel.real), density(car.gyro_time, car.gyro)) for car in self.cars
        ]
        self.density = []  # of the odometry noise of each car, x, y and yaw
        for car, (speed, turn) in zip(self.cars, self.measured, strict=True):
            stated, rate = drive.scenario.noises[car.vehicle], stated_rate(drive.scenario, car.vehicle)
            speed = max(speed, stated.velocity**2 / rate, LEAST_SPEED)
            turn = max(turn, stated.angular_velocity**2 / rate, LEAST_TURN)
            self.density.append(np.array([speed, speed, turn]))
        self.base = np.zeros(len(self.kinds))  # given values
        for c, car in enumerate(self.cars):
            mine = self.base[self.own(c)]
            mine[LEVER], mine[[SCALE, BIAS]] = car.lever, car.corrected
            mine[CAMERA_TIME : TRUTH_TIME + 1] = [added - car.gyro_added for _, added in car.topics]
            if (lens := car.lens) is not None:
                self.base[self.lens(c)] = *lens.focal_length, *lens.principal_point, *lens.distortion
        self.base[self.markers : self.frame] = self.places.ravel()
        self.slow = [averaged(car.wheel, float(np.median(np.diff(car.wheel_time)))) for car in self.cars]
        self.paths: dict[int, tuple[tuple[float, ...], Path]] = {}  # the last one of each car, with its constants

    def own(self, c: int) -> slice:
        """Return the slice of the constants of a car."""
        return slice(c * len(PER_CAR), (c + 1) * len(PER_CAR))

    def lens(self, c: int) -> NDArray[np.int64]:
        """Return the slice of the constants of a car's lens."""
        lens, begin = self.cars[c].lens, self.own(c).start + LENS.start
        return np.arange(begin, begin + 4 + (0 if lens is None else len(lens.distortion)))

    def marker(self, i: int) -> slice:
        """Return the slice of the coordinates of a marker."""
        return slice(self.markers + 3 * i, self.markers + 3 * i + 3)

    def path(self, c: int, x: Array) -> Path:
        """Return the dead reckoning of a car; the offset of its wheels acts on averaged speeds."""
        car, own = self.cars[c], x[self.own(c)]
        given = own[BIAS], own[SCALE], own[WHEEL_TIME]
        if c in self.paths and self.paths[c][0] == given:  # most derivatives and trials leave it as it is
            return self.paths[c][1]
        time = np.arange(self.keys[c][0] - 1.0, self.keys[c][-1] + 1.0, GRID)
        rate = np.interp(time, car.gyro_time, car.gyro) - own[BIAS]
        speed = np.interp(time, car.wheel_time, car.wheel)
        if own[WHEEL_TIME]:
            speed += np.interp(time, car.wheel_time + own[WHEEL_TIME], self.slow[c])
            speed -= np.interp(time, car.wheel_time, self.slow[c])
        speed /= 1.0 + own[SCALE] / (1.0 + car.corrected[0])
        yaw = cumulative_trapezoid(rate, dx=GRID, initial=0.0)
        place = cumulative_trapezoid(speed * np.exp(1j * yaw), dx=GRID, initial=0.0)
        self.paths[c] = given, Path(time, yaw, place, averaged(rate, GRID), averaged(speed, GRID))
        return self.paths[c][1]

    def residuals(self, c: int, x: Array, pose: Array, near: Array | None = None) -> tuple[Array, Array, Array]:
        """Return the residuals of sightings (n, 2), odometry (M - 1, 3) and motion capture (T, 3), px or rad, m, rad.

        `near`: constants by whose offsets keyframes are assigned, and from which offsets act (None: x).
        """
        near = x if near is None else near
        car, own, keys, path = self.cars[c], x[self.own(c)], self.keys[c], self.path(c, x)
        place, yaw = pose[:, 0] + 1j * pose[:, 1], pose[:, 2]
        seen = self.sightings(c, x, *self.carried(c, x, pose, car.time, CAMERA_TIME, near))
        step, bend = path.step(keys[:-1], keys[1:])
        gap = np.exp(-1j * yaw[:-1]) * np.diff(place) - step
        odometry = np.stack([gap.real, gap.imag, np.diff(yaw) - bend], axis=-1)
        at, heading = self.carried(c, x, pose, car.truth_time, TRUTH_TIME, near)
        offset, frame = own[BODY], x[self.frame :]
        at = at + np.exp(1j * heading) * (offset[1] + 1j * offset[2])
        at = np.exp(1j * frame[0]) * at + frame[1] + 1j * frame[2]
        gap, angle = car.truth - at, car.truth_yaw - heading - offset[0] - frame[0]
        return seen, odometry, np.stack([gap.real, gap.imag, (angle + np.pi) % (2 * np.pi) - np.pi], axis=-1)

    def carried(
        self, c: int, x: Array, pose: Array, time: Array, offset: int, near: Array
    ) -> tuple[NDArray[np.complex128], Array]:
        """Return places (m) and headings (rad) of a car at times (s) whose offset is a constant; `near`: see there."""
        start = near[self.own(c)][offset]
        when = time + start
        k = self.nearest(c, when)
        moved, turned = self.path(c, x).step(self.keys[c][k], when, x[self.own(c)][offset] - start)
        return pose[k, 0] + 1j * pose[k, 1] + np.exp(1j * pose[k, 2]) * moved, pose[k, 2] + turned

    def sightings(self, c: int, x: Array, at: NDArray[np.complex128], heading: Array) -> Array:
        """Return the residuals (n, 2) of sightings from places, m, and headings, rad."""
        car, own = self.cars[c], x[self.own(c)]
        point = (self.places + x[self.markers : self.frame].reshape(-1, 3))[car.target]
        flat = np.exp(-1j * heading) * (point[:, 0] + 1j * point[:, 1] - at)
        body = np.stack([flat.real, flat.imag, point[:, 2] - car.height], axis=-1) - car.lever - own[LEVER]
        return self._off(car, own, body @ (Rotation.from_rotvec(own[ROT]).as_matrix() @ car.mounting))

    def nearest(self, c: int, time: Array) -> NDArray[np.int64]:
        """Return the keyframes that are nearest to times."""
        k = np.rint((time - self.keys[c][0]) / KEYFRAME).astype(np.int64)
        return np.asarray(k.clip(0, len(self.keys[c]) - 1))

    def _off(self, car: CarDrive, own: Array, ray: Array) -> Array:
        if car.lens is None:
            across = np.cross(car.ray, np.array([0.0, 1.0, 0.0]))
            across /= np.linalg.norm(across, axis=-1, keepdims=True)
            unit = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
            off = [(unit * axis).sum(axis=-1) for axis in (across, np.cross(car.ray, across))]
            far = np.where((unit * car.ray).sum(axis=-1) < 0.0, 1.0, 0.0)
            return np.stack([off[0] + far, off[1] + far], axis=-1)
        lens, change = car.lens, own[LENS]
        flat = ray[:, :2] / np.maximum(ray[:, 2:], 0.05)
        bent = tuple((np.array(lens.distortion) + change[4 : 4 + len(lens.distortion)]).tolist())
        radius = np.linalg.norm(flat, axis=-1, keepdims=True)
        most = max(2.0, 1.2 * float((np.linalg.norm(car.ray[:, :2], axis=-1) / car.ray[:, 2]).max()))
        reach = largest_radius(tuple(round(value, 4) for value in bent))  # the same for steps of derivatives
        flat = flat * np.minimum(1.0, min(reach, most) / np.maximum(radius, 1e-9))
        return np.asarray(
            car.pixel
            - distort(flat, bent) * (np.array(lens.focal_length) + change[:2])
            - (np.array(lens.principal_point) + change[2:4])
        )

    def weights(self, c: int, parts: tuple[Array, Array, Array], sigma: Array) -> tuple[Array, float]:
        """Return the weight of every row of a car's residuals, one after the other, and the cost of all."""
        seen, odometry, truth = parts
        variance = self.density[c] * KEYFRAME
        found, cost = [], 0.5 * float((odometry**2 / variance).sum())
        for part, scale in ((seen, sigma[0]), (truth[:, :2], sigma[1]), (truth[:, 2:], sigma[2])):
            square = (part**2).sum(axis=-1) / (scale * LOSS) ** 2
            cost += 0.5 * LOSS**2 * float((square / (1.0 + square)).sum())
            found.append(np.repeat(((1.0 + square) ** -2 / scale**2)[:, None], part.shape[1], axis=1))
        rows = [found[0], np.broadcast_to(1.0 / variance, odometry.shape), np.concatenate(found[1:], axis=1)]
        return np.concatenate([part.ravel() for part in rows]), cost

    def scales(self, x: Array, poses: Sequence[Array]) -> Array:
        """Return the standard deviations (C, 3) that residuals have, by their medians."""
        found = []
        for c, car in enumerate(self.cars):
            seen, _, truth = self.residuals(c, x, poses[c])
            least = LEAST_ANGLE if car.lens is None else LEAST_PIXEL, LEAST_PLACE, LEAST_YAW
            found.append(np.maximum([deviation(part) for part in (seen, truth[:, :2], truth[:, 2:])], least))
        return np.array(found)

    def cost(self, x: Array, poses: Sequence[Array], sigma: Array, free: Mask, near: Array | None = None) -> float:
        """Return the cost of constants and poses, that of the priors included; `near` as for `residuals`."""
        parts = [self.weights(c, self.residuals(c, x, poses[c], near), sigma[c])[1] for c in range(len(self.cars))]
        return sum(parts) + 0.5 * float(((x / self.prior)[free] ** 2).sum())

    def linearised(self, c: int, fit: Fit, columns: NDArray[np.int64]) -> tuple[Array, Array, csr_array, Array]:
        """Return residuals (r,), weights (r,), the derivatives by the poses, sparse, and by constants (r, columns)."""
        pose, parts = fit.poses[c], self.residuals(c, fit.x, fit.poses[c])
        W, _ = self.weights(c, parts, fit.sigma[c])
        r = _flat(parts)
        car, M = self.cars[c], len(pose)
        own = fit.x[self.own(c)]
        late = self.nearest(c, car.truth_time + own[TRUTH_TIME])
        seen = self.nearest(c, car.time + own[CAMERA_TIME])
        key = np.concatenate([np.repeat(seen, 2), np.repeat(np.arange(M - 1), 3), np.repeat(late, 3)])
        after = np.zeros(len(r), dtype=np.int64)  # odometry depends on the next keyframe, too
        after[parts[0].size : parts[0].size + parts[1].size] = 1
        column, value = [], []
        for parity, axis in product((0, 1), range(3)):
            moved = pose.copy()
            moved[parity::2, axis] += 1e-6
            change = (_flat(self.residuals(c, fit.x, moved)) - r) / 1e-6
            column.append(3 * (key + after * (key % 2 != parity)) + axis)
            value.append(np.where((key % 2 == parity) | (after > 0), change, 0.0))
        place = np.tile(np.arange(len(r)), 6), np.concatenate(column)
        P = csr_array((np.concatenate(value), place), shape=(len(r), 3 * M))
        J, at = np.zeros((len(r), len(columns))), self.carried(c, fit.x, pose, car.time, CAMERA_TIME, fit.x)
        optical = (columns >= self.markers) & (columns < self.frame)  # they move no car
        optical |= (columns >= self.own(c).start) & (columns < self.own(c).start + LENS.stop)
        for n, constant in enumerate(columns):
            x = fit.x.copy()
            x[constant] += self.steps[constant]
            found = self.sightings(c, x, *at).ravel() if optical[n] else _flat(self.residuals(c, x, pose, fit.x))
            J[: len(found), n] = (found - r[: len(found)]) / self.steps[constant]
        return r, W, P, J

    def solved(self, fit: Fit, columns: NDArray[np.int64]) -> "System":
        """Return the normal equations of constants, from which poses are eliminated."""
        S, g = np.diag(1.0 / self.prior[columns] ** 2), -fit.x[columns] / self.prior[columns] ** 2
        scores, back = [], []
        for c in range(len(self.cars)):
            own = (columns >= self.own(c).start) & (columns < self.own(c).stop)
            mine = np.flatnonzero(own | (columns >= self.markers))
            r, W, P, J = self.linearised(c, fit, columns[mine])
            PW = P.T.multiply(W).tocsr()
            information = PW @ P
            bands = np.array([np.append(information.diagonal(-d), np.zeros(d)) for d in range(6)])
            bands[0] += 1e-6
            cross = PW @ np.column_stack([J, r])
            solution = solveh_banded(bands, cross, lower=True)
            S[np.ix_(mine, mine)] += (J.T * W) @ J - cross[:, :-1].T @ solution[:, :-1]
            effective = J - P @ solution[:, :-1]
            rest = r - P @ solution[:, -1]
            g[mine] -= (effective.T * W) @ r
            part = by_stretch(self.times(c), effective, W * rest)
            score = np.zeros((len(part), len(columns)))
            score[:, mine] = part
            scores.append(score)
            back.append((mine, solution))
        return System(S, g, np.concatenate(scores), back)

    def times(self, c: int) -> Array:
        """Return the times (s) of the rows of a car's residuals."""
        car = self.cars[c]
        return np.concatenate([np.repeat(car.time, 2), np.repeat(self.keys[c][:-1], 3), np.repeat(car.truth_time, 3)])

    def fit(self, begin: Fit, most: int = 25) -> Fit:
        """Return the fit from a start, of the constants that are free there."""
        fit, columns = begin, np.flatnonzero(begin.free)
        for _ in range(most):
            sigma = self.scales(fit.x, fit.poses)
            before = self.cost(fit.x, fit.poses, sigma, fit.free)
            fit = replace(fit, sigma=sigma)
            system = self.solved(fit, columns)
            change = np.linalg.solve(system.S, system.g)
            moves = [-(y[:, -1] + y[:, :-1] @ change[mine]).reshape(-1, 3) for mine, y in system.back]
            for share in 0.5 ** np.arange(6):
                x = fit.x.copy()
                x[columns] += share * change
                poses = tuple(pose + share * move for pose, move in zip(fit.poses, moves, strict=True))
                cost = self.cost(x, poses, sigma, fit.free, fit.x)
                if cost < before:
                    break
            else:
                return fit
            fit = replace(fit, x=x, poses=poses)
            if before - cost < 1e-4 * (1.0 + 1e-3 * before):
                break
        return fit

    def begin(self) -> Fit:
        """Return the start of fits: motion capture, or without it solutions of windows of sightings."""
        x, poses = np.zeros(len(self.kinds)), []
        for c, car in enumerate(self.cars):
            if self.truth[c]:
                keys, late = self.keys[c], car.truth_time
                near = np.interp(keys, late, np.arange(len(late))).round().astype(np.int64)
                moved, turned = self.path(c, x).step(late[near], keys)  # motion capture may have holes
                place, yaw = car.truth[near], np.unwrap(car.truth_yaw)[near]
                place = place + np.exp(1j * yaw) * moved
                poses.append(np.stack([place.real, place.imag, np.unwrap(yaw + turned)], axis=-1))
            else:
                poses.append(self.resected(c, np.arange(len(self.places)))[0])
        free = np.zeros(len(x), dtype=bool)
        for c in range(len(self.cars)):
            free[self.own(c).start + np.array(NUISANCE)] = True
        return Fit(x, tuple(poses), self.scales(x, poses), free)

    def misfit(self, labels: NDArray[np.int64]) -> float:
        """Return the misfit of sightings, (2 sin(angle / 2))^2 up to 0.04, if markers are exchanged.

        Motion capture counts at the offset of its stamps at which they fit best.
        """
        total = 0.0
        for c, car in enumerate(self.cars):
            if not self.truth[c]:
                total += self.resected(c, labels)[1]
                continue
            point, unit, found = self.places[labels[car.target]], car.ray @ car.mounting.T, []
            for time in car.time - LATE[:, None]:
                at, yaw = (np.interp(time, car.truth_time, v) for v in (car.truth, np.unwrap(car.truth_yaw)))
                flat = np.exp(-1j * yaw) * (point[:, 0] + 1j * point[:, 1] - at)
                to = np.stack([flat.real, flat.imag, point[:, 2] - car.height], axis=-1) - car.lever
                found.append(float(misfits(unit, to)))
            total += min(found)
        return total

    def resected(self, c: int, labels: NDArray[np.int64]) -> tuple[Array, float]:
        """Return poses (M, 3) at the keyframes from the sightings of windows, and their mean misfit."""
        car, path = self.cars[c], self.path(c, np.zeros(len(self.kinds)))
        keys, target, good = self.keys[c], labels[car.target], []
        for begin in np.arange(keys[0], keys[-1], WINDOW):
            inside = np.flatnonzero((car.time >= begin) & (car.time < begin + WINDOW))
            if len(inside) < 20 or len(np.unique(target[inside])) < 2:
                continue
            inside = inside[:: max(1, len(inside) // 150)]
            middle = begin + 0.5 * WINDOW
            moved, turned = path.step(np.full(len(inside), middle), car.time[inside])
            turn = Rotation.from_euler("z", turned[:, None])
            lever = turn.apply(car.lever) + np.stack([moved.real, moved.imag, 0.0 * turned], axis=-1)
            point = self.places[target[inside]] - [0.0, 0.0, car.height]
            good.append((middle, *seen_from(turn.apply(car.ray[inside] @ car.mounting.T), lever, point)))
        if not good:
            raise DataError(
                f"{car.name}: two static landmarks are never seen within {WINDOW:g} s; no pose can be found"
            )
        when, misfit, heading, place = map(np.array, zip(*good, strict=True))
        near = np.argmin(np.abs(when - keys[:, None]), axis=1)
        moved, turned = path.step(when[near], keys)
        now, yaw = place[near] + np.exp(1j * heading[near]) * moved, heading[near] + turned
        return np.stack([now.real, now.imag, np.unwrap(yaw)], axis=-1), float(misfit.mean())


class System(NamedTuple):
    """Normal equations of constants."""

    S: Array  # information
    g: Array
    scores: Array  # (stretches, G)
    back: list[tuple[NDArray[np.int64], Array]]  # per car: its constants, and what the poses follow by


def by_stretch(time: Array, J: Array, r: Array) -> Array:
    """Return the scores (stretches, G) of derivatives (n, G) and weighted residuals (n,) at times, s."""
    stretch = ((time - time.min()) / STRETCH).astype(int)
    return np.stack([np.bincount(stretch, column * r) for column in J.T], axis=-1).astype(np.float64)


def standard_errors(S: Array, scores: Array, prior: Array) -> Array:
    """Return standard errors by an information and the scores (stretches, G); `prior`: (G,) standard deviations."""
    inverse = np.linalg.inv(S)
    robust = inverse @ (scores.T @ scores + np.diag(prior**-2)) @ inverse
    return np.asarray(np.sqrt(np.maximum(robust.diagonal(), inverse.diagonal())))


def _flat(parts: tuple[Array, Array, Array]) -> Array:
    return np.concatenate([part.ravel() for part in parts])


def deviation(rows: Array) -> float:
    """Return the standard deviation of the components of rows (n, 1) or (n, 2), by the median of their lengths."""
    return float(np.median(np.linalg.norm(rows, axis=-1))) / (0.6745, 1.1774)[rows.shape[1] - 1] if len(rows) else 0.0


def stated_rate(scenario: Scenario, vehicle: int) -> float:
    """Return the rate in Hz at which the environment states a vehicle's odometry noise."""
    stated = scenario.noises[vehicle].odometry_rate
    return scenario.rates.odometry if isinstance(stated, str) else stated


def density(time: Array, values: Array) -> float:
    """Return the density of the white noise of samples, by the differences of neighbours."""
    if len(time) < 3:
        return 0.0
    return (float(np.median(np.abs(np.diff(values)))) / 0.9539) ** 2 * float(np.median(np.diff(time)))
