"""What vehicles sense, tick by tick: of one tick, and of a whole record."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coopenv.base.errors import DataError, shown
from coopenv.base.format import LARGEST
from coopenv.estimation.poses import Array
from coopenv.estimation.validity import are_covariances, are_numbers, are_rotations, are_unit_vectors, everywhere
from coopenv.observers.contract import Received, Setup, Tick
from coopenv.scenario.learning import MOST, PARAMETERS
from coopenv.scenario.starts import neighbour_sets, processing_order

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
    parameters: tuple[float, ...]  # factors, in the order of `coopenv.scenario.learning.PARAMETERS`


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


SHAPES: dict[str, tuple[str | int, ...]] = {
    "rotation": ("K", "N", 3, 3),
    "translation": ("K", "N", 3),
    "velocity": ("K", "N", 3),
    "angular_velocity": ("K", "N", 3),
    "bearings": ("K", "N", "T", 3),
    "visible": ("K", "N", "T"),
    "landmarks": ("K", "L", 3),
    "inbox_tick": ("K", "N", "N"),
    "due": ("K",),
    "start_rotation": ("N", 3, 3),
    "start_position": ("N", 3),
    "start_covariance": ("N", 6, 6),
    "truth.rotation": ("K", "N", 3, 3),
    "truth.position": ("K", "N", 3),
}
KINDS = {"visible": "b", "due": "b", "inbox_tick": "i"}  # NumPy's kind of the arrays that do not hold floats

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,63}")
TICK_LENGTHS_S = (1e-5, 1e3)
LARGEST_PAN = 3.15  # rad, after rounding
MAX_PERIOD_TICKS = 100_000
LEAST_EIGENVALUE = 1e-12  # least eigenvalue of the correlations of an initial estimate


def check_recording(recording: Recording, where: str) -> None:
    """Refuse a recording that contradicts itself or holds what no kernel may read.

    The DataError begins with its name and names the field, and vehicle and tick where it is about them.
    """
    try:
        _check_setups(recording.setups)
        _check_arrays(recording)
        _check_radio(recording)
        _check_start(recording)
        _check_ticks(recording)
        _check_scenario(recording)
        _check_drawn(recording)
    except _RecordingError as error:
        raise DataError(f"{where}: {error}") from None


class _RecordingError(Exception):
    """What is wrong with a recording."""


def _require(condition: Any, message: str) -> None:
    if not condition:
        raise _RecordingError(message)


def _between(name: str, value: Any, low: float, high: float) -> None:
    _require(low <= value <= high, f"{name}: {shown(value)} is not in {low:g} .. {high:g}")


def _check_setups(setups: Sequence[Setup]) -> None:
    _require(setups, "setups: there are none")
    names = setups[0].target_names
    for name in names:
        _require(NAME.fullmatch(name), f"setups: {shown(name)} is no name")
    _require(len(set(names)) == len(names), "setups: two targets have the same name")
    _require(setups[0].landmarks + len(setups) == len(names), "setups: not as many names as landmarks and vehicles")
    for i, setup in enumerate(setups):
        _check_setup(setup, i, setups[0], f"setups.{i}")


def _check_setup(setup: Setup, vehicle: int, first: Setup, where: str) -> None:
    same = (setup.target_names, setup.landmarks, setup.planar) == (first.target_names, first.landmarks, first.planar)
    _require(same, f"{where}: other names, landmarks or plane than the first vehicle's")
    _require(setup.vehicle == vehicle, f"{where}.vehicle: {setup.vehicle} instead of {vehicle}")
    own, targets = setup.landmarks + vehicle, setup.targets.tolist()
    _require(setup.name == setup.target_names[own], f"{where}.name: not the name of target {own}")
    sensible = len(set(targets)) == len(targets) and set(targets) <= set(range(len(setup.target_names))) - {own}
    _require(sensible, f"{where}.targets: not different targets of 0 .. {len(setup.target_names) - 1} without {own}")
    for name in ("lever_arm", "marker"):
        _require(_is_array(getattr(setup, name), (3,)), f"{where}.{name}: not three numbers")
    noise, gains = setup.noise, setup.gains
    for name, value in asdict(noise).items():
        if name not in ("odometry_period", "image_axis"):
            for entry in np.ravel(value):
                _between(f"{where}.noise.{name}", float(entry), 0.0, LARGEST)
    _between(f"{where}.noise.odometry_period", noise.odometry_period, *TICK_LENGTHS_S)
    if noise.image_axis is not None:
        axis = np.array(noise.image_axis, float)
        _require(axis.shape == (3,) and are_unit_vectors(axis), f"{where}.noise.image_axis: not a unit vector")
    for name, least in (("k", 0.5), ("max_turn", 0.0)):
        value = getattr(gains, name)
        _require(least < value <= LARGEST, f"{where}.gains.{name}: {shown(value)} is not in {least:g} .. {LARGEST:g}")
    for name, count in (("q", len(setup.target_names)), ("V", 2), ("P0", 2)):
        values = np.asarray(getattr(gains, name))
        positive = _is_array(values, (count,)) and (values > 0.0).all()
        _require(positive, f"{where}.gains.{name}: not {count} positive numbers")


def _is_array(values: Any, shape: tuple[int, ...]) -> bool:
    array = np.asarray(values)
    return array.shape == shape and array.dtype.kind == "f" and bool(are_numbers(array).all())


def _check_arrays(r: Recording) -> None:
    sizes = {"K": r.ticks, "N": len(r.setups), "T": len(r.setups[0].target_names), "L": r.setups[0].landmarks}
    for name, axes in SHAPES.items():
        array, kind, shape = attrgetter(name)(r), KINDS.get(name, "f"), tuple(sizes.get(str(n), n) for n in axes)
        fits = array.shape == shape and array.dtype.kind == kind
        _require(fits, f"{name}: shape {array.shape} of {array.dtype}, expected {shape} of {kind}")


def _check_radio(r: Recording) -> None:
    N = len(r.setups)
    _require(sorted(r.order) == list(range(N)), f"order: {shown(r.order)} is no order of 0 .. {N - 1}")
    _between("dt", r.dt, *TICK_LENGTHS_S)
    _between("period", r.period, 1, MAX_PERIOD_TICKS)
    _require(r.staleness > 0.0, f"staleness: {r.staleness} is not positive")
    sent, now = r.inbox_tick, np.arange(r.ticks)[:, None, None]
    received = (sent == -1) | ((sent >= 0) & (sent <= now) & (sent % r.period == 0))
    _require_all(r, everywhere(received, 2), "inbox_tick", f"not -1, nor a multiple of the period {r.period} up to now")
    later = np.diff(sent, axis=0, prepend=-1) >= 0
    _require_all(r, everywhere(later, 2), "inbox_tick", "sent before what had been heard")


def _check_start(r: Recording) -> None:
    for i, setup in enumerate(r.setups):
        _require(are_rotations(r.start_rotation[i]), f"start_rotation: of {setup.name} is no rotation")
        _require(are_numbers(r.start_position[i]).all(), f"start_position: of {setup.name} is not finite or too large")
        definite = are_covariances(r.start_covariance[i], LEAST_EIGENVALUE)
        _require(definite, f"start_covariance: of {setup.name} is not symmetric and positive definite")


def _check_drawn(r: Recording) -> None:
    if r.drawn is not None:
        _between("drawn.key", r.drawn.key, 0, 2**64 - 1)
        _between("drawn.episode", r.drawn.episode, 0, 2**32 - 1)
        _require(len(r.drawn.parameters) == len(PARAMETERS), f"drawn.parameters: not {len(PARAMETERS)} numbers")
        for factor in r.drawn.parameters:
            _between("drawn.parameters", factor, 0.0, MOST**3)


def _check_ticks(r: Recording) -> None:
    _require_all(r, are_rotations(r.rotation), "rotation", "not a rotation")
    for name in ("translation", "velocity", "angular_velocity"):
        _require_all(r, everywhere(are_numbers(getattr(r, name)), -1), name, "not finite or too large")
    unseen = everywhere(np.isnan(r.bearings), -1) & ~r.visible
    _require_all(r, everywhere(are_unit_vectors(r.bearings) | unseen, -1), "bearings", "not unit vectors")
    if r.pan is not None:
        fits = r.pan.shape == r.visible.shape[:2] and r.pan.dtype.kind == "f"
        _require(fits, f"pan: shape {r.pan.shape} of {r.pan.dtype}, expected {r.visible.shape[:2]} of f")
        _require_all(r, np.abs(r.pan) <= LARGEST_PAN, "pan", f"not within {LARGEST_PAN} rad")
    _require_all(r, everywhere(are_numbers(r.landmarks), 1, 2), "landmarks", "not finite or too large")
    R, p = r.truth.rotation, r.truth.position
    unknown_R, unknown_p = everywhere(np.isnan(R), -1, -2), everywhere(np.isnan(p), -1)
    _require_all(r, are_rotations(R) | unknown_R, "truth.rotation", "neither a rotation nor unknown (NaN)")
    _require_all(r, everywhere(are_numbers(p), -1) | unknown_p, "truth.position", "neither finite nor unknown (NaN)")


def _require_all(r: Recording, valid: NDArray[np.bool_], field: str, problem: str) -> None:
    """Blame the first tick, and its first vehicle, at which something is not valid: (K, N), or (K,) of everybody."""
    if not valid.all():
        k, *vehicle = np.argwhere(~valid)[0].tolist()
        whose = "".join(f" of {r.setups[i].name}" for i in vehicle)
        raise _RecordingError(f"{field}{whose}, tick {k}: {problem}")


def _check_scenario(r: Recording) -> None:
    """Compare the setups with the scenario, where there is one."""
    if r.scenario is None:
        return
    s, first = r.scenario, r.setups[0]
    same = (list(first.target_names), first.landmarks) == (s.target_names, len(s.landmarks))
    _require(same, "scenario: other landmarks or vehicles than the setups")
    neighbours = neighbour_sets(s)
    for setup, targets in zip(r.setups, neighbours, strict=True):
        _require(setup.targets.tolist() == targets, f"scenario: {setup.name} has other neighbours than in its setup")
    _require((s.action.pan is None) == (r.pan is None), "pan: as in the scenario, cameras turn or they do not")
    rates, staleness = s.rates, np.inf if s.v2x.staleness is None else s.v2x.staleness
    _require(list(r.order) == processing_order(s, neighbours), "scenario: vehicles in another order than recorded")
    _require(r.dt == 1.0 / rates.camera, f"scenario: ticks of {1.0 / rates.camera:g} s, recorded {r.dt:g} s")
    _require((r.period, r.staleness) == (s.v2x.period, staleness), "scenario: another radio than recorded")
    due = is_due(np.arange(r.ticks), min(rates.observer or rates.camera, rates.camera) / rates.camera)
    _require(np.array_equal(r.due, due), "scenario: corrections due at other ticks than recorded")
