"""What vehicles tell each other, and the new information between two messages of the same sender.

A sender tells its pose, the covariance of it, and its odometry: where it would be by dead reckoning alone. So a
receiver can carry the sender's last message to the new one as the sender itself did, P- = F P F^T + Q, and what the
sender has learnt in between is P^-1 - P-^-1, whatever messages were lost on the way. Source: the information
decorrelation of tracklets, Drummond, Tracklets and a hybrid fusion with process noise, SPIE 3163, 1997; the channel
filter of Grime and Durrant-Whyte, Data fusion in decentralized sensor networks, Control Engineering Practice 2(5),
1994.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coopenv.estimation.arrays import Array
from coopenv.estimation.rotations import exp_so3, log_so3, orthonormalise, skew
from coopenv.observers.contract import Message, SensorNoise
from coopenv.observers.mekf import LeftError
from coopenv.observers.robust.constants import ERRORS_TIME, MASK_BITS
from tests.oracles.robust.belief import Belief, Member, recentring
from tests.oracles.robust.matrices import invert_positive
from tests.oracles.robust.odometry import as_noise


def mask_of(vehicles: set[int]) -> np.uint64:
    """Return a set of vehicles as bits; numbers from 64 on share bits with lower ones."""
    bits = 0
    for vehicle in vehicles:
        bits |= 1 << (vehicle % MASK_BITS)
    return np.uint64(bits)


@dataclass(frozen=True)
class Report:
    """Poses of some vehicles as one of them knows them, the sender first; left errors, rad and m."""

    vehicles: tuple[int, ...]
    time: Array  # (m,) s, at which each stands
    R: Array  # (m, 3, 3)
    p: Array  # (m, 3) m, map frame, of the marker
    odometry_turn: Array  # (m, 3, 3) by dead reckoning from the start, in a frame of its own
    odometry_position: Array  # (m, 3) m, of the marker
    P: Array  # (6m, 6m)
    depends_on: int
    """Bits of all vehicles whose messages are in it."""

    @property
    def rank(self) -> tuple[int, int]:
        """What is larger for who depends on more others, and then for later ones."""
        return self.depends_on.bit_count(), self.vehicles[0]

    def depends_on_vehicle(self, vehicle: int) -> bool:
        """Return whether what it says may be a vehicle's own words."""
        return bool(self.depends_on & int(mask_of({vehicle})))

    def motion_since(self, last: Report, n: int) -> tuple[Array, Array]:
        """Return member n's odometry increment (dR, dp) since the last report."""
        R = last.odometry_turn[n].T
        return R.dot(self.odometry_turn[n]), R.dot(self.odometry_position[n] - last.odometry_position[n])


@dataclass(frozen=True)
class Tracklet:
    """What a sender has learnt between two reports: vector^T x - x^T information x / 2, x about (R, p)."""

    R: Array  # (m, 3, 3) the last report carried on by odometry
    p: Array  # (m, 3)
    information: Array  # (6m, 6m)
    vector: Array  # (6m,)

    def about(self, members: list[Member]) -> tuple[Array, Array]:
        """Return information (6m, 6m) and vector (6m,) for errors about other poses."""
        offset = np.concatenate([left_error(R, p, m.R, m.p) for R, p, m in zip(self.R, self.p, members, strict=True)])
        A = recentring(-offset)  # backwards, to second order
        return A.T.dot(self.information).dot(A), A.T.dot(self.vector - self.information.dot(offset))


def tracklet(last: Report, new: Report, noise: SensorNoise, errors: Array | None = None) -> Tracklet | None:
    """Return what was learnt between two reports of the same vehicles; None if the later one knows less.

    Errors of the odometry that last are taken to have the covariance (6, 6) of one's own.
    """
    m = len(new.vehicles)
    F, Q = np.zeros_like(new.P), np.empty(6 * m)
    R, p, c = np.empty_like(new.R), np.empty_like(new.p), np.empty(6 * m)
    for n in range(m):
        block = slice(6 * n, 6 * n + 6)
        dR, dp = new.motion_since(last, n)
        F[block, block] = LeftError.transition(dR, dp)
        dt = max(new.time[n] - last.time[n], 0.0)
        Q[block] = noise.odometry(dt) + as_noise(errors, dp, dt, ERRORS_TIME)
        R[n], p[n] = orthonormalise(last.R[n].dot(dR)), last.p[n] + last.R[n].dot(dp)
        c[block] = left_error(R[n], p[n], new.R[n], new.p[n])
    before = F.dot(last.P).dot(F.T)
    before.flat[:: 6 * m + 1] += Q
    if (new.P.diagonal() > 1.01 * before.diagonal()).any():
        return None
    G = recentring(c)
    after = G.T.dot(invert_positive(new.P)).dot(G)
    return Tracklet(R, p, after - invert_positive(before), after.dot(c))


def left_error(R: Array, p: Array, R_other: Array, p_other: Array) -> Array:
    """Return (6,) the left error of the other pose against (R, p)."""
    return np.concatenate([log_so3(R.T.dot(R_other)), R.T.dot(p_other - p)])


def seen_at(marker: Array, R: Array, p: Array, P: Array) -> tuple[Array, Array]:
    """Return position and covariance of a pose moved to the marker, which is what the others see."""
    if not marker.any():
        return p, P
    J = marker_jacobian(marker)
    return p + R.dot(marker), J.dot(P).dot(J.T)


def marker_jacobian(marker: Array) -> Array:
    """Return (6, 6) the derivative of the left error at a point of the body by that at its origin."""
    J = np.eye(6)
    J[3:, :3] = -skew(marker)
    return J


def to_message(belief: Belief, marker: Array, odometry: tuple[Array, Array], depends_on: int) -> Message:
    """Return a vehicle's own pose and covariance, its odometry, and on whom it leans; 196 bytes in all.

    The covariance travels in single precision.
    """
    own = belief.own
    p, P = seen_at(marker, own.R, own.p, belief.P[:6, :6])
    return Message(
        position=p,
        rotation=own.R,
        covariance=P.astype(np.float32),
        extra={
            "odometry": np.concatenate([log_so3(odometry[0]), odometry[1] + odometry[0].dot(marker)]),
            "depends_on": np.array([depends_on], dtype=np.uint64),
        },
    )


def from_message(message: Message, sender: int, time: float) -> Report | None:
    """Return what a message says; None if it is not one of ours or its sender does not know where it is."""
    if message.position is None or message.rotation is None or message.covariance is None:
        return None
    if len(message.covariance) != 6 or "odometry" not in message.extra:
        return None
    odometry = np.asarray(message.extra["odometry"], float)
    return Report(
        vehicles=(sender,),
        time=np.array([time]),
        R=message.rotation[None],
        p=message.position[None],
        odometry_turn=exp_so3(odometry[:3])[None],
        odometry_position=odometry[None, 3:],
        P=np.asarray(message.covariance, float),
        depends_on=int(message.extra["depends_on"][0]),
    )
