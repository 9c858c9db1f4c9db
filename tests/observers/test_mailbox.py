"""Messages between plug-in observers: stamps, ages and contents, against numbers worked out here."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from coopenv.base.errors import CoopenvError
from coopenv.observers.contract import Message, Received
from coopenv.observers.mailbox import MOST_CONTENTS, Mailbox

DT = 0.1
LANDMARKS = 2


def mailbox(vehicles: int = 3, staleness: float = 1.0, flight: int = 2) -> Mailbox:
    """Return the mailbox of vehicles that all hear one another."""
    targets = np.arange(LANDMARKS + vehicles)
    setups = [SimpleNamespace(landmarks=LANDMARKS, targets=targets) for _ in range(vehicles)]
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
