"""Fusion of received robot poses: checks of messages and suspected senders."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from coopenv.estimation.poses import Array
from coopenv.mrclam.planar_model import PlanarPose, misfit
from coopenv.observers.contract import Received, Tick

OLDEST_S = 2.0
SPEED = 0.15  # m/s at which a sender may have moved since its message
LEAST_STD = (0.01, 0.002)  # m, rad: least standard deviations of a received pose
FARTHEST_M = 1e6
MOST_SEEN = 64  # sightings in one message
POSE_NUMBERS = 9  # x, y, heading and the triangle of their covariance
LOWER = np.tril_indices(3)


def received_position(received: Received) -> PlanarPose | None:
    """Return the position that a message reports; None if it is not plausible or older than 2 s.

    The heading of a neighbour is not needed: it is 0 with a variance of 0.
    """
    p, P = received.message.position, received.message.covariance
    if p is None or P is None or not 0.0 <= received.age <= OLDEST_S or not _plausible(p[:2], P[:2, :2]):
        return None
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = (P[:2, :2] + P[:2, :2].T) / 2
    covariance[[0, 1], [0, 1]] += LEAST_STD[0] ** 2 + (SPEED * received.age) ** 2
    return PlanarPose(np.array([p[0], p[1], 0.0]), covariance)


class Sightings(NamedTuple):
    """The bearings to other robots in a message."""

    by: PlanarPose  # pose of the sender at these bearings
    seen: list[tuple[int, float]]  # targets and bearings, rad
    localised: bool  # whether a recent bearing to a landmark fitted the sender's pose


def sightings_of(extra: Mapping[str, Array]) -> Sightings | None:
    """Return the sightings in a message; None if they are malformed or not plausible."""
    seen, bearing, by, localised = (np.asarray(extra.get(name, ())) for name in ("seen", "bearing", "from", "sure"))
    if any(numbers.dtype.kind not in "buif" for numbers in (seen, bearing, by, localised)):
        return None
    if by.shape != (POSE_NUMBERS,) or seen.ndim != 1 or bearing.shape != seen.shape or len(seen) > MOST_SEEN:
        return None
    pose, covariance = by[:3].astype(float), np.zeros((3, 3))
    covariance[LOWER] = by[3:]
    covariance += np.tril(covariance, -1).T
    if not _plausible(pose, covariance) or not np.isfinite(bearing.astype(float)).all():
        return None
    sender = PlanarPose(pose, covariance + np.diag(np.square([LEAST_STD[0], *LEAST_STD])))
    angles = zip(seen.tolist(), bearing.astype(float).tolist(), strict=True)
    return Sightings(sender, list(angles), localised.shape == (1,) and bool(localised[0]))


def _plausible(pose: Array, covariance: Array) -> bool:
    """Return whether a pose is finite and near, and its covariance symmetric and positive semidefinite."""
    scale = float(np.abs(covariance).max())
    if not (np.abs(pose).max() <= FARTHEST_M and scale <= FARTHEST_M**2):  # of NaN neither holds
        return False
    if (np.abs(covariance - covariance.T) > 1e-3 * scale + 1e-5 * np.abs(covariance.T)).any():
        return False
    return bool(np.linalg.eigvalsh(covariance)[0] >= -1e-3 * scale)


FASTEST = 0.6  # m/s: largest speed of a robot
WIDE = 5.0  # standard deviations by which a reported position may change in addition
SILENCE_S = 1.0  # after which a reported position may be anywhere: a lost robot sends nothing, and returns elsewhere
HONEST = 2.5  # mean of the squared innovation up to which a sender is not suspect; 1 for consistent covariances
MOST = 40.0  # gate of the cumulative sum
LARGEST = 16.0  # most that one sighting adds to the sum
FITS = 4.0  # squared innovation up to which a sighting agrees
CLEAR = 0.2  # rad: less certain sightings do not count for readmission
ENOUGH = 20  # agreeing sightings in a row after which a sender is readmitted
CONTRADICTIONS = 2  # senders that must contradict a localised sender before it is excluded
LOCALISED_S = 15.0  # for which a sender's report that it is localised counts
CONTRADICTS = 10.0  # gate of the sum over the sightings of one sender


class RobotMonitor:
    """Fault tests of one sender: its reports, innovations of bearings to it, and sightings by other senders.

    Innovations count in cumulative sums: Page, Continuous inspection schemes, Biometrika 41, 1954.
    """

    def __init__(self) -> None:
        self.excluded = False
        self._sum, self._fitting = 0.0, 0
        self._sums: dict[int, float] = {}  # of the sightings of every other sender
        self._localised = -math.inf
        self.time = -math.inf  # s, of the last report
        self._last: PlanarPose | None = None

    def test_report(self, time: float, reported: PlanarPose) -> None:
        """Exclude the sender if its reported position has jumped, valid at a time in s after that of the last one."""
        if self._last is not None and time - self.time < SILENCE_S:
            moved = math.dist(reported.pose[:2].tolist(), self._last.pose[:2].tolist())
            spread = sum(float(of.covariance[0, 0] + of.covariance[1, 1]) for of in (reported, self._last))
            if moved > FASTEST * (time - self.time) + WIDE * math.sqrt(spread):
                self.exclude()
        self.time, self._last = time, reported

    def test_innovation(self, ratio: float, variance: float, localised: bool) -> None:
        """Test a bearing to or from the sender by its normalised innovation squared and its variance, rad^2.

        `localised`: landmarks confirm the receiver's own pose.
        """
        if self.excluded:
            self._count_fitting(ratio < FITS and variance < CLEAR**2 and localised)
        elif localised:
            self._sum = max(self._sum + min(ratio, LARGEST) - HONEST, 0.0)
            if self._sum > MOST:
                self.exclude()

    def test_sighting(self, by: int, ratio: float, variance: float) -> None:
        """Test a bearing from a localised sender `by` to this one, as in `test_innovation`."""
        total = self._sums.get(by, 0.0)
        self._sums[by] = min(max(total + min(ratio, LARGEST) - HONEST, 0.0), MOST)
        if self.excluded:
            self._count_fitting(ratio < FITS and variance < CLEAR**2)

    def contradicting(self) -> list[int]:
        """Return the senders whose sightings contradict this one."""
        return [by for by, total in self._sums.items() if total > CONTRADICTS]

    def note_localised(self, time: float, localised: bool) -> None:
        """Note whether the sender reports at a time in s that landmarks confirm its pose."""
        self._localised = time if localised else self._localised

    def is_contradicted(self, time: float, monitors: Mapping[int, "RobotMonitor"]) -> bool:
        """Return whether sightings show a fault of this sender, and not of the senders that made them."""
        by = self.contradicting()
        if not by or sum(self._sums.values()) < MOST:
            return False
        if time - self._localised > LOCALISED_S:
            return True
        return len(by) >= CONTRADICTIONS and all(len(monitors[j].contradicting()) < len(by) for j in by)

    def exclude(self) -> None:
        """Exclude the sender."""
        self.excluded, self._fitting = True, 0

    def _count_fitting(self, fits: bool) -> None:
        self._fitting = self._fitting + 1 if fits else 0
        if self._fitting >= ENOUGH:
            self.excluded, self._sum = False, 0.0
            self._sums.clear()


FUSED_S = 60.0  # for which a fused report may still affect the receiver's pose


class RobotMonitors:
    """Fault detection and exclusion of senders, from their reports and from sightings of them."""

    def __init__(self, bearing_std: float) -> None:
        self._bearing_std = bearing_std
        self._monitors: dict[int, RobotMonitor] = {}
        self._fused: dict[int, float] = {}  # by sender: when a report of it was fused last, s

    def of(self, target: int) -> RobotMonitor:
        """Return the monitor of a sender."""
        return self._monitors.setdefault(target, RobotMonitor())

    def test_reports(self, tick: Tick) -> None:
        """Test the received positions against the earlier ones."""
        for target, received in tick.messages.items():
            monitor, time = self.of(target), tick.time - received.age
            if monitor.time < time and (reported := received_position(received)) is not None:
                monitor.test_report(time, reported)

    def accepts(self, target: int, time: float) -> bool:
        """Return whether a sender is not excluded; its report then counts as fused at a time in s."""
        accepted = not self.of(target).excluded
        if accepted:
            self._fused[target] = time
        return accepted

    def test_sightings(self, tick: Tick, by: int, sightings: Sightings) -> None:
        """Test the reported positions against the sightings of a localised sender."""
        sender = self.of(by)
        sender.note_localised(tick.time, sightings.localised)
        if not sightings.localised or sender.excluded:
            return
        for target, bearing in sightings.seen:
            reported = received_position(tick.messages[target]) if target in tick.messages else None
            if reported is not None:
                monitor = self.of(target)
                monitor.test_sighting(by, *misfit(bearing, sightings.by, reported, self._bearing_std))
                if not monitor.excluded and monitor.is_contradicted(tick.time, self._monitors):
                    monitor.exclude()

    def fused_excluded(self, time: float) -> bool:
        """Return whether a recently fused sender is excluded now; every exclusion is reported once."""
        excluded = [target for target in self._fused if self._monitors[target].excluded]
        return any(time - self._fused.pop(target, -math.inf) < FUSED_S for target in excluded)
