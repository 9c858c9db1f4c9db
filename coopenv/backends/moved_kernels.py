"""Ticks of vehicles that a program on the host moves: their poses are copied, everything after that is computed."""

from functools import cache
from typing import Any

import warp as wp

from coopenv.world.camera import observe
from coopenv.world.collision import ARRIVED, COLLIDED, UNDER_WAY, depart, referee
from coopenv.world.dynamics import prescribe
from coopenv.world.embedded import Source
from coopenv.world.model import PRESCRIBED
from coopenv.world.odometry import measure_odometry
from coopenv.world.precision import Precision
from coopenv.world.records import array
from coopenv.world.reset import begin_sensing, place_everybody
from coopenv.world.v2x import transmit


@cache
def moved_struct(p: Precision) -> Any:
    """Return the Warp struct of what a program says of the present tick, in one precision."""
    scalar, vec3, mat33 = p.scalar, p.vec3, p.mat33

    @wp.struct
    class Moved:
        """W worlds, N vehicles, Z bodies of the traffic; lengths in m, angles in rad, map and body frames as named."""

        rotation: array("WN", mat33)  # body to map
        position: array("WN", vec3)  # map
        velocity: array("WN", vec3)  # held over the tick, body, m/s
        angular_velocity: array("WN", vec3)  # likewise, rad/s
        speed: array("WN", scalar)  # m/s
        steering: array("WN", scalar)
        crashed: array("WN", wp.int32)
        left: array("WN", wp.int32)
        traffic_position: array("WZ", vec3)  # map
        traffic_rotation: array("WZ", mat33)
        traffic_half: array("WZ", vec3)

    return Moved


@wp.func
def take_poses(model: Any, state: Any, moved: Any, world: int):
    """Write the true poses and twists, and where the traffic is; a twist holds for all odometry samples of the tick."""
    for vehicle in range(model.vehicles):
        agent = model.landmarks + vehicle
        state.rotation[world, agent] = moved.rotation[world, vehicle]
        state.position[world, agent] = moved.position[world, vehicle]
        state.velocity[world, agent] = moved.velocity[world, vehicle]
        state.angular_velocity[world, agent] = moved.angular_velocity[world, vehicle]
        state.speed[world, vehicle] = moved.speed[world, vehicle]
        state.steering[world, vehicle] = moved.steering[world, vehicle]
        if moved.left[world, vehicle] != 0:
            state.present[world, agent] = 0
        for sample in range(model.samples_per_tick):
            state.sampled_velocity[world, vehicle, sample] = moved.velocity[world, vehicle]
            state.sampled_angular_velocity[world, vehicle, sample] = moved.angular_velocity[world, vehicle]
    for k in range(model.traffic):
        state.traffic_position[world, k] = moved.traffic_position[world, k]
        state.traffic_rotation[world, k] = moved.traffic_rotation[world, k]
        state.traffic_half[world, k] = moved.traffic_half[world, k]


@wp.func
def renew_sample(model: Any, state: Any, moved: Any, world: int, vehicle: int, tick: int):
    """Let an odometry sample that fell on the last frame measure the twist that began there, its noise kept.

    Twists jump from tick to tick, and that of the new one was not known when the sample was taken.
    """
    agent = model.landmarks + vehicle
    taken = wp.float64(state.odometry_samples[world, vehicle] - 1) * model.odometry_period
    if wp.abs(taken - wp.float64(tick - 1) * model.camera_period) < wp.float64(1.0e-9):
        v = moved.velocity[world, vehicle] - state.velocity[world, agent]
        w = moved.angular_velocity[world, vehicle] - state.angular_velocity[world, agent]
        state.odometry_velocity[world, vehicle] = state.odometry_velocity[world, vehicle] + v
        state.odometry_angular_velocity[world, vehicle] = state.odometry_angular_velocity[world, vehicle] + w


@wp.func
def judge(model: Any, state: Any, moved: Any, world: int, vehicle: int):
    """Judge contact and arrival; whoever moves the vehicles may know of contacts that are over, and who has left."""
    if state.ended[world, vehicle] == UNDER_WAY:
        if moved.crashed[world, vehicle] != 0 and model.scene.end_on_collision == 1:
            state.ended[world, vehicle] = COLLIDED
        elif moved.left[world, vehicle] != 0 and model.scene.end_on_arrival == 1:
            state.ended[world, vehicle] = ARRIVED
    referee(model, state, world, vehicle)
    if moved.crashed[world, vehicle] != 0:
        state.collided[world, vehicle] = 1


@wp.func
def begin_moved(model: Any, state: Any, moved: Any, world: int):
    """Begin an episode where the vehicles stand; initial estimates are drawn as in the simulation."""
    place_everybody(model, state, world)
    take_poses(model, state, moved, world)
    for vehicle in range(model.vehicles):
        agent = model.landmarks + vehicle
        state.start_rotation[world, agent] = state.rotation[world, agent]
        state.start_position[world, agent] = state.position[world, agent]
    begin_sensing(model, state, world)


@wp.func
def sense_moved(model: Any, state: Any, moved: Any, world: int, tick: int):
    """Take the poses of a tick and measure there."""
    depart(model, state, world)
    for landmark in range(model.landmarks):
        if model.motion.kind[landmark] == PRESCRIBED:
            prescribe(model, state, world, landmark, wp.float64(tick) * model.camera_period)
    for vehicle in range(model.vehicles):
        renew_sample(model, state, moved, world, vehicle, tick)
    take_poses(model, state, moved, world)
    for vehicle in range(model.vehicles):
        measure_odometry(model, state, world, vehicle, tick)
    for vehicle in range(model.vehicles):
        judge(model, state, moved, world, vehicle)
    for vehicle in range(model.vehicles):
        observe(model, state, world, vehicle, tick)
    transmit(model, state, world, tick)


MOVED = Source("moved", begin_moved, sense_moved, moved_struct)
"""Ticks of vehicles that a program on the host moves."""
