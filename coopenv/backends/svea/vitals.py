"""What safety is judged by: when each sensor last told something new that can be used, and where every car is."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.svea.samples import Pose, Report, Sample
from coopenv.svea.topics import Role

AHEAD = 50_000_000  # ns by which a stamp may be ahead of the receiver's clock


@dataclass(frozen=True)
class Place:
    """Where a car is."""

    position: Array  # (3,) m, in the coordinates of the scenario's file
    time: int  # ns, when that was known


class Vitals:
    """Kept by the step loop, read by the watchdog's thread; times are in ns on the receiver's clock.

    Bytes that come are no sign of life: what counts is a message that can be read, with a stamp newer than all before.
    """

    def __init__(self, judge: Literal["truth", "estimate"]) -> None:
        """Say by what places are judged: motion capture, or what the cars believe."""
        self._judge = judge
        self._stamps: dict[tuple[str, Role], int] = {}
        self._told: dict[tuple[str, Role], int] = {}
        self.places: Mapping[str, Place] = {}
        """Replaced as a whole whenever one changes."""
        self.looked = 0
        """When messages were looked at last."""
        self._begun = 0

    def begin(self, now: int) -> None:
        """Forget where the cars were."""
        self.places, self.looked, self._begun = {}, now, now

    def put(self, sample: Sample) -> None:
        """Take a sample."""
        key = sample.car, sample.role
        if sample.stamp > sample.received + AHEAD or sample.stamp <= self._stamps.get(key, -1):
            return
        self._stamps[key] = sample.stamp
        # Motion capture has a clock of its own, of which nobody knows how late it is.
        self._told[key] = sample.received if sample.role is Role.TRUTH else min(sample.stamp, sample.received)
        judging = (Role.TRUTH,) if self._judge == "truth" else (Role.ESTIMATE, Role.REPORT, Role.POINT)
        if sample.role in judging and isinstance(sample.value, Pose | Report) and sample.value.position is not None:
            self.place(sample.car, sample.value.position, self._told[key])

    def place(self, car: str, position: Array, time: int) -> None:
        """Say where a car is, m, and when that was known."""
        if np.isfinite(position).all():
            self.places = {**self.places, car: Place(position, time)}

    def age(self, car: str, role: Role) -> float:
        """Return how old a sensor's last word was when messages were looked at last, s; inf: it has never spoken."""
        told = self._told.get((car, role))
        return float("inf") if told is None else max(self.looked - told, 0) * 1e-9

    def lost(self, car: str) -> float:
        """Return for how long nobody had known where a car was when messages were looked at last, s."""
        place = self.places.get(car)
        return max(self.looked - (self._begun if place is None else place.time), 0) * 1e-9
