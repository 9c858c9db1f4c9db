"""The scenario that a recording is replayed in: the recorded one, or for robots one made from their setups."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from coopenv.base.errors import CoopenvError, DataError
from coopenv.observers.recording import Recording, is_due
from coopenv.scenario import Scenario
from coopenv.scenario.files import override, parse_scenario

CHANGEABLE = ("action", "description", "horizon", "observation", "observer", "reward", "termination", "title")
"""Keys that say how a recording is used; the others say how it came about."""

DECISION_RATE = 10.0  # Hz, of the replay of robots, or the next rate at which decisions fall on ticks


def scenario_of(recording: Recording, name: str, overrides: Mapping[str, Any]) -> Scenario:
    """Return the scenario of a recording, whose name is for messages, and the title where nothing else is known.

    Raises:
        DataError: the recording holds what no scenario can say.
        CoopenvError: an override is not valid, or would change what was recorded.
    """
    if recording.ticks < 2:
        raise DataError(f"{name}: only {recording.ticks} tick recorded, nothing to replay")
    raw = _raw(recording, name)
    for key, value in overrides.items():
        if str(key).split(".")[0] not in CHANGEABLE and key != "rates.decision":
            free = f"free to choose: {', '.join(CHANGEABLE)}, rates.decision"
            raise CoopenvError(f"override '{key}': {name} is recorded; {free}")
        override(raw, str(key), value)
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
