"""An observer with kernels as a plug-in: one vehicle, fed with ticks on the host.

The kernels get a world of their own, filled with the measurements and messages of this vehicle. Where arrays have a row
per vehicle, one row is shared by all of them; truth is NaN.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import warp as wp

from coopenv.base.errors import CoopenvError
from coopenv.estimation import Sight
from coopenv.estimation.poses import Array, Coordinates, left_covariance
from coopenv.measurements.kinds import MOST_ROWS
from coopenv.measurements.sensor import MAP, number_of
from coopenv.observers.contract import Estimate, Message, Received, Setup, Tick, check_message
from coopenv.world.embedded import Embedded, Messages
from coopenv.world.launch import Launcher, start_warp
from coopenv.world.model import PRESCRIBED, STATIC, Precision, entry_struct, mat66d, model_struct, precision
from coopenv.world.state import SCRATCH, allocate, allocate_state, fields, repeated, state_fields, state_sizes
from coopenv.world.step import observer_kernels
from coopenv.world.warp_internals import struct_of


def views_of(record: Any, declared: Mapping[str, Any], vehicle: int = 0) -> SimpleNamespace:
    """Return a vehicle's part of a record's arrays, which it shares; of the first world."""
    arrays = {name: getattr(record, name).numpy() for name in declared}
    rows = {name: (0, vehicle, ...) if declared[name].axes[1:2] in ("N", SCRATCH) else (0, ...) for name in arrays}
    return SimpleNamespace(**{name: array[rows[name]] for name, array in arrays.items()})


def rotation_to(axis: tuple[float, float, float]) -> Array:
    """Return a rotation (3, 3) whose last column is a unit vector."""
    _, _, rows = np.linalg.svd(np.array([axis], dtype=np.float64))
    return np.column_stack((rows[1], np.cross(axis, rows[1]), axis))


def model_of(setup: Setup, p: Precision) -> Any:
    """Return the model of the world from a vehicle's setup."""
    L, T = setup.landmarks, len(setup.target_names)
    N, model = T - L, model_struct(p)()
    model.landmarks, model.vehicles, model.agents, model.before_boxes = L, N, T, L
    model.listed, model.kept, model.traffic, model.cells.across = 1, 0, 0, 0
    model.samples_per_tick = model.observer.blocks = model.ticks_per_decision = 1
    model.action_size = model.columns = 2
    model.horizon_ticks = 2**31 - 1
    model.odometry_period, model.odometry_rate = setup.noise.odometry_period, 1.0 / setup.noise.odometry_period
    targets = np.full((1, T), -1, dtype=np.int32)
    targets[0, : len(setup.targets)] = setup.targets
    model.targets = repeated(wp.array(targets, dtype=wp.int32, device="cpu"), 0, N)
    model.target_count = wp.full(N, len(setup.targets), dtype=wp.int32, device="cpu")
    model.order = model.rank = wp.array(np.arange(N, dtype=np.int32), dtype=wp.int32, device="cpu")
    model.start.covariance = wp.zeros(2 * N, dtype=mat66d, device="cpu")
    camera, noise, known = entry_struct(p, "camera")(), entry_struct(p, "noise")(), setup.noise
    camera.rotation, camera.position = p.mat33(*rotation_to(setup.optical_axis).ravel()), p.vec3(*setup.lever_arm)
    for name in ("velocity", "angular_velocity", "bearing", "odometry_scale", "odometry_scale_walk"):
        setattr(noise, name, getattr(known, name))
    noise.gyro_bias, noise.gyro_bias_walk = p.vec3(*known.gyro_bias), p.vec3(*known.gyro_bias_walk)
    noise.slip_rate, noise.slip_duration, noise.slip_size, noise.slip_angle = known.slip
    camera.orientation_std, camera.position_std = known.camera_orientation, known.camera_position
    camera.focal_std, camera.orientation_walk = known.focal_length, known.camera_orientation_walk
    camera.latency_std, camera.latency_jitter = known.latency, known.latency_jitter
    model.landmark_std = wp.array(setup.landmark_std or np.zeros(L), dtype=p.scalar, device="cpu")
    fault = entry_struct(p, "fault")()
    fault.clock = known.clock_offset
    for name, entry in (("fault", fault), ("camera", camera), ("noise", noise)):
        setattr(model, name, repeated(wp.array([entry], dtype=struct_of(entry), device="cpu"), 0, N))
    _add_sensors(model, setup, p)
    markers = np.zeros((T, 3))
    markers[L + setup.vehicle] = setup.marker
    model.scene.marker = wp.array(markers, dtype=p.vec3, device="cpu")
    model.radio.period = model.radio.slots = 1
    model.radio.range = model.radio.staleness = math.inf
    gains = setup.gains
    model.observer.k = wp.full(N, gains.k, dtype=p.scalar, device="cpu")
    model.observer.q = wp.array(gains.q, dtype=p.scalar, device="cpu")
    model.observer.v1, model.observer.v2 = gains.V
    model.observer.p1, model.observer.p2 = gains.P0
    model.observer.max_turn = gains.max_turn
    return model


def _add_sensors(model: Any, setup: Setup, p: Precision) -> None:
    """Add the sensors of a vehicle beside its camera to its model."""
    N, T, sensors = model.vehicles, model.agents, setup.sensors
    entries, measures = [], np.zeros((len(sensors), T), np.int32)
    for number, sensor in enumerate(sensors):
        kind, entry = sensor.kind, entry_struct(p, "sensor")()
        entry.kind = number_of(sensor.reference, kind)
        entry.rows, entry.has_target, entry.ratio = kind.rows, int(kind.has_target), 1.0
        entry.rotation, entry.position = p.mat33(*sensor.rotation.ravel()), p.vec3(*sensor.position)
        std = np.hypot(sensor.std, sensor.std_by_distance * USUAL_DISTANCE)
        entry.counted = p.vec6(*np.pad(std, (0, MOST_ROWS - kind.rows)))
        measures[number, sensor.targets[sensor.targets != MAP]] = 1
        entries.append(entry)
    model.sensor = wp.array(entries, dtype=entry_struct(p, "sensor"), device="cpu")
    model.carries = wp.full((N, len(sensors)), 1, dtype=wp.int32, device="cpu")
    model.measures = wp.array(measures, dtype=wp.int32, device="cpu")
    kinds = np.zeros(T, np.int32)
    if setup.landmark_rotation is not None:
        kinds[: setup.landmarks] = np.where(np.isfinite(setup.landmark_rotation).all(axis=(1, 2)), STATIC, PRESCRIBED)
    model.motion.kind = wp.array(kinds, dtype=wp.int32, device="cpu")


PRECISION = "float64"
UNITS_PER_TICK = 64
USUAL_DISTANCE = 3.0  # m, at which noise that grows with the distance counts
"""The kernels' time is a whole number; here it counts 64ths of the first tick. So ticks may come at any time and
messages be of any age, to 0.3 ms at 60 Hz; and, 64 being a power of two, regular ticks are as regular as in a world."""
MOST_UNITS = 2**31 - 1
_VISIBLE, _OUT_OF_VIEW = np.uint8(Sight.VISIBLE), np.uint8(Sight.OUT_OF_VIEW)


class KernelObserver:
    """One vehicle's observer, computed in float64 by the kernels of an embedded one."""

    def __init__(self, embedded: Embedded, setup: Setup) -> None:
        """Allocate the world of a vehicle from its setup."""
        start_warp()
        p = precision(PRECISION)
        self.embedded, self.setup = embedded, setup
        self._model = model_of(setup, p)
        self._kernels = embedded if embedded.fit is None else embedded.fit(self._model)
        self._messages = self._kernels.messages or POSE
        self._camera = rotation_to(setup.optical_axis)  # camera to body
        sizes = {**state_sizes(self._model, 1), **self._kernels.sizes}
        self._records = (
            allocate_state(self._model, 1, p, "cpu", shared="N"),
            allocate(self._kernels.memory, sizes, "cpu", shared="N" + SCRATCH),
        )
        self.state = views_of(self._records[0], state_fields(p))
        """The vehicle's part of the state by name: arrays without the axes W and N."""
        self.memory = views_of(self._records[1], fields(self._kernels.memory))
        """The same of the memory."""
        self._now = [wp.zeros(1, dtype=kind, device="cpu") for kind in (wp.int32, wp.float64, wp.int32)]
        self._now_views = [array.numpy() for array in self._now]
        self._noise_views = self._model.noise.numpy()
        self._start_covariance = self._model.start.covariance.numpy()[setup.vehicle]
        self._set_clock(None, setup.noise.odometry_period)
        self._received: dict[
            int, tuple[Message, int, bool]
        ] = {}  # by sender: the last one, its tick of sending, whether it is valid
        self.ignored_messages = 0
        """Malformed ones since the start."""

    def reset(self, initial_pose: tuple[Array, Array], initial_covariance: Array) -> None:
        """Start at a pose; its covariance is in LEFT coordinates."""
        for view in self._all_views():
            view[...] = np.zeros((), view.dtype)
        s, L, (R, p) = self.state, self.setup.landmarks, initial_pose
        s.estimate_rotation[...], s.estimate_position[...] = R, np.asarray(R).T @ p
        s.covariance[...] = np.diag(np.repeat(self.setup.gains.P0, 3))
        s.rotation[:L], s.rotation[L:] = np.eye(3), np.nan
        if self.setup.landmark_rotation is not None:
            known = self.setup.landmark_rotation
            s.rotation[:L] = np.where(np.isfinite(known), known, np.eye(3))
        for truth in (s.position, s.velocity, s.angular_velocity):
            truth[...] = np.nan
        for never in (s.inbox_tick, s.inbox_stamp, s.outbox_tick, s.bearing_tick, s.reading_tick):
            never[...] = -1
        self._start_covariance[...] = initial_covariance
        self._set_clock(None, self.setup.noise.odometry_period)
        self._received.clear()
        self.ignored_messages = 0
        self._run("start_one")

    def update(self, tick: Tick) -> Estimate:
        """Take one camera tick; a CoopenvError means that the kernels cannot count its time."""
        if self._origin is None:
            self._set_clock(tick.time - tick.dt, tick.dt)
        now = self.units(tick.time - (self._origin or 0.0))
        if not 0 <= now < MOST_UNITS:
            raise CoopenvError(f"{tick.time:g} s is not within {MOST_UNITS * self.unit:.0f} s of the start")
        for view, value in zip(self._now_views, (now, tick.dt, tick.due), strict=True):
            view[0] = value
        self._sense(tick, now)
        self._receive(tick.messages, now)
        self._run("estimate_one", *self._now)
        s, coordinates = self.state, self._kernels.coordinates
        R, p, P = s.estimate_rotation.copy(), s.estimate_position.copy(), s.covariance.copy()
        if coordinates is Coordinates.LEFT:
            P = left_covariance(p, P)
        dof = int(s.nis_dof)
        levels = tuple(s.protection_level.tolist()) if s.protection_level[0] > 0.0 else None
        return Estimate(R, R.dot(p), P, coordinates, float(s.nis) if dof else None, dof, levels)

    def message(self) -> Message:
        """Return the message that the kernels send."""
        self._run("send_one", self._now[0])
        return cast(Message, self._messages.write(self))

    def tampered(self, made: Message, honest: Message) -> Message:
        """Return a false message whose other entries agree with its pose."""
        return cast(Message, self._messages.tampered(made, honest))

    def _sense(self, tick: Tick, now: int) -> None:
        s = self.state
        for name in ("velocity", "angular_velocity"):
            self._noise_views[name] = getattr(tick.noise, name)
        s.increment_rotation[...], s.increment_translation[...] = tick.rotation, tick.translation
        s.odometry_velocity[...], s.odometry_angular_velocity[...] = tick.velocity, tick.angular_velocity
        s.position[: self.setup.landmarks] = tick.landmarks
        s.bearing_age[...] = tick.bearing_age
        s.sight[tick.targets] = np.where(tick.valid, _VISIBLE, _OUT_OF_VIEW)
        seen = tick.targets[tick.valid]
        s.bearing[seen], s.bearing_tick[seen] = tick.bearings[tick.valid] @ self._camera, now
        for number, reading in enumerate(tick.readings):
            targets, values = np.maximum(reading.sensor.targets, 0)[reading.valid], reading.values[reading.valid]
            s.reading[number, targets, : values.shape[1]], s.reading_tick[number, targets] = values, now

    def _receive(self, messages: Mapping[int, Received], now: int) -> None:
        """Write the received messages; a malformed one, or one older than the start, is ignored."""
        s = self.state
        s.inbox_tick[...] = s.inbox_stamp[...] = -1
        for target, received in messages.items():
            sender, sent = target - self.setup.landmarks, now - self.units(received.age)
            message, before, valid = self._received.get(sender, (None, 0, False))
            if message is not received.message or abs(before - sent) > 1:
                before, valid = sent, sent >= 0 and self._read(sender, received.message, sent)
                self._received[sender] = received.message, sent, valid
            if valid:
                s.inbox_tick[sender] = s.inbox_stamp[sender] = before

    def _read(self, sender: int, message: Message, sent: int) -> bool:
        """Hand a message to the kernels; return whether it is well-formed."""
        try:
            check_message(message)
            self._messages.read(self, sender, message, sent)
        except (CoopenvError, ValueError, TypeError, LookupError, ArithmeticError):
            self.ignored_messages += 1
            return False
        return True

    def units(self, seconds: float) -> int:
        """Return a time in the kernels' units."""
        return round(min(max(seconds / self.unit, -MOST_UNITS), MOST_UNITS))

    def _set_clock(self, origin: float | None, period: float) -> None:
        """Let the kernels count from an origin on, s, by parts of a tick of a period, s."""
        if not 0.0 < period < math.inf:
            raise CoopenvError(f"a tick of {period} s")
        self._origin, self.unit = origin, period / UNITS_PER_TICK
        self._model.camera_period, self._model.camera_rate = self.unit, 1.0 / self.unit
        self._launch = Launcher(1, "cpu", PRECISION)

    def _run(self, name: str, *moving: Any) -> None:
        kernel = observer_kernels(self._kernels, precision(PRECISION))[name]
        self._launch(name, kernel, [self._model, *self._records, self.setup.vehicle, *moving])

    def _all_views(self) -> list[Any]:
        return [*vars(self.state).values(), *vars(self.memory).values(), *self._now_views, self._start_covariance]

    def __reduce__(self) -> Any:
        """Travel, and be copied, as the name of the kernels and all that has changed since they began."""
        arrays = [view.copy() for view in self._all_views()]
        return _observer, (self.embedded.name, self.setup), (arrays, self._origin, self.unit, self._received)

    def __setstate__(self, state: Any) -> None:
        arrays, origin, unit, self._received = state
        for view, values in zip(self._all_views(), arrays, strict=True):
            view[...] = values
        self._set_clock(origin, unit * UNITS_PER_TICK)


def _observer(name: str, setup: Setup) -> KernelObserver:
    from coopenv.observers.registry import find_embedded

    embedded = find_embedded(name)
    if embedded is None:
        raise CoopenvError(f"observer '{name}' has no kernels in this program")
    return KernelObserver(embedded, setup)


@dataclass(frozen=True)
class KernelFactory:
    """Builds the plug-in observer of a vehicle from its setup."""

    embedded: Embedded

    def __call__(self, setup: Setup) -> KernelObserver:
        """Return the observer of one vehicle."""
        return KernelObserver(self.embedded, setup)


def write_position(observer: KernelObserver) -> Message:
    """Return the position of the vehicle's marker."""
    s = observer.state
    return Message(position=s.estimate_rotation @ (s.estimate_position + observer.setup.marker))


def write_pose(observer: KernelObserver) -> Message:
    """Return the pose estimate as a message."""
    return replace(write_position(observer), rotation=observer.state.estimate_rotation.copy())


def read_position(observer: KernelObserver, sender: int, message: Message, sent: int) -> None:
    """Put a position where the V2X stage puts it; the sender's marker takes the place of its origin."""
    if message.position is None:
        raise CoopenvError("no position")
    observer.state.inbox_position[sender] = message.position


def read_pose(observer: KernelObserver, sender: int, message: Message, sent: int) -> None:
    """Do the same with a whole pose."""
    if message.rotation is None:
        raise CoopenvError("no rotation")
    read_position(observer, sender, message, sent)
    observer.state.inbox_rotation[sender] = message.rotation


POSITION = Messages(write_position, read_position)
POSE = Messages(write_pose, read_pose)  # of an observer that declares no messages of its own
