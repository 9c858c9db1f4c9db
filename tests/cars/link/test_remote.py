"""Pulses of a remote control."""

from __future__ import annotations

import pytest

from coopenv.cars.deployment import Remote

REST = (1500, 1500, 1500, 1500, 1100)
NO_SIGNAL = "its remote control has no signal"


@pytest.mark.parametrize(
    ("pulses", "why"),
    [
        (REST, ""),
        ((), NO_SIGNAL),
        ((0,) * 8, NO_SIGNAL),
        ((1500, 0, 1500, 0, 1500), ""),  # two that are not in use
        ((1500, 1500, 65535, 1500, 1500), NO_SIGNAL),
        ((1500, 1500, 1500, 1500, 0), NO_SIGNAL),
        ((1500,) * 4, "its remote control has 4 channels, remote.mode_switch is 5"),
    ],
)
def test_what_tells_nothing_is_said(pulses: tuple[int, ...], why: str) -> None:
    assert Remote().fault(pulses) == why


def test_who_has_no_switch_needs_no_channel_for_it() -> None:
    assert Remote(mode_switch=0).fault((1500,) * 3) == ""
    assert not Remote(mode_switch=0).switched((1500,) * 3, (1900,) * 3)


def test_sticks_and_switch_are_where_the_file_says() -> None:
    for channel, driven in ((1, True), (2, False), (3, True), (4, False), (5, False)):
        moved = tuple(1800 if n == channel else pulse for n, pulse in enumerate(REST, start=1))
        assert Remote().drives(moved) is driven
        assert Remote().switched(moved, REST) is (channel == 5)
        assert Remote(steering=4, throttle=2).drives(moved) is (channel in (2, 4))
    assert not Remote().drives(()) and not Remote().drives((0, 0, 0)) and not Remote().drives((1590, 1500, 1410))
