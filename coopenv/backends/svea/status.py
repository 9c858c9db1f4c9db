"""What cars say of themselves besides what their sensors measure: armed, driven by remote control, battery, camera."""

import threading
from collections.abc import Callable

from coopenv.errors import CoopenvError
from coopenv.svea.codec import decode
from coopenv.svea.reading import read
from coopenv.svea.samples import Calibration, Status
from coopenv.svea.topics import TOPICS, Role, topic_of
from coopenv.svea.transport.base import Arrival, Transport

ROLES = (Role.STATE, Role.REMOTE, Role.BATTERY, Role.CAMERA_INFO)


class StatusBoard:
    """The last word of each car."""

    def __init__(self, transport: Transport, cars: tuple[str, ...]) -> None:
        """Listen to the cars."""
        self._lock = threading.Lock()
        self._topics = {topic_of(car, role): (car, role) for car in cars for role in ROLES}
        self._battery: dict[str, float] = {}
        self._calibration: dict[str, Calibration] = {}
        self.on_override: Callable[[str, bool], None] = lambda car, overridden: None
        for topic in self._topics:
            transport.subscribe(topic, self._take)

    def battery(self, car: str) -> float | None:
        """Return the share of a car's battery that is left; None: it is not known."""
        with self._lock:
            return self._battery.get(car)

    def calibration(self, car: str) -> Calibration | None:
        """Return what a car's camera says of itself; None: nothing yet."""
        with self._lock:
            return self._calibration.get(car)

    def _take(self, arrival: Arrival) -> None:
        car, role = self._topics[arrival.topic]
        try:
            value = read(role, decode(arrival.payload, TOPICS[role].type))
        except CoopenvError:
            return
        with self._lock:
            if isinstance(value, Calibration):
                self._calibration[car] = value
            elif isinstance(value, Status) and value.battery is not None:
                self._battery[car] = value.battery
        if isinstance(value, Status) and value.overridden is not None:
            self.on_override(car, value.overridden)
