"""Extended Kalman filter over the stacked left errors of all vehicles; the upper reference is `smoother`.

Source: Roumeliotis and Bekey, Distributed multirobot localization, IEEE Transactions on Robotics and Automation 18(5),
2002, in its centralised form; errors and Jacobians as in pose_filters.py. A bearing from i to a point z_j = p_j
+ R_j m_j of vehicle j also has H_j = B Rhat_i^T Rhat_j [-S(m_j), I] / |d|. Each vehicle has a gate; corrections are
linearised half way (correction.py).

The other two filters have a linearised system with the correct unobservable directions.

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

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from coopenv.estimation.compiled import adjoint
from coopenv.estimation.poses import Array, exp_so3, orthonormalise, skew
from coopenv.observers import uncertain_pose
from coopenv.observers.contract import Estimate, Message, Received, Setup, Tick
from coopenv.observers.correction import InnovationGate, Stacked, gain, joseph, judged
from coopenv.observers.frame import UsableMeasurements, measured_message, usable_measurements
from coopenv.observers.lasting_errors import LastingErrors
from coopenv.observers.linearisation import LinearMeasurements, linearised, spread
from coopenv.observers.uncertain_pose import LEFT, UncertainPose, increment, transition


class Centralised:
    """One filter over all vehicles and all measurements.

    It reads no messages, so their loss and delay change nothing.
    """

    joint = True
    halfway = True  # whether corrections are linearised half way, else at the prediction

    def __init__(self, setups: Sequence[Setup]) -> None:
        """Take the setups of all."""
        self.landmarks = setups[0].landmarks
        self.markers = [setup.marker for setup in setups]
        self.to_marker = [adjoint(np.eye(3), -marker) for marker in self.markers]  # own left error to the marker's
        self.lasting = [LastingErrors(setup) for setup in setups]
        self.moves = any("velocity" in sensor.kind.needs for setup in setups for sensor in setup.sensors)

    def reset(self, initial_poses: Sequence[tuple[Array, Array]], initial_covariances: Sequence[Array]) -> None:
        """Start with independent errors."""
        self.poses = [(np.array(R, float), np.array(p, float)) for R, p in initial_poses]
        self.P = np.asarray(block_diag(*initial_covariances))
        self.sent = [Message() for _ in self.poses]
        self.gates = [InnovationGate() for _ in self.poses]
        for lasting in self.lasting:
            lasting.reset()

    @staticmethod
    def block(i: int) -> slice:
        """Return the place of vehicle i in the state."""
        return slice(6 * i, 6 * i + 6)

    def update(self, ticks: Sequence[Tick]) -> list[Estimate]:
        """Predict every vehicle, then correct by all bearings in one update."""
        self.predict(ticks)
        if measured := self.measured(ticks):
            self.correct(ticks, measured)
        self.sent = [measured_message(tick) for tick in ticks]
        return [UncertainPose(LEFT, R, p, self.covariance(i)).estimate() for i, (R, p) in enumerate(self.poses)]

    def covariance(self, i: int) -> Array:
        """Return the covariance (6, 6) of the left error of vehicle i."""
        return self.P[self.block(i), self.block(i)].copy()

    def predict(self, ticks: Sequence[Tick]) -> None:
        """Carry every pose and the joint covariance through one tick of odometry."""
        F = self.transition(ticks)
        self.poses = [
            (orthonormalise(R.dot(tick.rotation)), p + R.dot(tick.translation))
            for tick, (R, p) in zip(ticks, self.poses, strict=True)
        ]
        noise = np.concatenate([tick.noise.odometry(tick.dt) for tick in ticks])
        self.P = F.dot(self.P).dot(F.T) + np.diag(noise)

    def transition(self, ticks: Sequence[Tick]) -> Array:
        """Return F (6N, 6N) of a tick of odometry."""
        return np.asarray(block_diag(*(transition(*increment(tick)) for tick in ticks)))

    def measured(self, ticks: Sequence[Tick]) -> dict[int, UsableMeasurements]:
        """Return the measurements of vehicles that have any, with all targets at their known or estimated poses."""
        reports = {self.landmarks + j: Received(self.report(j, tick), 0.0) for j, tick in enumerate(ticks)}
        due = {i: replace(tick, messages=reports) for i, tick in enumerate(ticks) if tick.due}
        found = {i: usable_measurements(tick, weighed=False) for i, tick in due.items()}
        for i, measured in found.items():
            if measured is not None and self.lasting[i].counts:
                self.lasting[i].count(ticks[i], measured, *self.poses[i])
        return {i: measured for i, measured in found.items() if measured is not None}

    def report(self, j: int, tick: Tick) -> Message:
        """Return what a vehicle's message would state of its marker."""
        (R, p), marker = self.poses[j], self.markers[j]
        moves = self.moves or tick.bearing_age > 0.0
        velocity = R.dot(tick.velocity + np.cross(tick.angular_velocity, marker)) if moves else None
        return Message(p + R.dot(marker), R, extra={} if velocity is None else {"velocity": velocity})

    def correct(self, ticks: Sequence[Tick], measured: Mapping[int, UsableMeasurements]) -> None:
        """Correct by the measurements of vehicles that pass the vehicles' gates, in one update."""
        before, P = self.poses, self.P
        linear = {i: self.linearise(i, of) for i, of in measured.items()}
        kept = {
            i: self.gates[i].passed(ticks[i].time, judged(of.residual, spread(of.H, P, of.N), *of[4:8]))
            for i, of in linear.items()
        }
        residual, H, N = _stacked([of.only(kept[i]) for i, of in linear.items()])
        if not len(residual):
            return
        K, dx, _ = gain(P, H, N, residual)
        if self.halfway:
            at = 0.5 * dx
            self.poses = self.moved(before, at)
            again = {i: of.only(kept[i]) for i, of in self.measured(ticks).items()}
            residual, H, N = _stacked([self.linearise(i, of) for i, of in again.items()])
            H = H.dot(self.recentring(at))
            K, dx, _ = gain(P, H, N, residual + H.dot(at))
        G = self.recentring(dx)
        self.poses, self.P = self.moved(before, dx), G.dot(joseph(P, K, H, N)).dot(G.T)

    def linearise(self, i: int, measured: UsableMeasurements) -> LinearMeasurements:
        """Return measurements of vehicle i, linearised by all errors."""
        own = linearised(UncertainPose(LEFT, *self.poses[i], self.P), measured)
        H = np.zeros((*own.residual.shape, len(self.P)))
        H[:, :, self.block(i)] = own.H
        for n, target in enumerate(measured.targets.tolist()):
            if (j := target - self.landmarks) >= 0:
                H[n, :, self.block(j)] = own.by_target[n].dot(self.to_marker[j])
        return own._replace(H=H)

    @staticmethod
    def moved(poses: Sequence[tuple[Array, Array]], dx: Array) -> list[tuple[Array, Array]]:
        """Return poses moved by their errors (6N,)."""
        return [(R.dot(exp_so3(e[:3])), p + R.dot(e[3:])) for (R, p), e in zip(poses, dx.reshape(-1, 6), strict=True)]

    @staticmethod
    def recentring(dx: Array) -> Array:
        """Return (6N, 6N) what `uncertain_pose.recentring` returns, of every pose."""
        return np.asarray(block_diag(*(uncertain_pose.recentring(LEFT, e) for e in dx.reshape(-1, 6))))

    def messages(self) -> list[Message]:
        """Return the raw measurements of this tick: odometry and bearings."""
        return self.sent


def _stacked(linear: Sequence[LinearMeasurements]) -> Stacked:
    residual, H, N = zip(*(of.stacked() for of in linear), strict=True)
    return np.concatenate(residual), np.concatenate(H), np.asarray(block_diag(*N))


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
        super().predict(ticks)
        self.first = [p for _, p in self.poses]

    def transition(self, ticks: Sequence[Tick]) -> Array:
        """Return F (6N, 6N) of a tick of odometry, from the first estimate of the last tick to that of this one."""
        F = np.eye(len(self.P))
        for i, (tick, (R, p)) in enumerate(zip(ticks, self.poses, strict=True)):
            F[6 * i + 3 : 6 * i + 6, 6 * i : 6 * i + 3] = skew(self.first[i] - p - R.dot(tick.translation))
        return F

    def linearise(self, i: int, measured: UsableMeasurements) -> LinearMeasurements:
        """Return measurements of vehicle i, linearised by all errors."""
        linear = super().linearise(i, measured)
        return linear._replace(H=self.turned(linear.H))

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

    def linearise(self, i: int, measured: UsableMeasurements) -> LinearMeasurements:
        """Return measurements of vehicle i, linearised by all errors."""
        linear = super().linearise(i, measured)
        targets = measured.targets - self.landmarks
        rows = np.flatnonzero(targets >= 0)
        j = targets[rows]
        of = linear.H.reshape(*linear.H.shape[:2], linear.H.shape[2] // 6, 6)  # a view
        H = np.concatenate([of[rows, :, i], of[rows, :, j]], axis=-1)
        H -= H @ self.projection[i, j]
        of[rows, :, i], of[rows, :, j] = H[..., :6], H[..., 6:]
        return linear
