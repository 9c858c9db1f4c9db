"""Watchdog, gates, checks before arming, and the status of cars: blind, lost, stopped or silent ones do not drive."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from coopenv.base.errors import CoopenvError
from coopenv.cars.backend.assembler import Assembler
from coopenv.cars.backend.buffers import StatusBoard
from coopenv.cars.backend.station import LATE, Gates, Station
from coopenv.cars.backend.watchdog import BEARING_STD, LinkMonitor, Watchdog, bearing_nis
from coopenv.cars.fake.lockstep import Hub
from coopenv.cars.gate.gate import Gate
from coopenv.cars.gate.process import GateConnection
from coopenv.cars.link.clock import CLOCK, Clock, SimulatedClock
from coopenv.cars.link.transport import Arrival
from coopenv.cars.messages.codec import encode, header, make
from coopenv.cars.messages.readings import CarPose, Sample, Twist
from coopenv.cars.messages.vision import Calibration
from coopenv.cars.settings.deployment import Remote, Safety
from coopenv.cars.settings.limits import USUAL
from coopenv.cars.settings.profile import SVEA, Role
from coopenv.estimation.poses import exp_so3
from coopenv.sources.base import VehicleBroadcast
from tests.cars.backend.test_assembler import binding
from tests.helpers.processes import wait_until

WHEEL = SVEA.topic_of("a", Role.WHEEL)
MS = 1_000_000
BEGIN = 10**15


def sample(car: str, role: Role, stamp: int, value: Any = None, received: int | None = None) -> Sample:
    return Sample(car, role, stamp, stamp if received is None else received, value)


def at(x: float, y: float = 0.0) -> CarPose:
    return CarPose(np.array([x, y, 0.0]))


def test_only_newer_messages_are_signs_of_life() -> None:
    monitor, still, assembler = LinkMonitor("truth"), Twist(np.zeros(3), np.zeros(3)), Assembler(binding())

    def put(stamp: int, received: int) -> None:
        given = sample("car0", Role.WHEEL, BEGIN + stamp * MS, still, received=BEGIN + received * MS)
        if assembler.put(given):
            monitor.put(given)

    assert monitor.age("car0", Role.WHEEL) == float("inf")
    for k in range(20):  # the same bytes again and again, and one from far in the future
        put(0, 10 * k)
    put(10_000, 200)
    monitor.looked = BEGIN + 200 * MS
    assert monitor.age("car0", Role.WHEEL) == pytest.approx(0.2)
    put(190, 195)
    assert monitor.age("car0", Role.WHEEL) == pytest.approx(0.01)
    assert monitor.age("car0", Role.IMU) == float("inf") and monitor.age("b", Role.WHEEL) == float("inf")


def test_positions_come_from_the_judging_source() -> None:
    for judge, x in (("truth", 1.0), ("estimate", 2.0)):
        monitor = LinkMonitor(judge)  # type: ignore[arg-type]
        monitor.begin(BEGIN)
        monitor.put(sample("a", Role.TRUTH, BEGIN + MS, at(1.0)))
        monitor.put(sample("a", Role.ESTIMATE, BEGIN + MS, at(2.0)))
        assert monitor.places["a"].position[0] == x
        monitor.place("a", np.array([np.nan, 0.0, 0.0]), BEGIN + 400 * MS)
        monitor.looked = BEGIN + 401 * MS
        assert monitor.lost("a") == pytest.approx(0.4), "not a number is no place"


def test_an_estimate_that_is_wrong_for_long_is_doubted() -> None:
    monitor, none, unknown = LinkMonitor("truth"), np.zeros(0), (float("nan"), float("nan"))
    safety = Safety(max_std=0.5, max_protection_level=1.0)
    cases = {
        "0.2 m from motion capture, safety.max_error = 0.15": (0.2, 0.0, 0.1, 0.0, none),
        "0.3 rad from motion capture, safety.max_turn_error = 0.15": (0.0, 0.3, 0.1, 0.0, none),
        "0.6 m uncertain, safety.max_std = 0.5": (*unknown, 0.6, 0.0, none),
        "inf m off at worst, if one source is faulty, safety.max_protection_level = 1": (*unknown, 0.1, np.inf, none),
        "20 squared standard deviations from its bearings": (*unknown, 0.1, 0.0, np.full(8, 20.0)),
        "": (0.1, 0.1, 0.4, 0.9, np.array([*[1.0] * 5, *[1e6] * 4])),  # false bearings are fewer than half
    }
    for (said, given), settled in itertools.product(cases.items(), (False, True)):
        monitor.begin(BEGIN)
        for ms in (0, 100, 190, 210) if settled else ():
            assert not monitor.settled("a")
            monitor.looked = BEGIN + ms * MS
            monitor.judge("a", safety, 0.0, 0.0, 0.0, 0.0, none)
        assert monitor.settled("a") == settled
        begin, patience = monitor.looked, 200 if settled else 2000
        for ms in (0, patience // 2, patience - 10, patience + 10):
            monitor.looked = begin + ms * MS
            monitor.judge("a", safety, *given)
            assert bool(monitor.doubt("a")) == (bool(said) and ms > patience)
            assert monitor.settled("a") == (settled or (not said and ms > 200))
        assert said in monitor.doubt("a") and not monitor.doubt("b")
        monitor.judge("a", Safety(max_error=None, max_turn_error=None, max_nis=None), *given)
        assert bool(monitor.doubt("a")) == (bool(said) and not settled)  # one good tick does not settle it


def test_the_innovation_of_bearings_counts_in_standard_deviations() -> None:
    rng = np.random.default_rng(0)
    lever, landmarks = np.array([0.3, 0.0, 0.2]), rng.uniform(-4.0, 4.0, (6, 3)) + np.array([0.0, 8.0, 0.0])
    P, found, wrong = np.diag([4e-4] * 3 + [9e-4] * 3), [], []
    for _ in range(400):
        R, p = exp_so3(rng.normal(size=3)), rng.normal(size=3)
        rays = (landmarks - p) @ R - lever
        bearings = rays / np.linalg.norm(rays, axis=1, keepdims=True) + rng.normal(0.0, BEARING_STD, (6, 3))
        theta, place = rng.normal(0.0, 0.02, 3), R.T @ p + rng.normal(0.0, 0.03, 3)  # errors of (2 lambda, p)
        sent = VehicleBroadcast(0, R @ exp_so3(theta), R @ exp_so3(theta) @ place, P, None)
        found.append(bearing_nis(sent, landmarks, lever, bearings))
        wrong.append(bearing_nis(sent, landmarks, lever, bearings[::-1]))
    assert np.mean(found) == pytest.approx(1.0, abs=0.1) and np.median(wrong) > 50.0


CORNERS = ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))


def closed_watchdog(safety: Safety, monitor: LinkMonitor) -> Watchdog:
    """Return one whose thread has ended; a is driven here, b is not."""
    station, gates = Station(Hub().connect(), (), None, {}), Gates(Hub().connect(), (), USUAL, None)
    made = Watchdog(safety, station, gates, monitor, ("a",), ("b",), (), 1.0)
    made.close()
    return made


@pytest.mark.parametrize(
    ("places", "judge", "found"),
    [
        ({"a": 0.0, "b": 0.5}, "truth", []),
        ({"a": 1.5, "b": 0.5}, "truth", ["a: left the geofence at (1.50, 0.00) m"]),
        ({"a": 0.4, "b": 0.5}, "truth", ["a: 0.10 m from b, 0.3 m is the least"]),
        ({"a": 0.0, "b": 3.0}, "truth", []),  # who does not drive here may be outside
        ({"a": 0.0}, "truth", ["b: its place is not known: separation cannot be judged"]),
        ({"b": 0.0}, "truth", ["a: its place is not known: fence and separation cannot be judged"]),
        ({"b": 0.0}, "estimate", []),  # for a moment after the start
    ],
)
def test_fence_and_separation(places: dict[str, float], judge: Any, found: list[str]) -> None:
    monitor = LinkMonitor(judge)
    monitor.begin(BEGIN)
    monitor.looked = BEGIN + 100 * MS
    for car, x in places.items():
        monitor.place(car, np.array([x, 0.0, 0.0]), BEGIN + 90 * MS)
    watchdog = closed_watchdog(Safety(geofence=CORNERS, separation=0.3, judge=judge), monitor)
    assert [f"{car}: {wrong}" for car, wrong in watchdog.misplaced()] == found
    monitor.looked = BEGIN + 700 * MS
    assert "a" in places or judge == "truth" or not [car for car, _ in watchdog.misplaced() if car == "a"], "settles"
    monitor.looked = BEGIN + 2100 * MS
    lost = [wrong for _, wrong in watchdog.misplaced()]
    assert len(lost) >= 2 and all("judged" in wrong for wrong in lost[:2]), "old places are none"


@pytest.mark.parametrize(
    ("starts", "velocities", "found"),
    [
        ({"a": -0.5, "b": 1.0}, {"a": 0.6}, []),  # 0.54 m to a stand
        ({"a": 0.5, "b": -0.5}, {"a": 0.6}, ["a: at (0.68, 0.00) m it needs 0.54 m to stand in the geofence"]),
        ({"a": 0.9, "b": -0.5}, {"a": -0.1}, []),  # to the inside
        ({"a": -0.5, "b": 1.26}, {"a": 0.6, "b": -0.6}, ["a: 1.40 m from b, and 0.32 m where they come to a stand, "]),
        ({"a": -0.5, "b": 0.3}, {"a": 0.6, "b": 0.6}, []),  # one behind the other
    ],
)
def test_cars_stop_in_time_to_stand_inside_the_fence_and_apart(starts: Any, velocities: Any, found: list[str]) -> None:
    monitor = LinkMonitor("truth")
    monitor.begin(BEGIN)
    for k in range(31):
        for car, x in starts.items():
            monitor.place(car, np.array([x + velocities.get(car, 0.0) * 0.01 * k, 0.0, 0.0]), BEGIN + 10 * k * MS)
    monitor.looked = BEGIN + 310 * MS
    watchdog = closed_watchdog(Safety(geofence=CORNERS, separation=0.35), monitor)
    reasons = [f"{car}: {wrong}" for car, wrong in watchdog.misplaced()]
    assert len(reasons) == len(found) and all(a.startswith(b) for a, b in zip(reasons, found, strict=True)), reasons


class Yard:
    """Gates of two cars in this process, and the station's side of them."""

    def __init__(self, clock: Clock) -> None:
        self.hub, self.clock = Hub(clock), clock
        self.links = {car: GateConnection(Gate(car, USUAL, clock), self.hub.connect()) for car in ("a", "b")}
        self.gates = Gates(self.hub.connect(), ("a", "b"), USUAL, None)
        self.publish()
        self.end_speaking = clock.repeat(0.01, self.publish, "gates")

    def publish(self) -> None:
        for link in self.links.values():
            link.publish_status()

    def stop(self, car: str) -> None:
        self.hub.connect().publish(SVEA.topic_of(car, Role.STOP), encode(make("std_msgs/msg/Bool", data=True)))


@pytest.fixture
def yard() -> Yard:
    return Yard(SimulatedClock())


def states(yard: Yard) -> list[str]:
    return [state.state for state in yard.gates.states.values()]


def test_gates_open(yard: Yard) -> None:
    yard.gates.begin()
    assert states(yard) == ["armed", "armed"]


def test_an_emergency_stop_during_arming_holds(yard: Yard, monkeypatch: pytest.MonkeyPatch) -> None:
    slow = yard.links.pop("b")
    slow.publish_status()
    pressed: list[bool] = []

    def during() -> None:
        slow.publish_status()
        if states(yard)[0] == "armed" and not pressed:
            pressed.append(True)
            yard.stop("a")

    arm = yard.gates._arm
    yard.clock.repeat(0.05, during, "the other gate")
    monkeypatch.setattr(
        yard.gates, "_arm", lambda car, on, nonce: arm(car, on, nonce) if car == "a" or not on else None
    )
    with pytest.raises(CoopenvError, match="a: was stopped while it was being armed"):
        yard.gates.begin()
    yard.publish()
    assert pressed and states(yard)[0] == "stopped"


def test_a_stop_of_another_station_is_noticed_and_needs_a_release(yard: Yard) -> None:
    yard.gates.begin()
    yard.gates.stop()
    yard.publish()
    assert states(yard) == ["stopped", "stopped"] and not yard.gates.stopped_by_others
    yard.gates.begin()
    yard.stop("b")
    yard.publish()
    assert yard.gates.stopped_by_others == {"b"}
    with pytest.raises(CoopenvError, match="b: it was stopped elsewhere"):
        yard.gates.begin()
    yard.gates.begin(release=True)
    assert not yard.gates.stopped_by_others and states(yard) == ["armed", "armed"]


def test_repeated_old_and_malformed_states_of_a_gate_are_dropped(yard: Yard) -> None:
    heard: list[Arrival] = []
    yard.hub.connect().subscribe(SVEA.topic_of("a", Role.GATE), heard.append)
    yard.gates.begin()
    yard.publish()
    first, topic = heard[0], SVEA.topic_of("a", Role.GATE)
    before = yard.gates.states["a"]
    yard.hub.connect().publish(topic, first.payload)
    assert yard.gates.states["a"] == before and yard.gates.dropped["a"]["out of order"] == 1
    last = heard[-1].payload
    yard.end_speaking()
    yard.clock.sleep(LATE * 1e-9 + 0.1)
    before = yard.gates.states["a"]
    yard.hub.connect().publish(topic, last)
    assert yard.gates.states["a"] == before and yard.gates.dropped["a"]["stale"] == 1
    yard.hub.connect().publish(topic, b"\x00\x01\x00\x00 nonsense")
    assert yard.gates.dropped["a"]["malformed"] == 1


def test_a_gate_that_does_not_open_is_reported_with_the_reason(yard: Yard) -> None:
    yard.links["b"].gate._check = refuse  # type: ignore[method-assign]
    with pytest.raises(CoopenvError, match=r"b: its gate refuses this end's signature: .*--station"):
        yard.gates.begin()
    yard.publish()
    assert states(yard) == ["disarmed", "disarmed"]


def refuse(*_message: object) -> None:
    from coopenv.cars.gate.gate import Reason, Rejected

    raise Rejected(Reason.SIGNATURE)


def watchdog_of(yard: Yard, monitor: LinkMonitor) -> Watchdog:
    """Return the watchdog of a yard, which needs the wheels of a."""
    station = Station(yard.hub.connect(), [WHEEL], None, {})
    return Watchdog(Safety(odometry_age=0.3), station, yard.gates, monitor, ("a",), (), (Role.WHEEL,), 10.0)


@pytest.fixture
def guard(yard: Yard) -> Iterator[tuple[Yard, Watchdog, LinkMonitor]]:
    monitor = LinkMonitor("truth")
    made = watchdog_of(yard, monitor)
    yield yard, made, monitor
    made.close()


def live(yard: Yard, guard: Watchdog, monitor: LinkMonitor, seconds: float, usable: bool) -> None:
    """Let wheels be heard for a time, and be understood or not."""
    wire, until = yard.hub.connect(), yard.clock.seconds() + seconds
    while yard.clock.seconds() < until and guard.trip is None:
        wire.publish(WHEEL, b"whatever")
        monitor.looked = yard.clock.wall()
        if usable:
            monitor.put(sample("a", Role.WHEEL, monitor.looked, Twist(np.zeros(3), None)))
        guard.beat(0)
        yard.clock.sleep(0.01)


def test_bytes_alone_do_not_keep_a_car_going(guard: tuple[Yard, Watchdog, LinkMonitor]) -> None:
    yard, dog, monitor = guard
    yard.gates.begin()
    yard.hub.connect().publish(WHEEL, b"whatever")
    monitor.put(sample("a", Role.WHEEL, yard.clock.wall(), Twist(np.zeros(3), None)))
    dog.arm()
    live(yard, dog, monitor, 0.6, usable=True)
    assert dog.trip is None
    live(yard, dog, monitor, 5.0, usable=False)
    assert dog.trip is not None and "no usable new message on fleet/a/mavros/wheel" in dog.trip.reason
    yard.publish()
    assert states(yard) == ["stopped", "stopped"]


@pytest.mark.parametrize("clock", [CLOCK, SimulatedClock()])
def test_a_network_that_fails_does_not_end_the_watchdog(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    yard, calls = Yard(clock), list[float]()
    dog = watchdog_of(yard, LinkMonitor("truth"))
    yard.gates.begin()

    def broken() -> None:
        calls.append(clock.seconds())
        raise OSError("no network")

    with monkeypatch.context() as patch:
        patch.setattr(yard.gates, "stop", broken)
        dog.arm()  # nothing has ever been heard of the wheels
        wait_until(lambda: len(calls) > 2, lambda: clock.sleep(0.01))
    wait_until(lambda: states(yard) == ["stopped", "stopped"], lambda: clock.sleep(0.01))
    dog.forget()
    dog.arm()
    dog.close()
    yard.end_speaking()


def test_nothing_is_armed_without_a_watchdog(guard: tuple[Yard, Watchdog, LinkMonitor]) -> None:
    guard[1].close()
    with pytest.raises(CoopenvError, match="not armed: the watchdog has ended"):
        guard[1].arm()


CAR = "svea7"
CAMERA = Calibration((316, 208), (213.0, 213.5), (155.0, 115.0), (0.0,) * 5)


class Talk:
    """A car and the board of its station."""

    def __init__(self, needed: bool = True) -> None:
        self.clock = SimulatedClock()
        self.hub = Hub(self.clock)
        self.board = StatusBoard(self.hub.connect(), (CAR,), Remote(), needed)
        self.network = self.hub.connect()

    def say(self, role: Role, age: float, **fields: Any) -> None:
        self.clock.sleep(0.001)
        stamp = self.clock.wall() - round(age * 1e9)
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
def test_a_car_without_its_conditions_is_not_armed(left_out: Role) -> None:
    for old in ({}, {"age": 2.5}, {"age": -2.5}):  # silent, old, or of a clock that is far ahead
        talk = Talk()
        for role, say in ((Role.REMOTE, talk.remote), (Role.STATE, talk.state), (Role.BATTERY, talk.battery)):
            if role is not left_out:
                say()
            elif old:
                say(**old)
        assert SVEA.topic_of(CAR, left_out) in talk.obstacle()


def test_conditions_of_a_car_count_for_two_seconds() -> None:
    talk = Talk()
    talk.all_is_well()
    talk.board.begin()
    talk.clock.sleep(1.5)
    assert talk.obstacle() == talk.board.happened(CAR) == ""
    talk.clock.sleep(1.0)
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
def test_changed_conditions_prevent_arming_and_are_kept_while_armed(
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


def test_old_conditions_neither_stop_a_car_nor_keep_it_going(armed: Talk) -> None:
    armed.remote(1300, *(1500,) * 7, age=2.5)
    armed.remote(1300, *(1500,) * 7, age=1.0)  # younger ones have come
    assert armed.board.happened(CAR) == ""


def test_cars_without_conditions_are_armed_if_none_are_required() -> None:
    talk = Talk(needed=False)
    assert talk.obstacle() == ""
    talk.board.begin()
    talk.remote(rssi=0)
    assert talk.board.happened(CAR) == ""
    talk.remote(1300, *(1500,) * 7)
    assert "remote control" in talk.board.happened(CAR)
