"""A filter over poses and all errors that setups declare, written anew for the tests of bound and filters.

The states are, per vehicle, pose (6), scale, gyro's bias (3), turn and place of the camera (6) and latency, then the
map (3 L). The jitter is no state here: it makes the bearings of a frame correlated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from coopenv.observers import Recording

W = 17
SCALE, GYRO, TURN, PLACE, LATENCY = 6, slice(7, 10), slice(10, 13), slice(13, 16), 16
JITTER = 0.004
STD = {
    "odometry_scale": 0.01,
    "odometry_scale_walk": 0.002,
    "gyro_bias": (0.003, 0.002, 0.004),
    "gyro_bias_walk": (1e-3, 2e-3, 3e-3),
    "camera_orientation": 0.01,
    "camera_orientation_walk": 0.003,
    "camera_position": 0.02,
    "latency": 0.02,
    "latency_jitter": JITTER,
}
MAP = 0.07


def S(v: np.ndarray) -> np.ndarray:
    """Return the matrix of the vector product."""
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def declaring(made: Recording) -> Recording:
    """Return a record of moving landmarks in which all errors are declared, those of the map with one exact one."""
    L = made.landmarks.shape[1]
    accuracy = np.where(np.arange(L) == 1, 0.0, MAP * (1.0 + np.arange(L)))
    setups = tuple(replace(s, noise=replace(s.noise, **STD), landmark_std=tuple(accuracy)) for s in made.setups)
    drift = made.t[:, None, None] * np.array([0.3, -0.2, 0.1])
    return replace(made, setups=setups, landmarks=made.landmarks + drift)


def frame(made: Recording, k: int, i: int, members: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return derivatives (2m, states) and covariance (2m, 2m) of the bearings that vehicle i has measured at tick k."""
    truth, dt, L, setup = made.truth, made.dt, made.landmarks.shape[1], made.setups[i]
    R, before, own = truth.rotation[k, i], truth.rotation[k - 1, i], W * members.index(i)
    p, omega = truth.position[k, i], Rotation.from_matrix(before.T @ R).as_rotvec() / dt
    v = R.T @ (p - truth.position[k - 1, i]) / dt
    rows, late = [], []
    for target in setup.targets:
        if not made.visible[k, i, target]:
            continue
        j = int(target) - L
        H = np.zeros((3, W * len(members) + 3 * L))
        if j < 0:
            z, z_before = made.landmarks[k, target], made.landmarks[k - 1, target]
        else:
            m = made.setups[j].marker
            z, z_before = (truth.position[n, j] + truth.rotation[n, j] @ m for n in (k, k - 1))
        a = R.T @ (z - p)
        d = a - setup.lever_arm
        u = d / np.linalg.norm(d)
        by_point = (np.eye(3) - np.outer(u, u)) / np.linalg.norm(d)  # of the bearing by the target, body axes
        H[:, own : own + 6] = by_point @ np.hstack([S(a), -np.eye(3)])
        H[:, own + 10 : own + 13], H[:, own + 13 : own + 16] = S(u), -by_point
        rate = by_point @ (-np.cross(omega, a) - v + R.T @ (z - z_before) / dt)
        H[:, own + LATENCY] = -rate
        if j < 0:
            H[:, W * len(members) + 3 * target : W * len(members) + 3 * target + 3] = by_point @ R.T
        else:
            its = W * members.index(j)
            H[:, its : its + 6] = by_point @ R.T @ truth.rotation[k, j] @ np.hstack([-S(m), np.eye(3)])
        plane = np.linalg.svd(u[None])[2][1:]  # two directions across the bearing
        rows.append(plane @ H)
        late.append(plane @ -rate)
    H = np.concatenate(rows) if rows else np.zeros((0, W * len(members) + 3 * L))
    common = np.concatenate(late) if rows else np.zeros(0)
    return H, setup.noise.bearing**2 * np.eye(len(H)) + JITTER**2 * np.outer(common, common)


def recursion(made: Recording, members: list[int], considered: Sequence[int] = ()) -> np.ndarray:
    """Return (K, n, 6, 6) the covariances of the poses of some vehicles by their own measurements.

    `considered` are states whose gain is zero (Schmidt): with any, the update is that of a gain that is not optimal.
    """
    truth, dt = made.truth, made.dt
    P, lasting = [], np.zeros(W)
    for i in members:
        noise = made.setups[i].noise
        std = [noise.odometry_scale, *noise.gyro_bias, *[noise.camera_orientation] * 3, *[noise.camera_position] * 3]
        P.append(block_diag(made.start_covariance[i], np.diag([*std, noise.latency]) ** 2))
        lasting[[SCALE, 7, 8, 9, 10, 11, 12]] = [noise.odometry_scale_walk, *noise.gyro_bias_walk, *[0.003] * 3]
    exact = 1e-14  # of a landmark whose place is known: its information must be finite
    P = block_diag(*P, np.diag(np.repeat(np.maximum(made.setups[0].landmark_std, exact) ** 2, 3)))
    found = [P]
    for k in range(1, made.ticks):
        F, Q = np.eye(len(P)), np.zeros(len(P))
        for n, i in enumerate(members):
            back = truth.rotation[k, i].T @ truth.rotation[k - 1, i]
            way = truth.rotation[k - 1, i].T @ (truth.position[k, i] - truth.position[k - 1, i])
            part = F[W * n : W * n + W, W * n : W * n + W]
            part[:3, :3] = part[3:6, 3:6] = back
            part[3:6, :3] = -back @ S(way)
            part[3:6, SCALE] = -back @ way
            part[:3, GYRO] = -dt * np.eye(3)
            Q[W * n : W * n + W] = dt * lasting**2
            Q[W * n : W * n + 6] = made.setups[i].noise.odometry(dt)
        P = F @ P @ F.T + np.diag(Q)
        for i in members if made.due[k] else ():
            H, N = frame(made, k, i, members)
            gain = np.linalg.solve(H @ P @ H.T + N, H @ P).T
            gain[[*considered]] = 0.0
            left = np.eye(len(P)) - gain @ H
            P = left @ P @ left.T + gain @ N @ gain.T
        found.append(P)
    blocks = [[P[W * n : W * n + 6, W * n : W * n + 6] for n in range(len(members))] for P in found]
    return np.array(blocks)
