"""What a receiver can rebuild from a sender's messages alone."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from coopenv.estimation.rotations import exp_so3
from coopenv.observers.contract import Message, SensorNoise
from tests.oracles.robust.belief import Belief, Member
from tests.oracles.robust.tracklets import (
    Report,
    from_message,
    left_error,
    mask_of,
    seen_at,
    to_message,
    tracklet,
)

NOISE = SensorNoise(velocity=0.1, angular_velocity=0.01, odometry_period=1 / 60, bearing=0.003)
DT = 1 / 60


class Sender:
    """A Kalman filter of one vehicle with arbitrary linear measurements."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.belief = Belief(
            1, Rotation.random(None, np.random.default_rng(seed)).as_matrix(), self.rng.normal(size=3), 0.01 * np.eye(6)
        )
        self.odometry = np.eye(3), np.zeros(3)
        self.time = 0.0

    def step(self) -> None:
        turn, step = exp_so3(0.05 * self.rng.normal(size=3)), 0.1 * self.rng.normal(size=3)
        self.belief.move(0, turn, step, NOISE.odometry(DT))
        R, p = self.odometry
        self.odometry, self.time = (R @ turn, p + R @ step), self.time + DT
        self.belief.correct(self.rng.normal(size=(4, 6)), np.full(4, 0.5), 0.01 * self.rng.normal(size=4))

    def report(self) -> Report:
        R, p = self.odometry
        own = self.belief.own
        return Report((1,), np.array([self.time]), own.R[None], own.p[None], R[None], p[None], self.belief.P.copy(), 0)


@pytest.mark.parametrize("gap", [1, 4])
def test_a_receiver_without_news_of_its_own_ends_where_the_sender_is(gap):
    sender = Sender(gap)
    last = sender.report()
    receiver = Belief(0, np.eye(3), np.zeros(3), np.eye(6))
    receiver.add([Member(1, last.R[0], last.p[0], 0.0, (last.odometry_turn[0], last.odometry_position[0]))], last.P)
    for _ in range(6):
        for _ in range(gap):  # messages between are lost
            sender.step()
        new = sender.report()
        receiver.follow(1, new.odometry_turn[0], new.odometry_position[0], new.time[0], NOISE)
        learnt = tracklet(last, new, NOISE)
        receiver.inform(np.arange(6, 12), *learnt.about([receiver.members[1]]))
        last = new
    assert_allclose(receiver.members[1].R, sender.belief.own.R, atol=1e-8)
    assert_allclose(receiver.members[1].p, sender.belief.own.p, atol=1e-8)
    assert_allclose(receiver.P[6:, 6:], sender.belief.P, rtol=1e-6, atol=1e-10)


def test_a_sender_that_knows_less_than_before_has_learnt_nothing():
    sender = Sender(0)
    last = sender.report()
    sender.step()
    sender.belief.P = 10.0 * np.eye(6)
    assert tracklet(last, sender.report(), NOISE) is None


def test_messages_hold_pose_and_covariance_and_no_more():
    rng = np.random.default_rng(0)
    A = rng.normal(size=(6, 6))
    marker = np.array([0.5, 0.0, 1.0])
    belief = Belief(3, Rotation.random(None, np.random.default_rng(1)).as_matrix(), rng.normal(size=3), A @ A.T)
    odometry = exp_so3(np.array([0.3, -2.0, 0.4])), rng.normal(size=3)
    message = to_message(belief, marker, odometry, mask_of({0, 5}))
    assert message.size_bytes <= 8 * (7 + 21)  # position, quaternion, triangle of the covariance
    report = from_message(message, 3, 2.5)
    p, P = seen_at(marker, belief.own.R, belief.own.p, belief.P)
    assert_allclose(report.R[0], belief.own.R)
    assert_allclose(report.p[0], p)
    assert_allclose(report.P, P, rtol=1e-6, atol=1e-6)
    assert_allclose(report.odometry_turn[0], odometry[0], atol=1e-12)
    assert_allclose(report.odometry_position[0], odometry[1] + odometry[0] @ marker)
    assert report.depends_on == 0b100001


def test_other_observers_messages_are_not_ours():
    assert from_message(Message(), 1, 0.0) is None
    assert from_message(Message(position=np.zeros(3), covariance=np.eye(3)), 1, 0.0) is None
    assert from_message(Message(position=np.zeros(3), rotation=np.eye(3), covariance=np.eye(6)), 1, 0.0) is None


def test_covariance_at_the_marker():
    marker = np.array([0.5, -0.3, 1.0])
    R, p = Rotation.random(None, np.random.default_rng(2)).as_matrix(), np.array([1.0, 2.0, 3.0])
    e = 1e-7 * np.array([1.0, -2.0, 0.5, 0.3, 0.1, -0.7])
    moved_R, moved_p = R @ exp_so3(e[:3]), p + R @ e[3:]
    error = left_error(R, p + R @ marker, moved_R, moved_p + moved_R @ marker)
    _, P = seen_at(marker, R, p, np.outer(e, e))
    assert_allclose(P, np.outer(error, error), atol=1e-19)
