"""The scenario: everything that defines a world, typed and checked; each failure is one line that names the field."""

import math
import re
import warnings
from collections import Counter
from collections.abc import Collection, Iterator, KeysView, Mapping, Sequence
from graphlib import CycleError, TopologicalSorter
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, field_validator, model_validator

from coopenv.base.errors import ScenarioError, ScenarioWarning, check_one_of, listed, shown, suggest
from coopenv.base.installation import load_reference
from coopenv.base.sections import NonNegative, Positive, Section, Text, Vector3, overlaid, validated
from coopenv.base.units import DETAIL, EPISODE, PLACE, TIME, warn_of_implausible
from coopenv.motions.table import DRIVES, columns_of, further_bodies
from coopenv.report.notebook import facts_html, one_line, picture_html
from coopenv.scenario.bodies import MOST_LANDMARKS, Landmark, LandmarkGroup, Obstacle, Road, Vehicle
from coopenv.scenario.cosimulators import COSIMULATORS, Cosimulator, Highway, Program, Sumo
from coopenv.scenario.difficulty import Difficulty, Randomisation
from coopenv.scenario.dynamics import Dynamics
from coopenv.scenario.routes import Route, followers, start_of
from coopenv.scenario.sensing import Camera, Faults, Images, Noise, ObserverSettings, Rates, Topology, V2x
from coopenv.scenario.sensors import MOST_SENSORS, SensorSection, problems_of_sensors
from coopenv.scenario.starts import check_room
from coopenv.scenario.task import Action, Observation, Reward, Termination

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_TICKS = 1e8  # camera frames or odometry samples of one episode; counters are 32 bits wide

MOST_PAIRS = 2e7  # of vehicles and their targets

MOST_PIXELS = 2**21  # of a rendered frame

FAR_FROM_ORIGIN = 50.0
"""m; beyond it the paper's observer loses accuracy, because it is not invariant to the map origin."""


BEARINGS_ALONE = ("riccati", "hamel_samson", "p3p", "factor_graph")
"""Observers that take no measurements of sensors beside the camera."""

READ = "coopenv.load_scenario reads one by name, from a file or from a dict"


if TYPE_CHECKING:
    Simulator = str
else:
    Simulator = Literal[("simulated", *COSIMULATORS)]


class Map(Section):
    """The frame in which vehicles know the landmarks."""

    origin: Annotated[Vector3, PLACE] = (0.0, 0.0, 0.0)
    """Point of this file's coordinates at which the map frame has its origin; keep it inside the scene."""
    accuracy: Annotated[NonNegative, DETAIL] = 0.0
    """Standard deviation per axis of the error of a landmark's position on the map, m; drawn per episode, the same for
    all vehicles. Cameras see the landmark in its true place."""


class _Loaded(type(Section)):  # type: ignore[misc]
    """The class of `Scenario`: its errors are one line."""

    def __call__(cls, *values: Any, **entries: Any) -> Any:
        if values:
            raise TypeError(f"{cls.__name__}() takes 0 positional arguments but {len(values)} were given; {READ}")
        return validated(cls, entries, cls.__name__, ScenarioError)

    def __getattr__(cls, name: str) -> Any:
        raise AttributeError(f"type object '{cls.__name__}' has no attribute '{name}'; {READ}")


class Scenario(Section, metaclass=_Loaded):
    """One environment. Units: m, s, rad; frames: x east, y north, z up; body x forward, y left, z up."""

    title: Text
    description: Text = ""
    source: Text = ""
    """Source of the numbers."""
    horizon: Annotated[Positive, EPISODE]
    """Length of an episode, s."""
    backend: Simulator = "simulated"
    """Simulator that moves the vehicles: coopenv itself, or a co-simulator with the section of this name."""
    highway: Highway | None = None
    sumo: Sumo | None = None
    program: Program | None = None
    map: Map = Map()
    routes: tuple[Route, ...] = Field(default=(), max_length=20_000)
    roads: tuple[Road, ...] = Field(default=(), max_length=50_000)
    obstacles: tuple[Obstacle, ...] = Field(default=(), max_length=50_000)
    landmarks: tuple[Landmark, ...] = Field(max_length=MOST_LANDMARKS)
    landmark_groups: tuple[LandmarkGroup, ...] = Field(default=(), max_length=1_000)
    vehicles: tuple[Vehicle, ...] = Field(min_length=1, max_length=4_096)
    camera: Camera = Camera()
    sensors: tuple[SensorSection, ...] = Field(default=(), max_length=MOST_SENSORS)
    """Sensors beside the camera."""
    rates: Rates = Rates()
    noise: Noise = Noise()
    topology: Topology = Topology()
    images: Images = Images()
    sensing: Literal["sensed", "ideal", "blind", "images"] = "sensed"
    """Switch for studies of the value of sensing; all else stays equal, noise, radio and draws included.
    `ideal`: every neighbour is measured in every frame, regardless of field of view, range, misses and occluders;
    `blind`: nothing is ever measured; `sensed`: by `topology.mode`; `images`: likewise, with the bearings of a detector
    in rendered frames, see `[images]`; `noise.bearing` is then an assumption of estimators alone."""
    v2x: V2x = V2x()
    faults: Faults = Faults()
    observer: ObserverSettings = ObserverSettings()
    dynamics: Dynamics = Dynamics()
    randomisation: Randomisation = Randomisation()
    difficulty: Difficulty = Difficulty()
    observation: Observation = Observation()
    action: Action = Action()
    reward: Reward = Reward()
    termination: Termination = Termination()

    def keys(self) -> KeysView[str]:
        """Return the names of the sections and values, for `dict(scenario)` and `{**scenario}`."""
        return type(self).model_fields.keys()

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Return a copy, its entries checked again where an update changes some.

        Raises:
            ScenarioError: the update does not describe a possible world.
        """
        copied = super().model_copy(deep=deep)
        own = {name: getattr(copied, name) for name in self.model_fields_set}
        return type(self)(**{**own, **update}) if update else copied

    @property
    def facts(self) -> dict[str, object]:
        """The main figures: of vehicles and landmarks, the observer's name, and the length, s."""
        counts = {"vehicles": len(self.vehicles), "landmarks": len(self.landmarks)}
        return {**counts, "observer": self.observer.name, "horizon": self.horizon}

    if TYPE_CHECKING:  # which is `load_scenario`

        def __or__(self, overrides: Mapping[str, Any]) -> Self: ...

    def __hash__(self) -> int:
        return hash(repr(self))  # equal scenarios have equal facts

    def __repr__(self) -> str:
        return one_line(self, self.title, self.facts)

    __str__ = __repr__

    def figure(self) -> "Figure":
        """Return the top view of the world before an episode, for a notebook or `figure().savefig(...)`."""
        drawn: Figure = load_reference("coopenv.viz.topview_ground:site_figure")(self)  # pictures stand on scenarios
        return drawn

    def _repr_html_(self) -> str:
        facts = {"description": self.description, **self.facts}
        return facts_html(self.title, facts) + picture_html(self.figure())

    @property
    def paced(self) -> bool:
        """True if the pace of prescribed motions may vary."""
        factors = (*self.randomisation.factors("traffic_pace"), *self.difficulty.factors("traffic_pace"))
        spreads = (*(mark.pace_spread for mark in self.landmarks), *(vehicle.pace_spread for vehicle in self.vehicles))
        return any(factor != 1.0 for factor in factors) or any(spreads)

    @property
    def vehicle_names(self) -> list[str]:
        """`vehicle_1`, `vehicle_2`, ... in file order."""
        return [f"vehicle_{i + 1}" for i in range(len(self.vehicles))]

    @property
    def target_names(self) -> list[str]:
        """Landmarks first, then vehicles: the order of the paper's agents and of every target axis."""
        return [landmark.name for landmark in self.landmarks] + self.vehicle_names

    @property
    def keeps_those_in_range(self) -> bool:
        """True if vehicles keep the agents in range, without lists of all measurable targets."""
        return self.topology.most_nearby is not None and self.vehicles[0].neighbours is None

    @property
    def driven(self) -> bool:
        """True if actions drive any vehicle."""
        return any(vehicle.motion.kind == "driven" for vehicle in self.vehicles)

    @property
    def drivers(self) -> list[str | None]:
        """The agent that drives each vehicle in place of actions; None: none does."""
        return [getattr(vehicle.motion, "driver", None) for vehicle in self.vehicles]

    @property
    def acting(self) -> list[bool]:
        """For each vehicle, True if actions drive it."""
        driven = [vehicle.motion.kind == "driven" for vehicle in self.vehicles]
        return [each and driver is None for each, driver in zip(driven, self.drivers, strict=True)]

    def agents(self, estimated: Collection[int] | None = None) -> list[int]:
        """Return indices of the vehicles that actions drive, or without any of all that have no driver.

        `estimated` are the indices to choose from (None: all).
        """
        free = [i for i, driver in enumerate(self.drivers) if driver is None and (estimated is None or i in estimated)]
        return [i for i in free if self.acting[i]] or free

    @property
    def columns(self) -> int:
        """Number of the first entries of an action, which drive: columns of the command of the vehicle with most."""
        drives = {limits.model: limits for limits in self.limits}
        return max(len(columns_of(limits)) for limits in drives.values())

    @property
    def action_size(self) -> int:
        """Number of entries of an action."""
        radio = len(self.vehicles) - 1 if self.action.radio else 0
        return self.columns + (self.action.pan is not None) + radio

    @property
    def has_lasting_errors(self) -> bool:
        """True if any vehicle's odometry or camera has lasting errors, see `[noise]` and `[camera]`."""
        noises, cameras = self.noises, self.cameras
        return any(n.enabled and (n.lasts or c.is_misplaced) for n, c in zip(noises, cameras, strict=True))

    @property
    def landmark_std(self) -> tuple[float, ...]:
        """(L,) standard deviations per axis of the landmarks' positions on the map, m; empty: exact."""
        common = self.map.accuracy
        std = [common if mark.accuracy is None else mark.accuracy for mark in self.landmarks]
        return tuple(std) if self.noise.enabled and any(std) else ()

    @property
    def cameras(self) -> list[Camera]:
        """The camera of every vehicle."""
        return [overlaid(self.camera, vehicle.camera) for vehicle in self.vehicles]

    @property
    def noises(self) -> list[Noise]:
        """The noise of every vehicle's sensors."""
        return [overlaid(self.noise, vehicle.noise) for vehicle in self.vehicles]

    @property
    def all_faults(self) -> list[Faults]:
        """Faults of every vehicle."""
        return [overlaid(self.faults, vehicle.faults) for vehicle in self.vehicles]

    @property
    def replay_ticks(self) -> int:
        """Largest age (ticks) of a replayed message beyond the radio's delay, over all vehicles."""
        lies = [faults.lie for faults in self.all_faults]
        return max(self.ticks_of_replay(lie.age) if lie.kind == "replay" else 0 for lie in lies)

    def ticks_of_replay(self, age: float) -> int:
        """Return an age in s as ticks: whole periods of the radio, at least one."""
        return self.v2x.period * max(1, round(age * self.rates.camera / self.v2x.period))

    @property
    def limits(self) -> list[Dynamics]:
        """The dynamics of every vehicle."""
        return [overlaid(self.dynamics, vehicle.dynamics) for vehicle in self.vehicles]

    @property
    def cosimulator(self) -> Cosimulator | None:
        """Section of the program that moves the vehicles; None: coopenv moves them."""
        return None if self.backend == "simulated" else getattr(self, self.backend)

    @property
    def ticks_per_decision(self) -> int:
        """Camera ticks between two decisions of the policy."""
        return round(self.rates.camera / self.rates.decision)

    @property
    def horizon_ticks(self) -> int:
        """Camera ticks of an episode."""
        return max(1, round(self.horizon * self.rates.camera))

    @property
    def decisions(self) -> int:
        """Decisions of an episode that nothing ends sooner."""
        return -(-self.horizon_ticks // self.ticks_per_decision)

    @field_validator("landmarks")
    @classmethod
    def _names_are_free(cls, landmarks: tuple[Landmark, ...]) -> tuple[Landmark, ...]:
        for name in _twice(landmarks):
            raise ValueError(f"landmark name '{name}' is used twice")
        for landmark in landmarks:
            if re.fullmatch(r"vehicle_\d+", landmark.name):
                raise ValueError(f"landmark name '{landmark.name}' is reserved for vehicles")
        return landmarks

    @model_validator(mode="after")
    def _is_possible(self) -> Self:
        ends = [abs(x) for x in (*self.map.origin, *(x for road in self.roads for x in (*road.start, *road.end)))]
        farthest = PLACE.most + max(ends) + 50.0 * (len(self.vehicles) + len(self.routes))
        warn_of_implausible(self, {PLACE: farthest / PLACE.most, TIME: max(1.0, self.horizon / TIME.most)})
        vehicles, targets = len(self.vehicles), len(self.target_names)
        if vehicles * targets > MOST_PAIRS and self.topology.most_nearby is None:
            pairs = f"{vehicles} times {targets} targets are over {MOST_PAIRS:.0e} pairs"
            raise ValueError(f"vehicles: {pairs}; set topology.most_nearby")
        neighbours = [] if self.keeps_those_in_range else neighbour_sets(self)
        processing_order(self, neighbours)
        for problem in (*_misplaced(self), *_problems(self)):
            raise ValueError(problem)
        if self.backend == "simulated":
            check_room(self.vehicles, self.routes, self.obstacles)
        for doubt in _doubts(self, neighbours):
            warnings.warn(doubt, ScenarioWarning, stacklevel=2)
        return self


def _twice(named: Sequence[Any]) -> list[str]:
    return [name for name, times in Counter(entry.name for entry in named).items() if times > 1]


def _misplaced(s: Scenario) -> Iterator[str]:
    """Yield the conflicts with the simulator of the vehicles."""
    for name in COSIMULATORS:
        if (getattr(s, name) is None) == (s.backend == name):
            yield f"{name}: needed" if s.backend == name else f'{name}: only with backend = "{name}"'
    elsewhere = s.cosimulator is not None
    title = s.cosimulator.title if s.cosimulator else ""
    for i, vehicle in enumerate(s.vehicles):
        misplaced = _moved_elsewhere(vehicle, title) if elsewhere else _moved_here(vehicle)
        yield from (f"vehicles.{i}.{problem}" for problem in misplaced)


def _moved_elsewhere(vehicle: Vehicle, title: str) -> Iterator[str]:
    kind, speed = vehicle.motion.kind, dict(vehicle.motion).get("initial_speed", 0.0)
    if kind not in ("driven", "traffic"):
        yield f"motion.kind: '{kind}' is not known to {title}; known: driven, traffic"
    drawn = {"initial_pose": vehicle.initial_pose, "motion.initial_speed": speed, "entry": vehicle.entry}
    for key in [key for key, given in drawn.items() if given]:
        yield f"{key}: {title} draws it; leave this out"


def _moved_here(vehicle: Vehicle) -> Iterator[str]:
    kind = vehicle.motion.kind
    if kind == "traffic" and not vehicle.routes:
        yield f"routes: needed by traffic, but for backend = {' or '.join(COSIMULATORS)}"
    if kind != "waypoints" and vehicle.initial_pose is None and not vehicle.routes:
        yield "initial_pose: needed, with at least a position"


def _problems(s: Scenario) -> Iterator[str]:
    """Yield the conflicts between sections."""
    k, q, targets = s.observer.k, s.observer.q, s.target_names
    if isinstance(k, tuple) and len(k) != len(s.vehicles):
        yield f"observer.k: {len(k)} values for {len(s.vehicles)} vehicles"
    for name in [*q.keys() - {*targets}][:1] if isinstance(q, dict) else ():
        yield f"observer.q: unknown target {shown(name)}{suggest(name, targets)}; known: {listed(targets)}"
    names = dict.fromkeys(route.name for route in s.routes)
    for key in ("routes", "landmark_groups"):
        yield from (f"{key}: the name '{name}' is used twice" for name in _twice(getattr(s, key)))
    for i, vehicle in enumerate(s.vehicles):
        for key in ("routes", "next_routes"):
            for name in [name for name in getattr(vehicle, key) if name not in names]:
                unknown = f"unknown route {shown(name)}{suggest(name, names)}"
                yield f"vehicles.{i}.{key}: {unknown}; known: {listed([*names])}"
    yield from problems_of_sensors(s.sensors, s.vehicle_names, targets, [group.name for group in s.landmark_groups])
    yield from _problems_of_draws(s)
    if s.topology.most_nearby is not None:
        yield from _problems_of_nearby(s)
    yield from _problems_of_images(s)
    for name, rate in (("camera", s.rates.camera), ("odometry", s.rates.odometry)):
        if s.horizon * rate > MOST_TICKS:
            yield f"horizon: {s.horizon:g} s at rates.{name} = {rate:g} Hz are over {MOST_TICKS:.0e} samples"
    parts = {"faults": s.faults, **{f"vehicles.{i}.faults": v.faults for i, v in enumerate(s.vehicles) if v.faults}}
    marks = {landmark.name: None for landmark in s.landmarks}
    for where, faults in parts.items():
        mark = faults.map_error.landmark
        if mark is not None and mark not in marks:
            unknown = f"unknown landmark {shown(mark)}{suggest(mark, marks)}"
            yield f"{where}.map_error.landmark: {unknown}; known: {listed([*marks])}"
    yield from _problems_of_driving(s)


def _problems_of_nearby(s: Scenario) -> Iterator[str]:
    """Yield the reasons for which the agents in range of a vehicle are not limited."""
    key, listed = "topology.most_nearby", [vehicle.neighbours for vehicle in s.vehicles]
    if s.sensors:
        yield f"{key}: not with [[sensors]], whose measurements keep all targets"
    if s.action.radio or "seen" in s.observation.include:
        yield f"action.radio, observation.include: neither a radio action nor 'seen' with {key}"
    if None not in listed:
        for i in [i for i, names in enumerate(listed) if names and len(names) > (s.topology.most_nearby or 0)][:1]:
            yield f"vehicles.{i}.neighbours: more than {key}"
        if s.v2x.links == "all":
            yield f"v2x.links: must be 'neighbours' where they are listed, with {key}"
        return
    if s.topology.mode != "sensed" or s.sensing == "ideal" or any(listed):
        yield f"{key}: needs topology.mode = 'sensed' and sensing other than 'ideal', or neighbours of all vehicles"
    if s.v2x.range is None:
        yield f"v2x.range: needed with {key}"
    for i in [i for i, camera in enumerate(s.cameras) if camera.range is None][:1]:
        yield f"camera.range: needed with {key}, not there for vehicle_{i + 1}"


def _problems_of_images(s: Scenario) -> Iterator[str]:
    """Yield the conflicts of rendered frames with the rest of the scenario."""
    if s.sensing != "images":
        return
    key, most = "sensing: 'images' needs", 16
    if s.backend != "simulated":
        yield f"{key} backend = 'simulated', got '{s.backend}'"
    if s.topology.mode != "sensed" or s.topology.most_nearby is not None:
        yield f"{key} topology.mode = 'sensed' without topology.most_nearby"
    for name in ("randomisation", "difficulty"):
        if getattr(s, name).bearing_noise != (1.0, 1.0):
            yield f"{name}.bearing_noise: the errors of rendered frames are the detector's, see images.noise"
    if len(s.vehicles) > most:
        yield f"{key} at most {most} vehicles, got {len(s.vehicles)}"
    for i, camera in enumerate(s.cameras):
        own = f", not so for vehicle_{i + 1}"
        if camera.model != "pinhole" or camera.quantise or not camera.undistort:
            yield f"{key} camera.model = 'pinhole', quantise = false and undistort = true{own}"
        if math.prod(camera.image_size) > MOST_PIXELS:
            yield f"{key} camera.image_size of at most {MOST_PIXELS:,} pixels{own}"


def _problems_of_driving(s: Scenario) -> Iterator[str]:
    """Yield the conflicts of action and reward with the vehicles, and values beyond their limits."""
    driven = sum(vehicle.motion.kind == "driven" for vehicle in s.vehicles)
    if s.reward.team != "own" and driven < 2:
        yield f"reward.team: '{s.reward.team}' needs at least two driven vehicles, got {driven}"
    if s.action.radio and not _receives(s):
        yield "action.radio: no vehicle receives messages of another one here (v2x.links, vehicles.*.neighbours)"
    if s.reward.own_share and s.reward.team == "own":
        yield "reward.own_share: only with reward.team = 'mean' or 'min'"
    decision, checked = 1.0 / s.rates.decision, set[int]()
    for i, (vehicle, limits) in enumerate(zip(s.vehicles, s.limits, strict=True)):
        own = vehicle.dynamics is not None
        where, top = f"vehicles.{i}.dynamics" if own else "dynamics", limits.max_speed
        speed = vehicle.motion.initial_speed if vehicle.motion.kind == "driven" else 0.0
        if not (-top if limits.reverse else 0.0) <= speed <= top:
            yield f"vehicles.{i}.motion.initial_speed: {speed:g} m/s is beyond what [dynamics] permits"
        if limits.latency > decision:
            yield f"{where}.latency: {limits.latency:g} s is longer than one decision ({decision:g} s)"
        yield from (f"{where}.{problem}" for problem in _problems_of_drive(s, vehicle, limits))
        if id(limits) in checked or limits.model not in DRIVES:
            continue  # vehicles share the limits of the scenario
        checked.add(id(limits))
        for column in columns_of(limits):
            if (wanted := s.action.at_one(column)) > column.high:
                above = f"{wanted:g} {column.unit} is above {where}.{column.limit} ({column.high:g} {column.unit})"
                yield f"action.{column.name}: {above}"


def _problems_of_drive(s: Scenario, vehicle: Vehicle, limits: Dynamics) -> Iterator[str]:
    """Yield the conflicts of a vehicle's kind of motion with the simulator that moves it."""
    if vehicle.motion.kind == "traffic" and s.cosimulator is None and limits.model != DRIVES[0]:
        yield f"model: {shown(limits.model)}: the model of traffic drives vehicles of the model '{DRIVES[0]}'"
    if limits.model not in DRIVES and (s.cosimulator is not None or s.sensing == "images"):
        yield f"model: {shown(limits.model)}: the user's own drive needs backend = 'simulated' without rendered frames"


def _receives(s: Scenario) -> bool:
    """Return whether any vehicle receives messages of another one."""
    to_all, landmarks = s.v2x.links == "all" and len(s.vehicles) > 1, len(s.landmarks)
    return to_all or any(target >= landmarks for targets in neighbour_sets(s) for target in targets)


def _problems_of_draws(s: Scenario) -> Iterator[str]:
    groups = {group.name for group in s.landmark_groups}
    for i, mark in enumerate(s.landmarks):
        if mark.group is not None and mark.group not in groups:
            yield f"landmarks.{i}.group: unknown group {shown(mark.group)}; groups make their landmarks themselves"
    if s.termination.after_arrival == "park":
        return
    if not s.termination.arrival:
        yield f"termination.arrival: must be true where after_arrival is '{s.termination.after_arrival}'"
    if s.termination.after_arrival in ("continue", "transit"):
        yield from _problems_of_sequels(s)


def _problems_of_sequels(s: Scenario) -> Iterator[str]:
    """Yield where a vehicle arrives and no route goes on."""
    number, seen, pairs = {route.name: i for i, route in enumerate(s.routes)}, set(), 0
    for i, vehicle in enumerate(s.vehicles):
        if vehicle.goal is not None and not vehicle.routes:
            key = f"vehicles.{i}.routes: needed by a vehicle with a goal where termination.after_arrival"
            yield f"{key} is '{s.termination.after_arrival}'"
        kind = vehicle.goal_radius, vehicle.next_routes, vehicle.routes
        if s.termination.after_arrival == "transit" or kind in seen:
            continue
        seen.add(kind)
        after = followers(vehicle, s.routes)
        pairs += len(s.routes) + sum(map(len, after))
        if pairs > MOST_PAIRS:
            yield f"vehicles.{i}: over {MOST_PAIRS:.0e} pairs of routes to go through where after_arrival is 'continue'"
        reached: set[int] = set()
        new = {number[name] for name in vehicle.routes}
        while new:
            reached |= new
            for route in [route for route in sorted(new) if not after[route]]:
                yield (
                    f"vehicles.{i}: termination.after_arrival is 'continue', but no route that may follow starts "
                    f"within {vehicle.goal_radius:g} m of the end of route '{s.routes[route].name}'"
                )
            new = {k for route in new for k in after[route]} - reached


def _doubts(s: Scenario, neighbours: Sequence[Sequence[int]]) -> Iterator[str]:
    """Yield where the paper's conditions for convergence are not met by construction.

    The numbers of landmarks and neighbours count where bearings are the only measurements.
    """
    bearings_alone = not s.sensors
    lonely = [f"vehicle_{i + 1}" for i, targets in enumerate(neighbours) if len(targets) < 3]
    if bearings_alone and (count := len(s.landmarks)) < 3:
        yield (
            f"only {count} landmark{'s' if count != 1 else ''}: with fewer than three the paper's Assumption 2 "
            "fails and observability is not guaranteed"
        )
    elif bearings_alone and lonely:
        verb = "has" if len(lonely) == 1 else "have"
        yield f"{listed(lonely)} {verb} fewer than three neighbours: observability is not guaranteed"
    if s.observer.name in BEARINGS_ALONE:
        stated = {"camera.latency": any(camera.is_late for camera in s.cameras), "map.accuracy": s.landmark_std}
        ignored = [*(sensor.label for sensor in s.sensors), *(key for key, there in stated.items() if there)]
        if ignored:
            yield f"observer '{s.observer.name}' takes the camera's bearings alone and ignores {listed(ignored)}"
    for sensor in [sensor for sensor in s.sensors if (sensor.rate or 0.0) > s.rates.camera]:
        yield f"sensors.{sensor.label}.rate: {sensor.rate:g} Hz is above rates.camera, {s.rates.camera:g} Hz"
    for landmark in s.landmarks if s.observer.name == "riccati" else ():
        distance = float(np.linalg.norm(np.array(landmark.position) - np.array(s.map.origin)))
        if distance > FAR_FROM_ORIGIN:
            yield (
                f"landmark '{landmark.name}' lies {distance:.0f} m from the map origin: the paper's observer is "
                f"not invariant to the origin and degrades beyond {FAR_FROM_ORIGIN:.0f} m; set map.origin inside "
                "the scene"
            )
            break


def own_drives(scenario: Scenario) -> dict[int, Dynamics]:
    """Return the dynamics of the vehicles that a drive of the user's own moves, by their indices."""
    pairs = enumerate(zip(scenario.vehicles, scenario.limits, strict=True))
    return {i: own for i, (vehicle, own) in pairs if vehicle.motion.kind == "driven" and own.model not in DRIVES}


def most_boxes(scenario: Scenario) -> int:
    """Return the largest number of moving boxes besides agents: a co-simulator's traffic, or bodies of own drives."""
    if scenario.cosimulator is not None:
        return scenario.cosimulator.most_vehicles
    return sum(further_bodies(limits) for limits in own_drives(scenario).values())


def agent_starts(scenario: Scenario) -> tuple[np.ndarray, np.ndarray]:
    """Return nominal start positions (A, 3) in the map frame and rotations (A, 3, 3), landmarks first."""
    agents: list[Landmark | Vehicle] = [*scenario.landmarks, *scenario.vehicles]
    routes = {route.name: route for route in scenario.routes}
    starts = [start_of(agent, routes) for agent in agents]
    return np.array([p for p, _ in starts]) - np.array(scenario.map.origin), np.array([R for _, R in starts])


def neighbour_sets(scenario: Scenario) -> list[list[int]]:
    """Return, per vehicle, the indices of the targets that it may measure.

    Without an explicit list these are all landmarks and, under the acyclic restriction, the vehicles before it
    (paper, Assumption 1: N_i within {1, ..., i-1}), otherwise all other vehicles.
    """
    landmarks, vehicles = len(scenario.landmarks), len(scenario.vehicles)
    index = {name: target for target, name in enumerate(scenario.target_names)}
    every, result = [*range(landmarks + vehicles)], []  # lists of the same numbers take a fifth of the memory
    for i, vehicle in enumerate(scenario.vehicles):
        own = landmarks + i
        if vehicle.neighbours is None:
            result.append(every[:own] if scenario.topology.acyclic else every[:own] + every[own + 1 :])
            continue
        where = f"vehicles.{i}.neighbours"
        for name in [name for name in vehicle.neighbours if name not in index][:1]:
            check_one_of(f"{where}: unknown target", name, index, ValueError)
        for name in vehicle.neighbours:
            if index[name] == own:
                raise ValueError(f"{where}: a vehicle cannot be its own neighbour")
        result.append(sorted({index[name] for name in vehicle.neighbours}))
    return result


def processing_order(scenario: Scenario, neighbours: Sequence[Sequence[int]]) -> list[int]:
    """Return vehicle indices so that leaders come before their followers, from the scenario's `neighbour_sets`.

    Raises:
        ValueError: the neighbour sets contain a cycle although `topology.acyclic` is set.
    """
    landmarks = len(scenario.landmarks)
    if not scenario.topology.acyclic:
        return list(range(len(neighbours)))
    leaders, last = list[Sequence[int]](), 0
    for i, targets in enumerate(neighbours):
        if scenario.vehicles[i].neighbours is None:  # it follows all before it, so those from the last such one suffice
            leaders.append(range(last, i))
            last = i
        else:
            leaders.append([j - landmarks for j in targets if j >= landmarks])
    sorter = TopologicalSorter(dict(enumerate(leaders)))
    try:
        sorter.prepare()
    except CycleError as error:
        names = [f"vehicle_{i + 1}" for i in error.args[1]]
        cycle = " -> ".join(names if len(names) <= 8 else [*names[:6], f"{len(names) - 7} more", names[-1]])
        raise ValueError(
            f"topology: the neighbours form a cycle ({cycle}); the paper's Assumption 1 needs an acyclic order "
            "(or set topology.acyclic = false)"
        ) from None
    order: list[int] = []
    while sorter.is_active():
        ready = sorted(sorter.get_ready())
        order += ready
        sorter.done(*ready)
    return order
