"""One world of highway-env: who drives in it, told in this project's frames.

highway-env's y axis points down on its screen, so that a map with y north has its y and its angles with the other sign.
Lengths are in m, angles in rad.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from coopenv.backends.highway.settings import make_environment, most_of_actions
from coopenv.backends.moved import Poses
from coopenv.base.errors import CoopenvError, ScenarioError, told
from coopenv.estimation.arrays import Array
from coopenv.scenario import Scenario
from coopenv.world.command import ACCELERATION, SPEED, STEERING

HEIGHT = 1.5  # m, of the traffic's boxes: highway-env is flat
MOST_DRAWS = 50  # resets until there is enough traffic to connect


class Simulation:
    """An environment of highway-env whose cars are the scenario's vehicles, in its order."""

    def __init__(self, scenario: Scenario) -> None:
        """Make the environment; errors as for `make_environment`."""
        self._scenario = scenario
        self._driven = [vehicle.motion.kind == "driven" for vehicle in scenario.vehicles]
        self._origin = np.array(scenario.map.origin)
        self.environment = make_environment(scenario)
        self._cars: list[Any] = []

    @property
    def begun(self) -> bool:
        """Whether it has been reset."""
        return bool(self._cars)

    def reset(self, seed: int) -> Poses:
        """Draw traffic and starts; of the traffic, the cars nearest to the first driven one are connected.

        Raises:
            ScenarioError: its road does not have the vehicles that the scenario names.
        """
        driven, connected = sum(self._driven), len(self._driven) - sum(self._driven)
        for draw in range(MOST_DRAWS):
            self._call("reset", seed=seed if draw == 0 else None)
            drivers = list(self.environment.controlled_vehicles)
            if len(drivers) != driven:
                raise ScenarioError(f"vehicles: {driven} are driven, but highway-env drives {len(drivers)} there")
            known = {id(car) for car in drivers}
            traffic = [car for car in self.environment.road.vehicles if id(car) not in known]
            if len(traffic) >= connected:
                break
        else:
            raise ScenarioError(f"vehicles: {connected} are in traffic, but highway-env has fewer there")
        traffic.sort(key=lambda car: float(np.linalg.norm(car.position - drivers[0].position)))
        own, others = iter(drivers), iter(traffic)
        self._cars = [next(own if is_driven else others) for is_driven in self._driven]
        return self.poses()

    def drive(self, commands: Array, present: Array) -> Poses:
        """Drive for one camera tick under commands (N, 3), see `coopenv.world.command`; traffic drives itself.

        Those that are not present (N,) are taken off the road.
        """
        gone = {id(car) for car, there in zip(self._cars, present, strict=True) if not there}
        road = self.environment.road
        road.vehicles = [car for car in road.vehicles if id(car) not in gone]
        (acceleration, steering), rate = most_of_actions(self._scenario), self._scenario.rates.camera
        actions = []
        for car, command in zip(self._cars, commands, strict=True):
            wanted = (command[SPEED] - car.speed) * rate
            most = command[ACCELERATION]
            gas = np.clip(wanted, -most, most) / acceleration
            actions.append(np.array([gas, -command[STEERING] / steering]))
        self._call("step", tuple(action for action, driven in zip(actions, self._driven, strict=True) if driven))
        return self.poses()

    def poses(self) -> Poses:
        """Return where everybody is; errors as for `poses_of`."""
        assert self._scenario.highway is not None
        return poses_of(self._cars, self.environment.road, self._origin, self._scenario.highway.most_vehicles)

    def _call(self, method: str, *arguments: Any, **options: Any) -> None:
        try:
            getattr(self.environment, method)(*arguments, **options)
        except Exception as error:  # whatever goes wrong in there
            raise CoopenvError(f"highway-env: {method}: {told(error)}") from error


def poses_of(cars: Sequence[Any], road: Any, origin: Array, most: int) -> Poses:
    """Return where some cars of a road are, and everything else on it, in a map whose origin is at `origin` (3,).

    Raises:
        CoopenvError: there are more than `most` other things.
    """
    here, own = {id(car) for car in road.vehicles}, {id(car) for car in cars}
    others = [car for car in road.vehicles if id(car) not in own] + [thing for thing in road.objects if thing.solid]
    if len(others) > most:
        raise CoopenvError(f"highway.most_vehicles: {most} are too few, there are {len(others)} on the road")
    position, heading, half = np.zeros((most, 3)), np.zeros(most), np.zeros((most, 3))
    for k, car in enumerate(others):
        position[k] = (*flipped(car.position), HEIGHT / 2)
        heading[k], half[k] = -car.heading, (car.LENGTH / 2, car.WIDTH / 2, HEIGHT / 2)
    moving = np.array([id(car) in here for car in cars])
    return Poses(
        xy=np.array([flipped(car.position) for car in cars]) - origin[:2],
        heading=np.array([-car.heading for car in cars]),
        speed=np.array([car.speed for car in cars]) * moving,
        steering=np.array([-car.action["steering"] for car in cars]),
        crashed=np.array([car.crashed for car in cars]),
        left=~moving,
        traffic_position=position - origin,
        traffic_heading=heading,
        traffic_half=half,
    )


def flipped(xy: Array) -> Array:
    """Return (x, y) of highway-env in a frame whose y axis points up, or the other way round."""
    return np.array([xy[0], -xy[1]])
