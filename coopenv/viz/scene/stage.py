"""The static side of a scene, its frames, and what follows from both: fields of view and occlusion."""

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Protocol, Self

import numpy as np

from coopenv.estimation.outcomes import Outcome, Sight
from coopenv.estimation.poses import position_covariance
from coopenv.scenario import Scenario
from coopenv.scenario.bodies import Body, Landmark, Vehicle
from coopenv.viz import topview_geometry as geometry
from coopenv.viz.topview_geometry import Box


class FrameSource(Protocol):
    """Source of frames: an engine, or a stand-in for one."""

    def view(self, name: str) -> np.ndarray:
        """Return a field of its results or its state, (W, ...)."""
        ...


@dataclass(frozen=True)
class Frame:
    """A agents (landmarks first, then N vehicles), R reward terms, P points of a route, Z bodies of other traffic.

    Positions are in the map frame, m; rotations map body to map. Arrays are copies. Numbers are NaN of agents that are
    not there, and of unknown true poses.
    """

    tick: np.ndarray  # () camera ticks since the start
    rotation: np.ndarray  # (A, 3, 3) true
    position: np.ndarray  # (A, 3) true
    estimate_rotation: np.ndarray  # (N, 3, 3)
    estimate_position: np.ndarray  # (N, 3)
    position_covariance: np.ndarray  # (N, 3, 3) m^2, of the estimate, from the observer's P to first order
    position_error: np.ndarray  # (N,) m
    orientation_error: np.ndarray  # (N,) deg
    nees: np.ndarray  # (N,) normalised error squared of the pose; 6 on average where P is consistent
    sight: np.ndarray  # (N, A) values of `Sight`
    pan: np.ndarray  # (N,) rad, by which the camera is turned to the left
    ended: np.ndarray  # (N,) values of `Outcome`, or conditions of the scenario's own
    inbox_tick: np.ndarray  # (N receiver, N sender) tick of sending of the last message that arrived; -1: none
    terms: np.ndarray  # (N, R) terms of the reward, of this tick
    goal: np.ndarray  # (N, 3)
    route: np.ndarray  # (N, P, 3) x, y, and arc length
    route_count: np.ndarray  # (N,) points of the route; 0: none
    route_drawn: np.ndarray  # (N,) number of the scenario's route that it is drawn from; -1: of none
    traffic_rotation: np.ndarray  # (Z, 3, 3)
    traffic_position: np.ndarray  # (Z, 3)
    traffic_half: np.ndarray  # (Z, 3) half of the edges; zero: not there

    @classmethod
    def of(cls, shown: FrameSource, world: int = 0) -> Self:
        """Return the present frame of a world of an engine."""
        kept: dict[str, Any] = {name: np.array(shown.view(name)[world], float) for name in _FLOATS}
        kept |= {name: np.array(shown.view(name)[world]).astype(np.int64) for name in _WHOLE}
        R_hat, p_hat = kept["estimate_rotation"], np.array(shown.view("estimate_position")[world], float)
        covariance = np.array(shown.view("covariance")[world], float)
        estimate = (R_hat @ p_hat[..., None])[..., 0]
        absent = np.asarray(shown.view("present")[world]) == 0
        kept["position"][absent] = np.nan
        estimate[absent[len(absent) - len(estimate) :]] = np.nan
        spread = position_covariance(R_hat, p_hat, covariance)
        return cls(**kept, estimate_position=estimate, position_covariance=spread)

    @property
    def landmarks(self) -> int:
        """How many agents are landmarks."""
        return len(self.position) - len(self.estimate_position)

    @property
    def vehicle_rotation(self) -> np.ndarray:
        """(N, 3, 3) true, body to map."""
        return self.rotation[self.landmarks :]

    @property
    def vehicle_position(self) -> np.ndarray:
        """(N, 3) true, map, m."""
        return self.position[self.landmarks :]

    @property
    def sees(self) -> np.ndarray:
        """(N,) how many targets each camera measures."""
        return np.asarray(np.sum(self.sight == Sight.VISIBLE, axis=-1))

    @property
    def could_see(self) -> np.ndarray:
        """(N,) how many targets there are for each camera."""
        return np.asarray(np.sum(self.sight != Sight.NOT_A_NEIGHBOUR, axis=-1))

    @property
    def under_way(self) -> np.ndarray:
        """(N,) bool: has not ended."""
        return np.asarray(self.ended == Outcome.UNDER_WAY)

    @property
    def three_sigma(self) -> np.ndarray:
        """(N,) m: three standard deviations of the estimated position in plan, along the axis where it is worst."""
        return geometry.semi_axes(self.position_covariance[:, :2, :2])[0][:, -1]


_FLOATS = (
    *("rotation", "position", "estimate_rotation", "position_error", "orientation_error", "nees", "pan", "terms"),
    *("goal", "route", "traffic_rotation", "traffic_position", "traffic_half"),
)
_WHOLE = ("tick", "sight", "ended", "inbox_tick", "route_count", "route_drawn")
WHOLE_FIELDS = frozenset(_WHOLE)
"""Fields that hold whole numbers."""
FIELDS = tuple(field.name for field in fields(Frame))


REACH = 0.4
"""Of the picture's side: how far a field of view is drawn of a camera that sees farther."""
_SHORTEST = 0.035  # of the picture's side, drawn length of a vehicle
_CAR = Body(size=(4.4, 1.9, 1.5), center=(0.0, 0.0, 0.75))  # stands in for a vehicle without a body

_ALL = slice(None)


class Stage:
    """The static side of a scene; lengths in m, everything in the map frame."""

    def __init__(self, scenario: Scenario) -> None:
        """Derive the static side from a scenario."""
        self.scenario = scenario
        self.landmarks, self.vehicles = len(scenario.landmarks), len(scenario.vehicles)
        self.origin = np.array(scenario.map.origin, float)
        low, high = geometry.limits(scenario)
        self.low, self.high = low, high
        """(2,) corners of a square in plan around all that is known beforehand."""
        self.side = float(high[0] - low[0])
        agents: list[Landmark | Vehicle] = [*scenario.landmarks, *scenario.vehicles]
        self.marker = np.array([agent.marker for agent in agents], float)
        """(A, 3) the point that cameras see, body frame."""
        self.camera = np.array([camera.position for camera in scenario.cameras], float)
        """(N, 3) optical centres, body frame."""
        limit = REACH * self.side
        pinhole = (camera.model == "pinhole" for camera in scenario.cameras)
        self.reach = np.array(
            [min(c.range or limit, limit) if p else 0.0 for c, p in zip(scenario.cameras, pinhole, strict=True)]
        )
        """(N,) how far fields of view are drawn."""
        self.moving = np.array([m.motion.kind != "static" for m in scenario.landmarks], dtype=bool)
        """(L,) which landmarks move."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the targets, landmarks first."""
        return tuple(self.scenario.target_names)

    def short_name(self, target: int) -> str:
        """Return f1 for the first vehicle, and a landmark's name; L1 for landmark_1."""
        if target >= self.landmarks:
            return f"f{target - self.landmarks + 1}"
        name = self.names[target]
        return f"L{name.removeprefix('landmark_')}" if name.startswith("landmark_") else name

    @cached_property
    def sees_a_part(self) -> bool:
        """Whether cameras have a field of view that matters."""
        return sees_a_part(self.scenario)

    @cached_property
    def bodies(self) -> tuple[np.ndarray, np.ndarray]:
        """(N, 3) sizes and (N, 3) centres of the vehicles' boxes as drawn: those too small to be seen are enlarged."""
        found = [vehicle.body for vehicle in self.scenario.vehicles]
        given = [_CAR if body is None else body for body in found]
        size, center = np.array([b.size for b in given], float), np.array([b.center for b in given], float)
        unknown = np.array([body is None for body in found])
        size[unknown] *= (1.2 * _SHORTEST * self.side / _CAR.size[0]) if unknown.any() else 1.0
        center[unknown] = 0.0
        grown = np.maximum(1.0, _SHORTEST * self.side / size[:, :1])
        return size * grown, center * grown

    @cached_property
    def _fan(self) -> np.ndarray:
        """(N, K, 3) unit rays over the width of each camera's image, body frame without pan."""
        return np.array([geometry.camera_fan(camera) for camera in self.scenario.cameras])

    def eyes(self, frame: Frame) -> np.ndarray:
        """Return where cameras are, (N, 3)."""
        return np.asarray(frame.vehicle_position + (frame.vehicle_rotation @ self.camera[..., None])[..., 0])

    def targets(self, frame: Frame) -> np.ndarray:
        """Return the points that cameras see, (A, 3)."""
        return np.asarray(frame.position + (frame.rotation @ self.marker[..., None])[..., 0])

    def fields_of_view(self, frame: Frame, every: int = 1, of: slice = _ALL) -> np.ndarray | None:
        """Return the fields of view in plan as polygons (N, K + 1, 3), the camera first; None where all see everything.

        Buildings end them. Of the rays along the rim every so many are taken, and of the vehicles those `of` a slice.
        """
        if not self.sees_a_part:
            return None
        eye = self.eyes(frame)[of]
        turned = np.array([geometry.about_z(pan) for pan in frame.pan[of]])
        rays = self._fan[of, ::every] @ np.swapaxes(frame.vehicle_rotation[of] @ turned, 1, 2)
        length = geometry.free_lengths(eye, rays, self.reach[of], self.buildings)
        return np.concatenate([eye[:, None], eye[:, None] + length[..., None] * rays], axis=1)

    def hider(self, frame: Frame, vehicle: int, target: int) -> str | None:
        """Return the short name of the box that hides a target from a vehicle's camera; None: no drawn box does."""
        kind = frame.sight[vehicle, target]
        start, end = self.eyes(frame)[vehicle], self.targets(frame)[target]
        if kind == Sight.OCCLUDED_BY_BUILDING:
            boxes = self.buildings
        elif kind == Sight.OCCLUDED_BY_BODY:
            boxes = self.solid(frame, (target, self.landmarks + vehicle))
        else:
            return None
        hits = [(entry(start, end, box), box.name) for box in boxes]
        share, name = min(hits, default=(np.inf, ""))
        return name if np.isfinite(share) else None

    @cached_property
    def buildings(self) -> list[Box]:
        """The buildings."""
        return [
            Box(o.name, geometry.about_z(o.yaw), np.array(o.center) - self.origin, o.size)
            for o in self.scenario.obstacles
        ]

    def solid(self, frame: Frame, without: tuple[int, ...] = ()) -> list[Box]:
        """Return the bodies that move, but for those of some agents."""
        s = self.scenario
        agents: list[Landmark | Vehicle] = [*s.landmarks, *s.vehicles]
        boxes = []
        for i, agent in enumerate(agents):
            if agent.body is not None and i not in without:
                R = frame.rotation[i]
                boxes.append(Box(self.short_name(i), R, frame.position[i] + R @ agent.body.center, agent.body.size))
        there = np.flatnonzero(frame.traffic_half[:, 0] > 0.0)
        R, center, size = frame.traffic_rotation, frame.traffic_position, 2.0 * frame.traffic_half
        return boxes + [Box("traffic", R[z], center[z], size[z]) for z in there]


def entry(start: np.ndarray, end: np.ndarray, box: Box) -> float:
    """Return at which share of a straight path from start to end (3,) a box is entered; infinite where it is not."""
    enter, leave = (float(share[0, 0]) for share in geometry.crossings(start[None], (end - start)[None], [box]))
    return max(enter, 0.0) if enter < leave and leave > 0.0 and enter < 1.0 else np.inf


def sees_a_part(scenario: Scenario) -> bool:
    """Return whether cameras have a field of view that matters."""
    sensed = scenario.topology.mode == "sensed" and scenario.sensing == "sensed"
    return sensed and any(camera.model == "pinhole" for camera in scenario.cameras)
