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

from coopenv.estimation.compiled import MATRICES, MATRIX, VECTOR, WHOLE, compiled, eliminated, product
from coopenv.estimation.poses import Array
from coopenv.observers.contract import Message, Tick
from coopenv.observers.frame_graph import GraphEstimator
from coopenv.observers.uncertain_pose import LEFT, recentring

WINDOW = 20  # frames
STEP_PERIOD = 0.1  # s between passes through the window
NUMBERS = 27  # of a message: the triangle of the information, and information times error
PASSES = 2  # at a new frame

BLOCKS, PAIRS = (types.Array(types.float64, n, "C") for n in (4, 5))


class BeliefPropagation(GraphEstimator):
    """Gaussian belief propagation over the last frames, with robust factors.

    It counts the messages that vehicles exchange, which arrive without loss or delay.
    """

    def begin(self, P: Array) -> None:
        """Start at the first frame."""
        N = len(P)
        self.first, self.step_time = 0, 0.0  # first frame of the window
        self.counts = [np.zeros((N, 2))]
        # messages into the variables, by frame: from odometry before and after, and from bearings, see `passed`
        self.before, self.after = np.zeros((2, 1, N, 6, 7))
        self.before[0, :, :, :6] = np.linalg.inv(P)
        self.pair = np.zeros((1, N, N, 12, 7))
        self.exchanged = np.zeros(N)

    NAMES = ("before", "after", "pair")

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
        pairs, counts = (np.array(part) for part in zip(*(graph.pairs(k) for k in frames), strict=True))
        steps = np.array([graph.odometry(k) if k else np.zeros((N, 6, 7)) for k in frames])
        place = slice(max(low - 1 - self.first, 0), None)
        if low > self.first:  # the frame before gives its belief, and takes none
            pairs, steps = (np.concatenate([np.zeros_like(part[:1]), part]) for part in (pairs, steps))
            pairs[0], _ = graph.pairs(low - 1)
        Q = graph.variance[high - len(pairs) : high]
        messages = [np.ascontiguousarray(getattr(self, name)[place]) for name in self.NAMES]
        own = np.arange(N)
        messages[2][:, own, own, :6] = pairs[:, own, own, :6][..., [*range(6), 12]]
        arguments: list[Any] = [*messages, pairs, steps, Q, passes]
        L, mean = passed(*arguments)
        new = high - low
        for name, values in zip(self.NAMES, messages, strict=True):
            getattr(self, name)[place] = values
        L, mean = L[-new:], mean[-new:]
        graph.move(low, mean)
        pair = self.pair[-new:]
        into = [(self.before[-new:], mean), (self.after[-new:], mean)]
        into += [(pair[..., :6, :], mean[:, :, None]), (pair[..., 6:, :], mean[:, None])]
        for message, at in into:
            message[..., 6] -= (message[..., :6] @ at[..., None])[..., 0]
        self.counts[low - self.first :] = list(counts[-new:])
        linked = np.einsum("fijxx->fij", pairs[-new:, :, :, 6:, 6:12]) > 0.0
        self.exchanged += 2.0 * passes * (linked.sum((0, 2)) + linked.sum((0, 1)))
        return L, mean

    def forget(self, first: int) -> None:
        """Let the window begin at a later frame."""
        for name in self.NAMES:
            setattr(self, name, getattr(self, name)[first - self.first :])
        self.counts = self.counts[first - self.first :]
        self.first = first

    def broadcast(self, ticks: Sequence[Tick]) -> list[Message]:
        """Return each vehicle's messages for this tick: its pose, and a message per factor, direction and pass."""
        k = self.graph.frames - 1
        return [
            Message(
                self.graph.p[k, i].copy(), self.graph.R[k, i].copy(), None, {"messages": np.zeros(NUMBERS * int(n))}
            )
            for i, n in enumerate(self.exchanged)
        ]


@compiled(BLOCKS, BLOCKS, PAIRS, WHOLE, WHOLE)
def belief(before: Array, after: Array, pair: Array, k: int, i: int) -> Array:
    """Return the belief (6, 7) of variable (k, i) by its messages."""
    total: Array = before[k, i] + after[k, i]
    for j in range(len(before[k])):
        total = total + pair[k, i, j, :6] + pair[k, j, i, 6:]
    return total


@compiled(MATRIX, MATRIX, WHOLE)
def factor_message(factor: Array, cavity: Array, to: int) -> Array:
    """Return the message (6, 7) of a factor (12, 13) to its first (0) or second (6) variable, by the other's cavity."""
    of = 6 - to
    A = factor[of : of + 6, of : of + 6] + cavity[:, :6]
    right, message = cavity.copy(), np.empty((6, 7))
    right[:, :6] = factor[of : of + 6, to : to + 6]
    right[:, 6] += factor[of : of + 6, 12]
    message[:, :6] = factor[to : to + 6, to : to + 6]
    message[:, 6] = factor[to : to + 6, 12]
    return message - product(factor[to : to + 6, of : of + 6], eliminated(A, right))


@compiled(MATRIX, VECTOR)
def odometry_factor(step: Array, variance: Array) -> Array:
    """Return the factor (12, 13) of the errors at a frame and at the next one, of e' = F e + u + noise."""
    J = np.zeros((6, 13))
    for r in range(6):
        J[r, :6], J[r, 6 + r], J[r, 12] = -step[r, :6], 1.0, step[r, 6]
    WJ = J.copy()
    for r in range(6):
        WJ[r] = J[r] / variance[r]
    return product(J[:, :12].T, WJ)


@compiled(BLOCKS, BLOCKS, PAIRS, PAIRS, BLOCKS, MATRICES, WHOLE)
def passed(
    before: Array, after: Array, pair: Array, factors: Array, steps: Array, variance: Array, passes: int
) -> tuple[Array, Array]:
    """Pass messages forward and backward over K frames of N vehicles; change the messages in place.

    The last column of messages and factors is information times error.

    Args:
        before: (K, N, 6, 7) messages of odometry from the frame before, and with it the prior of the first frame.
        after: (K, N, 6, 7) messages of odometry from the frame after.
        pair: (K, N, N, 12, 7) messages of factor (i, j) to i (first six rows) and to j; of (i, i) by the landmarks.
        factors: (K, N, N, 12, 13) of `FrameGraph.pairs`.
        steps: (K, N, 6, 7) of `FrameGraph.odometry`.
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
                cavity = belief(before, after, pair, k - 1, i) - after[k - 1, i]
                before[k, i] = factor_message(odometry_factor(steps[k, i], variance[k, i]), cavity, 6)
        for _ in range(passes):
            for i in range(N):
                for j in range(N):
                    of = factors[k, i, j]
                    if i == j or of[9, 9] + of[10, 10] + of[11, 11] <= 0.0:
                        continue
                    pair[k, i, j, 6:] = factor_message(of, belief(before, after, pair, k, i) - pair[k, i, j, :6], 6)
                    pair[k, i, j, :6] = factor_message(of, belief(before, after, pair, k, j) - pair[k, i, j, 6:], 0)
        if not forward and k > 0:
            for i in range(N):
                cavity = belief(before, after, pair, k, i) - before[k, i]
                after[k - 1, i] = factor_message(odometry_factor(steps[k, i], variance[k, i]), cavity, 0)
    L, mean = np.empty((K, N, 6, 6)), np.empty((K, N, 6))
    for k in range(K):
        for i in range(N):
            total = belief(before, after, pair, k, i)
            L[k, i] = total[:, :6]
            mean[k, i] = eliminated(total[:, :6], total[:, 6:])[:, 0]
    return L, mean
