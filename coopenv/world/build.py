"""Turn a scenario into the arrays and numbers of a `Model` on a device."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from coopenv.estimation.trajectory import Outcome
from coopenv.scenario import Scenario
from coopenv.scenario.bodies import Body, Landmark, Vehicle
from coopenv.scenario.motion import TwistTable, compile_motion
from coopenv.scenario.sensing import ROTATION_OF_CAMERA
from coopenv.scenario.starts import agent_starts, rotation_of
from coopenv.scenario.topology import neighbour_sets, processing_order
from coopenv.world.model import DRIVEN, PRESCRIBED, STATIC, model_struct
from coopenv.world.precision import Precision

NUMPY_OF = {wp.int32: np.int32, wp.float64: np.float64}

GRAMIAN_RATE = 20.0
"""Hz at which the sliding Gramian is sampled: it says how the scene is seen over a second, not within a frame."""

GRAMIAN_BLOCKS = 10
"""Blocks of the sliding window of the observability Gramian; it moves on by one block."""


class _Filler:
    """Writes a struct's fields in the right dtype on a device."""

    def __init__(self, p: Precision, device: str) -> None:
        self.p, self.device = p, device

    def array(self, values: Any, dtype: Any) -> Any:
        data = np.ascontiguousarray(values, dtype=NUMPY_OF.get(dtype, self.p.numpy))
        shape = getattr(dtype, "_shape_", ())
        if data.size == 0:
            return wp.zeros(0, dtype=dtype, device=self.device)
        return wp.array(data.reshape((-1, *shape)), dtype=dtype, device=self.device)


def build_model(scenario: Scenario, p: Precision, device: str) -> Any:
    """Return the Warp `Model` of a scenario."""
    fill = _Filler(p, device)
    model = model_struct(p)()
    model.landmarks = len(scenario.landmarks)
    model.vehicles = len(scenario.vehicles)
    model.agents = model.landmarks + model.vehicles
    model.obstacles = len(scenario.obstacles)
    model.sensed = int(scenario.topology.mode == "sensed")
    model.camera_rate = scenario.rates.camera
    model.odometry_rate = scenario.rates.odometry
    model.camera_period = 1.0 / scenario.rates.camera
    model.odometry_period = 1.0 / scenario.rates.odometry
    model.samples_per_tick = math.ceil(scenario.rates.odometry / scenario.rates.camera - 1e-9) + 1
    model.ticks_per_decision = scenario.ticks_per_decision
    model.horizon_ticks = scenario.horizon_ticks
    model.last_outcome = max(Outcome) + len(scenario.termination.own)
    _fill_topology(model, scenario, fill)
    _fill_start(model.start, scenario, fill)
    _fill_motion(model.motion, scenario, fill)
    _fill_dynamics(model.dynamics, scenario)
    _fill_scene(model.scene, scenario, fill)
    _fill_camera(model.camera, scenario, p)
    _fill_noise(model.noise, scenario, p)
    _fill_radio(model.radio, scenario)
    _fill_observer(model.observer, scenario, fill)
    return model


def _fill_topology(model: Any, scenario: Scenario, fill: _Filler) -> None:
    sets = neighbour_sets(scenario)
    table = np.full((model.vehicles, model.agents), -1, dtype=np.int32)
    for i, targets in enumerate(sets):
        table[i, : len(targets)] = targets
    order = processing_order(scenario, sets)
    model.targets = wp.array(table, dtype=wp.int32, ndim=2, device=fill.device)
    model.target_count = fill.array([len(targets) for targets in sets], wp.int32)
    model.order = fill.array(order, wp.int32)
    model.rank = fill.array(np.argsort(order), wp.int32)


def _fill_start(start: Any, scenario: Scenario, fill: _Filler) -> None:
    p = fill.p
    landmarks = len(scenario.landmarks)
    positions, rotations = agent_starts(scenario)
    poses = [vehicle.initial_pose for vehicle in scenario.vehicles]
    spread = [pose.position_spread if pose else (0.0, 0.0, 0.0) for pose in poses]
    start.position = fill.array(positions, p.vec3)
    start.rotation = fill.array(rotations, p.mat33)
    start.position_spread = fill.array([(0.0, 0.0, 0.0)] * landmarks + spread, p.vec3)
    start.yaw_spread = fill.array([0.0] * landmarks + [pose.yaw_spread if pose else 0.0 for pose in poses], p.scalar)
    motions = [vehicle.motion for vehicle in scenario.vehicles]
    start.speed = fill.array([m.initial_speed if m.kind == "driven" else 0.0 for m in motions], p.scalar)
    origin = np.array(scenario.map.origin)
    estimates = [vehicle.initial_estimate for vehicle in scenario.vehicles]
    offsets = [np.array(e.position_offset) for e in estimates]
    start.estimate_fixed = fill.array([int(e.position is not None) for e in estimates], wp.int32)
    start.estimate_position = fill.array(
        [
            o if e.position is None else np.array(e.position) - origin + o
            for e, o in zip(estimates, offsets, strict=True)
        ],
        p.vec3,
    )
    start.estimate_radius = fill.array([e.position_radius for e in estimates], p.scalar)
    fixed = [e.yaw is not None or e.quaternion_wxyz is not None for e in estimates]
    start.orientation_fixed = fill.array(np.array(fixed, dtype=int), wp.int32)
    offset = [Rotation.from_quat(e.orientation_offset_wxyz, scalar_first=True).as_matrix() for e in estimates]
    start.estimate_rotation = fill.array(
        [
            (rotation_of(e.yaw, e.quaternion_wxyz) if f else np.eye(3)) @ o
            for e, f, o in zip(estimates, fixed, offset, strict=True)
        ],
        p.mat33,
    )
    start.orientation_angle = fill.array(
        [-1.0 if e.orientation_angle == "uniform" else float(e.orientation_angle) for e in estimates], p.scalar
    )


def _fill_motion(motion: Any, scenario: Scenario, fill: _Filler) -> None:
    p = fill.p
    _, rotations = agent_starts(scenario)
    motions = [a.motion for a in scenario.landmarks] + [v.motion for v in scenario.vehicles]
    until = scenario.horizon + 1.0 / scenario.rates.camera
    tables: list[TwistTable] = [compile_motion(m, R, until) for m, R in zip(motions, rotations, strict=True)]
    kinds = {"static": STATIC, "driven": DRIVEN}
    motion.kind = fill.array([kinds.get(m.kind, PRESCRIBED) for m in motions], wp.int32)
    motion.first = fill.array(np.cumsum([0] + [len(t.start) for t in tables]), wp.int32)
    motion.start = fill.array(np.concatenate([t.start for t in tables]), wp.float64)
    motion.linear = fill.array(np.concatenate([t.linear for t in tables]), p.vec3)
    motion.angular = fill.array(np.concatenate([t.angular for t in tables]), p.vec3)
    motion.rotation = fill.array(np.concatenate([t.rotation for t in tables]), p.mat33)
    motion.position = fill.array(np.concatenate([t.position for t in tables]), p.vec3)


def _fill_dynamics(dynamics: Any, scenario: Scenario) -> None:
    d = scenario.dynamics
    dynamics.wheelbase = d.wheelbase
    dynamics.max_speed = d.max_speed
    dynamics.min_speed = -d.max_speed if d.reverse else 0.0
    dynamics.max_acceleration = d.max_acceleration
    dynamics.max_steering = d.max_steering
    dynamics.max_steering_rate = d.max_steering_rate
    accelerates = scenario.action.longitudinal == "acceleration"
    dynamics.speed_lag = 0.0 if accelerates else d.speed_time_constant  # an acceleration acts at once
    dynamics.steering_lag = d.steering_time_constant
    dynamics.latency_ticks = round(d.latency * scenario.rates.camera)
    dynamics.acceleration_mode = int(accelerates)
    dynamics.action_steering = scenario.action.steering or d.max_steering


def _half(body: Body | None) -> np.ndarray:
    return np.array(body.size) / 2 if body else np.zeros(3)


def _fill_scene(scene: Any, scenario: Scenario, fill: _Filler) -> None:
    p = fill.p
    origin = np.array(scenario.map.origin)
    everyone: list[Landmark | Vehicle] = [*scenario.landmarks, *scenario.vehicles]
    scene.body_half = fill.array([_half(a.body) for a in everyone], p.vec3)
    scene.body_center = fill.array([a.body.center if a.body else (0.0, 0.0, 0.0) for a in everyone], p.vec3)
    scene.marker = fill.array([a.marker for a in everyone], p.vec3)
    yaws = [Rotation.from_euler("z", o.yaw).as_matrix() for o in scenario.obstacles]
    scene.obstacle_rotation = fill.array(yaws, p.mat33)
    scene.obstacle_center = fill.array([np.array(o.center) - origin for o in scenario.obstacles], p.vec3)
    scene.obstacle_half = fill.array([np.array(o.size) / 2 for o in scenario.obstacles], p.vec3)
    goals = [v.goal for v in scenario.vehicles]
    scene.goal = fill.array([np.array(g.position) - origin if g else np.zeros(3) for g in goals], p.vec3)
    scene.goal_radius = fill.array([g.radius if g else 0.0 for g in goals], p.scalar)
    scene.end_on_collision = int(scenario.termination.collision)
    scene.end_on_arrival = int(scenario.termination.arrival)


def _monotone_radius(k: tuple[float, ...]) -> float:
    """Return the radius up to which r (1 + k1 r^2 + k2 r^4 + k3 r^6) grows: farther rays would fold back."""
    k1, k2, _, _, k3 = k
    roots = np.roots([7 * k3, 0, 5 * k2, 0, 3 * k1, 0, 1.0]) if any((k1, k2, k3)) else np.array([])
    real = roots[np.abs(roots.imag) < 1e-9].real
    positive = real[real > 0]
    return float(positive.min()) if positive.size else float(np.inf)


def _fill_camera(camera: Any, scenario: Scenario, p: Precision) -> None:
    c = scenario.camera
    if isinstance(c.orientation, str):
        rotation = ROTATION_OF_CAMERA[c.orientation]
    else:
        rotation = rotation_of(None, c.orientation)
    camera.rotation = p.mat33(*rotation.ravel().tolist())
    camera.position = p.vec3(*c.position)
    camera.pinhole = int(c.model == "pinhole")
    camera.image_size = p.vec2(*c.image_size)
    camera.focal_length = p.vec2(*c.focal_length)
    camera.principal_point = p.vec2(*c.principal_point)
    camera.k1, camera.k2, camera.p1, camera.p2, camera.k3 = c.distortion
    camera.max_radius = _monotone_radius(c.distortion)
    camera.undistort = int(c.undistort)
    camera.quantise = int(c.quantise)
    camera.range = c.range if c.range is not None else float("inf")
    camera.miss = c.miss_probability


def _at_rate(std: float, stated: float | str, actual: float) -> float:
    """Return the standard deviation per sample that keeps the density std^2 / stated rate."""
    return std if isinstance(stated, str) else std * float(np.sqrt(actual / stated))


def _fill_noise(noise: Any, scenario: Scenario, p: Precision) -> None:
    n, rates = scenario.noise, scenario.rates
    on = float(n.enabled)
    noise.velocity = on * _at_rate(n.velocity, n.odometry_rate, rates.odometry)
    noise.angular_velocity = on * _at_rate(n.angular_velocity, n.odometry_rate, rates.odometry)
    noise.bearing_paper = int(n.bearing.model == "paper")
    noise.bearing = on * _at_rate(n.bearing.scale, n.bearing.rate, rates.camera)
    axis = np.array(n.bearing.axis) / np.linalg.norm(n.bearing.axis)
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    if abs(axis[2]) > 1 - 1e-12:
        first = np.array([1.0, 0.0, 0.0])
    first = first / np.linalg.norm(first)
    frame = np.column_stack([first, np.cross(axis, first), axis])
    noise.axis = p.mat33(*frame.ravel().tolist())


def _fill_radio(radio: Any, scenario: Scenario) -> None:
    v = scenario.v2x
    radio.delay = v.delay
    radio.period = v.period
    radio.slots = max(v.delay, 1) + 1
    radio.loss = v.loss
    radio.range = v.range if v.range is not None else float("inf")
    radio.staleness = v.staleness if v.staleness is not None else float("inf")


def _fill_observer(observer: Any, scenario: Scenario, fill: _Filler) -> None:
    o = scenario.observer
    count = len(scenario.vehicles)
    observer.k = fill.array(o.k if isinstance(o.k, tuple) else [o.k] * count, fill.p.scalar)
    q = o.q
    weights = [q.get(name, 10.0) if isinstance(q, dict) else q for name in scenario.target_names]
    observer.q = fill.array(weights, fill.p.scalar)
    observer.v1, observer.v2 = o.V
    observer.p1, observer.p2 = o.P0
    observer.max_turn = o.max_turn
    observer.rate = min(scenario.rates.observer or scenario.rates.camera, scenario.rates.camera)
    stride = max(1, round(scenario.rates.camera / GRAMIAN_RATE))
    observer.gramian_stride = stride
    observer.block_ticks = stride * max(1, round(o.gramian_window * scenario.rates.camera / GRAMIAN_BLOCKS / stride))
    observer.blocks = GRAMIAN_BLOCKS
