"""Messages between plug-in observers: stamps, ages, contents and faults, against numbers worked out here."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coopenv.base.errors import CoopenvError
from coopenv.estimation import REPLAY
from coopenv.observers.contract import Message, Received
from coopenv.observers.faults import Interference, altered, interference_of, stacked
from coopenv.observers.mailbox import MOST_CONTENTS, Mailbox
from tests.helpers import builders

DT = 0.1
LANDMARKS = 2


def mailbox(vehicles: int = 3, staleness: float = 1.0, flight: int = 2) -> Mailbox:
    """Return the mailbox of vehicles that all hear one another."""
    targets = np.arange(LANDMARKS + vehicles)
    setups = [SimpleNamespace(landmarks=LANDMARKS, targets=targets, planar=False) for _ in range(vehicles)]
    init: Any = SimpleNamespace(setups=setups, dt=DT, staleness=staleness, flight=flight)
    return Mailbox(init)


def message(x: float = 0.0, **more: Any) -> Message:
    return Message(np.array([x, 0.0, 0.0]), np.eye(3), np.eye(6), **more)


def ages(mail: Mailbox, k: int, vehicle: int, inbox_tick: list[int], clock: list[int] | None = None) -> dict[int, Any]:
    """Return place (x) and age, in ticks, of the messages that a vehicle has, by sender."""
    found = mail.inbox(k, vehicle, inbox_tick, clock=clock)
    return {t - LANDMARKS: (m.message.position[0], round(m.age / DT, 9)) for t, m in found.items()}  # type: ignore[index]


@pytest.mark.parametrize(
    ("clock", "age"),
    [
        *((None, 2), ([0, 0, 0], 2), ([0, 1, 0], 1), ([0, 2, 0], 0), ([0, 3, 0], 0), ([0, 50, 0], 0), ([0, -1, 0], 3)),
        *(([1, 0, 0], 3), ([4, 0, 0], 6), ([6, 0, 0], 8), ([7, 0, 0], 8), ([90, 0, 0], 8), ([0, -90, 0], 8)),
    ],
)
def test_ages_of_offset_clocks_are_at_least_zero_and_at_most_the_time(clock: list[int] | None, age: int) -> None:
    mail = mailbox(flight=9)
    mail.post(1, 6, message(5.0))
    assert ages(mail, 8, 0, [-1, 6, -1], clock) == {1: (5.0, age)}
    assert ages(mail, 9, 0, [-1, 6, -1], clock) == {1: (5.0, age + 1)}  # the stamp stays


def test_a_message_is_there_from_its_delivery_until_it_is_stale() -> None:
    mail = mailbox(staleness=0.4, flight=9)
    mail.post(1, 2, message(5.0))
    assert ages(mail, 3, 0, [-1, -1, -1]) == {}
    assert ages(mail, 4, 0, [-1, 2, -1]) == {1: (5.0, 2)}
    assert ages(mail, 6, 0, [-1, 2, -1]) == {1: (5.0, 4)}
    assert ages(mail, 7, 0, [-1, 2, -1]) == {}
    mail.post(2, 0, message(4.0))
    assert ages(mail, 1, 0, [-1, -1, 0]) == {2: (4.0, 1)}  # that of the start, too
    mail.post(1, 7, message(6.0))
    assert ages(mail, 7, 0, [-1, 7, -1]) == {1: (6.0, 0)} and ages(mail, 7, 2, [-1, 7, -1]) == {1: (6.0, 0)}


def test_messages_are_kept_while_they_may_be_under_way() -> None:
    mail = mailbox(flight=2)
    for k in range(8):
        mail.post(0, k, message(float(k)))
    assert [*mail.sent[0]] == [4, 5, 6, 7]
    size = message().size_bytes
    assert mail.bytes.tolist() == [7 * size, 0, 0] and size > 0  # that of the start is not counted


def test_a_replay_sends_the_contents_of_an_earlier_tick() -> None:
    mail = mailbox(flight=20)
    for k in range(9):
        mail.post(0, k, message(float(k)), replay=3 if k >= 2 else 0, kept=4)
    sent = {k: sent.position[0] for k, sent in mail.sent[0].items() if sent and sent.position is not None}
    assert sent == {0: 0, 1: 1, 2: 0, 3: 0, 4: 1, 5: 2, 6: 3, 7: 4, 8: 5}
    assert [*mail.replayable[0]] == [4, 5, 6, 7, 8]


def test_invalid_and_large_messages_are_refused_and_the_last_one_stays() -> None:
    mail = mailbox(staleness=9.0, flight=9)
    mail.forms[0] = (6, 6)
    mail.post(1, 1, message(1.0))
    assert ages(mail, 1, 0, [-1, 1, -1]) == {1: (1.0, 0)}
    free = MOST_CONTENTS - message(extra={"a": np.zeros(0)}).size_bytes
    assert mail.post(1, 2, message(2.0, extra={"a": np.zeros(free // 8)})) and free % 8 == 0
    assert not mail.post(1, 3, message(3.0, extra={"a": np.zeros(free // 8 + 1)}))
    assert not mail.post(1, 4, message(np.nan))
    assert mail.post(1, 5, Message(np.zeros(3), np.eye(3), np.eye(3)))  # of another form than expected
    for k in (2, 3, 4, 5):
        assert ages(mail, 5, 0, [-1, k, -1]) == {1: (2.0, 3)}, k
    assert mail.refused.tolist() == [3, 0, 0]


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_contents_keep_their_precision_and_are_read_only(kind: type) -> None:
    mail = mailbox()
    mail.post(1, 1, Message(np.array([0.1, 0.0, 0.0], kind), np.eye(3)))
    sent = mail.sent[1][1]
    assert sent is not None and sent.position is not None and sent.position.dtype == kind
    assert sent.position[0] == kind(0.1) and not sent.position.flags.writeable


def test_messages_from_elsewhere_have_the_stamp_of_their_sending() -> None:
    mail = mailbox(staleness=9.0)
    arrived = {(0, 2): Received(message(7.0), 0.0), (1, 2): Received(message(8.0), 0.0)}
    found = mail.inbox(5, 0, [-1, -1, 3], arrived, clock=[0, 0, 9])
    assert [*found] == [LANDMARKS + 2] and found[LANDMARKS + 2].age == pytest.approx(2 * DT)
    assert found[LANDMARKS + 2].message.position is not None and found[LANDMARKS + 2].message.position[0] == 7.0


def test_a_saved_state_goes_on_alike_and_damaged_ones_are_refused() -> None:
    mail, other = mailbox(staleness=9.0, flight=9), mailbox(staleness=9.0, flight=9)
    for k in range(3):
        mail.post(1, k, message(float(k)), replay=1, kept=5)
    ages(mail, 2, 0, [-1, 1, -1], [0, 1, 0])
    other.set_state(mail.get_state())
    for box in (mail, other):
        assert ages(box, 3, 0, [-1, 1, -1]) == {1: (0.0, 1)} and ages(box, 3, 0, [-1, 2, -1]) == {1: (1.0, 1)}
    assert other.bytes.tolist() == mail.bytes.tolist()
    with pytest.raises(CoopenvError, match="not one mailbox per vehicle"):
        other.set_state({**mail.get_state(), "bytes": np.full(3, np.nan)})
    for key in ("sent", "said", "heard", "bytes", "refused"):
        with pytest.raises(CoopenvError, match="not one mailbox per vehicle"):
            other.set_state({**mail.get_state(), key: mail.get_state()[key][:2]})


def test_altered_messages_state_another_pose() -> None:
    R, turn = Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix(), np.array([0.0, 0.0, 0.5])
    honest = Message(np.array([1.0, 2.0, 3.0]), R, 2.0 * np.eye(6))
    assert altered(None, honest, np.zeros(3), np.zeros(3)) is honest
    false = altered(None, honest, np.array([1.0, 0.0, -1.0]), turn, 3.0)
    assert false.position is not None and false.position.tolist() == [2.0, 2.0, 2.0]
    assert np.allclose(false.rotation, R @ Rotation.from_rotvec(turn).as_matrix(), atol=1e-12)
    assert np.array_equal(false.covariance, 9.0 * np.eye(6))
    shifted = altered(None, honest, np.array([1.0, 0.0, 0.0]))
    assert shifted.rotation is R and np.array_equal(shifted.covariance, 2.0 * np.eye(6))
    turned = altered(None, honest, np.zeros(3), turn)
    assert not np.array_equal(turned.rotation, R) and np.array_equal(turned.position, honest.position)
    assert np.array_equal(altered(None, honest, np.zeros(3), None, 0.5).covariance, 0.25 * np.eye(6))
    bare = Message(honest.position, R)
    assert altered(None, bare, np.zeros(3), None, 0.5).covariance is None
    assert np.allclose(altered(None, honest, np.zeros(3), None, 0.01).covariance, 1e-4 * np.eye(6), atol=1e-18)
    agreeing = SimpleNamespace(tampered=lambda false, true: (false.position[0], true.position[0]))
    assert altered(agreeing, honest, np.ones(3)) == (2.0, 1.0)
    assert isinstance(altered(agreeing, honest, np.ones(3), consistent=False), Message)


def test_faults_of_a_tick_are_those_that_have_begun() -> None:
    vehicles = [builders.vehicle(), builders.vehicle((3, 0, 0)), builders.vehicle((6, 0, 0))]
    scenario = builders.scenario(vehicles, faults={"lie": {"kind": "jump"}})
    rows = {
        "lie": [REPLAY, 0, REPLAY],
        "lie_replay": [7, 7, 5],
        "lie_std": [0.5, 0.25, 2.0],
        "lie_consistent": [1, 0, 1],
    }
    table = np.array([*zip(*rows.values(), strict=True)], dtype=[(name, "f8") for name in rows])
    state = {
        "lie_tick": [4, 5, -1],
        "broadcast_shift": np.arange(9.0).reshape(3, 3),
        "broadcast_turn": -np.arange(9.0).reshape(3, 3),
        "clock": [1, -2, 3],
        "restart_tick": [4, -1, 3],
        "map_error": np.arange(54.0).reshape(3, 6, 3),
        "map_tick": [[0, 4, 5, -1, 0, 0]] * 3,
    }
    model = SimpleNamespace(fault=SimpleNamespace(numpy=lambda: table), landmarks=4)
    found = interference_of(scenario, model, lambda name: np.array([state[name]]), 0, 4)
    assert found is not None
    assert found.std.tolist() == [0.5, 0.0, 0.0] and found.replay.tolist() == [7, 0, 0]
    assert found.kept.tolist() == [7, 0, 5] and found.consistent.tolist() == [True, False, True]
    assert found.restarts.tolist() == [True, False, False] and found.clock.tolist() == [1, -2, 3]
    assert found.shift.tolist() == state["broadcast_shift"].tolist()  # type: ignore[attr-defined]
    assert found.turn.tolist() == state["broadcast_turn"].tolist()  # type: ignore[attr-defined]
    errors = np.arange(54.0).reshape(3, 6, 3)[1, :4]
    assert np.array_equal(found.map_error_of(1, 4), errors * [[1], [1], [0], [0]])
    assert np.array_equal(found.map_error_of(1, 5), errors * [[1], [1], [1], [0]])
    both = stacked([found, found])
    assert isinstance(both, Interference) and both.at(1).std.tolist() == found.std.tolist() and both.std.shape == (2, 3)
    assert stacked([found]).at(0).replay.tolist() == [7, 0, 0]  # type: ignore[union-attr]
    assert interference_of(builders.scenario(vehicles), model, lambda name: np.array([state[name]]), 0, 4) is None
    assert stacked([None, None]) is None
