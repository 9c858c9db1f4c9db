"""The Schmidt filter with lasting errors as states and corrections of neighbours, for vehicles in space and robots.

Neighbours consider the pose alone, without the lasting errors behind it.

A measurement of a neighbour, with innovation v, would also correct the neighbour's estimate: by K v, which reduces its
covariance by K S K^T. The Schmidt filter leaves this out; here the message has it, and the neighbour corrects itself.
The error after an optimal correction is not correlated with v. So the cross-covariance of the two is the same whether
the neighbour's correction has arrived or is lost, and the neighbour takes it over from the message.

Source: Kia, Rounds and Martinez, Cooperative localization for mobile agents, IEEE Control Systems Magazine 36(2), 2016
(corrections are broadcast); Luft, Schubert, Roumeliotis and Burgard, Recursive decentralized localization for
multi-robot systems with asynchronous pairwise communication, IJRR 37(10), 2018 (cross-covariances with third vehicles
are approximate).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from coopenv.estimation.poses import Array
from coopenv.observers.contract import Message, Setup, Tick
from coopenv.observers.correction import halfway_gain
from coopenv.observers.frame import Frame, UsableMeasurements
from coopenv.observers.lasting_errors import EVERY
from coopenv.observers.schmidt_kalman import (
    Considered,
    ConsideredNeighbour,
    SchmidtKalman,
    bounded,
    considered_from,
    sent_cross_covariance,
)
from coopenv.observers.uncertain_pose import LEFT, UncertainPose, moved, recentring

REMEMBERED = 8  # own messages that a neighbour's correction may refer to


class SelfCalibrating(SchmidtKalman):
    """Schmidt filter that also estimates lasting errors of odometry and sensors, and that corrects neighbours.

    It sends what `schmidt_kalman` sends, and corrections of the neighbours that it has measured.
    """

    estimated = EVERY

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        self.me = setup.landmarks + setup.vehicle

    def reset(self, initial_pose: tuple[Array, Array], initial_covariance: Array) -> None:
        """Start at a pose, with lasting errors of zero."""
        self.since: dict[int, Array] = {}  # by number of an own message: derivative of the error by the marker's then
        self.corrections: dict[int, tuple[int, Array, Array]] = {}  # by target: number of its message, shift, reduction
        self.last: dict[int, Message] = {}  # by sender
        self.measured_at: dict[int, int] = {}  # by target: number of the first own message after its measurement
        super().reset(initial_pose, initial_covariance)

    def predict(self, tick: Tick) -> None:
        """Append the increment, then receive the messages that have come."""
        super().predict(tick)
        for target, received in tick.messages.items():
            if self.last.get(target) is not received.message:
                self.last[target] = received.message
                self.receive(target, received.message)

    def propagate_cross_covariances(self, A: Array, others: Sequence[int] | None = None) -> None:
        """Multiply the own error by A also since the last own messages."""
        super().propagate_cross_covariances(A, others)
        self.since = {number: A.dot(by_then) for number, by_then in self.since.items()}

    def message(self) -> Message:
        """Return the message of `schmidt_kalman`, the numbers of messages that it refers to, and the corrections."""
        report = super().message()
        by_pose = np.linalg.solve(self.P[:6, :6], self.P[:6]).T
        recent = [*self.since.items()][1 - REMEMBERED :]
        self.since = dict(recent)
        if self.guard.factor == 1.0:  # otherwise corrections are of a larger covariance than the own one
            self.since[self.number] = by_pose.dot(self.from_marker)
        numbers = np.array([self.neighbours[t].number for t in sorted(self.neighbours)], float)
        made = [[target, one[0], *one[1], *one[2].ravel()] for target, one in self.corrections.items()]
        self.corrections = {}
        extra = {"numbers": numbers, "corrections": np.array(made, float).reshape(-1, 44)}
        return Message(report.position, report.rotation, report.covariance, {**report.extra, **extra})

    @staticmethod
    def between(by_one: Array, by_other: Array) -> Array:
        """Return the cross-covariance (6, 6) of two neighbours from what the two have sent; both know it."""
        return (by_one + by_other.T) / 2 if by_one.any() and by_other.any() else by_one + by_other.T

    def receive(self, target: int, message: Message) -> None:
        """Take the report of a neighbour, and a correction that it has made of this vehicle."""
        before = self.neighbours.get(target)
        super().receive(target, message)
        now = self.neighbours.get(target)
        if now is None or (before is not None and before.number == now.number):
            return
        cross = self.taken_over(target, message)
        made = np.asarray(message.extra.get("corrections", ()))
        if made.ndim == 2 and made.shape[1:] == (44,) and made.dtype.kind == "f":
            for one in made[(made[:, 0] == self.me) & np.isfinite(made).all(axis=1)]:
                self.take_correction(int(one[1]), one[2:8], one[8:].reshape(6, 6))
        if cross is not None:
            now = self.neighbours[target]
            cross = bounded(cross, self.P, now.P)
            self.neighbours[target] = ConsideredNeighbour(now.number, now.P, cross)

    def taken_over(self, target: int, message: Message) -> Array | None:
        """Return the cross-covariance (6 + c, 6) with a sender by its message, None if there is no later one."""
        targets, numbers = (np.asarray(message.extra.get(name, ())) for name in ("targets", "numbers"))
        if targets.ndim != 1 or targets.shape != numbers.shape or self.me not in targets:
            return None
        number = float(numbers[targets == self.me][0])
        if number not in self.since or number < self.measured_at.get(target, 0):
            return None
        return np.asarray(self.since[int(number)].dot(sent_cross_covariance(message, self.me).T))

    def take_correction(self, number: int, shift: Array, reduced: Array) -> None:
        """Correct the own estimate by a neighbour's measurement of this vehicle.

        Args:
            number: of the own message that the neighbour has used.
            shift: (6,) of the marker's pose in that message.
            reduced: (6, 6) by how much its covariance is smaller.
        """
        if number not in self.since:
            return
        by_then, size = self.since[number], len(self.P)
        after = self.P - by_then.dot(reduced + reduced.T).dot(by_then.T) / 2
        if np.linalg.eigvalsh(after)[0] <= 0.0:
            return
        dx = by_then.dot(shift)
        recentred = np.eye(size)
        recentred[:6, :6] = recentring(LEFT, dx[:6])
        carried = recentred.dot(np.linalg.solve(self.P, after).T)
        self.P = recentred.dot(after).dot(recentred.T)
        self.values = self.values + dx[6:]
        self.state = UncertainPose(LEFT, *moved(LEFT, self.state.R, self.state.p, dx[:6]), self.P[:6, :6])
        self.propagate_cross_covariances(carried)

    def considered(self, joint: Array, frame: Frame, places: NDArray[np.int64]) -> Considered:
        """Return the correction of the own error, and keep what the measurements show of the neighbours."""
        R, p, size = self.state.R, self.state.p, len(self.P)
        K, whole, N, dx, nis = halfway_gain(LEFT, R, p, joint, frame, self.constants, places)
        self.gained = [
            (dx[k : k + 6], K[k : k + 6].dot(whole).dot(joint[:, k : k + 6])) for k in range(size, len(joint), 6)
        ]
        made: Considered = considered_from(R, p, size, size, joint, K, whole, N, dx, nis)
        return made

    def fuse(self, measured: UsableMeasurements, between: Array | None = None) -> tuple[float, int]:
        """Correct by measurements, and keep the corrections of the neighbours among the targets."""
        result = super().fuse(measured, between)
        for target, (shift, reduced) in zip(self.seen(measured), self.gained, strict=True):
            if target < self.landmarks:
                continue
            self.corrections[target] = self.neighbours[target].number, shift, (reduced + reduced.T) / 2
            self.measured_at[target] = self.number + 1
        return result
