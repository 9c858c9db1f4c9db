"""`python -m benchmarks.linear_case`: exact error covariances of the observer `robust` in linear scalar examples.

Every error is a vector of coefficients over independent sources of variance 1, so that true covariances are exact.
The receiver states its covariance by the observer's rules: considered senders, regression, increments. Tuned
shares are left out. The second table has the mean of the monitors' statistic without a fault.
"""

import argparse
import sys
from collections.abc import Callable, Sequence

import numpy as np
from rich.console import Console

from coopenv.estimation.poses import Array
from coopenv.observers.robust.constants import DISTINCT_VARIANCES
from coopenv.report.table import Table

SOURCES = 512
"""Most independent sources of an example."""
SENDER_NOISE, BEARING_NOISE = 0.1, 0.1
"""Variances of a follower's own error beside that of the vehicle that it follows, and of a relative measurement."""


class Sources:
    """Independent errors."""

    def __init__(self) -> None:
        """Begin with none."""
        self.used = 0

    def draw(self, variance: float) -> Array:
        """Return a new error of a variance, independent of all earlier ones."""
        error = np.zeros(SOURCES)
        error[self.used] = np.sqrt(variance)
        self.used += 1
        return error


class Receiver:
    """True errors (rows of coefficients) and stated covariance of a receiver, row 0, and of its members."""

    def __init__(self, sources: Sources, own: Array, stated: float | None = None) -> None:
        """Begin with an own error, whose variance is stated as it is unless another one is given."""
        self.sources, self.errors = sources, own[None]
        self.P = np.array([[own @ own if stated is None else stated]])

    def add(self, error: Array, covariances: dict[int, float] | None = None, factor: float = 1.0) -> None:
        """Add a sender: unknown covariances follow by regression on the known ones, which are zero without any."""
        variance = factor * float(error @ error)
        row = self.regressed(covariances or {})
        self.errors = np.vstack([self.errors, error])
        self.P = np.block([[self.P, row[:, None]], [row[None], np.array([[variance]])]])

    def regressed(self, known: dict[int, float]) -> Array:
        """Return the covariance of an error with all errors by regression on its known ones, by index."""
        at = list(known)
        coefficients: Array = np.linalg.solve(self.P[np.ix_(at, at)], np.array([*known.values()]))
        row: Array = coefficients @ self.P[at]
        return row

    def measure(self, n: int) -> None:
        """Measure the position relative to member n; only the own estimate is corrected."""
        H = np.zeros(len(self.P))
        H[0], H[n] = -1.0, 1.0
        K = (self.P @ H)[0] / (H @ self.P @ H + BEARING_NOISE)
        self.correct(K, H, self.sources.draw(BEARING_NOISE))

    def correct(self, K: float, H: Array, noise: Array) -> None:
        """Correct the own estimate by a gain times the innovation of a measurement H with a noise."""
        G = np.eye(len(self.P))
        G[0] -= K * H
        self.errors, self.P = G @ self.errors, G @ self.P @ G.T
        self.errors[0] -= K * noise
        self.P[0, 0] += K * K * float(noise @ noise)

    def propagate(self, own: float, noise: Array, variance: float) -> None:
        """Add odometry noise: of a variance to the own error; to member 1 a true noise, with a stated variance."""
        self.errors[0] += self.sources.draw(own)
        self.errors[1] += noise
        self.P[0, 0] += own
        self.P[1, 1] += variance

    def report(self, n: int, error: Array) -> None:
        """Take a new report of a member as an increment of the own estimate."""
        after = float(error @ error)
        row = self.regressed({n: after})
        row[n] = after
        increment, column = self.errors[n] - error, self.P[n] - row
        column[n] = 0.0
        N = float(self.P[n, n] - after)
        self.errors[n], self.P[n], self.P[:, n] = error, row, row
        if N > 1e-9:
            gain = column[0] / N
            self.errors[0] = self.errors[0] - gain * increment
            self.P[0] -= gain * column
            self.P[1:, 0] = self.P[0, 1:]

    def ratios(self) -> tuple[float, float]:
        """Return the true over the stated own variance, and the largest such ratio of any combination of errors."""
        true = self.errors @ self.errors.T
        L = np.linalg.inv(np.linalg.cholesky(self.P))
        return float(true[0, 0] / self.P[0, 0]), float(np.linalg.eigvalsh(L @ true @ L.T)[-1])


def flat(*senders: Array, known: dict[int, dict[int, float]] | None = None) -> Receiver:
    """Return a receiver without a prior that has measured senders once each."""
    sources = Sources()
    sources.used = SOURCES // 2
    receiver = Receiver(sources, sources.draw(1e6))
    for n, error in enumerate(senders, 1):
        receiver.add(error, (known or {}).get(n))
    for n in range(1, len(senders) + 1):
        receiver.measure(n)
    return receiver


def leader(every: int, odometry: float) -> Receiver:
    """Return a receiver of a sender that measures a landmark, after 60 steps; one report in `every` is fused."""
    sources = Sources()
    sender, P = sources.draw(1.0), 1.0
    receiver = Receiver(sources, sources.draw(1.0))
    receiver.add(sender)
    for step in range(1, 61):
        noise = sources.draw(odometry)
        sender, P = sender + noise, P + odometry
        receiver.propagate(0.01, noise, odometry)
        K = P / (P + 1.0)
        sender, P = sender - K * (sender + sources.draw(1.0)), (1.0 - K) * P
        if step % every == 0:
            receiver.report(1, sender)
        receiver.measure(1)
    return receiver


def ancestors(links: int, broadcast: bool) -> Receiver:
    """Return a receiver of two senders with one ancestor so many links away; correlations are broadcast or not."""
    sources = Sources()
    root = sources.draw(1.0)
    pair = [root + sum(sources.draw(SENDER_NOISE) for _ in range(links)) for _ in range(2)]
    return flat(*pair, known={2: {1: float(root @ root)}} if broadcast else None)


def newcomers(count: int) -> Receiver:
    """Return a receiver that has met so many senders, one at a time, that share an ancestor two links away."""
    sources = Sources()
    root = sources.draw(1.0)
    receiver = Receiver(sources, sources.draw(1e6))
    for _ in range(count):
        receiver.add(root + sources.draw(SENDER_NOISE) + sources.draw(SENDER_NOISE))
        receiver.measure(1)
        receiver.errors, receiver.P = receiver.errors[:1], receiver.P[:1, :1]
    return receiver


def second_encounter() -> Receiver:
    """Return a receiver that meets again the sender from which its own pose comes, at the limit of the order."""
    sources = Sources()
    sender = sources.draw(1.0)
    receiver = Receiver(sources, sender + sources.draw(DISTINCT_VARIANCES - 1.0))
    receiver.add(sender)
    receiver.measure(1)
    return receiver


def circle() -> Receiver:
    """Return a receiver of a sender that depends on it, with a correlation of 0.8, at the limit of the order."""
    sources = Sources()
    own = sources.draw(1.0)
    receiver = Receiver(sources, own)
    variance = 1.0 / DISTINCT_VARIANCES
    share = 0.8 * np.sqrt(variance)
    receiver.add(share * own + sources.draw(variance - share**2), factor=2.0)
    receiver.measure(1)
    return receiver


def old_correlation() -> Receiver:
    """Return a receiver that takes a correlation of 0.5 of an older report for one of 0.9."""
    sources = Sources()
    first = sources.draw(1.0)
    return flat(first, 0.9 * first + sources.draw(1.0 - 0.81), known={2: {1: 0.5}})


def other_odometry() -> Receiver:
    """Return a receiver with odometry of a variance 0.1 per report, whose sender has exact odometry and no news."""
    sources = Sources()
    sender = sources.draw(1.0)
    receiver = flat(sender)
    for _ in range(10):
        receiver.propagate(0.0, np.zeros(SOURCES), 0.1)
        receiver.report(1, sender)
    return receiver


EXAMPLES: dict[str, Callable[[], Receiver]] = {
    "one sender, every report fused": lambda: leader(1, 0.01),
    "one sender, every twelfth, exact odometry": lambda: leader(12, 0.0),
    "one sender, every twelfth, noisy odometry": lambda: leader(12, 0.01),
    "common ancestor, correlation known": lambda: ancestors(1, True),
    "common ancestor, correlation missing": lambda: ancestors(2, False),
    "four newcomers, common ancestor": lambda: newcomers(4),
    "sixteen newcomers, common ancestor": lambda: newcomers(16),
    "second encounter, limit of the order": second_encounter,
    "circle of two, sender counts twice": circle,
    "correlation of an older report": old_correlation,
    "odometry of the sender less noisy": other_odometry,
}


def monitor(frames: int, sender: float) -> tuple[float, float, float]:
    """Return the mean statistic of the faults of odometry, a sender and a landmark, 1 for a chi-square of 1.

    The receiver measures a landmark and the sender, whose nominal error is constant with a variance, in each frame.
    """
    sources = Sources()
    receiver = Receiver(sources, sources.draw(1.0))
    receiver.add(sources.draw(sender))
    Phi, A, a = np.zeros(3), np.zeros((3, 3)), np.zeros((3, SOURCES))
    for _ in range(frames):
        receiver.propagate(0.01, np.zeros(SOURCES), 0.0)
        Phi[0] += 1.0
        for q, H in ((2, np.array([-1.0, 0.0])), (1, np.array([-1.0, 1.0]))):
            noise, M = sources.draw(BEARING_NOISE), -Phi
            M[q] += 1.0
            W = 1.0 / (H @ receiver.P @ H + BEARING_NOISE)
            innovation, K = H @ receiver.errors + noise, W * (receiver.P @ H)[0]
            A, a = A + W * np.outer(M, M), a + W * np.outer(M, innovation)
            receiver.correct(K, H, noise)
            Phi = Phi - K * M
    Pi = 1.0 / (1.0 / sender + A[1, 1])
    v = a - Pi * np.outer(A[:, 1], a[1])
    V = np.diag(A) - Pi * A[:, 1] ** 2
    statistic = (v**2).sum(axis=1) / V
    return float(statistic[0]), float(statistic[1]), float(statistic[2])


def main(arguments: Sequence[str] | None = None) -> int:
    """Print both tables; return the exit status."""
    argparse.ArgumentParser(prog="python -m benchmarks.linear_case", description=__doc__).parse_args(arguments)
    console = Console(markup=False, highlight=False)
    table = Table.of_texts(["\nexample"], ["own variance,\ntrue / stated", "largest\nratio"])
    for name, build in EXAMPLES.items():
        table.add(name, *(f"{ratio:.3f}" for ratio in build().ratios()))
    console.print(table)
    table = Table.of_texts(["variance of\nthe sender"], ["\nframes", "\nodometry", "\nsender", "\nlandmark"])
    for sender in (1e-9, 0.1, 1.0):
        for frames in (1, 10, 100):
            table.add(f"{sender:g}", str(frames), *(f"{mean:.3f}" for mean in monitor(frames, sender)))
    console.print("\nMean of the monitors' statistic without a fault", table, sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
