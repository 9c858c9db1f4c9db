"""Record what every vehicle of a world senses, and run any observer on the record.

A record is made once per seed and serves every observer, so that all of them have the same ticks. Observers read ticks;
truth is only for errors. Messages are those of the observers, sent with the scenario's period and delivered, lost or
delayed like those of the world's radio.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coopenv.estimation.metrics import nees as normalised_error
from coopenv.estimation.poses import Array, Coordinates, orientation_error_deg
from coopenv.observers.contract import Factory
from coopenv.observers.group import ObserverError, ObserverGroup, Tamper, TimedEstimate
from coopenv.observers.recording import Recording, recorded_arrays
from coopenv.observers.registry import find
from coopenv.observers.sensed import Truth

PLANAR_STATES = (2, 3, 4)
"""Yaw, x and y among (theta, rho): the states of NEES for vehicles on a plane, whose other errors are zero."""


@dataclass(frozen=True)
class Run:
    """Estimates and errors of one observer on one record; NaN after a failure."""

    t: Array  # (K,) s
    rotation: Array  # (K, N, 3, 3) estimates
    position: Array  # (K, N, 3) map, m
    covariance: Array  # (K, N, 6, 6) rad and m, NaN where the observer states none
    coordinates: Coordinates  # of the error that the covariance is about
    judged: NDArray[np.bool_]  # (K, N) where the truth is known
    position_error: Array  # (K, N) m
    orientation_error: Array  # (K, N) deg, geodesic
    nees: Array  # (K, N), in the observer's own coordinates
    nees_dof: int  # 6, or 3 on a plane
    nis: Array  # (K, N), NaN where the observer states none
    nis_dof: NDArray[np.int64]  # (K, N)
    protection_level: Array  # (K, N, 2) m and rad, infinite: unknown, NaN where the observer states none
    bytes_per_second: Array  # (N,) sent, payload
    microseconds_per_update: Array  # (N,) median, message included; a joint observer's time is shared out
    refused: NDArray[np.int64]  # (N,) invalid or unreadable messages per receiver
    failure: str = ""  # vehicle, time and reason of a failure; empty without one

    def position_rmse(self, after: float = 0.0) -> Array:
        """Return (N,) the root mean square of |pbar - pbarhat| from a time on, m."""
        return np.sqrt(self.mean(self.position_error**2, self.t >= after))

    def anees(self, after: float = 0.0) -> Array:
        """Return (N,) the mean NEES from a time on divided by its dimension, see `anees_in`."""
        return self.anees_in(self.t >= after)

    def anees_in(self, when: NDArray[np.bool_]) -> Array:
        """Return (N,) the mean NEES over ticks (K,), divided by its dimension; 1 for a consistent covariance.

        Ticks at which the observer states no covariance, such as the start, do not count; NaN where it never does.
        """
        silent = np.isnan(self.covariance).any(axis=(-1, -2)) & np.isfinite(self.position).all(axis=-1)
        return self.mean(self.nees, when[:, None] & ~silent) / self.nees_dof

    def mean(self, values: Array, when: NDArray[np.bool_]) -> Array:
        """Return (N,) the mean of values (K, N) over some ticks (K,) or (K, N), those without a known truth left out.

        NaN where the observer failed, and where there is no such tick.
        """
        counted = self.judged & when.reshape(len(when), -1)
        count = counted.sum(axis=0)
        return np.where(count > 0, np.where(counted, values, 0.0).sum(axis=0) / np.maximum(count, 1), np.nan)


def run(observer: str | Factory, recording: Recording, tamper: Tamper | None = None) -> Run:
    """Run an observer, by name or class, for all vehicles on a record.

    Received messages are checked, and invalid ones count as lost, so that none can end a run. An observer that raises
    an exception or returns numbers that are not finite ends its run: `Run.failure` names vehicle, time and reason.

    Args:
        observer: name or factory.
        recording: its data.
        tamper: changes the broadcasts of some vehicle.

    Raises:
        CoopenvError: unknown name, or arrays of the recording that do not belong together.
    """
    factory = find(observer)
    recorded_arrays(recording)
    r, failure = recording, ""
    group, shape = ObserverGroup(factory, r.observer_init, tamper), (r.ticks, len(r.setups))
    R, p, P = (np.full((*shape, *of), np.nan) for of in ((3, 3), (3,), (6, 6)))
    levels = np.full((*shape, 2), np.nan)
    nis, nis_dof, elapsed = np.full(shape, np.nan), np.zeros(shape, np.int64), np.full(shape, np.nan)
    try:
        group.start(r.start_rotation, r.start_position, None if r.interference is None else r.interference.at(0))
        R[0], p[0] = r.start_rotation, r.start_position
        for k, i, (estimate, seconds) in _play(group, r):
            R[k, i], p[k, i], elapsed[k, i] = estimate.rotation, estimate.position, seconds
            if estimate.covariance is not None:
                P[k, i] = estimate.covariance
            if estimate.protection_level is not None:
                levels[k, i] = estimate.protection_level
            if estimate.nis is not None and estimate.nis_dof > 0:
                nis[k, i], nis_dof[k, i] = estimate.nis, estimate.nis_dof
    except ObserverError as error:  # the comparison goes on with the next observer
        failure = str(error)
    coordinates = group.coordinates or Coordinates.LEFT
    states = PLANAR_STATES if r.on_a_plane else tuple(range(6))
    position_error, orientation_error, nees = _errors(r.truth, R, p, P, coordinates, states)
    timed = [column[np.isfinite(column)] for column in elapsed[1:].T]
    return Run(
        t=r.t,
        rotation=R,
        position=p,
        covariance=P,
        coordinates=coordinates,
        judged=r.truth.known,
        position_error=position_error,
        orientation_error=orientation_error,
        nees=nees,
        nees_dof=len(states),
        nis=nis,
        nis_dof=nis_dof,
        protection_level=levels,
        bytes_per_second=group.mail.bytes / max(r.dt, (r.ticks - 1) * r.dt),
        microseconds_per_update=np.array([1e6 * float(np.median(c)) if len(c) else np.nan for c in timed]),
        refused=group.refused,
        failure=failure,
    )


def _play(group: ObserverGroup, recording: Recording) -> Iterator[tuple[int, int, TimedEstimate]]:
    """Run the observers over a record, yielding (tick, vehicle, answer) after each update."""
    for k in range(1, recording.ticks):
        sensed = recording.at(k)
        faults = None if recording.interference is None else recording.interference.at(k)
        if group.joint:
            for i, answer in enumerate(group.update_all(sensed, faults)):
                yield k, i, answer
        else:
            for i in recording.order:
                yield k, i, group.update(i, sensed, recording.inbox_tick[k, i], faults)


def _errors(
    truth: Truth, R_hat: Array, p_hat: Array, P: Array, coordinates: Coordinates, states: tuple[int, ...]
) -> tuple[Array, Array, Array]:
    """Return position errors, orientation errors and NEES (K, N) where truth and estimate are known, NaN elsewhere."""
    R, p, known = truth.rotation, truth.position, truth.known & np.isfinite(p_hat[..., 0])
    position_error, orientation_error, nees = (np.full(known.shape, np.nan) for _ in range(3))
    position_error[known] = np.linalg.norm(p[known] - p_hat[known], axis=-1)
    orientation_error[known] = orientation_error_deg(R[known], R_hat[known])
    stated = known & np.isfinite(P[..., 0, 0])
    if stated.any():
        e = coordinates.error(R[stated], p[stated], R_hat[stated], p_hat[stated])[..., states]
        nees[stated] = normalised_error(e, P[stated][:, states][..., states])
    return position_error, orientation_error, nees
