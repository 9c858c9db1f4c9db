"""Conditions of the cars: armed, driven by remote control, battery, calibration of the camera."""

import threading
import time
from dataclasses import dataclass, field, replace

from coopenv.base.errors import CoopenvError, shown
from coopenv.cars.codec import decode, stamp_of
from coopenv.cars.deployment import Remote
from coopenv.cars.profile import SVEA, CarProfile, Role
from coopenv.cars.readings import read
from coopenv.cars.samples import Calibration, CarStatus
from coopenv.cars.transport.base import Arrival, Transport

ROLES = (Role.STATE, Role.REMOTE, Role.BATTERY, Role.CAMERA_INFO)


@dataclass(frozen=True)
class Condition:
    """Last condition of a car."""

    said: CarStatus = field(default_factory=CarStatus)
    stamps: dict[Role, int] = field(default_factory=dict)  # ns, clock of the car
    since: dict[Role, float] = field(default_factory=dict)  # s, monotonic: when what was said held

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
            return self._conditions[car].said.battery

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
        if self._remote.drives(now.said.pulses or (), self._profile.pulses):
            return "is driven by remote control"
        fault = self._remote.fault(now.said.pulses or (), self._profile.pulses)
        if fault and Role.REMOTE in self._conditions_needed:
            return fault
        return "its autopilot is not armed" if Role.STATE in self._conditions_needed and not now.said.armed else ""

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
                    now = Condition(_joined(before.said, value, role), {**before.stamps, role: stamp}, since)
                    self._conditions[car] = now
                    if car in self._begun and (why := self._changed(self._begun[car].said, now.said)):
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
        return f"nothing of use has {'ever come' if age == float('inf') else f'come for {age:.2f} s'} on {topic}"


def _joined(before: CarStatus, value: CarStatus, role: Role) -> CarStatus:
    """Return a condition with the values of one role replaced."""
    if role is Role.STATE:
        return replace(before, armed=value.armed, mode=value.mode)
    if role is Role.REMOTE:
        return replace(before, pulses=value.pulses)
    return replace(before, battery=value.battery)
