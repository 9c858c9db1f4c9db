"""What vehicles sense, tick by tick: of one tick, and of a whole record."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coopenv.estimation.arrays import Array
from coopenv.observers.contract import Received, Setup, Tick

if TYPE_CHECKING:
    from coopenv.observers.interference import Interference
    from coopenv.scenario import Scenario


@dataclass(frozen=True)
class Briefing:
    """What observers are told before the first tick, and how their messages travel."""

    setups: tuple[Setup, ...]
    order: tuple[int, ...]  # vehicles in the order in which they estimate: leaders first
    dt: float  # s
    period: int  # ticks between messages
    staleness: float  # s
    flight: int  # ticks that a message may be under way
    start_covariance: Array  # (N, 6, 6) LEFT coordinates


@dataclass(frozen=True)
class Truth:
    """What no observer reads, of one tick or (K, ...) of several; NaN where it is not known."""

    rotation: Array  # (..., N, 3, 3) body to map
    position: Array  # (..., N, 3) map, m

    @property
    def known(self) -> NDArray[np.bool_]:
        """(..., N) where the whole pose is known."""
        whole = np.concatenate([self.rotation, self.position[..., None]], axis=-1)
        return np.asarray(np.isfinite(whole).all(axis=(-1, -2)))


@dataclass(frozen=True)
class Sensed:
    """What N vehicles sense at one tick; T targets, of which the first L are landmarks. Nobody can write to it.

    Ticks are the frames of the scenario's camera rate, one after the other: tick k is due at k / rate. What a source
    has of a vehicle at that time is in its row; of a vehicle from which nothing came the row is not read.
    """

    index: int  # k
    dt: float  # s, between ticks
    rotation: Array  # (N, 3, 3) odometry increments since the last tick
    translation: Array  # (N, 3) m
    velocity: Array  # (N, 3) m/s, last odometry sample
    angular_velocity: Array  # (N, 3) rad/s
    bearings: Array  # (N, T, 3) camera -> target, body frame, NaN where not measured
    visible: NDArray[np.bool_]  # (N, T)
    landmarks: Array  # (L, 3) map, m
    due: bool = True  # whether the scenario's observer rate asks for a correction
    pan: Array | None = None  # (N,) rad, by which cameras are turned to the left; None: 0
    time: float | None = None  # s since the reset on the source's clock; None: index * dt
    odometry_age: Array | None = None  # (N,) s since the last odometry sample; None: 0
    bearing_age: Array | None = None  # (N,) s since the frame was exposed; None: 0
    missing: NDArray[np.bool_] | None = None  # (N,) of whom nothing came; None: of nobody
    late: NDArray[np.bool_] | None = None  # (N,) whose row came after its deadline; None: nobody's
    truth: Truth | None = None  # of this tick; None: not known
    inbox_tick: NDArray[np.int64] | None = None
    """(N receiver, N sender) tick of sending of the last message that arrived, -1: none, where the source knows what
    its radio delivered; None: the scenario's radio decides. What they say is up to the senders' observers, which keep
    it for `v2x.delay` ticks (at least one)."""
    messages: Mapping[tuple[int, int], Received] = field(default_factory=dict)
    """(receiver, sender) to a message that arrived since the last tick from a vehicle that is estimated elsewhere."""

    def tick(self, setup: Setup, messages: Mapping[int, Received]) -> Tick:
        """Return what one vehicle senses, with the messages that it has; nobody can write to it."""
        i = setup.vehicle
        return Tick(
            index=self.index,
            time=self.index * self.dt if self.time is None else self.time,
            dt=self.dt,
            rotation=self.rotation[i],
            translation=self.translation[i],
            velocity=self.velocity[i],
            angular_velocity=self.angular_velocity[i],
            targets=sealed(setup.targets[:]),
            bearings=sealed(self.bearings[i].take(setup.targets, axis=0)),
            valid=sealed(self.visible[i].take(setup.targets)),
            landmarks=self.landmarks,
            messages=messages,
            lever_arm=sealed(setup.lever_arm[:]),
            noise=setup.noise,
            due=self.due,
        )


def sealed(view: NDArray[Any]) -> NDArray[Any]:
    """Return a view that nobody can write to."""
    view.setflags(write=False)
    return view


@dataclass(frozen=True)
class Drawn:
    """What the draws of a simulated episode follow from: who was there, routes and goals, and later routes."""

    key: int  # of the world's random streams, see `coopenv.base.seeds`
    episode: int
    parameters: tuple[float, ...]  # factors, in the order of `coopenv.scenario.randomness.PARAMETERS`


PER_TICK = ("rotation", "translation", "velocity", "angular_velocity", "bearings", "visible", "landmarks", "inbox_tick")
"""Arrays of a recording that have a row per tick."""


@dataclass(frozen=True)
class Recording:
    """K ticks (t = 0 included) of N vehicles and T targets, of which the first L are landmarks."""

    setups: tuple[Setup, ...]  # (N,) what each vehicle knows before it starts
    order: tuple[int, ...]  # vehicles in the order in which they estimate: leaders first
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
    truth: Truth  # of the K ticks
    pan: Array | None = None  # (K, N) rad, by which cameras were turned to the left; None: never
    scenario: "Scenario | None" = None  # the world that was recorded; None for recorded robots
    drawn: Drawn | None = None  # None: not simulated
    interference: "Interference | None" = None  # of the world's faults with messages and observers; None: there is none

    @property
    def ticks(self) -> int:
        """K, the start included."""
        return len(self.rotation)

    @property
    def t(self) -> Array:
        """(K,) s."""
        return self.dt * np.arange(self.ticks, dtype=np.float64)

    @property
    def flight(self) -> int:
        """Ticks that a message was under way at most."""
        arrived = np.diff(self.inbox_tick, axis=0, prepend=-1) > 0
        lag = np.arange(self.ticks)[:, None, None] - self.inbox_tick
        return int(lag[arrived].max(initial=0))

    @property
    def briefing(self) -> Briefing:
        """What observers are told before the first tick."""
        return Briefing(
            self.setups, self.order, self.dt, self.period, self.staleness, self.flight, self.start_covariance
        )

    def at(self, k: int) -> Sensed:
        """Return what all vehicles sense at tick k."""
        sensed: dict[str, Any] = {name: sealed(getattr(self, name)[k]) for name in PER_TICK}
        truth = Truth(self.truth.rotation[k], self.truth.position[k])
        if self.pan is not None:
            sensed["pan"] = sealed(self.pan[k])
        return Sensed(index=k, dt=self.dt, due=bool(self.due[k]), truth=truth, **sensed)

    def tick(self, k: int, vehicle: int, messages: Mapping[int, Received]) -> Tick:
        """Return what one vehicle senses at tick k, with the messages that it has."""
        return self.at(k).tick(self.setups[vehicle], messages)


def is_due(index: ArrayLike, ratio: float) -> NDArray[np.bool_]:
    """Return at which ticks a correction at `ratio` times the camera's rate is due; at the start none is."""
    k = np.asarray(index)
    return np.asarray(np.floor(k * ratio + 1e-9) > np.floor(np.maximum(k - 1, 0) * ratio + 1e-9))
