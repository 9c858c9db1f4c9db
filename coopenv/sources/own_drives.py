"""Worlds in which a user's own drives (`coopenv.motions.own`) move their vehicles on the host, every camera tick.

The worlds draw the starts and move all other vehicles. Sensors, radio and observers are as in the simulation.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from coopenv.base.errors import CoopenvError
from coopenv.estimation.poses import Array
from coopenv.motions.command import LATERAL, SPEED, TURN
from coopenv.motions.own import POSE, OwnDrive
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
        self._ground = -scenario.map.origin[2]
        self._states: dict[int, Array] = {}
        self._poses = self._placed(len(scenario.vehicles))

    def _placed(self, vehicles: int) -> Poses:
        none = np.zeros(vehicles)
        return Poses(
            xy=np.zeros((vehicles, 2)),
            heading=none,
            speed=none,
            steering=none,
            crashed=none,
            left=none,
            traffic_position=np.zeros((0, 3)),
            traffic_heading=np.zeros(0),
            traffic_half=np.zeros((0, 3)),
            driven=np.full(vehicles, float(PLACED)),
        )

    def reset(self, seed: int) -> None:
        """Begin an episode where the world places the vehicles."""
        self._states.clear()
        self._poses = self._placed(len(self._poses.heading))

    def begin(self, now: Moment) -> None:
        """Start the drives at the drawn poses."""
        self._states = {i: drive.start(pose_of(now, i)) for i, drive in self._drives.items()}
        self._note(now)

    def command(self, now: Moment) -> None:
        """Let every drive whose vehicle is present make its step to the next tick."""
        for i, drive in self._drives.items():
            state = self._states[i]
            if np.hypot(*(now.xy[i] - state[:2])) > ELSEWHERE:
                state = drive.start(pose_of(now, i))
            if now.present[i]:
                state = drive.step(state, now.command[i, ENTRIES[: len(drive.columns)]], self._period)
            self._states[i] = state
        self._note(now)

    def _note(self, now: Moment) -> None:
        """Note the poses, those of the other vehicles as they are."""
        xy, heading, speed = (np.array(values, float) for values in (now.xy, now.heading, now.speed))
        turn, driven = np.zeros(len(heading)), np.ones(len(heading))
        for i, state in self._states.items():
            xy[i], heading[i], speed[i], driven[i] = state[:2], state[2], state[3], 0.0
            turn[i] = self._drives[i].turn(state, float(now.command[i, TURN]))
        bodies = [self._drives[i].bodies(state) for i, state in self._states.items()]
        boxes = np.concatenate([*bodies, np.zeros((0, 5))])
        if len(boxes) > self._boxes:
            raise CoopenvError(f"dynamics.model: bodies: {len(boxes)} boxes, and {self._boxes} at the start")
        half = np.full(len(boxes), HEIGHT / 2.0)
        none = np.zeros(len(heading))
        self._poses = Poses(
            xy=xy,
            heading=heading,
            speed=speed,
            steering=turn,
            crashed=none,
            left=none,
            traffic_position=np.column_stack([boxes[:, :2], self._ground + half]),
            traffic_heading=boxes[:, 2],
            traffic_half=np.column_stack([boxes[:, 3:] / 2.0, half]),
            driven=driven,
        )

    def poses(self) -> Poses:
        """Return the poses after the last reset or command."""
        return self._poses

    def save(self) -> Any:
        """Return the states of the drives and the poses: data alone."""
        return {"states": {i: state.copy() for i, state in self._states.items()}, "poses": self._poses}

    def accepts(self, saved: Any) -> bool:
        """Return whether `restore` can take this: finite states of the vehicles with drives of the user's own."""
        states = saved.get("states") if isinstance(saved, Mapping) else None
        if not isinstance(states, Mapping) or not isinstance(saved.get("poses"), Poses):
            return False
        arrays = [np.asarray(state) for state in states.values()]
        known = {*states} <= {*self._drives}
        return known and all(a.dtype.kind == "f" and a.ndim == 1 and len(a) >= len(POSE) for a in arrays)

    def restore(self, saved: Any) -> None:
        """Continue from a state of `save`."""
        self._states = {i: np.array(state, float) for i, state in saved["states"].items()}
        self._poses = saved["poses"]


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
