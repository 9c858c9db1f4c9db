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
from scipy.integrate import cumulative_trapezoid
from scipy.optimize import least_squares

from coopenv.base.errors import DataError
from coopenv.cars.calibration.batch import LEAST_PLACE, LOSS, by_stretch, deviation, standard_errors
from coopenv.cars.calibration.parameters import ParameterKind
from coopenv.estimation.poses import Array
from coopenv.estimation.validity import Mask
from coopenv.motions.command import first_order_lag
from coopenv.world.launch import kernel, launch, start_warp

GRID = 0.01  # s, longest step of the model
INTERVAL = 0.2  # s over which motion capture gives a speed
SETTLED = 1.0  # s after which commands before the bag no longer matter
LEAST_SECONDS = 10.0  # of commands
TRIED = 100  # dead bands in one evaluation
PASSES = 4  # of fit, weights and dead band
REACHED = 4.5  # cost by which a limit is better than none: three standard deviations
SURE = 2.0  # cost by which a dead band is worse than the best: two standard deviations

KINDS = (
    ParameterKind("fake.latency", "s", 0.2, 1e-4),
    ParameterKind("fake.speed_gain", "", 0.3, 1e-5),
    ParameterKind("fake.steering_gain", "", 0.3, 1e-5),
    ParameterKind("fake.steering_offset", "rad", 0.2, 1e-5),
    ParameterKind("fake.deceleration", "m/s^2", 3.0, 1e-4),
    ParameterKind("dynamics.max_acceleration", "m/s^2", 3.0, 1e-4),
    ParameterKind("dynamics.max_steering_rate", "rad/s", 5.0, 1e-4),
    ParameterKind("dynamics.max_speed", "m/s", 2.0, 1e-5),
    ParameterKind("dynamics.max_steering", "rad", 0.5, 1e-5),
    ParameterKind("dynamics.speed_time_constant", "s", 0.3, 1e-4),
    ParameterKind("dynamics.steering_time_constant", "s", 0.3, 1e-4),
    ParameterKind("fake.gyro_bias", "rad/s", 0.1, 1e-6),
    ParameterKind("fake.wheel_scale", "", 0.15, 1e-6),
)
NAMES = [kind.name.split(".")[1] for kind in KINDS]
LIMITS = slice(4, 9)
SIGNED = ("fake.steering_offset", "fake.gyro_bias", "fake.wheel_scale")
DEAD_BAND = "dynamics.dead_band"
PRIOR, STEPS = (np.array([getattr(kind, name) for kind in KINDS]) for name in ("prior", "step"))
LEAST = np.array([-np.inf if kind.name in SIGNED else 1e-3 for kind in KINDS])


def follow_commands(
    wanted: wp.array3d(dtype=wp.float64),
    lags: wp.array2d(dtype=wp.float64),
    start: wp.float64,
    steps: wp.array2d(dtype=wp.float64),
    reached: wp.array3d(dtype=wp.float64),
):
    """Follow wanted speeds and steering angles (P, T, 2) over steps (P, T), s.

    The columns of lags (P, 6) are lag of speed and steering, s, rates up, down and of steering, and the highest speed.
    """
    p = wp.tid()
    speed = start
    steering = wp.float64(0.0)
    for k in range(wanted.shape[1]):
        dt = steps[p, k]
        rate = lags[p, 2]
        if wp.abs(wanted[p, k, 0]) < wp.abs(speed):
            rate = lags[p, 3]
        speed = wp.clamp(first_order_lag(speed, wanted[p, k, 0], dt, lags[p, 0], rate), -lags[p, 5], lags[p, 5])
        steering = first_order_lag(steering, wanted[p, k, 1], dt, lags[p, 1], lags[p, 4])
        reached[p, k, 0] = speed
        reached[p, k, 1] = steering


class Response:
    """Measurements of a car under its commands, and their model."""

    def __init__(self, tracks: Mapping[str, Any], wheelbase: float, timeout: float, where: str) -> None:
        """Take tracks as of `tracks_of`, m, and s after which a command no longer counts. Raises DataError."""
        start_warp()
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
        parts = [np.insert(tracks[f"command_{name}"], late + 1, 0.0) for name in ("speed", "steering")]
        self.commands = np.stack(parts, axis=-1)  # (C, 2) m/s and rad
        self._grid = np.arange(time[0], time[0] + seconds, GRID)
        self.series = [
            self._kept(tracks["wheel_time"], tracks["wheel"].real),
            self._kept(tracks["gyro_time"], tracks["gyro"]),
            self._kept(*_speed_by_truth(tracks)),
        ]
        """Times and values of the speed of the wheels, the turn rate, and the speed by motion capture."""
        self.free = np.array([kind.name != "fake.wheel_scale" or len(self.series[2][0]) > 0 for kind in KINDS])
        """Constants that are estimated: the scale of the wheels needs motion capture."""
        self.ends = np.cumsum([len(time) for time, _ in self.series])[:-1]

    def _kept(self, time: Array, value: Array) -> tuple[Array, Array]:
        inside = (time > self._grid[0] + SETTLED) & (time < self._grid[-1])
        return time[inside], value[inside]

    def rows(self, x: Array, dead: Array) -> Array:
        """Return the residuals (P, R) of the model, for constants (P, K) and dead bands (P,), m/s."""
        grid, c = self._grid, dict(zip(NAMES, x.T, strict=True))
        edges = np.empty((len(x), len(grid) + len(self._when)))
        wanted = np.empty((len(x), edges.shape[1] - 1, 2))
        gains, most = np.stack([c["speed_gain"], c["steering_gain"]], axis=-1), c["max_steering"]
        for p, latency in enumerate(c["latency"]):
            begin = self._when + latency  # steps of the command are edges, so that none is within a step of the model
            edges[p] = np.sort(np.concatenate([grid, begin.clip(grid[0], grid[-1])]))
            row = np.searchsorted(begin, 0.5 * (edges[p, 1:] + edges[p, :-1]), side="right")
            v, angle = (np.concatenate([[[0.0, 0.0]], self.commands]) * gains[p])[row].T
            angle = (angle + c["steering_offset"][p]).clip(-most[p], most[p])
            wanted[p] = np.stack([np.where(np.abs(v) < dead[p], 0.0, v), angle], axis=-1)
        first = [c[name] for name in ("speed_time_constant", "steering_time_constant", "max_acceleration")]
        lags = np.stack([*first, c["deceleration"], c["max_steering_rate"], c["max_speed"]], axis=-1)
        reached = wp.zeros(wanted.shape, dtype=wp.float64, device="cpu")
        steps = np.diff(edges, axis=-1)
        arrays: list[Any] = [wp.array(part, dtype=wp.float64, device="cpu") for part in (wanted, lags, steps)]
        start = float(np.interp(grid[0], self._tracks["wheel_time"], self._tracks["wheel"].real))
        inputs = [*arrays[:2], start, arrays[2], reached]
        launch(kernel(follow_commands, "float64"), dim=len(x), inputs=inputs, device="cpu")
        (wheel, gyro, truth), found = self.series, []
        for (v, angle), bias, scale, at, step in zip(
            reached.numpy().transpose(0, 2, 1), c["gyro_bias"], c["wheel_scale"], edges[:, 1:], steps, strict=True
        ):
            turn = np.interp(gyro[0], at, v * np.tan(angle) / self._wheelbase) + bias
            way = np.cumsum(0.5 * (v + np.append(start, v[:-1])) * step)
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
        """Return (5,) the largest deceleration, acceleration, steering rate, speed and steering reached, SI units."""
        (time, _), (late, _), _ = self.series
        grid = np.arange(max(time[0], late[0]), min(time[-1], late[-1]), INTERVAL / 4)
        ways = (np.interp(grid, t, cumulative_trapezoid(value, t, initial=0.0)) for t, value in self.series[:2])
        v, turn = (np.diff(way) / (INTERVAL / 4) for way in ways)
        angle = np.arctan(self._wheelbase * turn / np.maximum(np.abs(v), 0.1))
        slope, bend = np.diff(np.abs(v)) / (INTERVAL / 4), np.abs(np.diff(angle)) / (INTERVAL / 4)
        return np.array([-slope.min(), slope.max(), np.quantile(bend, 0.95), np.abs(v).max(), np.abs(angle).max()])


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
    beyond: Mask  # (K,) limits that the drive has not reached
    dead: tuple[float, float]  # bounds of the dead band, m/s
    rest: list[Array]  # residuals of each series


class _Fit(NamedTuple):
    cost: float
    x: Array
    dead: float
    bounds: tuple[float, float]
    J: Array  # weighted derivatives (R, F) by the free constants
    r: Array  # weighted residuals (R,)


def constants_of(response: Response, given: Array, dead: float) -> Constants:
    """Return the constants by least squares, from given ones."""
    reached, starts = response.limits(), []
    for share in (10.0, 1.0, 0.6):  # a limit that is not reached gives no slope: begin at limits that are
        x = given.copy()
        x[LIMITS] = np.minimum(x[LIMITS], share * reached)
        starts.append(_fitted(response, given, x, dead, 1))
    fit = _fitted(response, given, min(starts, key=lambda start: start.cost).x, dead, PASSES)
    free, x, error = response.free, fit.x, np.zeros(len(KINDS))
    scores = by_stretch(np.concatenate([time for time, _ in response.series]), fit.J, fit.r)
    error[free] = standard_errors(fit.J.T @ fit.J + np.diag(PRIOR[free] ** -2), scores, PRIOR[free])
    without = np.tile(x, (1 + len(reached), 1))
    without[1:, LIMITS] *= 1.0 + 9.0 * np.eye(len(reached))
    rows = response.rows(without, np.full(len(without), fit.dead))
    cost = 0.5 * ((response.weights(rows[0]) * rows) ** 2).sum(axis=-1)
    beyond = np.zeros(len(x), dtype=bool)
    beyond[LIMITS] = cost[1:] - cost[0] < REACHED
    x[LIMITS] = np.where(beyond[LIMITS], np.maximum(given[LIMITS], reached), x[LIMITS])
    return Constants(x, np.where(beyond, PRIOR, error), beyond, fit.bounds, np.split(rows[0], response.ends))


def _fitted(response: Response, given: Array, x: Array, dead: float, passes: int) -> _Fit:
    """Return the fit from constants x and a dead band, which are improved in turn."""
    free, prior = response.free, PRIOR[response.free]
    least, steps = LEAST[free], np.diag(STEPS[free])
    bounds, found = (0.0, dead), None
    for _ in range(passes):
        w = response.weights(response.rows(x[None], np.array([dead]))[0])

        def weighted(parts: Array, w: Array = w, dead: float = dead) -> Array:
            sets = np.tile(given, (len(parts), 1))
            sets[:, free] = parts
            return np.asarray(w * response.rows(sets, np.full(len(sets), dead)))

        def residual(part: Array, weighted: Any = weighted) -> Array:
            return np.append(weighted(part[None])[0], (part - given[free]) / prior)

        def slopes(part: Array, weighted: Any = weighted) -> Array:
            first, *others = weighted(np.concatenate([part[None], part + steps]))
            return np.concatenate([(np.array(others) - first).T / STEPS[free], np.diag(1.0 / prior)])

        start = np.maximum(x[free], least)
        found = least_squares(residual, start, slopes, bounds=(least, np.inf), x_scale=prior, max_nfev=15)
        x = given.copy()
        x[free] = found.x
        dead, bounds = _dead_band(response, x, w)
    assert found is not None
    return _Fit(found.cost, x, dead, bounds, found.jac[: len(w)], found.fun[: len(w)])


def _dead_band(response: Response, x: Array, w: Array) -> tuple[float, tuple[float, float]]:
    """Return the dead band of the least cost and its bounds, m/s."""
    steps = np.unique(np.append(0.0, np.abs(x[NAMES.index("speed_gain")] * response.commands[:, 0]).round(6)))
    low, high = 0, len(steps) - 1
    while True:
        picked = np.unique(np.linspace(low, high, TRIED).astype(int))
        edges = steps[picked]
        tried = 0.5 * (edges[1:] + edges[:-1])
        cost = 0.5 * ((w * response.rows(np.tile(x, (len(tried), 1)), tried)) ** 2).sum(axis=-1)
        good = np.flatnonzero(cost < cost.min() + SURE)
        if len(picked) == high - low + 1:
            return float(tried[np.argmin(cost)]), (float(edges[good[0]]), float(edges[good[-1] + 1]))
        low, high = int(picked[max(good[0] - 1, 0)]), int(picked[min(good[-1] + 2, len(picked) - 1)])
