"""Messages of other cars: moving landmarks, and vehicles that are estimated elsewhere."""

from collections import Counter
from dataclasses import replace
from typing import Any, TypeVar, cast

import numpy as np

from coopenv.backends.base import VehicleBroadcast
from coopenv.cars.backend.binding import Binding
from coopenv.cars.backend.tracks import PlaceTrack
from coopenv.cars.codec import header, make, pose
from coopenv.cars.profile import Role
from coopenv.cars.samples import CarPose, RobustReport
from coopenv.estimation.poses import Array, left_covariance, skew
from coopenv.observers.contract import Message, Received
from coopenv.observers.robust.messages import from_six
from coopenv.scenario.base import rotation_of
from coopenv.scenario.schema import neighbour_sets


def message_of(value: CarPose | RobustReport, marker: Array) -> Message:
    """Return the message of a sender for an observer; its marker is at `marker` (3,) in the body frame, m.

    A position without an orientation gives the marker's height alone.
    """
    if isinstance(value, RobustReport):
        return Message(value.position, value.rotation, value.covariance, cast(dict[str, Array], value.extra))
    if value.rotation is None:
        return Message(value.position + np.array([0.0, 0.0, marker[2]]))
    arm = value.rotation @ marker
    covariance = None
    if value.covariance is not None:
        J = np.hstack([np.eye(3), -skew(arm)])  # of the marker's place by those of position and rotation
        covariance = J @ value.covariance @ J.T
    return Message(value.position + arm, value.rotation, covariance)


def estimate_message(sent: VehicleBroadcast, stamp: int, origin: Array) -> Any:
    """Return the PoseWithCovarianceStamped of an estimate; rotations of its covariance are about the map's axes.

    `origin` (3,) is that of the map in the coordinates of the scenario's file, which are those on the wire.
    """
    P = left_covariance(sent.rotation.T @ sent.position, sent.covariance)
    turn = np.zeros((6, 6))
    turn[:3, 3:] = turn[3:, :3] = sent.rotation  # (theta, rho) in the body to (position, rotation) in the map
    placed, covariance = pose(sent.rotation, sent.position + origin), turn @ P @ turn.T
    return make(
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        header=header(stamp, "map"),
        pose={"pose": placed, "covariance": covariance},
    )


def report_message(sent: VehicleBroadcast, stamp: int, origin: Array) -> Any | None:
    """Return the RobustReport of a vehicle, `origin` as for `estimate_message`; None: its observer has no such report.

    Its dead reckoning starts at the identity, in no map frame.
    """
    m = sent.message
    if m is None or (m.position is not None and not {"odometry", "depends_on"} <= set(m.extra)):
        return None
    if m.position is None or m.rotation is None or m.covariance is None:
        unknown = pose(np.eye(3), np.zeros(3))
        fields = {"pose": unknown, "covariance": np.eye(6), "odometry": unknown}
    else:
        placed, odometry = pose(m.rotation, m.position + origin), pose(*from_six(m.extra["odometry"]))
        fields = {"valid": True, "pose": placed, "covariance": m.covariance, "odometry": odometry}
        fields["depends_on"] = int(m.extra["depends_on"][0])
    return make("coopenv_msgs/msg/RobustReport", header=header(stamp, "map"), **fields)


def is_finite(sent: VehicleBroadcast) -> bool:
    """Return whether an estimate is finite."""
    numbers = np.concatenate([sent.rotation.ravel(), sent.position, sent.covariance.ravel()])
    return bool(np.isfinite(numbers).all())


NS = 1e-9

Placed = TypeVar("Placed", bound=CarPose | RobustReport)


class NeighbourInbox:
    """Received messages of other cars; times in ns on the receiver's clock, positions on the scenario's map."""

    def __init__(self, binding: Binding, refused: Counter[str]) -> None:
        """Begin with nothing.

        Args:
            binding: vehicles and markers of the cars.
            refused: counts of messages that are not used, by reason.
        """
        self._binding, self._refused, scenario = binding, refused, binding.scenario
        self._max_age = binding.profile.topics[Role.ESTIMATE].max_age_ns
        self._origin = np.array(scenario.map.origin)
        places = [np.array(m.position) + rotation_of(m.yaw, None) @ np.array(m.marker) for m in scenario.landmarks]
        self._landmarks = np.array(places).reshape(-1, 3) - self._origin
        self._led = {landmark: PlaceTrack() for landmark in binding.leaders.values()}
        self._receives_from = neighbour_sets(scenario)  # targets by vehicle
        markers = [*(m.marker for m in scenario.landmarks), *(v.marker for v in scenario.vehicles)]
        self._markers = [np.array(marker) for marker in markers]
        self._received: dict[int, dict[Role, tuple[int, CarPose | RobustReport]]] = {}  # since the last tick
        self._stamps: dict[tuple[int, Role], int] = {}  # stamp of a target's last message

    def on_map(self, value: Placed) -> Placed:
        """Return a value in the coordinates of the scenario's file in those of its map."""
        return value if value.position is None else replace(value, position=value.position - self._origin)

    def put_landmark(self, landmark: int, role: Role, stamp: int, age: int, value: CarPose) -> None:
        """Take a message of a moving landmark; `age` is its age at reception, ns."""
        position = message_of(self.on_map(value), self._markers[landmark]).position
        if age > self._max_age:
            self._refused["stale message"] += 1
        elif position is not None and self._is_new(landmark, role, stamp):
            self._led[landmark].put(stamp, position)  # older than the same position in another role: not kept

    def put_vehicle(self, vehicle: int, role: Role, stamp: int, value: CarPose | RobustReport) -> None:
        """Take a message of a vehicle that is estimated elsewhere."""
        if self._is_new(len(self._landmarks) + vehicle, role, stamp):
            self._received.setdefault(vehicle, {})[role] = stamp, self.on_map(value)

    def _is_new(self, target: int, role: Role, stamp: int) -> bool:
        """Return whether a message is newer than the last one of a target; count it where it is older, or replayed."""
        if stamp <= self._stamps.get((target, role), 0):
            self._refused["message out of order"] += 1
            return False
        self._stamps[target, role] = stamp
        return True

    def forget(self) -> None:
        """Drop all messages of vehicles."""
        self._received.clear()

    def is_lost(self, target: int, now: int) -> bool:
        """Return whether a target is a moving landmark of unknown position."""
        return target in self._led and now - self._led[target].stamp > self._max_age

    def places(self, now: int, when: int) -> Array:
        """Return (L, 3) the positions of the landmarks at a time `when`; the last one of a landmark that is lost."""
        places: Array = self._landmarks.copy()
        for landmark, track in self._led.items():
            if track.stamp >= 0:
                places[landmark] = track.last if self.is_lost(landmark, now) else track.at(when)
        return places

    def messages(self, now: int) -> dict[tuple[int, int], Received]:
        """Return the messages since the last call, by receiver and sender.

        The neighbours are those of the environment. Its delays and losses do not apply, as the radio is real.
        """
        found, L = {}, len(self._landmarks)
        for sender, by_role in self._received.items():
            receivers = [i for i in self._binding.local if L + sender in self._receives_from[i]]
            newest = by_role.get(Role.REPORT) or by_role.get(Role.ESTIMATE) or by_role.get(Role.POINT)
            if newest is None or not receivers:
                continue
            stamp, value = newest
            if now - stamp > self._max_age:
                self._refused["stale message"] += 1
                continue
            message = message_of(value, self._markers[L + sender])
            found.update({(i, sender): Received(message, max(0, now - stamp) * NS) for i in receivers})
        self._received.clear()
        return found
