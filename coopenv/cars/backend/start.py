"""Conditions of the cars, and the beginning of an episode: messages are awaited, checked, and the cars armed."""

import gc
import threading
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from coopenv.base.errors import CoopenvError, shown
from coopenv.cars.backend.assembler import BROADCAST, Intake
from coopenv.cars.backend.binding import Binding
from coopenv.cars.backend.station import Gates, Station
from coopenv.cars.backend.watchdog import LinkMonitor, Trip, Watchdog, misplaced
from coopenv.cars.codec import decode, encode, make, stamp_of
from coopenv.cars.deployment import Deployment, Remote
from coopenv.cars.keys import Signer, Verifier
from coopenv.cars.profile import RESET_TOPIC, SVEA, VELOCITY, CarProfile, Role, presence_of
from coopenv.cars.readings import Calibration, CarStatus, read
from coopenv.cars.transport.base import Arrival, Transport

ROLES = (Role.STATE, Role.REMOTE, Role.BATTERY, Role.CAMERA_INFO)


class Condition(NamedTuple):
    """Last message of a car about its condition."""

    status: CarStatus = CarStatus()
    stamp: int = -1  # ns, clock of the car
    since: float = float("-inf")  # s, monotonic: when the condition held


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
        self._conditions = {key: Condition() for key in self._topics.values()}
        self._begun: dict[tuple[str, Role], Condition] = {}  # as they were at arming
        self._happened: dict[str, str] = {}
        self._calibration: dict[str, Calibration] = {}
        for topic in self._topics:
            transport.subscribe(topic, self._take)

    def battery(self, car: str) -> float | None:
        """Return the share of a car's battery that is left; None: it is not known."""
        with self._lock:
            return self._conditions[car, Role.BATTERY].status.battery

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
        for role in self._conditions_needed:
            if why := self._silent(car, role):
                return why
        with self._lock:
            remote, state = (self._conditions[car, role].status for role in (Role.REMOTE, Role.STATE))
        if why := self._driven(remote):
            return why
        return "its autopilot is not armed" if Role.STATE in self._conditions_needed and not state.armed else ""

    def happened(self, car: str) -> str:
        """Return the reason to stop an armed car by its conditions since arming; empty: none."""
        with self._lock:
            happened = self._happened.get(car, "")
        return happened or (self._silent(car, Role.REMOTE) if Role.REMOTE in self._conditions_needed else "")

    def _take(self, arrival: Arrival) -> None:
        key = car, role = self._topics[arrival.topic]
        topic = self._profile.topics[role]
        try:
            message = decode(arrival.payload, topic.type)
            value, stamp = read(role, message), stamp_of(message)
        except CoopenvError:
            return
        delay = (arrival.received - stamp) * 1e-9
        with self._lock:
            if isinstance(value, Calibration):
                self._calibration[car] = value
                return
            new = stamp > self._conditions[key].stamp and abs(delay) <= (topic.max_age or 0.0)
            if isinstance(value, CarStatus) and new:
                self._conditions[key] = Condition(value, stamp, time.monotonic() - max(delay, 0.0))
                if key in self._begun and (why := self._changed(role, self._begun[key].status, value)):
                    self._happened.setdefault(car, why)

    def _driven(self, status: CarStatus) -> str:
        """Return the reason by the remote control not to drive a car; empty: none."""
        pulses, usual = status.pulses or (), self._profile.pulses
        if self._remote.drives(pulses, usual):
            return "is driven by remote control"
        return self._remote.fault(pulses, usual) if Role.REMOTE in self._conditions_needed else ""

    def _changed(self, role: Role, then: CarStatus, now: CarStatus) -> str:
        if role is Role.REMOTE:
            if why := self._driven(now):
                return why
            if self._remote.switched(now.pulses or (), then.pulses or (), self._profile.pulses):
                return "the mode switch of its remote control was moved"
        if now.armed is False and (self._needed or then.armed):
            return "its autopilot is no longer armed"
        if then.mode is not None and now.mode != then.mode:
            return f"its autopilot went from mode {shown(then.mode)} to {shown(now.mode)}"
        return ""

    def _silent(self, car: str, role: Role) -> str:
        with self._lock:
            age = time.monotonic() - self._conditions[car, role].since
        if age <= (self._profile.topics[role].max_age or 0.0):
            return ""
        words = "was received" if age == float("inf") else f"for {age:.2f} s"
        return f"no usable message {words} on {self._profile.topic_of(car, role)}"


PIXELS = 2.0
"""By which a camera's own calibration may differ from the environment's."""
DISTORTION = 0.02  # likewise, each coefficient
FIRST_MESSAGES_TIME = 3.0  # s to wait for first messages at the first reset
CAMERA_INFO_TIME = 1.5  # s to wait for the calibration of a camera; some publish none
READY_TIME = 2.0  # s to wait until all conditions of arming hold at once; cars publish theirs once a second
SETTLE = 0.5  # s for fakes to settle at their start


class Links:
    """The cars of a fleet over their network: messages, gates, conditions and the watchdog; episodes begin here."""

    def __init__(
        self,
        deployment: Deployment,
        binding: Binding,
        transport: Transport,
        signer: Signer | None,
        verifier: Verifier | None,
        stopped: Callable[[Trip], None],
    ) -> None:
        """Listen to the cars.

        Args:
            deployment: the fleet.
            binding: vehicles and markers of its cars.
            transport: the network.
            signer: signs sent messages (None: they are not signed).
            verifier: knows the cars' keys (None: signatures do not count).
            stopped: called when the watchdog stops the cars.
        """
        self.deployment, self.binding, self.scenario = deployment, binding, binding.scenario
        self._transport, self._signer = transport, signer
        profile, safety, fleet = binding.profile, deployment.safety, (*binding.cars, *binding.leaders)
        self._local = {binding.names[i]: i for i in binding.local}
        self._others = tuple(name for name in fleet if name not in self._local)
        self._odometry, cars = VELOCITY[deployment.sensors.odometry], tuple(self._local)
        self.intake = Intake(binding, deployment.sensors)
        identity = deployment.security.identity
        signers = {profile.topic_of(name, role): (name, identity) for name in fleet for role in BROADCAST}
        self.station = Station(transport, self.intake.topics, verifier, signers)
        self.gates = Gates(transport, cars, deployment.limits, signer, verifier, profile)
        self.board = StatusBoard(transport, cars, deployment.remote, deployment.conditions, profile)
        self.monitor = LinkMonitor(safety.judge)
        self.watchdog = Watchdog(
            *(safety, self.station, self.gates, self.monitor, cars, self._others, self._odometry),
            *(1.0 / self.scenario.rates.decision, profile, self.board.happened, stopped),
        )
        self._received_once = False
        transport.watch(presence_of("*"), self._presence)
        transport.announce(presence_of(identity))

    def _presence(self, key: str, there: bool) -> None:
        name = key.rsplit("/", 1)[-1]
        if name in self._local:
            self.watchdog.set_present(name, there)

    def drain(self) -> None:
        """Take the messages that have come."""
        raise NotImplementedError

    def prepare(self, seed: int) -> None:
        """Free memory now, as that would take longer than a decision may, and put fakes at the start of a seed."""
        gc.unfreeze()
        gc.collect()
        gc.freeze()  # what is left is not looked through again while cars drive
        if self.deployment.fakes:
            signed = (seed + 2**63) % 2**64 - 2**63  # the same 64 bits
            self._transport.publish(RESET_TOPIC, encode(make("std_msgs/msg/Int64", data=signed)), reliable=True)
            time.sleep(SETTLE)

    def listen(self, arm: bool) -> None:
        """Wait a limited time for messages of the cars: only driving needs them."""
        topics = [self.binding.profile.topic_of(name, role) for name in self._local for role in self._odometry]
        patience = 0.0 if self._received_once else FIRST_MESSAGES_TIME
        _wait(lambda: all(self.station.silence(topic) < 1.0 for topic in topics), patience)
        if arm:
            _wait(lambda: all(self.board.calibration(name) is not None for name in self._local), CAMERA_INFO_TIME)
        self._received_once = True
        self.drain()

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
        self.watchdog.forget()
        self.board.begin()
        self.gates.begin(release or self.deployment.fakes)
        self.watchdog.arm()

    def _problem(self) -> str | None:
        self.drain()
        return next(self._problems(), None)

    def _problems(self) -> Iterator[str]:
        """Yield the violated conditions of arming, the most basic ones first."""
        safety, profile = self.deployment.safety, self.binding.profile
        for car in self._local:
            offset = self.intake.offsets[car].seconds  # other ages depend on it
            if offset is not None and abs(offset) > safety.max_clock_offset:
                where = f"{abs(offset) * 1e3:.0f} ms {'behind' if offset > 0 else 'ahead of'}"
                allowed = f"{safety.max_clock_offset * 1e3:.0f} ms are allowed"
                yield f"{car}: its clock is {where} this computer's, {allowed}: let chrony or PTP synchronise them"
            for role in self._odometry:
                topic = profile.topic_of(car, role)
                if (age := self.station.silence(topic)) > safety.odometry_age:
                    yield f"{car}: no odometry on {topic} {_since(age)}"
                if (age := self.monitor.age(car, role)) > safety.odometry_age:
                    yield f"{car}: no usable new message on {topic} {_since(age)}"
            camera = profile.topic_of(car, Role(self.deployment.sensors.detections))
            if (age := self.station.silence(camera)) > safety.odometry_age:
                yield f"{car}: no camera frames on {camera} {_since(age)}"
            yield from (f"{car}: {why}" for why in self._about_itself(car))
        if safety.judge == "truth":  # estimates are not known before cars drive
            for car, wrong in misplaced(safety, self.monitor, self._local, self._others):
                yield f"{car}: {wrong}"

    def _about_itself(self, car: str) -> Iterator[str]:
        least = self.deployment.safety.min_battery
        if obstacle := self.board.obstacle(car):
            yield obstacle
        battery = self.board.battery(car)
        needed = self.deployment.conditions and "battery" in self.binding.profile.conditions
        if battery is None and needed and least > 0.0:
            yield "its battery publishes no charge (safety.min_battery = 0 needs none)"
        if battery is not None and battery < least:
            yield f"its battery is at {100 * battery:.0f} %, {100 * least:.0f} % are needed"
        published, used = self.board.calibration(car), self.intake.calibrations[car]
        tolerances = {"image_size": 0.5, "focal_length": PIXELS, "principal_point": PIXELS, "distortion": DISTORTION}
        for name, tolerance in tolerances.items() if published is not None else ():
            a, b = getattr(published, name), getattr(used, name)
            if (np.abs(np.subtract(a, b)) > tolerance).any():
                yield f"its camera publishes {name} = {list(a)}, the environment has {list(b)}"


def _since(age: float) -> str:
    return "(none was received)" if np.isinf(age) else f"for {age:.2f} s"


def _wait(ready: Callable[[], bool], patience: float) -> None:
    """Wait for something to become true, s at most."""
    until = time.monotonic() + patience
    while time.monotonic() < until and not ready():
        time.sleep(0.02)
