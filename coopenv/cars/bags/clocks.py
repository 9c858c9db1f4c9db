"""Offsets of clocks in a bag: by times of reception, robust against wrong stamps, and by the topics' measurements.

- By reception: the delay (received - stamp) of a topic is the offset of its clock and the time of transport. Its level
  is a low quantile over windows; a robust line through the windows gives offset and drift. A level that changes from
  one message to the next is a jump of the clock where the stamps are irregular, and not the times of reception.
- By content: topics of a car measure the same motion. Turns and distances by gyro, wheels and motion capture, and the
  bearings of landmarks, agree best at one offset between their stamps. It contains no time of transport.

Source of the line: Sen, Estimates of the regression coefficient based on Kendall's tau, Journal of the American
Statistical Association 63, 1968.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter, percentile_filter
from scipy.stats import theilslopes

from coopenv.cars.settings.profile import Role
from coopenv.estimation.poses import Array

Times = NDArray[np.int64]

OUTLYING = 50_000_000
"""Least deviation (ns) of a delay from its neighbours at which its stamp is wrong; at least five times their spread."""
WILD, NEAR = 10_000_000_000, 101  # ns between the middle of the delays near one, and a low one, that is no transport
STEADY = 25  # messages on both sides of a jump whose delays are compared
WINDOWS, LEAST = 20, 10  # number of windows, and of messages in one


@dataclass(frozen=True)
class Delay:
    """Delay of a topic's messages, (received - stamp), as a line; ns."""

    offset: int  # in the middle of the file
    drift: float  # per ns of reception
    middle: int
    jump: int = 0  # largest change of its level that is no drift; 0: none

    def at(self, received: int) -> int:
        """Return the delay at a time of reception, ns."""
        return self.offset + round(self.drift * (received - self.middle))


def outlying(stamps: Times, received: Times) -> NDArray[np.bool_]:
    """Return flags of wrong stamps (n,): ahead of their neighbours, or behind them and out of order."""
    delays = (received - stamps).astype(np.float64)
    size = min(NEAR, 2 * (len(delays) // 2) + 1)
    low, middle = (percentile_filter(delays, share, size=size, mode="mirror") for share in (20, 50))
    usual = np.where(middle - low > WILD, middle, low)
    spread = float(np.median(np.abs(delays - np.median(usual)))) if len(delays) else 0.0
    most = max(OUTLYING, 5.0 * min(spread, 20.0 * OUTLYING))
    wrong: NDArray[np.bool_] = delays < usual - most
    reached = np.maximum.accumulate(np.where(wrong, np.iinfo(np.int64).min, stamps))
    wrong |= (stamps < reached) & (delays > usual + 2.0 * most)
    return wrong


def jumps(stamps: Times, received: Times) -> dict[int, int]:
    """Return the jumps of a topic's clock: by the first message (n,) after it, ns by which stamps fall behind."""
    delays, found = (received - stamps).astype(np.float64), dict[int, int]()
    if len(delays) < 2 * STEADY:
        return found
    after = median_filter(delays, STEADY, origin=-(STEADY // 2), mode="nearest")
    before = median_filter(delays, STEADY, origin=STEADY // 2, mode="nearest")
    change = after - np.append(before[:1], before[:-1])  # of the levels on both sides of the begin of each message
    there = STEADY + np.flatnonzero(np.abs(change[STEADY:-STEADY]) > OUTLYING)
    for some in np.split(there, np.flatnonzero(np.diff(there) > 1) + 1) if len(there) else ():
        best = int(some[np.argmax(np.abs(change[some]))])
        low, high = delays[max(best - STEADY, 0) : best], delays[best : best + STEADY]
        step = float(np.median(high) - np.median(low))
        near = np.arange(max(best - STEADY, 1), min(best + STEADY, len(delays)))
        upper = np.sign(step) * (delays[near] - np.median(low) - step / 2) > 0.0
        k = int(near[np.argmin(np.cumsum(upper) - upper + np.cumsum(~upper[::-1])[::-1])])
        usual = float(np.median(np.diff(stamps)))
        irregular = [abs(float(times[k] - times[k - 1]) - usual) for times in (stamps, received)]
        if abs(step) > OUTLYING and irregular[0] > irregular[1]:
            found[k] = round(step)
    return found


def delay_of(stamps: Times, received: Times) -> Delay:
    """Return the delay of a topic by its messages (n,), n > 0, none of them outlying."""
    delays, middle = received - stamps, int(received[0] + received[-1]) // 2
    parts = np.array_split(np.arange(len(delays)), max(1, min(WINDOWS, len(delays) // LEAST)))
    low = np.array([np.sort(delays[part])[len(part) // 20] for part in parts])
    at = np.array([float(np.median(received[part] - middle)) for part in parts])
    if len(parts) < LEAST or np.ptp(at) == 0.0:
        return Delay(int(low.min()), 0.0, middle)
    level = (low - low[0]).astype(np.float64)
    slope, _, least, most = theilslopes(level, at)
    drift = float(slope) if least * most > 0.0 else 0.0
    apart = np.abs(level - drift * at - np.median(level - drift * at)) > OUTLYING
    if apart.mean() > 0.2:
        return Delay(int(low.min()), 0.0, middle, int(np.ptp(low)))
    return Delay(round(float(np.quantile(level - drift * at, 0.2))) + int(low[0]), drift, middle)


def checked(stamps: Times, received: Times) -> tuple[NDArray[np.bool_], Delay | None]:
    """Return flags of wrong stamps (n,), 0 for none, and the delay by the others; None: there are none."""
    wrong = np.zeros(len(stamps), bool)
    if not (given := stamps != 0).any():
        return wrong, None
    wrong[given] = outlying(stamps[given], received[given])
    return wrong, delay_of(stamps[given & ~wrong], received[given & ~wrong])


HOLE = 0.25  # s between two messages over which nothing is compared
INTERVAL = 0.4  # s over which turns and distances are compared
SEARCHED, STEP = 1.0, 0.02
"""Search range of an offset to both sides, and step of the search, s."""
THINNED = 1_000  # elements that are enough for the search
BLOCK = 2.0  # s within which errors are taken as dependent
SURE = 4.0  # standard errors above which an offset counts
FLOOR, PARALLAX = 0.001, 0.015
"""s, least standard errors: of interpolation, and of turns by bearings, to which the translation adds."""
UNEXPLAINED = 0.3  # largest share of the variance at a wrong offset that may remain at the right one
CUT = 3.0  # times the 90 % quantile of residuals; larger ones are outliers
FEWEST, MOST = 50, 20_000  # elements compared
ABSURD = 0.1  # rad between bearings and poses, with which no camera or map is right


@dataclass(frozen=True)
class Lead:
    """Offset between the stamps of two topics by their measurements."""

    seconds: float  # by which the stamps of the first are early
    error: float  # its standard error
    first: str = ""  # role of the first
    reference: str = ""  # and of the second

    def exceeds(self, tolerance: float) -> bool:
        """Return whether it is well larger than a tolerance, s, and than its error allows."""
        return abs(self.seconds) > max(1.5 * tolerance, SURE * self.error)

    def __str__(self) -> str:
        """Return the offset in ms, with its standard error in brackets."""
        ahead = "leads" if self.seconds > 0.0 else "lags behind"
        return f"{self.first} {ahead} {self.reference} by {written(abs(self.seconds), self.error)} ms"


def written(seconds: float, error: float) -> str:
    """Return a time in ms, with its standard error in brackets."""
    return f"{1e3 * seconds:.0f}({max(1.0, 1e3 * error):.0f})"


Leads = Mapping[str, Lead]  # by topic


class SampledSignal:
    """A cumulated signal of time: heading, distance or pose; there is none within holes."""

    def __init__(self, times: Array, values: NDArray[Any]) -> None:
        """Take increasing times (n,), s, and values (n,) or (n, k); planar ones, complex, count as two."""
        values = np.column_stack([values.real, values.imag]) if np.iscomplexobj(values) else values
        self.times, self.values = times, values.reshape(len(times), -1)
        ends = np.flatnonzero(np.diff(times) > HOLE)
        self._from, self._to = times[ends], times[ends + 1]

    @classmethod
    def of_rates(cls, times: Array, rates: NDArray[Any]) -> "SampledSignal":
        """Return the integral of rates (n,)."""
        return cls(times, np.concatenate([[0.0], np.cumsum(np.diff(times) * (rates[1:] + rates[:-1]) / 2)]))

    def over(self, begin: Array, end: Array, *, level: bool = False) -> Array:
        """Return the changes (m, k) between times (m,), NaN across holes; `level`: the values at the ends."""
        first, last = (
            np.array([np.interp(t, self.times, v, np.nan, np.nan) for v in self.values.T]).T for t in (begin, end)
        )
        change: Array = last if level else last - first
        change[np.searchsorted(self._from, end) > np.searchsorted(self._to, begin, side="right")] = np.nan
        return change


Residual = Callable[[float, slice], tuple[Array, Array]]
"""Returns at an offset in s, of some of the elements, a difference (n,), and what explains it up to factors (n, p).

NaN where there is none.
"""


def fit(e: Array, N: Array, w: Array | None = None, *, scaled: bool = False) -> tuple[Array, Array]:
    """Return the residual of e (n,) by N (n, p), and weights (n,), 0 or 1, without outliers unless given.

    With `scaled`, the first factor is not negative.
    """
    there = np.isfinite(e) & np.isfinite(N).all(axis=-1)
    e, N = np.where(there, e, 0.0), np.where(there[:, None], N, 0.0)
    weights = there.astype(np.float64) if w is None else there * w
    for _ in range(3 if w is None else 1):
        factors = np.linalg.lstsq(N * weights[:, None], e * weights, rcond=None)[0]
        if scaled and factors[0] < 0.0:
            factors = np.array([0.0, (e * weights).sum() / max(1.0, weights.sum())])
        rest = np.where(there, e - N @ factors, 0.0)
        if w is None and there.any():
            weights = (there & (np.abs(rest) <= CUT * _upper(np.abs(rest[there])) + 1e-9)).astype(np.float64)
    return rest, weights


def _upper(values: Array) -> float:
    """Return the quantile 0.9 of values (n,); `np.quantile` takes ten times as long for some hundreds of them."""
    place = 0.9 * (len(values) - 1)
    low = int(place)
    first, last = np.partition(values, (low, min(low + 1, len(values) - 1)))[low : low + 2][[0, -1]]
    return float(first + (place - low) * (last - first))


def lead_by(residual: Residual, times: Array, most: float, least: float, *, scaled: bool = False) -> Lead | None:
    """Return the offset at which a residual, of elements at times (n,), is smallest; None: no clear minimum.

    There is none either if its root mean square is above `most`. `least` is added to the error; `scaled` as in `fit`.
    """
    if len(times) < FEWEST:
        return None
    rows, tried = slice(None, None, 1 + len(times) // THINNED), np.arange(-SEARCHED, SEARCHED + STEP / 2, STEP)
    given = [residual(offset, rows) for offset in tried]
    # Costs of different elements cannot be compared: only those count for which there is a value at every offset.
    if (common := _common(given)).sum() < FEWEST:
        return None

    def cost(difference: Array, explained: Array) -> float:
        rest, w = fit(np.where(common, difference, np.nan), explained, scaled=scaled)
        return float((w * rest**2).sum() / w.sum()) if w.sum() >= FEWEST else np.inf

    costs = _refined(np.array([cost(*each) for each in given]))
    best, known = int(np.argmin(costs)), costs[np.isfinite(costs)]
    if abs(tried[best]) > SEARCHED - STEP / 2 or len(known) < len(tried) / 2:
        return None
    if costs[best] > min(UNEXPLAINED * known.max(), most**2):
        return None
    blocks = max(1.0, float(np.ptp(times)) / BLOCK)
    if np.ptp(tried[costs <= costs[best] * math.exp(SURE**2 / blocks)]) > SEARCHED:  # by the ratio of likelihoods
        return None  # as of an even speed: nearly any offset is possible
    offset, h, every = float(tried[best]), STEP / 4, slice(None)
    common = _common([residual(offset + k * STEP, every) for k in (-2, -1, 0, 1, 2)])

    def compared(offset: float) -> tuple[Array, Array]:
        difference, explained = residual(offset, every)
        return np.where(common, difference, np.nan), explained

    for _ in range(5):
        rest, w = fit(*compared(offset))
        slope = (fit(*compared(offset + h), w)[0] - fit(*compared(offset - h), w)[0]) / (2 * h)
        information = float((w * slope**2).sum())
        if information <= 0.0:
            return None
        offset -= float(np.clip((w * slope * rest).sum() / information, -STEP, STEP))
    sums = np.bincount(((times - times.min()) / BLOCK).astype(int), w * slope * rest)
    return Lead(offset, float(np.hypot(np.sqrt((sums**2).sum()) / information, least)))


def _refined(costs: Array) -> Array:
    """Return costs at even offsets, (n,): at a minimum, that of the parabola through it and its neighbours.

    Motion that nearly repeats itself has minima a period apart, which are narrower than a step.
    """
    left, middle, right = costs[:-2], costs[1:-1], costs[2:]
    with np.errstate(invalid="ignore"):
        lower = (right - left) ** 2 / np.maximum(8.0 * (left + right - 2.0 * middle), 1e-300)
        lowest = (middle <= left) & (middle <= right) & np.isfinite(left + right)
    return np.concatenate([costs[:1], np.where(lowest, np.maximum(middle - lower, 0.0), middle), costs[-1:]])


def _common(given: Sequence[tuple[Array, Array]]) -> NDArray[np.bool_]:
    """Return of which elements (n,) there is a value at every offset."""
    return np.asarray(np.logical_and.reduce([np.isfinite(np.column_stack(each)).all(axis=1) for each in given]))


def lead_of_motion(signal: SampledSignal, reference: SampledSignal, least: float = FLOOR) -> Lead | None:
    """Return the lead of the stamps of turns or distances, by another source of the same."""
    span = reference.times[-1] - reference.times[0]
    begin = np.arange(reference.times[0], reference.times[-1] - INTERVAL, max(STEP, span / MOST))
    end, one = begin + INTERVAL, np.ones((len(begin), 1))
    change = reference.over(begin, end)[:, 0]

    def residual(offset: float, rows: slice) -> tuple[Array, Array]:
        moved = signal.over(begin[rows] - offset, end[rows] - offset)
        return change[rows], np.concatenate([moved, one[rows]], axis=-1)

    return lead_by(residual, begin, np.inf, least, scaled=True)


def lead_of_bearings(times: Array, azimuths: Array, targets: Array, camera: Array, path: SampledSignal) -> Lead | None:
    """Return the lead of the stamps of bearings, by the known path (x, y, heading) of the car.

    They are (n,) times, s, azimuths in the body frame and (n, 2) targets in the map; the camera is at (2,) in the body.
    Wrong mountings and lenses look like an offset while the car turns, so their first-order effects are fitted with it:
    a shift of the camera, and a polynomial of the azimuth about its mean for orientation, focal length and distortion.
    """
    unit = np.exp(1j * azimuths)
    powers = np.vander(np.angle(unit * np.conj(unit.sum())), 4)

    def residual(offset: float, rows: slice) -> tuple[Array, Array]:
        when = times[rows] + offset
        x, y, heading = path.over(when, when, level=True).T
        away = targets[rows] - np.column_stack([x, y])
        ahead = (away[:, 0] + 1j * away[:, 1]) * np.exp(-1j * heading) - complex(*camera)
        shift = unit[rows] * (1.0 / np.abs(ahead))  # NaN beyond the path, without a warning
        return np.angle(ahead * np.conj(unit[rows])), np.column_stack([powers[rows], shift.real, shift.imag])

    return lead_by(residual, times, ABSURD, FLOOR)


def turn_of(times: Array, azimuths: Array, places: Array) -> SampledSignal | None:
    """Return the heading (n,) by the bearings of standing landmarks, as `lead_of_bearings` has them.

    Between two frames it changes by the median change of their azimuths; translation adds a little to that.
    """
    frames, at = np.unique(times, return_inverse=True)
    _, number = np.unique(places, axis=0, return_inverse=True)
    seen = np.full((len(frames), number.max(initial=0) + 1), np.nan)
    seen[at, number.ravel()] = azimuths
    steps = np.angle(np.exp(1j * np.diff(seen, axis=0)))
    common = np.isfinite(steps).any(axis=1)
    turned = np.zeros(len(steps))
    turned[common] = -np.nanmedian(steps[common], axis=1)
    kept = np.concatenate([[True], common])
    return SampledSignal(frames[kept], np.concatenate([[0.0], np.cumsum(turned)])[kept]) if common.any() else None


CAMERAS = (Role.DETECTIONS, Role.BEARINGS)
NO_CRYSTAL = 500e-6
"""s per s, drift above which a clock is none with a quartz crystal, whose errors are below 100e-6 from -40 to 85 C."""
