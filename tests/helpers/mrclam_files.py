"""Synthetic recordings of the shape of MR.CLAM's: files, and drives with barriers that hide landmarks."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from coopenv.mrclam.dataset import MotionCapture, Robot
from coopenv.mrclam.recording import Dataset
from coopenv.mrclam.wheels import IROBOT_CREATE

ORIGIN = 1248444187.0
LANDMARKS = {6: (0.0, 4.0), 7: (4.0, 0.0), 8: (-4.0, 0.0), 9: (0.0, -4.0), 10: (3.0, 3.0)}
BARCODES = {subject: 100 + 3 * subject for subject in range(1, 21)}
HEADER = (
    "# UTIAS Multi-Robot Cooperative Localization and Mapping Dataset\n# produced for a test\n# Format:\n# Columns\n"
)


def pose(robot: int, t: np.ndarray) -> np.ndarray:
    """Return (N, 3) x, y, heading of a robot on its circle, exactly as v and omega say."""
    v, omega = motion(robot)
    heading = 0.6 * robot + omega * t
    radius = v / omega
    x = 0.8 * np.cos(robot) + radius * (np.sin(heading) - np.sin(0.6 * robot))
    y = 0.8 * np.sin(robot) - radius * (np.cos(heading) - np.cos(0.6 * robot))
    return np.stack([x, y, (heading + np.pi) % (2 * np.pi) - np.pi], axis=-1)


def motion(robot: int) -> tuple[float, float]:
    """Return v m/s and omega rad/s."""
    return 0.1 + 0.01 * robot, 0.1 * (-1) ** robot


def command(robot: int) -> tuple[float, float]:
    """Return the commanded v and omega that the nominal calibration turns into the motion."""
    v, omega = motion(robot)
    commanded = v, omega
    for _ in range(50):  # a contraction
        turn = omega / 0.936 / IROBOT_CREATE.gain(*commanded) + 0.005
        commanded = v / (1.0 - abs(turn)), turn
    return commanded


def recorded_range(distance: float, bearing: float) -> float:
    """Return what the camera records as a range: a depth along its optical axis, with a nominal scale and offset."""
    return (1.022 * distance + 0.045) * math.cos(bearing)


def write(parent: Path, number: int = 6, seconds: float = 40.0) -> Path:
    """Write a sub-dataset without noise and return its folder; its commands are those of the nominal calibration."""
    folder = parent / f"MRCLAM_Dataset{number}"
    folder.mkdir()
    put(folder / "Barcodes.dat", [f"{s:3d} \t {b:4d}" for s, b in BARCODES.items()])
    rows = [f" {s:2d} \t {x:.8f} \t {y:.8f} \t 0.00004570 \t 0.00027395" for s, (x, y) in LANDMARKS.items()]
    put(folder / "Landmark_Groundtruth.dat", rows)
    for robot in range(1, 6):
        t = np.arange(0, seconds, 0.02)
        stamped = np.column_stack([ORIGIN + t, pose(robot, t)])
        rows = [f"{a:.3f} \t {x:.8f} \t {y:.8f} \t {h:.8f}" for a, x, y, h in stamped]
        put(folder / f"Robot{robot}_Groundtruth.dat", rows)
        v, omega = command(robot)
        t = np.arange(0.1, seconds - 0.5, 0.02)
        put(folder / f"Robot{robot}_Odometry.dat", [f"{ORIGIN + a:.3f} \t {v:.8f} \t {omega:.8f}" for a in t])
        put(folder / f"Robot{robot}_Measurement.dat", _sightings(robot, seconds))
    return folder


def _sightings(robot: int, seconds: float) -> list[str]:
    rows = []
    for t in np.arange(1.0 + 0.01 * robot, seconds - 1, 0.5):
        time = float(f"{t:.3f}")
        x, y, heading = pose(robot, np.array([time]))[0]
        targets = {s: np.array(p) for s, p in LANDMARKS.items()}
        targets |= {s: pose(s, np.array([time]))[0, :2] for s in range(1, 6) if s != robot}
        for subject, point in targets.items():
            dx, dy = point - (x, y)
            bearing = (np.arctan2(dy, dx) - heading + np.pi) % (2 * np.pi) - np.pi
            if abs(bearing) < 1.0:
                depth = recorded_range(float(np.hypot(dx, dy)), bearing)
                row = f"{ORIGIN + time:.3f} \t {BARCODES[subject]:4d} \t {depth:.8f} \t {bearing:.8f}"
                rows.append(row)
    return rows


def put(path: Path, rows: list[str]) -> None:
    """Write rows below the usual header of four lines."""
    path.write_text(HEADER + "".join(row + "\n" for row in rows))


DT = 0.025
LOW, HIGH = np.array([-1.0, -5.5]), np.array([5.0, 5.5])
HALL_LANDMARKS = (
    *((0.0, -5.0), (2.0, -4.6), (4.2, -5.0), (4.6, -3.0), (2.6, -2.2), (-0.6, -2.4), (0.9, -0.9), (3.4, -0.4)),
    *((4.7, 1.0), (-0.7, 1.1), (1.8, 1.6), (4.0, 3.2), (0.1, 3.4), (2.2, 4.6), (4.5, 5.0)),
)
REACH_M, HALF_VIEW = 5.0, 0.55  # m, rad
MISREAD = 0.004  # share of barcodes


def barrier_robots(seed: int, seconds: float = 150.0, turn_scale: float = 0.6, barriers: int = 3) -> Dataset:
    """Return a sub-dataset in which robots turn `turn_scale` times what their wheels make of commands."""
    rng = np.random.default_rng([9, seed])
    centre, angle = rng.uniform(LOW + 1, HIGH - 1, (barriers, 2)), rng.uniform(0, np.pi, barriers)
    half = rng.uniform(0.8, 1.6, barriers)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    walls = list(zip(centre - half, centre + half, strict=True))
    driven = [_drive(rng, seconds, turn_scale) for _ in range(5)]
    poses = np.array([pose for pose, _ in driven])
    robots = tuple(_robot(rng, n, poses, driven[n][1], walls) for n in range(5))
    return Dataset("mrclam_9", seconds - 0.5, {6 + n: np.array(p) for n, p in enumerate(HALL_LANDMARKS)}, robots)


def _drive(rng: np.random.Generator, seconds: float, turn_scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Return poses (K, 3) every DT and the log (n, 3) of commands at 8 Hz."""
    steps = int(seconds / DT)
    pose, commanded = np.zeros((steps, 3)), np.zeros((steps, 2))
    x = np.array([*rng.uniform(LOW + 1, HIGH - 1), rng.uniform(-3, 3)])
    scale, done, until, command, waiting = turn_scale * rng.normal(1, 0.05), np.zeros(2), 0.0, np.zeros(2), []
    wanted = np.zeros(2)
    for k in range(steps):
        t = k * DT
        if t >= until:
            command, until = _command(rng, x, t, scale)
            turns = scale * IROBOT_CREATE.gain(*command.tolist())
            came = command * (0.95 * rng.normal(1, 0.03), turns * rng.normal(1, 0.06))
            waiting.append((t + max(0.2 + 0.08 * rng.standard_normal(), DT), came))
        while waiting and t >= waiting[0][0]:
            wanted = waiting.pop(0)[1]
        done = done + (wanted - done) * (DT / 0.12)
        pose[k], commanded[k] = x, command
        x = x + DT * np.array([done[0] * math.cos(x[2]), done[0] * math.sin(x[2]), done[1]])
    logged = np.unique(np.clip(((np.arange(0, seconds, 1 / 8) + rng.uniform(-0.02, 0.02)) / DT).astype(int), 0, None))
    return pose, np.column_stack([logged * DT, commanded[logged]])


def _command(rng: np.random.Generator, x: np.ndarray, t: float, scale: float) -> tuple[np.ndarray, float]:
    """Return a robot's next command, m/s and rad/s, and its end, s."""
    inside = (LOW + HIGH) / 2 - x[:2]
    off = (math.atan2(inside[1], inside[0]) - x[2] + math.pi) % (2 * math.pi) - math.pi
    outside = bool((x[:2] < LOW + 0.7).any() or (x[:2] > HIGH - 0.7).any())
    kind = rng.random()
    if outside and abs(off) > 0.6:
        w = math.copysign(rng.uniform(0.3, 0.9), off)
        return np.array([0.0, w]), t + min(abs(off / w) / scale, 8.0)
    if outside or kind < 0.45:
        return np.array([rng.uniform(0.08, 0.25), 0.0]), t + rng.uniform(2, 8)
    w = rng.choice([-1.0, 1.0]) * rng.uniform(0.15, 0.9)
    if kind < 0.75:
        return np.array([rng.uniform(0.08, 0.25), w]), t + rng.uniform(1, 5)
    return np.array([0.0, w * (kind < 0.9)]), t + rng.uniform(0.5, 3)


def _robot(
    rng: np.random.Generator,
    n: int,
    poses: np.ndarray,
    odometry: np.ndarray,
    walls: list[tuple[np.ndarray, np.ndarray]],
) -> Robot:
    """Return what robot n logged; poses are (5, K, 3)."""
    bias, seen = 0.008 * rng.standard_normal(), []
    frames = np.cumsum(rng.uniform(0.25, 0.6, 4 * poses.shape[1]))
    for k in (frames[frames < DT * (poses.shape[1] - 1)] / DT).astype(int):
        x, y, heading = poses[n, k]
        points = [*poses[:, k, :2], *np.array(HALL_LANDMARKS)]
        for subject, point in enumerate(points, 1):
            dx, dy = point - (x, y)
            bearing = (math.atan2(dy, dx) - heading + math.pi) % (2 * math.pi) - math.pi
            near = 0.3 < math.hypot(dx, dy) < REACH_M and abs(bearing) < HALF_VIEW and subject != n + 1
            if near and rng.random() < 0.6 and not any(_crosses(poses[n, k, :2], point, *wall) for wall in walls):
                who = subject if rng.random() > MISREAD else int(rng.integers(6, 21))
                depth = recorded_range(math.hypot(dx, dy), bearing)
                seen.append((k * DT, who, depth, bearing + bias + 0.013 * rng.standard_normal()))
    t = np.asarray(DT * np.arange(poses.shape[1]), dtype=np.float64)
    truth = MotionCapture(t, poses[n, :, :2], np.unwrap(poses[n, :, 2]))
    return Robot(n + 1, odometry, np.array(seen).reshape(-1, 4), truth, 0)


def _crosses(p: np.ndarray, q: np.ndarray, a: np.ndarray, b: np.ndarray) -> bool:
    """Return whether the line from p to q meets the one from a to b."""
    u, v = q - p, b - a
    det = u[0] * v[1] - u[1] * v[0]
    if abs(det) < 1e-9:
        return False
    s = ((a - p)[0] * v[1] - (a - p)[1] * v[0]) / det
    r = ((a - p)[0] * u[1] - (a - p)[1] * u[0]) / det
    return bool(0 < s < 1 and 0 < r < 1)
