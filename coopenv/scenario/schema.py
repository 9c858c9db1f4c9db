"""The scenario: everything that defines a world, typed and checked; each failure is one line that names the field."""

import re
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Self

import numpy as np
from pydantic import field_validator, model_validator

from coopenv.base.errors import ScenarioWarning, listed, shown, suggest
from coopenv.scenario.bodies import Landmark
from coopenv.scenario.fields import ScenarioFields
from coopenv.scenario.routes import followers
from coopenv.scenario.starts import check_room, neighbour_sets, processing_order

MOST_TICKS = 1e8  # camera frames or odometry samples of one episode; counters are 32 bits wide

MOST_PAIRS = 2e7  # of vehicles and their targets

LIMITS = {"max_acceleration", "max_speed", "max_steering", "reverse"}
"""Keys of `[dynamics]` that are limits of commands; the others describe this project's own bicycle."""

FAR_FROM_ORIGIN = 50.0
"""m; beyond it the paper's observer loses accuracy, because it is not invariant to the map origin."""


class Scenario(ScenarioFields):
    """One environment. Units: m, s, rad; frames: x east, y north, z up; body x forward, y left, z up."""

    @field_validator("landmarks")
    @classmethod
    def _names_are_free(cls, landmarks: tuple[Landmark, ...]) -> tuple[Landmark, ...]:
        for name, times in Counter(landmark.name for landmark in landmarks).items():
            if times > 1:
                raise ValueError(f"landmark name '{name}' is used twice")
            if re.fullmatch(r"vehicle_\d+", name):
                raise ValueError(f"landmark name '{name}' is reserved for vehicles")
        return landmarks

    @model_validator(mode="after")
    def _is_possible(self) -> Self:
        vehicles, targets = len(self.vehicles), len(self.target_names)
        if vehicles * targets > MOST_PAIRS:
            raise ValueError(f"vehicles: {vehicles} times {targets} targets are over {MOST_PAIRS:.0e} pairs")
        neighbours = neighbour_sets(self)
        processing_order(self, neighbours)
        for problem in (*_misplaced(self), *_problems(self)):
            raise ValueError(problem)
        if self.backend == "simulated":
            check_room(self)
        for doubt in _doubts(self, neighbours):
            warnings.warn(doubt, ScenarioWarning, stacklevel=2)
        return self


def _misplaced(s: ScenarioFields) -> Iterator[str]:
    """Yield what does not fit to what moves the vehicles."""
    elsewhere = s.backend == "highway"
    if elsewhere != (s.highway is not None):
        yield "highway: needed" if elsewhere else 'highway: only with backend = "highway"'
    for i, vehicle in enumerate(s.vehicles):
        kind = vehicle.motion.kind
        if elsewhere and kind not in ("driven", "traffic"):
            yield f"vehicles.{i}.motion.kind: '{kind}' is not known to highway-env; known: driven, traffic"
        speed = getattr(vehicle.motion, "initial_speed", 0.0)
        drawn = {"initial_pose": vehicle.initial_pose is not None, "motion.initial_speed": speed != 0.0}
        for key in [key for key, given in drawn.items() if given] if elsewhere else ():
            yield f"vehicles.{i}.{key}: highway-env draws it; leave this out"
        if not elsewhere and kind == "traffic":
            yield f"vehicles.{i}.motion.kind: 'traffic' needs backend = \"highway\""
        if not elsewhere and kind != "waypoints" and vehicle.initial_pose is None and not vehicle.routes:
            yield f"vehicles.{i}.initial_pose: needed, with at least a position"
    given = {"dynamics": s.dynamics, **{f"vehicles.{i}.dynamics": v.dynamics for i, v in enumerate(s.vehicles)}}
    for where, part in given.items() if elsewhere else ():
        for name in sorted((part.model_fields_set if part else set()) - LIMITS):
            yield f"{where}.{name}: highway-env has its own; allowed: {', '.join(sorted(LIMITS))}"
    if elsewhere and s.rates.camera % 1.0:
        yield f"rates.camera: highway-env steps a whole number of times a second, not {s.rates.camera:g}"
    if elsewhere and not s.driven:
        yield "vehicles: highway-env needs at least one that is driven"


def _problems(s: ScenarioFields) -> Iterator[str]:
    """Yield what of one section does not fit to another."""
    k, q, targets = s.observer.k, s.observer.q, set(s.target_names)
    if isinstance(k, tuple) and len(k) != len(s.vehicles):
        yield f"observer.k: {len(k)} values for {len(s.vehicles)} vehicles"
    for name in [name for name in q if name not in targets] if isinstance(q, dict) else ():
        yield f"observer.q: unknown target {shown(name)}{suggest(name, targets)}"
    yield from _problems_of_routes(s)
    yield from _problems_of_draws(s)
    for name, rate in (("camera", s.rates.camera), ("odometry", s.rates.odometry)):
        if s.horizon * rate > MOST_TICKS:
            yield f"horizon: {s.horizon:g} s at rates.{name} = {rate:g} Hz are over {MOST_TICKS:.0e} samples"
    if s.action.pan is not None and s.highway is not None:
        yield "action.pan: cameras of vehicles of highway-env do not turn"
    yield from _beyond_limits(s)


def _beyond_limits(s: ScenarioFields) -> Iterator[str]:
    """Yield what of the vehicles' motion and action is beyond their own limits."""
    steering, decision = s.action.steering, 1.0 / s.rates.decision
    for i, (vehicle, limits) in enumerate(zip(s.vehicles, s.limits, strict=True)):
        own = vehicle.dynamics is not None
        where, top = f"vehicles.{i}.dynamics" if own else "dynamics", limits.max_speed
        speed = vehicle.motion.initial_speed if vehicle.motion.kind == "driven" else 0.0
        if not (-top if limits.reverse else 0.0) <= speed <= top:
            yield f"vehicles.{i}.motion.initial_speed: {speed:g} m/s is beyond what [dynamics] permits"
        if limits.latency > decision:
            yield f"{where}.latency: {limits.latency:g} s is longer than one decision ({decision:g} s)"
        if steering is not None and steering > limits.max_steering:
            yield f"action.steering: {steering:g} rad is above {where}.max_steering ({limits.max_steering:g} rad)"


def _problems_of_routes(s: ScenarioFields) -> Iterator[str]:
    names = [route.name for route in s.routes]
    for name, times in Counter(names).items():
        if times > 1:
            yield f"routes: the name '{name}' is used twice"
    for i, vehicle in enumerate(s.vehicles):
        for key, name in [*(("routes", n) for n in vehicle.routes), *(("next_routes", n) for n in vehicle.next_routes)]:
            if name not in names:
                yield f"vehicles.{i}.{key}: unknown route {shown(name)}{suggest(name, names)}; known: {listed(names)}"


def _problems_of_draws(s: ScenarioFields) -> Iterator[str]:
    groups = [group.name for group in s.landmark_groups]
    for name, times in Counter(groups).items():
        if times > 1:
            yield f"landmark_groups: the name '{name}' is used twice"
    for i, mark in enumerate(s.landmarks):
        if mark.group is not None and mark.group not in groups:
            yield f"landmarks.{i}.group: unknown group {shown(mark.group)}; groups make their landmarks themselves"
    if s.termination.after_arrival == "park":
        return
    if not s.termination.arrival:
        yield f"termination.arrival: must be true where after_arrival is '{s.termination.after_arrival}'"
    if s.termination.after_arrival == "continue":
        yield from _problems_of_sequels(s)


def _problems_of_sequels(s: ScenarioFields) -> Iterator[str]:
    """Yield where a vehicle arrives and no route goes on."""
    by_name = {route.name: route for route in s.routes}
    for i, vehicle in enumerate(s.vehicles):
        if vehicle.goal is not None and not vehicle.routes:
            yield f"vehicles.{i}.routes: needed by a vehicle with a goal where termination.after_arrival is 'continue'"
        reached, new = set(), {*vehicle.routes}
        while new:
            reached |= new
            after = {name: followers(vehicle, by_name[name], s.routes) for name in new}
            for name, sequels in after.items():
                if not sequels:
                    yield (
                        f"vehicles.{i}: termination.after_arrival is 'continue', but no route that may follow starts "
                        f"within {vehicle.goal_radius:g} m of the end of route '{name}'"
                    )
            new = {s.routes[k].name for sequels in after.values() for k in sequels} - reached


def _doubts(s: ScenarioFields, neighbours: Sequence[Sequence[int]]) -> Iterator[str]:
    """Yield where the paper's conditions for convergence are not met by construction."""
    lonely = [f"vehicle_{i + 1}" for i, targets in enumerate(neighbours) if len(targets) < 3]
    if (count := len(s.landmarks)) < 3:
        yield (
            f"only {count} landmark{'s' if count != 1 else ''}: with fewer than three the paper's Assumption 2 "
            "fails and observability is not guaranteed"
        )
    elif lonely:
        verb = "has" if len(lonely) == 1 else "have"
        yield f"{listed(lonely)} {verb} fewer than three neighbours: observability is not guaranteed"
    for landmark in s.landmarks:
        distance = float(np.linalg.norm(np.array(landmark.position) - np.array(s.map.origin)))
        if distance > FAR_FROM_ORIGIN:
            yield (
                f"landmark '{landmark.name}' lies {distance:.0f} m from the map origin: the paper's observer is "
                f"not invariant to the origin and degrades beyond {FAR_FROM_ORIGIN:.0f} m; set map.origin inside "
                "the scene"
            )
            break
