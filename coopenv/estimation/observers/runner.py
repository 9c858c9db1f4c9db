"""Record what every vehicle of a world senses, and run any observer on the record.

A record is made once per seed and serves every observer, so that all of them see the same ticks. Observers read ticks;
truth only judges them. What neighbours tell each other are the observers' own messages, sent with the scenario's
period and delivered, lost or delayed as the world's radio delivered its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coopenv.api.engine import Engine
from coopenv.errors import CoopenvError
from coopenv.estimation.metrics import orientation_error_deg
from coopenv.estimation.observers.base import (
    Array,
    Coordinates,
    Estimate,
    Factory,
    Gains,
    JointObserver,
    Message,
    Observer,
    Received,
    SensorNoise,
    Setup,
    Tick,
)
from coopenv.estimation.observers.registry import find, is_joint
from coopenv.estimation.trajectory import Sight
from coopenv.scenario import Scenario

EXACT_START_STD = 1e-3
"""rad and m, where a scenario starts its estimates at the truth."""


@dataclass(frozen=True)
class Truth:
    """What no observer reads. Tick 0 is the start."""

    rotation: Array  # (K, N, 3, 3) body to map
    position: Array  # (K, N, 3) map, m


@dataclass(frozen=True)
class Recording:
    """K ticks (t = 0 included) of N vehicles and T targets, of which the first L are landmarks."""

    setups: tuple[Setup, ...]
    order: tuple[int, ...]
    """Vehicles in the order in which they estimate: leaders first."""
    dt: float  # s
    rotation: Array  # (K, N, 3, 3) odometry increments
    translation: Array  # (K, N, 3) m
    velocity: Array  # (K, N, 3) m/s, last odometry sample
    angular_velocity: Array  # (K, N, 3) rad/s
    bearings: Array  # (K, N, T, 3) camera -> target, body frame, NaN where not measured
    visible: NDArray[np.bool_]  # (K, N, T)
    landmarks: Array  # (K, L, 3) map, m
    inbox_tick: NDArray[np.int64]  # (K, N receiver, N sender) tick of sending of the last message heard; -1: none
    period: int  # ticks between messages
    staleness: float  # s
    due: NDArray[np.bool_]  # (K,) whether the scenario's observer rate asks for a correction
    start_rotation: Array  # (N, 3, 3) initial estimates
    start_position: Array  # (N, 3) map, m
    start_covariance: Array  # (N, 6, 6) LEFT coordinates
    truth: Truth

    @property
    def ticks(self) -> int:
        """K, the start included."""
        return len(self.rotation)

    @property
    def t(self) -> Array:
        """(K,) s."""
        return self.dt * np.arange(self.ticks, dtype=np.float64)

    def tick(self, k: int, vehicle: int, messages: dict[int, Received]) -> Tick:
        """Return what one vehicle senses at tick k, with the messages that it has."""
        setup = self.setups[vehicle]
        return Tick(
            index=k,
            time=k * self.dt,
            dt=self.dt,
            rotation=self.rotation[k, vehicle],
            translation=self.translation[k, vehicle],
            velocity=self.velocity[k, vehicle],
            angular_velocity=self.angular_velocity[k, vehicle],
            targets=setup.targets,
            bearings=self.bearings[k, vehicle, setup.targets],
            valid=self.visible[k, vehicle, setup.targets],
            landmarks=self.landmarks[k],
            messages=messages,
            lever_arm=setup.lever_arm,
            noise=setup.noise,
            due=bool(self.due[k]),
        )


@dataclass(frozen=True)
class Run:
    """How one observer did on one record; NaN from where it failed."""

    t: Array  # (K,) s
    rotation: Array  # (K, N, 3, 3) estimates
    position: Array  # (K, N, 3) map, m
    covariance: Array  # (K, N, 6, 6) rad and m, NaN where the observer states none
    coordinates: Coordinates
    position_error: Array  # (K, N) m
    orientation_error: Array  # (K, N) deg, geodesic
    nees: Array  # (K, N), in the observer's own coordinates
    bytes_per_second: Array  # (N,) sent, payload
    microseconds_per_update: Array  # (N,) median, message included; a joint observer's time is shared out
    failure: str = ""
    """Who failed, when and why; empty where nobody did."""

    def position_rmse(self, after: float = 0.0) -> Array:
        """Return (N,) the root mean square of |pbar - pbarhat| from a time on, m."""
        late = self.t >= after
        return np.sqrt(np.mean(self.position_error[late] ** 2, axis=0))

    def anees(self, after: float = 0.0) -> Array:
        """Return (N,) the mean NEES from a time on divided by its dimension 6; 1 for an honest covariance."""
        return np.mean(self.nees[self.t >= after], axis=0) / 6.0


def setups_of(scenario: Scenario, model: Any) -> tuple[Setup, ...]:
    """Return what each vehicle of a world knows before it starts."""
    noise, observer = model.noise, model.observer
    bearing = float(noise.bearing) / (math.sqrt(3.0) if noise.bearing_paper else 1.0)
    sensor_noise = SensorNoise(
        float(noise.velocity), float(noise.angular_velocity), 1.0 / scenario.rates.odometry, bearing
    )
    L = len(scenario.landmarks)
    targets, counts = model.targets.numpy(), model.target_count.numpy()
    k, q = observer.k.numpy(), observer.q.numpy().astype(float)
    return tuple(
        Setup(
            vehicle=i,
            name=name,
            target_names=tuple(scenario.target_names),
            landmarks=L,
            targets=targets[i, : counts[i]].astype(np.int64),
            lever_arm=np.array(scenario.camera.position, float),
            marker=np.array(scenario.vehicles[i].marker, float),
            noise=sensor_noise,
            gains=Gains(float(k[i]), q, scenario.observer.V, scenario.observer.P0, scenario.observer.max_turn),
        )
        for i, name in enumerate(scenario.vehicle_names)
    )


def start_covariance(scenario: Scenario, vehicle: int) -> Array:
    """Return the covariance (6, 6) of the initial estimate in LEFT coordinates.

    Where the scenario draws the initial error it is that error's. Per axis: a^2 / 9 of an angle U(0, a) about a random
    axis, (pi^2 / 3 + 2) / 3 of a rotation uniform over SO(3), r^2 / 5 of a point uniform in a ball of radius r. A fixed
    initial error is no distribution: the scenario's P(0) stands for it.
    """
    e, (angle_P0, position_P0) = scenario.vehicles[vehicle].initial_estimate, scenario.observer.P0
    floor = EXACT_START_STD**2
    uniform = (math.pi**2 / 3.0 + 2.0) / 3.0
    angle_variance = uniform if e.orientation_angle == "uniform" else float(e.orientation_angle) ** 2 / 9.0
    turned = e.yaw is not None or e.quaternion_wxyz is not None or abs(e.orientation_offset_wxyz[0]) < 1.0 - 1e-12
    moved = e.position is not None or any(e.position_offset)
    variances = (
        angle_P0 if turned else max(angle_variance, floor),
        position_P0 if moved else max(e.position_radius**2 / 5.0, floor),
    )
    return np.diag(np.repeat(variances, 3))


def record(
    scenario: Scenario, seed: int = 0, policy: Callable[[Engine], NDArray[np.float64]] | None = None
) -> Recording:
    """Run a world in float64 to its horizon and keep what is sensed.

    Args:
        scenario: what to run.
        seed: of the world.
        policy: returns actions (1, N, 2) in [-1, 1] at every decision; None: zeros.
    """
    engine = Engine(scenario, 1, "float64")
    engine.reset([seed])
    model = engine.world.model
    L, N = len(scenario.landmarks), len(scenario.vehicles)
    K, dt = scenario.horizon_ticks + 1, 1.0 / scenario.rates.camera
    camera = np.array(model.camera.rotation, dtype=float).reshape(3, 3)
    markers = np.array([landmark.marker for landmark in scenario.landmarks], float).reshape(L, 3)
    names = {
        "rotation": "increment_rotation",
        "translation": "increment_translation",
        "velocity": "odometry_velocity",
        "angular_velocity": "odometry_angular_velocity",
        "bearing": "bearing",
        "sight": "sight",
        "inbox_tick": "inbox_tick",
        "true_rotation": "rotation",
        "true_position": "position",
    }
    kept = {key: np.empty((K, *engine.view(name).shape[1:])) for key, name in names.items()}
    start_rotation = engine.view("estimate_rotation")[0].copy()
    start_position = (start_rotation @ engine.view("estimate_position")[0][..., None])[..., 0]
    for k in range(K):
        if k > 0:
            if policy is not None and (k - 1) % scenario.ticks_per_decision == 0:
                engine.set_actions(policy(engine))
            engine.step(ticks=1)
        for key, name in names.items():
            kept[key][k] = engine.view(name)[0]
    for values in (*kept.values(), start_rotation):
        values.setflags(write=False)  # observers get views
    visible = kept["sight"] == Sight.VISIBLE
    bearings = np.where(visible[..., None], kept["bearing"] @ camera.T, np.nan)
    landmarks = kept["true_position"][:, :L] + (kept["true_rotation"][:, :L] @ markers[..., None])[..., 0]
    landmarks.setflags(write=False)
    return Recording(
        setups=setups_of(scenario, model),
        order=tuple(int(i) for i in model.order.numpy()),
        dt=dt,
        rotation=kept["rotation"],
        translation=kept["translation"],
        velocity=kept["velocity"],
        angular_velocity=kept["angular_velocity"],
        bearings=bearings,
        visible=visible,
        landmarks=landmarks,
        inbox_tick=kept["inbox_tick"].astype(np.int64),
        period=scenario.v2x.period,
        staleness=math.inf if scenario.v2x.staleness is None else scenario.v2x.staleness,
        due=_due(K, model.observer.rate / scenario.rates.camera),
        start_rotation=start_rotation,
        start_position=start_position,
        start_covariance=np.array([start_covariance(scenario, i) for i in range(N)]),
        truth=Truth(kept["true_rotation"][:, L:], kept["true_position"][:, L:]),
    )


def _due(ticks: int, ratio: float) -> NDArray[np.bool_]:
    """Return (K,) at which ticks a correction at `ratio` times the camera's rate is due."""
    counts = np.floor(np.arange(ticks) * ratio + 1e-9)
    return np.diff(counts, prepend=counts[:1]) > 0


def _copied(message: Message) -> Message:
    """Return a copy that the sender can no longer change."""
    arrays = {
        name: None if (value := getattr(message, name)) is None else np.array(value, float)
        for name in ("position", "rotation", "covariance")
    }
    return replace(message, **arrays, extra={name: np.array(value) for name, value in message.extra.items()})


class _Mail:
    """Carries the observers' messages as the recorded radio carried its own."""

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        self.sent: list[dict[int, Message]] = [{} for _ in recording.setups]
        self.bytes = np.zeros(len(recording.setups))

    def post(self, vehicle: int, k: int, message: Message) -> None:
        """Send one message; that of the start is heard but not counted."""
        self.sent[vehicle][k] = _copied(message)
        if k > 0:
            self.count(vehicle, message)

    def count(self, vehicle: int, message: Message) -> None:
        """Count the bytes of a message."""
        self.bytes[vehicle] += message.size_bytes

    def due(self, k: int) -> bool:
        """Return whether messages are sent at tick k."""
        return k % self.recording.period == 0

    def inbox(self, k: int, vehicle: int) -> dict[int, Received]:
        """Return what a vehicle has heard by tick k, by target, without what is stale."""
        r, setup = self.recording, self.recording.setups[vehicle]
        received = {}
        for target in setup.targets[setup.targets >= setup.landmarks]:
            sender = int(target) - setup.landmarks
            sent = int(r.inbox_tick[k, vehicle, sender])
            age = (k - sent) * r.dt
            if sent >= 0 and age <= r.staleness and sent in self.sent[sender]:
                received[int(target)] = Received(self.sent[sender][sent], age)
        return received


def run(observer: str | Factory, recording: Recording) -> Run:
    """Run an observer, by name or class, for all vehicles on a record.

    An observer that raises or returns something that is not finite ends its run: `Run.failure` says who, when and why.

    Raises:
        CoopenvError: unknown name.
    """
    factory = find(observer) if isinstance(observer, str) else observer
    log = _Log(recording)
    mail = _Mail(recording)
    where = "at the start"
    try:
        if is_joint(factory):
            team: JointObserver = factory(recording.setups)
            for k in _joint(team, recording, log, mail):
                where = f"at {k * recording.dt:.3f} s"
        else:
            for k, vehicle in _single(factory, recording, log, mail):
                where = f"of {recording.setups[vehicle].name} at {k * recording.dt:.3f} s"
    except Exception as error:  # an observer is anybody's code: its row says what went wrong, the others go on
        log.failure = f"{where}: {type(error).__name__}: {error}"
    return log.result(mail)


def _single(factory: Factory, recording: Recording, log: _Log, mail: _Mail) -> Iterator[tuple[int, int]]:
    """Run one observer per vehicle, yielding (tick, vehicle) before each update."""
    observers: list[Observer] = []
    for i, setup in enumerate(recording.setups):
        yield 0, i
        observers.append(factory(setup))
        R, p = recording.start_rotation[i].copy(), recording.start_position[i].copy()
        observers[i].reset((R, p), recording.start_covariance[i].copy())
        log.write(0, i, Estimate(R, p), 0.0)
        mail.post(i, 0, observers[i].message())
    for k in range(1, recording.ticks):
        for i in recording.order:
            yield k, i
            tick = recording.tick(k, i, mail.inbox(k, i))
            begin = perf_counter()
            estimate = observers[i].update(tick)
            message = observers[i].message() if mail.due(k) else None
            elapsed = perf_counter() - begin
            log.write(k, i, estimate, elapsed)
            if message is not None:
                mail.post(i, k, message)


def _joint(team: JointObserver, recording: Recording, log: _Log, mail: _Mail) -> Iterator[int]:
    """Run one observer of all vehicles, yielding the tick before each update."""
    N = len(recording.setups)
    yield 0
    poses = [(recording.start_rotation[i].copy(), recording.start_position[i].copy()) for i in range(N)]
    team.reset(poses, [covariance.copy() for covariance in recording.start_covariance])
    for i in range(N):
        log.write(0, i, Estimate(*poses[i]), 0.0)
    for k in range(1, recording.ticks):
        yield k
        ticks = [recording.tick(k, i, {}) for i in range(N)]
        begin = perf_counter()
        estimates = team.update(ticks)
        messages: Sequence[Message] = team.messages()
        elapsed = (perf_counter() - begin) / N
        for i in range(N):
            log.write(k, i, estimates[i], elapsed)
            mail.count(i, messages[i])


class _Log:
    """Collects estimates and judges them at the end."""

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        shape = (recording.ticks, len(recording.setups))
        self.rotation, self.position = np.full((*shape, 3, 3), np.nan), np.full((*shape, 3), np.nan)
        self.covariance, self.elapsed = np.full((*shape, 6, 6), np.nan), np.full(shape, np.nan)
        self.coordinates: Coordinates | None = None
        self.failure = ""

    def write(self, k: int, vehicle: int, estimate: Estimate, elapsed: float) -> None:
        """Keep one estimate.

        Raises:
            CoopenvError: it is not finite, has the wrong shape, or changes its coordinates.
        """
        fields = [("rotation", estimate.rotation, (3, 3)), ("position", estimate.position, (3,))]
        if estimate.covariance is not None:
            fields.append(("covariance", estimate.covariance, (6, 6)))
        for name, value, shape in fields:
            if np.shape(value) != shape or not np.isfinite(value).all():
                raise CoopenvError(f"{name} is not a finite array of shape {shape}")
        if k > 0:
            self.coordinates = self.coordinates or estimate.coordinates
            if estimate.coordinates is not self.coordinates:
                raise CoopenvError("error coordinates must stay the same")
        self.rotation[k, vehicle], self.position[k, vehicle] = estimate.rotation, estimate.position
        if estimate.covariance is not None:
            self.covariance[k, vehicle] = estimate.covariance
        self.elapsed[k, vehicle] = elapsed

    def result(self, mail: _Mail) -> Run:
        """Compare with the truth."""
        r, coordinates = self.recording, self.coordinates or Coordinates.LEFT
        known = np.isfinite(self.position[..., 0])
        shape = known.shape
        position_error, orientation_error, nees = (np.full(shape, np.nan) for _ in range(3))
        R, p = r.truth.rotation[known], r.truth.position[known]
        R_hat, p_hat = self.rotation[known], self.position[known]
        position_error[known] = np.linalg.norm(p - p_hat, axis=-1)
        orientation_error[known] = orientation_error_deg(R, R_hat)
        stated = np.isfinite(self.covariance[..., 0, 0])
        if stated.any():
            e = coordinates.error(
                r.truth.rotation[stated], r.truth.position[stated], self.rotation[stated], self.position[stated]
            )
            nees[stated] = np.einsum("...i,...i", e, _solve(self.covariance[stated], e))
        duration = max(r.dt, (r.ticks - 1) * r.dt)
        timed = self.elapsed[1:]
        micro = [1e6 * float(np.median(c[np.isfinite(c)])) if np.isfinite(c).any() else np.nan for c in timed.T]
        return Run(
            t=r.t,
            rotation=self.rotation,
            position=self.position,
            covariance=self.covariance,
            coordinates=coordinates,
            position_error=position_error,
            orientation_error=orientation_error,
            nees=nees,
            bytes_per_second=mail.bytes / duration,
            microseconds_per_update=np.array(micro),
            failure=self.failure,
        )


def _solve(P: Array, e: Array) -> Array:
    """Return P^-1 e, NaN throughout where some P is singular."""
    try:
        return np.asarray(np.linalg.solve(P, e[..., None])[..., 0], dtype=np.float64)
    except np.linalg.LinAlgError:
        return np.full_like(e, np.nan)
