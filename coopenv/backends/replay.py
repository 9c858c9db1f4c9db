"""Replay of a recording in place of the simulated world, and the scenario that is made of a recording."""

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp

from coopenv.backends.base import Capabilities, Episode, SensingWorld, TickGenerator
from coopenv.backends.feed import RECORDED, Feed
from coopenv.base.errors import CoopenvError, DataError
from coopenv.observers.contract import ObserverInit
from coopenv.observers.recording import Recording, Sensed, check_recording, is_due
from coopenv.observers.registry import find_embedded
from coopenv.scenario import Scenario
from coopenv.scenario.files import override, parse_scenario
from coopenv.world.embedded import HOST

CHANGEABLE = ("action", "description", "horizon", "observation", "observer", "reward", "termination", "title")
"""Keys of the use of a recording; the others describe its origin."""

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
    starts = zip(recording.setups, recording.start_position.tolist(), strict=True)
    return {
        "title": name,
        "horizon": (recording.ticks - 1) * recording.dt,
        "landmarks": [{"name": target, "position": position} for target, position in points],
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
            "focal_length_error": noise.focal_length,
        },
        "rates": {
            "camera": rate,
            "odometry": 1.0 / noise.odometry_period,
            "observer": corrections,
            "decision": rate / max(1, round(rate / DECISION_RATE)),
        },
        "noise": {
            "velocity": noise.velocity,
            "angular_velocity": noise.angular_velocity,
            "bearing": {"model": "isotropic", "scale": noise.bearing},
            "odometry_scale": noise.odometry_scale,
            "odometry_scale_walk": noise.odometry_scale_walk,
            "gyro_bias": noise.gyro_bias,
            "gyro_bias_walk": noise.gyro_bias_walk,
            "slip": dict(zip(("rate", "duration", "size", "angle"), noise.slip, strict=True)),
        },
        "topology": {"mode": "sensed", "acyclic": False},
        "v2x": {"period": recording.period, "staleness": staleness},
        "observer": {
            "k": [setup.gains.k for setup in recording.setups],
            "q": dict(zip(targets, gains.q.tolist(), strict=True)),
            **{name: getattr(gains, name) for name in ("V", "P0", "max_turn")},
        },
    }


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
        """Return what was sensed at tick k, the same in every world and in float64 whatever the precision."""
        return self._recording.at(k)

    def _build_model(self) -> Any:
        model = super()._build_model()
        order = np.array(self._recording.order, dtype=np.int32)
        model.order = wp.array(order, dtype=wp.int32, device=self.device)
        model.rank = wp.array(np.argsort(order).astype(np.int32), dtype=wp.int32, device=self.device)
        model.radio.slots = max(self._recording.flight, 1) + 1 + self.scenario.replay_ticks
        return model

    def _build_record(self) -> Any:
        rate = self.scenario.rates.odometry
        feed = Feed(self._recording.ticks, self.model, rate, self.precision, self.device)
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
        abilities = Capabilities(truth=known, driven=False, real_time=False, ticks=ticks, batched=True, recorded=True)
        super().__init__(scenario, abilities)

    def world(self, worlds: int, dtype: str, device: str, threads: int | None) -> ReplayWorld:
        """Return worlds that go through the recording."""
        observer = find_embedded(self.scenario.observer.name, self.recording.on_a_plane) or HOST
        covariance = self.recording.start_covariance
        return ReplayWorld(self.recording, self.scenario, worlds, dtype, device, threads, observer, covariance)

    def episode(self, seed: int | None, options: Mapping[str, Any]) -> Episode:
        """Go through the recording tick by tick."""
        recording = self.recording
        age = recording.odometry_age(self.scenario.rates.odometry)
        for k in range(self.scenario.horizon_ticks + 1):
            yield replace(recording.at(k), odometry_age=np.full(len(recording.setups), age[k]))


__all__ = ["Replay"]
