"""Observers for planar robots whose odometry is their commands: a textbook filter, and one of our own.

Both are planar; in the LEFT coordinates of their covariance only yaw, forward and left count. Roll, pitch and height
have a millimetre's and milliradian's variance, independent of the rest.
"""

import math
from typing import Any, ClassVar

import numpy as np

from coopenv.errors import CoopenvError
from coopenv.estimation.arrays import Array
from coopenv.observers.contract import Estimate, Message, Setup, Tick
from coopenv.observers.planar.commands import Wheels
from coopenv.observers.planar.filter import HEADING, PlanarFilter, PlanarPose, Tuning, X, Y

PLANE = np.ix_((2, 3, 4), (2, 3, 4))  # indices of the LEFT coordinates in the plane: yaw, forward, left
OUT_OF_PLANE_STD = 1e-3  # rad and m
LOWER = np.tril_indices(3)

TEXTBOOK = Tuning()
IROBOT_CREATE = Wheels(
    delay=(0.0, 0.1, 0.2, 0.4),
    share=(0.33, 0.42, 0.16, 0.09),
    arc=((0.15, 1.8), (0.35, 1.3), (0.8, 0.88), (1.6, 0.84), (2.6, 0.8), (3.2, 0.95), (3.8, 1.1), (4.5, 0.975)),
    spot=1.03,
    slow=0.065,
    slow_gain=0.22,
    centre=0.005,
)
"""The iRobot Create of MR.CLAM, measured on sub-dataset 6; all of its robots agree (docs/data.md)."""
CALIBRATING = Tuning(
    turn_noise=(0.001, 0.05, 0.1),
    path_noise=(0.002, 0.2),
    slide_noise=0.05,
    bearing_std=0.025,
    gate=25.0,
    soft=4.0,
    mean=(0.936, 1.0, 0.005, 0.004, 1.0, 0.15, 0.0),
    std=(0.08, 0.03, 0.001, 0.002, 0.3, 0.05, 0.007),
    walk=(0.0003, 0.0003, 0.0, 0.0001, 0.0003, 0.0005, 0.0),
    jitter=0.08,
    wheels=IROBOT_CREATE,
    fusion="intersection",
    dependent=0.25,
    arm_m=1.0,
    mutual=True,
)


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
        self.filter = PlanarFilter(self.tuning, np.array([p[0], p[1], heading]), covariance)
        self._sightings.clear()
        self._heard.clear()

    def update(self, tick: Tick) -> Estimate:
        """Take one camera tick."""
        turn = math.atan2(tick.rotation[1, 0], tick.rotation[0, 0])
        chord = math.copysign(math.hypot(tick.translation[0], tick.translation[1]), tick.translation[0])
        arc_over_chord = 1.0 if turn == 0.0 else turn / 2 / math.sin(turn / 2)
        self.filter.advance(tick.dt, turn, chord * arc_over_chord)
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

    def _look(self, tick: Tick) -> None:
        """Correct with what the camera saw, landmarks first."""
        for target, b, position, message in sorted(tick.usable(), key=lambda entry: entry[3] is not None):
            bearing = math.atan2(b[1], b[0])
            if message is None:
                self.filter.landmark(bearing, float(position[0]), float(position[1]))
            elif message.covariance is not None:
                if not self._sightings:
                    self._before = self.filter.tell()
                self._sightings.append((target, bearing))
                covariance = np.zeros((3, 3))  # of a neighbour's heading nothing is needed
                covariance[:2, :2] = message.covariance[:2, :2]
                self.filter.robot(bearing, PlanarPose(np.array([position[0], position[1], 0.0]), covariance))

    def _take_sightings(self, tick: Tick) -> None:
        """Correct with the bearings under which others saw this robot; each message counts once."""
        for target, received in tick.messages.items():
            extra, sent = received.message.extra, tick.time - received.age
            if "seen" not in extra or sent < self._heard.get(target, -math.inf) + tick.dt / 2:
                continue
            self._heard[target] = sent
            pose, covariance = extra["from"][:3].astype(float), np.zeros((3, 3))
            covariance[LOWER] = extra["from"][3:]
            covariance += np.tril(covariance, -1).T
            for bearing in extra["bearing"][extra["seen"] == self._me]:
                self.filter.seen(float(bearing), PlanarPose(pose, covariance))

    def _estimate(self) -> Estimate:
        x, y, heading = self.filter.state[[X, Y, HEADING]]
        c, s = math.cos(heading), math.sin(heading)
        turn = _from_body(heading)
        covariance = OUT_OF_PLANE_STD**2 * np.eye(6)
        covariance[PLANE] = turn.T @ self.filter.covariance[:3, :3] @ turn
        return Estimate(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.array([x, y, 0.0]), covariance)


class PlanarRobust(PlanarEkf):
    """Calibrates its odometry online, tells others that it saw them, and fuses by split covariance intersection.

    Messages hold position and covariance (72 bytes), and after a sighting a pose with its covariance in single
    precision (36 bytes) and 5 bytes for each robot seen.
    """

    tuning = CALIBRATING


def _from_body(heading: float) -> Array:
    """Return (3, 3) which takes (yaw, forward, left) to (x, y, heading); its transpose is its inverse."""
    c, s = math.cos(heading), math.sin(heading)
    return np.array([[0.0, c, -s], [0.0, s, c], [1.0, 0.0, 0.0]])
