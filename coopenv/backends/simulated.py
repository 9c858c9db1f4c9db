"""Simulated worlds, and worlds whose vehicles a program on the host moves (co-simulation)."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
import warp as wp

from coopenv.backends.base import Capabilities, Episode, SensingWorld, TickGenerator
from coopenv.backends.feed import recall_truth
from coopenv.base.errors import CoopenvError
from coopenv.estimation.outcomes import Sight
from coopenv.estimation.poses import Array, about_z
from coopenv.observers.contract import sealed
from coopenv.observers.recording import Sensed, Truth, is_due
from coopenv.observers.registry import find_embedded
from coopenv.observers.runner import start_covariances
from coopenv.scenario import Scenario
from coopenv.world.dynamics import ARRIVED, COLLIDED, UNDER_WAY, depart
from coopenv.world.embedded import HOST, Source, arrange_world, look_around
from coopenv.world.launch import PerWorld
from coopenv.world.model import Precision
from coopenv.world.odometry import measure_odometry
from coopenv.world.reset import begin_sensing, place_everybody
from coopenv.world.state import allocate, array, fields


class SimulatedWorld(SensingWorld):
    """A world that reads what vehicles sense from its state: copies in float64, bearings in the body frame."""

    @cached_property
    def _markers(self) -> np.ndarray:
        """(L, 3, 1) of the landmarks, m."""
        return np.array([landmark.marker for landmark in self.scenario.landmarks], float).reshape(-1, 3, 1)

    @cached_property
    def _from_body(self) -> np.ndarray:
        """(N, 3, 3) body to camera."""
        to_body: np.ndarray = self.model.camera.numpy()["rotation"].astype(float)
        return to_body.swapaxes(-1, -2)

    def sensed(self, world: int, k: int) -> Sensed:
        """Return what the vehicles of one world sense now, at tick k."""
        L, rates = len(self._markers), self.scenario.rates
        visible = self._copy("sight", world) == Sight.VISIBLE
        bearings = np.where(visible[..., None], self._pointed("bearing", world) @ self._from_body, np.nan)
        R, position = self._copy("rotation", world)[:L], self._copy("position", world)[:L]
        arrays = {
            "rotation": self._turned("increment_rotation", world),
            "translation": self._copy("increment_translation", world),
            "velocity": self._copy("odometry_velocity", world),
            "angular_velocity": self._copy("odometry_angular_velocity", world),
            "bearings": bearings,
            "visible": visible,
            "landmarks": position + (R @ self._markers)[..., 0],
        }
        for values in arrays.values():
            values.setflags(write=False)
        pan = None if self.scenario.action.pan is None else sealed(self._copy("pan", world))
        due = bool(is_due(k, self.model.observer.rate / rates.camera))
        return Sensed(index=k, dt=1.0 / rates.camera, due=due, pan=pan, **arrays)

    def full_tick(self, k: int) -> Sensed:
        """Return the tick of the first world with truth and deliveries."""
        L = len(self._markers)
        taken = self._copy("odometry_samples", 0)
        now = k / self.scenario.rates.camera
        return replace(
            self.sensed(0, k),
            odometry_age=np.where(taken > 0, now - (taken - 1) / self.scenario.rates.odometry, np.inf),
            truth=Truth(self._copy("rotation", 0)[L:], self._copy("position", 0)[L:]),
            inbox_tick=self.view("inbox_tick")[0].astype(np.int64),
        )

    def _turned(self, name: str, world: int) -> np.ndarray:
        """Return rotations that are so in float64 too: over thousands of ticks float32's rounding would add up."""
        R = self._copy(name, world)
        if self.precision.numpy is np.float32:
            R = R @ (1.5 * np.eye(3) - 0.5 * np.swapaxes(R, -1, -2) @ R)  # a Newton step towards the nearest rotation
        return R

    def _pointed(self, name: str, world: int) -> np.ndarray:
        """Return unit vectors that are so in float64 too; zero where nothing has been measured."""
        b = self._copy(name, world)
        if self.precision.numpy is np.float32:
            b /= np.maximum(np.linalg.norm(b, axis=-1, keepdims=True), 0.5)
        return b

    def _copy(self, name: str, world: int) -> np.ndarray:
        return np.array(self.view(name)[world], dtype=float)


class Simulated(TickGenerator):
    """Worlds that are computed: many at once on a device, or one of them tick by tick."""

    kind: type[SimulatedWorld] = SimulatedWorld

    def __init__(self, scenario: Scenario) -> None:
        """Simulate a scenario."""
        driven, ticks = scenario.driven, scenario.horizon_ticks + 1
        capabilities = Capabilities(truth=True, driven=driven, real_time=False, ticks=ticks, batched=True)
        super().__init__(scenario, capabilities)
        self._world: SimulatedWorld | None = None

    def world(self, worlds: int, dtype: str, device: str, threads: int | None) -> SimulatedWorld:
        """Return the worlds, with the observer that the scenario names."""
        observer = find_embedded(self.scenario.observer.name) or HOST
        start = start_covariances(self.scenario)
        return self.kind(self.scenario, worlds, dtype, device, threads, observer, start)

    def episode(self, seed: int | None, options: Mapping[str, Any]) -> Episode:
        """Simulate one world in float64, without an observer: deliveries do not depend on the contents of messages."""
        if self._world is None:
            self._world = self.kind(self.scenario, 1, "float64", threads=1)
        world = self._world
        world.reset(None if seed is None else [seed])
        command = yield world.full_tick(0)
        for k in range(1, self.scenario.horizon_ticks + 1):
            world.view("command")[0] = command.rows
            world.fetch()
            world.sense()
            for vehicle in world.observer_init.order:
                world.receive(vehicle)
                world.broadcast(vehicle)
            world.finish()
            command = yield world.full_tick(k)


@cache
def cosimulation_struct(p: Precision) -> Any:
    """Return the Warp struct of the poses and twists of the present tick, in one precision."""
    scalar, vec3, mat33 = p.scalar, p.vec3, p.mat33

    @wp.struct
    class HostMotion:
        """W worlds, N vehicles, Z bodies of the traffic; lengths in m, angles in rad, map and body frames as named."""

        true_rotation: array("WN", mat33)  # body to map
        true_position: array("WN", vec3)  # map
        true_velocity: array("WN", vec3)  # held over the tick, body, m/s
        true_angular_velocity: array("WN", vec3)  # likewise, rad/s
        speed: array("WN", scalar)  # m/s
        steering: array("WN", scalar)
        crashed: array("WN", wp.int32)
        left: array("WN", wp.int32)
        traffic_position: array("WZ", vec3)  # map
        traffic_rotation: array("WZ", mat33)
        traffic_half: array("WZ", vec3)

    return HostMotion


@wp.func
def take_pose(model: Any, state: Any, motion: Any, world: int, vehicle: int):
    """Write the true pose and twist of a vehicle; the twist holds for all odometry samples of the tick."""
    recall_truth(model, state, motion, world, vehicle, world)
    state.speed[world, vehicle] = motion.speed[world, vehicle]
    state.steering[world, vehicle] = motion.steering[world, vehicle]
    if motion.left[world, vehicle] != 0:
        state.present[world, model.landmarks + vehicle] = 0
    for sample in range(model.samples_per_tick):
        state.sampled_velocity[world, vehicle, sample] = motion.true_velocity[world, vehicle]
        state.sampled_angular_velocity[world, vehicle, sample] = motion.true_angular_velocity[world, vehicle]


@wp.func
def take_traffic(model: Any, state: Any, motion: Any, world: int):
    """Write where the traffic is."""
    for k in range(model.traffic):
        state.traffic_position[world, k] = motion.traffic_position[world, k]
        state.traffic_rotation[world, k] = motion.traffic_rotation[world, k]
        state.traffic_half[world, k] = motion.traffic_half[world, k]


@wp.func
def renew_sample(model: Any, state: Any, motion: Any, world: int, vehicle: int, tick: int):
    """Let an odometry sample that fell on the last frame measure the twist that began there, its noise kept.

    Twists jump from tick to tick, and that of the new one was not known when the sample was taken.
    """
    agent = model.landmarks + vehicle
    taken = wp.float64(state.odometry_samples[world, vehicle] - 1) * model.odometry_period
    if wp.abs(taken - wp.float64(tick - 1) * model.camera_period) < wp.float64(1.0e-9):
        v = motion.true_velocity[world, vehicle] - state.velocity[world, agent]
        w = motion.true_angular_velocity[world, vehicle] - state.angular_velocity[world, agent]
        state.odometry_velocity[world, vehicle] = state.odometry_velocity[world, vehicle] + v
        state.odometry_angular_velocity[world, vehicle] = state.odometry_angular_velocity[world, vehicle] + w


@wp.func
def begin_cosimulation(model: Any, state: Any, motion: Any, world: int):
    """Begin an episode where the vehicles stand; initial estimates are drawn as in the simulation."""
    place_everybody(model, state, world)
    take_traffic(model, state, motion, world)
    for vehicle in range(model.vehicles):
        take_pose(model, state, motion, world, vehicle)
        agent = model.landmarks + vehicle
        state.start_rotation[world, agent] = state.rotation[world, agent]
        state.start_position[world, agent] = state.position[world, agent]
    begin_sensing(model, state, world)


@wp.func
def move_cosimulated(model: Any, state: Any, motion: Any, world: int, vehicle: int, tick: int):
    """Take the pose of a vehicle at a tick and measure its motion."""
    depart(model, state, world, vehicle)
    renew_sample(model, state, motion, world, vehicle, tick)
    take_pose(model, state, motion, world, vehicle)
    measure_odometry(model, state, world, vehicle, tick)


@wp.func
def arrange_cosimulated(model: Any, state: Any, motion: Any, world: int, tick: int):
    """Take the traffic, and do what a simulation does."""
    take_traffic(model, state, motion, world)
    arrange_world(model, state, motion, world, tick)


@wp.func
def look_cosimulated(model: Any, state: Any, motion: Any, world: int, vehicle: int, tick: int):
    """Do what a simulation does; the moving program may know of past contacts and departures."""
    if state.ended[world, vehicle] == UNDER_WAY:
        if motion.crashed[world, vehicle] != 0 and model.scene.end_on_collision == 1:
            state.ended[world, vehicle] = COLLIDED
        elif motion.left[world, vehicle] != 0 and model.scene.end_on_arrival == 1:
            state.ended[world, vehicle] = ARRIVED
    look_around(model, state, motion, world, vehicle, tick)
    if motion.crashed[world, vehicle] != 0:
        state.collided[world, vehicle] = 1


COSIMULATED = Source(
    "cosimulated",
    begin_cosimulation,
    move_cosimulated,
    arrange_cosimulated,
    look_cosimulated,
    cosimulation_struct,
    keeps_nearby=True,
)
"""Ticks of vehicles that a program on the host moves."""


@dataclass(frozen=True)
class Poses:
    """Where N vehicles and Z other bodies are on the plane, map frame; of an absent body nothing but `half` counts."""

    xy: Array  # (N, 2) m
    heading: Array  # (N,) rad, from x towards y
    speed: Array  # (N,) m/s
    steering: Array  # (N,) rad, positive to the left
    crashed: Array  # (N,) bool, has touched something
    left: Array  # (N,) bool, has left the road for good
    traffic_position: Array  # (Z, 3) centres of boxes, m
    traffic_heading: Array  # (Z,) rad
    traffic_half: Array  # (Z, 3) half of their edges, m; zero: absent


class CosimulatedWorld(SimulatedWorld):
    """Worlds on the CPU whose vehicles stand where `place` and `move` put them; all else is as in the simulation."""

    source = COSIMULATED

    def __init__(self, *arguments: Any, **options: Any) -> None:
        """Build the arrays; arguments and errors as for `World`, and CoopenvError: not on the CPU."""
        super().__init__(*arguments, **options)
        if self.device != "cpu":
            raise CoopenvError(f"device '{self.device}': these worlds are moved on the host, use device='cpu'")

    def _build_record(self) -> Any:
        struct, model = cosimulation_struct(self.precision), self.model
        record = allocate(struct, {"W": self.worlds, "N": model.vehicles, "Z": model.traffic}, self.device)
        self._motion = {name: getattr(record, name).numpy() for name in fields(struct)}
        self._xy, self._heading = np.zeros((self.worlds, model.vehicles, 2)), np.zeros((self.worlds, model.vehicles))
        return PerWorld(record)

    def place(self, world: int, poses: Poses) -> None:
        """Put the vehicles of one world where an episode begins, before it is reset."""
        self._put(world, poses, np.zeros_like(poses.xy), np.zeros_like(poses.heading))

    def move(self, world: int, poses: Poses) -> None:
        """Put the vehicles of one world where they are at the next tick, before it is advanced.

        The odometry measures the twist that leads there from the last pose when it is held over the tick.
        """
        turned = (poses.heading - self._heading[world] + np.pi) % (2.0 * np.pi) - np.pi
        c, s = np.cos(self._heading[world]), np.sin(self._heading[world])
        dx, dy = (poses.xy - self._xy[world]).T
        forward, left = c * dx + s * dy, c * dy - s * dx
        # rho of Log in SE(2): V(turned)^-1 times the way in the body frame
        half = turned / 2.0
        a = np.where(np.abs(half) < 1e-6, 1.0, half / np.tan(np.where(half == 0.0, 1.0, half)))
        way = np.stack([a * forward + half * left, a * left - half * forward], axis=-1)
        rate = self.scenario.rates.camera
        self._put(world, poses, way * rate, turned * rate)

    def _put(self, world: int, poses: Poses, velocity: Array, yaw_rate: Array) -> None:
        row = {name: values[world] for name, values in self._motion.items()}
        self.remember(world, poses)
        row["true_rotation"][...] = about_z(poses.heading)
        row["true_position"][..., :2] = poses.xy
        row["true_velocity"][..., :2], row["true_angular_velocity"][..., 2] = velocity, yaw_rate
        row["traffic_rotation"][...] = about_z(poses.traffic_heading)
        for name in ("speed", "steering", "crashed", "left", "traffic_position", "traffic_half"):
            row[name][...] = getattr(poses, name)

    def remember(self, world: int, poses: Poses) -> None:
        """Take poses for the last ones, of a world that is about to be restored."""
        self._xy[world], self._heading[world] = poses.xy, poses.heading

    def advance(self, ticks: int) -> None:
        """Run camera ticks, see `World.advance`; `fetch` moves the vehicles to each."""
        self.decide()
        for _ in range(ticks):
            self.fetch()
            super().advance(1)
