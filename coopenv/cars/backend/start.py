"""Conditions of the cars, and the beginning of an episode: messages are awaited, checked, and the cars armed."""

import gc
import threading
import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from coopenv.base.errors import CoopenvError, shown
from coopenv.cars.backend.assembler import Intake
from coopenv.cars.backend.station import Gates, Station
from coopenv.cars.backend.watchdog import LinkMonitor, Watchdog, misplaced
from coopenv.cars.codec import decode, encode, make, stamp_of
from coopenv.cars.deployment import Deployment, Remote
from coopenv.cars.profile import RESET_TOPIC, SVEA, VELOCITY, CarProfile, Role
from coopenv.cars.readings import read
from coopenv.cars.samples import Calibration, CarStatus
from coopenv.cars.transport.base import Arrival, Transport

ROLES = (Role.STATE, Role.REMOTE, Role.BATTERY, Role.CAMERA_INFO)


@dataclass(frozen=True)
class Condition:
    """Last condition of a car."""

    status: CarStatus = field(default_factory=CarStatus)
    stamps: dict[Role, int] = field(default_factory=dict)  # ns, clock of the car
    since: dict[Role, float] = field(default_factory=dict)  # s, monotonic: when the condition held

    def age(self, role: Role) -> float:
        """Return the age of the last message of a role, s; inf: none was received."""
        return time.monotonic() - self.since.get(role, float("-inf"))


class StatusBoard:
    """Last condition of each car, and the reasons to stop it since arming."""

    def __init__(
        self, transport: Transport, cars: tuple[str, ...], remote: Remote, needed: bool, profile: CarProfile = SVEA
    ) -> None:
        """Subscribe to the conditions of the cars.

        Args:
            transport: the network.
            cars: their names.
            remote: channels of their remote controls.
            needed: whether cars must send the conditions of their profile.
            profile: make of the cars.
        """
        self._lock = threading.Lock()
        self._remote, self._needed, self._profile = remote, needed, profile
        self._conditions_needed = tuple(map(Role, profile.conditions)) if needed else ()
        self._topics = {profile.topic_of(car, role): (car, role) for car in cars for role in ROLES}
        self._conditions = {car: Condition() for car in cars}
        self._begun: dict[str, Condition] = {}  # as it was at arming
        self._happened: dict[str, str] = {}
        self._calibration: dict[str, Calibration] = {}
        for topic in self._topics:
            transport.subscribe(topic, self._take)

    def battery(self, car: str) -> float | None:
        """Return the share of a car's battery that is left; None: it is not known."""
        with self._lock:
            return self._conditions[car].status.battery

    def calibration(self, car: str) -> Calibration | None:
        """Return the calibration that a car publishes; None: none was received."""
        with self._lock:
            return self._calibration.get(car)

    def begin(self) -> None:
        """Take the present conditions as the reference for changes."""
        with self._lock:
            self._begun, self._happened = dict(self._conditions), {}

    def obstacle(self, car: str) -> str:
        """Return the reason not to arm a car by its conditions; empty: none."""
        with self._lock:
            now = self._conditions[car]
        for role in self._conditions_needed:
            if why := self._silent(now, car, role):
                return why
        if self._remote.drives(now.status.pulses or (), self._profile.pulses):
            return "is driven by remote control"
        fault = self._remote.fault(now.status.pulses or (), self._profile.pulses)
        if fault and Role.REMOTE in self._conditions_needed:
            return fault
        return "its autopilot is not armed" if Role.STATE in self._conditions_needed and not now.status.armed else ""

    def happened(self, car: str) -> str:
        """Return the reason to stop an armed car by its conditions since arming; empty: none."""
        with self._lock:
            now, happened = self._conditions[car], self._happened.get(car, "")
        return happened or (self._silent(now, car, Role.REMOTE) if Role.REMOTE in self._conditions_needed else "")

    def _take(self, arrival: Arrival) -> None:
        car, role = self._topics[arrival.topic]
        try:
            message = decode(arrival.payload, self._profile.topics[role].type)
            value, stamp = read(role, message), stamp_of(message)
        except CoopenvError:
            return
        delay = (arrival.received - stamp) * 1e-9
        with self._lock:
            if isinstance(value, Calibration):
                self._calibration[car] = value
            elif isinstance(value, CarStatus) and abs(delay) <= (self._profile.topics[role].max_age or 0.0):
                before = self._conditions[car]
                if stamp > before.stamps.get(role, -1):
                    since = {**before.since, role: time.monotonic() - max(delay, 0.0)}
                    now = Condition(_joined(before.status, value, role), {**before.stamps, role: stamp}, since)
                    self._conditions[car] = now
                    if car in self._begun and (why := self._changed(self._begun[car].status, now.status)):
                        self._happened.setdefault(car, why)

    def _changed(self, then: CarStatus, now: CarStatus) -> str:
        pulses, usual = now.pulses or (), self._profile.pulses
        if self._remote.drives(pulses, usual):
            return "is driven by remote control"
        if Role.REMOTE in self._conditions_needed and (fault := self._remote.fault(pulses, usual)):
            return fault
        if self._remote.switched(pulses, then.pulses or (), usual):
            return "the mode switch of its remote control was moved"
        if now.armed is False and (self._needed or then.armed):
            return "its autopilot is no longer armed"
        if then.mode is not None and now.mode != then.mode:
            return f"its autopilot went from mode {shown(then.mode)} to {shown(now.mode)}"
        return ""

    def _silent(self, condition: Condition, car: str, role: Role) -> str:
        age, topic = condition.age(role), self._profile.topic_of(car, role)
        if age <= (self._profile.topics[role].max_age or 0.0):
            return ""
        return f"no usable message {'was received' if age == float('inf') else f'for {age:.2f} s'} on {topic}"


def _joined(before: CarStatus, value: CarStatus, role: Role) -> CarStatus:
    """Return a condition with the values of one role replaced."""
    if role is Role.STATE:
        return replace(before, armed=value.armed, mode=value.mode)
    if role is Role.REMOTE:
        return replace(before, pulses=value.pulses)
    return replace(before, battery=value.battery)


PIXELS = 2.0
"""By which a camera's own calibration may differ from the environment's."""
DISTORTION = 0.02  # likewise, each coefficient


@dataclass(frozen=True)
class Fleet:
    """What is checked."""

    deployment: Deployment
    calibrations: dict[str, Calibration]  # of the environment, by car
    station: Station
    intake: Intake
    board: StatusBoard
    monitor: LinkMonitor
    others: Collection[str]  # cars of the fleet that are not driven here


def problems_of(fleet: Fleet) -> Iterator[str]:
    """Yield the violated conditions of arming, the most basic ones first."""
    safety, sensors = fleet.deployment.safety, fleet.deployment.sensors
    for car in fleet.calibrations:
        yield from _its_clock(fleet, car)  # other ages depend on it
        for role in VELOCITY[sensors.odometry]:
            topic = fleet.deployment.profile.topic_of(car, role)
            if (age := fleet.station.silence(topic)) > safety.odometry_age:
                yield f"{car}: no odometry on {topic} {_since(age)}"
            if (age := fleet.monitor.age(car, role)) > safety.odometry_age:
                yield f"{car}: no usable new message on {topic} {_since(age)}"
        camera = fleet.deployment.profile.topic_of(car, Role(sensors.detections))
        if (age := fleet.station.silence(camera)) > safety.odometry_age:
            yield f"{car}: no camera frames on {camera} {_since(age)}"
        yield from _about_itself(fleet, car)
    if safety.judge == "truth":  # estimates are not known before cars drive
        for car, wrong in misplaced(safety, fleet.monitor, fleet.calibrations, fleet.others):
            yield f"{car}: {wrong}"


def _its_clock(fleet: Fleet, car: str) -> Iterator[str]:
    safety, offset = fleet.deployment.safety, fleet.intake.offsets[car].seconds
    if offset is not None and abs(offset) > safety.max_clock_offset:
        yield (
            f"{car}: its clock is {abs(offset) * 1e3:.0f} ms {'behind' if offset > 0 else 'ahead of'} this computer's, "
            f"{safety.max_clock_offset * 1e3:.0f} ms are allowed: let chrony or PTP synchronise them"
        )


def _about_itself(fleet: Fleet, car: str) -> Iterator[str]:
    safety = fleet.deployment.safety
    if obstacle := fleet.board.obstacle(car):
        yield f"{car}: {obstacle}"
    battery = fleet.board.battery(car)
    needed = fleet.deployment.conditions and "battery" in fleet.deployment.profile.conditions
    if battery is None and needed and safety.min_battery > 0.0:
        yield f"{car}: its battery publishes no charge (safety.min_battery = 0 needs none)"
    if battery is not None and battery < safety.min_battery:
        yield f"{car}: its battery is at {100 * battery:.0f} %, {100 * safety.min_battery:.0f} % are needed"
    published, used = fleet.board.calibration(car), fleet.calibrations[car]
    if published is not None and (difference := _difference(published, used)):
        yield f"{car}: its camera publishes {difference}"


def _difference(published: Calibration, used: Calibration) -> str:
    """Return in which entry two calibrations differ, empty where they agree."""
    for name, tolerance in (("image_size", 0.5), ("focal_length", PIXELS), ("principal_point", PIXELS)):
        a, b = getattr(published, name), getattr(used, name)
        if (np.abs(np.subtract(a, b)) > tolerance).any():
            return f"{name} = {list(a)}, the environment has {list(b)}"
    if (np.abs(np.subtract(published.distortion, used.distortion)) > DISTORTION).any():
        return f"distortion = {list(published.distortion)}, the environment has {list(used.distortion)}"
    return ""


def _since(age: float) -> str:
    return "(none was received)" if np.isinf(age) else f"for {age:.2f} s"


FIRST_MESSAGES_TIME = 3.0  # s to wait for first messages at the first reset
CAMERA_INFO_TIME = 1.5  # s to wait for the calibration of a camera; some publish none
READY_TIME = 2.0  # s to wait until all conditions of arming hold at once; cars publish theirs once a second
SETTLE = 0.5  # s for fakes to settle at their start


class Start:
    """Begins episodes."""

    def __init__(
        self,
        fleet: Fleet,
        transport: Transport,
        gates: Gates,
        watchdog: Watchdog,
        odometry: Collection[Role],
        drain: Callable[[], None],
    ) -> None:
        """Say of what.

        Args:
            fleet: what is checked.
            transport: the network.
            gates: of the cars.
            watchdog: looks after them.
            odometry: what each car has to measure.
            drain: takes what has come.
        """
        self._fleet, self._transport, self._gates, self._watchdog = fleet, transport, gates, watchdog
        topic_of = fleet.deployment.profile.topic_of
        self._topics = [topic_of(name, role) for name in fleet.calibrations for role in odometry]
        self._drain, self._received_once = drain, False

    def prepare(self, seed: int) -> None:
        """Free memory now, as that would take longer than a decision may, and put fakes at the start of a seed."""
        gc.unfreeze()
        gc.collect()
        gc.freeze()  # what is left is not looked through again while cars drive
        if self._fleet.deployment.fakes:
            signed = (seed + 2**63) % 2**64 - 2**63  # the same 64 bits
            self._transport.publish(RESET_TOPIC, encode(make("std_msgs/msg/Int64", data=signed)), reliable=True)
            time.sleep(SETTLE)

    def listen(self, arm: bool) -> None:
        """Wait a limited time for messages of the cars: only driving needs them."""
        silence, board = self._fleet.station.silence, self._fleet.board
        _wait(
            lambda: all(silence(topic) < 1.0 for topic in self._topics),
            0 if self._received_once else FIRST_MESSAGES_TIME,
        )
        if arm:
            _wait(
                lambda: all(board.calibration(name) is not None for name in self._fleet.calibrations), CAMERA_INFO_TIME
            )
        self._received_once = True
        self._drain()

    def arm(self, release: bool) -> None:
        """Open the gates and look after the cars.

        Args:
            release: whether to arm cars that another station has stopped as well.

        Raises:
            CoopenvError: a condition of arming does not hold.
        """
        _wait(lambda: self._problem() is None, READY_TIME)
        if found := self._problem():
            raise CoopenvError(f"not armed: {found}")
        self._watchdog.forget()
        self._fleet.board.begin()
        self._gates.begin(release or self._fleet.deployment.fakes)
        self._watchdog.arm()

    def _problem(self) -> str | None:
        self._drain()
        return next(problems_of(self._fleet), None)


def _wait(ready: Callable[[], bool], patience: float) -> None:
    """Wait for something to become true, s at most."""
    until = time.monotonic() + patience
    while time.monotonic() < until and not ready():
        time.sleep(0.02)
