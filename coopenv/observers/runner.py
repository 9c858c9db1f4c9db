"""Record what every vehicle of a world senses, and run any observer on the record.

A record is made once per seed and serves every observer, so that all of them see the same ticks. Observers read ticks;
truth only judges them. What neighbours tell each other are the observers' own messages, sent with the scenario's
period and delivered, lost or delayed as the world's radio delivered its own.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coopenv.estimation.arrays import Array
from coopenv.estimation.coordinates import Coordinates
from coopenv.estimation.metrics import orientation_error_deg
from coopenv.observers.contract import Estimate, Factory
from coopenv.observers.group import Answer, Group, ObserverError, Tamper
from coopenv.observers.recording import Recording
from coopenv.observers.registry import find

PLANAR_STATES = (2, 3, 4)
"""Yaw, x and y among (theta, rho): what NEES is about for vehicles on a plane, whose other errors are zero."""


@dataclass(frozen=True)
class Run:
    """How one observer did on one record; NaN from where it failed."""

    t: Array  # (K,) s
    rotation: Array  # (K, N, 3, 3) estimates
    position: Array  # (K, N, 3) map, m
    covariance: Array  # (K, N, 6, 6) rad and m, NaN where the observer states none
    coordinates: Coordinates
    judged: NDArray[np.bool_]  # (K, N) where the truth is known
    position_error: Array  # (K, N) m
    orientation_error: Array  # (K, N) deg, geodesic
    nees: Array  # (K, N), in the observer's own coordinates
    nees_dof: int  # 6, or 3 on a plane
    nis: Array  # (K, N), NaN where the observer tells none
    nis_dof: NDArray[np.int64]  # (K, N)
    bytes_per_second: Array  # (N,) sent, payload
    microseconds_per_update: Array  # (N,) median, message included; a joint observer's time is shared out
    failure: str = ""  # who failed, when and why; empty where nobody did

    def position_rmse(self, after: float = 0.0) -> Array:
        """Return (N,) the root mean square of |pbar - pbarhat| from a time on, m."""
        return np.sqrt(self.mean(self.position_error**2, self.t >= after))

    def anees(self, after: float = 0.0) -> Array:
        """Return (N,) the mean NEES from a time on divided by its dimension; 1 for an honest covariance.

        Ticks at which the observer states no covariance, such as the start, do not count; NaN where it never does.
        """
        silent = np.isnan(self.covariance).any(axis=(-1, -2)) & np.isfinite(self.position).all(axis=-1)
        return self.mean(self.nees, (self.t >= after)[:, None] & ~silent) / self.nees_dof

    def mean(self, values: Array, when: NDArray[np.bool_]) -> Array:
        """Return (N,) the mean of values (K, N) over some ticks (K,) or (K, N), those without a known truth left out.

        NaN where the observer failed, and where there is no such tick.
        """
        counted = self.judged & when.reshape(len(when), -1)
        count = counted.sum(axis=0)
        return np.where(count > 0, np.where(counted, values, 0.0).sum(axis=0) / np.maximum(count, 1), np.nan)


def run(observer: str | Factory, recording: Recording, tamper: Tamper | None = None) -> Run:
    """Run an observer, by name or class, for all vehicles on a record.

    An observer that raises or returns something that is not finite ends its run: `Run.failure` says who, when and why.

    Args:
        observer: name or factory.
        recording: what it runs on.
        tamper: changes what some vehicle broadcasts.

    Raises:
        CoopenvError: unknown name.
    """
    factory = find(observer)
    log = _Log(recording)
    group = Group(factory, recording.briefing, tamper)
    try:
        group.start(recording.start_rotation, recording.start_position)
        for i, pose in enumerate(zip(recording.start_rotation, recording.start_position, strict=True)):
            log.write(0, i, Answer(Estimate(*pose), 0.0))
        for k, vehicle, answer in _play(group, recording):
            log.write(k, vehicle, answer)
    except ObserverError as failure:  # its row says what went wrong, the others go on
        log.failure = str(failure)
    return log.result(group)


def _play(group: Group, recording: Recording) -> Iterator[tuple[int, int, Answer]]:
    """Run the observers over a record, yielding (tick, vehicle, answer) after each update."""
    for k in range(1, recording.ticks):
        sensed = recording.at(k)
        if group.joint:
            for i, answer in enumerate(group.update_all(sensed)):
                yield k, i, answer
        else:
            for i in recording.order:
                yield k, i, group.update(i, sensed, recording.inbox_tick[k, i])


class _Log:
    """Collects estimates and judges them at the end."""

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        shape = (recording.ticks, len(recording.setups))
        self.rotation, self.position = np.full((*shape, 3, 3), np.nan), np.full((*shape, 3), np.nan)
        self.covariance, self.elapsed = np.full((*shape, 6, 6), np.nan), np.full(shape, np.nan)
        self.nis, self.nis_dof = np.full(shape, np.nan), np.zeros(shape, np.int64)
        self.failure = ""

    def write(self, k: int, vehicle: int, answer: Answer) -> None:
        """Keep one estimate."""
        estimate = answer.estimate
        self.rotation[k, vehicle], self.position[k, vehicle] = estimate.rotation, estimate.position
        if estimate.covariance is not None:
            self.covariance[k, vehicle] = estimate.covariance
        if estimate.nis is not None and estimate.nis_dof > 0:
            self.nis[k, vehicle], self.nis_dof[k, vehicle] = estimate.nis, estimate.nis_dof
        self.elapsed[k, vehicle] = answer.elapsed

    def result(self, group: Group) -> Run:
        """Compare with the truth, where it is known."""
        r, coordinates = self.recording, group.coordinates or Coordinates.LEFT
        judged = r.truth.known
        known = judged & np.isfinite(self.position[..., 0])
        position_error, orientation_error, nees = (np.full(known.shape, np.nan) for _ in range(3))
        R, p = r.truth.rotation, r.truth.position
        R_hat, p_hat = self.rotation, self.position
        position_error[known] = np.linalg.norm(p[known] - p_hat[known], axis=-1)
        orientation_error[known] = orientation_error_deg(R[known], R_hat[known])
        states = PLANAR_STATES if all(setup.planar for setup in r.setups) else tuple(range(6))
        stated = known & np.isfinite(self.covariance[..., 0, 0])
        if stated.any():
            e = coordinates.error(R[stated], p[stated], R_hat[stated], p_hat[stated])[..., states]
            P = self.covariance[stated][:, states][..., states]
            with suppress(np.linalg.LinAlgError):  # some P is singular
                nees[stated] = np.einsum("...i,...i", e, np.linalg.solve(P, e[..., None])[..., 0])
        duration = max(r.dt, (r.ticks - 1) * r.dt)
        timed = self.elapsed[1:]
        micro = [1e6 * float(np.median(c[np.isfinite(c)])) if np.isfinite(c).any() else np.nan for c in timed.T]
        return Run(
            t=r.t,
            rotation=self.rotation,
            position=self.position,
            covariance=self.covariance,
            coordinates=coordinates,
            judged=judged,
            position_error=position_error,
            orientation_error=orientation_error,
            nees=nees,
            nees_dof=len(states),
            nis=self.nis,
            nis_dof=self.nis_dof,
            bytes_per_second=group.mail.bytes / duration,
            microseconds_per_update=np.array(micro),
            failure=self.failure,
        )
