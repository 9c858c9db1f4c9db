"""Every field of a scenario, typed; `schema.Scenario` checks them against one another."""

from typing import Annotated, Literal

from pydantic import Field

from coopenv.base.sections import Section
from coopenv.scenario.base import Number, Positive, Text, Vector3, Word, overlaid
from coopenv.scenario.bodies import Landmark, LandmarkGroup, Obstacle, Road, Vehicle
from coopenv.scenario.learning import Action, Difficulty, Dynamics, Observation, Randomisation, Reward, Termination
from coopenv.scenario.routes import Route
from coopenv.scenario.sensing import Camera, Faults, Noise, Observer, Rates, Topology, V2x

Setting = bool | int | Number | Word | tuple[Number, ...] | None


class Highway(Section):
    """Roads, traffic (IDM and MOBIL) and dynamics of an environment of highway-env, see docs/highway.md."""

    id: Annotated[str, Field(max_length=64, pattern=r"^[a-z0-9][A-Za-z0-9-]*-v\d+$")]
    """Its id in Gymnasium's registry, such as `intersection-v0`."""
    config: dict[str, Setting] = Field(default={})
    """Its own configuration by key; settings of this file (rates, sizes of actions) are not repeated here."""
    dynamical: bool = False
    """Whether driven vehicles have tyres that slip (highway-env's BicycleVehicle); otherwise its kinematic bicycle."""
    most_vehicles: int = Field(default=40, ge=0, le=1000)
    """Vehicles on its road at most, besides those of this file: the traffic that only occludes and collides."""


class Map(Section):
    """The frame in which vehicles know the landmarks."""

    origin: Vector3 = (0.0, 0.0, 0.0)
    """Point of this file's coordinates at which the map frame has its origin; keep it inside the scene."""


class ScenarioFields(Section):
    """One environment. Units: m, s, rad; frames: x east, y north, z up; body x forward, y left, z up."""

    title: Text
    description: Text = ""
    source: Text = ""
    """Where the figures come from."""
    horizon: Positive
    """Length of an episode, s."""
    backend: Literal["simulated", "highway"] = "simulated"
    """What moves the vehicles: coopenv itself, or highway-env with the section `[highway]`."""
    highway: Highway | None = None
    map: Map = Map()
    routes: tuple[Route, ...] = Field(default=(), max_length=1_000)
    roads: tuple[Road, ...] = Field(default=(), max_length=10_000)
    obstacles: tuple[Obstacle, ...] = Field(default=(), max_length=10_000)
    landmarks: tuple[Landmark, ...] = Field(max_length=50_000)
    landmark_groups: tuple[LandmarkGroup, ...] = Field(default=(), max_length=1_000)
    vehicles: tuple[Vehicle, ...] = Field(min_length=1, max_length=1_000)
    camera: Camera = Camera()
    rates: Rates = Rates()
    noise: Noise = Noise()
    topology: Topology = Topology()
    sensing: Literal["sensed", "ideal", "blind"] = "sensed"
    """One switch for studies of what looking is worth; all else stays equal, noise, radio and draws included.
    `ideal`: every neighbour is measured in every frame, whatever the field of view, range, misses and what is in
    between; `blind`: nothing is ever measured; `sensed`: by `topology.mode`."""
    v2x: V2x = V2x()
    faults: Faults = Faults()
    observer: Observer = Observer()
    dynamics: Dynamics = Dynamics()
    randomisation: Randomisation = Randomisation()
    difficulty: Difficulty = Difficulty()
    observation: Observation = Observation()
    action: Action = Action()
    reward: Reward = Reward()
    termination: Termination = Termination()

    @property
    def paced(self) -> bool:
        """Whether the pace of prescribed motions may vary."""
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
    def driven(self) -> bool:
        """Whether any vehicle is driven by actions."""
        return any(vehicle.motion.kind == "driven" for vehicle in self.vehicles)

    @property
    def has_lasting_errors(self) -> bool:
        """Whether any vehicle's odometry or camera has errors that last, see `[noise]` and `[camera]`."""
        noises, cameras = self.noises, self.cameras
        return any(n.enabled and (n.lasts or c.is_misplaced) for n, c in zip(noises, cameras, strict=True))

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
        """What may go wrong with every vehicle."""
        return [overlaid(self.faults, vehicle.faults) for vehicle in self.vehicles]

    @property
    def replay_ticks(self) -> int:
        """The most ticks that a replayed message may be old beyond what the radio takes, over all vehicles."""
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
    def ticks_per_decision(self) -> int:
        """Camera ticks between two decisions of the policy."""
        return round(self.rates.camera / self.rates.decision)

    @property
    def horizon_ticks(self) -> int:
        """Camera ticks of an episode."""
        return max(1, round(self.horizon * self.rates.camera))
