"""Factor graph of the poses of all vehicles, for the smoothers and for Gaussian belief propagation.

Source: Dellaert and Kaess, Factor graphs for robot perception, Foundations and Trends in Robotics 6, 2017. Variables
are the poses of all vehicles at every camera frame. Factors are the initial estimates, odometry and bearings, as in
uncertain_pose.py, frame.py and centralised.py. Every error is a left one: R = Rhat Exp(theta), p = phat + Rhat rho.

Frames cannot be combined to fewer: odometry is as precise over one frame as bearings are, so that its noise between two
variables is not negligible. Where vehicles follow each other in a lane, this decides about the range.

Robust loss: Agarwal, Tipaldi, Spinello, Stachniss and Burgard, Robust map optimization using dynamic covariance
scaling, ICRA 2013. The information of a bearing of normalised squared residual x is multiplied by s^2, where
s = min(1, 2 PHI / (PHI + x)). A vehicle of which most bearings would be scaled has a wrong pose. Its bearings count
fully until most of them fit. New bearings pass the gate of the other filters first (correction.py).
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from coopenv.estimation.compiled import (
    MATRICES,
    MATRIX,
    VECTOR,
    adjoint,
    compiled,
    cross_matrix,
    logarithm,
    product,
    transformed,
)
from coopenv.estimation.poses import Array, orthonormalise
from coopenv.observers.contract import Estimate, Message, Received, Setup, Tick
from coopenv.observers.correction import (
    LARGEST,
    LARGEST_OF,
    NO_CONSTANTS,
    NO_CROSSES,
    NO_PLACES,
    PLACES,
    InnovationGate,
    judged_frame,
)
from coopenv.observers.frame import CAMERA, measured_message, usable_measurements
from coopenv.observers.lasting_errors import LastingErrors
from coopenv.observers.linearisation import across, linearised, put_derivative
from coopenv.observers.uncertain_pose import LEFT, UncertainPose, increment, moved

LEAST_STD = 1e-6  # rad and m, of an odometry increment: without noise its information would be infinite
PHI = LARGEST  # squared residual at which the loss begins to differ from least squares
MOST_SCALED = 0.5  # share of a vehicle's bearings that may be scaled

SEEN = types.Tuple((PLACES, PLACES, MATRIX, MATRIX))
"""Bearings: vehicle of the camera (m,); target, -1: landmark (m,); body frame (m, 3); landmark's position (m, 3), m."""
VEHICLES = types.Tuple((MATRIX, MATRIX, VECTOR, types.Array(types.boolean, 1, "A", readonly=True)))
"""Cameras (N, 3), m, and markers (N, 3), m, in the body; variance (N,) of a bearing, rad^2; robust loss or not (N,)."""
Bearings = tuple[NDArray[np.int64], NDArray[np.int64], Array, Array]
Vehicles = tuple[Array, Array, Array, NDArray[np.bool_]]
STACK = types.Array(types.float64, 4, "A", readonly=True)


class OtherFactors(NamedTuple):
    """The measurements of one vehicle's sensors beside the camera at a frame, or of all where some have more noise."""

    vehicle: int
    tick: Tick  # without bearings if they are factors of their own
    ticks: tuple[Tick, ...]  # of all vehicles
    kept: NDArray[np.bool_]  # which of the usable measurements have passed the gate
    curvature: Array  # of these, see `ENTRY`


class FrameGraph:
    """Poses, odometry and bearings of N vehicles at K frames, in arrays that grow."""

    FRAME_ARRAYS = ("R", "p", "turn", "shift", "variance")

    def __init__(self, setups: Sequence[Setup], R: Array, p: Array) -> None:
        """Start with one frame at poses R (N, 3, 3) and p (N, 3), map, m."""
        N = len(p)
        self.landmarks = setups[0].landmarks
        self.markers = np.array([setup.marker for setup in setups], float)
        cameras, variance = [setup.lever_arm for setup in setups], [setup.noise.bearing_std**2 for setup in setups]
        self.vehicles: Vehicles = np.array(cameras, float), self.markers, np.array(variance), np.zeros(N, np.bool_)
        self.frames = 1
        self.R, self.p = R[None].copy(), p[None].copy()  # where factors are linearised
        self.turn, self.shift = np.zeros((1, N, 3, 3)), np.zeros((1, N, 3))  # odometry since the last frame, m
        self.variance = np.ones((1, N, 6))  # of it, rad^2 and m^2
        self.begin = np.zeros(2, np.int64)  # first bearing of each frame, and of the next one
        self.bearings: Bearings = np.zeros(1, np.int64), np.zeros(1, np.int64), np.zeros((1, 3)), np.zeros((1, 3))
        self.others: dict[int, list[OtherFactors]] = {}  # of other sensors, by frame

    def append(self, ticks: Sequence[Tick]) -> None:
        """Add a frame without bearings, at the poses that odometry predicts."""
        k = self.frames
        for name in self.FRAME_ARRAYS:
            setattr(self, name, grown(getattr(self, name), k + 1))
        self.begin = grown(self.begin, k + 2)
        for i, tick in enumerate(ticks):
            self.turn[k, i], self.shift[k, i] = increment(tick)
            self.variance[k, i] = tick.noise.odometry(tick.dt) + LEAST_STD**2
            R, p = self.R[k - 1, i], self.p[k - 1, i]
            self.R[k, i], self.p[k, i] = orthonormalise(R.dot(self.turn[k, i])), p + R.dot(self.shift[k, i])
        self.frames, self.begin[k + 1] = k + 1, self.begin[k]

    def add(self, vehicle: int, targets: NDArray[np.int64], bearings: Array, points: Array) -> None:
        """Add m bearings (m, 3) of a vehicle to the last frame; points (m, 3) of landmarks, map, m."""
        first = int(self.begin[self.frames])
        end = first + len(targets)
        observer, target, bearing, point = self.bearings
        self.bearings = grown(observer, end), grown(target, end), grown(bearing, end), grown(point, end)
        added: Any = vehicle, np.maximum(targets - self.landmarks, -1), bearings, points
        for values, new in zip(self.bearings, added, strict=True):
            values[first:end] = new
        self.begin[self.frames] = end

    def add_others(self, vehicle: int, tick: Tick, ticks: Sequence[Tick], kept: NDArray[np.bool_], more: Array) -> None:
        """Add measurements of a vehicle's tick to the last frame, see `OtherFactors`; `more` is their `curvature`."""
        self.others.setdefault(self.frames - 1, []).append(OtherFactors(vehicle, tick, tuple(ticks), kept, more))

    def reports(self, frame: int, ticks: Sequence[Tick], P: Array | None = None) -> dict[int, Received]:
        """Return what messages of all vehicles would state of a frame, by target; P (N, 6, 6): with covariances."""
        found = {}
        for j, (tick, marker) in enumerate(zip(ticks, self.markers, strict=True)):
            R, p = self.R[frame, j], self.p[frame, j]
            C = None if P is None else UncertainPose(LEFT, R, p, P[j]).marker_covariance(marker)
            velocity = R.dot(tick.velocity + np.cross(tick.angular_velocity, marker))
            found[self.landmarks + j] = Received(Message(p + R.dot(marker), R, C, {"velocity": velocity}), 0.0)
        return found

    def move(self, first: int, dx: Array) -> None:
        """Move the poses from a frame on by their errors (F, N, 6)."""
        moved_poses(self.R[first : first + len(dx)], self.p[first : first + len(dx)], dx)

    def bearings_of(self, first: int, end: int) -> Bearings:
        """Return the bearings of the frames from one on, up to another one."""
        of = slice(self.begin[first], self.begin[end])
        observer, target, bearing, point = self.bearings
        return observer[of], target[of], bearing[of], point[of]

    def pairs(self, frame: int) -> tuple[Array, Array]:
        """Return the information of the bearings of a frame.

        Returns:
            (N, N, 12, 13) information about the errors of observer and target, with information times error as the last
            column, and (N, 2) the bearings of each vehicle and how many of them do not fit. At [i, i] the first six
            rows are those of the bearings to landmarks.
        """
        seen = self.bearings_of(frame, frame + 1)
        information, count = pair_information(self.R[frame], self.p[frame], seen, self.vehicles)
        for factors in self.others.get(frame, ()):
            self.put_others(information, count, frame, factors)
        return information, count

    def other_pairs(self, first: int, end: int) -> tuple[Array, Array]:
        """Return (F, N, N, 12, 13) and (F, N, 2) what `pairs` returns of other sensors; empty without any."""
        N = len(self.markers)
        frames = range(first, end) if any(k in self.others for k in range(first, end)) else range(0)
        information, count = np.zeros((len(frames), N, N, 12, 13)), np.zeros((len(frames), N, 2))
        for n, frame in enumerate(frames):
            for factors in self.others.get(frame, ()):
                self.put_others(information[n], count[n], frame, factors)
        return information, count

    def put_others(self, information: Array, count: Array, frame: int, factors: "OtherFactors") -> None:
        """Add the information of a vehicle's sensors beside the camera to the result of `pairs`."""
        i, reports = factors.vehicle, self.reports(frame, factors.ticks)
        measured = usable_measurements(replace(factors.tick, messages=reports), weighed=False)
        if measured is None or not factors.kept.any():
            return
        measured = measured.only(factors.kept)
        measured.entries["curvature"] = factors.curvature
        pose = UncertainPose(LEFT, self.R[frame, i], self.p[frame, i], np.zeros((6, 6)))
        linear = linearised(pose, measured)
        weight = 1.0 / linear.variance
        squared = (linear.residual**2 * weight).sum(axis=1)
        largest = LARGEST_OF[linear.used.sum(axis=1)]
        count[i] += len(squared), (squared > largest).sum()
        if self.vehicles[3][i]:
            weight *= (np.minimum(1.0, 2.0 * largest / (largest + squared)) ** 2)[:, None]
        for n, target in enumerate(measured.targets.tolist()):
            j = target - self.landmarks
            J = np.zeros((len(linear.residual[n]), 13))
            J[:, :6], J[:, 12] = linear.H[n], linear.residual[n]
            if j >= 0:
                J[:, 6:12] = linear.by_target[n].dot(adjoint(np.eye(3), -self.markers[j]))
            information[i, j if j >= 0 else i] += J[:, :12].T.dot(weight[n][:, None] * J)

    def odometry(self, frame: int) -> Array:
        """Return [F u] (N, 6, 7): the error at a frame is F e + u + noise, of e (N, 6) at the frame before."""
        k = frame
        step: Array = motion(self.R[k - 1], self.p[k - 1], self.R[k], self.p[k], self.turn[k], self.shift[k])
        return step


def grown(values: NDArray[Any], length: int) -> NDArray[Any]:
    """Return an array of at least a length that begins with some values, themselves if there is room."""
    if len(values) >= length:
        return values
    return np.concatenate([values, np.zeros((2 * length - len(values), *values.shape[1:]), values.dtype)])


class GraphEstimator(ABC):
    """Base of joint estimators over a frame graph. Subclasses define `begin` and `correct`."""

    joint = True

    def __init__(self, setups: Sequence[Setup]) -> None:
        """Take the setups of all vehicles."""
        self.setups = tuple(setups)

    def reset(self, initial_poses: Sequence[tuple[Array, Array]], initial_covariances: Sequence[Array]) -> None:
        """Start with independent errors."""
        R, p = (np.array(values, float) for values in zip(*initial_poses, strict=True))
        self.graph = FrameGraph(self.setups, R, p)
        self.P = np.array(initial_covariances, float)  # (N, 6, 6) at the last tick
        self.gates, self.lasting = [InnovationGate() for _ in self.setups], [LastingErrors(s) for s in self.setups]
        for lasting in self.lasting:
            lasting.reset()
        self.sent = [Message() for _ in self.setups]
        self.begin(self.P)

    @abstractmethod
    def begin(self, P: Array) -> None:
        """Start at the first frame with covariances P (N, 6, 6)."""

    @abstractmethod
    def correct(self, ticks: Sequence[Tick]) -> Array:
        """Estimate the poses of the last frame, which is new: move it, and return the covariances (N, 6, 6)."""

    def update(self, ticks: Sequence[Tick]) -> list[Estimate]:
        """Append a tick of every vehicle and estimate the poses."""
        self.graph.append(ticks)
        for i, tick in enumerate(ticks):
            if tick.due:
                self.receive(i, tick, ticks)
        self.P = P = self.correct(ticks)
        self.sent = self.broadcast(ticks)
        R, p = self.graph.R[self.graph.frames - 1], self.graph.p[self.graph.frames - 1]
        return [Estimate(R[i].copy(), p[i].copy(), P[i].copy()) for i in range(len(ticks))]

    def receive(self, vehicle: int, tick: Tick, ticks: Sequence[Tick]) -> None:
        """Add the measurements of a vehicle that pass its gate; correlations between vehicles are neglected there."""
        graph, k = self.graph, self.graph.frames - 1
        reported = replace(tick, messages=graph.reports(k, ticks, self.P))
        if (measured := usable_measurements(reported)) is None:
            return
        R, p, lasting = graph.R[k, vehicle], graph.p[k, vehicle], self.lasting[vehicle]
        if lasting.counts:
            lasting.count(tick, measured, R, p)
        judgement = judged_frame(LEFT, R, p, self.P[vehicle], measured.frame, NO_CONSTANTS, NO_CROSSES, NO_PLACES)
        kept = self.gates[vehicle].passed(tick.time, judgement)
        if tick.bearing_age > 0.0 or lasting.counts:
            graph.add_others(vehicle, tick, ticks, kept, measured.entries["curvature"][kept])
            return
        bearings = measured.only(kept).of_camera()
        graph.add(vehicle, bearings.targets, bearings.bearings, bearings.positions)
        if len(measured.sensors) > 1:
            others, blind = measured.entries["sensor"] != CAMERA, replace(tick, valid=np.zeros_like(tick.valid))
            graph.add_others(vehicle, blind, ticks, kept[others], measured.entries["curvature"][others & kept])

    def broadcast(self, ticks: Sequence[Tick]) -> list[Message]:
        """Return the measurements of this tick, which every vehicle sends: odometry and bearings."""
        return [measured_message(tick) for tick in ticks]

    def messages(self) -> list[Message]:
        """Return the message of each vehicle for this tick."""
        return self.sent

    def judge(self, count: Array) -> None:
        """Apply the robust loss to the vehicles most of whose bearings fit, by the counts (N, 2) of some frames."""
        self.graph.vehicles = *self.graph.vehicles[:3], count[:, 1] <= MOST_SCALED * count[:, 0]


@compiled(types.Array(types.float64, 4, "A"), types.Array(types.float64, 3, "A"), MATRICES)
def moved_poses(R: Array, p: Array, dx: Array) -> None:
    """Move poses R (F, N, 3, 3) and p (F, N, 3) in place by their errors dx (F, N, 6)."""
    for k in range(len(R)):
        for i in range(len(R[k])):
            turned, shifted = moved(LEFT, R[k, i], p[k, i], dx[k, i])
            R[k, i], p[k, i] = 1.5 * turned - product(0.5 * turned, product(turned.T, turned)), shifted


@compiled(MATRICES, MATRIX, MATRICES, MATRIX, MATRICES, MATRIX)
def motion(before_R: Array, before_p: Array, R: Array, p: Array, turn: Array, shift: Array) -> Array:
    """Return [F u] of `FrameGraph.odometry`, without the Jacobian of the logarithm, which is 1 where u is small."""
    N = len(R)
    step = np.zeros((N, 6, 7))
    for i in range(N):
        E = product(R[i].T, before_R[i])
        S = product(E, cross_matrix(-shift[i]))
        for r in range(3):
            for c in range(3):
                step[i, r, c] = turn[i, c, r]
                step[i, r + 3, c] = S[r, c]
                step[i, r + 3, c + 3] = E[r, c]
        step[i, :3, 6] = logarithm(product(E, turn[i]))
        step[i, 3:, 6] = transformed(R[i].T, before_p[i] + transformed(before_R[i], shift[i]) - p[i])
    return step


@compiled(MATRICES, MATRIX, SEEN, VEHICLES)
def pair_information(R: Array, p: Array, seen: Bearings, vehicles: Vehicles) -> tuple[Array, Array]:
    """Return the result of `FrameGraph.pairs` from its arrays."""
    (observer, target, bearing, point), (cameras, markers, variance, scaled), N = seen, vehicles, len(R)
    information, count = np.zeros((N, N, 12, 13)), np.zeros((N, 2))
    J, row = np.zeros((2, 13)), np.zeros(6)  # derivatives, and the residual as the last column
    for n in range(len(observer)):
        i, j = observer[n], target[n]
        z = point[n].copy()
        if j >= 0:
            z = p[j] + transformed(R[j], markers[j])
        a = transformed(R[i].T, z - p[i])
        d = a - cameras[i]
        distance = max(math.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]), 1e-9)
        B = across(d[0] / distance, d[1] / distance, d[2] / distance)
        for k in range(2):
            put_derivative(row, B[k], a, 1.0 / distance)
            J[k, :6] = row
            J[k, 6:12] = 0.0
            if j >= 0:  # in the body of the target
                put_derivative(row, transformed(R[j].T, transformed(R[i], B[k])), markers[j], -1.0 / distance)
                J[k, 6:12] = row
            J[k, 12] = B[k, 0] * bearing[n, 0] + B[k, 1] * bearing[n, 1] + B[k, 2] * bearing[n, 2]
        squared = (J[0, 12] * J[0, 12] + J[1, 12] * J[1, 12]) / variance[i]
        ahead = d[0] * bearing[n, 0] + d[1] * bearing[n, 1] + d[2] * bearing[n, 2] > 0.0
        count[i, 0] += 1.0
        count[i, 1] += 0.0 if squared <= PHI and ahead else 1.0
        w = 1.0 / variance[i]
        if scaled[i]:
            s = min(1.0, 2.0 * PHI / (PHI + squared))
            w *= s * s if ahead else 0.0
        b = i if j < 0 else j
        for k in range(2):
            for x in range(12):
                for y in range(13):
                    information[i, b, x, y] += w * J[k, x] * J[k, y]
    return information, count
