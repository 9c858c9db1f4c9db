"""Error-state (multiplicative) Kalman filter with body-frame errors; neighbours are taken as exact.

Source: Lefferts, Markley and Shuster, Kalman filtering for spacecraft attitude estimation, 1982 (multiplicative
error); the bearing as a residual in its tangent plane. Errors: R = Rhat Exp(theta), p = phat + Rhat rho.

Over a tick of odometry (dR, dp), with E = dR^T:  F = [E, 0; -E S(dp), E].
With a = Rhat^T (z - phat), d = a - c the line from the camera c, and B a tangent basis at d / |d|:
H = B [S(a), -I] / |d|,  residual B b. Bearings are gated (gate.py) and linearised half way (correction.py).
"""

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.estimation.coordinates import Coordinates
from coopenv.estimation.rotations import IDENTITY, exp_so3, orthonormalise, right_jacobian, skew
from coopenv.observers.contract import Estimate, Message, Setup, Tick
from coopenv.observers.correction import Look, Stacked, halfway
from coopenv.observers.gate import Gate
from coopenv.observers.lines import Lines, Sight, ahead, linearised, sight_of


@dataclass(frozen=True)
class LeftError:
    """A pose with a covariance over its left error."""

    R: Array
    p: Array  # map frame
    P: Array
    right: ClassVar[bool] = False

    @classmethod
    def start(cls, R: Array, p: Array, P: Array) -> Self:
        """Return the state of a pose with a covariance in LEFT coordinates."""
        return cls(np.array(R, float), np.array(p, float), np.array(P, float))

    @staticmethod
    def transition(rotation: Array, translation: Array) -> Array:
        """Return F (6, 6) of the error over an odometry increment (dR, dp)."""
        F = np.zeros((6, 6))
        E = rotation.T
        F[:3, :3] = F[3:, 3:] = E
        F[3:, :3] = E.dot(skew(-translation))
        return F

    def predicted(self, tick: Tick) -> Self:
        """Return the state after the tick's odometry."""
        F = self.transition(tick.rotation, tick.translation)
        P = F.dot(self.P).dot(F.T)
        P.flat[::7] += tick.noise.odometry(tick.dt)
        return type(self)(orthonormalise(self.R.dot(tick.rotation)), self.p + self.R.dot(tick.translation), P)

    def jacobian(self, positions: Array) -> Array:
        """Return (m, 3, 6) the derivative of the lines to map positions (m, 3)."""
        J = np.empty((len(positions), 3, 6))
        J[:, :, :3] = skew((positions - self.p).dot(self.R))
        J[:, :, 3:] = -IDENTITY
        return J

    def moved(self, dx: Array, P: Array) -> Self:
        """Return the state moved by an error dx."""
        return type(self)(self.R.dot(exp_so3(dx[:3])), self.p + self.R.dot(dx[3:]), P)

    @staticmethod
    def recentring(dx: Array) -> Array:
        """Return G (6, 6): about the state moved by dx, an error of dx + d about this one is G d to first order."""
        G = np.zeros((6, 6))
        G[:3, :3] = right_jacobian(dx[:3])
        G[3:, 3:] = exp_so3(dx[:3]).T
        return G

    def corrected(self, dx: Array, P: Array) -> Self:
        """Return the state moved by an error dx, of which P is the covariance about this state."""
        G = self.recentring(dx)
        return self.moved(dx, G.dot(P).dot(G.T))

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
        self.nis = self.fuse(tick, sight, lines, self.state.P)
        self.nis_dof = 2 * len(lines.residual)

    def fuse(self, tick: Tick, sight: Sight, lines: Lines, P: Array) -> float:
        """Correct a prediction of covariance P by bearings; return their normalised innovation squared."""
        before = self.state

        def look(at: Array) -> Stacked:
            moved = before.moved(at, before.P)
            residual, H, N = linearised(moved, tick, sight).stacked()
            return residual, H.dot(before.recentring(at)), N

        dx, P, nis = self.settled(P, lines.stacked(), look, sight)
        self.state = before.corrected(dx, P)
        return nis

    def settled(self, P: Array, first: Stacked, look: Look, sight: Sight) -> tuple[Array, Array, float]:
        """Return the correction (n,), the covariance (n, n) after it and r^T S^-1 r at the prediction.

        The update is linearised half way to where it leads.
        """
        return halfway(P, first, look)
