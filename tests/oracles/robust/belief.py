"""What one vehicle believes about itself and the vehicles that it hears: poses with one covariance over all of them.

Errors are left errors, R = Rhat Exp(theta), p = phat + Rhat rho, six per member, the vehicle itself first. A member
stands at the time of its last message; until now it is carried on by its last known twist.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coopenv.estimation.arrays import Array, cholesky, solve
from coopenv.estimation.rotations import exp_so3, lengths, log_so3, orthonormalise, skew
from coopenv.observers.contract import SensorNoise
from coopenv.observers.mekf import LeftError
from coopenv.observers.robust.constants import (
    BEARING_GATE,
    BEND_TIME,
    CONSIDERED_BEND_TIME,
    ERRORS_TIME,
    MAX_ACCELERATION,
    MAX_GROWTH,
    MAX_LINEARISATIONS,
    MEMBER_BEND_TIME,
    RELINEARISATION_ANGLE,
    SAME_TIME,
)
from tests.oracles.robust.matrices import solve_positive, tangent_basis
from tests.oracles.robust.odometry import as_noise
from tests.oracles.robust.sight import Sight


@dataclass
class Member:
    """One vehicle in a belief."""

    vehicle: int
    R: Array  # (3, 3) body to map
    p: Array  # (3,) map frame, m
    time: float = 0.0
    """s, at which it stands."""
    odometry: tuple[Array, Array] | None = None
    """Its pose by dead reckoning at that time; not needed of the vehicle itself."""
    v: Array | None = None
    """(3,) last known velocity in its body, m/s; None before a second message."""
    w: Array | None = None
    """(3,) last known angular velocity in its body, rad/s."""
    dated: Array | None = None
    """(3,) m/s: by which clocks that are off count."""
    velocity_variance: float = 0.0
    """(m/s)^2 per axis."""
    seen: float = 0.0
    """s, when it was last in view, or was told of along with one in view."""
    considered: bool = False
    """Whether it stands as told, and bearings do not correct it."""
    untold: bool = False
    """Whether it had been heard before it was met, and nobody has told how its error correlates."""

    def carried(self, age: float) -> Array:
        """Return (3,) how far it comes in its body frame at the last known twist in a time, m."""
        if age <= 0.0 or self.v is None or self.w is None:
            return np.zeros(3)
        result: Array = exp_so3(self.w * (age / 2)).dot(self.v) * age
        return result


ERRORS = -1
"""In place of a vehicle's number: the errors of one's own odometry, (bias (3,), scale, 0, 0), `w` and `v` of the
member."""


MOUNTING = -2
"""In place of a vehicle's number: the turn and the shift of one's own camera, `R` and `p` of the member."""


class Belief:
    """Members and their joint covariance (6n, 6n)."""

    def __init__(self, vehicle: int, R: Array, p: Array, P: Array, time: float = 0.0) -> None:
        """Start with the vehicle itself."""
        self.members = [Member(vehicle, R, p, time)]
        self.P = P

    def begin_errors(self, P: Array, like: Belief | None = None) -> None:
        """Let member 1 stand for the odometry's errors, of covariance P (6, 6), as another belief has them."""
        member = Member(ERRORS, np.eye(3), np.zeros(3), v=np.zeros(3), w=np.zeros(3))
        if like is not None and like.errors is not None:
            member.v, member.w = like.errors.v, like.errors.w
        self.add([member], P)

    def begin_mounting(self, P: Array, like: Belief | None = None) -> None:
        """Let member 2 stand for the camera's mounting, of covariance P (6, 6), as another belief has it."""
        member = Member(MOUNTING, np.eye(3), np.zeros(3))
        if like is not None and like.mounting is not None:
            member.R, member.p = like.mounting.R, like.mounting.p
        self.add([member], P)

    @property
    def mounting(self) -> Member | None:
        """The member that stands for the camera's mounting, if there is one."""
        return self.members[2] if len(self.members) > 2 and self.members[2].vehicle == MOUNTING else None

    @property
    def others(self) -> int:
        """Where the members begin that are other vehicles."""
        return 1 + sum(member.vehicle in (ERRORS, MOUNTING) for member in self.members)

    @property
    def errors(self) -> Member | None:
        """The member that stands for the odometry's errors, if there is one."""
        return self.members[1] if len(self.members) > 1 and self.members[1].vehicle == ERRORS else None

    @property
    def errors_covariance(self) -> Array | None:
        """(6, 6) of the odometry's errors, if there are any."""
        return None if self.errors is None else self.P[6:12, 6:12]

    def corrected(self, dR: Array, dp: Array, dt: float) -> tuple[Array, Array]:
        """Return an odometry increment over dt without the errors that are believed."""
        if self.errors is None or self.errors.v is None or self.errors.w is None:
            return dR, dp
        turn = self.errors.w * dt
        return dR.dot(exp_so3(-turn)), (dp - np.cross(turn, dp) / 2) / (1.0 + self.errors.v[0])

    def drift(self, dR: Array, v: Array, dt: float) -> None:
        """Let the odometry's errors be in the vehicle's own after a corrected increment at a measured mean velocity."""
        if self.errors is None or self.errors.v is None:
            return
        dp = v * dt / (1.0 + self.errors.v[0])
        A = np.eye(len(self.P))
        A[:3, 6:9] = -dt * np.eye(3)
        A[3:6, 6:9] = dR.T.dot(skew(dp)) * dt / 2
        A[3:6, 9] = -dR.T.dot(dp) / (1.0 + self.errors.v[0])
        P = A.dot(self.P).dot(A.T)
        self.P = (P + P.T) / 2

    @property
    def own(self) -> Member:
        """The vehicle itself."""
        return self.members[0]

    def place(self, vehicle: int) -> int | None:
        """Return a vehicle's number among the members, None if it is not one."""
        return next((n for n, member in enumerate(self.members) if member.vehicle == vehicle), None)

    def add(self, members: list[Member], P: Array) -> None:
        """Take in members whose errors are independent of those of the others."""
        n, m = len(self.P), len(P)
        joint = np.zeros((n + m, n + m))
        joint[:n, :n], joint[n:, n:] = self.P, P
        self.P = joint
        self.members.extend(members)

    def drop(self, vehicles: set[int]) -> None:
        """Forget members."""
        keep = [n for n, member in enumerate(self.members) if member.vehicle not in vehicles]
        index = errors_of(keep)
        self.P = self.P[np.ix_(index, index)]
        self.members = [self.members[n] for n in keep]

    def move(self, n: int, dR: Array, dp: Array, noise: Array) -> None:
        """Carry a member through an odometry increment with noise variances (6,)."""
        member = self.members[n]
        member.p = member.p + member.R.dot(dp)
        member.R = orthonormalise(member.R.dot(dR))
        F, block = LeftError.transition(dR, dp), slice(6 * n, 6 * n + 6)
        self.P[block] = F.dot(self.P[block])
        self.P[:, block] = self.P[:, block].dot(F.T)
        self.P.flat[6 * n * (len(self.P) + 1) : (6 * n + 6) * len(self.P) : len(self.P) + 1] += noise

    def follow(
        self,
        n: int,
        odometry_turn: Array,
        odometry_position: Array,
        time: float,
        noise: SensorNoise,
        memory: float = 0.0,
    ) -> None:
        """Carry a member on to where its own odometry says that it was at a time.

        Its errors that last are taken as noise of as large errors as one's own, the same for a `memory`, s.
        """
        member = self.members[n]
        dt = time - member.time
        if dt < SAME_TIME or member.odometry is None:
            return
        R, p = member.odometry
        dR, dp = R.T.dot(odometry_turn), R.T.dot(odometry_position - p)
        self.move(n, dR, dp, noise.odometry(dt) + as_noise(self.errors_covariance, dp, dt, ERRORS_TIME))
        q = float(noise.odometry(1.0)[3])
        averaged = max(averaging_time(noise), dt / 2.0)
        member.velocity_variance = (MAX_ACCELERATION * averaged) ** 2 + q / (2.0 * averaged)
        v, w = dp / dt, log_so3(dR) / dt
        if member.v is None or member.w is None:
            member.v, member.w = v, w
        else:
            share = min(1.0, dt / averaged)
            member.v, member.w = member.v + share * (v - member.v), member.w + share * (w - member.w)
        member.time, member.odometry = time, (odometry_turn, odometry_position)

    def sight(
        self,
        bearings: Array,
        lever_arm: Array,
        z: Array,
        places: Sequence[int] = (),
        points: Sequence[Array] = (),
        mounted: bool = False,
        period: float = BEND_TIME,
    ) -> Sight:
        """Return bearings as measurements; the last ones are to members.

        Args:
            bearings: (m, 3) unit vectors, body frame.
            lever_arm: (3,) the camera's place in the body, m.
            z: (m, 3) where the targets are believed to be, map frame, m.
            places: the members that the last targets belong to.
            points: of these targets in their members' bodies, (3,) m each.
            mounted: whether the camera's mounting is as believed, not as declared.
            period: s, since the last frame.
        """
        own, m = self.own, len(z)
        a = (z - own.p).dot(own.R)
        d, said, mounting = a - lever_arm, bearings, self.mounting if mounted else None
        if mounting is not None:
            d, bearings = d - mounting.p, said.dot(mounting.R.T)
        distance = np.maximum(lengths(d), 1e-9)
        u = d / distance[:, None]
        T = tangent_basis(u)
        B = T / distance[:, None, None]
        H = np.zeros((m, 2, len(self.P)))
        H[:, :, :3], H[:, :, 3:6] = B @ skew(a), -B
        if mounting is not None:
            H[:, :, 12:15], H[:, :, 15:18] = T.dot(mounting.R) @ skew(said), -B.dot(mounting.R)
        for k, n, point in zip(range(m - len(places), m), places, points, strict=True):
            G = B[k].dot(own.R.T).dot(self.members[n].R)
            H[k, :, 6 * n + 3 : 6 * n + 6] = G
            if point.any():
                H[k, :, 6 * n : 6 * n + 3] = G.dot(skew(-point))
        bend = self._bends(d.dot(own.R.T), dict(zip(range(m - len(places), m), places, strict=True)), period)
        return Sight(H, (T @ bearings[..., None])[..., 0], (u * bearings).sum(axis=1) > 0.0, distance, bend)

    def _bends(self, lines: Array, places: dict[int, int], period: float) -> Array:
        """Return (m,) the variance of the part t s / d^2 of lines d (m, 3), map frame, that is not linear in errors.

        An error s along a line and t across it. The last lines are to members, by line.
        """
        result = np.zeros(len(lines))
        for k, d in enumerate(lines):
            D = np.zeros((3, len(self.P)))
            D[:, 3:6] = -self.own.R
            time = BEND_TIME
            if k in places:
                n = places[k]
                time = CONSIDERED_BEND_TIME if self.members[n].considered else MEMBER_BEND_TIME
                D[:, 6 * n + 3 : 6 * n + 6] = self.members[n].R
            V, square = D.dot(self.P).dot(D.T), float(d.dot(d))
            along = float(d.dot(V).dot(d)) / square
            result[k] = max(time / period, 1.0) * max(along, 0.0) * max(float(np.trace(V)) - along, 0.0) / square**2
        return result

    def correct(self, H: Array, noise: Array, residual: Array) -> None:
        """Take independent measurements residual = H x + noise of variances (m,), in Joseph's form."""
        K = self._held(self.gain(H, noise))
        self.condense(K, H, noise)
        self.shift_about(K.dot(residual))

    def settle(
        self, sight: Sight, noise: Array, fits: NDArray[np.bool_], look: Callable[[], tuple[Sight, Array]]
    ) -> Array:
        """Correct by bearings, linearised anew half way, or at where they put the poses if that is far.

        Source: the iterated extended Kalman filter as Gauss-Newton steps, Bell and Cathey, The iterated Kalman filter
        update as a Gauss-Newton method, IEEE Transactions on Automatic Control 38(2), 1993.

        Args:
            sight: the frame's bearings as measurements.
            noise: (m,) their variances.
            fits: which of them count.
            look: returns sight and noise again, at the poses believed by then.

        Returns:
            (m,) the variances at last. `fits` is changed where a bearing does not fit the others. `full_correction`
            (6n,) is the correction with that of members that are considered, `full_covariance` its covariance.
        """
        before = [(member.R, member.p) for member in self.members]
        x0 = np.zeros(len(self.P))  # where the lines are linearised
        for step in range(MAX_LINEARISATIONS):
            if step > 0:
                self._put(before, x0)
                sight, noise = look()
            else:
                self._judge(sight, noise, fits)
                if not fits.any():
                    self.full_correction, self.full_covariance = np.zeros(len(x0)), np.zeros_like(self.P)
                    return noise
            H = sight.H[fits].reshape(-1, len(x0)).dot(recentring(x0))
            variances = np.repeat(noise[fits], 2)
            full = self.gain(H, variances)
            K = self._held(full)
            self.full_correction = full.dot(sight.residual[fits].ravel() + H.dot(x0))
            dx = self._held(self.full_correction)
            distance = float(sight.distance[fits].min())
            last, x0 = x0, dx if _bend(dx, distance) >= RELINEARISATION_ANGLE else dx / 2
            if step > 0 and _bend(x0 - last, distance) < RELINEARISATION_ANGLE:
                break
        self._put(before, np.zeros(len(x0)))
        self.full_covariance = full.dot(H).dot(self.P)
        self.condense(K, H, variances)
        self.shift_about(dx)
        return noise

    def _judge(self, sight: Sight, noise: Array, fits: NDArray[np.bool_]) -> None:
        """Let bearings to members count that fit what those before them, to landmarks first, leave of the belief."""
        P, x = self.P, np.zeros(len(self.P))
        for k in np.flatnonzero(fits):
            H = sight.H[k]
            S, r = H.dot(P).dot(H.T) + noise[k] * np.eye(2), sight.residual[k] - H.dot(x)
            if H[:, 6 * self.others :].any() and r.dot(np.linalg.solve(S, r)) > BEARING_GATE:
                fits[k] = False
            else:
                K = np.linalg.solve(S, H.dot(P)).T
                x, P = x + K.dot(r), P - K.dot(H).dot(P)

    def _held(self, corrections: Array) -> Array:
        """Return corrections (6n, ...) without those of members that are considered."""
        held = corrections.copy()
        for n, member in enumerate(self.members):
            if member.considered:
                held[6 * n : 6 * n + 6] = 0.0
        return held

    def _put(self, poses: list[tuple[Array, Array]], error: Array) -> None:
        """Put the members at poses moved by errors."""
        for member, (R, p) in zip(self.members, poses, strict=True):
            member.R, member.p = R, p
        self.shift(error)

    def enlarge(self, n: int, variance: float) -> None:
        """Let a member's position be uncertain by a variance per axis more, with all that depends on its error."""
        block = slice(6 * n, 6 * n + 6)
        A = np.linalg.solve(self.P[block, block], self.P[block]).T[:, 3:]
        self.P = self.P + variance * A.dot(A.T)

    def gain(self, H: Array, noise: Array) -> Array:
        """Return the Kalman gain K (6n, m) of measurements H x + noise of variances (m,)."""
        PHt = self.P.dot(H.T)
        S = H.dot(PHt)
        S.flat[:: len(S) + 1] += noise
        return solve_positive(S, PHt.T).T

    def condense(self, K: Array, H: Array, noise: Array) -> None:
        """Let the covariance be that after measurements H x + noise with gain K."""
        A = -K.dot(H)
        A.flat[:: len(A) + 1] += 1.0
        P = A.dot(self.P).dot(A.T) + (K * noise).dot(K.T)
        self.P = (P + P.T) / 2

    def inform(self, index: NDArray[np.int64], information: Array, vector: Array) -> None:
        """Take information about some errors x: their likelihood has the exponent vector^T x - x^T information x / 2.

        Args:
            index: (m,) which errors.
            information: (m, m).
            vector: (m,).
        """
        columns = self.P.take(index, axis=1)
        L = cholesky(columns.take(index, axis=0))
        least = np.linalg.eigvalsh(L.T.dot(information).dot(L))[0] if len(index) == 6 else 0.0
        if not 1.0 + least > 1.0 / MAX_GROWTH:
            return
        A = columns.take(index, axis=0).dot(information)
        A.flat[:: len(A) + 1] += 1.0
        W = solve(A, np.eye(len(A)))
        M = information.dot(W)
        P = self.P - columns.dot((M + M.T) / 2).dot(columns.T)
        self.P = (P + P.T) / 2
        self.shift_about(columns.dot(vector.dot(W)))

    def shift_about(self, dx: Array) -> None:
        """Move the poses by the error dx, and let the covariance be about where they are then."""
        G = recentring(dx)
        if self.errors is not None:
            G[6:12] = 0.0
            G[6:12, 6:12] = np.eye(6)
            self.errors.w, self.errors.v = self.errors.w + dx[6:9], self.errors.v + dx[9:12]
        self.P = G.dot(self.P).dot(G.T)
        self.shift(dx)

    def shift(self, dx: Array) -> None:
        """Move the poses of the first members by their part of the error dx (6m,)."""
        for n in range(len(dx) // 6):
            member = self.members[n]
            if member.vehicle != ERRORS:
                member.p = member.p + member.R.dot(dx[6 * n + 3 : 6 * n + 6])
                member.R = member.R.dot(exp_so3(dx[6 * n : 6 * n + 3]))


def recentring(dx: Array) -> Array:
    """Return (6n, 6n) the derivative of errors about poses moved by errors dx (6n,) by those about them before."""
    G = np.zeros((len(dx), len(dx)))
    for n in range(0, len(dx), 6):
        w = dx[n : n + 3]
        x, S = max(float(np.linalg.norm(w)), 1e-6), skew(w)
        G[n : n + 3, n : n + 3] = np.eye(3) - (1 - np.cos(x)) / x**2 * S + (x - np.sin(x)) / x**3 * S @ S
        G[n + 3 : n + 6, n + 3 : n + 6] = exp_so3(-w)
    return G


def averaging_time(noise: SensorNoise) -> float:
    """Return over which time a velocity by odometry is averaged, s."""
    return float((noise.odometry(1.0)[3] / (4.0 * MAX_ACCELERATION**2)) ** (1.0 / 3.0))


def errors_of(members: Sequence[int]) -> NDArray[np.int64]:
    """Return (6m,) the indices of the errors of some members."""
    return np.concatenate([np.arange(6 * n, 6 * n + 6) for n in members])


def _bend(dx: Array, distance: float) -> float:
    """Return by how much errors (6n,) turn lines of sight of a length, rad."""
    errors = np.abs(dx).reshape(-1, 6)
    return float(max(errors[:, :3].max(), errors[:, 3:].max() / distance))
