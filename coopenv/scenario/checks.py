"""Checks that span several sections of a scenario. Each failure is one line that names the field."""

from __future__ import annotations

import re
import warnings
from collections import Counter
from collections.abc import Sequence

import numpy as np

from coopenv.errors import ScenarioWarning, listed, shown, suggest
from coopenv.scenario.fields import ScenarioFields
from coopenv.scenario.starts import check_room
from coopenv.scenario.topology import neighbour_sets, processing_order

MOST_TICKS = 1e8
"""Camera frames or odometry samples of one episode; counters are 32 bits wide."""

MOST_PAIRS = 2e7
"""Of vehicles and their targets."""

FAR_FROM_ORIGIN = 50.0
"""m; beyond it the paper's observer loses accuracy, because it is not invariant to the map origin."""


def landmark_names(names: Sequence[str]) -> None:
    """Refuse names that occur twice or that vehicles have."""
    for name, times in Counter(names).items():
        if times > 1:
            raise ValueError(f"landmark name '{name}' is used twice")
        if re.fullmatch(r"vehicle_\d+", name):
            raise ValueError(f"landmark name '{name}' is reserved for vehicles")


def everything(scenario: ScenarioFields) -> None:
    """Run all checks on a parsed scenario.

    Raises:
        ValueError: the first impossibility found.
    """
    vehicles, targets = len(scenario.vehicles), len(scenario.target_names)
    if vehicles * targets > MOST_PAIRS:
        raise ValueError(f"vehicles: {vehicles} times {targets} targets are over {MOST_PAIRS:.0e} pairs")
    neighbours = neighbour_sets(scenario)
    processing_order(scenario, neighbours)
    gains(scenario)
    check_room(scenario)
    limits(scenario)
    observability(scenario, neighbours)


def gains(scenario: ScenarioFields) -> None:
    """Check per-vehicle and per-target gains against the names that exist."""
    k = scenario.observer.k
    if isinstance(k, tuple) and len(k) != len(scenario.vehicles):
        raise ValueError(f"observer.k: {len(k)} values for {len(scenario.vehicles)} vehicles")
    if isinstance(scenario.observer.q, dict):
        targets = set(scenario.target_names)
        for name in scenario.observer.q:
            if name not in targets:
                raise ValueError(f"observer.q: unknown target {shown(name)}{suggest(name, targets)}")


def limits(scenario: ScenarioFields) -> None:
    """Check quantities of one section against those of another."""
    for name, rate in (("camera", scenario.rates.camera), ("odometry", scenario.rates.odometry)):
        if scenario.horizon * rate > MOST_TICKS:
            raise ValueError(
                f"horizon: {scenario.horizon:g} s at rates.{name} = {rate:g} Hz are over {MOST_TICKS:.0e} samples"
            )
    for i, vehicle in enumerate(scenario.vehicles):
        motion, top = vehicle.motion, scenario.dynamics.max_speed
        if motion.kind == "driven" and not (-top if scenario.dynamics.reverse else 0.0) <= motion.initial_speed <= top:
            raise ValueError(
                f"vehicles.{i}.motion.initial_speed: {motion.initial_speed:g} m/s is beyond what [dynamics] permits"
            )
    decision = 1.0 / scenario.rates.decision
    if scenario.dynamics.latency > decision:
        raise ValueError(
            f"dynamics.latency: {scenario.dynamics.latency:g} s is longer than one decision ({decision:g} s)"
        )
    steering = scenario.action.steering
    if steering is not None and steering > scenario.dynamics.max_steering:
        raise ValueError(
            f"action.steering: {steering:g} rad is above dynamics.max_steering ({scenario.dynamics.max_steering:g} rad)"
        )


def observability(scenario: ScenarioFields, neighbours: Sequence[Sequence[int]]) -> None:
    """Warn where the paper's conditions for convergence are not met by construction."""
    count = len(scenario.landmarks)
    if count < 3:
        warnings.warn(
            f"only {count} landmark{'s' if count != 1 else ''}: with fewer than three the paper's Assumption 2 "
            "fails and observability is not guaranteed",
            ScenarioWarning,
            stacklevel=2,
        )
    lonely = [f"vehicle_{i + 1}" for i, targets in enumerate(neighbours) if len(targets) < 3]
    if lonely and count >= 3:
        verb = "has" if len(lonely) == 1 else "have"
        warnings.warn(
            f"{listed(lonely)} {verb} fewer than three neighbours: observability is not guaranteed",
            ScenarioWarning,
            stacklevel=2,
        )
    origin = np.array(scenario.map.origin)
    for landmark in scenario.landmarks:
        distance = float(np.linalg.norm(np.array(landmark.position) - origin))
        if distance > FAR_FROM_ORIGIN:
            warnings.warn(
                f"landmark '{landmark.name}' lies {distance:.0f} m from the map origin: the paper's observer is "
                f"not invariant to the origin and degrades beyond {FAR_FROM_ORIGIN:.0f} m; set map.origin inside "
                "the scene",
                ScenarioWarning,
                stacklevel=2,
            )
            break
