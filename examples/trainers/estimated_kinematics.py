"""Any policy of highway-env on estimated kinematics, to measure the cost of localisation errors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import gymnasium
import numpy as np

from coopenv.api.engine import Engine
from coopenv.base.errors import CoopenvError
from coopenv.base.seeds import checked_seed
from coopenv.estimation import Sight
from coopenv.estimation.poses import Array, position_covariance
from coopenv.highway.program import flipped, poses_of
from coopenv.scenario import Scenario, load_scenario
from coopenv.sources.cosimulation import Cosimulated, Moment, Poses, TrafficProgram

LONGEST = 3600.0  # s, of an episode


class Kinematics(NamedTuple):
    """Estimated pose and speed of a car, in highway-env's frame."""

    xy: Array  # (2,) m
    heading: float  # rad
    speed: float  # m/s


class Followed(TrafficProgram):
    """Vehicles that stand at the poses of `present`."""

    present: Poses

    def __init__(self, scenario: Scenario) -> None:
        """Follow the wrapper's `present`."""

    def reset(self, seed: int) -> None:
        """Begin where the vehicles stand."""

    def command(self, now: Moment) -> None:
        """Do nothing: the environment has moved them."""

    def poses(self) -> Poses:
        """Return their positions."""
        return self.present


class EstimatedKinematics(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment of highway-env whose observation is made from estimates instead of the truth.

    The car of the agent and up to `connected` cars of the traffic carry the scenario's cameras, odometry, radio and
    observers, at every step of highway-env's simulation. When the observation is made,

    - the agent's car has the pose of its estimate and the speed of its odometry;
    - connected cars have the pose of their last received message, while that is not stale;
    - all other cars have their true pose relative to the agent's car, and so share its error.

    All kinds of observation of highway-env, and all of their settings, work as they are. Rewards and ends of episodes
    stay those of the truth.

    `info["localisation"]` holds of the agent's car, and `info["connected"]` of the connected ones (a tuple), estimated
    `position` (2,) m and `heading` rad and `position_covariance` (2, 2) m^2, in highway-env's frame,
    `position_error` m, `orientation_error` deg, and `visible` (names of targets).
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        scenario: str | Path = "highway_intersection",
        *,
        sensing: Literal["ideal", "sensed", "blind"] | None = None,
        connected: int = 2,
        lane_keeping: bool = False,
        overrides: Mapping[str, Any] | None = None,
    ) -> None:
        """Wrap an environment with one agent.

        Args:
            env: of highway-env.
            scenario: name or file with the sensors, the observer and the landmarks; its vehicles give way to the cars.
            sensing: the scenario's key: "ideal" measures every target in every frame, "sensed" what is in view, "blind"
                nothing; None: as the scenario says.
            connected: largest number of connected cars of the traffic: the nearest ones at the start.
            lane_keeping: let the car's own control, such as highway-env's lane keeping, use its estimate, too.
            overrides: dotted keys of the scenario.

        Raises:
            CoopenvError: it is not an environment of highway-env, or another argument is not valid.
        """
        super().__init__(env)
        if not isinstance(connected, int) or connected < 0:
            raise CoopenvError(f"connected must be a whole number and not negative, got {connected!r}")
        self.highway: Any = env.unwrapped
        if not hasattr(self.highway, "road") or not hasattr(self.highway, "observation_type"):
            raise CoopenvError(
                f"EstimatedKinematics wraps environments of highway-env, not {type(self.highway).__name__}"
            )
        self.connected, self.lane_keeping = connected, lane_keeping
        self._load = partial(load_scenario, scenario)
        self._overrides = {**(overrides or {}), **({} if sensing is None else {"sensing": sensing})}
        declared = self._load(self._overrides).highway
        if declared is None:
            raise CoopenvError(f'EstimatedKinematics: {scenario} has not backend = "highway"')
        self._most = max(1, declared.most_vehicles)  # doubled as needed
        self._engines: dict[tuple[int, int], Engine] = {}
        self._rng = np.random.default_rng()
        self._cars: list[Any] = []  # connected ones, then the agent's, which receives from all of them

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode; initial estimates are drawn about the truth as the scenario says."""
        _, info = self.env.reset(seed=seed, options=options)
        if seed is not None:
            self._rng = np.random.default_rng(checked_seed(seed))
        self._board()
        self._follow()
        self._engine.reset([int(self._rng.integers(2**63))])
        return self.highway.observation_type.observe(), self._with_localisation(info)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment; sensors and observers run along with its simulation."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated, self._with_localisation(info)

    def _board(self) -> None:
        """Find the cars of this episode, and hook into their motion and observation."""
        road, agents = self.highway.road, self.highway.controlled_vehicles
        if len(agents) != 1:
            raise CoopenvError(f"EstimatedKinematics takes environments with one agent, this one has {len(agents)}")
        agent = agents[0]
        traffic = [car for car in road.vehicles if car is not agent]
        traffic.sort(key=lambda car: float(np.linalg.norm(car.position - agent.position)))
        self._cars = [*traffic[: self.connected], agent]
        while self._most < 2 * len(road.vehicles):  # traffic may join later
            self._most *= 2
        road.step = partial(self._step_road, road.step)
        self.highway.observation_type.observe = partial(self._observe, self.highway.observation_type.observe)
        if self.lane_keeping:
            agent.act = partial(self._act, agent.act)
        key = (len(self._cars), self._most)
        if key not in self._engines:
            self._engines[key] = self._build(*key)
        self._engine = self._engines[key]
        self._world: Any = self._engine.world

    def _step_road(self, step: Any, dt: float) -> None:
        step(dt)
        self._follow()
        self._engine.step(ticks=1)

    def _act(self, act: Any, action: Any = None) -> None:
        with moved_to({self._cars[-1]: self._estimated(len(self._cars) - 1)}):
            act(action)

    def _build(self, count: int, most: int) -> Engine:
        """Return sensors and observers for so many cars among at most so many."""
        frequency = float(self.highway.config["simulation_frequency"])
        cars = [{"motion": {"kind": "traffic"}}] * (count - 1) + [{"motion": {"kind": "driven"}}]
        rates = {"rates.camera": frequency, "rates.decision": frequency, "rates.odometry": 5.0 * frequency}
        fixed = {"horizon": LONGEST, "vehicles": cars, "routes": [], "highway.most_vehicles": most, **rates}
        scenario: Scenario = self._load({**self._overrides, **fixed})
        return Engine(scenario, 1, backend=Cosimulated(scenario, Followed))

    def _follow(self) -> None:
        """Put the vehicles of the world where the cars are."""
        origin = np.array(self._world.scenario.map.origin)
        self._world.programs[0].present = poses_of(self._cars, self.highway.road, origin)

    def _observe(self, observe: Any) -> Any:
        """Return the observation that highway-env makes when all cars have their estimated poses."""
        agent, last = self._cars[-1], len(self._cars) - 1
        own = self._estimated(last)
        received = {self._cars[i]: message for i in range(last) if (message := self._received(i)) is not None}
        c, s = np.cos(own.heading - agent.heading), np.sin(own.heading - agent.heading)
        turn = np.array([[c, -s], [s, c]])
        seen = {
            thing: Kinematics(
                own.xy + turn @ (thing.position - agent.position),
                thing.heading + own.heading - agent.heading,
                thing.speed,
            )
            for thing in (*self.highway.road.vehicles, *self.highway.road.objects)
        }
        with moved_to({**seen, **received, agent: own}):
            return observe()

    def _estimated(self, i: int) -> Kinematics:
        """Return the estimate of a car."""
        view = self._engine.view
        R = view("estimate_rotation")[0, i]
        return self._kinematics(i, R, R @ view("estimate_position")[0, i])

    def _received(self, i: int) -> Kinematics | None:
        """Return the last message of a connected car to the agent's; None if it is stale, or the car left the road."""
        view = self._engine.view
        sent = int(view("inbox_tick")[0, -1, i])
        age = (int(view("tick")[0]) - sent) / self._world.scenario.rates.camera
        there = any(car is self._cars[i] for car in self.highway.road.vehicles)
        if sent < 0 or age > self._world.model.radio.staleness or not there:
            return None
        return self._kinematics(i, view("inbox_rotation")[0, -1, i], view("inbox_position")[0, -1, i])

    def _kinematics(self, i: int, R: Array, position: Array) -> Kinematics:
        view = self._engine.view
        v = view("odometry_velocity")[0, i]
        known = view("odometry_samples")[0, i] > 0  # otherwise nothing has moved yet
        speed = float(np.copysign(np.hypot(v[0], v[1]), v[0]) if known else view("speed")[0, i])
        xy = position[:2] + self._world.scenario.map.origin[:2]
        return Kinematics(flipped(xy.astype(float)), -float(np.arctan2(R[1, 0], R[0, 0])), speed)

    def _with_localisation(self, info: dict[str, Any]) -> dict[str, Any]:
        """Return the info with estimates and their errors."""
        *connected, agent = (self._localisation(i) for i in range(len(self._cars)))
        return {**info, "localisation": agent, "connected": tuple(connected)}

    def _localisation(self, i: int) -> dict[str, Any]:
        view, estimated = self._engine.view, self._estimated(i)
        R_hat, p_hat, P = (view(name)[0, i] for name in ("estimate_rotation", "estimate_position", "covariance"))
        mirror = np.diag([1.0, -1.0])
        return {
            "position": estimated.xy,
            "heading": estimated.heading,
            "position_covariance": mirror @ position_covariance(R_hat, R_hat @ p_hat, P)[:2, :2] @ mirror,
            "position_error": float(view("position_error")[0, i]),
            "orientation_error": float(view("orientation_error")[0, i]),
            "visible": tuple(
                name
                for name, sight in zip(self._world.scenario.target_names, view("sight")[0, i], strict=True)
                if sight == Sight.VISIBLE
            ),
        }


@contextmanager
def moved_to(estimates: Mapping[Any, Kinematics]) -> Iterator[None]:
    """Move cars and objects of highway-env to estimated kinematics, and back at the end."""
    names = ("position", "heading", "speed", "lane_index", "lane")
    truth = {thing: [getattr(thing, name) for name in names] for thing in estimates}
    try:
        for thing, estimate in estimates.items():
            thing.position, thing.heading, thing.speed = estimate
            thing.lane_index = thing.road.network.get_closest_lane_index(thing.position, thing.heading)
            thing.lane = thing.road.network.get_lane(thing.lane_index)
        yield
    finally:
        for thing, values in truth.items():
            for name, value in zip(names, values, strict=True):
                setattr(thing, name, value)
