"""Observers for robots on a plane whose odometry is their commands, as plug-ins: textbook and robust.

In the LEFT coordinates of its covariance only yaw, forward and left count. Roll, pitch and height
have a millimetre's and milliradian's variance, independent of the rest.
"""

import math
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from coopenv.base.errors import CoopenvError
from coopenv.estimation.poses import Array
from coopenv.mrclam.planar_filter import Mixture, PlanarFilter
from coopenv.mrclam.planar_fusion import LOWER, RobotMonitors, received_position, sightings_of
from coopenv.mrclam.planar_model import (
    BIAS,
    CALIBRATING,
    HEADING,
    STATES,
    TEXTBOOK,
    TURN_SCALE,
    OdometryStep,
    PlanarPose,
    Tuning,
    X,
    Y,
)
from coopenv.mrclam.planar_search import LossTest, PoseInformation, Sighting, SightingHistory, find_pose
from coopenv.observers.contract import Estimate, Message, Setup, Tick

PLANE = np.ix_((2, 3, 4), (2, 3, 4))  # indices of the LEFT coordinates in the plane: yaw, forward, left
OUT_OF_PLANE_STD = 1e-3  # rad and m


class PlanarEkf:
    """Extended Kalman filter of x, y and heading.

    It fuses odometry, bearings and received positions, for robots on a plane only. A neighbour's covariance is added
    to the bearing's variance, as if its errors were independent (Roumeliotis, Bekey, "Distributed multirobot
    localization", IEEE Trans. Robotics and Automation 18(5), 2002, without its cross-correlations).
    """

    tuning: ClassVar[Tuning] = TEXTBOOK
    estimator: ClassVar[type[PlanarFilter] | type[Mixture]] = PlanarFilter

    def __init__(self, setup: Setup) -> None:
        if not setup.planar:
            raise CoopenvError(f"{type(self).__name__} is for robots on a plane; '{setup.name}' moves in space")

    def reset(self, initial_pose: tuple[Array, Array], initial_covariance: Array) -> None:
        """Start at a pose with a covariance (6, 6) in LEFT coordinates."""
        R, p = initial_pose
        heading = math.atan2(R[1, 0], R[0, 0])
        turn = _from_body(heading)
        pose, covariance = np.array([p[0], p[1], heading]), turn @ initial_covariance[PLANE] @ turn.T
        self.filter: Any = self.estimator(self.tuning, pose, covariance)

    def update(self, tick: Tick) -> Estimate:
        """Take one camera tick."""
        turn = math.atan2(tick.rotation[1, 0], tick.rotation[0, 0])
        chord = math.copysign(math.hypot(tick.translation[0], tick.translation[1]), tick.translation[0])
        arc_over_chord = 1.0 if turn == 0.0 else turn / 2 / math.sin(turn / 2)
        self._advance(tick.dt, turn, chord * arc_over_chord)
        self._look(tick)
        return self._estimate()

    def message(self) -> Message:
        """Return position and covariance."""
        state, covariance = self.filter.state, np.zeros((3, 3))
        covariance[:2, :2], covariance[2, 2] = self.filter.covariance[:2, :2], OUT_OF_PLANE_STD**2
        return Message(position=np.array([state[X], state[Y], 0.0]), covariance=covariance)

    def _advance(self, dt: float, turn: float, path: float) -> None:
        self.filter.advance(dt, turn, path)

    def _look(self, tick: Tick) -> None:
        """Correct by the bearings of a frame, landmarks first."""
        if not tick.valid.any():
            return
        for target, b, position, message in sorted(tick.usable(), key=lambda entry: entry[3] is not None):
            bearing = math.atan2(b[1], b[0])
            if message is None:
                self._see_landmark(tick, target, bearing, float(position[0]), float(position[1]))
            elif (reported := received_position(tick.messages[target])) is not None:
                self._see_robot(tick, target, bearing, reported)

    def _see_landmark(self, tick: Tick, target: int, bearing: float, x: float, y: float) -> None:
        self.filter.landmark(bearing, x, y)

    def _see_robot(self, tick: Tick, target: int, bearing: float, there: PlanarPose) -> None:
        """Correct by a bearing to a robot at its reported pose."""
        self.filter.robot(bearing, there)

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


CLEAR_STD = (8.0, 1.6)  # m, rad; above these a single bearing cannot correct the pose, and bearings are collected
LOST_HEADING_STD = math.pi / math.sqrt(3)  # rad, of an unknown heading
LEAST_LOST_STD = 5.0  # m
SPANS_S = (10.0, 30.0)  # of the sightings in a search; the shortest span with a solution counts
SEARCH_PERIOD_S = 0.4
ENOUGH = 8  # bearings that contradict the prior
EXCLUSION_STD = (0.5, 0.5, 0.3)  # m, m, rad: possible error of a pose that has fused an excluded sender
MOST_FAILED = 15  # searches with so many bearings after which the prior is dropped


class PlanarRobust(PlanarEkf):
    """Calibrates its odometry online; fuses neighbours by split covariance intersection.

    It broadcasts its sightings. It declares itself lost when most bearings fail the gate, or when its covariance is so
    large that a single bearing cannot correct it. It then states a large covariance, sends nothing, and searches for
    the pose that agrees with the bearings of the last half minute.

    Messages hold position and covariance (72 bytes), and after a sighting a pose with its covariance in single
    precision (36 bytes), whether landmarks were seen lately (1), and 5 bytes for each robot seen.
    """

    tuning: ClassVar[Tuning] = CALIBRATING
    estimator = Mixture

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        self._me = setup.landmarks + setup.vehicle
        self._site = LEAST_LOST_STD

    def reset(self, initial_pose: tuple[Array, Array], initial_covariance: Array) -> None:
        """Start at a pose with a covariance (6, 6) in LEFT coordinates."""
        super().reset(initial_pose, initial_covariance)
        self._sightings: list[tuple[int, float]] = []
        self._before = self._broadcast_pose()
        self._received: dict[int, float] = {}
        self._test, self._history = LossTest(), SightingHistory()
        self._monitors = RobotMonitors(self.tuning.bearing_std)
        self._now, self._next_search, self._failed, self._news = 0.0, 0.0, 0, False
        self.lost, self._adrift, self._turned, self._from = False, 0.0, 0.0, 0.0
        if self._unclear() or self.filter.covariance[HEADING, HEADING] > CLEAR_STD[1] ** 2:
            self._declare_lost()

    def update(self, tick: Tick) -> Estimate:
        """Take one camera tick."""
        if len(tick.landmarks):
            self._site = max(LEAST_LOST_STD, float(np.ptp(tick.landmarks[:, :2], axis=0).max()) / 2)
        self._now = tick.time
        self._monitors.test_reports(tick)
        self._inflate_after_exclusion(tick.time)
        estimate = super().update(tick)
        if self.lost:  # not in the tick of the loss, whose bearings are the contradicting ones
            if not (self._news and tick.time >= self._next_search):
                return estimate
            self._search(tick.time)
        elif self._test.lost:
            self._history.forget(self._test.since)  # earlier sightings may be of another pose
            self._declare_unknown()
        elif self._unclear():
            self._history.forget(math.inf)  # these sightings are in the estimate
            self._declare_lost()
        else:
            return estimate
        return self._estimate()

    def message(self) -> Message:
        """Return position and covariance, and the bearings to other robots since the last message; nothing while lost.

        The pose sent with these bearings is the one before they corrected it. The receiver's own estimate therefore
        does not return to it.
        """
        sightings, self._sightings = self._sightings, []
        if self.lost:
            return Message()
        if not sightings:
            return super().message()
        targets, bearings = zip(*sightings, strict=True)
        pose = [*self._before.pose, *self._before.covariance[LOWER]]
        extra: dict[str, Any] = {
            "seen": np.array(targets, np.uint8),
            "bearing": np.array(bearings, np.float32),
            "from": np.array(pose, np.float32),
            "sure": np.array([self._test.localised(self._now)], np.uint8),
        }
        return replace(super().message(), extra=extra)

    def tampered(self, made: Message, honest: Message) -> Message:
        """Return a message with a changed position whose sightings agree with it."""
        if made.position is None or honest.position is None or "from" not in made.extra:
            return made
        by = np.array(made.extra["from"])
        by[:2] += (made.position[:2] - honest.position[:2]).astype(by.dtype)
        return replace(made, extra={**made.extra, "from": by})

    def _advance(self, dt: float, turn: float, path: float) -> None:
        step = self.filter.advance(dt, turn, path)
        self._history.move(step)
        self._news = False
        if self.lost:
            self._inflate_while_lost(step)
        else:
            self.filter.split()

    def _inflate_while_lost(self, step: OdometryStep) -> None:
        """Inflate the covariance by the turn and path since the loss: errors of scale and heading are constant."""
        state, covariance = self.filter.state, self.filter.covariance
        before = self._turned
        self._adrift, self._turned = self._adrift + abs(step.driven), before + abs(step.turned)
        by_scale = float(covariance[TURN_SCALE, TURN_SCALE]) * (self._turned**2 - before**2)
        heading = min(float(covariance[HEADING, HEADING]) + by_scale, LOST_HEADING_STD**2)
        variance = self._from + self._adrift**2 * min(heading, 1.0)
        self.filter.set_pose(state[:3].copy(), np.diag([variance, variance, heading]))

    def _look(self, tick: Tick) -> None:
        """Correct by the received bearings to this robot, each message once, then by the own bearings."""
        for target, received in tick.messages.items():
            extra, sent = received.message.extra, tick.time - received.age
            if "seen" not in extra or sent < self._received.get(target, -math.inf) + tick.dt / 2:
                continue
            self._received[target] = sent
            if (sightings := sightings_of(extra)) is not None:
                self._monitors.test_sightings(tick, target, sightings)
                self._inflate_after_exclusion(tick.time)
                for seen, bearing in sightings.seen:
                    if seen == self._me:
                        self._fuse_robot(tick, target, bearing, sightings.by, seen=True)
        super()._look(tick)

    def _see_landmark(self, tick: Tick, target: int, bearing: float, x: float, y: float) -> None:
        self._remember(tick.time, target, bearing, True, PlanarPose(np.array([x, y, 0.0]), np.zeros((3, 3))))
        if not self.lost:
            self._test.take(tick.time, self.filter.landmark(bearing, x, y))

    def _see_robot(self, tick: Tick, target: int, bearing: float, there: PlanarPose) -> None:
        """Note the sighting for the next message, and correct."""
        if not self._sightings:
            self._before = self._broadcast_pose()
        self._sightings.append((target, bearing))
        self._fuse_robot(tick, target, bearing, there, seen=False)

    def _broadcast_pose(self) -> PlanarPose:
        """Return x, y and the heading from which bearings count (without the camera's bias), with their covariance."""
        pick = np.eye(3, STATES)
        pick[HEADING, BIAS] = -1.0
        return PlanarPose(pick @ self.filter.state, pick @ self.filter.covariance @ pick.T)

    def _fuse_robot(self, tick: Tick, target: int, bearing: float, there: PlanarPose, seen: bool) -> None:
        """Test a sender by a bearing to its reported pose, or by one from it; correct if it is not excluded."""
        if not self.lost:
            ratio, variance = self.filter.misfit(bearing, there, seen)
            self._monitors.of(target).test_innovation(ratio, variance, self._test.localised(tick.time))
        if self._monitors.accepts(target, tick.time):
            angle = float(there.pose[2]) + bearing + math.pi if seen else bearing
            self._remember(tick.time, target, angle, not seen, there)
            if not self.lost:
                self._test.take_of_robot(tick.time, self.filter.robot(bearing, there, seen))

    def _inflate_after_exclusion(self, now: float) -> None:
        """Inflate the covariance if a sender whose reports were fused is excluded now."""
        if self._monitors.fused_excluded(now) and not self.lost and not self._test.localised(now):
            state, covariance = self.filter.state, self.filter.covariance
            self.filter.set_pose(state[:3].copy(), covariance[:3, :3] + np.diag(np.square(EXCLUSION_STD)))

    def _remember(self, time: float, target: int, angle: float, own: bool, there: PlanarPose) -> None:
        """Store a sighting; an own bearing counts from the heading, without the bias."""
        self._news = True
        angle -= float(self.filter.state[BIAS]) if own else 0.0
        noise = self.tuning.bearing_std**2 + (0.0 if own else float(there.covariance[2, 2]))
        x, y = there.pose[:2].tolist()
        variance = float(there.covariance[0, 0] + there.covariance[1, 1]) / 2
        self._history.add(Sighting(time, target, angle, own, x, y, variance, noise))

    def _unclear(self) -> bool:
        variance = np.diag(self.filter.covariance)
        return bool(variance[X] + variance[Y] > CLEAR_STD[0] ** 2)

    def _declare_lost(self) -> None:
        """Declare the pose lost."""
        covariance = self.filter.covariance
        self.lost, self._adrift, self._turned, self._failed = True, 0.0, 0.0, 0
        self._from = float(covariance[X, X] + covariance[Y, Y])
        self._test.clear()

    def _declare_unknown(self) -> None:
        """Declare the pose lost with an uninformative prior, and reset the calibration."""
        self.filter.set_pose(
            self.filter.state[:3].copy(), np.diag(np.square([self._site, self._site, LOST_HEADING_STD]))
        )
        self.filter.reset_calibration()
        self._declare_lost()

    def _search(self, now: float) -> None:
        """Search for a pose that agrees with the sightings."""
        self._next_search = now + SEARCH_PERIOD_S
        covariance = self.filter.covariance
        before = PoseInformation(self.filter.state[:3].copy(), np.linalg.inv(covariance[:3, :3]))
        for span in SPANS_S:
            lines = self._history.lines(now, span, float(covariance[TURN_SCALE, TURN_SCALE]))
            found, contradicted = find_pose(lines, before)
            if found is not None:
                self.filter.set_pose(*found)
                self.lost = False
                return
        self._failed += contradicted and len(lines.angle) >= ENOUGH
        if self._failed >= MOST_FAILED:
            self._declare_unknown()  # the prior is wrong
