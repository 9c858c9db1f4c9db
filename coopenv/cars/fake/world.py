"""The world of one fake car: the simulation's kernels move the car, other cars are where motion capture puts them."""

import math
from collections import deque
from collections.abc import Iterator
from typing import Any

import numpy as np
import warp as wp

from coopenv.base.errors import CoopenvError
from coopenv.cars.backend.binding import Binding
from coopenv.cars.gate.wheel_command import NEUTRAL, MotionCommand
from coopenv.cars.link.transport import Arrival, Transport
from coopenv.cars.messages.codec import decode
from coopenv.cars.messages.readings import CarPose, read
from coopenv.cars.settings.profile import Role
from coopenv.estimation import Sight
from coopenv.estimation.poses import Array
from coopenv.scenario import Scenario
from coopenv.world.camera import observe
from coopenv.world.dynamics import drive, prescribe
from coopenv.world.launch import PerWorld
from coopenv.world.model import PRESCRIBED
from coopenv.world.nearby import sort_into_cells
from coopenv.world.odometry import drift
from coopenv.world.world import World


def drive_one(model: Any, state: Any, duration: wp.array(dtype=wp.float64), vehicle: int):
    """Let one vehicle follow its command for a while, s."""
    world = wp.tid()
    drive(model, state, world, vehicle, state.command[world, vehicle], duration[world])


def prescribe_one(model: Any, state: Any, time: wp.array(dtype=wp.float64), agent: int):
    """Put one agent where its prescribed motion is at a time since the start, s."""
    world = wp.tid()
    prescribe(model, state, world, agent, time[world])


def look_once(model: Any, state: Any, frame: wp.array(dtype=wp.int32), vehicle: int):
    """Carry the lasting errors of one vehicle to a camera frame and take it; frames count from the start."""
    world = wp.tid()
    drift(model, state, world, vehicle, frame[world])
    sort_into_cells(model, state, world)
    observe(model, state, world, vehicle, frame[world])


class CarWorld(World):
    """World of one agent. Poses are in the map, from its origin."""

    def __init__(self, scenario: Scenario, agent: int, *, frames: bool = False) -> None:
        """Build it.

        Args:
            scenario: scenario of the world.
            agent: index of the agent that this car is, a moving landmark or, after the landmarks, a vehicle.
            frames: whether cameras take frames, which have noise of their own: sight is exact.

        Raises:
            CoopenvError: the scenario limits what vehicles keep.
        """
        if scenario.topology.most_nearby is not None:
            raise CoopenvError("topology.most_nearby: cars keep all; leave it out")
        self._frames = frames
        super().__init__(scenario, 1, "float64", threads=1)
        self.agent, self.vehicle = agent, agent - self.model.landmarks
        self._acceleration = scenario.limits[self.vehicle].max_acceleration if self.vehicle >= 0 else 0.0
        self._time, self._frame = wp.zeros(1, dtype=wp.float64), wp.zeros(1, dtype=wp.int32)
        self._time_value, self._frame_value = self._time.numpy(), self._frame.numpy()

    def _build_model(self) -> Any:
        """Build the model; cameras see all carriers of markers, and measure before pixels are rounded."""
        model = super()._build_model()
        camera = model.camera.numpy()  # on the CPU this and the others are views
        camera["quantise"], camera["undistort"] = 0, 1
        camera["changes"] = 0  # frames are stamped when they are exposed
        if self._frames:
            camera["miss_probability"], model.noise.numpy()["bearing"] = 0.0, 0.0
        targets = np.tile(np.arange(model.agents), (model.vehicles, 1))
        for vehicle in range(model.vehicles):
            own = model.landmarks + vehicle
            targets[vehicle] = [*(a for a in range(model.agents) if a != own), -1]
        model.targets.numpy()[...] = targets
        model.target_count.numpy()[...] = model.agents - 1
        return model

    def begin(self, seed: int) -> None:
        """Go to the start that the simulation draws with a key; all stand, other vehicles are not there yet."""
        self.reset([seed])
        L = self.model.landmarks
        self.view("present")[0, L:] = 0
        self.view("present")[0, self.agent] = 1
        self.view("ended")[0] = 0
        for name in ("speed", "turn", "velocity", "angular_velocity"):
            self.view(name)[0] = 0.0

    def drive(self, duration: float, speed: float, steering: float, deceleration: float | None = None) -> None:
        """Move by the bicycle under a command, m/s and rad, for a while, s; slow down by a deceleration, m/s^2."""
        self._time_value[0] = duration
        slower = deceleration is not None and abs(speed) < abs(self.view("speed")[0, self.vehicle])
        most = deceleration if slower else self._acceleration
        self.view("command")[0, self.vehicle] = (speed, steering, most, 0.0, 0.0)
        self._run("drive", drive_one, PerWorld(self._time), self.vehicle)

    def follow(self, time: float) -> None:
        """Move to where the prescribed motion is at a time since the start, s."""
        self._time_value[0] = time
        self._run("prescribe", prescribe_one, PerWorld(self._time), self.agent)

    def look(self, frame: int) -> dict[int, Array]:
        """Return the unit rays (3,), optical frame, at which the agents in view are seen, by agent."""
        self._frame_value[0] = frame
        self._run("look", look_once, PerWorld(self._frame), self.vehicle)
        seen = np.flatnonzero(self.view("sight")[0, self.vehicle] == Sight.VISIBLE)
        bearings = self.view("bearing")[0, self.vehicle]
        return {int(agent): bearings[agent].copy() for agent in seen}

    def put(self, agent: int, rotation: Array, position: Array) -> None:
        """Put another agent somewhere."""
        self.view("rotation")[0, agent], self.view("position")[0, agent] = rotation, position
        self.view("present")[0, agent] = 1

    def pose(self, agent: int) -> tuple[Array, Array]:
        """Return the rotation (3, 3), body to map, and the position (3,), m, of an agent."""
        return self.view("rotation")[0, agent], self.view("position")[0, agent]

    def distance(self, agent: int) -> float:
        """Return the distance to the body of another agent, m."""
        place = self.view("position")[0]
        return math.dist(place[agent], place[self.agent])

    @property
    def twist(self) -> tuple[Array, Array]:
        """The own velocity, m/s, and turn rate, rad/s, (3,) each, body axes."""
        return self.view("velocity")[0, self.agent], self.view("angular_velocity")[0, self.agent]


class Neighbours:
    """Places the other cars by motion capture; they are in the world from their first message on."""

    def __init__(self, world: CarWorld, binding: Binding, name: str, transport: Transport) -> None:
        """Listen to all cars but that of a name."""
        L = world.model.landmarks
        agents = {**binding.leaders, **{car: L + vehicle for car, vehicle in binding.cars.items()}}
        self._world, self._origin = world, np.array(world.scenario.map.origin)
        self._truth_type, topic_of = binding.profile.topics[Role.TRUTH].type, binding.profile.topic_of
        self._agents = {topic_of(car, Role.TRUTH): agent for car, agent in agents.items() if car != name}
        self._received: dict[str, bytes] = {}
        self._moving = np.flatnonzero(world.model.motion.kind.numpy()[:L] == int(PRESCRIBED))
        transport.subscribe(topic_of("*", Role.TRUTH), self._receive)  # one, as every subscription costs a thread

    def _receive(self, arrival: Arrival) -> None:
        if arrival.topic in self._agents:
            self._received[arrival.topic] = arrival.payload  # read when the camera looks: many are never looked at

    def begin(self) -> None:
        """Drop their poses. A moving landmark is a car as well, and absent without it."""
        self._received.clear()
        for landmark in self._moving:
            if landmark != self._world.agent:
                self._world.view("present")[0, landmark] = 0

    def place(self) -> None:
        """Put them at their last poses."""
        while self._received:
            try:
                topic, payload = self._received.popitem()
                value = read(Role.TRUTH, decode(payload, self._truth_type))
            except CoopenvError:
                continue  # malformed
            if isinstance(value, CarPose) and value.rotation is not None:
                self._world.put(self._agents[topic], value.rotation, value.position - self._origin)


class Actuators:
    """Commands in the order of time; times in ns on one clock. Lag, limits and dead band are the world's."""

    def __init__(self, latency: float, timeout: float) -> None:
        """Build them for a dead time, and a time without a command after which they go to neutral; both in s."""
        self._latency, self._timeout = round(latency * 1e9), round(timeout * 1e9)
        self._waiting: deque[tuple[int, MotionCommand]] = deque()  # from when on; the last one is the time-out
        self._now = NEUTRAL

    def clear(self) -> None:
        """Forget all commands."""
        self._waiting.clear()
        self._now = NEUTRAL

    def receive(self, drive: MotionCommand, at: int) -> None:
        """Take a command that has come."""
        begin = at + self._latency
        if self._waiting and self._waiting[-1][0] > begin:
            self._waiting.pop()  # the command before it does not time out
        self._waiting.extend([(begin, drive), (begin + self._timeout, NEUTRAL)])

    def pieces(self, begin: int, end: int) -> Iterator[tuple[float, MotionCommand]]:
        """Yield (duration in s, followed command) from a time to a later one; each stretch is read once."""
        now = begin
        while now < end:
            while self._waiting and self._waiting[0][0] <= now:
                _, self._now = self._waiting.popleft()
            stop = min(end, self._waiting[0][0]) if self._waiting else end
            yield (stop - now) * 1e-9, self._now
            now = stop
