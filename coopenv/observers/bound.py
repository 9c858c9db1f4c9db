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

Errors that the setups declare are states of it, too, behind those of the poses; derivatives are those of the true
bearing u (unit vector, body axes) to a target at z (map), seen from a = R^T (z - p), d = a - lever arm, with the
projection B = (I - u u^T) / |d|:

- per vehicle, each with the standard deviation and the walk that its noise states: scale of the odometry, bias of the
  gyro, orientation (S(u)) and place (-B) of the camera, offset of the clock (+- B R^T dz/dt between vehicles);
- latency of its frames, with the derivative c = -B (S(a) w - v) - B R^T dz/dt of a bearing. The twist (w, v) and the
  velocity of the target are differences of the true poses over the tick: w = log(R_{k-1}^T R_k) / dt, v = R_k^T (p_k -
  p_{k-1}) / dt;
- jitter of the latency, with the same derivative c: a state whose transition is 0 and whose variance is new at every
  tick, so that the bearings of a frame have a common error;
- the map: three states for each landmark with a standard deviation, in map axes, constant and common to all vehicles,
  with the derivative B R^T of a bearing to it; of other sensors their derivative by the target.

Slips and errors of the focal length are left out: with them the bound would be higher. So is a known age of a frame,
which changes the bound by second-order terms alone.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from coopenv.estimation.poses import Array, skew
from coopenv.measurements.kinds import Landmarks, Placed
from coopenv.measurements.sensor import COMPARED_AT, MAP, LinearRows, Sensor, landmark_place
from coopenv.observers.recording import Recording

ERRORS = 13
"""Errors of a vehicle: scale of the odometry (relative), bias of the gyro (3, rad/s), orientation (3, rad) and place
(3, m) of the camera in body axes, offset of the clock (s), latency and its jitter (s)."""
CLOCK, LATENCY, JITTER = 16, 17, 18
"""Places of the last of these errors among the states of a vehicle."""


POSE = list(range(6))
"""Left error of a pose, the first of a vehicle's states; `ERRORS` follow."""


def error_states(recording: Recording) -> tuple[list[int], Array, Array]:
    """Return the states (w,) of the vehicles of a record: those of the pose, and the errors that any vehicle has.

    The others are the variances (N, w - 6) of these errors at the start, and (N, w - 6) by which they grow in a tick.
    """
    std, walk = np.zeros((2, len(recording.setups), ERRORS))
    for i, noise in enumerate(setup.noise for setup in recording.setups):
        camera = [noise.camera_orientation] * 3 + [noise.camera_position] * 3
        times = noise.clock_offset, noise.latency, noise.latency_jitter
        std[i] = [noise.odometry_scale, *noise.gyro_bias, *camera, *times]
        walk[i, :7] = [noise.odometry_scale_walk, *noise.gyro_bias_walk, *[noise.camera_orientation_walk] * 3]
    kept, growth = np.flatnonzero((std + walk).any(axis=0)), recording.dt * walk**2
    growth[:, JITTER - 6] = std[:, JITTER - 6] ** 2
    return [*POSE, *(6 + kept).tolist()], std[:, kept] ** 2, growth[:, kept]


def map_variances(recording: Recording) -> Array:
    """Return (L,) the variances of the landmarks' positions per axis, m^2; setups that state none have exact maps."""
    stated = [setup.landmark_std for setup in recording.setups if setup.landmark_std]
    return np.square(np.max(stated, axis=0)) if stated else np.zeros(recording.landmarks.shape[1])


def map_states(recording: Recording) -> dict[int, int]:
    """Return by landmark with a standard deviation the first of its three states, which follow on the vehicles'."""
    uncertain = np.flatnonzero(map_variances(recording)).tolist()
    return {landmark: 3 * n for n, landmark in enumerate(uncertain)}


BLOCK = 10_000_000
"""Numbers of the matrices over all vehicles that are kept at a time."""


@dataclass(frozen=True)
class Bound:
    """Lower bounds on the standard deviations at each tick."""

    t: Array  # (K,) s
    position: Array  # (K, N) m: sqrt(trace) of the position's block
    orientation: Array  # (K, N) deg: sqrt(trace) of the orientation's block
    covariance: Array  # (K, N, 6, 6) left errors, rad and m


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
    states, variances, growths = error_states(recording)
    w, dt, members = len(states), recording.dt, np.asarray(groups)
    of_map = np.repeat(map_variances(recording)[[*map_states(recording)]], 3)
    common = np.broadcast_to(w * len(recording.setups) + np.arange(len(of_map)), (len(groups), len(of_map)))
    part = (w * members[..., None] + np.arange(w)).reshape(len(groups), -1)
    own = np.arange(part.shape[1]).reshape(-1, w)
    part = np.concatenate([part, common], axis=1)
    start = [block_diag(P, np.diag(of)) for P, of in zip(recording.start_covariance, variances, strict=True)]
    P = np.array([block_diag(*(start[i] for i in group), np.diag(of_map)) for group in groups])
    noises = [setup.noise.odometry(dt) for setup in recording.setups]
    Q = np.array([np.diag([*noise, *growth]) for noise, growth in zip(noises, growths, strict=True)])
    rows, columns = own[:, :, None], own[:, None, :]
    blocks = np.empty((recording.ticks, len(groups), len(own), 6, 6))
    blocks[0] = P[:, rows, columns][..., :6, :6]
    identity = np.eye(part.shape[1])
    for ticks in _stretches(recording, w * len(recording.setups) + len(of_map)):
        E, M = steps(recording, ticks, states), information(recording, joint, members, ticks, states)
        M[~recording.due[ticks.start : ticks.stop]] = 0.0
        for k, moved, info in zip(ticks, E, M, strict=True):
            P = _moved(P, moved[members])
            P[:, rows, columns] += Q[members]
            info = info[part[:, :, None], part[:, None, :]]
            if info.any():
                # (P^-1 + M)^-1 without the inverse of P, which may be ill-conditioned: P (I + M P)^-1
                P = np.linalg.solve(identity + P @ info, P)
                P = (P + np.swapaxes(P, -1, -2)) / 2
            blocks[k] = P[:, rows, columns][..., :6, :6]
    return blocks


def _stretches(recording: Recording, size: int) -> Iterator[range]:
    """Yield the ticks after the start in stretches, each of which needs little memory for matrices of a size."""
    most = max(1, BLOCK // size**2)
    for first in range(1, recording.ticks, most):
        yield range(first, min(first + most, recording.ticks))


def _moved(P: Array, E: Array) -> Array:
    """Return E P E^T of covariances P (g, s, s), E being block diagonal with blocks (g, n, w, w) and then ones."""
    g, n, w = E.shape[:3]
    for _ in range(2):
        rows = (E @ P[:, : n * w].reshape(g, n, w, -1)).reshape(g, n * w, -1)
        P = np.swapaxes(np.concatenate([rows, P[:, n * w :]], axis=1), -1, -2)
    return P


def _bound(recording: Recording, blocks: Array) -> Bound:
    if any(setup.noise.bearing == 0.0 for setup in recording.setups):
        blocks = np.full_like(blocks, np.nan)
    trace = np.trace(blocks[..., 3:, 3:], axis1=-2, axis2=-1)
    angle = np.trace(blocks[..., :3, :3], axis1=-2, axis2=-1)
    return Bound(recording.t, np.sqrt(trace), np.degrees(np.sqrt(angle)), blocks)


def steps(recording: Recording, ticks: range, states: list[int] = POSE) -> Array:
    """Return (k, N, w, w) how each vehicle's states go on over its true motion into some ticks, to first order.

    Of tick 0 it is the identity.
    """
    R, p = recording.truth.rotation, recording.truth.position
    into = np.array(ticks)
    before = np.maximum(into - 1, 0)
    E = np.swapaxes(R[into], -1, -2) @ R[before]
    way = (np.swapaxes(R[before], -1, -2) @ (p[into] - p[before])[..., None])[..., 0]
    made = np.broadcast_to(np.eye(6 + ERRORS), (*E.shape[:2], 6 + ERRORS, 6 + ERRORS)).copy()
    made[..., :3, :3] = made[..., 3:6, 3:6] = E
    made[..., 3:6, :3] = -E @ skew(way)
    made[..., 3:6, 6:7] = -E @ way[..., None]
    made[..., :3, 7:10] = -recording.dt * np.eye(3) * (into > 0)[:, None, None, None]
    made[..., JITTER, JITTER] = 0.0
    return np.asarray(made[..., states, :][..., states])


def information(
    recording: Recording, joint: bool, observers: ArrayLike, ticks: range, states: list[int] = POSE
) -> Array:
    """Return sum of H^T N^-1 H (k, s, s) over the visible edges at some ticks, linearised at the truth.

    `joint`: a neighbour's pose is unknown, too; `observers`: the vehicles that measure; `states`: what is unknown of
    each of N vehicles, w numbers. There are s = wN + 3m of them with m uncertain landmarks.
    """
    truth, N, L, w = recording.truth, len(recording.setups), recording.landmarks.shape[1], len(states)
    at, of_map = np.array(ticks), map_states(recording)
    R, visible, before = truth.rotation[at], recording.visible[at], np.maximum(at - 1, 0)
    size = w * N + 3 * len(of_map)
    M = np.zeros((len(at), size, size))
    for i in np.unique(observers):
        setup = recording.setups[i]
        own = slice(w * i, w * i + w)
        Rt = np.swapaxes(R[:, i], -1, -2)
        turn = Rotation.from_matrix(np.swapaxes(truth.rotation[before, i], -1, -2) @ R[:, i]).as_rotvec()
        velocity = (Rt @ (truth.position[at, i] - truth.position[before, i])[..., None])[..., 0] / recording.dt
        for target in setup.targets.tolist():
            j = target - L
            marker = recording.setups[j].marker if j >= 0 else np.zeros(3)
            path = recording.landmarks[:, target] if j < 0 else truth.position[:, j] + truth.rotation[:, j] @ marker
            a = (Rt @ (path[at] - truth.position[at, i])[..., None])[..., 0]
            d = a - setup.lever_arm
            distance = np.maximum(np.linalg.norm(d, axis=-1), 1e-9)
            u = d / distance[:, None]
            across = (np.eye(3) - u[:, :, None] * u[:, None, :]) / distance[:, None, None]
            weight = visible[:, i, target, None, None] * setup.noise.bearing_information(u)
            known = j < 0 or not joint
            of_target = (Rt @ (path[at] - path[before])[..., None])[..., 0] / recording.dt
            clock = (across @ of_target[..., None])[..., 0]
            late = -(across @ (np.cross(a, turn / recording.dt) - velocity + of_target)[..., None])
            H = np.zeros((len(at), 3, 6 + ERRORS))
            H[..., :3], H[..., 3:6] = across @ skew(a), -across
            H[..., 10:13], H[..., 13:16] = skew(u), -across
            H[..., CLOCK] = 0.0 if known else -clock  # a report is dated by the sender's clock
            H[..., [LATENCY, JITTER]] = late
            blocks = [(own, H[..., states])]
            if target in of_map:
                first = w * N + of_map[target]
                blocks.append((slice(first, first + 3), across @ Rt))
            elif not known:
                H = np.zeros_like(H)
                H[..., :6] = across @ Rt @ R[:, j] @ np.hstack([-skew(marker), np.eye(3)])
                H[..., CLOCK] = clock
                blocks.append((slice(w * j, w * j + w), H[..., states]))
            _add_information(M, blocks, weight)
        for sensor in setup.sensors:
            for target in sensor.targets.tolist():
                _add_readings(M, recording, joint, at, int(i), sensor, target, w)
    return M


Blocks = Sequence[tuple[slice, Array]]
"""States and derivatives (k, r, w) of measurements by them."""


def _add_information(M: Array, blocks: Blocks, weight: Array) -> None:
    """Add the information of measurements with a weight (k, r, r) to M (k, s, s)."""
    for rows, first in blocks:
        weighted = np.swapaxes(first, -1, -2) @ weight
        for columns, second in blocks:
            M[:, rows, columns] += weighted @ second


def _add_readings(
    M: Array, recording: Recording, joint: bool, at: Array, i: int, sensor: Sensor, target: int, w: int
) -> None:
    """Add the information of what a sensor of vehicle i has measured of one target to M (k, s, s)."""
    truth, L = recording.truth, recording.landmarks.shape[1]
    linear, _ = _linear_rows(recording, at, i, sensor, target)
    blocks, of_map = [(slice(w * i, w * i + 6), linear.by_own)], map_states(recording)
    if target in of_map:
        first = w * len(recording.setups) + of_map[target]
        blocks.append((slice(first, first + 3), linear.by_target[..., 3:]))
    elif joint and target >= L:
        j = target - L
        arm, shift = truth.rotation[at, j] @ skew(recording.setups[j].marker), linear.by_target[..., 3:]
        by_pose = np.concatenate([linear.by_target[..., :3] - shift @ arm, shift @ truth.rotation[at, j]], axis=-1)
        blocks.append((slice(w * j, w * j + 6), by_pose))
    weight = np.where(linear.used, 1.0 / linear.noise, 0.0)
    _add_information(M, blocks, weight[..., None] * np.eye(weight.shape[-1]))


def _linear_rows(recording: Recording, at: Any, i: int, sensor: Sensor, target: int) -> tuple[LinearRows, Array]:
    """Return the measurements of a target by a sensor of vehicle i, linearised at the truth, and distances (k,), m."""
    values = recording.readings[sensor.name][at, i, max(target, 0)]
    R, p = recording.truth.rotation[at, i], recording.truth.position[at, i]
    marks = Landmarks(zip(recording.setups[i].target_names, np.swapaxes(recording.landmarks[at], 0, 1), strict=False))
    own = sensor.placed(R, p, recording.velocity[at, i], recording.angular_velocity[at, i], marks)
    place = _place_of(recording, at, target)
    distance = (
        np.linalg.norm(place.position - own.position, axis=-1) if target != MAP else np.full(len(at), COMPARED_AT)
    )
    return sensor.linearised(R, own, place, values), distance


def relative_information(recording: Recording) -> Array:
    """Return (K, N, 6, 6) the information of sensors beside the cameras in the Gramian, map axes, about its origin.

    Neighbours count as known. A row counts by the ratio of the error across of the camera's bearing, at the distance of
    the target, to its own.
    """
    at, M = np.arange(recording.ticks), np.zeros((recording.ticks, len(recording.setups), 6, 6))
    for i, setup in enumerate(recording.setups):
        for sensor in setup.sensors:
            for target in sensor.targets.tolist():
                linear, distance = _linear_rows(recording, at, i, sensor, target)
                ratio = np.nan_to_num(setup.noise.bearing_std * distance)[:, None] / np.sqrt(linear.noise)
                rows = np.where(linear.used, ratio, 0.0)[..., None] * linear.by_own
                M[:, i] += np.swapaxes(rows, -1, -2) @ rows
    R_t = np.nan_to_num(np.swapaxes(recording.truth.rotation, -1, -2))
    to_body = np.zeros_like(M)  # turn and shift of the map about its origin as a left error
    to_body[..., :3, :3] = to_body[..., 3:, 3:] = R_t
    to_body[..., 3:, :3] = -R_t @ skew(np.nan_to_num(recording.truth.position))
    return np.asarray(np.swapaxes(to_body, -1, -2) @ M @ to_body)


def _place_of(recording: Recording, at: Array, target: int) -> Placed:
    """Return a target at some ticks, by the truth; the velocity of a vehicle is that of its odometry."""
    L, truth = recording.landmarks.shape[1], recording.truth
    if target == MAP:
        return Placed.at(np.zeros((len(at), 3)))
    if target < L:
        rotations = recording.setups[0].landmark_rotation
        rotation = np.eye(3) if rotations is None else rotations[target]
        return landmark_place(recording.landmarks[at, target], np.broadcast_to(rotation, (len(at), 3, 3)))
    j = target - L
    R, rate = truth.rotation[at, j], recording.angular_velocity[at, j]
    marker = recording.setups[j].marker
    velocity = R @ (recording.velocity[at, j] + np.cross(rate, marker))[..., None]
    return Placed(truth.position[at, j] + R @ marker, R, velocity[..., 0], rate)
