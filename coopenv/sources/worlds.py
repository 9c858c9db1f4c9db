"""Backends of many worlds at once: the simulation, and the replay of a recording in a scenario that is made of it."""

import json
import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from coopenv.base.errors import CoopenvError, DataError, ScenarioWarning
from coopenv.estimation import Sight
from coopenv.observers.arrays import ARRAYS
from coopenv.observers.contract import ObserverInit, Setup, sealed
from coopenv.observers.recording import Recording, check_recording
from coopenv.observers.registry import find_embedded
from coopenv.observers.sensed import Sensed, Truth, is_due
from coopenv.observers.setups import start_covariances
from coopenv.scenario import Scenario, parse_scenario
from coopenv.scenario.files import override
from coopenv.scenario.schema import neighbour_sets, processing_order
from coopenv.sources.base import Capabilities, SensingWorld, TickGenerator, TickStream
from coopenv.sources.feed import RECORDED, Feed
from coopenv.world.embedded import HOST


class SimulatedWorld(SensingWorld):
    """A world that reads measurements from its state: copies in float64, bearings in the body frame."""

    @cached_property
    def _markers(self) -> np.ndarray:
        """(L, 3, 1) of the landmarks, m."""
        return np.array([landmark.marker for landmark in self.scenario.landmarks], float).reshape(-1, 3, 1)

    @cached_property
    def _from_body(self) -> np.ndarray:
        """(N, 3, 3) body to camera."""
        to_body: np.ndarray = self.model.camera.numpy()["rotation"].astype(float)
        return to_body.swapaxes(-1, -2)

    def sensed(self, world: int, k: int) -> Sensed:
        """Return the measurements of the vehicles of one world now, at tick k."""
        L, rates = len(self._markers), self.scenario.rates
        visible = self._copy("sight", world) == Sight.VISIBLE
        bearings = np.where(visible[..., None], self._pointed("bearing", world) @ self._from_body, np.nan)
        R, position = self._copy("rotation", world)[:L], self._copy("position", world)[:L]
        arrays = {
            "rotation": self._turned("increment_rotation", world),
            "translation": self._copy("increment_translation", world),
            "velocity": self._copy("odometry_velocity", world),
            "angular_velocity": self._copy("odometry_angular_velocity", world),
            "bearings": bearings,
            "visible": visible,
            "landmarks": position + (R @ self._markers)[..., 0],
        }
        if self.model.map_errors:
            arrays["landmarks"] += self._copy("map_offset", world)[:L]
        for name in ("pan", "bearing_age"):
            if ARRAYS[name].present(self.scenario):
                arrays[name] = self._copy(name, world)
        for values in arrays.values():
            values.setflags(write=False)
        due = bool(is_due(k, self.model.observer.rate / rates.camera))
        return Sensed(index=k, dt=1.0 / rates.camera, due=due, readings=self._readings(world, k), **arrays)

    def _readings(self, world: int, k: int) -> dict[str, np.ndarray]:
        """Return what the sensors beside the camera have measured at tick k, by name."""
        readings = {}
        for d, section in enumerate(self.scenario.sensors):
            entries = slice(None) if section.made.has_target else slice(1)
            measured = self.view("reading_tick")[world, :, d, entries] == k
            values = np.array(self.view("reading")[world, :, d, entries, : section.made.size], dtype=float)
            readings[section.label] = sealed(np.where(measured[..., None], values, np.nan))
        return readings

    def full_tick(self, k: int) -> Sensed:
        """Return the tick of the first world with truth and deliveries."""
        L = len(self._markers)
        taken = self._copy("odometry_samples", 0)
        now = k / self.scenario.rates.camera
        return replace(
            self.sensed(0, k),
            odometry_age=np.where(taken > 0, now - (taken - 1) / self.scenario.rates.odometry, np.inf),
            truth=Truth(self._copy("rotation", 0)[L:], self._copy("position", 0)[L:]),
            inbox_tick=self.view("inbox_tick")[0].astype(np.int64),
        )

    def _turned(self, name: str, world: int) -> np.ndarray:
        """Return rotations that are so in float64 too: over thousands of ticks float32's rounding would add up."""
        R = self._copy(name, world)
        if self.precision.numpy is np.float32:
            R = R @ (1.5 * np.eye(3) - 0.5 * np.swapaxes(R, -1, -2) @ R)  # a Newton step towards the nearest rotation
        return R

    def _pointed(self, name: str, world: int) -> np.ndarray:
        """Return unit vectors that are so in float64 too; zero where nothing has been measured."""
        b = self._copy(name, world)
        if self.precision.numpy is np.float32:
            b /= np.maximum(np.linalg.norm(b, axis=-1, keepdims=True), 0.5)
        return b

    def _copy(self, name: str, world: int) -> np.ndarray:
        return np.array(self.view(name)[world], dtype=float)


class Simulated(TickGenerator):
    """Worlds that are computed: many at once on a device, or one of them tick by tick."""

    def __init__(self, scenario: Scenario) -> None:
        """Simulate a scenario."""
        driven, ticks = scenario.driven, scenario.horizon_ticks + 1
        capabilities = Capabilities(truth=True, driven=driven, real_time=False, ticks=ticks, batched=True)
        super().__init__(scenario, capabilities)
        self._world: SimulatedWorld | None = None

    def kind(self, *arguments: Any, **options: Any) -> SimulatedWorld:
        """Return worlds; arguments and errors as for `World`."""
        return SimulatedWorld(*arguments, **options)

    def world(self, worlds: int, dtype: str, device: str, threads: int | None) -> SimulatedWorld:
        """Return the worlds, with the observer that the scenario names."""
        observer = find_embedded(self.scenario.observer.name) or HOST
        start = start_covariances(self.scenario)
        return self.kind(self.scenario, worlds, dtype, device, threads, observer, start)

    def episode(self, seed: int | None, options: Mapping[str, Any]) -> TickStream:
        """Simulate one world in float64, without an observer: deliveries do not depend on the contents of messages."""
        if self._world is None:
            self._world = self.kind(self.scenario, 1, "float64", "cpu", 1)
        world, acting = self._world, [vehicle.motion.kind != "traffic" for vehicle in self.scenario.vehicles]
        world.reset(None if seed is None else [seed])
        command = yield world.full_tick(0)
        for k in range(1, self.scenario.horizon_ticks + 1):
            world.view("command")[0, acting] = command.rows[acting]
            world.fetch()
            world.sense()
            for vehicle in world.observer_init.order:
                world.receive(vehicle)
                world.broadcast(vehicle)
            world.finish()
            command = yield world.full_tick(k)


CHANGEABLE = ("action", "description", "horizon", "observation", "observer", "reward", "termination", "title")
"""Keys of the use of a recording; the others describe its origin."""

LASTING = ("odometry_scale", "odometry_scale_walk", "gyro_bias", "gyro_bias_walk")  # errors of a vehicle's odometry

DECISION_RATE = 10.0  # Hz, of the replay of robots, or the next rate at which decisions fall on ticks


def scenario_of(recording: Recording, name: str, overrides: Mapping[str, Any]) -> Scenario:
    """Return the scenario of a recording, whose name is for messages, and the title where nothing else is known.

    Raises:
        DataError: no scenario can describe the recording.
        CoopenvError: an override is not valid, or would change what was recorded.
    """
    if recording.ticks < 2:
        raise DataError(f"{name}: only {recording.ticks} tick recorded, nothing to replay")
    raw = _raw(recording, name)
    for key in overrides:
        if str(key).split(".")[0] not in CHANGEABLE and key != "rates.decision":
            free = f"free to choose: {', '.join(CHANGEABLE)}, rates.decision"
            raise CoopenvError(f"override '{key}': {name} is recorded; {free}")
    override(raw, overrides)
    scenario = parse_scenario(raw, name)
    if scenario.horizon_ticks > recording.ticks - 1:
        raise CoopenvError(f"horizon: {scenario.horizon:g} s are more than {name} has ({recording.t[-1]:g} s)")
    return scenario


def _raw(recording: Recording, name: str) -> dict[str, Any]:
    if recording.scenario is not None:
        raw = recording.scenario.model_dump(mode="json")
        raw["horizon"] = (recording.ticks - 1) / recording.scenario.rates.camera
    else:
        raw = _of_robots(recording, name)
    for landmark in raw["landmarks"]:  # recorded is the point that cameras see
        if landmark.get("body"):
            landmark["body"]["center"] = np.subtract(landmark["body"]["center"], landmark["marker"]).tolist()
        landmark["marker"] = (0.0, 0.0, 0.0)
    return raw


def _of_robots(recording: Recording, name: str) -> dict[str, Any]:
    """Return plain data of a scenario with the vehicles, landmarks, gains and radio of a recording."""
    first, rate = recording.setups[0], 1.0 / recording.dt
    gains, noise, targets = first.gains, first.noise, first.target_names
    for setup in recording.setups:
        own = setup.gains
        if not np.array_equal(own.q, gains.q) or (own.V, own.P0, own.max_turn) != (gains.V, gains.P0, gains.max_turn):
            raise DataError(f"{name}: {setup.name} has other gains than {first.name}")
        if not np.array_equal(setup.lever_arm, first.lever_arm):
            raise DataError(f"{name}: the camera of {setup.name} sits elsewhere than that of {first.name}")
    corrections = float(recording.due[1:].mean()) * rate
    if not np.array_equal(is_due(np.arange(recording.ticks), corrections / rate)[1:], recording.due[1:]):
        raise DataError(f"{name}: its corrections are not due at a fixed rate")
    staleness = recording.staleness if math.isfinite(recording.staleness) else None
    points = zip(targets[: first.landmarks], recording.landmarks[0].tolist(), strict=True)
    accuracies = first.landmark_std or [None] * first.landmarks
    starts = zip(recording.setups, recording.start_position.tolist(), strict=True)
    return {
        "title": name,
        "horizon": (recording.ticks - 1) * recording.dt,
        "landmarks": [
            {"name": target, "position": position, "accuracy": std}
            for (target, position), std in zip(points, accuracies, strict=True)
        ],
        "vehicles": [
            {
                "initial_pose": {"position": position},
                "marker": setup.marker.tolist(),
                "neighbours": [targets[n] for n in setup.targets],
            }
            for setup, position in starts
        ],
        "camera": {
            "position": first.lever_arm.tolist(),
            "orientation": "body",
            "extrinsics_error": noise.camera_orientation,
            "extrinsics_position_error": noise.camera_position,
            "extrinsics_walk": noise.camera_orientation_walk,
            "focal_length_error": noise.focal_length,
            "latency_error": noise.latency,
            "latency_jitter": noise.latency_jitter,
        },
        "rates": {
            "camera": rate,
            "odometry": 1.0 / noise.odometry_period,
            "observer": corrections,
            "decision": rate / max(1, round(rate / DECISION_RATE)),
        },
        "noise": {
            **{name: getattr(noise, name) for name in ("velocity", "angular_velocity", *LASTING)},
            "bearing": {"model": "isotropic", "scale": noise.bearing},
            "slip": dict(zip(("rate", "duration", "size", "angle"), noise.slip, strict=True)),
        },
        "sensors": _sensor_sections(recording.setups),
        "topology": {"mode": "sensed", "acyclic": False},
        "v2x": {"period": recording.period, "staleness": staleness},
        "observer": {
            "k": [setup.gains.k for setup in recording.setups],
            "q": dict(zip(targets, gains.q.tolist(), strict=True)),
            **{name: getattr(gains, name) for name in ("V", "P0", "max_turn")},
        },
    }


def _sensor_sections(setups: Sequence[Setup]) -> list[dict[str, Any]]:
    """Return plain data of the sensors beside the camera that robots have."""
    sections: dict[str, dict[str, Any]] = {}
    for setup in setups:
        for sensor in setup.sensors:
            section = sections.setdefault(
                sensor.name,
                {
                    "kind": sensor.reference,
                    "name": sensor.name,
                    "vehicles": [],
                    "towards": ["landmarks", "vehicles"] if sensor.kind.has_target else ["map"],
                    "position": sensor.position.tolist(),
                    "orientation": Rotation.from_matrix(sensor.rotation).as_quat(scalar_first=True).tolist(),
                    "noise": sensor.std.tolist(),
                    "options": json.loads(sensor.options),
                },
            )
            section["vehicles"].append(setup.name)
    return [*sections.values()]


def of_robots(recording: Recording, kept: Sequence[int]) -> Recording:
    """Return a recording in which the robots that are not kept have no neighbours and no truth."""
    out = np.array([i not in kept for i in range(len(recording.setups))])
    gone, seen = recording.setups[0].landmarks + np.flatnonzero(out), recording.visible.copy()
    seen[:, out], seen[..., gone] = False, False
    setups = tuple(
        without_targets(setup, gone if i in kept else setup.targets) for i, setup in enumerate(recording.setups)
    )
    readings = {name: np.array(values) for name, values in recording.readings.items()}
    for values in readings.values():
        values[:, out] = np.nan
        values[:, :, gone if values.shape[2] == seen.shape[2] else []] = np.nan
    truth = Truth(*(np.array(values) for values in (recording.truth.rotation, recording.truth.position)))
    truth.rotation[:, out], truth.position[:, out] = np.nan, np.nan
    scenario, order = without_robots(recording.scenario, kept), recording.order
    if scenario is not None:
        order = tuple(processing_order(scenario, neighbour_sets(scenario)))
    bearings = np.where(seen[..., None], recording.bearings, np.nan)
    return replace(
        recording,
        setups=setups,
        visible=seen,
        bearings=bearings,
        readings=readings,
        truth=truth,
        scenario=scenario,
        order=order,
    )


def without_targets(setup: Setup, gone: NDArray[np.int64]) -> Setup:
    """Return a setup whose vehicle measures none of some targets, with any sensor."""
    sensors = tuple(replace(sensor, targets=sensor.targets[~np.isin(sensor.targets, gone)]) for sensor in setup.sensors)
    return replace(setup, targets=np.setdiff1d(setup.targets, gone), sensors=sensors)


def without_robots(scenario: Any, kept: Sequence[int]) -> Any:
    """Return a scenario in which only the vehicles kept have neighbours, each among the kept; None of None."""
    if scenario is None or len(kept) == len(scenario.vehicles):
        return scenario
    names, L = scenario.target_names, len(scenario.landmarks)
    neighbours = [
        tuple(names[n] for n in targets if n < L or n - L in kept) if i in kept else ()
        for i, targets in enumerate(neighbour_sets(scenario))
    ]
    vehicles = [v.model_copy(update={"neighbours": n}) for v, n in zip(scenario.vehicles, neighbours, strict=True)]
    with warnings.catch_warnings(action="ignore", category=ScenarioWarning):  # of vehicles without neighbours
        return scenario.model_copy(update={"vehicles": tuple(vehicles)})


def has_faults(recording: Recording) -> bool:
    """Return whether the scenario of a recording has faults, which a replay draws again."""
    return recording.scenario is not None and any(faults.any for faults in recording.scenario.all_faults)


def stretch(recording: Recording, first: int, last: int, where: str) -> Recording:
    """Return the ticks from `first` to `last` of a recording."""
    if first and (recording.interference is not None or has_faults(recording)):
        raise DataError(f"{where}: from: its scenario has faults, whose times count from its own start")
    truth, judged, cut = recording.truth, ~recording.left_out, slice(first, last + 1)
    known = np.asarray(truth.known[:, judged].all(axis=1))
    if first and not known[first]:
        later = np.flatnonzero(known[first:])
        hint = f"; they are at {(first + later[0]) * recording.dt:g} s" if len(later) else ""
        raise DataError(f"{where}: from: true poses of all robots are not known at {first * recording.dt:g} s{hint}")
    arrays: dict[str, Any] = {name: np.array(values[cut]) for name, values in recording.per_tick().items()}
    arrays["rotation"][0], arrays["translation"][0] = np.eye(3), 0.0
    arrays["inbox_tick"] = np.where(arrays["inbox_tick"] >= first, arrays["inbox_tick"] - first, -1)
    arrays["due"] = recording.due[: last + 1 - first]
    if first:
        R, p = np.array(recording.start_rotation), np.array(recording.start_position)
        for i in np.flatnonzero(judged):
            begin, now = ((truth.rotation[k, i], truth.position[k, i]) for k in (0, first))
            if not truth.known[0, i]:
                begin = R[i], p[i]
            moved = now[0] @ begin[0].T
            R[i], p[i] = moved @ R[i], now[1] + moved @ (p[i] - begin[1])
        arrays |= {"start_rotation": R, "start_position": p}
    truth = Truth(truth.rotation[cut], truth.position[cut])
    return replace(recording, truth=truth, readings=recording.readings_at(cut), **arrays)


class ReplayWorld(SensingWorld):
    """A world whose truth, measurements and deliveries are recorded."""

    source = RECORDED

    def __init__(self, recording: Recording, scenario: Scenario, *arguments: Any) -> None:
        """Build the arrays; further arguments and errors as for `World`."""
        self._recording = recording
        super().__init__(scenario, *arguments)

    @cached_property
    def observer_init(self) -> ObserverInit:
        """Initial information for observers."""
        return self._recording.observer_init

    def sensed(self, world: int, k: int) -> Sensed:
        """Return the measurements at tick k, the same in every world and in float64 for any precision."""
        return self._recording.at(k)

    def _build_model(self) -> Any:
        model = super()._build_model()
        order = np.array(self._recording.order, dtype=np.int32)
        model.order = wp.array(order, dtype=wp.int32, device=self.device)
        model.rank = wp.array(np.argsort(order).astype(np.int32), dtype=wp.int32, device=self.device)
        model.radio.slots = max(self._recording.flight, 1) + 1 + self.scenario.replay_ticks
        return model

    def _build_record(self) -> Any:
        feed = Feed(self._recording.ticks, self.model, self.scenario, self.precision, self.device)
        feed.fill_recording(self._recording)
        return feed.record


class Replay(TickGenerator):
    """A recording as a backend. Actions change nothing; every episode is the recording again."""

    def __init__(self, recording: Recording, name: str, overrides: Mapping[str, Any] | None = None) -> None:
        """Find the recording's scenario; arguments and errors as for `check_recording` and `scenario_of`."""
        check_recording(recording, name)
        self.recording = recording
        scenario, known = scenario_of(recording, name, overrides or {}), bool(recording.truth.known.any())
        ticks = scenario.horizon_ticks + 1
        out = recording.left_out
        here = tuple(np.flatnonzero(~out).tolist()) if out.any() and not out.all() else None
        super().__init__(scenario, Capabilities(known, False, False, ticks, True, True, here))

    def world(self, worlds: int, dtype: str, device: str, threads: int | None) -> ReplayWorld:
        """Return worlds that go through the recording."""
        host = self.recording.on_a_plane  # a scenario cannot say all that the setups of robots do
        observer = HOST if host else find_embedded(self.scenario.observer.name) or HOST
        covariance = self.recording.start_covariance
        return ReplayWorld(self.recording, self.scenario, worlds, dtype, device, threads, observer, covariance)

    def episode(self, seed: int | None, options: Mapping[str, Any]) -> TickStream:
        """Go through the recording tick by tick."""
        recording = self.recording
        age = recording.odometry_age(self.scenario.rates.odometry)
        for k in range(self.scenario.horizon_ticks + 1):
            yield replace(recording.at(k), odometry_age=np.full(len(recording.setups), age[k]))
