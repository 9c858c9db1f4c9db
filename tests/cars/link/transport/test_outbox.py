"""What waits to be sent."""

from __future__ import annotations

import threading
import time

from coopenv.cars.transport.nats import Letter, Outbox


def letter(number: int) -> Letter:
    return Letter("t", bytes([number]), b"")


def test_urgent_ones_overtake_and_the_oldest_go_first_when_there_is_no_room() -> None:
    outbox = Outbox(2, 0.0)
    for number in range(4):
        outbox.put(letter(number), urgent=False, patient=False)
    outbox.put(letter(9), urgent=True, patient=False)
    assert [outbox.take() for _ in range(4)] == [letter(9), letter(2), letter(3), None]


def test_a_patient_sender_waits_for_room_and_loses_nothing() -> None:
    outbox = Outbox(1, 60.0)
    outbox.put(letter(1), urgent=True, patient=False)
    sender = threading.Thread(target=lambda: outbox.put(letter(2), urgent=True, patient=True), daemon=True)
    sender.start()
    time.sleep(0.1)
    assert sender.is_alive()
    assert outbox.take() == letter(1)
    sender.join(60.0)
    assert outbox.take() == letter(2)
