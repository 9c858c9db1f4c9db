"""The textbook filter for planar robots whose odometry is their commands, as a plug-in.

In the LEFT coordinates of its covariance only yaw, forward and left count. Roll, pitch and height
have a millimetre's and milliradian's variance, independent of the rest.
"""

import math
from typing import Any, ClassVar

import numpy as np

from coopenv.base.errors import CoopenvError
from coopenv.estimation.arrays import Array
from coopenv.observers.contract import Estimate, Message, Setup, Tick
from coopenv.observers.planar.filter import PlanarFilter
from coopenv.observers.planar.fusion import LOWER, Sightings, place_of, sightings_of
from coopenv.observers.planar.mixture import Mixture
from coopenv.observers.planar.model import TEXTBOOK, PlanarPose, Step, Tuning, X, Y

PLANE = np.ix_((2, 3, 4), (2, 3, 4))  # indices of the LEFT coordinates in the plane: yaw, forward, left
OUT_OF_PLANE_STD = 1e-3  # rad and m


class PlanarEkf:
    """Extended Kalman filter of x, y and heading.

    It believes its odometry and its neighbours, and is for robots on a plane alone. A neighbour's covariance is added
    to the bearing's variance, as if its errors were independent (Roumeliotis, Bekey, "Distributed multirobot
    localization", IEEE Trans. Robotics and Automation 18(5), 2002, without its cross-correlations).
    """

    tuning: ClassVar[Tuning] = TEXTBOOK

    def __init__(self, setup: Setup) -> None:
        if not setup.planar:
            raise CoopenvError(f"{type(self).__name__} is for robots on a plane; '{setup.name}' moves in space")
        self._me = setup.landmarks + setup.vehicle
        self._sightings: list[tuple[int, float]] = []
        self._before = PlanarPose(np.zeros(3), np.zeros((3, 3)))
        self._heard: dict[int, float] = {}

    def reset(self, initial_pose: tuple[Array, Array], initial_covariance: Array) -> None:
        """Start at a pose with a covariance (6, 6) in LEFT coordinates."""
        R, p = initial_pose
        heading = math.atan2(R[1, 0], R[0, 0])
        turn = _from_body(heading)
        covariance = turn @ initial_covariance[PLANE] @ turn.T
        self._begin(np.array([p[0], p[1], heading]), covariance)
        self._sightings.clear()
        self._heard.clear()

    def update(self, tick: Tick) -> Estimate:
        """Take one camera tick."""
        turn = math.atan2(tick.rotation[1, 0], tick.rotation[0, 0])
        chord = math.copysign(math.hypot(tick.translation[0], tick.translation[1]), tick.translation[0])
        arc_over_chord = 1.0 if turn == 0.0 else turn / 2 / math.sin(turn / 2)
        self._advance(tick.dt, turn, chord * arc_over_chord)
        if self.tuning.mutual:
            self._take_sightings(tick)
        if tick.valid.any():
            self._look(tick)
        return self._estimate()

    def message(self) -> Message:
        """Return position and covariance, and under which bearing whom it saw since the last message.

        The pose that goes with the sightings is the one before they corrected it, so that who was seen does not hear
        its own estimate back.
        """
        state, covariance = self.filter.state, np.zeros((3, 3))
        covariance[:2, :2], covariance[2, 2] = self.filter.covariance[:2, :2], OUT_OF_PLANE_STD**2
        extra: dict[str, Any] = {}
        if self.tuning.mutual and self._sightings:
            targets, bearings = zip(*self._sightings, strict=True)
            pose = [*self._before.pose, *self._before.covariance[LOWER]]
            extra = {
                "seen": np.array(targets, np.uint8),
                "bearing": np.array(bearings, np.float32),
                "from": np.array(pose, np.float32),
            }
        self._sightings.clear()
        return Message(position=np.array([state[X], state[Y], 0.0]), covariance=covariance, extra=extra)

    def _begin(self, pose: Array, covariance: Array) -> None:
        self.filter: PlanarFilter | Mixture = PlanarFilter(self.tuning, pose, covariance)

    def _advance(self, dt: float, turn: float, path: float) -> Step:
        return self.filter.advance(dt, turn, path)

    def _look(self, tick: Tick) -> None:
        """Correct with what the camera saw, landmarks first."""
        for target, b, position, message in sorted(tick.usable(), key=lambda entry: entry[3] is not None):
            bearing = math.atan2(b[1], b[0])
            if message is None:
                self._see_landmark(tick, target, bearing, float(position[0]), float(position[1]))
            elif (place := place_of(tick.messages[target])) is not None:
                if not self._sightings:
                    self._before = self.filter.tell()
                self._sightings.append((target, bearing))
                self._see_robot(tick, target, bearing, place)

    def _see_landmark(self, tick: Tick, target: int, bearing: float, x: float, y: float) -> None:
        self.filter.landmark(bearing, x, y)

    def _see_robot(self, tick: Tick, target: int, bearing: float, place: PlanarPose) -> None:
        self.filter.robot(bearing, place)

    def _be_seen(self, tick: Tick, target: int, bearing: float, by: PlanarPose) -> None:
        self.filter.seen(bearing, by)

    def _witness(self, tick: Tick, by: int, told: Sightings) -> None:
        """Take what a robot tells of all that it saw; of use to who doubts words."""

    def _take_sightings(self, tick: Tick) -> None:
        """Correct with the bearings under which others saw this robot; each message counts once."""
        for target, received in tick.messages.items():
            extra, sent = received.message.extra, tick.time - received.age
            if "seen" not in extra or sent < self._heard.get(target, -math.inf) + tick.dt / 2:
                continue
            self._heard[target] = sent
            if (told := sightings_of(extra)) is not None:
                self._witness(tick, target, told)
                for seen, bearing in told.seen:
                    if seen == self._me:
                        self._be_seen(tick, target, bearing, told.by)

    def _estimate(self) -> Estimate:
        x, y, heading = self.filter.state[:3].tolist()
        c, s = math.cos(heading), math.sin(heading)
        turn = _from_body(heading)
        covariance = OUT_OF_PLANE_STD**2 * np.eye(6)
        covariance[PLANE] = turn.T @ self.filter.covariance[:3, :3] @ turn
        return Estimate(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.array([x, y, 0.0]), covariance)


def _from_body(heading: float) -> Array:
    """Return (3, 3) which takes (yaw, forward, left) to (x, y, heading); its transpose is its inverse."""
    c, s = math.cos(heading), math.sin(heading)
    return np.array([[0.0, c, -s], [0.0, s, c], [1.0, 0.0, 0.0]])
