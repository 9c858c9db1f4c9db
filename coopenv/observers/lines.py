"""What the filters of the zoo have of a frame: lines of sight, their residuals and derivatives, and whether they fit.

With a = Rhat^T (z - phat), d = a - c the line from the camera c to the point z, and B a tangent basis at d / |d|, the
residual of a bearing b is B b, and its derivative by the line J = B / |d|.
"""

import math
from collections.abc import Sequence
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

    @property
    def right(self) -> bool:
        """Whether the error is about the map's axes, R = Exp(theta) Rhat, and not about the body's."""


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
    G: Array  # (m, 2, 3) derivative of what is measured by the points, map axes, rad/m

    def only(self, kept: NDArray[np.bool_]) -> "Lines":
        """Return those of a mask (m,)."""
        return Lines(self.residual[kept], self.H[kept], self.N[kept], self.G[kept])

    def weighed(self, bearing_std: float, factor: float) -> Array:
        """Return N if the points' covariances were so many times larger."""
        own = bearing_std**2 * PLANE
        return np.asarray(own + (self.N - own) * factor)

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
    if len(sight.bearings) == 1:
        return _one(pose, tick, sight)
    residual, J = innovation(pose.R, pose.p, tick.lever_arm, sight.bearings, sight.positions)
    G = J.dot(pose.R.T)
    N = G @ sight.covariances @ G.transpose(0, 2, 1) + tick.noise.bearing_std**2 * PLANE
    return Lines(residual, J @ pose.jacobian(sight.positions), N, G)


def _one(pose: Pose, tick: Tick, sight: Sight) -> Lines:
    """Return what `linearised` does of one line, in numbers of Python: NumPy's calls take twice as long.

    With the rows j of J, and g = R j, the derivative by a left error is (j x a, -j), by a right one (g x z, -g).
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = pose.R.tolist()
    px, py, pz = pose.p.tolist()
    cx, cy, cz = tick.lever_arm.tolist()
    point, b = sight.positions[0].tolist(), sight.bearings[0].tolist()
    x, y, z = point[0] - px, point[1] - py, point[2] - pz
    a = (xx * x + yx * y + zx * z, xy * x + yy * y + zy * z, xz * x + yz * y + zz * z)
    x, y, z = a[0] - cx, a[1] - cy, a[2] - cz
    near = 1.0 / max(math.sqrt(x * x + y * y + z * z), 1e-9)
    basis = _across(x * near, y * near, z * near)
    rows = [(u * near, v * near, w * near) for u, v, w in basis]
    mapped = [(xx * u + xy * v + xz * w, yx * u + yy * v + yz * w, zx * u + zy * v + zz * w) for u, v, w in rows]
    H = [_derivative(row, point) for row in mapped] if pose.right else [_derivative(row, a) for row in rows]
    N = _spread(mapped, sight.covariances[0].tolist(), tick.noise.bearing_std**2)
    residual = [u * b[0] + v * b[1] + w * b[2] for u, v, w in basis]
    return Lines(np.array([residual]), np.array([H]), np.array([N]), np.array([mapped]))


Row = tuple[float, float, float]


def _across(x: float, y: float, z: float) -> tuple[Row, Row]:
    """Return the rows of `tangent_basis` of one unit vector."""
    sign = math.copysign(1.0, z)
    t = -1.0 / (sign + z)
    c = x * y * t
    return (1.0 + sign * x * x * t, sign * c, -sign * x), (c, sign + y * y * t, -y)


def _derivative(row: Row, about: Sequence[float]) -> tuple[float, ...]:
    (u, v, w), (x, y, z) = row, about
    return v * z - w * y, w * x - u * z, u * y - v * x, -u, -v, -w


def _spread(rows: list[Row], C: list[list[float]], variance: float) -> list[list[float]]:
    """Return (2, 2) the rows' covariance of a point of covariance C (3, 3), and the bearing's."""
    if not (C[0][0] or C[1][1] or C[2][2]):
        return [[variance, 0.0], [0.0, variance]]
    (u, v, w), q = rows
    (a, b, c), (d, e, f), (g, h, i) = C
    p = (u * a + v * d + w * g, u * b + v * e + w * h, u * c + v * f + w * i)
    r = (q[0] * a + q[1] * d + q[2] * g, q[0] * b + q[1] * e + q[2] * h, q[0] * c + q[1] * f + q[2] * i)
    off = p[0] * q[0] + p[1] * q[1] + p[2] * q[2]
    return [
        [p[0] * u + p[1] * v + p[2] * w + variance, off],
        [r[0] * u + r[1] * v + r[2] * w, r[0] * q[0] + r[1] * q[1] + r[2] * q[2] + variance],
    ]


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
