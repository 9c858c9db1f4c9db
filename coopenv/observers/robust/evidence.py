"""A sender's place against bearings: what all innovations together say of how far it is from where it tells.

The filter knows how an error of a sender would show in every innovation r of covariance S, M = H_0 C P_s^-1 + H_s, what
has passed into the vehicle's own pose included. So sums of M^T S^-1 M and M^T S^-1 r are information on that error
(Willsky and Jones, A generalized likelihood ratio approach to the detection and estimation of jumps in linear systems,
IEEE Transactions on Automatic Control 21(1), 1976). It contradicts the sender where its covariance has no room for it.
The correction that is not carried out, because the sender is only considered, is P_s M^T S^-1 r.
"""

from typing import Any

import warp as wp

from coopenv.estimation.linalg import block3
from coopenv.observers.robust import constants
from coopenv.observers.robust.memory import Frame, mat33d
from coopenv.observers.robust.trust import accuse
from coopenv.world.device_function import device_function


@wp.func
def size_squared(x: Any, P: Any):
    """Return the squared size of a vector in standard deviations; 0 where P is no covariance."""
    return wp.max(wp.dot(x, wp.inverse(P) * x), wp.float64(0.0))


@device_function
def certainty_of(memory: Any, world: int, i: int, sender: int):
    """Return the information on how far a sender is from where it says, 1/m^2; at first there is hardly any."""
    V = memory.word[world, i, sender].certainty
    if wp.trace(V) == wp.float64(0.0):
        V = wp.float64(constants.LEAST_CERTAINTY) * wp.identity(3, wp.float64)
    return V


@device_function
def carry_evidence(memory: Any, world: int, i: int, sender: int, x: Any, variance: Any):
    """Let evidence be about where a sender says to be now: x (m) from where odometry of a variance (m^2) has led."""
    covariance = wp.inverse(certainty_of(memory, world, i, sender))
    believed = covariance * memory.word[world, i, sender].offset - x
    certainty = wp.inverse(covariance + variance * wp.identity(3, wp.float64))
    memory.word[world, i, sender].certainty = certainty
    memory.word[world, i, sender].offset = certainty * believed


@device_function
def share_of(frame: Frame, memory: Any, world: int, dt: Any):
    """Return which share of a frame's information counts: noise that is not the camera's lasts for many frames."""
    frames = wp.max(wp.float64(constants.NEWS_TIME) / dt, wp.float64(1.0))
    most = frame.variance
    for m in range(frame.lines):
        if memory.line[world, m].fits == 1:
            lasting = frames * (memory.line[world, m].noise - frame.variance)
            most = wp.max(most, frame.variance + lasting)
    return wp.float64(constants.EVIDENCE_SHARE) * frame.variance / most


@device_function
def note_evidence(memory: Any, world: int, i: int, n: int, lines: int, share: Any):
    """Add what a frame says of how far member n is from where it says, along the axes of the map."""
    D = mat33d()
    for m in range(lines):
        if memory.line[world, m].fits == 1:
            g = memory.gain[world, m, n]
            K = memory.line[world, m].weight * g
            D = D + wp.transpose(K[:, 3:]) * g[:, 3:]
    R = memory.member[world, i, n].pose.R
    inverse = R * wp.inverse(block3(memory.P[world, i, n, n], 3, 3))
    sender = memory.member[world, i, n].vehicle
    correction = memory.scratch[world, n].full_correction
    certainty = certainty_of(memory, world, i, sender) + share * (inverse * D * wp.transpose(inverse))
    offset = memory.word[world, i, sender].offset + share * (inverse * correction[3:])
    memory.word[world, i, sender].offset = offset
    memory.word[world, i, sender].certainty = certainty


@device_function
def contradiction(memory: Any, world: int, i: int, n: int):
    """Return by how much bearings contradict member n, squared in standard deviations."""
    sender = memory.member[world, i, n].vehicle
    certainty = certainty_of(memory, world, i, sender)
    offset = memory.word[world, i, sender].offset
    covariance = wp.inverse(certainty)
    R = memory.member[world, i, n].pose.R
    P = R * block3(memory.P[world, i, n, n], 3, 3) * wp.transpose(R)
    return size_squared(covariance * offset, P + covariance)


@device_function
def likely_error(memory: Any, world: int, i: int, n: int):
    """Return how far member n is likely to be from where it says, m: some metre at most, unless bearings tell."""
    sender = memory.member[world, i, n].vehicle
    certainty = certainty_of(memory, world, i, sender)
    return wp.length(wp.inverse(certainty + wp.identity(3, wp.float64)) * memory.word[world, i, sender].offset)


@device_function
def test_words(frame: Frame, memory: Any, world: int, i: int, now: Any):
    """Weigh a frame's bearings against what every member says; accuse the one that they contradict most."""
    worst = int(0)
    most = wp.float64(constants.WORD_GATE)
    share = share_of(frame, memory, world, now.period)
    for n in range(memory.belief[world, i].others, memory.belief[world, i].members):
        if memory.member[world, i, n].considered == 1:
            note_evidence(memory, world, i, n, frame.lines, share)
            size = contradiction(memory, world, i, n)
            if size > most:
                worst = n
                most = size
    if worst > 0:
        accuse(memory, world, i, worst, likely_error(memory, world, i, worst), 1)
