"""A world whose ticks come from a backend, one by one; observers and results run on it as on any other world."""

from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, NoReturn, cast

import numpy as np

from coopenv.base.errors import CoopenvError
from coopenv.estimation.poses import exp_so3, exp_translation
from coopenv.observers.contract import Message, ObserverInit
from coopenv.observers.kernel_observer import views_of
from coopenv.observers.readings import nothing_measured
from coopenv.observers.registry import find_embedded
from coopenv.observers.sensed import Sensed, check_tick, is_due
from coopenv.observers.setups import start_covariances
from coopenv.sources.base import (
    Backend,
    Broadcasting,
    Command,
    Repeating,
    SensingWorld,
    VehicleBroadcast,
    WorldBackend,
    is_valid_message,
)
from coopenv.sources.feed import RECORDED, Feed, unknown_truth
from coopenv.world.embedded import HOST
from coopenv.world.state import fields, state_fields
from coopenv.world.world import Keys, Options


def open_world(backend: Backend, worlds: int, dtype: str, device: str, threads: int | None) -> SensingWorld:
    """Return the world or worlds that a backend's ticks fill; arguments and errors as for `World`."""
    if backend.capabilities.batched:
        return cast(WorldBackend, backend).world(worlds, dtype, device, threads)
    return TickWorld(backend, worlds, dtype, device)


class TickWorld(SensingWorld):
    """One world filled with the ticks of a backend.

    A missing vehicle continues with its last odometry and sees nothing. Unknown truth is NaN. The episode ends with the
    last tick of the backend.
    """

    source = RECORDED

    def __init__(self, backend: Backend, worlds: int, dtype: str, device: str) -> None:
        """Build the arrays. Raises CoopenvError: more than one world, or not on the CPU."""
        self._backend = backend
        self._name = f"backend {type(backend).__name__}"
        if worlds != 1 or device != "cpu":
            raise CoopenvError(f"{self._name} gives the ticks of one world to the CPU, not of {worlds} to {device}")
        scenario = backend.scenario
        observer = find_embedded(scenario.observer.name) or HOST
        super().__init__(scenario, 1, dtype, device, 1, observer, start_covariances(scenario))
        self._present = _nothing(self.observer_init)
        self._ticks: Iterator[Sensed] = iter(())
        self._adopted: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        """Rotation and body-frame position of the estimates that were received of vehicles estimated elsewhere."""
        self._parts: dict[int, SimpleNamespace] = {}

    def sensed(self, world: int, k: int) -> Sensed:
        """Return the present tick."""
        return self._present

    def _build_model(self) -> Any:
        model = super()._build_model()
        markers, centers = model.scene.marker.numpy(), model.scene.body_center.numpy()
        centers[: model.landmarks] -= markers[: model.landmarks]
        markers[: model.landmarks] = 0.0  # a source gives the visible point of a landmark
        model.scene.marker.assign(markers)
        model.scene.body_center.assign(centers)
        return model

    def _build_record(self) -> Any:
        self._feed = Feed(1, self.model, self.scenario, self.precision, self.device)
        return self._feed.record

    def reset(self, keys: Keys = None, mask: np.ndarray | None = None, options: Options = None) -> None:
        """Begin an episode of the backend, see `World.reset`."""
        self._ticks = iter(())
        self._present = _nothing(self.observer_init)
        self._adopted.clear()
        self._clear_marks()
        self.missing_in_all[:] = 0
        self._take(self._backend.reset(None if keys is None or keys[0] is None else int(keys[0]), options or {}), 0)
        if isinstance(self._backend, Repeating):
            key, episode = self._backend.drawn
            self.state.seed.assign(np.array([key], dtype=np.uint64))
            self.state.episode.assign(np.array([(episode - 1) % 2**32], dtype=np.uint32))
            keys = None
        super().reset(keys, mask)
        self._receive()
        self._end_tick()

    def load(self) -> None:
        """Load the kernels, see `World.load`."""
        super().load()
        self.mask.fill_(1)  # so that nothing moves: in real time the first tick must not wait for its launch
        self.decide()
        self.mask.zero_()

    def advance(self, ticks: int) -> None:
        """Run camera ticks, as many as the backend gives."""
        for _ in range(ticks):
            over = self.view("tick")[0] >= self.model.horizon_ticks or self.mask.numpy()[0] != 0
            if over or not self.fetch():
                return
            super().advance(1)
            self._end_tick()

    def finish(self) -> None:
        """End the tick, see `World.finish`."""
        super().finish()
        if self.mask.numpy()[0] == 0:
            self._end_tick()

    def fetch(self) -> bool:
        """Get the next tick from the backend, which is sent its command first where a decision begins."""
        k = int(self.view("tick")[0]) + 1
        if self.view("exhausted")[0] != 0:
            return False
        if (k - 1) % self.model.ticks_per_decision == 0:
            self.decide()
            self._clear_marks()
            self._ticks = iter(self._backend.advance(Command.of(self.view("command")[0])))
        tick = next(self._ticks, None)
        if tick is None:
            self.view("exhausted")[0] = 1
            return False
        self._take(tick, k)
        self._receive()
        return True

    def get_state(self) -> NoReturn:
        """Refuse. Raises CoopenvError: always."""
        raise CoopenvError(f"{self._name} gives ticks from elsewhere, so that no state of them can be saved")

    def _clear_marks(self) -> None:
        self.late[:] = 0
        self.missing[:] = 0

    def _take(self, tick: Sensed, k: int) -> None:
        """Check a tick and put it where the kernels read it."""
        try:
            check_tick(tick, k, self.observer_init)
        except CoopenvError as error:
            raise CoopenvError(f"{self._name}: {error}") from None
        last, self._present = self._present, self._completed(tick)
        now = self._present
        self._feed.fill(now, (now if k == 0 else last).truth or unknown_truth(now))
        self.late += now.late
        self.missing += now.missing
        self.missing_in_all += now.missing

    def _completed(self, tick: Sensed) -> Sensed:
        """Return a sealed tick without gaps: a missing vehicle continues with its last odometry."""
        last, missing = self._present, np.array(tick.filled("missing"), bool)
        ages = {name: tick.filled(name) for name in ("odometry_age", "bearing_age")}
        arrays: dict[str, Any] = {name: np.array(value, float) for name, value in (tick.measured() | ages).items()}
        arrays["visible"] = tick.visible.copy()
        for i in np.flatnonzero(missing):
            turn, step = last.angular_velocity[i] * tick.dt, last.velocity[i] * tick.dt
            arrays["rotation"][i], arrays["translation"][i] = exp_so3(turn), exp_translation(turn, step)
        for name in arrays.keys() & {"velocity", "angular_velocity", "pan"}:
            arrays[name][missing] = last.filled(name)[missing]
        arrays["odometry_age"][missing] = last.filled("odometry_age")[missing] + tick.dt
        arrays["visible"][missing] = False
        arrays["bearings"][~arrays["visible"]] = np.nan
        readings = nothing_measured(self.observer_init.setups)
        for name, values in readings.items():
            values[~missing] = tick.readings.get(name, values)[~missing]
        for values in (*arrays.values(), *readings.values()):
            values.setflags(write=False)
        due = bool(is_due(tick.index, self.model.observer.rate / self.scenario.rates.camera))
        late = np.array(tick.filled("late"), bool)
        return replace(tick, **arrays, readings=readings, missing=missing, late=late, due=due)

    def _receive(self) -> None:
        """Put messages from vehicles that are estimated elsewhere into the inboxes; malformed ones are as none."""
        now, accepted = self._present, {}
        for (receiver, sender), received in now.messages.items():
            message, sent = received.message, max(0, now.index - round(received.age / now.dt))
            if not (is_valid_message(message) and self._read(receiver, sender, message, sent)):
                self._backend.health.rejected += 1
                continue
            accepted[receiver, sender] = received
            if message.position is not None:
                R = np.eye(3) if message.rotation is None else np.asarray(message.rotation, dtype=float)
                self.view("inbox_rotation")[0, receiver, sender] = R
                position = message.position - R @ self.observer_init.setups[sender].marker
                self.view("inbox_position")[0, receiver, sender] = position
                self.view("inbox_tick")[0, receiver, sender] = self.view("inbox_stamp")[0, receiver, sender] = sent
        self._present = replace(now, messages=accepted)

    def _end_tick(self) -> None:
        """Adopt the received estimates of vehicles estimated elsewhere; let the backend broadcast the others."""
        here = self._backend.capabilities.estimated
        for (_, sender), received in self._present.messages.items() if here is not None else ():
            R, place = received.message.rotation, received.message.position
            if R is not None and place is not None:
                self._adopted[sender] = R, R.T @ place - self.observer_init.setups[sender].marker
        for sender, (R, p) in self._adopted.items():
            self.view("estimate_rotation")[0, sender], self.view("estimate_position")[0, sender] = R, p
        if isinstance(self._backend, Broadcasting) and int(self.view("tick")[0]) % self.observer_init.period == 0:
            estimated = range(self.model.vehicles) if here is None else here
            self._backend.broadcast([self._broadcast_of(i) for i in estimated])

    def _broadcast_of(self, vehicle: int) -> VehicleBroadcast:
        view, messages = self.view, self.observer.messages
        message = None if messages is None else messages.write(self._parts_of(vehicle))
        R = np.array(view("estimate_rotation")[0, vehicle], dtype=float)
        position = R @ np.array(view("estimate_position")[0, vehicle], dtype=float)
        P, level = np.array(view("covariance")[0, vehicle], dtype=float), float(view("protection_level")[0, vehicle, 0])
        return VehicleBroadcast(vehicle, R, position, P, message, level or np.inf)

    def _read(self, receiver: int, sender: int, message: Message, sent: int) -> bool:
        """Hand a message to the embedded observer, if that has messages of its own; return whether it can read it."""
        if self.observer.messages is None:
            return True
        try:
            self.observer.messages.read(self._parts_of(receiver), sender, message, sent)
        except (CoopenvError, ValueError, TypeError, LookupError, ArithmeticError):
            return False
        return True

    def _parts_of(self, vehicle: int) -> SimpleNamespace:
        """Return a vehicle's part of the embedded observer's memory and of the state, as its messages see them."""
        if vehicle not in self._parts:
            memory = views_of(self.memory, fields(self.observer.memory), vehicle)
            state = views_of(self.state, state_fields(self.precision), vehicle)
            unit = float(self.model.camera_period)
            self._parts[vehicle] = SimpleNamespace(
                memory=memory,
                state=state,
                setup=self.observer_init.setups[vehicle],
                unit=unit,
                units=lambda seconds: round(seconds / unit),
            )
        return self._parts[vehicle]


def _nothing(observer_init: ObserverInit) -> Sensed:
    """Return the measurements before the first tick: no motion, nothing in view."""
    N, T = len(observer_init.setups), len(observer_init.setups[0].target_names)
    return Sensed(
        index=-1,
        dt=observer_init.dt,
        rotation=np.tile(np.eye(3), (N, 1, 1)),
        translation=np.zeros((N, 3)),
        velocity=np.zeros((N, 3)),
        angular_velocity=np.zeros((N, 3)),
        bearings=np.full((N, T, 3), np.nan),
        visible=np.zeros((N, T), bool),
        landmarks=np.zeros((observer_init.setups[0].landmarks, 3)),
        odometry_age=np.full(N, np.inf),
        readings=nothing_measured(observer_init.setups),
    )
