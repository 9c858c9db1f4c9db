"""Turn a scenario into the arrays and numbers of a `Model` on a device."""

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import warp as wp

from coopenv.base.errors import ScenarioError
from coopenv.base.sections import Section
from coopenv.estimation import KINDS, Outcome
from coopenv.estimation.lens import largest_radius
from coopenv.measurements.sensor import CURVATURE_TIME, averaged_std
from coopenv.motions.table import DRIVES, MOTIONS, columns_of
from coopenv.scenario import Scenario
from coopenv.scenario.bodies import Landmark, Vehicle
from coopenv.scenario.difficulty import FASTEST_PACE, PARAMETERS
from coopenv.scenario.dynamics import Dynamics
from coopenv.scenario.routes import Signal, compile_motion, even_points, followers, point_count
from coopenv.scenario.schema import agent_starts, most_boxes, neighbour_sets, processing_order
from coopenv.scenario.sensing import Camera, Faults, Noise, Rates, rotation_of
from coopenv.world.model import BLIND, DRIVEN, IDEAL, PRESCRIBED, SENSED, STATIC, Precision, entry_struct, model_struct
from coopenv.world.sensors import sensor_entries, sensor_tables
from coopenv.world.warp_internals import field_types, scalar_of

NO_SIGNAL = Signal(at=0.0, period=1.0, green=1.0)


def routes_of(scenario: Scenario) -> dict[str, Any]:
    """Return the fields of `Routes` by name."""
    origin, routes = np.array(scenario.map.origin), scenario.routes
    number = {route.name: i for i, route in enumerate(routes)}
    choices = [[number[name] for name in vehicle.routes] for vehicle in scenario.vehicles]
    places = [vehicle.goal and vehicle.goal.position for vehicle in scenario.vehicles]
    counts = [point_count(route) for route in routes]
    points = np.zeros((len(routes), max(counts, default=0), 3))
    signals = [route.signal or NO_SIGNAL for route in routes]
    for route, row in zip(routes, points, strict=True):
        row[: point_count(route)] = even_points(route) - [*origin[:2], 0.0]
    return {
        "first": np.cumsum([0, *(len(own) for own in choices)]),
        "choice": [i for own in choices for i in own],
        "goal": [np.array(place) - origin if place else np.zeros(3) for place in places],
        "points": max([*counts, 2]),
        "count": counts,
        "point": points,
        **{name: [getattr(route, name) for route in routes] for name in ("lateral_spread", "wander", "start_spread")},
        **{
            f"signal_{name}": [getattr(light, name) for light in signals] for name in ("at", "period", "start", "green")
        },
        "height": -origin[2],
    }


def drawn_of(scenario: Scenario) -> dict[str, Any]:
    """Return the fields of `DrawRanges` by name."""
    agents: list[Landmark | Vehicle] = [*scenario.landmarks, *scenario.vehicles]
    motions = [vehicle.motion for vehicle in scenario.vehicles]
    drawn, hard = scenario.randomisation, scenario.difficulty
    routes = scenario.routes
    after = scenario.termination.after_arrival
    kinds = [(v.goal_radius, v.next_routes) if after in ("continue", "transit") else None for v in scenario.vehicles]
    row = {kind: (k, scenario.vehicles[kinds.index(kind)]) for k, kind in enumerate(dict.fromkeys(kinds))}
    following: list[list[int]] = []
    for kind, (_, vehicle) in row.items():
        following += followers(vehicle, routes) if kind else [[]] * len(routes)
    ends = np.cumsum([0, *map(len, following)])
    rows = np.arange(len(row))[:, None] * len(routes) + np.arange(len(routes) + 1)
    return {
        "presence": [agent.presence for agent in agents],
        "any_driven": scenario.driven,
        "pace_spread": [agent.pace_spread for agent in agents],
        "speed_spread": [motion.initial_speed_spread if motion.kind == "driven" else 0.0 for motion in motions],
        **_groups(scenario),
        **{name: [part.factors(key)[0] for key in PARAMETERS] for name, part in (("low", drawn), ("easy", hard))},
        **{name: [part.factors(key)[1] for key in PARAMETERS] for name, part in (("high", drawn), ("hard", hard))},
        "level": scenario.difficulty.number,
        "entry": [vehicle.entry or (-1.0, -1.0) for vehicle in scenario.vehicles],
        "leaves": after in ("leave", "transit"),
        "next_row": [row[kind][0] for kind in kinds],
        "next_first": ends[rows],
        "next_choice": [i for next_ones in following for i in next_ones],
    }


def _groups(scenario: Scenario) -> dict[str, Any]:
    origin, groups = np.array(scenario.map.origin), scenario.landmark_groups
    number = {group.name: i for i, group in enumerate(groups)}
    areas = [(group, *area) for group in groups for area in group.parallelograms]
    shares = [np.cumsum(group.weights) / np.sum(group.weights) for group in groups]
    return {
        "group": [-1 if mark.group is None else number[mark.group] for mark in scenario.landmarks],
        "first_area": np.cumsum([0, *(len(group.parallelograms) for group in groups)]),
        "area_share": np.concatenate([[], *shares]),
        "area_corner": [np.array([*corner, group.height[0]]) - origin for group, corner, _, _ in areas],
        "area_first_edge": [[*edge, 0.0] for _, _, edge, _ in areas],
        "area_second_edge": [[*edge, 0.0] for _, _, _, edge in areas],
        "height": [group.height[1] - group.height[0] for group in groups],
    }


def fault_entries(f: Faults, scenario: Scenario) -> dict[str, Any]:
    """Return the values of the model's `FaultValues` that differ from entries of the section."""
    lie, wrong = f.lie, f.map_error
    return {
        "clock": f.clock_offset,
        "lie": KINDS[lie.kind],
        "lie_offset": lie.offset if lie.kind in ("jump", "collude") else 0.0,
        "lie_speed": lie.speed if lie.kind == "drift" else 0.0,
        "lie_replay": scenario.ticks_of_replay(lie.age),
        "lie_direction": _unit(lie.direction),
        "lie_std": lie.std or 0.0,
        "lie_consistent": int(lie.kind != "none" and lie.odometry == "consistent"),
        "map_error_landmark": -1 if wrong.landmark is None else scenario.target_names.index(wrong.landmark),
        "map_error_direction": _unit(wrong.direction),
        "jammer_fixed": f.jammer.position is not None,
        "jammer_position": np.array(f.jammer.position or NOWHERE) - scenario.map.origin,
    }


def _unit(direction: tuple[float, float, float] | None) -> np.ndarray:
    """Return a direction with length 1; zero for None."""
    return np.zeros(3) if direction is None else np.array(direction) / np.linalg.norm(direction)


def camera_entries(c: Camera, noise: Noise, rates: Rates) -> dict[str, Any]:
    """Return the values of the model's `CameraValues` that differ from the camera's own."""
    on = float(noise.enabled)
    return {
        "rotation": c.to_body(),
        "absent": c.model == "none",
        "pinhole": c.model == "pinhole",
        **dict(zip(("k1", "k2", "p1", "p2", "k3"), c.distortion, strict=True)),
        "max_radius": largest_radius(c.distortion),
        "orientation_std": on * c.extrinsics_error,
        "position_std": on * c.extrinsics_position_error,
        "focal_std": on * c.focal_length_error,
        "changes": c.latency > 0.0 or (noise.enabled and (c.is_late or c.extrinsics_walk > 0.0)),
        "orientation_walk": on * c.extrinsics_walk,
        "latency_std": on * c.latency_error,
        "latency_jitter": on * c.latency_jitter,
        "latency_ticks": round(c.latency / (1.0 / rates.camera)),
        "uncertain": noise.enabled and (c.is_late or c.extrinsics_walk > 0.0 or noise.bearing.correlated.std > 0.0),
    }


def noise_entries(n: Noise, rates: Rates) -> dict[str, Any]:
    """Return the values of the model's `NoiseValues` that differ from entries of the section."""
    on = float(n.enabled)
    axis = np.array(n.bearing.axis) / np.linalg.norm(n.bearing.axis)
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    if abs(axis[2]) > 1 - 1e-12:
        first = np.array([1.0, 0.0, 0.0])
    first = first / np.linalg.norm(first)
    correlated, time = np.array(on * n.bearing.correlated.std), n.bearing.correlated.time
    return {
        "velocity": on * _at_rate(n.velocity, n.odometry_rate, rates.odometry),
        "angular_velocity": on * _at_rate(n.angular_velocity, n.odometry_rate, rates.odometry),
        "bearing_paper": n.bearing.model == "paper",
        "bearing": on * _at_rate(n.bearing.scale, n.bearing.rate, rates.camera),
        "bearing_correlated": correlated,
        "bearing_correlation_time": time,
        "bearing_counted": averaged_std(np.zeros(()), correlated, time, 1.0 / rates.camera),
        "frames_together": max(CURVATURE_TIME * rates.camera, 1.0),
        "axis": np.column_stack([first, np.cross(axis, first), axis]),
        "lasting": n.enabled and n.lasts,
        "odometry_scale": on * n.odometry_scale,
        "odometry_scale_walk": on * n.odometry_scale_walk,
        "gyro_bias": on * np.broadcast_to(n.gyro_bias, 3),
        "gyro_bias_walk": on * np.broadcast_to(n.gyro_bias_walk, 3),
        "slip_rate": on * n.slip.rate,
    }


def _at_rate(std: float, stated: float | str, actual: float) -> float:
    """Return the standard deviation per sample that keeps the density std^2 / stated rate."""
    return std if isinstance(stated, str) else std * float(np.sqrt(actual / stated))


GRAMIAN_RATE = 20.0
"""Sampling rate (Hz) of the sliding Gramian, which measures the view of the scene over a second."""

GRAMIAN_BLOCKS = 10  # blocks of the sliding window of the observability Gramian; it moves on by one block

MOST_FILLED = 5_000_000  # pairs of buildings and cells of the grid

MOST_IN_ONE_CELL = 12
"""Bodies, or buildings, of a scene in which all pairs are tested. Sensing of a vehicle takes 0.71 us so, and 0.84 us in
a grid, with 8 items; 1.42 and 1.28 us with 16; 3.16 and 2.13 us with 32 (half of them vehicles, 12 m apart)."""
CELLS_PER_RANGE, LONGEST_CELL = 3.0, 60.0
"""Cells of the grid within the shortest range of a camera; the range that counts where all are unlimited, m. With 1, 2,
3, 4 and 6 cells sensing takes 9.2, 7.4, 6.5, 7.2 and 10.9 us for each of 1,024 vehicles that are 12 m apart."""
WIDER = 1.01  # factor of a building's extent, against rounding in the kernels

NOWHERE = (0.0, 0.0, 0.0)


def build_model(scenario: Scenario, p: Precision, device: str) -> Any:
    """Return the Warp `Model` of a scenario."""
    model = model_struct(p)()
    limits, cameras, noises, faults = scenario.limits, scenario.cameras, scenario.noises, scenario.all_faults
    traffic = [v.motion.kind == "traffic" and scenario.cosimulator is None for v in scenario.vehicles]
    _fill(model, device, _world(scenario))
    _fill(model.start, device, _start(scenario))
    _fill(model.motion, device, _motion(scenario))
    _fill(model.scene, device, _scene(scenario))
    _fill(model.cells, device, _cells(scenario))
    _fill(model.routes, device, routes_of(scenario))
    _fill(model.drawn, device, drawn_of(scenario))
    _fill(model.radio, device, _radio(scenario), scenario.v2x)
    _fill(model.observer, device, _observer(scenario), scenario.observer)
    _fill(model.judgement, device, {}, scenario.reward)
    of_vehicles: dict[str, tuple[list[Any], Callable[[int], dict[str, Any]]]] = {
        "dynamics": (limits, lambda i: _dynamics(limits[i], scenario, traffic[i])),
        "camera": (cameras, lambda i: camera_entries(cameras[i], noises[i], scenario.rates)),
        "noise": (noises, lambda i: noise_entries(noises[i], scenario.rates)),
        "fault": (faults, lambda i: fault_entries(faults[i], scenario)),
    }
    for name, (sections, values) in of_vehicles.items():
        kind, made = entry_struct(p, name), {}
        keys = [(id(section), id(noise), own) for section, noise, own in zip(sections, noises, traffic, strict=True)]
        for i, key in enumerate(keys):  # vehicles share the sections of the scenario
            if key not in made:
                made[key] = kind()
                _fill(made[key], device, values(i), sections[i])
        setattr(model, name, wp.array([made[key] for key in keys], dtype=kind, device=device))
    sensors = [entry_struct(p, "sensor")() for _ in scenario.sensors]
    for made, section in zip(sensors, scenario.sensors, strict=True):
        _fill(made, device, sensor_entries(section, scenario))
    _fill(model, device, sensor_tables(scenario))
    model.sensor = wp.array(sensors, dtype=entry_struct(p, "sensor"), device=device)
    return model


def _fill(struct: Any, device: str, values: Mapping[str, Any], section: Any = None) -> None:
    """Write fields of a struct in their types: the values, and entries of the same names of a scenario's section.

    An entry of a table in the section has the names of both, such as `jammer_period`. A missing limit (None) is
    infinite.
    """
    entries = dict(section or ())
    tables = {name: table for name, table in entries.items() if isinstance(table, Section)}
    entries |= {f"{name}_{key}": value for name, table in tables.items() for key, value in table}
    entries |= values
    for name, kind in field_types(struct).items():
        if name not in entries:
            continue
        value = math.inf if entries[name] is None else entries[name]
        if isinstance(kind, wp.array):
            scalar = scalar_of(kind.dtype)
            data = np.ascontiguousarray(value, dtype=wp.dtype_to_numpy(scalar))
            empty = wp.zeros((0,) * kind.ndim, dtype=kind.dtype, device=device)
            value = wp.array(data, dtype=kind.dtype, ndim=kind.ndim, device=device) if data.size else empty
        elif hasattr(kind, "_shape_"):
            value = kind(*np.ravel(value).tolist())
        setattr(struct, name, int(value) if kind is wp.int32 else value)


def _world(scenario: Scenario) -> dict[str, Any]:
    rates, vehicles, faults = scenario.rates, len(scenario.vehicles), scenario.all_faults
    agents = len(scenario.landmarks) + vehicles
    sets = [] if scenario.keeps_those_in_range else neighbour_sets(scenario)
    order = processing_order(scenario, sets) or list(range(vehicles))
    kept = scenario.topology.most_nearby or 0
    everyone: list[Landmark | Vehicle] = [*scenario.landmarks, *scenario.vehicles]
    return {
        "landmarks": len(scenario.landmarks),
        "vehicles": vehicles,
        "agents": agents,
        "obstacles": len(scenario.obstacles),
        "traffic": most_boxes(scenario),
        "sensed": scenario.topology.mode == "sensed",
        "sensing": {"ideal": IDEAL, "blind": BLIND}.get(scenario.sensing, SENSED),
        "camera_rate": rates.camera,
        "odometry_rate": rates.odometry,
        "camera_period": 1.0 / rates.camera,
        "odometry_period": 1.0 / rates.odometry,
        "samples_per_tick": math.ceil(rates.odometry / rates.camera - 1e-9) + 1,
        "ticks_per_decision": scenario.ticks_per_decision,
        "action_size": scenario.action_size,
        "columns": scenario.columns,
        "pans": scenario.action.pan is not None,
        "horizon_ticks": scenario.horizon_ticks,
        "kept": kept,
        "listed": len(sets) > 0,
        "before_boxes": 0 if kept else len(scenario.landmarks),
        "acyclic": scenario.topology.acyclic,
        "marker_reach": max(math.hypot(*agent.marker) for agent in everyone),
        "last_outcome": max(Outcome) + len(scenario.termination.own),
        "map_size": scenario.observation.map_size,
        "route_step": scenario.observation.route_step,
        "targets": [targets + [-1] * ((kept or agents) - len(targets)) for targets in sets],
        "target_count": [len(targets) for targets in sets],
        "order": order,
        "rank": np.argsort(order),
        "landmark_std": scenario.landmark_std or np.zeros(len(scenario.landmarks)),
        "clocks": any(f.clock_offset > 0.0 for f in faults),
        "restarts": any(f.restart.chance > 0.0 for f in faults),
        "alters": any(f.alters for f in faults),
        "map_errors": len(scenario.landmark_std) > 0 or any(f.map_error.chance > 0.0 for f in faults),
        "past": _kept_ticks(scenario),
        "correlated": any(n.enabled and n.bearing.correlated.std > 0.0 for n in scenario.noises),
        "jammers": any(f.jammer.chance > 0.0 for f in faults),
    }


FARTHEST_DRAW = 5.0  # standard deviations, which one frame in two millions exceeds


def _kept_ticks(scenario: Scenario) -> int:
    """Return the number of ticks of which the poses of all agents are kept for frames that show the past."""
    late = [camera for camera in scenario.cameras if camera.is_late]
    ages = [c.latency + FARTHEST_DRAW * math.hypot(c.latency_error, c.latency_jitter) for c in late]
    return 1 + math.ceil(max(ages) * scenario.rates.camera) if ages else 0


def _start(scenario: Scenario) -> dict[str, Any]:
    positions, rotations = agent_starts(scenario)
    origin = np.array(scenario.map.origin)
    poses = [*(None for _ in scenario.landmarks), *(vehicle.initial_pose for vehicle in scenario.vehicles)]
    motions = [vehicle.motion for vehicle in scenario.vehicles]
    estimates = [vehicle.initial_estimate for vehicle in scenario.vehicles]
    initial = [NOWHERE if e.position is None else np.array(e.position) - origin for e in estimates]
    fixed = [e.yaw is not None or e.quaternion_wxyz is not None for e in estimates]
    turned = [rotation_of(e.yaw, e.quaternion_wxyz) for e in estimates]
    offsets = [rotation_of(None, e.orientation_offset_wxyz) for e in estimates]
    angles = [e.orientation_angle for e in estimates]
    return {
        "position": positions,
        "rotation": rotations,
        "position_spread": [
            *(mark.position_spread for mark in scenario.landmarks),
            *(
                vehicle.initial_pose.position_spread if vehicle.initial_pose else NOWHERE
                for vehicle in scenario.vehicles
            ),
        ],
        "yaw_spread": [pose.yaw_spread if pose else 0.0 for pose in poses],
        "speed": [motion.initial_speed if motion.kind == "driven" else 0.0 for motion in motions],
        "estimate_fixed": [e.position is not None for e in estimates],
        "estimate_position": [np.add(p, e.position_offset) for p, e in zip(initial, estimates, strict=True)],
        "estimate_radius": [e.position_radius for e in estimates],
        "orientation_fixed": fixed,
        "estimate_rotation": [(R if f else np.eye(3)) @ o for R, f, o in zip(turned, fixed, offsets, strict=True)],
        "orientation_angle": [-1.0 if angle == "uniform" else angle for angle in angles],
    }


def _motion(scenario: Scenario) -> dict[str, Any]:
    _, rotations = agent_starts(scenario)
    everyone: list[Landmark | Vehicle] = [*scenario.landmarks, *scenario.vehicles]
    motions = [agent.motion for agent in everyone]
    until = (scenario.horizon + 1.0 / scenario.rates.camera) * (2.0 * FASTEST_PACE if scenario.paced else 1.0)
    tables = [compile_motion(motion, R, until) for motion, R in zip(motions, rotations, strict=True)]
    kinds = {"static": STATIC, "driven": DRIVEN, "traffic": DRIVEN}
    columns = ("start", "linear", "angular", "rotation", "position")
    return {
        "kind": [kinds.get(motion.kind, PRESCRIBED) for motion in motions],
        "first": np.cumsum([0] + [len(table.start) for table in tables]),
        **{name: np.concatenate([getattr(table, name) for table in tables]) for name in columns},
    }


def _dynamics(d: Dynamics, scenario: Scenario, traffic: bool) -> dict[str, Any]:
    accelerates, pan = scenario.action.longitudinal == "acceleration", scenario.action.pan
    kind = d.model if d.model in DRIVES else DRIVES[0]  # a drive of the user's own is moved on the host
    change, lag = (getattr(d, key) for key in MOTIONS[kind].turning)
    speed, turn, *others = columns_of(d)
    return {
        "kind": DRIVES.index(kind),
        "min_speed": speed.low,
        "max_speed": speed.high,
        "steers": turn.unit == "rad",
        "max_turn": turn.high,
        "max_turn_change": change,
        "turn_time_constant": lag,
        "max_lateral_speed": others[0].high if others else 0.0,
        "speed_time_constant": 0.0 if accelerates or traffic else d.speed_time_constant,  # an acceleration acts at once
        "in_traffic": traffic,
        "latency_ticks": round(d.latency * scenario.rates.camera),
        "acceleration_mode": accelerates,
        "action_turn": scenario.action.at_one(turn),
        "pan_limit": pan.limit if pan else 0.0,
        "pan_rate": pan.rate if pan else 0.0,
    }


def _scene(scenario: Scenario) -> dict[str, Any]:
    origin = np.array(scenario.map.origin)
    everyone: list[Landmark | Vehicle] = [*scenario.landmarks, *scenario.vehicles]
    bodies = [agent.body for agent in everyone]
    return {
        "body_half": [np.array(body.size) / 2 if body else NOWHERE for body in bodies],
        "body_center": [body.center if body else NOWHERE for body in bodies],
        "marker": [agent.marker for agent in everyone],
        "anchor": [*(mark.anchor for mark in scenario.landmarks), *(False for _ in scenario.vehicles)],
        "obstacle_rotation": [rotation_of(obstacle.yaw, None) for obstacle in scenario.obstacles],
        "obstacle_center": [np.array(obstacle.center) - origin for obstacle in scenario.obstacles],
        "obstacle_half": [np.array(obstacle.size) / 2 for obstacle in scenario.obstacles],
        "goal_radius": [vehicle.goal_radius for vehicle in scenario.vehicles],
        "end_on_collision": scenario.termination.collision,
        "end_on_arrival": scenario.termination.arrival,
        "off_route": scenario.termination.off_route or 0.0,
    }


def _cells(scenario: Scenario) -> dict[str, Any]:
    """Return the grid of the world; it has about as many cells as bodies.

    Raises:
        ScenarioError: buildings are in too many cells.
    """
    origin, obstacles = np.array(scenario.map.origin), scenario.obstacles
    everyone: list[Landmark | Vehicle] = [*scenario.landmarks, *scenario.vehicles]
    reaches = [math.hypot(*agent.body.center) + math.hypot(*agent.body.size) / 2 for agent in everyone if agent.body]
    items = max(len(everyone) + most_boxes(scenario), len(obstacles))
    across = 1 if items <= MOST_IN_ONE_CELL else 1 << math.ceil(math.log2(items) / 2)
    ranges = [camera.range for camera in scenario.cameras if camera.range is not None]
    edge = min(ranges, default=LONGEST_CELL) / CELLS_PER_RANGE
    cells, filled = [list[int]() for _ in range(across * across)], 0
    for k, obstacle in enumerate(obstacles):
        reach = np.abs(rotation_of(obstacle.yaw, None)) @ np.array(obstacle.size) / 2 * WIDER
        spans = np.floor((obstacle.center - origin + np.outer((-1, 1), reach))[:, :2] / edge).astype(int).T
        columns, rows = (np.unique(np.arange(a, min(b, a + across - 1) + 1) % across) for a, b in spans)
        filled += len(rows) * len(columns)
        if filled > MOST_FILLED:
            raise ScenarioError(f"obstacles: to number {k} the buildings fill over {MOST_FILLED:,} cells of the grid")
        for cell in (rows[:, None] * across + columns).ravel():
            cells[cell].append(k)
    return {
        "across": across,
        "per_metre": 1.0 / edge,
        "body_reach": max(reaches, default=0.0),
        "first_building": np.cumsum([0, *map(len, cells)]),
        "building": [k for cell in cells for k in cell],
    }


def _radio(scenario: Scenario) -> dict[str, Any]:
    return {
        "connected": [vehicle.connected for vehicle in scenario.vehicles],
        "entry": scenario.columns + (scenario.action.pan is not None) if scenario.action.radio else 0,
        "to_all": scenario.v2x.links == "all",
        "slots": max(scenario.v2x.delay, 1) + 1 + scenario.replay_ticks,
    }


def _observer(scenario: Scenario) -> dict[str, Any]:
    o, camera = scenario.observer, scenario.rates.camera
    stride = max(1, round(camera / GRAMIAN_RATE))
    block = round(o.gramian_window * camera / GRAMIAN_BLOCKS / stride)
    return {
        "k": o.k if isinstance(o.k, tuple) else [o.k] * len(scenario.vehicles),
        "q": [o.q.get(name, 10.0) if isinstance(o.q, dict) else o.q for name in scenario.target_names],
        **dict(zip(("v1", "v2", "p1", "p2"), (*o.V, *o.P0), strict=True)),
        "rate": min(scenario.rates.observer or camera, camera),
        "gramian_stride": stride,
        "block_ticks": stride * max(1, block),
        "block_distance": (o.gramian_distance or 0.0) / GRAMIAN_BLOCKS,
        "blocks": GRAMIAN_BLOCKS,
    }
