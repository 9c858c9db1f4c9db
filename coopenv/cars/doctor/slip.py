"""Wheels that slip or spin for a while, beside which they measure the motion of motion capture.

The factor of the wheels is that of most intervals, or of two that are as common the one nearer to 1. Intervals with
another one that adjoin are an episode.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coopenv.cars.bags.clocks import SampledSignal
from coopenv.cars.doctor.finding import Diagnosis, Finding
from coopenv.cars.doctor.motion import LAGS, displacements
from coopenv.cars.doctor.relation import INTERVAL
from coopenv.cars.doctor.streams import MOVING, CarStreams
from coopenv.estimation.poses import Array

SHOWN, MARGIN = 4, 0.5
"""Episodes that are listed, and s around them that are left to motion capture."""
OFF, METRES = 0.2, 0.06
"""Share of the way over an interval, and m, by which wheels that slip are off."""
USUAL, COMMON = 0.08, 0.25
"""Relative difference of factors that are alike, and share of the intervals of a factor that may be the right one."""
MOST, FEWEST = 0.75, 6
"""Largest share of the intervals in episodes, and fewest intervals of one (0.6 s)."""
LEAST = 0.1  # m over an interval of which a factor is known
STEADY = 0.8
"""Share of the other intervals at least whose factor is the usual one."""


class Slipping(NamedTuple):
    """Wheels by the motion over intervals."""

    factor: float
    """That of most intervals."""
    factors: Array  # (n,) NaN: the car hardly moves
    off: NDArray[np.bool_]  # (n,) whether the wheels are off
    steady: float
    """Share of the other intervals that have the usual factor."""


def of_slip(car: CarStreams, place: SampledSignal, heading: SampledSignal) -> Iterator[Diagnosis]:
    """Yield that wheels slip in episodes, by a path of the car."""
    if (moved := displacements(car, place, heading)) is None:
        return
    found = [each for lag in (0.0, *LAGS) if (each := _slipping(moved.body, moved.driven(lag))) is not None]
    best = min(found, key=lambda each: float(each.off.mean()) - each.steady, default=None)
    if best is None or best.steady < STEADY or not (runs := [*_episodes(best.off)]):
        return
    times = [
        (float(moved.begin[first]) + 0.5 * INTERVAL, float(moved.begin[last]) + 0.5 * INTERVAL) for first, last in runs
    ]
    lasted, whole = sum(end - begin for begin, end in times), float(np.ptp(moved.begin)) + INTERVAL
    if lasted > MOST * whole:
        return
    slipped = np.concatenate([best.factors[first : last + 1] for first, last in runs])
    slipped = slipped[np.isfinite(slipped)]
    worst = float(slipped[np.argmax(np.abs(slipped - best.factor))]) if len(slipped) else np.inf
    listed = ", ".join(f"{begin:.1f} to {end:.1f} s" for begin, end in times[:SHOWN])
    more = f" and {len(times) - SHOWN} more" if len(times) > SHOWN else ""
    text = (
        f"the velocity of {car.name} slips for {lasted:.1f} s, {lasted / whole:.0%} of the drive, from {listed}{more}: "
    )
    text += f"the wheels measure up to {worst:.2g} times the motion by motion capture, and {best.factor:.3g} times else"

    def change(car: CarStreams) -> CarStreams:
        for begin, end in times:
            car = car.following_truth("wheel", begin - MARGIN, end + MARGIN)
        return car

    yield Diagnosis(Finding(car.topic(MOVING), text, lasted, car=car.name), change)


def _slipping(body: NDArray[np.complex128], driven: NDArray[np.complex128]) -> Slipping | None:
    """Return in which intervals (n,) wheels are off; None: the car hardly moves."""
    known = np.isfinite(body) & np.isfinite(driven)
    far = known & (np.abs(body) > LEAST)
    if far.sum() < FEWEST:
        return None
    factors = np.full(len(body), np.nan)
    factors[far] = (driven[far] / body[far]).real
    tried = np.quantile(factors[far], np.arange(0.05, 1.0, 0.05))
    alike = np.abs(factors[far, None] - tried) < USUAL * np.abs(tried)
    common = alike.mean(axis=0) >= min(COMMON, float(alike.mean(axis=0).max()))
    near = alike[:, int(np.argmin(np.where(common, np.abs(tried - 1.0), np.inf)))]
    factor = float(np.median(factors[far][near]))
    off = known & (np.abs(driven - factor * body) > np.maximum(OFF * abs(factor) * np.abs(body), METRES))
    others = np.abs(factors[far & ~off] - factor) < USUAL * abs(factor)
    return Slipping(factor, factors, off, float(others.mean()) if len(others) else 0.0)


def _episodes(off: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """Yield the first and last of intervals (n,) in a row that are off."""
    ends = np.flatnonzero(np.diff(np.concatenate([[False], off, [False]]).astype(int)))
    yield from ((a, b - 1) for a, b in zip(ends[::2].tolist(), ends[1::2].tolist(), strict=True) if b - a >= FEWEST)
