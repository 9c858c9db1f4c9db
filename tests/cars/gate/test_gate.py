"""Commands that pass the gate, and its actions without commands."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coopenv.cars.gate.gate import MOST_AHEAD, TIMEOUT, GateMode, Reason
from coopenv.cars.gate.wheel_command import NEUTRAL, MotionCommand
from coopenv.cars.settings.limits import Limits
from coopenv.cars.settings.profile import SVEA, Role
from tests.cars.gate import messages
from tests.cars.gate.bench import LIMITS, MS, OTHER, STATION, Bench

MOST_AGE = SVEA.topics[Role.COMMAND].max_age_ns


def armed(ticks: int = 0, **options: Any) -> Bench:
    """Return an armed gate after some commands, one per tick."""
    bench = Bench(**options)
    assert bench.arm() is None
    bench.drive(ticks)
    return bench


def test_it_starts_disarmed_and_neutral() -> None:
    bench = Bench()
    assert bench.tick() == NEUTRAL
    assert bench.command() is Reason.NOT_ARMED
    assert bench.tick() == NEUTRAL
    status = bench.status()
    assert (status.state, status.session, status.accepted, len(status.nonce)) == ("disarmed", "", 0, 16)
    assert dict(zip(status.rejections, status.counts.tolist(), strict=True)) == {
        str(reason): int(reason is Reason.NOT_ARMED) for reason in Reason
    }


def test_commands_of_the_armed_session_move_the_car() -> None:
    bench = armed()
    assert bench.tick() == NEUTRAL and bench.gate.state is GateMode.ARMED
    output = bench.drive(10)
    assert (output.steering, output.speed) == pytest.approx((0.1, 0.2), abs=1e-6)
    status = bench.status()
    assert (status.state, status.session, status.accepted, status.last_sequence) == ("armed", "s1", 10, 10)
    assert not status.counts.any()


def test_rates_are_limited_both_ways() -> None:
    bench = armed()
    speeds, angles = [0.0], [0.0]
    for steering, speed in [(0.5, 0.5)] * 15 + [(-0.5, 0.0)] * 15:
        output = bench.drive(1, steering=steering, speed=speed)
        speeds.append(output.speed)
        angles.append(output.steering)
    for before, after in pairwise(speeds):
        assert abs(after - before) <= LIMITS.acceleration * 0.05 + 1e-6
    for before, after in pairwise(angles):
        assert abs(after - before) <= LIMITS.steering_rate * 0.05 + 1e-6
    assert (speeds[10], angles[5], speeds[-1], angles[-1]) == pytest.approx((0.5, 0.5, 0.0, -0.5), abs=1e-6)
    assert speeds[1] == pytest.approx(0.05, abs=1e-6)


def test_a_late_tick_makes_no_jump() -> None:
    bench = armed()
    bench.drive(2, speed=0.5)
    bench.wait(100 * MS)
    bench.command(speed=0.5)
    assert bench.tick().speed == pytest.approx(0.15, abs=1e-6)


def test_without_commands_the_car_gets_neutral_and_newer_commands_go_on_from_a_stand() -> None:
    bench = armed()
    assert bench.drive(10).speed > 0.19
    bench.wait(TIMEOUT - 100 * MS)
    assert bench.tick().speed > 0.19 and bench.gate.state is GateMode.ARMED
    assert bench.tick() == NEUTRAL and bench.gate.state is GateMode.TIMED_OUT
    assert bench.status().session == "s1"
    assert bench.command(age=MOST_AGE + MS) is Reason.STALE
    assert bench.tick() == NEUTRAL
    output = bench.drive(1)
    assert output.speed == pytest.approx(0.05, abs=1e-6) and bench.gate.state is GateMode.ARMED


def test_late_commands_of_a_stalled_link_move_nothing() -> None:
    bench = armed(10)
    sent = []
    for sequence in range(100, 160):
        sent.append(messages.command(bench.wall, "s1", sequence))
        bench.wait(50 * MS)
    results = [bench.send(Role.COMMAND, payload) for payload in sent]
    assert results[:57] == [Reason.STALE] * 57  # the last three are as young as they may be
    assert results[57:] == [None] * 3
    assert bench.tick().speed <= 0.05 + 1e-6


def test_a_process_that_was_frozen_goes_on_from_a_stand() -> None:
    bench = armed()
    assert bench.drive(10).speed > 0.19
    bench.wait(2_000 * MS)  # nothing was called meanwhile; the first call is a fresh command
    assert bench.command() is None
    assert bench.tick().speed == pytest.approx(0.05, abs=1e-6)


@pytest.mark.parametrize(
    ("age", "reason"),
    [
        (0, None),
        (MOST_AGE, None),
        (MOST_AGE + 1, Reason.STALE),
        (3600 * 10**9, Reason.STALE),
        (-MOST_AHEAD, None),
        (-MOST_AHEAD - 1, Reason.FUTURE),
    ],
)
def test_stamps_are_fresh(age: int, reason: Reason | None) -> None:
    assert (MOST_AGE, MOST_AHEAD) == (150 * MS, 50 * MS)
    assert armed().command(age=age) is reason
    assert Bench().arm(age=age) is reason


def test_a_clock_that_is_set_stops_the_car() -> None:
    bench = armed(10)
    bench.wall += 10**9
    assert bench.send(Role.COMMAND, messages.command(bench.wall - 10**9, "s1", 99)) is Reason.STALE
    bench.wait(TIMEOUT)
    assert bench.tick() == NEUTRAL


def test_a_clock_that_is_set_back_makes_no_command_fresh() -> None:
    bench = armed(10)
    late = messages.command(bench.wall, "s1", 99)
    bench.wait(5 * TIMEOUT)
    assert bench.send(Role.COMMAND, late) is Reason.STALE
    bench.wall -= 5 * TIMEOUT
    assert bench.send(Role.COMMAND, late) is Reason.STALE and bench.tick() == NEUTRAL


def test_sequences_increase() -> None:
    bench = armed()
    assert bench.command(sequence=0) is None
    for sequence, reason in [(0, Reason.SEQUENCE), (5, None), (5, Reason.SEQUENCE), (4, Reason.SEQUENCE), (6, None)]:
        assert bench.command(sequence=sequence) is reason
    assert bench.status().last_sequence == 6


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        ("", Reason.SESSION),
        ("s1", Reason.SESSION),
        ("s2:1", Reason.SESSION),
        (":1", Reason.SESSION),
        ("s1:", Reason.MALFORMED),
        ("s1:-1", Reason.MALFORMED),
        ("s1:1.0", Reason.MALFORMED),
        ("s1: 1", Reason.MALFORMED),
        ("s1:1_0", Reason.MALFORMED),
        ("s1:²", Reason.MALFORMED),
        ("s1:٣", Reason.MALFORMED),
        ("s1:" + "9" * 19, Reason.MALFORMED),
    ],
)
def test_a_command_names_session_and_sequence(frame: str, reason: Reason) -> None:
    bench = armed()
    assert bench.send(Role.COMMAND, messages.framed_command(bench.wall, frame, (0.0,) * 5)) is reason


@given(st.floats(width=32), st.floats(width=32))
def test_commands_are_finite_and_inside_the_limits(steering: float, speed: float) -> None:
    bench = armed()
    reason = bench.command(steering, speed)
    output = bench.tick()
    if not (math.isfinite(steering) and math.isfinite(speed)):
        assert reason is Reason.NOT_FINITE
    elif not (abs(steering) <= 0.5 + 1e-6 and -1e-6 <= speed <= 0.5 + 1e-6):
        assert reason is Reason.LIMITS
    else:
        assert reason is None
    assert reason is None or output == NEUTRAL


def test_a_command_that_is_not_finite_stops_the_car() -> None:
    bench = armed(10)
    assert bench.command(speed=math.nan) is Reason.NOT_FINITE
    assert bench.tick() == NEUTRAL and bench.gate.state is GateMode.TIMED_OUT
    bench.drive(10)
    assert bench.command(speed=math.nan, signer=OTHER) is Reason.SIGNATURE  # others cannot
    assert bench.tick().speed > 0.19
    frame = messages.framed_command(bench.wall, "s1:99", (0.0, math.inf, 0.1, 0.0, 0.0))
    assert bench.send(Role.COMMAND, frame) is Reason.NOT_FINITE


def test_reverse_only_where_it_is_allowed() -> None:
    assert armed().command(speed=-0.2) is Reason.LIMITS
    bench = armed(limits=Limits(0.5, 0.5, 1.0, 2.0, reverse=True))
    assert bench.drive(10, speed=-0.2).speed == pytest.approx(-0.2, abs=1e-6)


def test_only_the_station_arms_and_commands() -> None:
    bench = Bench()
    nonce = bench.status().nonce
    for signer in (None, OTHER):
        assert bench.send(Role.ARM, messages.arm(bench.wall, "s1", nonce), signer) is Reason.SIGNATURE
    assert bench.arm() is None
    for signer in (None, OTHER):
        assert bench.command(signer=signer) is Reason.SIGNATURE
        assert bench.send(Role.ARM, messages.arm(bench.wall, "s1", "", False), signer) is Reason.SIGNATURE
    assert bench.command() is None


def test_a_signature_for_another_car_or_topic_is_refused() -> None:
    bench = armed()
    payload = messages.command(bench.wall, "s1", 1)
    for topic in ("fleet/svea8/coopenv/cmd", "fleet/svea7/coopenv/arm", "svea7/coopenv/cmd"):
        attachment = STATION.sign(topic, payload)
        assert bench.gate.arrive(Role.COMMAND, payload, attachment) is Reason.SIGNATURE


def test_without_keys_nothing_needs_a_signature() -> None:
    bench = armed(signed=False)
    assert bench.command(signer=None) is None
    assert bench.tick().speed > 0.0


def test_an_arming_counts_once() -> None:
    bench = Bench()
    nonce = bench.status().nonce
    payload = messages.arm(bench.wall, "s1", nonce)
    assert bench.send(Role.ARM, payload) is None
    assert bench.status().nonce != nonce
    assert bench.send(Role.ARM, payload) is Reason.NONCE
    assert bench.arm(armed=False) is None
    assert bench.send(Role.ARM, payload) is Reason.NONCE
    assert bench.gate.state is GateMode.DISARMED
    assert Bench().status().nonce != Bench().status().nonce


@pytest.mark.parametrize("session", ["", "a:b", "a b", "x" * 65, "ä"])
def test_a_session_has_a_plain_name(session: str) -> None:
    bench = Bench()
    assert bench.arm(session) is Reason.SESSION
    assert bench.gate.state is GateMode.DISARMED


def test_another_session_begins_from_a_stand_and_ends_the_first() -> None:
    bench = armed(10)
    assert bench.arm("s2") is None
    assert bench.tick() == NEUTRAL
    assert bench.send(Role.COMMAND, messages.command(bench.wall, "s1", 50)) is Reason.SESSION
    assert bench.command(sequence=0) is None


def test_a_session_that_is_armed_again_takes_no_command_twice() -> None:
    bench = armed(3)
    old = messages.command(bench.wall, "s1", 3)
    assert bench.arm("s1", armed=False) is None and bench.arm("s1") is None
    assert bench.send(Role.COMMAND, old) is Reason.SEQUENCE
    assert bench.command() is None


def test_disarming_needs_no_nonce() -> None:
    bench = armed(10)
    assert bench.arm("whatever", nonce="", armed=False) is None
    assert bench.tick() == NEUTRAL and bench.gate.state is GateMode.DISARMED
    bench.session = "s1"
    assert bench.command() is Reason.NOT_ARMED


def test_a_stop_holds_until_the_next_arming() -> None:
    bench = armed(10)
    before = bench.status().nonce
    assert bench.stop() is None
    assert bench.tick() == NEUTRAL and bench.gate.state is GateMode.STOPPED
    nonce = bench.status().nonce
    bench.stop(False)
    assert bench.command() is Reason.NOT_ARMED
    assert bench.arm(armed=False) is None
    assert bench.arm(nonce=before) is Reason.NONCE  # sent by one who could not know of the stop
    bench.stop()
    assert bench.gate.state is GateMode.STOPPED and bench.status().nonce == nonce
    bench.wait(10**10)
    assert bench.gate.state is GateMode.STOPPED
    assert bench.arm() is None
    assert bench.tick() == NEUTRAL and bench.gate.state is GateMode.ARMED
    assert bench.drive(1).speed == pytest.approx(0.05, abs=1e-6)


def test_malformed_stops_stop_nothing() -> None:
    bench = armed(10)
    for payload in (b"", b"\0\1\0\0", messages.stop() + bytes(4), bytes(600)):
        assert bench.gate.arrive(Role.STOP, payload) in (Reason.MALFORMED, Reason.TOO_LONG)
    assert bench.tick().speed > 0.19


def test_a_gate_that_closes_is_neutral_for_good() -> None:
    bench = armed(10)
    bench.gate.neutral()
    assert bench.command() is Reason.NOT_ARMED
    assert bench.tick() == MotionCommand()
