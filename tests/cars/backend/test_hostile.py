"""What anybody can send to a station: random bytes, cut-off and huge messages, NaN, floods, forgeries and replays."""

from __future__ import annotations

import time
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from coopenv.cars.backend.assembler import Assembler, Intake
from coopenv.cars.backend.binding import Binding, bind
from coopenv.cars.backend.station import MOST_WAITING, Station
from coopenv.cars.codec import MOST_BYTES, encode, header, make
from coopenv.cars.deployment import Car, Sensors
from coopenv.cars.keys import Signer, Verifier
from coopenv.cars.profile import SVEA, Role
from coopenv.cars.transport.base import Arrival
from coopenv.scenario import load_scenario
from tests.helpers.hub import Hub

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


def test_a_flood_of_one_topic_takes_nobody_elses_place() -> None:
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


def test_what_others_have_not_signed_is_dropped_and_counted(tmp_path: Path) -> None:
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
