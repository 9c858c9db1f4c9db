"""Observers with kernels on the host: ticks at any time, messages of any kind."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from coopenv.base.errors import CoopenvError
from coopenv.observers import Estimate, Message, Received, Recording, Tick, find
from coopenv.observers.kernel_observer import MOST_UNITS, UNITS_PER_TICK
from tests.helpers.robust_scenes import small_errors


def merged(recording: Recording, first: int, last: int, vehicle: int) -> Tick:
    """Return the last of some ticks, with the odometry of all of them."""
    R, p = np.eye(3), np.zeros(3)
    for k in range(first, last + 1):
        p, R = p + R @ recording.translation[k, vehicle], R @ recording.rotation[k, vehicle]
    tick = recording.tick(last, vehicle, {})
    return replace(tick, rotation=R, translation=p, dt=(last - first + 1) * recording.dt)


def played(
    factory: Callable[..., Any], recording: Recording, shift: Callable[[int], float], ticks: int = 200
) -> tuple[list[Estimate], list[Any]]:
    """Run observers on ticks of which some do not come, with messages of which some are lost.

    Args:
        factory: of the observers.
        recording: whose ticks.
        shift: (tick) -> s by which its time is told late.
        ticks: how many of them.
    """
    draw, L = np.random.default_rng(0), recording.setups[0].landmarks
    observers = [factory(setup) for setup in recording.setups]
    for observer, R, p, P in zip(
        observers, recording.start_rotation, recording.start_position, recording.start_covariance, strict=True
    ):
        observer.reset((R, p), P)
    estimates, sent, last, time = [], {}, 0, 0.0
    while last < ticks:
        first, last = last + 1, last + int(draw.integers(1, 4)) if last else 1
        before, time = time, last * recording.dt + shift(last)
        for vehicle in recording.order:
            tick = merged(recording, first, last, vehicle)
            heard = {t: sent[t] for t in tick.targets.tolist() if t in sent and draw.random() < 0.7}
            messages = {t: Received(message, time - told) for t, (message, told) in heard.items()}
            estimates.append(observers[vehicle].update(replace(tick, time=time, dt=time - before, messages=messages)))
            sent[L + vehicle] = observers[vehicle].message(), time
    return estimates, observers


def test_ticks_may_come_at_any_time() -> None:
    """Late by whole ticks errors stay small; by milliseconds it rounds to 64ths of a tick, which changes little."""
    recording = small_errors(12.0)
    regular, _ = played(find("robust"), recording, lambda k: 0.0)
    late, _ = played(find("robust"), recording, lambda k: 2e-3 * np.sin(7.0 * k) * (k > 1))
    used = [[estimate.nis_dof for estimate in part] for part in (late, regular)]
    assert np.mean(np.not_equal(*used)) < 0.01  # by bearings that are about as far off as the gate
    for estimates in (regular, late):
        for estimate, vehicle in zip(estimates[-5:], recording.order, strict=True):
            assert np.linalg.norm(estimate.position - recording.truth.position[200, vehicle]) < 0.6
    for a, b in zip(late[::5], regular[::5], strict=True):  # of who sees landmarks alone
        assert_allclose(a.position, b.position, rtol=0, atol=5e-3)
        assert_allclose(a.rotation, b.rotation, rtol=0, atol=2e-3)


def observer_and_leader() -> tuple[Any, Any, Recording]:
    """Return a follower and its leader, who have started, and their ticks."""
    recording = small_errors(12.0)
    pair = []
    for vehicle in (3, 2):
        observer = find("robust")(recording.setups[vehicle])
        pose = recording.truth.rotation[0, vehicle], recording.truth.position[0, vehicle]
        observer.reset(pose, 1e-4 * np.eye(6))
        pair.append(observer)
    return *pair, recording


def damaged(message: Message) -> list[Message]:
    """Return messages that nobody should send."""
    extra = message.extra
    assert message.position is not None and message.rotation is not None and message.covariance is not None
    return [
        replace(message, position=np.full(3, np.nan)),
        replace(message, position=np.full(3, 1e12)),
        replace(message, position=np.zeros(2)),
        replace(message, position=None),
        replace(message, rotation=2.0 * message.rotation),
        replace(message, rotation=np.diag([1.0, 1.0, -1.0])),
        replace(message, rotation=None),
        replace(message, covariance=np.zeros((6, 6))),
        replace(message, covariance=-message.covariance),
        replace(message, covariance=np.tri(6)),
        replace(message, covariance=np.eye(3)),
        replace(message, extra={}),
        replace(message, extra={**extra, "odometry": np.zeros(5)}),
        replace(message, extra={**extra, "odometry": np.full(6, np.inf)}),
        replace(message, extra={**extra, "odometry": np.array(["x"] * 6)}),
        replace(message, extra={**extra, "depends_on": np.zeros(1)}),
        replace(message, extra={**extra, "depends_on": np.zeros(0, np.uint64)}),
    ]


def test_malformed_messages_are_as_none_and_counted() -> None:
    follower, leader, recording = observer_and_leader()
    L = recording.setups[0].landmarks
    target = L + 2
    known = int(recording.setups[2].targets[recording.setups[2].targets >= L][0]) - L
    third = find("robust")(recording.setups[known])
    third.reset((recording.truth.rotation[0, known], recording.truth.position[0, known]), 1e-4 * np.eye(6))
    leader.update(recording.tick(1, 2, {L + known: Received(third.message(), 0.0)}))
    bad = damaged(leader.message())
    for k, message in enumerate(bad, 1):
        follower.update(recording.tick(k, 3, {target: Received(message, 0.0)}))
        assert follower.ignored_messages == k
    deaf, _, _ = observer_and_leader()
    for k in range(1, len(bad) + 1):
        deaf.update(recording.tick(k, 3, {}))
    assert (follower.state.estimate_position == deaf.state.estimate_position).all()
    good = recording.tick(len(bad) + 1, 3, {target: Received(leader.message(), 0.0)})
    assert (follower.update(good).position != deaf.update(replace(good, messages={})).position).any()
    assert follower.ignored_messages == len(bad)


def test_a_message_from_before_the_start_is_not_heard() -> None:
    follower, leader, recording = observer_and_leader()
    target = recording.setups[0].landmarks + 2
    follower.update(recording.tick(1, 3, {target: Received(leader.message(), 1.0)}))
    assert follower.state.inbox_tick.tolist() == [-1] * 5 and follower.ignored_messages == 0


def test_time_has_an_end() -> None:
    follower, _, recording = observer_and_leader()
    follower.update(recording.tick(1, 3, {}))
    late = replace(recording.tick(2, 3, {}), time=MOST_UNITS / UNITS_PER_TICK * recording.dt + 1.0)
    with pytest.raises(CoopenvError, match="of the start"):
        follower.update(late)


def test_the_kernels_know_no_truth() -> None:
    follower, _, recording = observer_and_leader()
    follower.update(recording.tick(1, 3, {}))
    L = recording.setups[0].landmarks
    for name in ("position", "rotation", "velocity", "angular_velocity"):
        assert np.isnan(getattr(follower.state, name)[L:]).all(), name
