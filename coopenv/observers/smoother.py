"""Robust smoothers over the poses of all vehicles: the upper reference.

Source: Dellaert and Kaess, Factor graphs for robot perception, Foundations and Trends in Robotics 6, 2017. It is
Gauss-Newton on the factor graph (frame_graph.py). In the order of time the normal equations are block tridiagonal, so
that a banded Cholesky factor L solves them. The last diagonal block of L is the factor of the information about the
last poses by all measurements: a marginal prior, from which later steps start (Kaess et al., iSAM2: incremental
smoothing and mapping using the Bayes tree, International Journal of Robotics Research 31(2), 2012).

At each tick the new frame alone is estimated, from the marginal of the one before. Every tenth of a second a
Gauss-Newton step moves the last half second. The whole-window smoother also moves all frames whenever their number has
grown by a quarter. `centralised` linearises each bearing once, at an estimate that depends on its noise. Smoothers
linearise it again when later measurements have improved the estimate, which matters where geometry is weak.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray
from scipy.linalg import cholesky_banded, solve_triangular
from scipy.linalg.lapack import dtbtrs

from coopenv.base.errors import CoopenvError
from coopenv.estimation.compiled import MATRICES, MATRIX, TARGET, WHOLE, compiled
from coopenv.estimation.poses import Array
from coopenv.observers.contract import Tick
from coopenv.observers.correction import PLACES
from coopenv.observers.frame_graph import (
    SEEN,
    STACK,
    VEHICLES,
    Bearings,
    GraphEstimator,
    Vehicles,
    motion,
    pair_information,
)
from coopenv.observers.uncertain_pose import LEFT, recentring

OTHERS = types.Array(types.float64, 5, "A", readonly=True)
LAG = 0.5  # s that are linearised anew
STEP_PERIOD = 0.1  # s between steps over the lag
GROWTH = 1.25  # of the number of frames, until the whole window is linearised anew


class Marginal(NamedTuple):
    """Information about the poses at a frame by all measurements up to it."""

    frame: int
    information: Array  # (6N, 6N)
    mean: Array  # (6N,) error about the poses of the frame


class Solution(NamedTuple):
    """Gauss-Newton step over the frames from one on."""

    first: int  # frame
    dx: Array  # (F, N, 6)
    L: Array  # (12N, 6NF) banded Cholesky factor of the information, lower form
    y: Array  # (6NF,) with L y = information times error
    seen: Array  # (N, 2) bearings of each vehicle, and how many do not fit

    def factor(self) -> Array:
        """Return the Cholesky factor (6N, 6N) of the marginal information at the last frame."""
        size = len(self.L) // 2
        rows, columns = np.tril_indices(size)
        block = np.zeros((size, size))
        block[rows, columns] = self.L[rows - columns, columns - size]
        return block

    def marginal(self) -> Marginal:
        """Return the marginal at the last frame, about its poses before the step."""
        block = self.factor()
        mean = solve_triangular(block, self.y[-len(block) :], lower=True, trans=1, check_finite=False)
        return Marginal(self.first + len(self.dx) - 1, block.dot(block.T), mean)


class FixedLagSmoother(GraphEstimator):
    """Robust smoother of all vehicles over the last half second.

    Older frames are marginalised, at the poses at which they were linearised last.
    """

    whole = False

    def begin(self, P: Array) -> None:
        """Start at the first frame."""
        N = len(P)
        information = np.zeros((N, 6, N, 6))
        information[np.arange(N), :, np.arange(N)] = np.linalg.inv(P)
        self.start = Marginal(0, information.reshape(6 * N, 6 * N), np.zeros(6 * N))
        self.anchor = self.last = self.start
        self.step_time, self.next_whole = 0.0, 2.0

    def correct(self, ticks: Sequence[Tick]) -> Array:
        """Estimate the new frame from the marginal of the one before; take a step over the lag when it is due."""
        graph, N = self.graph, len(ticks)
        solution = self.solve(self.last)
        last = graph.frames - 1
        block, dx = solution.factor(), solution.dx[-1]
        graph.move(last, dx[None])
        self.last = Marginal(last, block.dot(block.T), np.zeros(6 * N))
        if ticks[0].time - self.step_time > STEP_PERIOD - 0.5 * ticks[0].dt:
            self.step_time = ticks[0].time
            block, dx = self.smooth(round(LAG / max(ticks[0].dt, 1e-9)))
        inverse = solve_triangular(block, np.eye(6 * N), lower=True, check_finite=False)
        G = np.array([recentring(LEFT, e) for e in dx])
        columns = inverse.reshape(6 * N, N, 6).transpose(1, 2, 0)
        root = G @ columns
        return np.asarray(root @ root.transpose(0, 2, 1))

    def smooth(self, lag: int) -> tuple[Array, Array]:
        """Take one step over the last frames, or over all, and return the last factor (6N, 6N) and step (N, 6)."""
        graph = self.graph
        last, prior = graph.frames - 1, self.anchor
        if self.whole and graph.frames >= self.next_whole:
            prior, self.next_whole = self.start, GROWTH * graph.frames
        solution = self.solve(prior)
        block, dx = solution.factor(), solution.dx
        graph.move(prior.frame, dx)
        prior = prior._replace(mean=prior.mean - dx[0].ravel())  # about the moved poses
        if prior.frame == 0:
            self.start = prior
        anchor = max(prior.frame, last - lag)
        self.anchor = self.solve(prior, anchor).marginal() if anchor > prior.frame else prior
        self.last = Marginal(last, block.dot(block.T), np.zeros(len(block)))
        self.judge(solution.seen)
        return block, dx[-1]

    def solve(self, prior: Marginal, last: int | None = None) -> Solution:
        """Return the step over all frames from that of a prior up to `last` (None: the newest).

        A CoopenvError means that the measurements do not determine the poses.
        """
        g, first, end = self.graph, prior.frame, self.graph.frames if last is None else last + 1
        arguments: list[Any] = [getattr(g, name)[first:end] for name in g.FRAME_ARRAYS]
        arguments += [g.begin[first : end + 1] - g.begin[first + 1], g.bearings_of(first + 1, end), g.vehicles]
        arguments += g.other_pairs(first, end)
        bands, eta, seen = normal_equations(*arguments)
        size = 6 * len(g.markers)
        rows, columns = np.tril_indices(size)
        bands[rows - columns, columns] += prior.information[rows, columns]
        eta[:size] += prior.information.dot(prior.mean)
        try:
            L = cholesky_banded(bands, overwrite_ab=True, lower=True, check_finite=False)
        except np.linalg.LinAlgError:
            raise CoopenvError("smoother: the information is not positive definite") from None
        y = dtbtrs(L, eta, uplo="L")[0]
        dx = dtbtrs(L, y, uplo="L", trans="T")[0]
        return Solution(first, dx.reshape(end - first, -1, 6), L, y, seen)

    def trajectory(self) -> tuple[Array, Array]:
        """Return the smoothed orientations (K, N, 3, 3) and positions (K, N, 3), map, m, of all frames so far."""
        if self.whole:
            self.next_whole = 0.0
            self.smooth(self.graph.frames - 1 - self.anchor.frame)
        return self.graph.R[: self.graph.frames].copy(), self.graph.p[: self.graph.frames].copy()


class Smoother(FixedLagSmoother):
    """Robust smoother of all vehicles over the whole window.

    It is causal: an estimate depends on the measurements up to its tick.
    """

    whole = True


@compiled(TARGET, WHOLE, WHOLE, MATRIX)
def add_block(bands: Array, row: int, column: int, block: Array) -> None:
    """Add a block (6, 6) to a symmetric matrix in lower banded form, at a row and a column, its lower half alone."""
    for r in range(6):
        for c in range(6):
            if row + r >= column + c:
                bands[row + r - column - c, column + c] += block[r, c]


@compiled(STACK, MATRICES, STACK, MATRICES, MATRICES, PLACES, SEEN, VEHICLES, OTHERS, MATRICES)
def normal_equations(
    R: Array,
    p: Array,
    turn: Array,
    shift: Array,
    variance: Array,
    begin: NDArray[np.int64],
    bearings: Bearings,
    vehicles: Vehicles,
    others: Array,
    other_count: Array,
) -> tuple[Array, Array, Array]:
    """Return the information (12N, 6NF) of F frames in lower banded form, information times error, and the counts.

    The measurements of the first frame are not in it, nor is any prior. Arguments are the arrays of `FrameGraph` and
    the results of `other_pairs`.
    """
    F, N = len(R), len(R[0])
    size = 6 * N
    bands, eta, count = np.zeros((2 * size, size * F)), np.zeros(size * F), np.zeros((N, 2))
    for k in range(1, F):
        step = motion(R[k - 1], p[k - 1], R[k], p[k], turn[k], shift[k])
        for i in range(N):
            T, u = np.ascontiguousarray(step[i, :, :6]), step[i, :, 6]
            here, before = size * k + 6 * i, size * (k - 1) + 6 * i
            W = np.diag(1.0 / variance[k, i])
            WT = np.ascontiguousarray(-W.dot(T))
            add_block(bands, here, here, W)
            add_block(bands, here, before, WT)
            add_block(bands, before, before, -T.T.copy().dot(WT))
            Wu = u / variance[k, i]
            eta[here : here + 6] += Wu
            for c in range(6):
                for r in range(6):
                    eta[before + c] -= T[r, c] * Wu[r]
        of = slice(begin[k], begin[k + 1])
        observer, target, bearing, point = bearings
        L, seen = pair_information(R[k], p[k], (observer[of], target[of], bearing[of], point[of]), vehicles)
        if len(others):
            L, seen = L + others[k], seen + other_count[k]
        count += seen
        for i in range(N):
            for j in range(N):
                if L[i, j, 0, 0] + L[i, j, 1, 1] + L[i, j, 2, 2] + L[i, j, 3, 3] + L[i, j, 4, 4] + L[i, j, 5, 5] > 0.0:
                    a, b = size * k + 6 * i, size * k + 6 * j
                    add_block(bands, a, a, L[i, j, :6, :6])
                    eta[a : a + 6] += L[i, j, :6, 12]
                    if i != j:
                        add_block(bands, b, b, L[i, j, 6:, 6:12])
                        eta[b : b + 6] += L[i, j, 6:, 12]
                        if i > j:
                            add_block(bands, a, b, L[i, j, :6, 6:12])
                        else:
                            add_block(bands, b, a, L[i, j, 6:, :6])
    return bands, eta, count
