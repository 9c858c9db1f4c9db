"""Turn a scenario into the arrays and numbers of a `Model` on a device."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import warp as wp

from coopenv.estimation.outcomes import Outcome
from coopenv.scenario import Scenario
from coopenv.scenario.base import rotation_of
from coopenv.scenario.bodies import Landmark, Vehicle
from coopenv.scenario.learning import FASTEST_PACE, Dynamics
from coopenv.scenario.routes import compile_motion
from coopenv.scenario.starts import agent_starts, neighbour_sets, processing_order
from coopenv.world.build_draws import drawn_of, routes_of
from coopenv.world.build_faults import fault_entries, fault_switches
from coopenv.world.build_sensors import camera_entries, noise_entries
from coopenv.world.model import BLIND, DRIVEN, IDEAL, PRESCRIBED, SENSED, STATIC, entry_struct, model_struct
from coopenv.world.precision import Precision

GRAMIAN_RATE = 20.0
"""Hz at which the sliding Gramian is sampled: it says how the scene is seen over a second, not within a frame."""

GRAMIAN_BLOCKS = 10  # blocks of the sliding window of the observability Gramian; it moves on by one block

NOWHERE = (0.0, 0.0, 0.0)


def build_model(scenario: Scenario, p: Precision, device: str) -> Any:
    """Return the Warp `Model` of a scenario."""
    model = model_struct(p)()
    _fill(model, _world(scenario), device)
    _fill(model.start, _start(scenario), device)
    _fill(model.motion, _motion(scenario), device)
    model.dynamics = _structs(p, "dynamics", [_dynamics(d, scenario) for d in scenario.limits], device)
    _fill(model.scene, _scene(scenario), device)
    _fill(model.routes, routes_of(scenario), device)
    _fill(model.drawn, drawn_of(scenario), device)
    sensors = zip(scenario.cameras, scenario.noises, strict=True)
    model.camera = _structs(p, "camera", [camera_entries(camera, noise) for camera, noise in sensors], device)
    model.noise = _structs(p, "noise", [noise_entries(n, scenario.rates) for n in scenario.noises], device)
    model.fault = _structs(p, "fault", [fault_entries(f, scenario) for f in scenario.all_faults], device)
    _fill(model, fault_switches(scenario), device)
    _fill(model.radio, _radio(scenario), device)
    _fill(model.observer, _observer(scenario), device)
    _fill(model.judgement, _judgement(scenario), device)
    return model


def _fill(struct: Any, values: Mapping[str, Any], device: str) -> None:
    """Write fields of a struct, each in the type that it is declared with."""
    for name, value in values.items():
        kind = struct._cls.vars[name].type
        if isinstance(kind, wp.array):
            scalar = getattr(kind.dtype, "_wp_scalar_type_", kind.dtype)
            data = np.ascontiguousarray(value, dtype=wp.dtype_to_numpy(scalar))
            empty = wp.zeros((0,) * kind.ndim, dtype=kind.dtype, device=device)
            value = wp.array(data, dtype=kind.dtype, ndim=kind.ndim, device=device) if data.size else empty
        elif hasattr(kind, "_shape_"):
            value = kind(*np.ravel(value).tolist())
        setattr(struct, name, value)


def _structs(p: Precision, name: str, rows: Sequence[Mapping[str, Any]], device: str) -> Any:
    """Return one of the model's arrays of structs, filled."""
    kind = entry_struct(p, name)
    entries = [kind() for _ in rows]
    for entry, values in zip(entries, rows, strict=True):
        _fill(entry, values, device)
    return wp.array(entries, dtype=kind, device=device)


def _world(scenario: Scenario) -> dict[str, Any]:
    rates, vehicles = scenario.rates, len(scenario.vehicles)
    agents = len(scenario.landmarks) + vehicles
    sets = neighbour_sets(scenario)
    order = processing_order(scenario, sets)
    return {
        "landmarks": len(scenario.landmarks),
        "vehicles": vehicles,
        "agents": agents,
        "obstacles": len(scenario.obstacles),
        "traffic": scenario.highway.most_vehicles if scenario.highway else 0,
        "sensed": int(scenario.topology.mode == "sensed"),
        "sensing": {"sensed": SENSED, "ideal": IDEAL, "blind": BLIND}[scenario.sensing],
        "camera_rate": rates.camera,
        "odometry_rate": rates.odometry,
        "camera_period": 1.0 / rates.camera,
        "odometry_period": 1.0 / rates.odometry,
        "samples_per_tick": math.ceil(rates.odometry / rates.camera - 1e-9) + 1,
        "ticks_per_decision": scenario.ticks_per_decision,
        "action_size": scenario.action.size,
        "horizon_ticks": scenario.horizon_ticks,
        "last_outcome": max(Outcome) + len(scenario.termination.own),
        "map_size": scenario.observation.map_size,
        "route_step": scenario.observation.route_step,
        "targets": [targets + [-1] * (agents - len(targets)) for targets in sets],
        "target_count": [len(targets) for targets in sets],
        "order": order,
        "rank": np.argsort(order),
    }


def _start(scenario: Scenario) -> dict[str, Any]:
    positions, rotations = agent_starts(scenario)
    origin = np.array(scenario.map.origin)
    poses = [*(None for _ in scenario.landmarks), *(vehicle.initial_pose for vehicle in scenario.vehicles)]
    motions = [vehicle.motion for vehicle in scenario.vehicles]
    estimates = [vehicle.initial_estimate for vehicle in scenario.vehicles]
    believed = [NOWHERE if e.position is None else np.array(e.position) - origin for e in estimates]
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
        "estimate_position": [np.add(p, e.position_offset) for p, e in zip(believed, estimates, strict=True)],
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


def _dynamics(d: Dynamics, scenario: Scenario) -> dict[str, Any]:
    accelerates, pan = scenario.action.longitudinal == "acceleration", scenario.action.pan
    same = ("wheelbase", "max_speed", "max_acceleration", "max_steering", "max_steering_rate", "dead_band")
    return {
        **{name: getattr(d, name) for name in same},
        "min_speed": -d.max_speed if d.reverse else 0.0,
        "speed_lag": 0.0 if accelerates else d.speed_time_constant,  # an acceleration acts at once
        "steering_lag": d.steering_time_constant,
        "gated": int(d.gated),
        "latency_ticks": round(d.latency * scenario.rates.camera),
        "acceleration_mode": int(accelerates),
        "action_steering": scenario.action.steering or d.max_steering,
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
        "obstacle_rotation": [rotation_of(obstacle.yaw, None) for obstacle in scenario.obstacles],
        "obstacle_center": [np.array(obstacle.center) - origin for obstacle in scenario.obstacles],
        "obstacle_half": [np.array(obstacle.size) / 2 for obstacle in scenario.obstacles],
        "goal_radius": [vehicle.goal_radius for vehicle in scenario.vehicles],
        "end_on_collision": int(scenario.termination.collision),
        "end_on_arrival": int(scenario.termination.arrival),
        "off_route": scenario.termination.off_route or 0.0,
    }


def _radio(scenario: Scenario) -> dict[str, Any]:
    v = scenario.v2x
    return {
        **{name: getattr(v, name) for name in ("delay", "period", "loss")},
        "slots": max(v.delay, 1) + 1 + scenario.replay_ticks,
        "range": math.inf if v.range is None else v.range,
        "staleness": math.inf if v.staleness is None else v.staleness,
    }


def _observer(scenario: Scenario) -> dict[str, Any]:
    o, camera = scenario.observer, scenario.rates.camera
    stride = max(1, round(camera / GRAMIAN_RATE))
    block = round(o.gramian_window * camera / GRAMIAN_BLOCKS / stride)
    return {
        "k": o.k if isinstance(o.k, tuple) else [o.k] * len(scenario.vehicles),
        "q": [o.q.get(name, 10.0) if isinstance(o.q, dict) else o.q for name in scenario.target_names],
        **dict(zip(("v1", "v2", "p1", "p2"), (*o.V, *o.P0), strict=True)),
        "max_turn": o.max_turn,
        "rate": min(scenario.rates.observer or camera, camera),
        "gramian_stride": stride,
        "block_ticks": stride * max(1, block),
        "block_way": (o.gramian_distance or 0.0) / GRAMIAN_BLOCKS,
        "blocks": GRAMIAN_BLOCKS,
    }


def _judgement(scenario: Scenario) -> dict[str, Any]:
    names = ("uncertainty_threshold", "uncertainty_cap", "observability_floor", "observability_level")
    return {name: getattr(scenario.reward, name) for name in names}
