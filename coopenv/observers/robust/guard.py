"""The last guard of a vehicle's covariance in kernels: see coopenv/observers/guard.py, whose numbers these are.

It adds up innovations of bearings at the prediction, used and refused ones, by the slots of their sources. Excluded
sources and landmarks without a slot do not count.
"""

from typing import Any

import warp as wp

from coopenv.observers.guard import LENGTHS, MOST_DEVIATIONS, NORMAL_QUANTILE, WINDOW
from coopenv.observers.robust.linearisation import innovation_cross_covariance
from coopenv.observers.robust.memory import SOURCES, BearingFrame
from coopenv.world.warp_internals import device_function, subroutine

ROWS = 2  # of a bearing
COUNT = len(LENGTHS)
SHORT, LONG = LENGTHS


@wp.func
def share_without_largest(count: int):
    """Return the expected sum of all but the largest of squared sums, see `guard.share_without_largest`."""
    share = wp.float64(1.0)
    if count > 1:
        for n in range(1, count + 1):
            share -= wp.float64(1.0) / wp.float64(n * count)
    return share


@wp.func
def factor_of(total: wp.float64, expected: wp.float64, freedom: wp.float64):
    """Return the ratio of a total to its expectation if its chi-square test fails, else 1; see `guard.factor_of`."""
    f = wp.max(freedom, wp.float64(2.0))
    variance = wp.float64(2.0 / 9.0) / f
    root = wp.float64(1.0) - variance + wp.float64(NORMAL_QUANTILE) * wp.sqrt(variance)
    if total > expected * root * root * root:
        return total / expected
    return wp.float64(1.0)


@device_function
def add_innovation(memory: Any, world: int, i: int, n: int):
    """Add the innovation of a bearing to the sums of its source; a row that was not measured has residual 0."""
    q = memory.measurement[world, i, n].source
    noise = memory.measurement[world, i, n].noise
    S = innovation_cross_covariance(memory, world, i, n, n)
    residual = memory.measurement[world, i, n].residual
    sums = memory.source[world, i, q].guard
    for k in range(ROWS):
        if residual[k] != wp.float64(0.0):
            variance = noise + S[k, k]
            limit = wp.float64(MOST_DEVIATIONS)
            white = wp.float64(1.0)
            if memory.measurement[world, i, n].member > 0:
                white = noise / variance
            for length in range(COUNT):
                sums.innovation[length, k] += wp.clamp(residual[k] / wp.sqrt(variance), -limit, limit)
                sums.white[length, k] += white
                sums.lasting[length, k] += wp.sqrt(wp.float64(1.0) - white)
    memory.source[world, i, q].guard = sums


@device_function
def end_guard_block(memory: Any, world: int, i: int, length: int):
    """Add the blocks of all sources to the totals of a length, and begin the next ones."""
    total = wp.float64(0.0)
    most = wp.float64(0.0)
    rows = wp.float64(0.0)
    freedom = wp.float64(0.0)
    count = int(0)
    for q in range(SOURCES):
        sums = memory.source[world, i, q].guard
        squared = wp.float64(0.0)
        before = rows
        for k in range(ROWS):
            variance = sums.white[length, k] + sums.lasting[length, k] * sums.lasting[length, k]
            if variance > wp.float64(0.0):
                squared += sums.innovation[length, k] * sums.innovation[length, k] / variance
                freedom += sums.white[length, k] / variance
                rows += wp.float64(1.0)
            sums.innovation[length, k] = wp.float64(0.0)
            sums.white[length, k] = wp.float64(0.0)
            sums.lasting[length, k] = wp.float64(0.0)
        memory.source[world, i, q].guard = sums
        total += squared
        most = wp.max(most, squared)
        if rows > before:
            count += 1
    if count > 1:
        total -= most
    share = share_without_largest(count)
    totals = memory.belief[world, i].guard
    kept = wp.exp(-totals.time[length] / wp.float64(WINDOW))
    totals.time[length] = wp.float64(0.0)
    totals.squared[length] = kept * totals.squared[length] + total
    totals.expected[length] = kept * totals.expected[length] + share * rows
    totals.freedom[length] = kept * totals.freedom[length] + share * freedom
    totals.factor = wp.float64(1.0)
    for n in range(COUNT):
        totals.factor = wp.max(totals.factor, factor_of(totals.squared[n], totals.expected[n], totals.freedom[n]))
    memory.belief[world, i].guard = totals


@subroutine
def guard_covariance(frame: BearingFrame, memory: Any, world: int, i: int):
    """Add the innovations of a frame that the gate has judged, and end the blocks that are complete."""
    for n in range(frame.bearings):
        if memory.measurement[world, i, n].source >= 0 and memory.measurement[world, i, n].fits != 0:
            add_innovation(memory, world, i, n)
    for length in range(COUNT):
        totals = memory.belief[world, i].guard
        totals.time[length] += frame.period
        memory.belief[world, i].guard = totals
        if totals.time[length] >= wp.where(length == 0, wp.float64(SHORT), wp.float64(LONG)):
            end_guard_block(memory, world, i, length)
