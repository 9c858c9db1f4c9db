"""What a recording says once, as plain data: who is there, gains, noise, starts, and the scenario it came from."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from coopenv.observers.contract import Gains, SensorNoise, Setup
from coopenv.observers.recording import Recording
from coopenv.scenario.files import parse_scenario


def facts_of(recording: Recording) -> dict[str, Any]:
    """Return everything of a recording that does not change from tick to tick."""
    return {
        "ticks": recording.ticks,
        "dt": recording.dt,
        "order": list(recording.order),
        "period": recording.period,
        "staleness": None if math.isinf(recording.staleness) else recording.staleness,
        "setups": [_setup_facts(setup) for setup in recording.setups],
        "start_rotation": recording.start_rotation.tolist(),
        "start_position": recording.start_position.tolist(),
        "start_covariance": recording.start_covariance.tolist(),
        "scenario": None if recording.scenario is None else recording.scenario.model_dump(mode="json"),
    }


def _setup_facts(setup: Setup) -> dict[str, Any]:
    noise, gains = setup.noise, setup.gains
    return {
        "vehicle": setup.vehicle,
        "name": setup.name,
        "target_names": list(setup.target_names),
        "landmarks": setup.landmarks,
        "targets": setup.targets.tolist(),
        "lever_arm": setup.lever_arm.tolist(),
        "marker": setup.marker.tolist(),
        "planar": setup.planar,
        "noise": {
            "velocity": noise.velocity,
            "angular_velocity": noise.angular_velocity,
            "odometry_period": noise.odometry_period,
            "bearing": noise.bearing,
            "image_axis": None if noise.image_axis is None else list(noise.image_axis),
        },
        "gains": {
            "k": gains.k,
            "q": gains.q.tolist(),
            "V": list(gains.V),
            "P0": list(gains.P0),
            "max_turn": gains.max_turn,
        },
    }


def _noise(facts: Mapping[str, Any]) -> SensorNoise:
    axis = facts["image_axis"]
    x, y, z = (0.0, 0.0, 0.0) if axis is None else _array(axis, 3).tolist()
    return SensorNoise(
        velocity=float(facts["velocity"]),
        angular_velocity=float(facts["angular_velocity"]),
        odometry_period=float(facts["odometry_period"]),
        bearing=float(facts["bearing"]),
        image_axis=None if axis is None else (x, y, z),
    )


def setup_from(facts: Mapping[str, Any]) -> Setup:
    """Return a setup from its plain data."""
    gains = facts["gains"]
    return Setup(
        vehicle=int(facts["vehicle"]),
        name=str(facts["name"]),
        target_names=tuple(facts["target_names"]),
        landmarks=int(facts["landmarks"]),
        targets=np.array(facts["targets"], np.int64),
        lever_arm=_array(facts["lever_arm"], 3),
        marker=_array(facts["marker"], 3),
        noise=_noise(facts["noise"]),
        gains=Gains(
            k=float(gains["k"]),
            q=_array(gains["q"], len(facts["target_names"])),
            V=_pair(gains["V"]),
            P0=_pair(gains["P0"]),
            max_turn=float(gains["max_turn"]),
        ),
        planar=bool(facts["planar"]),
    )


def constants_from(facts: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return the arguments of a `Recording` that its facts give.

    Raises:
        KeyError, TypeError, ValueError: facts are missing or malformed (a `ScenarioError` is a ValueError).
    """
    N = len(facts["setups"])
    return {
        "setups": tuple(setup_from(setup) for setup in facts["setups"]),
        "order": tuple(int(i) for i in facts["order"]),
        "dt": float(facts["dt"]),
        "period": int(facts["period"]),
        "staleness": math.inf if facts["staleness"] is None else float(facts["staleness"]),
        "start_rotation": _array(facts["start_rotation"], N, 3, 3),
        "start_position": _array(facts["start_position"], N, 3),
        "start_covariance": _array(facts["start_covariance"], N, 6, 6),
        "scenario": None if facts["scenario"] is None else parse_scenario(facts["scenario"], where),
    }


def _array(values: Any, *shape: int) -> np.ndarray:
    return np.array(values, dtype=np.float64).reshape(shape)


def _pair(values: Any) -> tuple[float, float]:
    first, second = values
    return float(first), float(second)
