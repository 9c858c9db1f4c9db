"""`python -m benchmarks.linearisation`: range bias and consistency of a receiver by the point of linearisation.

A receiver has odometry and bearings to one leader, whose pose is nearly known. In the lane both drive alike; in the
curve the receiver turns, so that they move against each other. The small planar filter considers the leader's error
and linearises each bearing at the predicted pose, half way, at the corrected pose, or at the predicted pose with a
Jacobian that gives no information along the first line of sight (observability-constrained). Seeds come in pairs of
opposite noise, so that the mean range error is of second order.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console

from coopenv.base.format import in_parentheses
from coopenv.estimation.poses import Array
from coopenv.report.table import Table
from coopenv.runs.console import Progress
from coopenv.viz import style

POINTS = {"prediction": 0.0, "midpoint": 0.5, "correction": 1.0, "constrained": 0.0}
"""Share of the correction after which a bearing is linearised."""
SCENES = {"lane": 0.0, "curve": 0.4}
"""Yaw rate of the receiver, rad/s; both drive at 0.5 m/s, and the leader begins 3 m ahead."""
RATE, SPEED, AHEAD = 60.0, 0.5, np.array([3.0, 0.5])
BEARING, VELOCITY, GYRO = 0.0029, 0.1, 0.01  # rad, m/s and rad/s of a sample
START = np.array([0.03, 0.1, 0.1, 0.002, 0.01, 0.01])  # rad and m: of the receiver's pose, then of the leader's
VARIANCE_TIME = 12.0  # s for which the second-order error of a bearing counts as one
TURN = np.array([[0.0, -1.0], [1.0, 0.0]])
LOOKS = 5.0  # s between looks


class Look(NamedTuple):
    """Results of all seeds at a time: means and their standard errors."""

    time: float
    bias: float  # m, of the estimated range
    bias_error: float
    anees: float  # over 3
    anees_error: float


def rotations(angle: Array) -> Array:
    """Return rotations (S, 2, 2) by angles, rad."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)


def moved(pose: Array, error: Array) -> Array:
    """Return poses (S, 3), angle and position, moved by left errors (S, 3)."""
    change = np.einsum("nij,nj->ni", rotations(pose[:, 0]), error[:, 1:])
    return np.column_stack([pose[:, 0] + error[:, 0], pose[:, 1:] + change])


def bearing(own: Array, leader: Array) -> tuple[Array, Array, Array]:
    """Return the bearing (S,), its derivative (S, 6) by the left errors of both poses, and the direction (S, 2)."""
    a = np.einsum("nji,nj->ni", rotations(own[:, 0]), leader[:, 1:] - own[:, 1:])
    distance = np.linalg.norm(a, axis=1)
    across = a @ TURN.T / distance[:, None] ** 2
    theirs = np.einsum("ni,nij->nj", across, rotations(leader[:, 0] - own[:, 0]))
    H = np.column_stack([-np.ones(len(a)), -across, np.zeros(len(a)), theirs])
    return np.arctan2(a[:, 1], a[:, 0]), H, a / distance[:, None]


def wrapped(angle: Array) -> Array:
    """Return angles between -pi and pi."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def transition(step: Array) -> Array:
    """Return the derivative (S, 3, 3) of left errors after odometry increments (S, 3) by those before."""
    back = np.swapaxes(rotations(step[:, 0]), 1, 2)
    F = np.zeros((len(step), 3, 3))
    F[:, 0, 0], F[:, 1:, 1:], F[:, 1:, 0] = 1.0, back, np.einsum("nij,nj->ni", back, step[:, 1:] @ TURN.T)
    return F


def second_order(P: Array, H: Array, u: Array) -> Array:
    """Return the variance (S,) of the neglected term of a bearing, times the frames that count as one."""
    square = 1.0 / np.sum(H[:, 1:3] ** 2, axis=1)
    along = np.einsum("ni,nij,nj->n", u, P[:, 1:3, 1:3], u)
    across = np.trace(P[:, 1:3, 1:3], axis1=1, axis2=2) - along
    variance: Array = VARIANCE_TIME * RATE * along * across / square**2
    return variance


def corrected(own: Array, leader: Array, P: Array, z: Array, point: str, N: Array, variance: bool) -> tuple[Array, ...]:
    """Return pose, covariance and constrained direction (S, 6) after a bearing z (S,), linearised at a point."""
    dx, at = np.zeros((len(own), 6)), POINTS[point]
    for share in (0.0, at) if at else (0.0,):
        there = share * dx[:, :3]
        predicted, H, u = bearing(moved(own, there), leader)
        H[:, 1:3] = np.einsum("ni,nij->nj", H[:, 1:3], rotations(-there[:, 0]))
        noise = BEARING**2 + (second_order(P, H, u) if variance else 0.0)
        if point == "constrained":
            H = H - np.einsum("ni,ni->n", H, N)[:, None] * N / np.sum(N**2, axis=1)[:, None]
        residual = wrapped(z - predicted) + share * np.einsum("ni,ni->n", H, dx)
        K = np.einsum("nij,nj->ni", P, H)
        K = K / (np.einsum("ni,ni->n", H, K) + noise)[:, None]
        K[:, 3:] = 0.0
        dx = K * residual[:, None]
    G = np.tile(np.eye(6), (len(own), 1, 1))
    G[:, 1:3, 1:3] = rotations(-dx[:, 0])
    A = G @ (np.eye(6) - K[:, :, None] * H[:, None, :])
    GK = np.einsum("nij,nj->ni", G, K)
    P = A @ P @ np.swapaxes(A, 1, 2) + (noise * np.ones(len(own)))[:, None, None] * GK[:, :, None] * GK[:, None, :]
    return moved(own, dx[:, :3]), P, np.einsum("nij,nj->ni", G, N)


def simulate(
    scene: str, point: str, seeds: int, seconds: float, variance: bool = False, scale: float = 1.0
) -> list[Look]:
    """Return the looks of a filter over seeds; `scale`: of the receiver's first errors."""
    random, dt, start = np.random.default_rng(0), 1.0 / RATE, START * np.repeat([scale, 1.0], 3)

    def draw(*sizes: float) -> Array:
        half = random.standard_normal((seeds // 2, len(sizes))) * sizes
        return np.concatenate([half, -half])

    truth = np.zeros((seeds, 3))
    leader = np.tile([0.0, *AHEAD], (seeds, 1))
    errors = draw(*start)
    own, theirs = (moved(pose, -part) for pose, part in ((truth, errors[:, :3]), (leader, errors[:, 3:])))
    P = np.tile(np.diag(start**2), (seeds, 1, 1))
    N = np.column_stack([np.zeros(seeds), bearing(own, theirs)[2], np.zeros((seeds, 3))])
    step, straight = (np.tile([w * dt, SPEED * dt, 0.0], (seeds, 1)) for w in (SCENES[scene], 0.0))
    Q = np.diag([GYRO * dt, VELOCITY * dt, VELOCITY * dt, 0.0, 0.0, 0.0]) ** 2
    F = np.tile(np.eye(6), (seeds, 1, 1))
    F[:, 3:, 3:] = transition(straight)
    looks = []
    for k in range(1, round(seconds * RATE) + 1):
        measured = step + draw(GYRO * dt, VELOCITY * dt, VELOCITY * dt)
        truth, leader, theirs = moved(truth, step), moved(leader, straight), moved(theirs, straight)
        own, F[:, :3, :3] = moved(own, measured), transition(measured)
        P, N = F @ P @ np.swapaxes(F, 1, 2) + Q, np.einsum("nij,nj->ni", F, N)
        z = bearing(truth, leader)[0] + draw(BEARING)[:, 0]
        own, P, N = corrected(own, theirs, P, z, point, N, variance)
        if k % round(LOOKS * RATE) == 0:
            away = [np.linalg.norm(b[:, 1:] - a[:, 1:], axis=1) for a, b in ((own, theirs), (truth, leader))]
            bias = (away[0] - away[1]).reshape(2, -1).mean(axis=0)
            error = np.column_stack(
                [wrapped(truth[:, 0] - own[:, 0]), np.einsum("nji,nj->ni", rotations(own[:, 0]), (truth - own)[:, 1:])]
            )
            nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(P[:, :3, :3]), error) / 3.0
            figures = [f for v in (bias, nees) for f in (float(v.mean()), float(v.std(ddof=1) / np.sqrt(len(v))))]
            looks.append(Look(k * dt, *figures))
    return looks


def drawn(results: dict[tuple[str, str, bool], list[Look]], path: Path) -> None:
    """Write the figure: range bias over time, a panel per scene, with and without the variance."""
    figure = Figure(figsize=(7.2, 3.2), layout="constrained")
    axes = figure.subplots(1, len(SCENES), sharex=True)
    for ax, scene in zip(axes, SCENES, strict=True):
        for point, colour in zip(POINTS, style.VEHICLE_COLOURS, strict=False):
            for variance, line in ((False, "-"), (True, "--")):
                time, bias = zip(
                    *((look.time, 100 * look.bias) for look in results[scene, point, variance]), strict=True
                )
                ax.plot(time, bias, line, color=colour, label=None if variance or ax is axes[0] else point)
        ax.axhline(0.0, color=style.GREY, linewidth=0.6)
        ax.set_title(scene)
        ax.set_xlabel("time [s]")
    axes[0].set_ylabel("range bias [cm]")
    figure.legend(loc="outside lower center", ncols=4, title="linearised at; dashed: with linearisation variance")
    style.save(figure, path, about={"command": "python -m benchmarks.linearisation"})


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print the table and write the figure; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.linearisation", description=__doc__)
    parser.add_argument("--seeds", type=int, default=200, help="number of seeds, even (default: 200)")
    parser.add_argument("--seconds", type=float, default=30.0, help="of each run, 5 at least (default: 30)")
    parser.add_argument("--scale", type=float, default=1.0, help="of the receiver's first errors (default: 1)")
    parser.add_argument("--figure", type=Path, help="PNG, PDF or SVG to write")
    asked = parser.parse_args(arguments)
    if asked.seeds < 4 or asked.seeds % 2 or asked.seconds < LOOKS:
        print("error: expected an even number of seeds, 4 at least, and 5 s at least", file=sys.stderr)
        return 2
    cases = [(scene, point, variance) for variance in (False, True) for scene in SCENES for point in POINTS]
    table = Table.of_texts(["\nscene", "\nlinearised at", "\nvariance"], ["range bias\n[cm]", "ANEES\n"])
    results = {}
    with Progress(Console(stderr=True), "simulating", total=len(cases)) as progress:
        for done, (scene, point, variance) in enumerate(cases):
            progress.update(done)
            looks = simulate(scene, point, asked.seeds, asked.seconds, variance, asked.scale)
            results[scene, point, variance], last = looks, looks[-1]
            bias = in_parentheses(100 * last.bias, 100 * last.bias_error)
            table.add(scene, point, "12 s" if variance else "-", bias, in_parentheses(last.anees, last.anees_error))
    Console(markup=False, highlight=False).print(table, f"After {last.time:g} s, {asked.seeds} seeds.", sep="\n")
    if asked.figure is not None:
        drawn(results, asked.figure)
    return 0


if __name__ == "__main__":
    sys.exit(main())
