"""Conditions of the cars as they publish them: why one is not armed, or is stopped."""

import threading
import time
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from coopenv.base.errors import CoopenvError, shown
from coopenv.cars.codec import decode, stamp_of
from coopenv.cars.deployment import Remote
from coopenv.cars.profile import SVEA, CarProfile, Role
from coopenv.cars.readings import CarStatus, read
from coopenv.cars.transport.base import Arrival, Transport
from coopenv.cars.vision import Calibration

ROLES = (Role.STATE, Role.REMOTE, Role.BATTERY, Role.CAMERA_INFO)
TOLERANCES = {"image_size": 0.5, "focal_length": 2.0, "principal_point": 2.0, "distortion": 0.02}
"""By which a camera's own calibration may differ from the environment's: pixels; each coefficient of the distortion."""


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
        self.calibrations: dict[str, Calibration] = {}
        """Of the cars that publish theirs."""
        for topic in self._topics:
            transport.subscribe(topic, self._take)

    def begin(self) -> None:
        """Take the present conditions as the reference for changes."""
        with self._lock:
            self._begun, self._happened = dict(self._conditions), {}

    def obstacles(self, car: str, least: float, used: Calibration) -> Iterator[str]:
        """Yield reasons not to arm a car by its conditions.

        Args:
            car: its name.
            least: share of its battery that it needs.
            used: calibration of its camera, which its own has to agree with.
        """
        remote, state = self._conditions[car, Role.REMOTE].status, self._conditions[car, Role.STATE].status
        battery = self._conditions[car, Role.BATTERY].status.battery
        yield from filter(None, (self._silent(car, role) for role in self._conditions_needed))
        if why := self._driven(remote):
            yield why
        if Role.STATE in self._conditions_needed and not state.armed:
            yield "its autopilot is not armed"
        if battery is None and Role.BATTERY in self._conditions_needed and least > 0.0:
            yield "its battery publishes no charge (safety.min_battery = 0 needs none)"
        if battery is not None and battery < least:
            yield f"its battery is at {100 * battery:.0f} %, {100 * least:.0f} % are needed"
        published = self.calibrations.get(car)
        for name, tolerance in TOLERANCES.items() if published is not None else ():
            a, b = getattr(published, name), getattr(used, name)
            if len(a) != len(b) or (np.abs(np.subtract(a, b)) > tolerance).any():
                yield f"its camera publishes {name} = {list(a)}, the environment has {list(b)}"

    def happened(self, car: str) -> str:
        """Return the reason to stop an armed car by its conditions since arming; empty: none."""
        silent = self._silent(car, Role.REMOTE) if Role.REMOTE in self._conditions_needed else ""
        return self._happened.get(car) or silent

    def _take(self, arrival: Arrival) -> None:
        key = car, role = self._topics[arrival.topic]
        topic = self._profile.topics[role]
        try:
            message = decode(arrival.payload, topic.type)
            value, stamp = read(role, message, vision=self._profile.vision), stamp_of(message)
        except CoopenvError:
            return
        delay = (arrival.received - stamp) * 1e-9
        with self._lock:
            if isinstance(value, Calibration):
                self.calibrations[car] = value
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
        age = time.monotonic() - self._conditions[car, role].since
        if age <= (self._profile.topics[role].max_age or 0.0):
            return ""
        words = "was received" if age == float("inf") else f"for {age:.2f} s"
        return f"no usable message {words} on {self._profile.topic_of(car, role)}"
