"""Gaussian belief propagation with robust factors over the last frames of all vehicles (Robot Web).

Source: Murai, Ortiz, Saeedi, Kelly and Davison, A Robot Web for distributed many-device localisation, arXiv 2202.03314.
Variables and factors are those of frame_graph.py. Every vehicle keeps its own poses in a sliding window. Messages are
information (6, 6) and information times error (6,), about the present poses:

- belief of a variable: the product of the messages from all its factors;
- variable to factor: the belief without the message of that factor (cavity);
- factor to variable: the factor times the other variable's cavity, marginalised over that variable (Schur complement).

When a pose moves by dx, the messages into it keep their information L, and L dx is subtracted from L times the error.
A factor between two vehicles is kept by the observer, which sends the message to the other vehicle. On trees the
beliefs are the exact marginals. In graphs with loops the means are those of least squares when they converge, and the
covariances are too small. The loss is dynamic covariance scaling (frame_graph.py).

Schedule: at each tick messages pass twice at the new frame; every tenth of a second they pass through the window
forward and backward. The odometry message from the last frame before the window is the prior of the window. In graphs
with loops it has too much information. Then the means of a sliding window are not those of the whole trajectory.

Here all vehicles are one joint estimator: the radio of a scenario brings messages from observed vehicles to observers
only, and the algorithm needs both directions. Lost and late messages are therefore not simulated.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import types

from coopenv.estimation.compiled import MATRICES, MATRIX, VECTOR, WHOLE, compiled, eliminated
from coopenv.estimation.poses import Array
from coopenv.observers.bearing_measurements import LEFT, recentring
from coopenv.observers.contract import Message, Tick
from coopenv.observers.frame_graph import GraphEstimator

WINDOW = 20  # frames
STEP_PERIOD = 0.1  # s between passes through the window
NUMBERS = 27  # of a message: the triangle of the information, and information times error
PASSES = 2  # at a new frame

BLOCKS, ROWS = types.Array(types.float64, 4, "C"), types.Array(types.float64, 3, "C")
PAIRS, PAIR_ROWS = types.Array(types.float64, 5, "C"), types.Array(types.float64, 4, "C")


class BeliefPropagation(GraphEstimator):
    """Gaussian belief propagation over the last frames, with robust factors.

    It counts the messages that vehicles exchange, which arrive without loss or delay.
    """

    def begin(self, P: Array) -> None:
        """Start at the first frame."""
        N = len(P)
        self.first, self.step_time = 0, 0.0  # first frame of the window
        self.counts = [np.zeros((N, 2))]
        # messages into the variables, by frame: from odometry before and after, and from factors between vehicles
        self.before, self.before_eta = np.linalg.inv(P)[None], np.zeros((1, N, 6))
        self.after, self.after_eta = np.zeros((1, N, 6, 6)), np.zeros((1, N, 6))
        self.pair, self.pair_eta = np.zeros((1, N, N, 12, 6)), np.zeros((1, N, N, 12))
        self.exchanged = np.zeros(N)

    NAMES = ("before", "before_eta", "after", "after_eta", "pair", "pair_eta")

    def correct(self, ticks: Sequence[Tick]) -> Array:
        """Pass messages at the new frame, and through the window when it is due."""
        for name in self.NAMES:
            values = getattr(self, name)
            setattr(self, name, np.concatenate([values, np.zeros_like(values[:1])]))
        self.counts.append(np.zeros((len(ticks), 2)))
        self.exchanged = np.zeros(len(ticks))
        L, mean = self.propagate(self.graph.frames - 1, PASSES)
        if ticks[0].time - self.step_time > STEP_PERIOD - 0.5 * ticks[0].dt:
            self.step_time = ticks[0].time
            self.forget(max(self.first, self.graph.frames - WINDOW))
            L, mean = self.propagate(self.first, 1)
            self.judge(np.sum(self.counts, axis=0))
        P = np.linalg.inv(L[-1])
        G = np.array([recentring(LEFT, e) for e in mean[-1]])
        P = G @ P @ np.swapaxes(G, 1, 2)
        return np.asarray(0.5 * (P + np.swapaxes(P, 1, 2)))

    def propagate(self, low: int, passes: int) -> tuple[Array, Array]:
        """Pass messages forward and backward over the frames from one on, and move their poses by the beliefs.

        Returns:
            Information (F, N, 6, 6) and means (F, N, 6) of these frames, about the poses before.
        """
        graph, high, N = self.graph, self.graph.frames, len(self.setups)
        frames = range(low, high)
        pairs, eta, counts = (
            np.array(part) for part in zip(*(graph.pairs(k, self.scaled) for k in frames), strict=True)
        )
        motion = [graph.odometry(k) if k else (np.zeros((N, 6, 6)), np.zeros((N, 6))) for k in frames]
        F, u = (np.array(part) for part in zip(*motion, strict=True))
        place = slice(max(low - 1 - self.first, 0), None)
        if low > self.first:  # the frame before gives its belief, and takes none
            pairs, eta, F, u = (np.concatenate([np.zeros_like(part[:1]), part]) for part in (pairs, eta, F, u))
            pairs[0], eta[0], _ = graph.pairs(low - 1, self.scaled)
        Q = graph.variance[high - len(pairs) : high]
        messages = [np.ascontiguousarray(getattr(self, name)[place]) for name in self.NAMES]
        arguments: list[Any] = [*messages, pairs, eta, F, u, Q, passes]
        L, mean = passed(*arguments)
        new = high - low
        for name, values in zip(self.NAMES, messages, strict=True):
            getattr(self, name)[place] = values
        L, mean = L[-new:], mean[-new:]
        graph.move(low, mean)
        for name in ("before", "after"):
            eta_of = getattr(self, f"{name}_eta")
            eta_of[-new:] -= (getattr(self, name)[-new:] @ mean[..., None])[..., 0]
        self.pair_eta[-new:, ..., :6] -= np.einsum("fijrc,fic->fijr", self.pair[-new:, ..., :6, :], mean)
        self.pair_eta[-new:, ..., 6:] -= np.einsum("fijrc,fjc->fijr", self.pair[-new:, ..., 6:, :], mean)
        self.counts[low - self.first :] = list(counts[-new:])
        linked = np.einsum("fijxx->fij", pairs[-new:, :, :, 6:, 6:]) > 0.0
        self.exchanged += 2.0 * passes * (linked.sum((0, 2)) + linked.sum((0, 1)))
        return L, mean

    def forget(self, first: int) -> None:
        """Let the window begin at a later frame."""
        for name in self.NAMES:
            setattr(self, name, getattr(self, name)[first - self.first :])
        self.counts = self.counts[first - self.first :]
        self.first = first

    def broadcast(self, ticks: Sequence[Tick]) -> list[Message]:
        """Return what each vehicle sent for this tick: its pose, and one message per factor, direction and pass."""
        k = self.graph.frames - 1
        return [
            Message(
                self.graph.p[k, i].copy(), self.graph.R[k, i].copy(), None, {"messages": np.zeros(NUMBERS * int(n))}
            )
            for i, n in enumerate(self.exchanged)
        ]


@compiled(BLOCKS, ROWS, BLOCKS, ROWS, PAIRS, PAIR_ROWS, PAIRS, PAIR_ROWS, WHOLE, WHOLE)
def belief(
    before: Array,
    before_eta: Array,
    after: Array,
    after_eta: Array,
    pair: Array,
    pair_eta: Array,
    factors: Array,
    factors_eta: Array,
    k: int,
    i: int,
) -> tuple[Array, Array]:
    """Return the information (6, 6) of variable (k, i) and information times error (6,)."""
    L = before[k, i] + after[k, i] + factors[k, i, i, :6, :6]
    eta = before_eta[k, i] + after_eta[k, i] + factors_eta[k, i, i, :6]
    for j in range(len(before[k])):
        if j != i:
            L = L + pair[k, i, j, :6] + pair[k, j, i, 6:]
            eta = eta + pair_eta[k, i, j, :6] + pair_eta[k, j, i, 6:]
    return L, eta


@compiled(MATRIX, VECTOR, MATRIX, VECTOR, WHOLE)
def factor_message(L: Array, eta: Array, cavity: Array, cavity_eta: Array, to: int) -> tuple[Array, Array]:
    """Return the message of a factor (12, 12), (12,) to its first (0) or second (6) variable, by the other's cavity."""
    of = 6 - to
    A = L[of : of + 6, of : of + 6] + cavity
    right = np.empty((6, 7))
    right[:, :6] = L[of : of + 6, to : to + 6]
    right[:, 6] = eta[of : of + 6] + cavity_eta
    solved = np.ascontiguousarray(eliminated(A, right))
    across = np.ascontiguousarray(L[to : to + 6, of : of + 6]).dot(solved)
    return L[to : to + 6, to : to + 6] - across[:, :6], eta[to : to + 6] - across[:, 6]


@compiled(MATRIX, VECTOR, VECTOR)
def odometry_factor(F: Array, u: Array, variance: Array) -> tuple[Array, Array]:
    """Return the factor (12, 12), (12,) of the errors at a frame and at the next one, of e' = F e + u + noise."""
    J = np.zeros((6, 12))
    J[:, :6] = -F
    for r in range(6):
        J[r, 6 + r] = 1.0
    WJ = J.copy()
    for r in range(6):
        WJ[r] = J[r] / variance[r]
    L, eta = J.T.copy().dot(WJ), np.zeros(12)
    for c in range(12):
        for r in range(6):
            eta[c] += WJ[r, c] * u[r]
    return L, eta


@compiled(BLOCKS, ROWS, BLOCKS, ROWS, PAIRS, PAIR_ROWS, PAIRS, PAIR_ROWS, BLOCKS, ROWS, MATRICES, WHOLE)
def passed(
    before: Array,
    before_eta: Array,
    after: Array,
    after_eta: Array,
    pair: Array,
    pair_eta: Array,
    factors: Array,
    factors_eta: Array,
    F: Array,
    u: Array,
    variance: Array,
    passes: int,
) -> tuple[Array, Array]:
    """Pass messages forward and backward over K frames of N vehicles; change the messages in place.

    Args:
        before: (K, N, 6, 6) messages of odometry from the frame before, and with it the prior of the first frame.
        before_eta: (K, N, 6) information times error.
        after: (K, N, 6, 6) messages of odometry from the frame after.
        after_eta: (K, N, 6).
        pair: (K, N, N, 12, 6) messages of factor (i, j) to i (first six rows) and to j.
        pair_eta: (K, N, N, 12).
        factors: (K, N, N, 12, 12) of `FrameGraph.pairs`.
        factors_eta: (K, N, N, 12).
        F: (K, N, 6, 6) of `FrameGraph.odometry`.
        u: (K, N, 6).
        variance: (K, N, 6) of odometry.
        passes: at each frame between the vehicles.

    Returns:
        Information (K, N, 6, 6) and means (K, N, 6) of the beliefs.
    """
    K, N = len(before), len(before[0])
    for step in range(2 * K):
        forward = step < K
        k = step if forward else 2 * K - 1 - step
        if forward and k > 0:
            for i in range(N):
                L, eta = odometry_factor(F[k, i], u[k, i], variance[k, i])
                C, c = belief(before, before_eta, after, after_eta, pair, pair_eta, factors, factors_eta, k - 1, i)
                before[k, i], before_eta[k, i] = factor_message(L, eta, C - after[k - 1, i], c - after_eta[k - 1, i], 6)
        for _ in range(passes):
            for i in range(N):
                for j in range(N):
                    if i == j or factors[k, i, j, 9, 9] + factors[k, i, j, 10, 10] + factors[k, i, j, 11, 11] <= 0.0:
                        continue
                    C, c = belief(before, before_eta, after, after_eta, pair, pair_eta, factors, factors_eta, k, i)
                    to, to_eta = factor_message(
                        factors[k, i, j], factors_eta[k, i, j], C - pair[k, i, j, :6], c - pair_eta[k, i, j, :6], 6
                    )
                    pair[k, i, j, 6:], pair_eta[k, i, j, 6:] = to, to_eta
                    C, c = belief(before, before_eta, after, after_eta, pair, pair_eta, factors, factors_eta, k, j)
                    to, to_eta = factor_message(
                        factors[k, i, j], factors_eta[k, i, j], C - pair[k, i, j, 6:], c - pair_eta[k, i, j, 6:], 0
                    )
                    pair[k, i, j, :6], pair_eta[k, i, j, :6] = to, to_eta
        if not forward and k > 0:
            for i in range(N):
                L, eta = odometry_factor(F[k, i], u[k, i], variance[k, i])
                C, c = belief(before, before_eta, after, after_eta, pair, pair_eta, factors, factors_eta, k, i)
                after[k - 1, i], after_eta[k - 1, i] = factor_message(L, eta, C - before[k, i], c - before_eta[k, i], 0)
    L, mean = np.empty((K, N, 6, 6)), np.empty((K, N, 6))
    for k in range(K):
        for i in range(N):
            C, c = belief(before, before_eta, after, after_eta, pair, pair_eta, factors, factors_eta, k, i)
            L[k, i] = C
            mean[k, i] = eliminated(C, c.reshape((6, 1)))[:, 0]
    return L, mean
