"""The plug-in observers of one world's vehicles and the messages between them.

A source of ticks drives a group: the runner on a record, the environment on a world or a replay.
"""

import copy
from collections.abc import Callable, Sequence
from pathlib import Path
from time import perf_counter
from traceback import extract_tb
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coopenv.base.errors import CoopenvError, error_text, shown
from coopenv.estimation import UNKNOWN
from coopenv.estimation.poses import Array, Coordinates
from coopenv.observers.contract import (
    Estimate,
    Factory,
    JointObserver,
    Message,
    Observer,
    ObserverInit,
    Setup,
    Tick,
    check_estimate,
    check_message,
)
from coopenv.observers.faults import Interference, altered
from coopenv.observers.mailbox import Mailbox
from coopenv.observers.sensed import Sensed


class ObserverError(CoopenvError):
    """An observer raised an exception or returned an invalid estimate; the message names vehicle, time and reason."""


def failure_text(error: BaseException) -> str:
    """Return an exception of an observer in words, with its line where it is not one of this package."""
    if isinstance(error, ObserverError):
        return str(error)
    last = extract_tb(error.__traceback__)[-1]
    where = "" if isinstance(error, CoopenvError) else f" ({Path(last.filename).name}:{last.lineno})"
    return f"{error_text(error)}{where}"


class TimedEstimate(NamedTuple):
    """An estimate and its time, s (message included; a joint observer's time is divided by the vehicles)."""

    estimate: Estimate
    elapsed: float


Tamper = Callable[[int, float, Observer, Message], Message]
"""(vehicle, time in s, observer, message): returns the broadcast in place of a message, in tests and attacks."""


class ObserverGroup:
    """One observer per vehicle, or a joint one of all; `start` comes first and begins anew.

    Exceptions and invalid estimates of observers become an `ObserverError`.
    """

    def __init__(self, factory: Factory, observer_init: ObserverInit, tamper: Tamper | None = None) -> None:
        self.factory, self.observer_init, self.tamper = factory, observer_init, tamper
        self.joint = bool(getattr(factory, "joint", False))

    def start(self, rotation: Array, position: Array, interference: Interference | None = None) -> None:
        """Build the observers and start them at poses (N, 3, 3) and (N, 3), map frame, m."""
        setups = self.observer_init.setups
        self.mail = Mailbox(self.observer_init)
        self.coordinates: Coordinates | None = None
        self.observers: list[Any] = []
        covariances = [P.copy() for P in self.observer_init.start_covariance]
        poses = [(R.copy(), p.copy()) for R, p in zip(rotation, position, strict=True)]
        for i, of in enumerate([setups] if self.joint else setups):
            try:
                observer = self.factory(of)
                self.observers.append(observer)
                if self.joint:
                    observer.reset(poses, covariances)
                else:
                    observer.reset(poses[i], covariances[i])
                    self._post(i, 0, observer.message(), interference, None)
            except BaseException as error:
                raise self._blamed(error, 0, None if self.joint else i) from error

    def update(
        self, vehicle: int, sensed: Sensed, inbox_tick: ArrayLike, interference: Interference | None = None
    ) -> TimedEstimate:
        """Let one vehicle's observer take a tick; vehicles come in the order of the observer_init.

        `inbox_tick` is as for `Mailbox.inbox`; `interference` holds the world's faults at this tick.
        """
        k, clock = sensed.index, None if interference is None else interference.clock
        try:
            restarts = interference is not None and interference.restarts[vehicle]
            if restarts:
                self.mail.received[vehicle].clear()
            messages = self.mail.inbox(k, vehicle, inbox_tick, sensed.messages, clock)
            tick = sensed.tick(self.observer_init.setups[vehicle], messages, interference)
            if restarts:
                self._restart(vehicle, tick.landmarks)
            observer = self.observers[vehicle]
            begin = perf_counter()
            estimate = observer.update(tick)
            message = observer.message() if k % self.observer_init.period == 0 else None
            elapsed = perf_counter() - begin
            self._check(estimate)
            if message is not None:
                self._post(vehicle, k, message, interference, self.tamper)
        except BaseException as error:
            raise self._blamed(error, k, vehicle) from error
        return TimedEstimate(estimate, elapsed)

    def _restart(self, vehicle: int, landmarks: Array) -> None:
        """Restart a vehicle's observer with a wide prior about the centre of the landmarks (L, 3) of its map."""
        middle = landmarks.mean(axis=0) if len(landmarks) else np.zeros(3)
        self.observers[vehicle] = self.factory(self.observer_init.setups[vehicle])
        self.observers[vehicle].reset((np.eye(3), middle), UNKNOWN.copy())

    def _post(
        self, vehicle: int, k: int, message: Message, interference: Interference | None, tamper: Tamper | None
    ) -> None:
        """Send a message, changed by the world's faults and by `tamper`.

        A CoopenvError names why it is invalid. An unchanged valid message is checked by the mailbox alone.
        """
        if not isinstance(message, Message):
            raise CoopenvError(f"message returned {shown(message)}, expected a Message")
        unchanged = interference is None and tamper is None
        if not unchanged:
            check_message(message)
        observer, replay, kept = self.observers[vehicle], 0, 0
        if message.covariance is not None:
            self.mail.forms[vehicle] = np.shape(message.covariance)
        if interference is not None:
            shift, turn, std = interference.shift[vehicle], interference.turn[vehicle], interference.std[vehicle]
            message = altered(observer, message, shift, turn, float(std), bool(interference.consistent[vehicle]))
            replay, kept = int(interference.replay[vehicle]), int(interference.kept[vehicle])
        if tamper is not None:
            message = tamper(vehicle, k * self.observer_init.dt, observer, message)
        if not self.mail.post(vehicle, k, message, replay, kept) and unchanged:
            check_message(message)

    @property
    def refused(self) -> NDArray[np.int64]:
        """(N,) received messages that were invalid, or that the vehicle's observer could not read."""
        refused = self.mail.refused.copy()
        for i, observer in enumerate(self.observers):
            refused[i] += getattr(observer, "ignored_messages", 0)
        return refused

    def update_all(self, sensed: Sensed, interference: Interference | None = None) -> list[TimedEstimate]:
        """Let a joint observer take a tick of every vehicle."""
        setups = self.observer_init.setups
        try:
            ticks = [sensed.tick(setup, {}, interference) for setup in setups]
            begin = perf_counter()
            estimates = self.observers[0].update(ticks)
            messages = self.observers[0].messages()
            elapsed = (perf_counter() - begin) / len(setups)
            for i, (estimate, message) in enumerate(zip(estimates, messages, strict=True)):
                self._check(estimate)
                check_message(message)
                self.mail.bytes[i] += message.size_bytes
        except BaseException as error:
            raise self._blamed(error, sensed.index) from error
        return [TimedEstimate(estimate, elapsed) for estimate in estimates]

    def _check(self, estimate: Estimate) -> None:
        check_estimate(estimate)
        self.coordinates = self.coordinates or estimate.coordinates
        if estimate.coordinates is not self.coordinates:
            raise CoopenvError("error coordinates must stay the same")

    def _blamed(self, error: BaseException, k: int, vehicle: int | None = None) -> ObserverError:
        """Return an error that names the vehicle, the time and the reason; KeyboardInterrupt itself is raised."""
        if isinstance(error, KeyboardInterrupt):
            raise error
        whose = "" if vehicle is None else f"at {self.observer_init.setups[vehicle].name} "
        return ObserverError(f"{whose}at {k * self.observer_init.dt:.3f} s: {failure_text(error)}")

    def get_state(self) -> dict[str, Any]:
        """Return a deep copy of the observers and of all messages, if they can be copied; empty before the start."""
        if not hasattr(self, "mail"):
            return {}
        state = {"observers": self.observers, "coordinates": self.coordinates, "mail": self.mail.get_state()}
        try:
            return copy.deepcopy(state)
        except Exception as error:
            raise CoopenvError(f"the observers' state cannot be copied: {error_text(error)}") from error

    def checked_state(self, state: Any, begun: bool) -> dict[str, Any]:
        """Return a checked state for `set_state`, from a state of `get_state` of such a group, before or after a start.

        A CoopenvError means that it is of another group, or that a copy of an observer of this package cannot take a
        tick. Observers of users are not tried: they can run any code.
        """
        try:
            copied = copy.deepcopy(state)
            if copied == {} and not begun:
                return {}
            observers, coordinates, mail = (copied[name] for name in ("observers", "coordinates", "mail"))
            kind, count = (JointObserver, 1) if self.joint else (Observer, len(self.observer_init.setups))
            fit = isinstance(observers, list) and len(observers) == count
            fit = fit and all(isinstance(observer, kind) for observer in observers)
            if len(copied) != 3 or not fit or not (coordinates is None or isinstance(coordinates, Coordinates)):
                raise CoopenvError("not one observer per vehicle, or not with their coordinates")
            copied["mail"] = Mailbox(self.observer_init)
            copied["mail"].set_state(mail)
            if all(type(observer).__module__.startswith("coopenv.") for observer in observers):
                self._try(copy.deepcopy(observers))
        except Exception as error:  # of any other value
            raise CoopenvError(f"state: the observers do not fit: {error_text(error)}") from error
        return dict(copied)

    def _try(self, observers: Sequence[Any]) -> None:
        """Let observers take a tick at a standstill, with a bearing; damaged ones raise any exception."""
        ticks = [_still(setup, self.observer_init.dt) for setup in self.observer_init.setups]
        if self.joint:
            for estimate in observers[0].update(ticks):
                check_estimate(estimate)
            return
        for observer, tick in zip(observers, ticks, strict=True):
            check_estimate(observer.update(tick))
            check_message(observer.message())

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore a state of `checked_state`."""
        vars(self).pop("mail", None)
        vars(self).update(state)


def _still(setup: Setup, dt: float) -> Tick:
    """Return a tick of a vehicle that stands and measures the first of its targets ahead."""
    zero, targets = np.zeros(3), setup.targets[:]
    return Tick(
        index=1,
        time=dt,
        dt=dt,
        rotation=np.eye(3),
        translation=zero,
        velocity=zero,
        angular_velocity=zero,
        targets=targets,
        bearings=np.tile([1.0, 0.0, 0.0], (len(targets), 1)),
        valid=np.arange(len(targets)) == 0,
        landmarks=np.arange(3.0 * setup.landmarks).reshape(-1, 3),
        messages={},
        lever_arm=setup.lever_arm,
        noise=setup.noise.moving(zero, zero),
    )
