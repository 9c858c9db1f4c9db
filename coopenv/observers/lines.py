"""What the filters of the zoo have of a frame: lines of sight, their residuals and derivatives, and whether they fit.

With a = Rhat^T (z - phat), d = a - c the line from the camera c to the point z, and B a tangent basis at d / |d|, the
residual of a bearing b is B b, and its derivative by the line J = B / |d|.
"""

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from coopenv.estimation.arrays import Array
from coopenv.estimation.rotations import lengths, tangent_basis
from coopenv.observers.contract import Message, Tick

PLANE = np.eye(2)


class Pose(Protocol):
    """A pose with an error about it."""

    @property
    def R(self) -> Array:  # noqa: N802
        """(3, 3) body to map."""

    @property
    def p(self) -> Array:
        """(3,) map frame, m."""

    def jacobian(self, positions: Array) -> Array:
        """Return (m, 3, n) the derivative of the lines to map positions (m, 3) by the error."""


class Sight(NamedTuple):
    """The bearings of a frame that can be used."""

    bearings: Array  # (m, 3) unit vectors, body frame
    positions: Array  # (m, 3) of the points, as known or told, map frame, m
    covariances: Array  # (m, 3, 3) of the points, m^2, zero where they are known or nothing is stated
    targets: NDArray[np.int64]  # (m,)
    messages: tuple[Message | None, ...]  # (m,) None for landmarks

    def only(self, kept: NDArray[np.bool_]) -> "Sight":
        """Return those of a mask (m,)."""
        messages = tuple(message for message, keep in zip(self.messages, kept.tolist(), strict=True) if keep)
        return Sight(self.bearings[kept], self.positions[kept], self.covariances[kept], self.targets[kept], messages)


class Lines(NamedTuple):
    """Bearings, linearised."""

    residual: Array  # (m, 2) rad, in the tangent planes
    H: Array  # (m, 2, n) derivative of what is measured by the error
    N: Array  # (m, 2, 2) rad^2, covariance of the residuals given one's own pose

    def only(self, kept: NDArray[np.bool_]) -> "Lines":
        """Return those of a mask (m,)."""
        return Lines(self.residual[kept], self.H[kept], self.N[kept])

    def spread(self, P: Array) -> Array:
        """Return (m, 2, 2) the covariances of the innovations, given that of the error (n, n)."""
        return np.asarray(self.H @ P @ self.H.transpose(0, 2, 1) + self.N)

    def stacked(self) -> tuple[Array, Array, Array]:
        """Return the residual (2m,), H (2m, n) and N (2m, 2m)."""
        return self.residual.ravel(), self.H.reshape(-1, self.H.shape[-1]), dense(self.N)


def sight_of(tick: Tick, weighed: bool = True) -> Sight | None:
    """Return what can be used of a frame, None where there is nothing; `weighed`: with the covariances told."""
    seen = tick.usable()
    if not seen:
        return None
    covariances = np.zeros((len(seen), 3, 3))
    if weighed:
        for n, (*_, message) in enumerate(seen):
            if message is not None and message.covariance is not None:
                covariances[n] = point_covariance(message)
    targets, bearings, positions, messages = zip(*seen, strict=True)
    return Sight(np.array(bearings), np.array(positions), covariances, np.array(targets), messages)


def point_covariance(message: Message) -> Array:
    """Return the covariance (3, 3) in map axes of the position that a message tells, from whatever it states."""
    if message.covariance is None or len(message.covariance) == 3 or message.rotation is None:
        return np.zeros((3, 3)) if message.covariance is None else message.covariance[:3, :3]
    R = message.rotation
    return np.asarray(R.dot(message.covariance[3:, 3:]).dot(R.T))


def innovation(R: Array, p: Array, lever_arm: Array, bearings: Array, positions: Array) -> tuple[Array, Array]:
    """Return (residual (m, 2), J (m, 2, 3)): tangent residuals and their derivative by the line d in the body frame."""
    d = (positions - p).dot(R) - lever_arm
    distance = np.maximum(lengths(d), 1e-9)[:, None]
    B = tangent_basis(d / distance)
    return (B @ bearings[..., None])[..., 0], B / distance[..., None]


def linearised(pose: Pose, tick: Tick, sight: Sight) -> Lines:
    """Return the lines at a pose; the points' covariances are noise, as if independent of the pose."""
    residual, J = innovation(pose.R, pose.p, tick.lever_arm, sight.bearings, sight.positions)
    return Lines(residual, J @ pose.jacobian(sight.positions), noise(pose.R, J, tick, sight))


def noise(R: Array, J: Array, tick: Tick, sight: Sight) -> Array:
    """Return (m, 2, 2) the covariances of the residuals given one's own pose; J as from `innovation`."""
    G = J.dot(R.T)
    return np.asarray(G @ sight.covariances @ G.transpose(0, 2, 1) + tick.noise.bearing_std**2 * PLANE)


def ahead(pose: Pose, tick: Tick, sight: Sight) -> NDArray[np.bool_]:
    """Return (m,) whether the points are where the bearings point, and not opposite."""
    d = (sight.positions - pose.p).dot(pose.R) - tick.lever_arm
    return np.asarray((d * sight.bearings).sum(1) > 0.0)


def normalised(residual: Array, S: Array) -> Array:
    """Return (m,) r^T S^-1 r of residuals (m, 2)."""
    x, y = residual.T
    a, b, d = S[:, 0, 0], S[:, 0, 1], S[:, 1, 1]
    return np.asarray((d * x * x - 2.0 * b * x * y + a * y * y) / (a * d - b * b))


def dense(blocks: Array) -> Array:
    """Return (2m, 2m) the block diagonal of blocks (m, 2, 2)."""
    m = len(blocks)
    N = np.zeros((m, 2, m, 2))
    each = np.arange(m)
    N[each, :, each, :] = blocks
    return N.reshape(2 * m, 2 * m)
