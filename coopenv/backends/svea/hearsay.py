"""What cars say of where they are: moving landmarks, and vehicles that are estimated elsewhere."""

from collections import Counter
from dataclasses import replace
from typing import TypeVar

import numpy as np

from coopenv.backends.svea.binding import Binding
from coopenv.backends.svea.place_track import PlaceTrack
from coopenv.backends.svea.v2x import message_of
from coopenv.estimation.arrays import Array
from coopenv.observers.contract import Received
from coopenv.scenario.starts import rotation_of
from coopenv.scenario.topology import neighbour_sets
from coopenv.svea.samples import Pose, Report
from coopenv.svea.topics import TOPICS, Role

STALE = round((TOPICS[Role.ESTIMATE].max_age or 0.0) * 1e9)
"""ns after which what another car has said no longer counts."""
NS = 1e-9

Placed = TypeVar("Placed", bound=Pose | Report)


class Hearsay:
    """Keeps what has been said; times in ns on the receiver's clock, positions on the scenario's map."""

    def __init__(self, binding: Binding, refused: Counter[str]) -> None:
        """Begin with nothing.

        Args:
            binding: who is who.
            refused: where messages are counted that are not used, by reason.
        """
        self._binding, self._refused, scenario = binding, refused, binding.scenario
        self._origin = np.array(scenario.map.origin)
        places = [np.array(m.position) + rotation_of(m.yaw, None) @ np.array(m.marker) for m in scenario.landmarks]
        self._landmarks = np.array(places).reshape(-1, 3) - self._origin
        self._led = {landmark: PlaceTrack() for landmark in binding.leaders.values()}
        self._hears = neighbour_sets(scenario)  # targets by vehicle
        markers = [*(m.marker for m in scenario.landmarks), *(v.marker for v in scenario.vehicles)]
        self._markers = [np.array(marker) for marker in markers]
        self._heard: dict[int, dict[Role, tuple[int, Pose | Report]]] = {}  # since the last tick
        self._said: dict[tuple[int, Role], int] = {}  # stamp of a target's last message

    def on_map(self, told: Placed) -> Placed:
        """Return what holds in the coordinates of the scenario's file as on its map."""
        return told if told.position is None else replace(told, position=told.position - self._origin)

    def put_landmark(self, landmark: int, role: Role, stamp: int, age: int, pose: Pose) -> None:
        """Take what a moving landmark has said of itself; `age` is that with which it came."""
        position = message_of(self.on_map(pose), self._markers[landmark]).position
        if age > STALE:
            self._refused["stale message"] += 1
        elif position is not None and self._is_new(landmark, role, stamp):
            self._led[landmark].put(stamp, position)  # unless it has said so in another role

    def put_vehicle(self, vehicle: int, role: Role, stamp: int, told: Pose | Report) -> None:
        """Take what a vehicle that is estimated elsewhere has said."""
        if self._is_new(len(self._landmarks) + vehicle, role, stamp):
            self._heard.setdefault(vehicle, {})[role] = stamp, self.on_map(told)

    def _is_new(self, target: int, role: Role, stamp: int) -> bool:
        """Return whether a message is newer than the last one of a target; count it where it is older, or replayed."""
        if stamp <= self._said.get((target, role), 0):
            self._refused["message out of order"] += 1
            return False
        self._said[target, role] = stamp
        return True

    def forget(self) -> None:
        """Forget what vehicles have said."""
        self._heard.clear()

    def is_lost(self, target: int, now: int) -> bool:
        """Return whether a target is a moving landmark of which nobody knows where it is now."""
        return target in self._led and now - self._led[target].stamp > STALE

    def places(self, now: int, when: int) -> Array:
        """Return (L, 3) where the landmarks were at a time `when`; who is lost by now is where it has been last."""
        places: Array = self._landmarks.copy()
        for landmark, track in self._led.items():
            if track.stamp >= 0:
                places[landmark] = track.last if self.is_lost(landmark, now) else track.at(when)
        return places

    def messages(self, now: int) -> dict[tuple[int, int], Received]:
        """Return what has come since the last call, by receiver and sender.

        The environment says who hears whom; its delays and losses do not count, as the radio is a real one.
        """
        found, L = {}, len(self._landmarks)
        for sender, by_role in self._heard.items():
            receivers = [i for i in self._binding.local if L + sender in self._hears[i]]
            newest = by_role.get(Role.REPORT) or by_role.get(Role.ESTIMATE) or by_role.get(Role.POINT)
            if newest is None or not receivers:
                continue
            stamp, told = newest
            if now - stamp > STALE:
                self._refused["stale message"] += 1
                continue
            message = message_of(told, self._markers[L + sender])
            found.update({(i, sender): Received(message, max(0, now - stamp) * NS) for i in receivers})
        self._heard.clear()
        return found
