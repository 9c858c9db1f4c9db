"""Error-state (multiplicative) Kalman filter with body-frame errors; neighbours are taken as exact.

Source: Lefferts, Markley and Shuster, Kalman filtering for spacecraft attitude estimation, 1982 (multiplicative
error); the bearing as a residual in its tangent plane. Errors are left ones (pose_errors.py).

With a = Rhat^T (z - phat), d = a - c the line from the camera c, and B a tangent basis at d / |d|:
H = B [S(a), -I] / |d|,  residual B b. Bearings are gated (gate.py) and linearised half way (correction.py).
"""

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.estimation.coordinates import Coordinates
from coopenv.estimation.rotations import skew
from coopenv.observers import pose_errors
from coopenv.observers.contract import Estimate, Message, Setup, Tick
from coopenv.observers.gate import Gate
from coopenv.observers.lines import Lines, Sight, ahead, linearised, sight_of
from coopenv.observers.pose_update import frame_of, updated


@dataclass(frozen=True)
class LeftError:
    """A pose with a covariance over its left error."""

    R: Array
    p: Array  # map frame
    P: Array
    kind: ClassVar[int] = pose_errors.LEFT

    @classmethod
    def start(cls, R: Array, p: Array, P: Array) -> Self:
        """Return the state of a pose with a covariance in LEFT coordinates."""
        return cls(np.array(R, float), np.array(p, float), np.array(P, float))

    @staticmethod
    def transition(rotation: Array, translation: Array) -> Array:
        """Return F (6, 6) of the error over an odometry increment (dR, dp)."""
        F: Array = pose_errors.transition(np.asarray(rotation, float), np.asarray(translation, float))
        return F

    def predicted(self, tick: Tick) -> Self:
        """Return the state after the tick's odometry."""
        rotation, translation = np.asarray(tick.rotation, float), np.asarray(tick.translation, float)
        step = (rotation, translation, tick.noise.odometry(tick.dt))
        return type(self)(*pose_errors.predicted(self.kind, self.R, self.p, self.P, *step))

    def moved(self, dx: Array, P: Array) -> Self:
        """Return the state moved by an error dx."""
        return type(self)(*pose_errors.moved(self.kind, self.R, self.p, dx), P)

    @classmethod
    def recentring(cls, dx: Array) -> Array:
        """Return G (6, 6): about the state moved by dx, an error of dx + d about this one is G d to first order."""
        G: Array = pose_errors.recentring(cls.kind, dx)
        return G

    def corrected(self, dx: Array, P: Array) -> Self:
        """Return the state moved by an error dx, of which P is the covariance about this state."""
        return type(self)(*pose_errors.corrected(self.kind, self.R, self.p, dx, P))

    def point_covariance(self, marker: Array) -> Array:
        """Return the covariance (3, 3) in map axes of a point of the body."""
        J = np.empty((3, 6))
        J[:, :3] = self.R.dot(skew(-marker))
        J[:, 3:] = self.R
        return np.asarray(J.dot(self.P).dot(J.T))

    def estimate(self, nis: float | None = None, nis_dof: int = 0) -> Estimate:
        """Return the pose with its covariance, and the normalised innovation squared of its correction."""
        return Estimate(self.R, self.p, self.P, Coordinates.LEFT, nis, nis_dof)


class PoseObserver:
    """What observers share that believe in one pose and a covariance, and tell where their marker is."""

    belief: ClassVar[type[LeftError]] = LeftError
    sends_covariance = True

    def __init__(self, setup: Setup) -> None:
        self.marker = setup.marker  # what others measure

    def reset(self, initial_pose: tuple[Array, Array], initial_covariance: Array) -> None:
        """Start at a pose."""
        self.state = self.belief.start(*initial_pose, initial_covariance)

    def message(self) -> Message:
        """Return the marker's position, and its covariance if this observer sends it."""
        covariance = self.state.point_covariance(self.marker) if self.sends_covariance else None
        return Message(position=self.state.p + self.state.R.dot(self.marker), covariance=covariance)


class Mekf(PoseObserver):
    """Error-state filter; trusts the positions that it hears.

    It sends its position alone.
    """

    sends_covariance = False

    def __init__(self, setup: Setup, gated: bool = True) -> None:
        """Take a setup; without `gated` every bearing is believed."""
        super().__init__(setup)
        self.gated, self.gate = gated, Gate()

    def reset(self, initial_pose: tuple[Array, Array], initial_covariance: Array) -> None:
        """Start at a pose."""
        super().reset(initial_pose, initial_covariance)
        self.gate.reset()

    def update(self, tick: Tick) -> Estimate:
        """Predict, then correct by every usable bearing."""
        self.predict(tick)
        self.nis: float | None = None
        self.nis_dof = 0
        sight = sight_of(tick, self.sends_covariance) if tick.due else None
        if sight is not None:
            self.take(tick, sight)
        return self.state.estimate(self.nis, self.nis_dof)

    def predict(self, tick: Tick) -> None:
        """Append the increment."""
        self.state = self.state.predicted(tick)

    def take(self, tick: Tick, sight: Sight) -> None:
        """Correct by what passes the gate."""
        lines = linearised(self.state, tick, sight)
        if self.gated:
            S = self.spread(tick, sight, lines)
            kept = self.gate.passed(tick.time, lines.residual, S, ahead(self.state, tick, sight))
            if not kept.all():
                sight, lines = sight.only(kept), lines.only(kept)
        if len(lines.residual):
            self.correct(tick, sight, lines)

    def spread(self, tick: Tick, sight: Sight, lines: Lines) -> Array:
        """Return (m, 2, 2) the covariances of the innovations."""
        return lines.spread(self.state.P)

    def correct(self, tick: Tick, sight: Sight, lines: Lines) -> None:
        """Correct by bearings, which are linearised at the prediction."""
        self.nis = self.fuse(tick, sight)
        self.nis_dof = 2 * len(lines.residual)

    def fuse(self, tick: Tick, sight: Sight) -> float:
        """Correct by bearings; return their normalised innovation squared."""
        before = self.state
        R, p, P, nis = updated(before.kind, before.R, before.p, before.P, frame_of(tick, sight))
        self.state = self.belief(R, p, P)
        return float(nis)
