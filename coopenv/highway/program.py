"""highway-env as a co-simulator: its roads, traffic and dynamics under this project's cameras, radio and observers."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from coopenv.base.errors import CoopenvError, ScenarioError, error_text, listed, shown, suggest
from coopenv.base.installation import install_command, needing
from coopenv.estimation.poses import Array
from coopenv.motions.command import ACCELERATION, SPEED, TURN
from coopenv.scenario import Scenario
from coopenv.scenario.bodies import Road
from coopenv.scenario.cosimulators import Highway
from coopenv.scenario.dynamics import Dynamics
from coopenv.sources.cosimulation import Moment, Poses, TrafficProgram

BEND = 2.0  # m, length of a strip of a lane that bends
MARGIN = 25.0  # m, of road that is drawn beyond the outermost landmark


def _strips(lane: Any, reach: float) -> list[Road]:
    s = np.linspace(0.0, lane.length, max(2, int(np.ceil(lane.length / BEND)) + 1))
    middle = np.array([lane.position(x, 0.0) for x in s]) * (1.0, -1.0)
    middle = middle[np.abs(middle).max(axis=1) <= reach]
    if np.ptp([lane.heading_at(x) for x in s]) < 1e-9:
        middle = middle[[0, -1]] if len(middle) else middle  # straight: one strip
    width = float(lane.width_at(0.0))
    return [
        Road(start=(ax, ay), end=(bx, by), width=width, marked=False)
        for (ax, ay), (bx, by) in pairwise(middle.tolist())
        if (ax, ay) != (bx, by)
    ]


OWNED = {
    "action": "[dynamics] and [action]",
    "controlled_vehicles": "the vehicles whose motion is driven",
    "duration": "horizon",
    "observation": "[observation]",
    "policy_frequency": "rates.decision",
    "simulation_frequency": "rates.camera",
}
"""Keys of highway-env's configuration that follow from other parts of a scenario, named here."""

UNFIT = {"two-way": "its rewards need discrete actions", "lane-keeping": "its steps are of a model of its own"}

NO_ENVIRONMENT = f"backend 'highway' needs highway-env, which is not installed: {install_command('highway')}"


def make_environment(scenario: Scenario) -> Any:
    """Return the environment of highway-env, whose every step is one camera tick.

    Raises:
        CoopenvError: highway-env is not installed.
        ScenarioError: it has no such environment or key, or it does not take a value.
    """
    assert scenario.highway is not None  # the schema asks for it
    for problem in _unknown_to_it(scenario):
        raise ScenarioError(problem)
    creator = _creator(scenario.highway.id)
    config = _config(scenario, scenario.highway, creator.default_config())
    try:
        return creator(config=config)
    except Exception as error:  # any error of highway-env
        raise ScenarioError(f"highway: {scenario.highway.id} cannot be made: {error_text(error)}") from None


LIMITS = {"max_acceleration", "max_speed", "max_steering", "reverse"}
"""Keys of `[dynamics]` that are limits of commands; the others describe this project's own bicycle."""


def _unknown_to_it(s: Scenario) -> Iterator[str]:
    """Yield the features of a scenario that highway-env lacks."""
    given = {"dynamics": s.dynamics, **{f"vehicles.{i}.dynamics": v.dynamics for i, v in enumerate(s.vehicles)}}
    for where, part in given.items():
        for name in sorted(_changed(part) - LIMITS):
            yield f"{where}.{name}: highway-env has its own; allowed: {', '.join(sorted(LIMITS))}"
    if s.rates.camera % 1.0:
        yield f"rates.camera: highway-env steps a whole number of times a second, not {s.rates.camera:g}"
    if not s.driven:
        yield "vehicles: highway-env needs at least one that is driven"
    if s.action.pan is not None:
        yield "action.pan: cameras of vehicles of highway-env do not turn"


def _changed(part: Dynamics | None) -> set[str]:
    """Return the keys that differ from their defaults; a scenario in a file of results has all of its defaults."""
    return {name for name, field in Dynamics.model_fields.items() if part and getattr(part, name) != field.default}


def _creator(name: str) -> Any:
    """Return the class of an environment."""
    with needing(NO_ENVIRONMENT):
        import gymnasium
        import highway_env  # noqa: F401  (registers its environments)
    from gymnasium.envs.registration import load_env_creator

    known = {i: s.entry_point for i, s in gymnasium.registry.items() if str(s.entry_point).startswith("highway_env.")}
    if name not in known:
        near = suggest(name, known) or f"; known: {listed(sorted(known), 40)}"
        raise ScenarioError(f"highway.id: highway-env has no environment {shown(name)}{near}")
    creator: Any = load_env_creator(str(known[name]))
    if why := UNFIT.get(name.rpartition("-v")[0]):
        raise ScenarioError(f"highway.id: {name} takes no speed and steering of vehicles from here: {why}")
    if not hasattr(creator, "default_config"):
        raise ScenarioError(f"highway.id: {name} is not one environment but a wrapper of another")
    return creator


def __getattr__(name: str) -> Any:
    """Return a class of highway-env's traffic; highway-env is loaded with the first one (PEP 562).

    Environments of highway-env set parameters of the class of their traffic, and with it those of every other
    environment in the process. Separate classes keep the worlds of one program apart.
    """
    if name not in ("IntersectionTraffic", "Traffic"):
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    from highway_env.vehicle.behavior import IDMVehicle

    own = {"DISTANCE_WANTED": 5.0 + IDMVehicle.LENGTH, "COMFORT_ACC_MAX": 3.0, "COMFORT_ACC_MIN": -5.0}  # m, m/s^2
    globals()[name] = type(name, (IDMVehicle,), {"__module__": __name__, **(own if name == "Traffic" else {})})
    return globals()[name]


def _config(scenario: Scenario, section: Highway, defaults: Mapping[str, Any]) -> dict[str, Any]:
    """Return the configuration of highway-env: the section's own keys, checked, and those of the scenario."""
    rate = int(scenario.rates.camera)
    for key, value in section.config.items():
        if key in OWNED:
            raise ScenarioError(f"highway.config.{key}: follows from {OWNED[key]}; leave this out")
        if key not in defaults:
            near = suggest(key, defaults) or f"; allowed: {listed(sorted(set(defaults) - set(OWNED)), 40)}"
            raise ScenarioError(f"highway.config.{key}: unknown key{near}")
        if defaults[key] is not None and _kind(value) != _kind(defaults[key]):
            raise ScenarioError(
                f"highway.config.{key}: expected a value like {shown(defaults[key])}, got {shown(value)}"
            )
    kind = "IntersectionTraffic" if section.id.startswith("intersection") else "Traffic"
    acceleration, steering = most_of_actions(scenario)
    speeds = [limits.max_speed for limits in scenario.limits]
    drive = {
        "type": "ContinuousAction",
        "acceleration_range": [-acceleration, acceleration],
        "steering_range": [-steering, steering],
        "speed_range": [-max(speeds) if any(limits.reverse for limits in scenario.limits) else 0.0, max(speeds)],
        "dynamical": section.dynamical,
    }
    return {
        "other_vehicles_type": f"{__name__}.{kind}",
        **section.config,
        "action": {"type": "MultiAgentAction", "action_config": drive},
        "observation": {"type": "AttributesObservation", "attributes": []},
        "simulation_frequency": rate,
        "policy_frequency": rate,
        "controlled_vehicles": sum(vehicle.motion.kind == "driven" for vehicle in scenario.vehicles),
        "duration": scenario.horizon,
    }


def most_of_actions(scenario: Scenario) -> tuple[float, float]:
    """Return the acceleration (m/s^2) and the steering angle (rad) that an action of highway-env of 1 stands for."""
    limits = scenario.limits
    return max(of.max_acceleration for of in limits), max(of.max_steering for of in limits)


def _kind(value: Any) -> Any:
    """Return the kind of a setting; numbers are of one kind, and so are lists and tuples."""
    return next((kind for kind in (bool, int | float, str, list | tuple) if isinstance(value, kind)), type(value))


HEIGHT = 1.5  # m, of the traffic's boxes: highway-env is flat
MOST_DRAWS = 50  # resets until there is enough traffic to connect


class Simulation(TrafficProgram):
    """An environment of highway-env whose cars are the scenario's vehicles, in its order."""

    def __init__(self, scenario: Scenario) -> None:
        """Make the environment; errors as for `make_environment`."""
        self._scenario = scenario
        self._driven = [vehicle.motion.kind == "driven" for vehicle in scenario.vehicles]
        self._origin = np.array(scenario.map.origin)
        self.environment = make_environment(scenario)
        self._cars: list[Any] = []

    @property
    def roads(self) -> tuple[Road, ...]:
        """Lanes of its road network as far as the landmarks stand, y up, in the coordinates of the scenario's file."""
        places = [landmark.position[:2] for landmark in self._scenario.landmarks] or [(0.0, 0.0)]
        reach = float(np.abs(places).max()) + MARGIN
        lanes = self.environment.road.network.lanes_list()
        return tuple(road for lane in lanes for road in _strips(lane, reach))

    def reset(self, seed: int) -> None:
        """Draw traffic and starts; of the traffic, the cars nearest to the first driven one are connected.

        Those beyond `most_vehicles` are taken off the road.

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
        assert self._scenario.highway is not None
        surplus = {id(car) for car in traffic[connected + self._scenario.highway.most_vehicles :]}
        self.environment.road.vehicles = [car for car in self.environment.road.vehicles if id(car) not in surplus]
        own, others = iter(drivers), iter(traffic)
        self._cars = [next(own if is_driven else others) for is_driven in self._driven]

    def command(self, now: Moment) -> None:
        """Drive to the next tick; traffic drives itself, and vehicles that are not present are taken off the road."""
        gone = {id(car) for car, there in zip(self._cars, now.present, strict=True) if not there}
        road = self.environment.road
        road.vehicles = [car for car in road.vehicles if id(car) not in gone]
        (acceleration, steering), rate = most_of_actions(self._scenario), self._scenario.rates.camera
        actions = []
        for car, command in zip(self._cars, now.command, strict=True):
            wanted = (command[SPEED] - car.speed) * rate
            most = command[ACCELERATION]
            gas = np.clip(wanted, -most, most) / acceleration
            actions.append(np.array([gas, -command[TURN] / steering]))
        self._call("step", tuple(action for action, driven in zip(actions, self._driven, strict=True) if driven))

    def poses(self) -> Poses:
        """Return the poses of all vehicles."""
        return poses_of(self._cars, self.environment.road, self._origin)

    def _call(self, method: str, *arguments: Any, **options: Any) -> None:
        try:
            getattr(self.environment, method)(*arguments, **options)
        except Exception as error:  # any error of the program
            raise CoopenvError(f"highway-env: {method}: {error_text(error)}") from error


def poses_of(cars: Sequence[Any], road: Any, origin: Array) -> Poses:
    """Return the poses of some cars of a road, and of all else on it, in a map with its origin at `origin` (3,)."""
    here, own = {id(car) for car in road.vehicles}, {id(car) for car in cars}
    others = [car for car in road.vehicles if id(car) not in own] + [thing for thing in road.objects if thing.solid]
    position = np.array([(*flipped(car.position), HEIGHT / 2) for car in others]).reshape(-1, 3)
    half = np.array([(car.LENGTH / 2, car.WIDTH / 2, HEIGHT / 2) for car in others]).reshape(-1, 3)
    moving = np.array([id(car) in here for car in cars])
    return Poses(
        xy=np.array([flipped(car.position) for car in cars]) - origin[:2],
        heading=np.array([-car.heading for car in cars]),
        speed=np.array([car.speed for car in cars]) * moving,
        steering=np.array([-car.action["steering"] for car in cars]),
        crashed=np.array([car.crashed for car in cars]),
        left=~moving,
        traffic_position=position - origin,
        traffic_heading=np.array([-car.heading for car in others]),
        traffic_half=half,
    )


def flipped(xy: Array) -> Array:
    """Return (x, y) of highway-env in a frame whose y axis points up, or the other way round."""
    return np.array([xy[0], -xy[1]])
