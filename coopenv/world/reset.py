"""Start an episode: draw presence, poses and initial estimates.

An absent agent is neither seen nor a body. Presence is drawn at a reset and changed by vehicles that leave.
"""

from typing import Any

import warp as wp

from coopenv.estimation.linalg import exp_so3, identity3, join6, orthonormalise
from coopenv.motions.command import command_of
from coopenv.world.dynamics import prescribe
from coopenv.world.model import DRIVEN, PRESCRIBED
from coopenv.world.nearby import clear_cells, clear_entries, put_into_cell
from coopenv.world.quality import empty_block
from coopenv.world.random import (
    INITIAL_ERROR,
    INITIAL_SPEED,
    LANDMARK,
    LANDMARK_PRESENCE,
    PRESENCE,
    RESET_ESTIMATE_ORIENTATION,
    RESET_ESTIMATE_POSITION,
    RESET_POSE,
    TRAFFIC_PACE,
    draw_parameters,
    on_cells,
    random_words,
    signed_uniform,
    uniform,
    unit_vector,
)
from coopenv.world.referee import touches_one_of
from coopenv.world.route import draw_route, go_straight, has_routes, start_on_route
from coopenv.world.v2x import NOTHING, POSE_BYTES, first_tick_of
from coopenv.world.warp_internals import outlined

ABSENT = wp.constant(-1)
"""Value of `ended` of a vehicle that is absent in this episode."""

EVERY_VEHICLE = wp.constant(-1)
"""All vehicles of a world, as a subject of random numbers."""


@wp.func
def draw_presence(model: Any, state: Any, world: int):
    """Draw the agents that are present in an episode, and the pace of each prescribed motion."""
    one = type(model.routes.height)(1.0)
    for agent in range(model.agents):
        words = random_words(state.seed[world], state.episode[world], 0, agent, PRESENCE)
        chance = model.drawn.presence[agent]
        if agent < model.landmarks:
            chance = chance * state.parameter[world, LANDMARK_PRESENCE]
        state.present[world, agent] = wp.where(uniform(words[0], one) < chance, 1, 0)
        pace = one
        if model.motion.kind[agent] == PRESCRIBED:
            pace = one + model.drawn.pace_spread[agent] * signed_uniform(words[1], one)
            pace = pace * state.parameter[world, TRAFFIC_PACE]
        state.pace[world, agent] = pace
    keep_one_vehicle(model, state, world)
    for vehicle in range(model.vehicles):
        agent = model.landmarks + vehicle
        state.ended[world, vehicle] = wp.where(state.present[world, agent] == 0, ABSENT, 0)
        state.entry_tick[world, vehicle] = 0
        times = model.drawn.entry[vehicle]
        if times[0] >= times.dtype(0.0) and state.present[world, agent] == 1:
            words = random_words(state.seed[world], state.episode[world], 0, agent, PRESENCE)
            state.entry_tick[world, vehicle] = first_tick_of(model, times[0], times[1] - times[0], words[2])
            state.present[world, agent] = 0


@wp.func
def keep_one_vehicle(model: Any, state: Any, world: int):
    """Keep one vehicle, a driven one if possible, in an episode without any drawn vehicle."""
    candidates = int(0)
    for agent in range(model.landmarks, model.agents):
        if model.motion.kind[agent] == DRIVEN or model.drawn.any_driven == 0:
            candidates += 1
            if state.present[world, agent] != 0:
                return
    words = random_words(state.seed[world], state.episode[world], 0, EVERY_VEHICLE, PRESENCE)
    chosen = wp.min(int(uniform(words[0], wp.float64(1.0)) * wp.float64(candidates)), candidates - 1)
    for agent in range(model.landmarks, model.agents):
        if model.motion.kind[agent] == DRIVEN or model.drawn.any_driven == 0:
            if chosen == 0:
                state.present[world, agent] = 1
            chosen -= 1


ATTEMPTS = wp.constant(16)
"""Number of draws of a start on a route, until the vehicle touches no other body."""


@wp.func
def place_agent(model: Any, state: Any, world: int, agent: int):
    """Draw the true start pose of one agent, and its route, and start its motion; earlier agents are in place."""
    vehicle = agent - model.landmarks
    if vehicle < 0:
        position = model.start.position[agent]
        if model.drawn.group[agent] >= 0:
            position = draw_place(model, state, world, agent)
        place_at(model, state, world, agent, position, model.start.rotation[agent], 0)
        return
    state.arrivals[world, vehicle] = 0
    if not has_routes(model, vehicle):
        place_at(model, state, world, agent, model.start.position[agent], model.start.rotation[agent], 0)
        go_straight(model, state, world, vehicle)
        return
    for attempt in range(ATTEMPTS):
        s = draw_route(model, state, world, vehicle, attempt)
        position, R = start_on_route(model, state, world, vehicle, s)
        place_at(model, state, world, agent, position, R, attempt)
        if touches_one_of(model, state, world, vehicle, agent) == 0:
            break


@wp.func
def draw_place(model: Any, state: Any, world: int, landmark: int):
    """Draw the position of a landmark of a group: uniform over the group's areas and heights."""
    d = model.drawn
    group = d.group[landmark]
    seed = state.seed[world]
    words = random_words(seed, state.episode[world], 0, landmark, LANDMARK)
    area = d.first_area[group]
    share = uniform(words[3], wp.float64(1.0))
    while area < d.first_area[group + 1] - 1 and d.area_share[area] < share:
        area += 1
    second = d.area_second_edge[area]
    height = d.height[group]
    zero = height - height
    one = zero + type(zero)(1.0)
    words = on_cells(words, seed, True, wp.dot(second, second) > zero, height > zero)
    along = d.area_first_edge[area] * uniform(words[0], one) + second * uniform(words[1], one)
    return d.area_corner[area] + along + type(second)(zero, zero, height * uniform(words[2], one))


@outlined
def place_at(model: Any, state: Any, world: int, agent: int, position: Any, R: Any, attempt: int):
    """Draw the true start pose of one agent about a given one and start its motion."""
    spread = model.start.position_spread[agent]
    o = type(position)()
    one = o.dtype(1.0)
    words = random_words(state.seed[world], state.episode[world], attempt, agent, RESET_POSE)
    if agent < model.landmarks:
        words = on_cells(words, state.seed[world], spread[0] > o[0], spread[1] > o[0], spread[2] > o[0])
    offset = type(o)(
        spread[0] * signed_uniform(words[0], one),
        spread[1] * signed_uniform(words[1], one),
        spread[2] * signed_uniform(words[2], one),
    )
    turn = model.start.yaw_spread[agent] * signed_uniform(words[3], one)
    place = position + R * offset
    turned = R
    if turn != o[0]:
        turned = R * exp_so3(type(o)(o[0], o[0], turn))
    state.start_position[world, agent] = place
    state.start_rotation[world, agent] = turned
    state.position[world, agent] = place
    state.rotation[world, agent] = turned
    state.velocity[world, agent] = o
    state.angular_velocity[world, agent] = o
    if model.motion.kind[agent] == PRESCRIBED:
        prescribe(model, state, world, agent, wp.float64(0.0))


@outlined
def place_vehicle(model: Any, state: Any, world: int, vehicle: int):
    """Reset the vehicle's actuators, odometry and counters."""
    agent = model.landmarks + vehicle
    o = type(state.velocity[world, agent])()
    speed = model.start.speed[vehicle]
    if model.drawn.speed_spread[vehicle] > o[0]:
        words = random_words(state.seed[world], state.episode[world], 0, vehicle, INITIAL_SPEED)
        speed = speed + model.drawn.speed_spread[vehicle] * signed_uniform(words[0], o.dtype(1.0))
        speed = wp.clamp(speed, model.dynamics[vehicle].min_speed, model.dynamics[vehicle].max_speed)
    state.speed[world, vehicle] = speed
    state.turn[world, vehicle] = o[0]
    state.lateral_speed[world, vehicle] = o[0]
    # The action in force before the first decision keeps the start speed, or accelerates by nothing.
    level = o[0]
    limits = model.dynamics[vehicle]
    if limits.acceleration_mode == 0:
        span = limits.max_speed - limits.min_speed
        level = (speed - limits.min_speed) * o.dtype(2.0) / span - o.dtype(1.0)
    command = command_of(limits, level, o[0], o[0], o[0])
    state.action[world, vehicle, 0] = level
    for k in range(1, model.action_size):
        state.action[world, vehicle, k] = o[0]
        if model.radio.entry > 0 and k >= model.radio.entry:
            state.action[world, vehicle, k] = o.dtype(1.0)
    state.report_size[world, vehicle] = POSE_BYTES
    state.bytes_sent[world, vehicle] = 0
    state.pan[world, vehicle] = o[0]
    state.command[world, vehicle] = command
    state.last_command[world, vehicle] = command
    if model.motion.kind[agent] == DRIVEN:
        state.velocity[world, agent] = type(o)(speed, o[0], o[0])
    state.odometry_velocity[world, vehicle] = o
    state.odometry_angular_velocity[world, vehicle] = o
    state.odometry_samples[world, vehicle] = 0
    state.increment_rotation[world, vehicle] = identity3(o)
    state.increment_translation[world, vehicle] = o
    state.corrected_tick[world, vehicle] = 0
    state.nis[world, vehicle] = wp.float64(0.0)
    state.nis_dof[world, vehicle] = 0
    state.protection_level[world, vehicle] = wp.vec2d()
    for sample in range(model.samples_per_tick):
        state.sampled_velocity[world, vehicle, sample] = o
        state.sampled_angular_velocity[world, vehicle, sample] = o
    clear_entries(model, state, world, vehicle)
    for slot in range(model.radio.slots):
        state.outbox_tick[world, vehicle, slot] = -1
        state.outbox_position[world, vehicle, slot] = o
        state.outbox_rotation[world, vehicle, slot] = identity3(o)
        state.outbox_std[world, vehicle, slot] = o[0]
        for other in range(state.outbox_seen.shape[3]):
            state.outbox_seen[world, vehicle, slot, other] = -1
            state.outbox_content[world, vehicle, slot, other] = NOTHING
    for block in range(model.observer.blocks):
        empty_block(state, world, vehicle, block)
    state.gramian_distance_at[world, vehicle] = o[0]
    state.distance_driven[world, vehicle] = o[0]


@wp.func
def random_turn(largest: Any, words: Any, zero: Any):
    """Return a random rotation vector: angle uniform in [0, largest]; uniform over SO(3) if largest < 0.

    Over SO(3) the angle's distribution is (angle - sin(angle)) / pi; it is inverted by bisection.
    """
    axis = unit_vector(words[0], words[1], zero)
    u = uniform(words[2], zero[0])
    if largest >= zero[0]:
        return axis * (largest * u)
    pi = zero.dtype(3.141592653589793)
    low = zero[0]
    high = pi
    for _ in range(50):
        middle = (low + high) * zero.dtype(0.5)
        if (middle - wp.sin(middle)) / pi < u:
            low = middle
        else:
            high = middle
    return axis * ((low + high) * zero.dtype(0.5))


@outlined
def set_initial_estimate(model: Any, state: Any, world: int, vehicle: int):
    """Draw the initial estimate and set P(0)."""
    agent = model.landmarks + vehicle
    seed = state.seed[world]
    episode = state.episode[world]
    o = type(state.position[world, agent])()
    position = model.start.estimate_position[vehicle]
    if model.start.estimate_fixed[vehicle] == 0:
        position = position + state.position[world, agent]
    words = random_words(seed, episode, 0, vehicle, RESET_ESTIMATE_POSITION)
    third = o.dtype(1.0) / o.dtype(3.0)
    factor = state.parameter[world, INITIAL_ERROR]
    radius = model.start.estimate_radius[vehicle] * factor * wp.pow(uniform(words[2], third), third)
    position = position + unit_vector(words[0], words[1], o) * radius
    R = model.start.estimate_rotation[vehicle]
    if model.start.orientation_fixed[vehicle] == 0:
        R = state.rotation[world, agent] * R
    words = random_words(seed, episode, 0, vehicle, RESET_ESTIMATE_ORIENTATION)
    largest = model.start.orientation_angle[vehicle]
    if largest > o[0]:
        largest = wp.min(largest * factor, o.dtype(3.141592653589793))
    turn = random_turn(largest, words, o)
    R = orthonormalise(R * exp_so3(turn))
    state.estimate_rotation[world, vehicle] = R
    state.estimate_position[world, vehicle] = wp.transpose(R) * position
    i3 = identity3(o)
    state.covariance[world, vehicle] = join6(model.observer.p1 * i3, type(R)(), type(R)(), model.observer.p2 * i3)
    state.coordinates[world, vehicle] = model.coordinates


@outlined
def place_bodies(model: Any, state: Any, world: int):
    """Begin at tick 0: draw the world's random quantities and place all bodies."""
    state.tick[world] = 0
    state.exhausted[world] = 0
    draw_parameters(model, state, world)
    draw_presence(model, state, world)
    clear_cells(model, state, world)
    for agent in range(model.agents):
        place_agent(model, state, world, agent)
        put_into_cell(model, state, world, agent, state.position[world, agent])
    for vehicle in range(model.vehicles):
        place_vehicle(model, state, world, vehicle)
