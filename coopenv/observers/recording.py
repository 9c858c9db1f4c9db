"""A recording of what vehicles measured, the checks of one, and its construction from arrays of any robots."""

import math
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from numbers import Integral, Real
from operator import attrgetter
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coopenv.base.errors import DataError, DataWarning, shown
from coopenv.base.sections import LARGEST
from coopenv.estimation.poses import MISFIT_DEG, Array, bearing_misfit_deg, exp_so3, exp_translation
from coopenv.estimation.validity import Mask, are_numbers, are_unit_vectors, everywhere
from coopenv.measurements.sensor import Sensor
from coopenv.observers.arrays import ARRAYS, invalid_rows, misshapen, recorded_names, sizes_of
from coopenv.observers.contract import Gains, ObserverInit, Received, SensorNoise, Setup, Tick, sealed
from coopenv.observers.faults import Interference
from coopenv.observers.readings import problems_of_readings, problems_of_sensors, shapes_of_readings
from coopenv.observers.sensed import Measurements, Sensed, Truth, is_due
from coopenv.scenario import Scenario
from coopenv.scenario.difficulty import MOST, PARAMETERS
from coopenv.scenario.schema import neighbour_sets, processing_order


@dataclass(frozen=True)
class Drawn:
    """The keys of the draws of a simulated episode: presence, routes and goals."""

    key: int  # of the world's random streams, see `coopenv.base.seeds`
    episode: int
    parameters: tuple[float, ...]  # factors, in the order of `coopenv.scenario.difficulty.PARAMETERS`


@dataclass(frozen=True, kw_only=True)
class Recording(Measurements):
    """K ticks (t = 0 included) of N vehicles and T targets, of which the first L are landmarks.

    Its arrays become read-only, because observers get views.
    """

    setups: tuple[Setup, ...]  # (N,) what each vehicle knows before it starts
    order: tuple[int, ...]  # vehicles in the order in which they estimate: leaders first
    dt: float  # s
    inbox_tick: NDArray[np.int64]  # (K, N receiver, N sender) tick of sending of the last received message; -1: none
    period: int  # ticks between messages
    staleness: float  # s
    due: NDArray[np.bool_]  # (K,) whether the scenario's observer rate asks for a correction
    start_rotation: Array  # (N, 3, 3) initial estimates
    start_position: Array  # (N, 3) map, m
    start_covariance: Array  # (N, 6, 6) LEFT coordinates
    truth: Truth  # of the K ticks
    scenario: Scenario | None = None  # the world that was recorded; None for recorded robots
    drawn: Drawn | None = None  # None: not simulated
    interference: Interference | None = None  # of the world's faults with messages and observers; None: there is none

    def __post_init__(self) -> None:
        for name, values in [*vars(self).items()]:
            if isinstance(values, np.ndarray):
                if values.dtype.kind == "f" and values.dtype != np.float64:
                    object.__setattr__(self, name, values := values.astype(np.float64))
                values.setflags(write=False)
        readings = {name: np.asarray(values, np.float64) for name, values in self.readings.items()}
        object.__setattr__(self, "readings", {name: sealed(values) for name, values in readings.items()})

    @classmethod
    def from_arrays(
        cls,
        *,
        dt: float,
        landmarks: ArrayLike,
        velocity: ArrayLike,
        angular_velocity: ArrayLike,
        bearings: ArrayLike,
        noise: SensorNoise,
        start_position: ArrayLike | None = None,
        start_rotation: ArrayLike | None = None,
        start_std: tuple[float, float] = (0.01, 0.01),
        truth_position: ArrayLike | None = None,
        truth_rotation: ArrayLike | None = None,
        period: int = 1,
        sensors: Sequence[Sensor] = (),
        readings: Mapping[str, ArrayLike] | None = None,
    ) -> Self:
        """Return a recording of vehicle_1, vehicle_2, ... that receive each other's messages one tick later.

        Args:
            dt: time between two ticks, s.
            landmarks: (L, 3) m, map; they are landmark_1, landmark_2, ...
            velocity: (K, N, 3) m/s, body frame (x forward), held from the tick before to each tick; row 0 is unused.
            angular_velocity: (K, N, 3) rad/s, likewise.
            bearings: (K, N, L + N, 3) unit vectors from the camera to landmarks, then vehicles, body frame; NaN where
                nothing was measured.
            noise: standard deviations of odometry and bearings.
            start_position: (N, 3) m, map, initial estimate; None: the first true one.
            start_rotation: (N, 3, 3) body to map, likewise.
            start_std: of the initial estimates per axis, rad and m.
            truth_position: (K, N, 3) m, map, NaN where not known; None: nowhere.
            truth_rotation: (K, N, 3, 3) body to map, likewise.
            period: ticks between messages.
            sensors: beside the camera, which every vehicle has; a vehicle among its own targets is left out.
            readings: (K, N, L + N, size) by the name of a sensor, (K, N, 1, size) of one that measures the map; NaN
                where nothing was measured.

        Raises:
            DataError: an array has another shape or holds what it must not; one line that names it.
        """
        given = {name: values for name, values in locals().items() if name in _SHAPES and values is not None}
        for name, value, kind, expected in (
            ("dt", dt, Real, "a number of s"),
            ("period", period, Integral, "a whole number of ticks"),
            ("noise", noise, SensorNoise, "a SensorNoise"),
        ):
            valid = isinstance(value, kind) and not isinstance(value, bool)
            _require(valid, f"{name}: expected {expected}, got {shown(value)}")
        _between("dt", dt, *TICK_LENGTHS_S)
        _between("period", period, 1, MAX_PERIOD_TICKS)
        std = _numbers("start_std", start_std)
        positive = std.shape == (2,) and (std > 0.0).all()
        _require(positive, f"start_std: expected two positive numbers, got {shown(start_std)}")
        arrays = _checked_arrays(given)
        (K, N, _), L = arrays["velocity"].shape, len(arrays["landmarks"])
        turn, step = arrays["angular_velocity"] * dt, arrays["velocity"] * dt
        turn[0], step[0] = 0.0, 0.0
        names = (*(f"landmark_{n + 1}" for n in range(L)), *(f"vehicle_{n + 1}" for n in range(N)))
        gains = Gains(1.0, np.full(L + N, 10.0), (0.1, 1.0), (float(std[0] ** 2), float(std[1] ** 2)), 0.1)
        targets, here = np.arange(L + N), np.zeros(3)
        recording = cls(
            setups=tuple(
                Setup(
                    i,
                    names[L + i],
                    names,
                    L,
                    np.delete(targets, L + i),
                    here,
                    here,
                    noise,
                    gains,
                    sensors=tuple(replace(s, targets=s.targets[s.targets != L + i]) for s in sensors),
                )
                for i in range(N)
            ),
            order=tuple(range(N)),
            dt=dt,
            rotation=np.array([[exp_so3(w) for w in row] for row in turn]),
            translation=np.array([[*map(exp_translation, *row)] for row in zip(turn, step, strict=True)]),
            velocity=arrays["velocity"],
            angular_velocity=arrays["angular_velocity"],
            bearings=arrays["bearings"],
            visible=np.asarray(np.isfinite(arrays["bearings"]).all(axis=-1)),
            landmarks=np.broadcast_to(arrays["landmarks"], (K, L, 3)),
            inbox_tick=received_by_all(K, N, period),
            period=period,
            staleness=math.inf,
            due=np.ones(K, bool),
            start_rotation=arrays["start_rotation"],
            start_position=arrays["start_position"],
            start_covariance=np.tile(np.diag(np.repeat(np.square(std), 3)), (N, 1, 1)),
            truth=Truth(arrays["truth_rotation"], arrays["truth_position"]),
            readings={name: _numbers(f"readings.{name}", values) for name, values in (readings or {}).items()},
        )
        check_recording(recording, "recording")
        _warn_of_wrong_truth(recording)
        return recording

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
    def left_out(self) -> NDArray[np.bool_]:
        """(N,) vehicles without neighbours and truth, as those are that a selection leaves out."""
        alone = np.array([not setup.targets.size for setup in self.setups])
        return np.asarray(alone & ~self.truth.known.any(axis=0))

    @property
    def on_a_plane(self) -> bool:
        """True if recorded robots drive on the plane z = 0, so that errors out of it vanish and are not judged."""
        return self.scenario is None and not np.nan_to_num(self.truth.position[..., 2]).any()

    @property
    def observer_init(self) -> ObserverInit:
        """The setups of all observers, and the properties of the radio."""
        return ObserverInit(
            self.setups, self.order, self.dt, self.period, self.staleness, self.flight, self.start_covariance
        )

    def at(self, k: int) -> Sensed:
        """Return the measurements of all vehicles at tick k."""
        sensed: dict[str, Any] = {name: values[k] for name, values in self.per_tick().items()}
        truth = Truth(self.truth.rotation[k], self.truth.position[k])
        due, readings = bool(self.due[k]), self.readings_at(k)
        return Sensed(index=k, dt=self.dt, due=due, truth=truth, readings=readings, **sensed)

    def per_tick(self) -> dict[str, Any]:
        """Return by name the arrays that hold what was measured and received at every tick."""
        return {**self.measured(), "inbox_tick": self.inbox_tick}

    def odometry_age(self, rate: float) -> Array:
        """Return (K,) the age of the last odometry sample at each tick, s; samples are taken at 0, 1 / rate, ... s."""
        taken = np.floor((self.t + 1e-9) * rate) + 1.0
        return np.where(self.t > 0.0, self.t - (taken - 1.0) / rate, np.inf)

    def stacked(self, odometry_rate: float) -> Sensed:
        """Return all ticks as one whose arrays have the leading axis K, for an odometry rate in Hz."""
        return Sensed(
            index=np.arange(self.ticks)[:, None],  # type: ignore[arg-type]
            dt=self.dt,
            odometry_age=self.odometry_age(odometry_rate)[:, None],
            truth=self.truth,
            readings=self.readings,
            **self.per_tick(),
        )

    def tick(self, k: int, vehicle: int, messages: Mapping[int, Received]) -> Tick:
        """Return the measurements of one vehicle at tick k, with its messages."""
        return self.at(k).tick(self.setups[vehicle], messages)


_SHAPES = {
    "landmarks": "L 3",
    "velocity": "K N 3",
    "angular_velocity": "K N 3",
    "bearings": "K N T 3",
    "start_position": "N 3",
    "start_rotation": "N 3 3",
    "truth_position": "K N 3",
    "truth_rotation": "K N 3 3",
}
"""Of the arrays that `Recording.from_arrays` takes; T = L + N."""


def _numbers(name: str, values: ArrayLike) -> Array:
    """Return a copy of an array. Raises DataError: it does not hold numbers."""
    try:
        return np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DataError(f"{name}: not an array of numbers ({error})") from None


def _checked_arrays(given: Mapping[str, ArrayLike]) -> dict[str, Array]:
    """Return the arrays of `Recording.from_arrays`, unknown truth as NaN, and initial estimates.

    Raises:
        DataError: an array has another shape than in `_SHAPES`, or is not finite where it must be.
    """
    arrays = {name: _numbers(name, values) for name, values in given.items()}
    for name, rank in (("velocity", 3), ("landmarks", 2)):
        _require(arrays[name].ndim == rank, f"{name}: expected {_SHAPES[name]}, got shape {arrays[name].shape}")
    (K, N, _), L = arrays["velocity"].shape, len(arrays["landmarks"])
    _require(K > 1 and N > 0, f"velocity: expected {_SHAPES['velocity']}, K > 1, got shape {(K, N, 3)}")
    unknown = {"truth_position": np.full((K, N, 3), np.nan), "truth_rotation": np.full((K, N, 3, 3), np.nan)}
    arrays = unknown | arrays
    for name, array in arrays.items():
        shape = tuple({"K": K, "N": N, "L": L, "T": L + N, "3": 3}[axis] for axis in _SHAPES[name].split())
        _require(array.shape == shape, f"{name}: expected {_SHAPES[name]} = {shape}, got {array.shape}")
    for name in ("landmarks", "velocity", "angular_velocity"):
        wrong = np.argwhere(~np.isfinite(arrays[name]))
        _require(not len(wrong), f"{name}: not finite at {wrong[:1].tolist()}")
    for part in ("position", "rotation"):
        arrays.setdefault(f"start_{part}", arrays[f"truth_{part}"][0])
        known = np.isfinite(arrays[f"start_{part}"]).all()
        _require(known, f"start_{part}: needed, as the first true one is not known")
    return arrays


def _warn_of_wrong_truth(recording: Recording) -> None:
    """Warn if bearings to landmarks contradict the true poses of a vehicle."""
    for i in range(len(recording.setups)):
        k, n = np.nonzero(recording.visible[:, i, : recording.landmarks.shape[1]])
        pose = recording.truth.rotation[k, i], recording.truth.position[k, i]
        misfit = bearing_misfit_deg(*pose, recording.bearings[k, i, n], recording.landmarks[k, n])
        if misfit > MISFIT_DEG:
            why = "are truth_position in m and truth_rotation body to map?"
            text = f"truth of vehicle_{i + 1}: bearings to landmarks are {misfit:.0f} deg off (median): {why}"
            warnings.warn(DataWarning(text), stacklevel=3)


def received_by_all(ticks: int, vehicles: int, period: int) -> NDArray[np.int64]:
    """Return (K, N, N) the tick of the last received message: sent one tick ago or more."""
    before = np.maximum(np.arange(ticks) - 1, 0)
    inbox = np.repeat(before - before % period, vehicles * vehicles).reshape(ticks, vehicles, vehicles)
    inbox[0] = -1
    inbox[:, np.arange(vehicles), np.arange(vehicles)] = -1
    return inbox


NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,63}")
TICK_LENGTHS_S = (1e-5, 1e3)
MAX_PERIOD_TICKS = 100_000


def check_recording(recording: Recording, where: str) -> None:
    """Refuse a recording that contradicts itself or holds what no kernel may read.

    The DataError begins with its name and names the field, and vehicle and tick where it is about them.
    """
    try:
        _check_setups(recording.setups)
        _check_radio(recording)
        _check_arrays(recording)
        _check_scenario(recording)
        _check_drawn(recording)
    except DataError as error:
        raise DataError(f"{where}: {error}") from None


def _require(condition: Any, message: str) -> None:
    if not condition:
        raise DataError(message)


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
    same = (setup.target_names, setup.landmarks) == (first.target_names, first.landmarks)
    _require(same, f"{where}: other names or landmarks than the first vehicle's")
    _require(setup.vehicle == vehicle, f"{where}.vehicle: {setup.vehicle} instead of {vehicle}")
    own, targets = setup.landmarks + vehicle, setup.targets.tolist()
    _require(setup.name == setup.target_names[own], f"{where}.name: not the name of target {own}")
    sensible = len(set(targets)) == len(targets) and set(targets) <= set(range(len(setup.target_names))) - {own}
    _require(sensible, f"{where}.targets: not different targets of 0 .. {len(setup.target_names) - 1} without {own}")
    for name in ("lever_arm", "marker"):
        _require(_is_array(getattr(setup, name), (3,)), f"{where}.{name}: not three numbers")
    noise, gains = setup.noise, setup.gains
    for name, axis in (("optical_axis", setup.optical_axis), ("noise.image_axis", noise.image_axis)):
        unit = axis is None or (np.shape(axis) == (3,) and bool(are_unit_vectors(np.array(axis, float))))
        _require(unit, f"{where}.{name}: not a unit vector")
    for name, value in asdict(noise).items():
        if name not in ("odometry_period", "image_axis"):
            for entry in np.ravel(value):
                _between(f"{where}.noise.{name}", float(entry), 0.0, LARGEST)
    _between(f"{where}.noise.odometry_period", noise.odometry_period, *TICK_LENGTHS_S)
    for name, least in (("k", 0.5), ("max_turn", 0.0)):
        value = getattr(gains, name)
        _require(least < value <= LARGEST, f"{where}.gains.{name}: {shown(value)} is not in {least:g} .. {LARGEST:g}")
    for name, count in (("q", len(setup.target_names)), ("V", 2), ("P0", 2)):
        positive = _is_array(getattr(gains, name), (count,)) and np.min(getattr(gains, name)) > 0.0
        _require(positive, f"{where}.gains.{name}: not {count} positive numbers")
    std = setup.landmark_std
    valid = len(std) in (0, setup.landmarks) and min(std, default=0.0) >= 0.0 and max(std, default=0.0) <= LARGEST
    _require(valid, f"{where}.landmark_std: not {setup.landmarks} numbers in 0 .. {LARGEST:g}")
    for problem in problems_of_sensors(setup, first):
        raise DataError(f"{where}.sensors.{problem}")


def _is_array(values: Any, shape: tuple[int, ...]) -> bool:
    array = np.asarray(values)
    return array.shape == shape and array.dtype.kind == "f" and bool(are_numbers(array).all())


def _check_radio(r: Recording) -> None:
    N = len(r.setups)
    _require(sorted(r.order) == list(range(N)), f"order: {shown(r.order)} is no order of 0 .. {N - 1}")
    _between("dt", r.dt, *TICK_LENGTHS_S)
    _between("period", r.period, 1, MAX_PERIOD_TICKS)
    _require(r.staleness > 0.0, f"staleness: {r.staleness} is not positive")


def recorded_arrays(r: Recording) -> dict[str, Any]:
    """Return the arrays of a recording by name. Raises DataError: one has another shape or type than it should."""
    values = {name: attrgetter(name)(r) for name, spec in ARRAYS.items() if spec.recorded}
    values = {name: value for name, value in values.items() if value is not None or ARRAYS[name].optional is None}
    for problem in misshapen(values, {"K": r.ticks, **sizes_of(r.setups)}, {kind: kind for kind in "fib"}):
        raise DataError(problem)
    return values


def _check_arrays(r: Recording) -> None:
    values = recorded_arrays(r)
    for problem in problems_of_readings(r.readings, r.setups, r.ticks):
        raise DataError(problem)
    for name in shapes_of_readings(r.setups).keys() - r.readings.keys():
        raise DataError(f"readings.{name}: missing")
    about = {"now": np.arange(r.ticks)[:, None, None], "period": r.period}
    for name, valid, problem in invalid_rows(values, about, ticks=True):
        _require_all(r, name, valid, problem)
    later = np.diff(r.inbox_tick, axis=0, prepend=-1) >= 0
    _require_all(r, "inbox_tick", everywhere(later, 2), "sent before an earlier received message")


def _require_all(r: Recording, name: str, valid: Mask, problem: str) -> None:
    """Raise an error about the first row that is not valid."""
    if not valid.all():
        tick, *row = np.argwhere(~valid)[0].tolist() if ARRAYS[name].axes[0] == "K" else (None, *np.argwhere(~valid)[0])
        whose = "".join(f" of {r.setups[i].name}" for i in row)
        raise DataError(f"{name}{whose}{'' if tick is None else f', tick {tick}'}: {problem}")


def _check_drawn(r: Recording) -> None:
    if r.drawn is not None:
        _between("drawn.key", r.drawn.key, 0, 2**64 - 1)
        _between("drawn.episode", r.drawn.episode, 0, 2**32 - 1)
        _require(len(r.drawn.parameters) == len(PARAMETERS), f"drawn.parameters: not {len(PARAMETERS)} numbers")
        for factor in r.drawn.parameters:
            _between("drawn.parameters", factor, 0.0, MOST**3)


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
    for setup in r.setups:
        names = [section.label for section in s.sensors if section.is_on(setup.name)]
        same = [sensor.name for sensor in setup.sensors] == names
        _require(same, f"scenario: {setup.name} has other sensors than in its setup")
    for name in recorded_arrays(r).keys() ^ set(recorded_names(s)):
        _require(False, f"{name}: a recording has this array if its scenario asks for it, and only then")
    rates, staleness = s.rates, np.inf if s.v2x.staleness is None else s.v2x.staleness
    _require(list(r.order) == processing_order(s, neighbours), "scenario: vehicles in another order than recorded")
    _require(r.dt == 1.0 / rates.camera, f"scenario: ticks of {1.0 / rates.camera:g} s, recorded {r.dt:g} s")
    _require((r.period, r.staleness) == (s.v2x.period, staleness), "scenario: another radio than recorded")
    due = is_due(np.arange(r.ticks), min(rates.observer or rates.camera, rates.camera) / rates.camera)
    _require(np.array_equal(r.due, due), "scenario: corrections due at other ticks than recorded")
