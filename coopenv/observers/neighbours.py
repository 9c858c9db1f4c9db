"""What filters share that keep cross-covariances with their neighbours, whom they consider and do not correct.

The error of a neighbour j is that of its marker's pose as it tells it, R_j = Rhat_j Exp(theta), z_j = zhat_j + Rhat_j
rho. C_ij is the covariance of one's own error with it. One's own errors change by F (odometry) and by P+ P-^-1
(bearings); the product of these since the last message, a vehicle's factor, is told, so that a neighbour carries its
C_ij on by C_ij <- C_ij factor_j^T. Source of this rule: Luft, Schubert, Roumeliotis and Burgard, Recursive
decentralized localization for multi-robot systems with asynchronous pairwise communication, International Journal of
Robotics Research 37(10), 2018. It is exact for odometry and landmarks; for bearings to a third vehicle it holds if the
two have nothing in common but what the first one knows. For messages that were lost the factor that came stands in.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from coopenv.estimation.arrays import Array, cholesky, solve
from coopenv.estimation.rotations import skew
from coopenv.observers.contract import Message, Setup, Tick
from coopenv.observers.correction import Stacked, halfway
from coopenv.observers.lines import Lines, Sight, linearised
from coopenv.observers.mekf import LeftError, Mekf

IDENTITY = np.eye(6)
MOST_LOST = 60  # messages in a row for which a factor stands in
SHRINKING = (0.98, 0.9, 0.7, 0.4, 0.0)
"""Factors of cross-covariances where no joint distribution has them: a sender may lie, the rule approximates."""


@dataclass(frozen=True)
class Neighbour:
    """What is known of a neighbour."""

    number: int  # of its last message
    R: Array  # (3, 3) as told
    P: Array  # (6, 6) as told, about its marker
    cross: Array  # (6, 6) C_ij


class Considering(Mekf):
    """The part of a filter that keeps cross-covariances."""

    sends_covariance = True

    def __init__(self, setup: Setup, gated: bool = True) -> None:
        """Take a setup; without `gated` every bearing is believed."""
        super().__init__(setup, gated)
        self.to_marker = np.eye(6)  # own left error to that of the marker's pose
        self.to_marker[3:, :3] = -skew(setup.marker)
        self.from_marker = np.eye(6)
        self.from_marker[3:, :3] = skew(setup.marker)

    def reset(self, initial_pose: tuple[Array, Array], initial_covariance: Array) -> None:
        """Start at a pose that has nothing to do with others'."""
        super().reset(initial_pose, initial_covariance)
        self.neighbours: dict[int, Neighbour] = {}
        self.factor, self.number = IDENTITY, 0

    def message(self) -> Message:
        """Return the marker's pose and covariance, and the factor since the last message with its number."""
        T = self.to_marker
        factor = T.dot(self.factor).dot(self.from_marker)
        self.factor, self.number = IDENTITY, self.number + 1
        extra = {"factor": factor, "number": np.array([self.number])}
        position = self.state.p + self.state.R.dot(self.marker)
        return Message(position, self.state.R, T.dot(self.state.P).dot(T.T), extra)

    def predict(self, tick: Tick) -> None:
        """Append the increment."""
        self.carry(LeftError.transition(tick.rotation, tick.translation))
        super().predict(tick)

    def carry(self, A: Array, others: Sequence[int] | None = None) -> None:
        """Let the own error be A times what it was, in the factor and in cross-covariances; `others`: in whose."""
        for j in self.neighbours if others is None else others:
            of = self.neighbours[j]
            self.neighbours[j] = Neighbour(of.number, of.R, of.P, A.dot(of.cross))
        self.factor = A.dot(self.factor)

    def take(self, tick: Tick, sight: Sight) -> None:
        """Hear who is seen, then correct."""
        for target, message in zip(sight.targets.tolist(), sight.messages, strict=True):
            if message is not None:
                self.hear(target, message)
        super().take(tick, sight)

    def spread(self, tick: Tick, sight: Sight, lines: Lines) -> Array:
        """Return (m, 2, 2) the covariances of the innovations, with what the two errors have in common."""
        S = super().spread(tick, sight, lines)
        for n, target in enumerate(sight.targets.tolist()):
            if target in self.neighbours:
                of = self.neighbours[target]
                common = lines.H[n].dot(of.cross[:, 3:]).dot(lines.G[n].dot(of.R).T)
                S[n] += common + common.T
        return S

    def hear(self, target: int, message: Message) -> None:
        """Take what a neighbour tells of itself, if it is what this observer sends."""
        factor, number = (np.asarray(message.extra.get(name, np.nan)) for name in ("factor", "number"))
        if message.rotation is None or message.covariance is None or factor.shape != (6, 6) or number.shape != (1,):
            return
        of, now = self.neighbours.get(target), int(number[0])
        cross = np.zeros((6, 6)) if of is None else of.cross
        if of is not None and now != of.number:
            lost = max(1, min(now - of.number, MOST_LOST))
            cross = cross.dot(factor.T if lost == 1 else np.linalg.matrix_power(factor, lost).T)
        variances = np.maximum(np.outer(self.state.P.diagonal(), message.covariance.diagonal()), 0.0)
        limit = np.sqrt(variances)  # of any covariance: what is told may be anything
        cross = np.clip(np.nan_to_num(cross), -limit, limit)
        self.neighbours[target] = Neighbour(now, message.rotation, message.covariance, cross)

    def consider(self, tick: Tick, sight: Sight, told: Array | None = None) -> float:
        """Correct by bearings to landmarks and to neighbours that are known; return the squared innovation.

        `told` (n, n, 6, 6) holds the covariances of the neighbours with each other, in the order of the sight.
        """
        seen = [t for t in sight.targets.tolist() if t in self.neighbours]
        of, before = [self.neighbours[t] for t in seen], self.state
        joint, P = self.joint_covariance(of, told), before.P
        exact = sight._replace(covariances=np.zeros_like(sight.covariances))

        def look(at: Array) -> Stacked:
            moved = before.moved(at[:6], P)
            lines = linearised(moved, tick, exact)
            residual, H, N = lines.stacked()
            whole = np.zeros((len(residual), len(joint)))
            whole[:, :6] = H.dot(before.recentring(at[:6])) if at.any() else H
            for n, target in enumerate(sight.targets.tolist()):
                if target in self.neighbours:
                    k = 6 * seen.index(target) + 9
                    whole[2 * n : 2 * n + 2, k : k + 3] = lines.G[n].dot(self.neighbours[target].R)
            return residual, whole, N

        dx, after, nis = halfway(joint, look(np.zeros(len(joint))), look, 6)
        G = before.recentring(dx[:6])
        self.state = before.corrected(dx[:6], after[:6, :6])
        self.carry(solve(P, after[:6, :6].dot(G.T)).T, [t for t in self.neighbours if t not in seen])
        for n, (target, was) in enumerate(zip(seen, of, strict=True)):
            cross = G.dot(after[:6, 6 * n + 6 : 6 * n + 12])
            self.neighbours[target] = Neighbour(was.number, was.R, was.P, cross)
        return nis

    def joint_covariance(self, of: Sequence[Neighbour], told: Array | None) -> Array:
        """Return the joint covariance of the own error and those of neighbours, which is positive definite."""
        size = 6 + 6 * len(of)
        joint = np.zeros((size, size))
        joint[:6, :6] = self.state.P
        for n, one in enumerate(of):
            k = slice(6 * n + 6, 6 * n + 12)
            joint[k, k], joint[:6, k], joint[k, :6] = one.P, one.cross, one.cross.T
            if told is not None:
                joint[k, 6 : 6 * n + 6] = told[n, :n].transpose(1, 0, 2).reshape(6, -1)
                joint[6 : 6 * n + 6, k] = joint[k, 6 : 6 * n + 6].T
        if not of or _is_definite(joint):
            return joint
        alone = np.kron(np.eye(len(of) + 1), np.ones((6, 6)))
        for factor in SHRINKING:
            shrunk = joint * (alone + factor * (1.0 - alone))
            if _is_definite(shrunk):
                return shrunk
        return shrunk


def _is_definite(P: Array) -> bool:
    try:
        cholesky(P)
    except np.linalg.LinAlgError:
        return False
    return True
