"""The actuation of a car by a drive and its commands.

The model is the fake car's: commands act after a dead time through gains, an offset of the steering, a dead band and
limits, with lags of the first order and limited rates. Least squares against the speed of the wheels, the turn rate and
the speed by motion capture give its constants; weights and standard errors are those of `batch`. The cost is a step
function of the dead band, so that this is looked for between all commanded speeds.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from scipy.optimize import least_squares

from coopenv.base.errors import DataError
from coopenv.cars.calibration.batch import LEAST_PLACE, LOSS, STRETCH, Kind, deviation, sandwich
from coopenv.estimation.poses import Array
from coopenv.world.dynamics import first_order_lag
from coopenv.world.launch import kernel, launch

GRID = 0.01  # s, of the model
INTERVAL = 0.2  # s over which motion capture gives a speed
SETTLED = 1.0  # s after which commands before the bag no longer matter
LEAST_SECONDS = 10.0  # of commands
TRIED = 100  # dead bands in one evaluation
PASSES = 4  # of fit, weights and dead band
SURE = 2.0  # cost by which a dead band is worse than the best: two standard deviations

KINDS = (
    Kind("fake.latency", "s", 0.2, 1e-4),
    Kind("fake.speed_gain", "", 0.3, 1e-5),
    Kind("fake.steering_gain", "", 0.3, 1e-5),
    Kind("fake.steering_offset", "rad", 0.2, 1e-5),
    Kind("fake.deceleration", "m/s^2", 3.0, 1e-4),
    Kind("dynamics.max_acceleration", "m/s^2", 3.0, 1e-4),
    Kind("dynamics.max_steering_rate", "rad/s", 5.0, 1e-4),
    Kind("dynamics.max_speed", "m/s", 2.0, 1e-5),
    Kind("dynamics.max_steering", "rad", 0.5, 1e-5),
    Kind("dynamics.speed_time_constant", "s", 0.3, 1e-4),
    Kind("dynamics.steering_time_constant", "s", 0.3, 1e-4),
    Kind("fake.gyro_bias", "rad/s", 0.1, 1e-6),
    Kind("fake.wheel_scale", "", 0.15, 1e-6),
)
LIMITS = slice(4, 9)
SIGNED = ("fake.steering_offset", "fake.gyro_bias", "fake.wheel_scale")
DEAD_BAND = "dynamics.dead_band"


def follow_all(
    wanted: wp.array3d(dtype=wp.float64),
    lags: wp.array2d(dtype=wp.float64),
    start: wp.float64,
    dt: wp.float64,
    reached: wp.array3d(dtype=wp.float64),
):
    """Follow wanted speeds and steering angles (P, T, 2); lags (P, 6): s of both, rates up, down, of steering; m/s."""
    p = wp.tid()
    speed = start
    steering = wp.float64(0.0)
    for k in range(wanted.shape[1]):
        rate = lags[p, 2]
        if wp.abs(wanted[p, k, 0]) < wp.abs(speed):
            rate = lags[p, 3]
        speed = wp.clamp(first_order_lag(speed, wanted[p, k, 0], dt, lags[p, 0], rate), -lags[p, 5], lags[p, 5])
        steering = first_order_lag(steering, wanted[p, k, 1], dt, lags[p, 1], lags[p, 4])
        reached[p, k, 0] = speed
        reached[p, k, 1] = steering


class Response:
    """What a car measured under its commands, and the model of it."""

    def __init__(self, tracks: Mapping[str, Any], wheelbase: float, timeout: float, where: str) -> None:
        """Take tracks as of `tracks_of`, m, and s after which a command no longer counts. Raises DataError."""
        self._tracks, self._wheelbase = tracks, wheelbase
        time = tracks["command_time"]
        ends = [tracks[name][-1] if len(tracks[name]) else 0.0 for name in ("wheel_time", "gyro_time")]
        seconds = min(time[-1], *ends) - time[0] if len(time) else 0.0
        if seconds < LEAST_SECONDS:
            raise DataError(
                f"{where}: {max(seconds, 0.0):.3g} s with commands, speeds and turn rates; identify needs "
                f"{LEAST_SECONDS:g} s (topics manual or command of the map)"
            )
        late = np.flatnonzero(np.diff(time, append=np.inf) > timeout)
        self._when = np.insert(time, late + 1, time[late] + timeout)
        told = [np.insert(tracks[f"command_{name}"], late + 1, 0.0) for name in ("speed", "steering")]
        self.told = np.stack(told, axis=-1)
        self._edges = np.arange(time[0], time[0] + seconds, GRID)
        self.series = [
            self._kept(tracks["wheel_time"], tracks["wheel"].real),
            self._kept(tracks["gyro_time"], tracks["gyro"]),
            self._kept(*_speed_by_truth(tracks)),
        ]
        """Times and values of the speed of the wheels, the turn rate, and the speed by motion capture."""
        self.ends = np.cumsum([len(time) for time, _ in self.series])[:-1]

    def _kept(self, time: Array, value: Array) -> tuple[Array, Array]:
        inside = (time > self._edges[0] + SETTLED) & (time < self._edges[-1])
        return time[inside], value[inside]

    def rows(self, x: Array, dead: Array) -> Array:
        """Return what the model exceeds the measurements by (P, R), for constants (P, K) and dead bands (P,), m/s."""
        wanted = np.empty((len(x), len(self._edges) - 1, 2))
        for p, (latency, *gains, offset, _, _, _, _, most, _, _, _, _) in enumerate(x):
            v, angle = (self.told * gains).T
            for n, value in enumerate((np.where(np.abs(v) < dead[p], 0.0, v), (angle + offset).clip(-most, most))):
                passed = np.concatenate([[0.0], np.cumsum(value[:-1] * np.diff(self._when))])
                wanted[p, :, n] = np.diff(np.interp(self._edges - latency, self._when, passed)) / GRID
        lags = np.ascontiguousarray(x[:, [9, 10, 5, 4, 6, 7]])
        reached = wp.zeros(wanted.shape, dtype=wp.float64, device="cpu")
        arrays = [wp.array(part, dtype=wp.float64, device="cpu") for part in (wanted, lags)]
        begin = float(np.interp(self._edges[0], self._tracks["wheel_time"], self._tracks["wheel"].real))
        inputs = [*arrays, begin, GRID, reached]
        launch(kernel(follow_all, "float64"), dim=len(x), inputs=inputs, device="cpu")
        at, (wheel, gyro, truth), found = self._edges[1:], self.series, []
        for (v, angle), (*_, bias, scale) in zip(reached.numpy().transpose(0, 2, 1), x, strict=True):
            turn = np.interp(gyro[0], at, v * np.tan(angle) / self._wheelbase) + bias
            way = (np.cumsum(v) - v / 2) * GRID
            mean = np.interp(truth[0] + INTERVAL / 2, at, way) - np.interp(truth[0] - INTERVAL / 2, at, way)
            speed = np.interp(wheel[0], at, v) * (1.0 + scale)
            found.append(np.concatenate([speed - wheel[1], turn - gyro[1], mean / INTERVAL - truth[1]]))
        return np.array(found)

    def weights(self, row: Array) -> Array:
        """Return the square roots of the weights of the rows: by the noise of each series, less for outliers."""
        found, least = [], (0.0, 0.0, np.sqrt(2.0) * LEAST_PLACE / INTERVAL)
        for part, floor in zip(np.split(row, self.ends), least, strict=True):
            scale = max(deviation(part[:, None]), floor, 1e-6)
            found.append(1.0 / scale / (1.0 + (part / scale / LOSS) ** 2))
        return np.concatenate(found)

    def limits(self) -> Array:
        """Return the largest deceleration, acceleration, steering rate, speed and steering that were reached."""
        (time, wheel), (late, gyro), _ = self.series
        grid = np.arange(max(time[0], late[0]), min(time[-1], late[-1]), INTERVAL / 4)
        v, turn = (_mean_at(grid, t, value) for t, value in ((time, wheel), (late, gyro)))
        angle = np.arctan(self._wheelbase * turn / np.maximum(np.abs(v), 0.1))
        slope, bend = np.diff(np.abs(v)) / (INTERVAL / 4), np.abs(np.diff(angle)) / (INTERVAL / 4)
        return np.array([-slope.min(), slope.max(), np.quantile(bend, 0.95), np.abs(v).max(), np.abs(angle).max()])


def _mean_at(grid: Array, time: Array, value: Array) -> Array:
    """Return the means of samples over a grid's steps."""
    passed = np.concatenate([[0.0], np.cumsum(np.diff(time) * 0.5 * (value[1:] + value[:-1]))])
    half = (grid[1] - grid[0]) / 2
    return np.asarray((np.interp(grid + half, time, passed) - np.interp(grid - half, time, passed)) / (2 * half))


def _speed_by_truth(tracks: Mapping[str, Any]) -> tuple[Array, Array]:
    """Return times and forward speeds by motion capture, of intervals one after the other."""
    time = tracks["truth_time"]
    if len(time) < 3:
        return np.zeros(0), np.zeros(0)
    ends = np.arange(time[0], time[-1], INTERVAL)
    middle, place = 0.5 * (ends[1:] + ends[:-1]), np.interp(ends, time, tracks["truth"])
    yaw = np.interp(middle, time, np.unwrap(tracks["truth_yaw"]))
    return middle, (np.diff(place) * np.exp(-1j * yaw)).real / INTERVAL


class Constants(NamedTuple):
    """Constants of the model, with standard errors."""

    x: Array  # (K,) of `KINDS`
    error: Array  # (K,)
    dead: tuple[float, float]  # bounds of the dead band, m/s
    rest: tuple[Array, ...]  # what is left of each series


def constants_of(response: Response, given: Array, dead: float) -> Constants:
    """Return the constants by least squares, from given ones."""
    reached, starts = response.limits(), []
    for share in (None, 1.0, 0.6):  # a limit that is not reached gives no slope: begin at limits that are
        x = given.copy()
        if share is not None:
            x[LIMITS] = np.minimum(x[LIMITS], share * reached)
        starts.append(_fitted(response, given, x, dead, 1))
    x = min(starts, key=lambda found: found[0])[1]
    _, x, J, r, free, bounds = _fitted(response, given, x, dead, PASSES)
    prior = np.array([kind.prior for kind in KINDS])
    stretch = (np.concatenate([time for time, _ in response.series]) / STRETCH).astype(int)
    score = np.stack([np.bincount(stretch, column * r) for column in J.T], axis=-1)
    S = J.T @ J + np.diag(prior[free] ** -2)
    error = np.zeros(len(x))
    error[free] = np.sqrt(sandwich(S, score, prior[free]).diagonal())
    rest = np.split(response.rows(x[None], np.mean(bounds, keepdims=True))[0], response.ends)
    return Constants(x, error, bounds, tuple(rest))


def _fitted(response: Response, given: Array, x: Array, dead: float, passes: int) -> tuple[Any, ...]:
    """Return cost, constants, derivatives, residuals, free constants, and bounds of the dead band."""
    prior = np.array([kind.prior for kind in KINDS])
    free = np.array([kind.name != "fake.wheel_scale" or len(response.series[2][0]) > 0 for kind in KINDS])
    least = np.array([-np.inf if kind.name in SIGNED else 1e-3 for kind in KINDS])
    steps = np.array([kind.step for kind in KINDS])[free]
    lowest, highest = 0.0, dead

    def full(part: Array) -> Array:
        whole = np.tile(given, (*part.shape[:-1], 1))
        whole[..., free] = part
        return whole

    for _ in range(passes):
        w = response.weights(response.rows(x[None], np.array([dead]))[0])

        def residual(part: Array, w: Array = w, dead: float = dead) -> Array:
            return np.append(w * response.rows(full(part[None]), np.array([dead]))[0], (part - given[free]) / prior[free])

        def slopes(part: Array, w: Array = w, dead: float = dead) -> Array:
            sets = np.concatenate([part[None], part + np.diag(steps)])
            rows = w * response.rows(full(sets), np.full(len(sets), dead))
            return np.concatenate([(rows[1:] - rows[0]).T / steps, np.diag(1.0 / prior[free])])

        found = least_squares(
            residual, np.maximum(x, least)[free], slopes, bounds=(least[free], np.inf), x_scale=prior[free], max_nfev=15
        )
        x = full(found.x)
        dead, lowest, highest = _dead_band(response, x, w)
    rows = len(w)
    return found.cost, x, found.jac[:rows], found.fun[:rows], free, (lowest, highest)


def _dead_band(response: Response, x: Array, w: Array) -> tuple[float, float, float]:
    """Return the dead band of the least cost and its bounds, m/s."""
    steps = np.unique(np.append(0.0, np.abs(x[1] * response.told[:, 0]).round(6)))
    low, high = 0, len(steps) - 1
    while True:
        picked = np.unique(np.linspace(low, high, TRIED).astype(int))
        edges = steps[picked]
        tried = 0.5 * (edges[1:] + edges[:-1])
        cost = 0.5 * ((w * response.rows(np.tile(x, (len(tried), 1)), tried)) ** 2).sum(axis=-1)
        good = np.flatnonzero(cost < cost.min() + SURE)
        if len(picked) == high - low + 1:
            return float(tried[np.argmin(cost)]), float(edges[good[0]]), float(edges[good[-1] + 1])
        low, high = int(picked[max(good[0] - 1, 0)]), int(picked[min(good[-1] + 2, len(picked) - 1)])
