"""What a car says of itself, before it is armed and while it is."""

from __future__ import annotations

import time
from typing import Any

import pytest

from coopenv.cars.backend import status
from coopenv.cars.backend.status import StatusBoard
from coopenv.cars.codec import encode, header, make
from coopenv.cars.deployment import Remote
from coopenv.cars.profile import SVEA, Role
from coopenv.cars.readings import Calibration
from tests.helpers.hub import Hub

CAR = "svea7"
CAMERA = Calibration((316, 208), (213.0, 213.5), (155.0, 115.0), (0.0,) * 5)


class Talk:
    """A car and the board of its station."""

    def __init__(self, needed: bool = True) -> None:
        self.hub = Hub()
        self.board = StatusBoard(self.hub.connect(), (CAR,), Remote(), needed)
        self.network = self.hub.connect()

    def say(self, role: Role, age: float, **fields: Any) -> None:
        stamp = time.time_ns() - round(age * 1e9)
        message = make(SVEA.topics[role].type, header=header(stamp), **fields)
        self.network.publish(SVEA.topic_of(CAR, role), encode(message))

    def obstacle(self) -> str:
        return next(self.board.obstacles(CAR, 0.5, CAMERA), "")

    def remote(self, *pulses: int, rssi: int = 200, age: float = 0.0) -> None:
        self.say(Role.REMOTE, age, rssi=rssi, channels=pulses or (1500,) * 8)

    def state(self, mode: str = "MANUAL", armed: bool = True, age: float = 0.0) -> None:
        self.say(Role.STATE, age, armed=armed, connected=True, mode=mode)

    def battery(self, age: float = 0.0) -> None:
        self.say(Role.BATTERY, age, percentage=0.8)

    def all_is_well(self) -> None:
        self.remote()
        self.state()
        self.battery()


@pytest.fixture
def armed() -> Talk:
    talk = Talk()
    talk.all_is_well()
    assert talk.obstacle() == ""
    talk.board.begin()
    return talk


@pytest.mark.parametrize("left_out", [Role.REMOTE, Role.STATE, Role.BATTERY])
def test_a_car_that_has_not_told_of_itself_is_not_armed(left_out: Role) -> None:
    for old in ({}, {"age": 2.5}, {"age": -2.5}):  # silent, old, or of a clock that is far ahead
        talk = Talk()
        for role, say in ((Role.REMOTE, talk.remote), (Role.STATE, talk.state), (Role.BATTERY, talk.battery)):
            if role is not left_out:
                say()
            elif old:
                say(**old)
        assert SVEA.topic_of(CAR, left_out) in talk.obstacle()


def test_what_has_been_said_counts_for_two_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    talk, now = Talk(), time.monotonic()
    talk.all_is_well()
    talk.board.begin()
    monkeypatch.setattr(status.time, "monotonic", lambda: now + 1.5)
    assert talk.obstacle() == talk.board.happened(CAR) == ""
    monkeypatch.setattr(status.time, "monotonic", lambda: now + 2.5)
    assert talk.obstacle().endswith(SVEA.topic_of(CAR, Role.STATE))
    assert talk.board.happened(CAR)


@pytest.mark.parametrize(
    ("change", "why", "before"),
    [
        (lambda talk: talk.remote(1300, *(1500,) * 7), "remote control", True),
        (lambda talk: talk.remote(1500, 1500, 1700, *(1500,) * 5), "remote control", True),
        (lambda talk: talk.remote(1500, 1500), "remote.throttle", True),
        (lambda talk: talk.remote(*(1500,) * 4, 1900), "mode switch", False),
        (lambda talk: talk.remote(rssi=0), "signal", True),
        (lambda talk: talk.remote(*(0,) * 8), "signal", True),
        (lambda talk: talk.state(armed=False), "armed", True),
        (lambda talk: talk.state(mode="HOLD"), "HOLD", False),
    ],
)
def test_a_car_in_another_state_is_not_armed_and_what_happens_to_an_armed_one_is_not_forgotten(
    armed: Talk, change: Any, why: str, before: bool
) -> None:
    """`before`: whether it also counts before the car is armed, and not as a change alone."""
    armed.all_is_well()
    assert armed.board.happened(CAR) == ""
    change(armed)
    assert (why in armed.obstacle()) is before
    armed.all_is_well()
    assert why in armed.board.happened(CAR)
    armed.board.begin()
    assert armed.board.happened(CAR) == ""


def test_old_words_neither_stop_a_car_nor_keep_it_going(armed: Talk) -> None:
    armed.remote(1300, *(1500,) * 7, age=2.5)
    armed.remote(1300, *(1500,) * 7, age=1.0)  # younger ones have come
    assert armed.board.happened(CAR) == ""


def test_cars_that_cannot_tell_are_armed_all_the_same() -> None:
    talk = Talk(needed=False)
    assert talk.obstacle() == ""
    talk.board.begin()
    talk.remote(rssi=0)
    assert talk.board.happened(CAR) == ""
    talk.remote(1300, *(1500,) * 7)
    assert "remote control" in talk.board.happened(CAR)
