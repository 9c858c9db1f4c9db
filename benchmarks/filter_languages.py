"""CPU time of one filter of the comparison in Numba and in NumPy: `python -m benchmarks.filter_languages`.

The NumPy functions hold the same equations for `mekf_covariance`; its estimates agree to rounding.
"""

import sys
import time

import numpy as np
from numpy.typing import NDArray

from coopenv.estimation.poses import Array, exp_so3, lengths, orthonormalise, right_jacobian, skew, solve
from coopenv.observers import uncertain_pose
from coopenv.observers.correction import LARGEST, Judgement, Stacked
from coopenv.observers.frame import Frame
from coopenv.observers.pose_filters import Mekf
from coopenv.observers.recording import Recording
from coopenv.observers.runner import Run, run
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario

OBSERVER = "mekf_covariance"


def predicted(
    kind: int, R: Array, p: Array, P: Array, rotation: Array, translation: Array, noise: Array
) -> tuple[Array, Array, Array]:
    """Return what `uncertain_pose.predicted` does of a left error."""
    F, E = np.zeros((6, 6)), rotation.T
    F[:3, :3] = F[3:, 3:] = E
    F[3:, :3] = E.dot(skew(-translation))
    return orthonormalise(R.dot(rotation)), p + R.dot(translation), F.dot(P).dot(F.T) + np.diag(noise)


def across(u: Array) -> Array:
    """Return (m, 2, 3) orthonormal rows across unit vectors (m, 3)."""
    x, y, z = u.T
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    c = x * y * a
    rows = [1.0 + sign * x * x * a, sign * c, -sign * x, c, sign + y * y * a, -y]
    return np.stack(rows, axis=-1).reshape(-1, 2, 3)


def linearise(R: Array, p: Array, frame: Frame) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Return residual, H, N and `ahead` of the camera's bearings, as `linearisation.linearise` does of a left error."""
    entries, sensors, weight, _ = frame
    a = (entries["position"] - p).dot(R)
    d = a - sensors["position"][0]
    distance = np.maximum(lengths(d), 1e-9)[:, None]
    B = across(d / distance)
    J = B / distance[..., None]
    axes = entries["rotation"].copy()
    axes[~axes.any(axis=(1, 2))] = np.eye(3)
    G = J.dot(R.T) @ axes
    H = np.concatenate([J @ skew(a), -J], axis=-1)
    N = weight * G @ entries["covariance"][:, 3:, 3:] @ G.transpose(0, 2, 1) + sensors["variance"][0, 0] * np.eye(2)
    bearings = entries["value"][:, :3]
    return (B @ bearings[..., None])[..., 0], H, N, (d * bearings).sum(axis=1) > 0.0


def judged(kind: int, R: Array, p: Array, P: Array, frame: Frame, *unused: object) -> Judgement:
    """Return what `correction.judged_frame` does of bearings of the camera."""
    residual, H, N, ahead = linearise(R, p, frame)
    S = H.dot(P) @ H.transpose(0, 2, 1) + N
    squared = np.einsum("mr,mr->m", residual, np.linalg.solve(S, residual[..., None])[..., 0])
    fits = (squared >= 0.0) & (squared <= LARGEST) & ahead
    widest, of_guard = float(np.trace(S, axis1=1, axis2=2).max()), np.zeros((len(S), 3, 2))  # which this filter has not
    return squared >= 0.0, fits, 1.0 - float(fits.mean()), widest, of_guard


def stacked(R: Array, p: Array, frame: Frame) -> Stacked:
    """Return residual (2m,), H (2m, 6) and N (2m, 2m) at a pose."""
    residual, H, N, _ = linearise(R, p, frame)
    m, dense = np.arange(len(N)), np.zeros((len(N), 2, len(N), 2))
    dense[m, :, m, :] = N
    return residual.ravel(), H.reshape(-1, 6), dense.reshape(2 * len(N), -1)


def gain(P: Array, H: Array, N: Array, residual: Array) -> tuple[Array, Array, float]:
    """Return what `correction.gain` does."""
    HP = H.dot(P)
    solved = solve(HP.dot(H.T) + N, np.concatenate([HP, residual[:, None]], axis=1))
    return solved[:, :-1].T, solved[:, :-1].T.dot(residual), float(residual.dot(solved[:, -1]))


def recentring(dx: Array) -> Array:
    """Return what `uncertain_pose.recentring` does of a left error."""
    G = np.zeros((6, 6))
    G[:3, :3], G[3:, 3:] = right_jacobian(dx[:3]), exp_so3(dx[:3]).T
    return G


def updated(kind: int, R: Array, p: Array, P: Array, frame: Frame) -> tuple[Array, Array, Array, float, int]:
    """Return what `correction.updated` does of a left error."""
    residual, H, N = stacked(R, p, frame)
    _, dx, nis = gain(P, H, N, residual)
    at = 0.5 * dx
    residual, H, N = stacked(R.dot(exp_so3(at[:3])), p + R.dot(at[3:]), frame)
    H = H.dot(recentring(at))
    K, dx, _ = gain(P, H, N, residual + H.dot(at))
    A, G = np.eye(6) - K.dot(H), recentring(dx)
    P = G.dot(A.dot(P).dot(A.T) + K.dot(N).dot(K.T)).dot(G.T)
    return R.dot(exp_so3(dx[:3])), p + R.dot(dx[3:]), (P + P.T) / 2, nis, len(N)


def measured(recording: Recording) -> tuple[Run, float]:
    """Return a run and its CPU time, s: the lesser one of three."""
    times = []
    for _ in range(3):
        begin = time.process_time()
        found = run(OBSERVER, recording)
        times.append(time.process_time() - begin)
    return found, min(times)


def main() -> None:
    """Print both times and their ratio."""
    recording = record(load_scenario("lane:8", {"horizon": 12.0}))
    compiled, numba = measured(recording)
    uncertain_pose.predicted = predicted
    vars(sys.modules[Mekf.__module__]).update(updated=updated, judged_frame=judged)
    plain, numpy = measured(recording)
    difference = float(np.abs(plain.position[1:] - compiled.position[1:]).max())
    print(f"{OBSERVER}, lane:8, 12 s: Numba {numba:.2f} s of CPU, NumPy {numpy:.2f} s, factor {numpy / numba:.1f}")
    print(f"largest difference of the estimated positions {difference:.1e} m")


if __name__ == "__main__":
    main()
