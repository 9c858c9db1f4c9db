"""Extended Kalman filters of all vehicles whose linearised system has the correct unobservable directions.

Source: Huang, Trawny, Mourikis and Roumeliotis, Observability-based consistent EKF estimators for multi-robot
cooperative localization, Autonomous Robots 30(1), 2011. Bearings between vehicles do not change if all vehicles turn
and move together: six directions in space are unobservable without landmarks. An EKF linearises at different estimates
of the same pose, before and after a correction. Then these directions differ from tick to tick, and the filter gains
information about them that it does not have.

Errors are about the map's axes: R = Exp(theta) Rhat, p = phat + e. The unobservable directions are N, which has the
rows [I, 0] and [-S(phat_i), I] of each vehicle i. Two conditions preserve them: F_k N_k = N_k+1, and H_k N_k = 0 for a
bearing between vehicles.

OC-EKF 1.0 of that paper linearises at estimates before their correction: F = [I, 0; -S(p_k+1|k - p_k|k-1), I] and H at
the prediction. These are the first estimates of every pose: without static unknown features it is the filter with
first-estimates Jacobians of Huang, Mourikis and Roumeliotis, A first-estimates Jacobian EKF for improving SLAM
consistency, ISER 2008. It also gives the estimates of the coordinate transformation of Tian, Hao, He and Yao,
Consistent distributed cooperative localization, arXiv 2303.01205: in T e, T = [I, 0; S(phat), I], F is the identity.
(Its server and the messages to it are left out: with them the estimates are the same while no message is lost.)

Projection: Hesch, Kottas, Bowman and Roumeliotis, Consistency analysis and improvement of vision-aided inertial
navigation, IEEE Transactions on Robotics 30(1), 2014. H is linearised at the best estimate, here half way to the
correction, and replaced by the nearest H* with H* N = 0: H* = H - H N (N^T N)^-1 N^T.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from coopenv.estimation.poses import Array, exp_so3, orthonormalise, skew
from coopenv.observers.bearing_measurements import LinearisedBearings
from coopenv.observers.centralised import Centralised
from coopenv.observers.contract import Tick


class FirstEstimatesEkf(Centralised):
    """Centralised filter that linearises at first estimates.

    It is the OC-EKF 1.0 of Huang et al.
    """

    halfway = False

    def reset(self, initial_poses: Sequence[tuple[Array, Array]], initial_covariances: Sequence[Array]) -> None:
        """Start with independent errors, which are left ones."""
        super().reset(initial_poses, initial_covariances)
        turn = self.turned(np.eye(len(self.P)))  # from errors about the map's axes to left ones
        self.P = turn.T.dot(self.P).dot(turn)
        self.first = [p for _, p in self.poses]  # m, at which the last tick was linearised

    def turned(self, H: Array) -> Array:
        """Return a derivative (..., 6N) by left errors as one by errors about the map's axes."""
        R = np.array([R for R, _ in self.poses])
        parts = H.reshape(*H.shape[:-1], len(R), 2, 3)
        return np.asarray(np.einsum("...iak,ijk->...iaj", parts, R).reshape(H.shape))

    def covariance(self, i: int) -> Array:
        """Return the covariance (6, 6) of the left error of vehicle i."""
        T = np.zeros((6, 6))
        T[:3, :3] = T[3:, 3:] = self.poses[i][0].T
        return np.asarray(T.dot(self.P[self.block(i), self.block(i)]).dot(T.T))

    def predict(self, ticks: Sequence[Tick]) -> None:
        """Carry every pose and the joint covariance through one tick of odometry, whose noise is isotropic."""
        F, before = self.transition(ticks), self.poses
        self.poses = [
            (orthonormalise(R.dot(tick.rotation)), p + R.dot(tick.translation))
            for tick, (R, p) in zip(ticks, before, strict=True)
        ]
        self.first = [p for _, p in self.poses]
        noise = np.concatenate([tick.noise.odometry(tick.dt) for tick in ticks])
        self.P = F.dot(self.P).dot(F.T) + np.diag(noise)

    def transition(self, ticks: Sequence[Tick]) -> Array:
        """Return F (6N, 6N) of a tick of odometry, from the first estimate of the last tick to that of this one."""
        F = np.eye(len(self.P))
        for i, (tick, (R, p)) in enumerate(zip(ticks, self.poses, strict=True)):
            F[6 * i + 3 : 6 * i + 6, 6 * i : 6 * i + 3] = skew(self.first[i] - p - R.dot(tick.translation))
        return F

    def linearise(self, i: int, tick: Tick, mask: NDArray[np.bool_]) -> tuple[LinearisedBearings, NDArray[np.bool_]]:
        """Return the bearings of a mask (m,) of vehicle i, linearised by all errors, and whether they point ahead."""
        linear, in_front = super().linearise(i, tick, mask)
        return linear._replace(H=self.turned(linear.H)), in_front

    @staticmethod
    def moved(poses: Sequence[tuple[Array, Array]], dx: Array) -> list[tuple[Array, Array]]:
        """Return poses moved by their errors (6N,)."""
        return [(exp_so3(e[:3]).dot(R), p + e[3:]) for (R, p), e in zip(poses, dx.reshape(-1, 6), strict=True)]

    @staticmethod
    def recentring(dx: Array) -> Array:
        """Return the identity (6N, 6N): errors stay about the first estimates."""
        return np.eye(len(dx))


class ObservabilityConstrainedEkf(FirstEstimatesEkf):
    """Centralised filter with Jacobians projected onto the observable directions.

    Bearings are linearised half way to the correction.
    """

    halfway = True

    def predict(self, ticks: Sequence[Tick]) -> None:
        """Carry every pose and the joint covariance through one tick, then project onto the unobservable directions."""
        super().predict(ticks)
        p = np.array(self.first)
        N = np.zeros((len(p), len(p), 12, 6))  # of a pair (i, j): turns about i, and translations
        N[:, :, :6], N[:, :, 6:] = np.eye(6), np.eye(6)
        N[:, :, 9:, :3] = np.cross(p[:, None, None] - p[None, :, None], np.eye(3)).swapaxes(-1, -2)
        NT = np.swapaxes(N, -1, -2)
        self.projection = N @ np.linalg.solve(NT @ N, NT)  # (N, N, 12, 12)

    def linearise(self, i: int, tick: Tick, mask: NDArray[np.bool_]) -> tuple[LinearisedBearings, NDArray[np.bool_]]:
        """Return the bearings of a mask (m,) of vehicle i, linearised by all errors, and whether they point ahead."""
        linear, in_front = super().linearise(i, tick, mask)
        targets = tick.targets[mask] - self.landmarks
        rows = np.flatnonzero(targets >= 0)
        j = targets[rows]
        of = linear.H.reshape(*linear.H.shape[:2], -1, 6)  # a view
        H = np.concatenate([of[rows, :, i], of[rows, :, j]], axis=-1)
        H -= H @ self.projection[i, j]
        of[rows, :, i], of[rows, :, j] = H[..., :6], H[..., 6:]
        return linear, in_front
