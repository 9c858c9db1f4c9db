"""Binding of a fleet to its scenario: cars and vehicles, markers and targets; messages of other cars."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from coopenv.base.errors import CoopenvError, check_one_of, listed, shown
from coopenv.cars.backend.buffers import PlaceTrack
from coopenv.cars.messages.readings import CarPose, check_types
from coopenv.cars.messages.v2x import arm_of, message_of
from coopenv.cars.settings.deployment import Car
from coopenv.cars.settings.profile import SVEA, CarProfile, Role
from coopenv.estimation.poses import Array
from coopenv.observers.contract import Message, Received
from coopenv.scenario import Scenario
from coopenv.scenario.schema import neighbour_sets
from coopenv.scenario.sensing import rotation_of
from coopenv.sources.base import check_options


@dataclass(frozen=True)
class Binding:
    """A fleet and its scenario."""

    scenario: Scenario
    cars: Mapping[str, int]  # name of a car to the index of the vehicle that it is
    leaders: Mapping[str, int]  # or of the moving landmark
    targets: Mapping[int, int]  # number of a marker to the index of the target that carries it
    local: tuple[int, ...]  # vehicles that are estimated here
    profile: CarProfile = SVEA  # make of the cars

    @property
    def names(self) -> tuple[str, ...]:
        """(N,) the cars' names by vehicle."""
        return tuple(sorted(self.cars, key=lambda name: self.cars[name]))

    @property
    def unmarked(self) -> tuple[str, ...]:
        """Names of landmarks and vehicles that cameras cannot identify: no marker. A single vehicle needs none."""
        names = self.scenario.target_names
        count = len(names) if len(self.cars) > 1 else len(self.scenario.landmarks)
        return tuple(name for target, name in enumerate(names[:count]) if target not in self.targets.values())

    @property
    def remote(self) -> bool:
        """True if some vehicles are estimated on another computer."""
        return len(self.local) < len(self.cars)


def bind(
    scenario: Scenario,
    cars: Sequence[Car],
    markers: Mapping[str, int],
    where: str,
    only: str | None,
    profile: CarProfile = SVEA,
    calibrated: bool = True,
) -> Binding:
    """Return the binding.

    Args:
        scenario: scenario of the cars as vehicles.
        cars: the fleet.
        markers: numbers of the markers of landmarks, by name.
        where: name of the file, for errors.
        only: the car whose vehicle alone is estimated here; None: all are.
        profile: make of the cars.
        calibrated: the environment needs the calibration of every camera, see `check_calibrated`.

    Raises:
        CoopenvError: a name is not of the scenario, a vehicle has no car, or the camera has no calibration; the
            profile has a type that cannot be read.
    """
    check_types(profile, where)
    vehicles, landmarks = scenario.vehicle_names, [landmark.name for landmark in scenario.landmarks]
    driven = [car for car in cars if car.landmark is None]
    if len(driven) != len(vehicles):
        raise CoopenvError(
            f"{where}: cars: {len(driven)} of them are vehicles, the environment has {len(vehicles)}: "
            f"{listed(vehicles)}"
        )
    for i in [i for i, vehicle in enumerate(scenario.vehicles) if not vehicle.connected][:1]:
        raise CoopenvError(f"{where}: vehicles.{i}.connected: must be true, cars send their estimates")
    for limits in [limits for limits in scenario.limits if limits.model != "bicycle"][:1]:
        raise CoopenvError(f"{where}: dynamics.model: must be 'bicycle', cars take steering; got {shown(limits.model)}")
    left = [name for name in vehicles if name not in {car.vehicle for car in driven}]
    targets = {number: _index(landmarks, name, f"{where}: markers") for name, number in markers.items()}
    chosen, led = {}, {}
    for car in cars:
        here = f"{where}: cars.{car.name}"
        if car.landmark is not None:
            target = led[car.name] = _index(landmarks, car.landmark, f"{here}.landmark")
        else:
            chosen[car.name] = _index(vehicles, left.pop(0) if car.vehicle is None else car.vehicle, f"{here}.vehicle")
            target = len(landmarks) + chosen[car.name]
        if car.marker is not None:
            targets[car.marker] = target
    for i in range(len(vehicles)) if calibrated else ():
        check_calibrated(scenario, i, where)
    if only is not None:
        check_one_of(f"{where}: unknown car", only, chosen)
    local = tuple(range(len(vehicles))) if only is None else (chosen[only],)
    return Binding(scenario, chosen, led, targets, local, profile)


def check_calibrated(scenario: Scenario, vehicle: int, where: str) -> None:
    """Refuse a vehicle's camera without a calibration, which turns pixels into bearings, with a CoopenvError."""
    if scenario.cameras[vehicle].model != "pinhole":
        raise CoopenvError(
            f"{where}: the camera of {scenario.vehicle_names[vehicle]} has no calibration: [camera] of the environment "
            'needs model = "pinhole", image_size, focal_length, principal_point and distortion'
        )


def _index(known: Sequence[str], name: str, where: str) -> int:
    check_one_of(f"{where}: unknown name", name, known)
    return known.index(name)


OPTIONS = ("arm", "release")
"""Options of a reset: arm the cars, and release cars that another station has stopped."""


def reset_options(options: Mapping[str, Any]) -> tuple[bool, bool]:
    """Return the values of the options `OPTIONS` of a reset.

    Raises:
        CoopenvError: an option is not known, or not what it must be.
    """
    check_options(options, OPTIONS)
    for name in OPTIONS:
        if not isinstance(value := options.get(name, False), bool):
            raise CoopenvError(f"option '{name}' must be true or false, got {shown(value)}")
    return options.get("arm", False), options.get("release", False)


def marker_places(landmarks: Sequence[Any]) -> Array:
    """Return the positions (L, 3) of the markers of a scenario's landmarks, m."""
    places = [np.array(m.position) + rotation_of(m.yaw, None) @ np.array(m.marker) for m in landmarks]
    return np.array(places).reshape(-1, 3)


NS = 1e-9


class NeighbourInbox:
    """Received messages of other cars; times in ns on the receiver's clock, positions on the scenario's map."""

    def __init__(self, binding: Binding, refused: Counter[str]) -> None:
        """Begin with nothing; messages that are not used are counted in `refused`, by reason."""
        self._binding, self._refused, scenario = binding, refused, binding.scenario
        self._max_age = binding.profile.topics[Role.ESTIMATE].max_age_ns
        self._landmarks = marker_places(scenario.landmarks) - np.array(scenario.map.origin)
        self._led = {landmark: PlaceTrack() for landmark in binding.leaders.values()}
        self._receives_from = neighbour_sets(scenario)  # targets by vehicle
        markers = [*(m.marker for m in scenario.landmarks), *(v.marker for v in scenario.vehicles)]
        self._markers = [np.array(marker) for marker in markers]
        self._received: dict[int, dict[Role, tuple[int, CarPose | Message]]] = {}  # since the last tick

    def put_landmark(self, landmark: int, stamp: int, received: int, pose: CarPose) -> None:
        """Take a message of a moving landmark, by its stamp and the time of its reception."""
        if received - stamp > self._max_age:
            self._refused["stale message"] += 1
        else:
            self._led[landmark].put(stamp, pose.position + arm_of(pose, self._markers[landmark]))

    def put_vehicle(self, vehicle: int, role: Role, stamp: int, value: CarPose | Message) -> None:
        """Take a message of a vehicle that is estimated elsewhere."""
        self._received.setdefault(vehicle, {})[role] = stamp, value

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
                places[landmark] = track.at(track.stamp if self.is_lost(landmark, now) else when)
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
            message = message_of(value, self._markers[L + sender]) if isinstance(value, CarPose) else value
            found.update({(i, sender): Received(message, max(0, now - stamp) * NS) for i in receivers})
        self._received.clear()
        return found
