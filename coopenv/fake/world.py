"""The room as one fake car has it: it moves itself by the simulation's kernels, others are where they are heard."""

import math
from typing import Any

import numpy as np
import warp as wp

from coopenv.estimation.arrays import Array
from coopenv.estimation.outcomes import Sight
from coopenv.fake.kernels import drive_one, look_once, prescribe_one
from coopenv.scenario import Scenario
from coopenv.world.launch import PerWorld
from coopenv.world.world import World


class Room(World):
    """One world, in which one agent is at home. Poses are in the map, from its origin."""

    def __init__(self, scenario: Scenario, agent: int) -> None:
        """Build it.

        Args:
            scenario: what it is a world of.
            agent: index of the agent that this car is, a moving landmark or, after the landmarks, a vehicle.
        """
        super().__init__(scenario, 1, "float64", threads=1)
        self.agent, self.vehicle = agent, agent - self.model.landmarks
        self._acceleration = scenario.limits[self.vehicle].max_acceleration if self.vehicle >= 0 else 0.0
        self._time, self._frame = wp.zeros(1, dtype=wp.float64), wp.zeros(1, dtype=wp.int32)
        self._time_value, self._frame_value = self._time.numpy(), self._frame.numpy()

    def _build_model(self) -> Any:
        """Build the model; cameras see whoever carries a marker, and measure before pixels are rounded."""
        model = super()._build_model()
        camera = model.camera.numpy()  # on the CPU this and the others are views
        camera["quantise"], camera["undistort"] = 0, 1
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
        for name in ("speed", "steering", "velocity", "angular_velocity"):
            self.view(name)[0] = 0.0

    def drive(self, duration: float, speed: float, steering: float) -> None:
        """Move by the bicycle under a command, m/s and rad, for a while, s."""
        self._time_value[0] = duration
        self.view("command")[0, self.vehicle] = (speed, steering, self._acceleration, 0.0)
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
        """Return how far the body of another agent is, m."""
        place = self.view("position")[0]
        return math.dist(place[agent], place[self.agent])

    @property
    def twist(self) -> tuple[Array, Array]:
        """The own velocity, m/s, and turn rate, rad/s, (3,) each, body axes."""
        return self.view("velocity")[0, self.agent], self.view("angular_velocity")[0, self.agent]
