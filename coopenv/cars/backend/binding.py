"""Binding of a fleet to its scenario: cars and markers of a fleet, and vehicles and targets of its scenario."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from coopenv.backends.base import IGNORED_OPTIONS
from coopenv.base.errors import CoopenvError, listed, shown, suggest
from coopenv.cars.deployment import Car
from coopenv.cars.profile import SVEA, CarProfile
from coopenv.cars.readings import check_types
from coopenv.scenario import Scenario


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
        by_vehicle = {vehicle: name for name, vehicle in self.cars.items()}
        return tuple(by_vehicle[i] for i in range(len(by_vehicle)))

    @property
    def unmarked(self) -> tuple[str, ...]:
        """Names of landmarks and vehicles that cameras cannot identify: no marker. A single vehicle needs none."""
        names = self.scenario.target_names
        count = len(names) if len(self.cars) > 1 else len(self.scenario.landmarks)
        return tuple(name for target, name in enumerate(names[:count]) if target not in self.targets.values())

    @property
    def remote(self) -> bool:
        """Whether some vehicles are estimated elsewhere."""
        return len(self.local) < len(self.cars)


def bind(
    scenario: Scenario,
    cars: Sequence[Car],
    markers: Mapping[str, int],
    where: str,
    only: str | None,
    profile: CarProfile = SVEA,
) -> Binding:
    """Return the binding.

    Args:
        scenario: what the cars are vehicles of.
        cars: the fleet.
        markers: numbers of the markers of landmarks, by name.
        where: name of the file, for errors.
        only: the car whose vehicle alone is estimated here; None: all are.
        profile: make of the cars.

    Raises:
        CoopenvError: a name is not of the scenario, a vehicle has no car, or the camera has no calibration; the
            profile has a type that cannot be read.
    """
    check_types(profile, where)
    vehicles, landmarks = scenario.vehicle_names, [landmark.name for landmark in scenario.landmarks]
    driven, leaders = [car for car in cars if car.landmark is None], [car for car in cars if car.landmark is not None]
    if len(driven) != len(vehicles):
        raise CoopenvError(
            f"{where}: cars: {len(driven)} of them are vehicles, the environment has {len(vehicles)}: "
            f"{listed(vehicles)}"
        )
    left = [name for name in vehicles if name not in {car.vehicle for car in driven}]
    chosen = {}
    for car in driven:
        name = left.pop(0) if car.vehicle is None else car.vehicle
        chosen[car.name] = _index(vehicles, name, f"{where}: cars.{car.name}.vehicle")
    for name in markers:
        _index(landmarks, name, f"{where}: markers")
    targets = {number: landmarks.index(name) for name, number in markers.items()}
    led = {c.name: _index(landmarks, str(c.landmark), f"{where}: cars.{c.name}.landmark") for c in leaders}
    for car in cars:
        if car.marker is not None:
            targets[car.marker] = led[car.name] if car.name in led else len(landmarks) + chosen[car.name]
    for i, camera in enumerate(scenario.cameras):
        if camera.model != "pinhole":
            raise CoopenvError(
                f"{where}: the camera of {vehicles[i]} has no calibration: [camera] of the environment needs "
                'model = "pinhole", image_size, focal_length, principal_point and distortion'
            )
    if only is not None and only not in chosen:
        raise CoopenvError(f"{where}: unknown car '{only}'{suggest(only, chosen)}; known: {listed([*chosen])}")
    local = tuple(range(len(vehicles))) if only is None else (chosen[only],)
    return Binding(scenario, chosen, led, targets, local, profile)


def _index(known: Sequence[str], name: str, where: str) -> int:
    if name not in known:
        raise CoopenvError(f"{where}: unknown name '{name}'{suggest(name, known)}; known: {listed(known)}")
    return known.index(name)


OPTIONS = ("arm", "release")


@dataclass(frozen=True)
class ResetOptions:
    """Options of a reset."""

    arm: bool = False
    """Whether the cars drive."""
    release: bool = False
    """Whether cars that another station has stopped drive as well."""


def reset_options(options: Mapping[str, Any]) -> ResetOptions:
    """Return the checked options of a reset.

    Raises:
        CoopenvError: an option is not known, or not what it must be.
    """
    for key in options:
        if key not in OPTIONS and key not in IGNORED_OPTIONS:
            raise CoopenvError(f"unknown option {shown(key)}{suggest(str(key), OPTIONS)}; known: arm, release")
    found = {name: options.get(name, False) for name in OPTIONS}
    for name, value in found.items():
        if not isinstance(value, bool):
            raise CoopenvError(f"option '{name}' must be true or false, got {shown(value)}")
    return ResetOptions(**found)
