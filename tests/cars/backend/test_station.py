"""A station: its deadlines on a clock that the test moves, tracks between samples, and hostile messages of any kind."""

from __future__ import annotations

import time
import tracemalloc
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from coopenv.cars.backend.assembler import Assembler, Intake
from coopenv.cars.backend.binding import Binding, bind
from coopenv.cars.backend.buffers import KEPT, MOST_SAMPLES, Odometer, PlaceTrack
from coopenv.cars.backend.station import MOST_WAITING, Pacer, Station
from coopenv.cars.fake.lockstep import Hub
from coopenv.cars.link.clock import Clock
from coopenv.cars.link.keys import Signer, Verifier
from coopenv.cars.link.transport import Arrival
from coopenv.cars.messages.codec import MOST_BYTES, encode, header, make
from coopenv.cars.messages.readings import Twist
from coopenv.cars.settings.deployment import Car, Sensors
from coopenv.cars.settings.profile import SVEA, Role
from coopenv.scenario import load_scenario

PERIOD, TICKS = 0.01, 3
MS = 1_000_000


class WorkClock(Clock):
    """Time that passes when somebody sleeps or works; waking up takes `late` ns."""

    def __init__(self) -> None:
        self.time, self.late = 5_000_000_000, 0
        super().__init__(lambda: self.time + 1_700_000_000_000_000_000, lambda: self.time)

    def sleep(self, seconds: float) -> None:
        self.time += round(seconds * 1e9) + self.late


@pytest.fixture
def clock():
    return WorkClock()


def begun(clock: WorkClock) -> tuple[Pacer, int]:
    """Return one that has started, and when that was, ns."""
    pacer = Pacer(PERIOD, TICKS, clock)
    return pacer, pacer.start()


def decision(pacer: Pacer, clock: WorkClock, works: tuple[int, ...]) -> list[int]:
    """Make one decision whose ticks are followed by so many ns of work; return when its ticks came, ns."""
    pacer.decide()
    times = []
    for work in works:
        times.append(pacer.wait())
        clock.time += work
    return times


def test_ticks_come_at_multiples_of_the_period_for_any_work(clock):
    pacer, begin = begun(clock)
    times = [t for _ in range(50) for t in decision(pacer, clock, (4 * MS, 9 * MS, 6 * MS))]
    assert times == [begin + 10 * MS * k for k in range(1, 151)]
    assert pacer.missed == 0 and pacer.late(1.0) == 0.0


def test_a_decision_misses_its_deadline_once_however_often_the_computer_stands_still(clock):
    pacer, _ = begun(clock)
    decision(pacer, clock, (200 * MS, 200 * MS, 0))
    assert pacer.missed == 1
    decision(pacer, clock, (0, 0, 200 * MS))
    decision(pacer, clock, (200 * MS, 200 * MS, 200 * MS))
    assert pacer.missed == 2 and pacer.in_a_row == 1
    decision(pacer, clock, (0, 0, 0))
    assert pacer.missed == 3 and pacer.in_a_row == 2


def test_a_late_decision_is_back_on_time_at_its_last_tick_without_having_missed_anything(clock):
    pacer, begin = begun(clock)
    decision(pacer, clock, (0, 0, 25 * MS))
    times = decision(pacer, clock, (0, 0, 0))
    assert [t - begin for t in times] == [55 * MS, 55 * MS, 60 * MS]
    assert pacer.missed == 0
    assert pacer.late(1.0) == pytest.approx(0.015)


def test_work_longer_than_a_decision_counts_once_and_is_not_made_up_for(clock):
    pacer, begin = begun(clock)
    decision(pacer, clock, (0, 0, 75 * MS))  # until 105: the decisions that end at 60 and 90 are over
    times = decision(pacer, clock, (0, 0, 0))
    assert [t - begin for t in times] == [105 * MS, 110 * MS, 120 * MS]
    assert (pacer.missed, pacer.in_a_row) == (1, 1)
    decision(pacer, clock, (0, 0, 0))
    assert (pacer.missed, pacer.in_a_row) == (1, 0)


def test_a_computer_that_stands_still_between_two_ticks_leaves_that_time_out(clock):
    pacer, begin = begun(clock)
    pacer.decide()
    pacer.wait()
    clock.time += 3_000 * MS
    pacer.wait()
    pacer.wait()
    assert pacer.missed == 1
    assert (pacer.now() - begin) // MS in range(3_010, 3_041)


def test_late_waking_is_measured_and_does_not_add_up(clock):
    pacer, begin = begun(clock)
    clock.late = 2 * MS
    for _ in range(20):
        times = decision(pacer, clock, (1 * MS, 1 * MS, 1 * MS))
    assert times[-1] - begin == 602 * MS
    assert pacer.late(0.5) == pytest.approx(0.002)


@given(st.lists(st.integers(0, 200 * MS), min_size=1, max_size=30))
def test_commands_are_not_sent_in_a_burst_after_any_work(works):
    clock = WorkClock()
    (pacer, begin), sent = begun(clock), []
    for work in works:
        pacer.decide()
        sent.append(pacer.now() - begin)
        for _ in range(TICKS):
            pacer.wait()
        clock.time += work
    assert len({t // (30 * MS) for t in sent}) == len(sent), "two commands within one interval"
    assert pacer.missed <= sum(work >= 30 * MS for work in works[:-1])
    assert pacer.missed >= sum(work >= 60 * MS for work in works[:-1])


CARS = [Car(name="svea7", marker=7), Car(name="svea1", marker=6)]
MARKERS = {"SL1": 1, "SL2": 2, "SL4": 4, "SL5": 5}
COUNT = 10_000


def binding(only: str | None = None) -> Binding:
    return bind(load_scenario("svea_overtaking"), CARS, MARKERS, "test", only)


def hostile(rng: np.random.Generator, kind: str) -> bytes:
    """Return bytes that are nearly a message of a type, or nothing like it."""
    good = encode(make(kind))
    choice = rng.integers(6)
    if choice == 0:
        return rng.bytes(int(rng.integers(0, 200)))
    if choice == 1:
        return good[: int(rng.integers(0, len(good)))]
    if choice == 2:  # any bits where numbers and lengths are
        damaged = bytearray(good)
        for at in rng.integers(4, len(good), size=8):
            damaged[at] = int(rng.integers(256))
        return bytes(damaged)
    if choice == 3:
        return good[:4] + np.full((len(good) - 4) // 8, np.nan).tobytes()
    if choice == 4:
        return good + rng.bytes(50)
    return b"\x00\x01\x00\x00" + b"\xff" * int(rng.integers(8, 300))


def test_nothing_that_comes_stops_the_ticks_or_stays_in_memory() -> None:
    """After all of it every tick can still be run on, and good messages count again."""
    rng, bound, now = np.random.default_rng(0), binding(), time.time_ns()
    intake, assembler = Intake(bound, Sensors()), Assembler(bound)
    assembler.begin(now)
    kinds = {topic: SVEA.topics[role].type for topic, (_, role, _) in intake.topics.items()}
    topics, half = list(kinds), 0
    for k in range(COUNT):
        if k == COUNT // 2:
            tracemalloc.start()
            half = tracemalloc.get_traced_memory()[0]
        topic = topics[int(rng.integers(len(topics)))]
        for sample in intake.samples(Arrival(topic, hostile(rng, kinds[topic]), now)):
            assembler.put(sample)
        if k % 200 == 0:
            now += 16_666_667
            tick = assembler.tick(k // 200 + 1, now)
            assert np.isfinite(tick.rotation).all() and np.isfinite(tick.translation).all()
            assert np.isfinite(tick.velocity).all() and np.isfinite(tick.bearings[tick.visible]).all()
    grown = tracemalloc.get_traced_memory()[0] - half
    tracemalloc.stop()
    assert sum(sum(counts.values()) for counts in intake.rejected.values()) > 0.3 * COUNT
    assert grown < 300_000
    moved = {"twist": ((0.25, 0.0, 0.0), (0.0, 0.0, 0.0))}
    wheel = make(SVEA.topics[Role.WHEEL].type, header=header(now + 10**10), twist=moved)
    arrival = Arrival(SVEA.topic_of("svea7", Role.WHEEL), encode(wheel), now + 10**10)
    [sample] = intake.samples(arrival)
    assembler.put(sample)
    assert assembler.tick(COUNT, now + 10**10).velocity[0, 0] == pytest.approx(0.25)


def test_a_message_that_is_too_long_is_neither_kept_nor_looked_at() -> None:
    intake, hub = Intake(binding(), Sensors()), Hub()
    topic, long = SVEA.topic_of("svea7", Role.DETECTIONS), b"\x00\x01\x00\x00" + bytes(MOST_BYTES)
    assert not list(intake.samples(Arrival(topic, long, 0)))
    assert intake.rejected["svea7"] == {Role.DETECTIONS.value: 1}
    station = Station(hub.connect(), (topic,), None, {})
    for payload in (long, bytes(100)):
        hub.connect().publish(topic, payload)
    assert station.dropped == {"too long": 1} and [len(a.payload) for a in station.drain()] == [100]
    assert station.silence(topic) < 10.0


def test_a_flood_of_one_topic_drops_no_message_of_another() -> None:
    hub = Hub()
    flooded, other = SVEA.topic_of("svea7", Role.IMU), SVEA.topic_of("svea1", Role.WHEEL)
    station = Station(hub.connect(), (flooded, other), None, {})
    network = hub.connect()
    network.publish(other, b"x")
    for k in range(50 * MOST_WAITING):
        network.publish(flooded, k.to_bytes(4))
    waiting = station.drain()
    assert len(waiting) == MOST_WAITING + 1 and other in {arrival.topic for arrival in waiting}
    assert station.dropped["overflow"] == 49 * MOST_WAITING
    assert waiting[-1].payload == (50 * MOST_WAITING - 1).to_bytes(4)


def test_messages_without_the_senders_signature_are_dropped_and_counted(tmp_path: Path) -> None:
    keys = {name: Ed25519PrivateKey.generate() for name in ("svea1", "svea7", "mallory")}
    verifier = Verifier({name: key.public_key() for name, key in keys.items() if name != "mallory"})
    topic, hub = SVEA.topic_of("svea1", Role.ESTIMATE), Hub()
    station = Station(hub.connect(), (topic,), verifier, {topic: ("svea1", "station")})
    network, payload = hub.connect(), encode(make(SVEA.topics[Role.ESTIMATE].type))
    genuine = Signer("svea1", keys["svea1"]).sign(topic, payload)
    elsewhere = Signer("svea1", keys["svea1"]).sign(SVEA.topic_of("svea7", Role.ESTIMATE), payload)
    for signature in (
        b"",
        genuine[:-1],
        elsewhere,
        Signer("svea7", keys["svea7"]).sign(topic, payload),
        Signer("svea1", keys["mallory"]).sign(topic, payload),
    ):
        network.publish(topic, payload, signature)
    network.publish(topic, payload + b"x", genuine)
    assert not station.drain() and station.dropped == {"signature": 6}
    network.publish(topic, payload, genuine)
    assert len(station.drain()) == 1


NS = 10**9


def integrated(
    samples: list[tuple[int, np.ndarray, np.ndarray]], begin: int, end: int
) -> tuple[np.ndarray, np.ndarray]:
    """Integrate held twists by exponentials of homogeneous matrices (4, 4), piece by piece."""
    pose = np.eye(4)
    edges = sorted({begin, end, *(t for t, _, _ in samples if begin < t < end)})
    for a, b in pairwise(edges):
        v, w = next(((v, w) for t, v, w in reversed(samples) if t <= a), (np.zeros(3), np.zeros(3)))
        twist = np.zeros((4, 4))
        twist[:3, :3], twist[:3, 3] = np.cross(np.eye(3), w), v  # y -> w x y
        pose = pose @ expm(twist * (b - a) / NS)
    return pose[:3, :3], pose[:3, 3]


numbers = st.floats(-2.0, 2.0).map(lambda x: round(x, 3))
vectors = st.tuples(numbers, numbers, numbers).map(np.array)


@given(
    st.lists(st.tuples(st.integers(0, 200), vectors, vectors), min_size=1, max_size=6, unique_by=lambda s: s[0]),
    st.integers(0, 200),
    st.integers(0, 200),
)
def test_held_twists_are_integrated_exactly(rows: list[tuple[int, np.ndarray, np.ndarray]], a: int, b: int) -> None:
    samples = [(t * NS // 1000, v, w) for t, v, w in sorted(rows, key=lambda row: row[0])]
    begin, end = sorted((a * NS // 1000, b * NS // 1000))
    odometer = Odometer()
    for t, v, w in samples:
        odometer.put(t, Twist(v, w))
    odometer.increment(0, begin)
    R, p = odometer.increment(begin, end)
    R_expected, p_expected = integrated(samples, begin, end)
    np.testing.assert_allclose(R, R_expected, atol=1e-8)
    np.testing.assert_allclose(p, p_expected, atol=1e-8)


@given(st.lists(st.integers(1, 20), min_size=2, max_size=8), st.randoms())
def test_the_order_in_which_two_sensors_come_does_not_matter(gaps: list[int], random: object) -> None:
    """Each sensor's samples come in order, but one sensor may come later than the other."""
    wheel = [(t * 7_000_001, Twist(np.array([0.1 * t, 0.0, 0.0]), None)) for t in range(1, len(gaps) + 1)]
    gyro = [(t * 5_000_003, Twist(None, np.array([0.0, 0.0, 0.2 * t]))) for t in range(1, 2 * len(gaps))]
    in_order, one_late = Odometer(), Odometer()
    for stamp, twist in sorted(wheel + gyro, key=lambda sample: sample[0]):
        in_order.put(stamp, twist)
    for stamp, twist in gyro + wheel:
        one_late.put(stamp, twist)
    end = 10**8
    for expected, got in zip(in_order.increment(0, end), one_late.increment(0, end), strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-12)


def test_its_age_is_that_of_the_sensor_that_is_older() -> None:
    odometer = Odometer()
    odometer.put(5, Twist(np.ones(3), None))
    assert odometer.stamp is None
    odometer.put(3, Twist(None, np.ones(3)))
    assert odometer.stamp == 3


def test_samples_that_are_not_taken_fill_no_memory() -> None:
    odometer = Odometer()
    for k in range(5 * MOST_SAMPLES):
        odometer.put(k, Twist(np.array([float(k), 0.0, 0.0]), np.zeros(3)))
    assert len(odometer._waiting) <= MOST_SAMPLES


NS_PER_MS = 1_000_000
START = 1_700_000_000 * 1_000_000_000
"""ns: a wall clock's numbers, at which float64 no longer tells nanoseconds apart."""


def test_it_is_on_the_straight_line_and_goes_on_for_a_tenth_of_a_second() -> None:
    track = PlaceTrack()
    assert track.stamp < 0
    for k in range(5):
        track.put(START + 16 * k * NS_PER_MS, np.array([0.26 * 0.016 * k, 1.45, 0.0]))
    np.testing.assert_allclose(track.at(START + 24 * NS_PER_MS), [0.26 * 0.024, 1.45, 0.0], atol=1e-12)
    np.testing.assert_allclose(track.at(START + 80 * NS_PER_MS), [0.26 * 0.080, 1.45, 0.0], atol=1e-12)
    np.testing.assert_allclose(track.at(START + 1000 * NS_PER_MS), [0.26 * 0.164, 1.45, 0.0], atol=1e-12)
    np.testing.assert_allclose(track.at(START - 1000 * NS_PER_MS), [0.0, 1.45, 0.0], atol=1e-12)


def test_old_positions_and_positions_out_of_order_do_not_count() -> None:
    track = PlaceTrack()
    track.put(START, np.array([1.0, 0.0, 0.0]))
    for older in (START - 1, START):
        track.put(older, np.array([9.0, 0.0, 0.0]))
    assert track.stamp == START and track.at(START)[0] == 1.0
    track.put(START + 200 * NS_PER_MS, np.array([3.0, 0.0, 0.0]))
    assert track.at(START + 250 * NS_PER_MS)[0] == 3.0  # nothing is said of its speed by positions so far apart
    track = PlaceTrack()
    for k in range(2 * KEPT):
        track.put(START + k * NS_PER_MS, np.array([float(k), 0.0, 0.0]))
    assert track.at(START)[0] == KEPT  # the oldest that is kept
