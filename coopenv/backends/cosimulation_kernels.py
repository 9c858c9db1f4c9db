"""Kernels of worlds whose vehicles a program on the host moves (co-simulation)."""

from functools import cache
from typing import Any

import warp as wp

from coopenv.backends.feed import recall_truth
from coopenv.world.dynamics import ARRIVED, COLLIDED, UNDER_WAY, depart, move
from coopenv.world.embedded import Source, arrange_world, look_around
from coopenv.world.model import Precision
from coopenv.world.odometry import measure_odometry
from coopenv.world.reset import begin_sensing, place_everybody
from coopenv.world.state import array


@cache
def cosimulation_struct(p: Precision) -> Any:
    """Return the Warp struct of the poses and twists of the present tick, in one precision."""
    scalar, vec3, mat33 = p.scalar, p.vec3, p.mat33

    @wp.struct
    class HostMotion:
        """W worlds, N vehicles; lengths in m, angles in rad, map and body frames as named."""

        true_rotation: array("WN", mat33)  # body to map
        true_position: array("WN", vec3)  # map
        true_velocity: array("WN", vec3)  # held over the tick, body, m/s
        true_angular_velocity: array("WN", vec3)  # likewise, rad/s
        speed: array("WN", scalar)  # m/s
        steering: array("WN", scalar)
        crashed: array("WN", wp.int32)
        left: array("WN", wp.int32)
        driven: array("WN", wp.int32)  # moved here, by commands; its row of the others is not read

    return HostMotion


@wp.func
def take_pose(model: Any, state: Any, motion: Any, world: int, vehicle: int):
    """Write the true pose and twist of a vehicle; the twist holds for all odometry samples of the tick."""
    recall_truth(model, state, motion, world, vehicle, world)
    state.speed[world, vehicle] = motion.speed[world, vehicle]
    state.steering[world, vehicle] = motion.steering[world, vehicle]
    if motion.left[world, vehicle] != 0:
        state.present[world, model.landmarks + vehicle] = 0
    for sample in range(model.samples_per_tick):
        state.sampled_velocity[world, vehicle, sample] = motion.true_velocity[world, vehicle]
        state.sampled_angular_velocity[world, vehicle, sample] = motion.true_angular_velocity[world, vehicle]


@wp.func
def renew_sample(model: Any, state: Any, motion: Any, world: int, vehicle: int, tick: int):
    """Let an odometry sample that fell on the last frame measure the twist that began there, its noise kept.

    Twists jump from tick to tick, and that of the new one was not known when the sample was taken.
    """
    agent = model.landmarks + vehicle
    taken = wp.float64(state.odometry_samples[world, vehicle] - 1) * model.odometry_period
    if wp.abs(taken - wp.float64(tick - 1) * model.camera_period) < wp.float64(1.0e-9):
        v = motion.true_velocity[world, vehicle] - state.velocity[world, agent]
        w = motion.true_angular_velocity[world, vehicle] - state.angular_velocity[world, agent]
        state.odometry_velocity[world, vehicle] = state.odometry_velocity[world, vehicle] + v
        state.odometry_angular_velocity[world, vehicle] = state.odometry_angular_velocity[world, vehicle] + w


@wp.func
def begin_cosimulation(model: Any, state: Any, motion: Any, world: int):
    """Begin an episode where the vehicles stand; initial estimates are drawn as in the simulation."""
    place_everybody(model, state, world)
    for vehicle in range(model.vehicles):
        take_pose(model, state, motion, world, vehicle)
        agent = model.landmarks + vehicle
        state.start_rotation[world, agent] = state.rotation[world, agent]
        state.start_position[world, agent] = state.position[world, agent]
    begin_sensing(model, state, world)


@wp.func
def move_cosimulated(model: Any, state: Any, motion: Any, world: int, vehicle: int, tick: int):
    """Take the pose of a vehicle at a tick, or drive it there, and measure its motion."""
    depart(model, state, world, vehicle)
    if motion.driven[world, vehicle] != 0:
        move(model, state, world, vehicle, tick)
    else:
        renew_sample(model, state, motion, world, vehicle, tick)
        take_pose(model, state, motion, world, vehicle)
    measure_odometry(model, state, world, vehicle, tick)


@wp.func
def look_cosimulated(model: Any, state: Any, motion: Any, world: int, vehicle: int, tick: int):
    """Do what a simulation does; the moving program may know of past contacts and departures."""
    if state.ended[world, vehicle] == UNDER_WAY:
        if motion.crashed[world, vehicle] != 0 and model.scene.end_on_collision == 1:
            state.ended[world, vehicle] = COLLIDED
        elif motion.left[world, vehicle] != 0 and model.scene.end_on_arrival == 1:
            state.ended[world, vehicle] = ARRIVED
    look_around(model, state, motion, world, vehicle, tick)
    if motion.crashed[world, vehicle] != 0:
        state.collided[world, vehicle] = 1


COSIMULATED = Source(
    "cosimulated",
    begin_cosimulation,
    move_cosimulated,
    arrange_world,
    look_cosimulated,
    cosimulation_struct,
    keeps_nearby=True,
)
"""Ticks of vehicles that a program on the host moves."""
