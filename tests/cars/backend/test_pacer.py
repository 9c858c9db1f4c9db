"""Deadlines, on a clock that the test moves."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coopenv.cars.backend import station as module
from coopenv.cars.backend.station import Pacer

PERIOD, TICKS = 0.01, 3
MS = 1_000_000


class Clock:
    """Time that passes when somebody sleeps or works; waking up takes `late` ns."""

    def __init__(self) -> None:
        self.time, self.late = 5_000_000_000, 0

    def monotonic_ns(self) -> int:
        return self.time

    def time_ns(self) -> int:
        return self.time + 1_700_000_000_000_000_000

    def sleep(self, seconds: float) -> None:
        self.time += round(seconds * 1e9) + self.late


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(module, "time", clock)
    return clock


def begun() -> Pacer:
    pacer = Pacer(PERIOD, TICKS)
    pacer.start()
    return pacer


def decision(pacer: Pacer, clock: Clock, works: tuple[int, ...]) -> list[int]:
    """Make one decision whose ticks are followed by so many ns of work; return when its ticks came, ns."""
    pacer.decide()
    times = []
    for work in works:
        times.append(pacer.wait())
        clock.time += work
    return times


def test_ticks_come_at_multiples_of_the_period_whatever_the_work_takes(clock):
    pacer = begun()
    begin = pacer.now()
    times = [t for _ in range(50) for t in decision(pacer, clock, (4 * MS, 9 * MS, 6 * MS))]
    assert times == [begin + 10 * MS * k for k in range(1, 151)]
    assert pacer.missed == 0 and pacer.late(1.0) == 0.0


def test_a_late_decision_is_back_on_time_at_its_last_tick_without_having_missed_anything(clock):
    pacer = begun()
    begin = pacer.now()
    decision(pacer, clock, (0, 0, 25 * MS))
    times = decision(pacer, clock, (0, 0, 0))
    assert [t - begin for t in times] == [55 * MS, 55 * MS, 60 * MS]
    assert pacer.missed == 0
    assert pacer.late(1.0) == pytest.approx(0.015)


def test_what_takes_longer_than_a_decision_is_counted_once_and_never_made_up_for(clock):
    pacer = begun()
    begin = pacer.now()
    decision(pacer, clock, (0, 0, 75 * MS))  # until 105: the decisions that end at 60 and 90 are over
    times = decision(pacer, clock, (0, 0, 0))
    assert [t - begin for t in times] == [105 * MS, 110 * MS, 120 * MS]
    assert (pacer.missed, pacer.in_a_row) == (1, 1)
    decision(pacer, clock, (0, 0, 0))
    assert (pacer.missed, pacer.in_a_row) == (1, 0)


def test_a_computer_that_stands_still_between_two_ticks_leaves_that_time_out(clock):
    pacer = begun()
    begin = pacer.now()
    pacer.decide()
    pacer.wait()
    clock.time += 3_000 * MS
    pacer.wait()
    pacer.wait()
    assert pacer.missed == 1
    assert (pacer.now() - begin) // MS in range(3_010, 3_041)


def test_late_waking_is_measured_and_does_not_add_up(clock):
    pacer = begun()
    begin, clock.late = pacer.now(), 2 * MS
    for _ in range(20):
        times = decision(pacer, clock, (1 * MS, 1 * MS, 1 * MS))
    assert times[-1] - begin == 602 * MS
    assert pacer.late(0.5) == pytest.approx(0.002)


@given(st.lists(st.integers(0, 200 * MS), min_size=1, max_size=30))
def test_whatever_the_work_takes_commands_are_never_sent_in_a_burst(works):
    clock = Clock()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "time", clock)
        pacer = begun()
        begin, sent = pacer.now(), []
        for work in works:
            pacer.decide()
            sent.append(pacer.now() - begin)
            for _ in range(TICKS):
                pacer.wait()
            clock.time += work
    assert len({t // (30 * MS) for t in sent}) == len(sent), "two commands within one interval"
    assert pacer.missed <= sum(work >= 30 * MS for work in works[:-1])
    assert pacer.missed >= sum(work >= 60 * MS for work in works[:-1])
