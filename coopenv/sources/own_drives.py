"""Worlds in which a user's own drives (`coopenv.motions.own`) move their vehicles on the host, every camera tick.

The worlds draw the starts and move all other vehicles. Sensors, radio and observers are as in the simulation.
"""

from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from coopenv.base.errors import UserCodeError, listed
from coopenv.estimation.poses import Array
from coopenv.motions.command import LATERAL, SPEED, TURN
from coopenv.motions.own import BOX, OwnDrive
from coopenv.scenario import Scenario
from coopenv.scenario.schema import most_boxes, own_drives
from coopenv.sources.cosimulation import CosimulatedWorld, Moment, Poses, TrafficProgram
from coopenv.sources.feed import PLACED
from coopenv.sources.worlds import Simulated
from coopenv.world.route import UNDER_WAY

ENTRIES = [int(entry) for entry in (SPEED, TURN, LATERAL)]
"""Entries of a command that are the columns of a user's own drive."""
ELSEWHERE = 0.01
"""m; a vehicle that stands farther from where its drive has moved it has been placed there, and starts anew."""
HEIGHT = 1.0
"""m, of the boxes of further bodies: their drives are planar."""


class OwnDrives(TrafficProgram):
    """The user's own drives of one world; the other vehicles are moved there."""

    def __init__(self, scenario: Scenario) -> None:
        """Make the drives. Raises CoopenvError: a class cannot be loaded or fails."""
        self._drives = {i: OwnDrive(limits) for i, limits in own_drives(scenario).items()}
        self._period, self._boxes = 1.0 / scenario.rates.camera, most_boxes(scenario)
        self._vehicles, self._ground = len(scenario.vehicles), -scenario.map.origin[2]
        self.states: dict[int, Array] = {}
        """States of the drives by vehicle."""

    def reset(self, seed: int) -> None:
        """Begin an episode where the world places the vehicles."""
        zero = np.zeros(self._vehicles)
        self._set(np.zeros((self._vehicles, 2)), zero, zero, zero, np.full(self._vehicles, float(PLACED)), [])

    def begin(self, now: Moment) -> None:
        """Start the drives at the drawn poses."""
        self.states = {i: drive.start(pose_of(now, i)) for i, drive in self._drives.items()}
        self._note(now)

    def command(self, now: Moment) -> None:
        """Let every drive whose vehicle is present make its step to the next tick."""
        for i, drive in self._drives.items():
            state = self.states[i]
            if np.hypot(*(now.xy[i] - state[:2])) > ELSEWHERE:
                state = drive.start(pose_of(now, i))
            if now.present[i]:
                state = drive.step(state, now.command[i, ENTRIES[: len(drive.columns)]], self._period)
            self.states[i] = state
        self._note(now)

    def _note(self, now: Moment) -> None:
        """Note the poses by the states; the other vehicles are where the world moves them."""
        xy, heading, speed = (np.array(values, float) for values in (now.xy, now.heading, now.speed))
        turn, driven, boxes = np.zeros(self._vehicles), np.ones(self._vehicles), []
        for i, state in self.states.items():
            xy[i], heading[i], speed[i], driven[i] = state[:2], state[2], state[3], 0.0
            turn[i] = self._drives[i].turn(state, float(now.command[i, TURN]))
            boxes += [*self._drives[i].bodies(state)]
        if len(boxes) > self._boxes:
            where = listed([*dict.fromkeys(drive.where for drive in self._drives.values())])
            raise UserCodeError(f"{where}: bodies: {len(boxes)} boxes, and {self._boxes} at the start")
        self._set(xy, heading, speed, turn, driven, boxes)

    def _set(self, xy: Array, heading: Array, speed: Array, turn: Array, driven: Array, boxes: list[Array]) -> None:
        x, y, turned, length, width = np.reshape(boxes, (-1, BOX)).T
        half, none = np.full(len(x), HEIGHT / 2.0), np.zeros(self._vehicles)
        place = np.column_stack([x, y, self._ground + half])
        sides = np.column_stack([length / 2.0, width / 2.0, half])
        self._poses = Poses(xy, heading, speed, turn, none, none, place, turned, sides, driven)

    def poses(self) -> Poses:
        """Return the poses after the last reset or command."""
        return self._poses


def pose_of(now: Moment, vehicle: int) -> Array:
    """Return pose and speed of a vehicle as its own drive takes them, (4,)."""
    return np.array([*now.xy[vehicle], now.heading[vehicle], now.speed[vehicle]])


class OwnDrivenWorld(CosimulatedWorld):
    """Worlds on the CPU whose vehicles with drives of the user's own are moved on the host."""

    programs: list[OwnDrives]  # type: ignore[assignment]

    def restart(self) -> None:
        """Start the next episode in the worlds of `self.mask`, and the drives where the world places the vehicles."""
        super().restart()
        for w in np.flatnonzero(self.mask.numpy()).tolist():
            now = self._moment(w)
            self.programs[w].begin(now)
            self._put(w, self._poses(w), np.zeros_like(now.xy), np.zeros_like(now.heading))

    def _moment(self, world: int) -> Moment:
        """Return the vehicles before the next tick; during the dead time after a decision with the last command."""
        now, elapsed = super()._moment(world), int(self.view("tick")[world]) % self.model.ticks_per_decision
        late = (elapsed < self._latency) & (self.view("ended")[world] == UNDER_WAY)
        return replace(now, command=np.where(late[:, None], self.view("last_command")[world], now.command))

    @cached_property
    def _latency(self) -> Array:
        """(N,) dead time, ticks."""
        return np.asarray(self.model.dynamics.numpy()["latency_ticks"])

    def _put(self, world: int, poses: Poses, velocity: Array, yaw_rate: Array) -> None:
        super()._put(world, poses, velocity, yaw_rate)
        self._motion["true_position"][world, :, 2] = self.view("position")[world, self.model.landmarks :, 2]


class OwnDriven(Simulated):
    """The simulation of a scenario with drives of the user's own."""

    def kind(self, *arguments: Any, **options: Any) -> OwnDrivenWorld:
        """Return worlds; arguments as for `World`."""
        return OwnDrivenWorld(OwnDrives, *arguments, **options)
