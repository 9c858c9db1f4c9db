"""The posterior Cramer-Rao lower bound of a scenario: the least mean error of any observer of the same measurements.

Source: Tichavsky, Muravchik and Nehorai, Posterior Cramer-Rao bounds for discrete-time nonlinear filtering, IEEE
Transactions on Signal Processing 46(5), 1998, on the stacked left errors of all vehicles (R = Rhat Exp(theta),
p = phat + Rhat rho), linearised at the truth:

    J_{k+1} = (F_k J_k^-1 F_k^T + Q_k)^-1 + sum over visible (i, j) of H_ij^T N_ij^-1 H_ij.

Noise that is not Gaussian, as the paper's on the image plane, counts with its covariance: then it is the bound of what
is linear in the measurements. Without noise of bearings there is none, and every entry is NaN.

The edges are those that were realised, so the bound is conditional on them: average it over seeds. It is first order in
the orientation, meaningful below about 10 deg, and does not count the information in missed targets. It bounds the
problem in which all vehicles have all data, whatever was delivered.

Lasting errors of odometry, cameras and clocks that are declared in the setups are states of it, too.

Counted are the odometry's scale, the gyro's bias, how the camera is mounted, and the clocks. Slips and errors of the
focal length are left out: with them the bound would be higher.
"""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from coopenv.estimation.poses import Array, skew
from coopenv.observers.recording import Recording

ERRORS = 11
"""Errors of a vehicle: scale of the odometry (relative), bias of the gyro (3, rad/s), orientation (3, rad) and place
(3, m) of the camera in body axes, offset of the clock (s)."""


@dataclass(frozen=True)
class ErrorStates:
    """Which errors the vehicles of a record have, beside those of their poses."""

    kept: list[int]  # (e,) of `ERRORS`, those that any vehicle has
    variance: Array  # (N, e) at the start
    walk: Array  # (N, e) by which it grows, 1/s

    @property
    def count(self) -> int:
        """How many a vehicle has."""
        return len(self.kept)

    def over_step(self, turned: Array, step: Array, dt: float) -> Array:
        """Return (..., 6, e) what the pose's left error gets over a tick from the errors, to first order.

        Args:
            turned: (..., 3, 3) body at the start to body at the end.
            step: (..., 3) displacement, body at the start, m.
            dt: s.
        """
        made = np.zeros((*step.shape[:-1], 6, ERRORS))
        made[..., 3:, :1] = -turned @ step[..., None]
        made[..., :3, 1:4] = -dt * np.eye(3)
        return made[..., self.kept]

    def in_bearings(self, u: Array, across: Array) -> Array:
        """Return (K, 3, e) what a bearing gets from its own vehicle's errors, its clock apart.

        Args:
            u: (K, 3) unit bearings, body frame.
            across: (K, 3, 3) the derivative of a bearing by the line to the target.
        """
        made = np.zeros((len(u), 3, ERRORS))
        made[..., 4:7], made[..., 7:10] = skew(u), -across
        return made[..., self.kept]

    def of_clock(self, motion: Array) -> Array:
        """Return (K, 3, e) what a bearing gets from a clock that is off, given its derivative by time (K, 3)."""
        made = np.zeros((len(motion), 3, ERRORS))
        made[..., 10] = motion
        return made[..., self.kept]


def error_states(recording: Recording) -> ErrorStates:
    """Return the declared errors of the vehicles of a record."""
    std, walk = np.zeros((2, len(recording.setups), ERRORS))
    for i, noise in enumerate(setup.noise for setup in recording.setups):
        camera = [noise.camera_orientation] * 3 + [noise.camera_position] * 3
        std[i] = [noise.odometry_scale, *noise.gyro_bias, *camera, noise.clock_offset]
        walk[i, :4] = [noise.odometry_scale_walk, *noise.gyro_bias_walk]
    kept = np.flatnonzero((std + walk).any(axis=0)).tolist()
    return ErrorStates(kept, std[:, kept] ** 2, walk[:, kept] ** 2)


BLOCK = 10_000_000
"""Numbers of the matrices over all vehicles that are kept at a time."""

EXACT, COARSE = 12, 0.1
"""Of more vehicles than that the ticks of 0.1 s count as one, half of the odometry's noise before what they measured
and half after it: six times as fast, and less than 1 % off (`tests/observers/test_bound.py`)."""


@dataclass(frozen=True)
class Bound:
    """Lower bounds on the standard deviations at each tick."""

    t: Array  # (K,) s
    position: Array  # (K, N) m: sqrt(trace) of the position's block
    orientation: Array  # (K, N) deg: sqrt(trace) of the orientation's block
    covariance: Array  # (K, N, 6, 6) left errors, rad and m

    def position_rms(self, after: float = 0.0) -> Array:
        """Return (N,) the root mean square of the position's bound from a time on, m."""
        return np.asarray(np.sqrt(np.mean(self.position[self.t >= after] ** 2, axis=0)))


def cramer_rao(recording: Recording, joint: bool = True) -> Bound:
    """Return the bound of a record: of its truth, visible edges, noise and initial covariance.

    It is joint, over all vehicles, whose poses are all unknown, or that of each vehicle alone, as if its neighbours'
    poses were known exactly.
    """
    N = len(recording.setups)
    groups = [range(N)] if joint else [[i] for i in range(N)]
    return _bound(recording, _covariances(recording, groups, joint).reshape(recording.ticks, N, 6, 6))


def cramer_rao_ancestors(recording: Recording) -> Bound:
    """Return, for each vehicle, the joint bound over it and its ancestors: all whose messages can reach it.

    It counts the measurements of these vehicles alone. A decentralised observer with messages along the graph has no
    further information, whereas the bound over all vehicles also counts measurements of followers for their leaders.
    """
    N = len(recording.setups)
    blocks = np.empty((recording.ticks, N, 6, 6))
    families = [ancestors(recording, i) for i in range(N)]
    for family in sorted(set(families)):
        P = _covariances(recording, [family])[:, 0]
        for i in (i for i in range(N) if families[i] == family):
            blocks[:, i] = P[:, family.index(i)]
    return _bound(recording, blocks)


def ancestors(recording: Recording, vehicle: int) -> tuple[int, ...]:
    """Return a vehicle, its neighbours, theirs, and so on, sorted."""
    found, waiting = set(), {vehicle}
    while waiting:
        i = waiting.pop()
        found.add(i)
        targets = recording.setups[i].targets - recording.setups[i].landmarks
        waiting |= {int(j) for j in targets if j >= 0} - found
    return tuple(sorted(found))


def _covariances(recording: Recording, groups: Sequence[Sequence[int]], joint: bool = True) -> Array:
    """Return (K, g, n, 6, 6) the bounds of g groups of n vehicles, those of a group estimated together.

    A group counts what its own vehicles measure; `joint`: their neighbours' poses are unknown.
    """
    errors = error_states(recording)
    w = 6 + errors.count
    part = (w * np.asarray(groups)[..., None] + np.arange(w)).reshape(len(groups), -1)
    members, used = np.asarray(groups), sorted({i for group in groups for i in group})
    pairs = zip(recording.start_covariance, errors.variance, strict=True)
    start = [block_diag(P, np.diag(variance)) for P, variance in pairs]
    P = np.array([block_diag(*(start[i] for i in group)) for group in groups])
    dt, walks = recording.dt, zip(recording.setups, errors.walk, strict=True)
    Q = np.array([np.diag(np.concatenate([setup.noise.odometry(dt), dt * walk])) for setup, walk in walks])
    own = np.arange(part.shape[1]).reshape(-1, w)
    rows, columns = own[:, :, None], own[:, None, :]
    blocks = np.empty((recording.ticks, len(groups), len(own), 6, 6))
    blocks[0] = P[:, rows, columns][..., :6, :6]
    identity = np.eye(part.shape[1])
    at_once = 1 if len(own) <= EXACT else max(1, round(COARSE / recording.dt))
    for ticks in _stretches(recording, at_once, w):
        E, M = steps(recording, ticks, errors), information(recording, joint, used, ticks, errors)
        M[~recording.due[ticks.start : ticks.stop]] = 0.0
        for first in range(0, len(ticks), at_once):
            last = min(first + at_once, len(ticks))
            moved, noise, info = _together(E[first:last], M[first:last], Q) if at_once > 1 else (E[first], Q, M[first])
            after = 0.5 * (1.0 - 1.0 / (last - first))  # of the noise, so that the error is of second order
            P = _moved(P, moved[members])
            P[:, rows, columns] += (1.0 - after) * noise[members]
            info = info[part[:, :, None], part[:, None, :]]
            if info.any():
                # (P^-1 + M)^-1 without the inverse of P, which may be ill-conditioned: P (I + M P)^-1
                P = np.linalg.solve(identity + P @ info, P)
                P = (P + np.swapaxes(P, -1, -2)) / 2
            P[:, rows, columns] += after * noise[members]
            k, parts = ticks.start + first, np.linspace(0.0, 1.0, last - first + 1)[1:, None, None, None, None]
            poses = P[:, rows, columns][..., :6, :6]
            blocks[k : ticks.start + last] = blocks[k - 1] + parts * (poses - blocks[k - 1])
    return blocks


def _together(E: Array, M: Array, Q: Array) -> tuple[Array, Array, Array]:
    """Return motion, noise (N, w, w) and information (wN, wN) of some ticks as one, over the errors at the last one.

    All of them measure what that in their middle does: each by itself, carried on without the noise in between, would
    count a parallax that the noise hides.
    """
    on = np.broadcast_to(np.eye(Q.shape[-1]), Q.shape)  # from a tick to the last one
    noise, info, middle = np.zeros_like(Q), M[0], len(E) // 2
    for k in reversed(range(len(E))):
        if k == middle:
            info = len(E) * _moved(M[k][None], np.swapaxes(np.linalg.inv(on), -1, -2)[None])[0]
        noise += on @ Q @ np.swapaxes(on, -1, -2)
        on = on @ E[k]
    return on, noise, info


def _stretches(recording: Recording, multiple: int, width: int) -> Iterator[range]:
    """Yield the ticks after the start in stretches, each of which needs little memory, of a multiple of so many."""
    most = multiple * max(1, BLOCK // (width * len(recording.setups)) ** 2 // multiple)
    for first in range(1, recording.ticks, most):
        yield range(first, min(first + most, recording.ticks))


def _moved(P: Array, E: Array) -> Array:
    """Return E P E^T of covariances P (g, w n, w n), E being block diagonal with blocks (g, n, w, w)."""
    g, n, w = E.shape[:3]
    half = (E @ P.reshape(g, n, w, w * n)).reshape(P.shape)
    return np.asarray((E @ np.swapaxes(half, -1, -2).reshape(g, n, w, w * n)).reshape(P.shape))


def _bound(recording: Recording, blocks: Array) -> Bound:
    if any(setup.noise.bearing == 0.0 for setup in recording.setups):
        blocks = np.full_like(blocks, np.nan)
    trace = np.trace(blocks[..., 3:, 3:], axis1=-2, axis2=-1)
    angle = np.trace(blocks[..., :3, :3], axis1=-2, axis2=-1)
    return Bound(recording.t, np.sqrt(trace), np.degrees(np.sqrt(angle)), blocks)


def steps(recording: Recording, ticks: range, errors: ErrorStates | None = None) -> Array:
    """Return (k, N, w, w) how each vehicle's errors go on over its true motion into some ticks.

    They are the left error of its pose (w = 6), and after it further `errors`. Of tick 0 it is the identity.
    """
    R, p = recording.truth.rotation, recording.truth.position
    into = np.array(ticks)
    before = np.maximum(into - 1, 0)
    back = np.swapaxes(R[before], -1, -2)
    E = np.swapaxes(R[into], -1, -2) @ R[before]
    way = (back @ (p[into] - p[before])[..., None])[..., 0]
    more = 0 if errors is None else errors.count
    made = np.zeros((*E.shape[:2], 6 + more, 6 + more))
    made[..., :3, :3] = made[..., 3:6, 3:6] = E
    made[..., 3:6, :3] = -E @ skew(way)
    if errors is not None:
        made[..., 6:, 6:] = np.eye(more)
        made[..., :6, 6:] = errors.over_step(E, way, recording.dt) * (into > 0)[:, None, None, None]
    return made


def information(
    recording: Recording,
    joint: bool = True,
    observers: Collection[int] | None = None,
    ticks: range | None = None,
    errors: ErrorStates | None = None,
) -> Array:
    """Return sum of H^T N^-1 H (k, wN, wN) over the visible edges at each tick, linearised at the truth.

    `joint`: a neighbour's pose is unknown, too; `observers`: the vehicles that measure, None: all; `ticks`: at
    which ones, None: at all; `errors`: what is unknown beside the poses, for which w = 6.
    """
    ticks = range(recording.ticks) if ticks is None else ticks
    wanted, w = slice(ticks.start, ticks.stop), 6 + (0 if errors is None else errors.count)
    R, p, landmarks = recording.truth.rotation[wanted], recording.truth.position[wanted], recording.landmarks[wanted]
    visible = recording.visible[wanted]
    K, N = R.shape[:2]
    L = recording.landmarks.shape[1]
    M = np.zeros((K, w * N, w * N))
    minus = np.broadcast_to(-np.eye(3), (K, 3, 3))
    for i, setup in enumerate(recording.setups):
        if observers is not None and i not in observers:
            continue
        own = slice(w * i, w * i + w)
        Rt = np.swapaxes(R[:, i], -1, -2)
        for target in setup.targets:
            j = int(target) - L
            marker = recording.setups[j].marker if j >= 0 else np.zeros(3)
            z = landmarks[:, target] if j < 0 else p[:, j] + R[:, j] @ marker
            a = (Rt @ (z - p[:, i])[..., None])[..., 0]
            d = a - setup.lever_arm
            distance = np.maximum(np.linalg.norm(d, axis=-1), 1e-9)
            u = d / distance[:, None]
            across = (np.eye(3) - u[:, :, None] * u[:, None, :]) / distance[:, None, None]
            weight = visible[:, i, target, None, None] * setup.noise.bearing_information(u)
            Hi = across @ np.concatenate([skew(a), minus], axis=-1)
            known, moved = j < 0 or not joint, np.zeros((K, 3, 0))
            if errors is not None:
                Hi = np.concatenate([Hi, errors.in_bearings(u, across)], axis=-1)
            if errors is not None and not known:  # a report is dated by the sender's clock
                there = recording.truth.position[:, j] + recording.truth.rotation[:, j] @ marker
                at = np.maximum(ticks, 1)
                v = (there[at] - there[at - 1]) / recording.dt  # m/s
                moved = errors.of_clock((across @ Rt @ v[..., None])[..., 0])
                Hi[..., 6:] -= moved
            Hi_t = np.swapaxes(Hi, -1, -2) @ weight
            M[:, own, own] += Hi_t @ Hi
            if known:
                continue
            other = slice(w * j, w * j + w)
            Hj = across @ Rt @ R[:, j] @ np.hstack([-skew(marker), np.eye(3)])
            Hj = np.concatenate([Hj, moved], axis=-1)
            Hj_t = np.swapaxes(Hj, -1, -2) @ weight
            M[:, other, other] += Hj_t @ Hj
            M[:, own, other] += Hi_t @ Hj
            M[:, other, own] += Hj_t @ Hi
    return M
