"""One tick of one world, as far as pictures show it."""

from dataclasses import dataclass, fields
from typing import Any, Protocol, Self

import numpy as np

from coopenv.estimation.outcomes import Outcome, Sight
from coopenv.viz.topview_geometry import position_covariance


class Shown(Protocol):
    """What can be drawn: an engine, or what stands for one."""

    def view(self, name: str) -> np.ndarray:
        """Return a field of its results or its state, (W, ...)."""
        ...


@dataclass(frozen=True)
class Frame:
    """A agents (landmarks first, then N vehicles), R reward terms, P points of a route, Z bodies of other traffic.

    Positions are in the map frame, m; rotations map body to map. Arrays are copies. Numbers are NaN of agents that are
    not there, and of true poses that nobody knows.
    """

    tick: np.ndarray  # () camera ticks since the start
    rotation: np.ndarray  # (A, 3, 3) true
    position: np.ndarray  # (A, 3) true
    estimate_rotation: np.ndarray  # (N, 3, 3)
    estimate_position: np.ndarray  # (N, 3)
    position_covariance: np.ndarray  # (N, 3, 3) m^2, of the estimate, from the observer's P to first order
    position_error: np.ndarray  # (N,) m
    orientation_error: np.ndarray  # (N,) deg
    nees: np.ndarray  # (N,) normalised error squared of the pose; 6 on average where P is honest
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
    def of(cls, shown: Shown, world: int = 0) -> Self:
        """Return what an engine shows of a world now."""
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
        return three_sigma(self.position_covariance)


def three_sigma(covariance: np.ndarray) -> np.ndarray:
    """Return (N,) m of covariances (N, 3, 3), m^2: three standard deviations in plan along the worst axis, or NaN."""
    plan = covariance[:, :2, :2]
    finite = np.isfinite(plan).all(axis=(-1, -2))
    variance = np.linalg.eigvalsh(np.where(finite[:, None, None], plan, 0.0))
    return np.where(finite & (variance[:, 0] >= 0.0), 3.0 * np.sqrt(np.maximum(variance[:, 1], 0.0)), np.nan)


_FLOATS = (
    *("rotation", "position", "estimate_rotation", "position_error", "orientation_error", "nees", "pan", "terms"),
    *("goal", "route", "traffic_rotation", "traffic_position", "traffic_half"),
)
_WHOLE = ("tick", "sight", "ended", "inbox_tick", "route_count", "route_drawn")
WHOLE_FIELDS = frozenset(_WHOLE)
"""Fields that hold whole numbers."""
FIELDS = tuple(field.name for field in fields(Frame))
