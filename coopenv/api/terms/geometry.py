"""Computation of the records of terms: estimate, route, map, targets and neighbours of one vehicle."""

from typing import Any

import warp as wp

from coopenv.api.terms.records import NEVER, Ego, MapLandmark, Neighbour, Target, TruthRecord, log10, mat66
from coopenv.motions.command import ACCELERATION, SPEED, TURN
from coopenv.scenario import terms
from coopenv.world.camera import (
    VISIBLE,
    behind_building,
    body_bearing,
    camera_to_body,
    inverse_square_of,
    mapped_position,
    project,
    segment_hits_box,
)
from coopenv.world.model import DRIVEN
from coopenv.world.nearby import (
    ROUNDING,
    WIDER,
    agent_of,
    box_of_entry,
    cell_at,
    cell_of,
    entry_count,
    entry_of,
    first_in,
    kept_before,
    next_in,
    sender_of,
)
from coopenv.world.quality import position_covariance
from coopenv.world.referee import ARRIVED, COLLIDED, OFF_ROUTE
from coopenv.world.route import UNDER_WAY, goal_distance, place_on_route, point_on_route, route_length
from coopenv.world.v2x import POSE_BYTES, fresh
from coopenv.world.warp_internals import device_function

HALF_TICK = wp.constant(1.0e-3)
"""Less than half of the time between two camera ticks, s."""
SETTLED_FROM = wp.constant(terms.SETTLED_FROM)
FASTEST = wp.constant(wp.float64(2.0))
"""Largest gain of progress per time, in multiples of the top speed (the inside of a bend is shorter)."""


@device_function
def estimate_on_route(state: Any, world: int, vehicle: int):
    """Return the place of a route nearest to the estimate; 0 without a goal.

    Returns:
        Arc length (m), offset of the estimate to the left (m), heading of the route (rad), and the progress: the arc
        length within the ends of the route (m).
    """
    p = state.estimate_rotation[world, vehicle] * state.estimate_position[world, vehicle]
    s, offset, heading = place_on_route(state, world, vehicle, p[0], p[1])
    return s, offset, heading, wp.clamp(s, s - s, route_length(state, world, vehicle))


@wp.func
def turn_between(first: Any, second: Any):
    """Return the angle from the second to the first direction, rad in [-pi, pi]."""
    return wp.atan2(wp.sin(first - second), wp.cos(first - second))


@device_function
def route_from_estimate(model: Any, state: Any, world: int, vehicle: int, s: Any, along: Any):
    """Return the route relative to the estimated pose, from its nearest arc length `s` (m) and heading `along` (rad).

    Returns:
        Heading minus the heading of the route (rad), remaining arc length (m), and the directions of the route 1, 2, 4
        and 8 steps ahead, in rad from the body's x axis to the left.
    """
    R = state.estimate_rotation[world, vehicle]
    p = R * state.estimate_position[world, vehicle]
    heading = wp.atan2(R[1, 0], R[0, 0])
    ahead = wp.vec4()
    step = model.route_step
    for k in range(4):
        x, y, _ = point_on_route(state, world, vehicle, s + step)
        ahead[k] = wp.float32(turn_between(wp.atan2(y - p[1], x - p[0]), heading))
        step = step + step
    return turn_between(heading, along), wp.max(route_length(state, world, vehicle) - s, s - s), ahead


@device_function
def furthest_so_far(state: Any, results: Any, world: int, vehicle: int):
    """Return the largest estimated progress along the present route before this decision, m; 0 on a new route."""
    last = results.furthest[world, vehicle]
    if (
        state.arrivals[world, vehicle] != results.last_arrivals[world, vehicle]
        and state.ended[world, vehicle] != ARRIVED
    ):
        last = last - last
    return last


@device_function
def metres(model: Any, state: Any, results: Any, world: int, vehicle: int, progress: Any, elapsed: wp.float64):
    """Return the metres of its route that a vehicle gains in this decision, and those that it misses.

    The missed metres are the rest of the route in the step that ends the episode without an arrival, otherwise 0.
    """
    zero = progress - progress
    last = furthest_so_far(state, results, world, vehicle)
    most = model.dynamics[vehicle].max_speed * type(progress)(FASTEST * elapsed)
    gained = wp.clamp(progress - last, zero, most)
    missed = zero
    ends = results.terminated[world, vehicle] or results.truncated[world, vehicle]
    if ends and results.alive[world, vehicle] and state.ended[world, vehicle] != ARRIVED:
        missed = wp.max(route_length(state, world, vehicle) - last - gained, zero)
    return gained, missed


@device_function
def lost_time(model: Any, state: Any, results: Any, world: int, vehicle: int) -> wp.float32:
    """Return the time (s) for which a vehicle counts as lost after the end of its episode, as the score defines it.

    It is the rest of the way at the mean pace so far, at most the duration of an episode; without a goal, or after an
    arrival, the rest of the episode. Of all other steps it is 0. The time before `SETTLED_FROM` does not count. See
    `coopenv.evaluation.episodes.Episodes.lost_for`.
    """
    ends = results.alive[world, vehicle] and (results.terminated[world, vehicle] or results.truncated[world, vehicle])
    outcome = state.ended[world, vehicle]
    has_goal = wp.float32(model.scene.goal_radius[vehicle]) > 0.0
    to_goal = has_goal and model.scene.end_on_arrival == 1 and state.arrivals[world, vehicle] == 0
    left_or_hit = wp.where(outcome == COLLIDED, True, outcome == OFF_ROUTE)
    if not ends or not (to_goal or left_or_hit):
        return 0.0
    decision = wp.float32(model.ticks_per_decision) / wp.float32(model.camera_rate)
    made = wp.ceil(wp.float32(state.tick[world]) / wp.float32(model.ticks_per_decision))
    decisions = wp.ceil(wp.float32(model.horizon_ticks) / wp.float32(model.ticks_per_decision))
    rest = decisions - made
    if to_goal:
        length = wp.max(wp.float32(route_length(state, world, vehicle)), 1.0e-6)
        left = wp.clamp(wp.float32(goal_distance(model, state, world, vehicle)) / length, 0.0, 1.0)
        rest = wp.min(made * left / wp.max(1.0 - left, 1.0e-6), decisions)
    early = wp.max(wp.ceil(SETTLED_FROM / decision - 1.0e-4) - 1.0 - made, 0.0)
    return decision * wp.max(wp.max(wp.round(rest), 1.0) - early, 0.0)


@wp.func
def zero_if_unknown(value: Any) -> wp.float32:
    """Return a quantity of the truth, 0 in a recording without it."""
    return wp.where(wp.isfinite(value), wp.float32(value), 0.0)


@wp.func
def seconds_since(now: int, then: int, rate: wp.float64) -> wp.float32:
    """Return the age in s of a measurement or message by its tick; `NEVER` without one."""
    return wp.where(then < 0, NEVER, wp.float32(wp.float64(now - then) / rate))


@wp.func
def odometry_age(samples: int, time: wp.float64, rate: wp.float64) -> wp.float32:
    """Return the age in s of the last of so many samples, the first of which was at 0 s."""
    age = wp.max(time - wp.float64(samples - 1) / rate, wp.float64(0.0))
    return wp.where(samples == 0, NEVER, wp.float32(age))


@device_function
def own_records(model: Any, state: Any, results: Any, world: int, vehicle: int, remaining: Any, route: bool):
    """Return the records `Ego` and `Truth` of a vehicle.

    `results` holds the quality of its estimate and the values after the last decision; `remaining` is the length of its
    route that is left, m. Without `route`, the fields `route_offset` to `route_ahead` stay 0.
    """
    ego = Ego()
    ego.number = vehicle
    tick = state.tick[world]
    time = wp.float64(tick) / model.camera_rate
    ego.time = wp.float32(time)
    ego.elapsed = wp.float32(wp.float64(tick - results.last_tick[world, vehicle]) / model.camera_rate)
    R = state.estimate_rotation[world, vehicle]
    p = state.estimate_position[world, vehicle]
    ego.position_estimate = wp.vec3(R * p)
    ego.rotation_estimate = wp.mat33(R)
    ego.covariance = mat66(state.covariance[world, vehicle])
    ego.log_determinant = wp.float32(results.log_determinant[world, vehicle])
    ego.mean_log_variance = wp.float32(results.log_determinant[world, vehicle] / p.dtype(6.0))
    last = results.last_log_determinant[world, vehicle]
    ego.information_gained = wp.float32((last - results.log_determinant[world, vehicle]) / p.dtype(6.0))
    ego.position_std = wp.float32(results.position_std[world, vehicle])
    spread = position_covariance(state.covariance[world, vehicle], p)
    for axis in range(3):
        ego.axis_std[axis] = wp.float32(wp.sqrt(wp.max(spread[axis, axis], p.dtype(0.0))))
    ego.heading_std = wp.float32(wp.sqrt(wp.max(state.covariance[world, vehicle][2, 2], p.dtype(0.0))))
    ego.protection_level = wp.vec2(results.protection_level[world, vehicle])
    ego.uncertainty_threshold = wp.float32(model.judgement.uncertainty_threshold)
    ego.uncertainty_cap = wp.float32(model.judgement.uncertainty_cap)
    s, offset, along, progress = estimate_on_route(state, world, vehicle)
    gained, missed = metres(model, state, results, world, vehicle, progress, wp.float64(ego.elapsed))
    ego.metres_gained = wp.float32(gained)
    ego.metres_missed = wp.float32(missed)
    ego.gramian_min_eigenvalue = wp.float32(results.gramian_min_eigenvalue[world, vehicle])
    floor = wp.float32(model.judgement.observability_floor)
    ego.soft_observability = log10(floor + wp.max(ego.gramian_min_eigenvalue, 0.0))
    ego.observability_floor = log10(floor)
    ego.observability_level = wp.float32(model.judgement.observability_level)
    ego.targets_in_view = results.targets_in_view[world, vehicle]
    ego.possible_targets = entry_count(model, state, world, vehicle)
    ego.velocity = wp.vec3(state.odometry_velocity[world, vehicle])
    ego.angular_velocity = wp.vec3(state.odometry_angular_velocity[world, vehicle])
    ego.odometry_age = odometry_age(state.odometry_samples[world, vehicle], time, model.odometry_rate)
    first = wp.float32(state.action[world, vehicle, 0])
    second = wp.float32(state.action[world, vehicle, 1])
    third = float(0.0)
    if model.columns + model.pans > 2:
        third = wp.float32(state.action[world, vehicle, 2])
    ego.action = wp.vec3(first, second, third)
    ego.effort = wp.length_sq(ego.action)
    ego.bytes_sent = state.bytes_sent[world, vehicle]
    command = state.command[world, vehicle]
    ego.command = wp.vec3(wp.float32(command[SPEED]), wp.float32(command[TURN]), wp.float32(command[ACCELERATION]))
    ego.pan = wp.float32(state.pan[world, vehicle])
    turning = wp.float32(state.turn[world, vehicle])
    steers = model.dynamics[vehicle].steers == 1
    ego.steering = wp.where(steers, turning, 0.0)
    ego.turn_rate = wp.where(steers, 0.0, turning)
    ego.lateral_speed = wp.float32(state.lateral_speed[world, vehicle])
    ego.time_left = 1.0 - wp.float32(tick) / wp.float32(model.horizon_ticks)
    if route and route_length(state, world, vehicle) > p.dtype(0.0):
        turn, left, ahead = route_from_estimate(model, state, world, vehicle, s, along)
        ego.route_offset = wp.float32(offset)
        ego.route_heading = wp.float32(turn)
        ego.route_left = wp.float32(left)
        ego.route_ahead = ahead
    ego.route_step = wp.float32(model.route_step)
    ego.top_speed = wp.max(wp.float32(model.dynamics[vehicle].max_speed), 1.0e-3)
    if model.scene.goal_radius[vehicle] > p.dtype(0.0):
        ego.goal = wp.vec3(wp.transpose(R) * state.goal[world, vehicle] - p)
    if results.alive[world, vehicle]:
        ego.arrived = state.arrivals[world, vehicle] - results.last_arrivals[world, vehicle]
    ego.outcome = wp.where(results.alive[world, vehicle], state.ended[world, vehicle], UNDER_WAY)

    truth = TruthRecord()
    agent = model.landmarks + vehicle
    truth.position = wp.vec3(state.position[world, agent])
    truth.rotation = wp.mat33(state.rotation[world, agent])
    truth.velocity = wp.vec3(state.velocity[world, agent])
    truth.angular_velocity = wp.vec3(state.angular_velocity[world, agent])
    truth.position_error = zero_if_unknown(results.position_error[world, vehicle])
    truth.orientation_error = zero_if_unknown(results.orientation_error[world, vehicle])
    truth.nees = zero_if_unknown(results.nees[world, vehicle])
    truth.goal_distance = zero_if_unknown(goal_distance(model, state, world, vehicle))
    if model.scene.goal_radius[vehicle] > p.dtype(0.0):
        nearer = results.last_remaining[world, vehicle] - remaining
        if ego.arrived > 0 and ego.outcome == UNDER_WAY:  # on a new route now
            nearer += route_length(state, world, vehicle)
        truth.progress = zero_if_unknown(nearer)
    truth.contact = state.collided[world, vehicle] != 0
    if results.alive[world, vehicle] and ego.time >= SETTLED_FROM - HALF_TICK:
        truth.scored_time = ego.elapsed
    truth.lost_time = lost_time(model, state, results, world, vehicle)
    return ego, truth


@device_function
def kept_entry(state: Any, world: int, vehicle: int, n: int) -> int:
    """Return the n-th entry that is kept; -1: there are fewer."""
    if n >= state.kept_count[world, vehicle]:
        return -1
    return state.kept_order[world, vehicle, n]


@device_function
def target_record(model: Any, state: Any, world: int, vehicle: int, n: int) -> Target:
    """Return the record of the n-th agent, of those kept if not all are; behind the last one its index is -1."""
    target = Target()
    entry = n
    if model.kept > 0:
        entry = kept_entry(state, world, vehicle, n)
    if entry < 0:
        target.index = -1
        target.age = NEVER
    else:
        target.index = agent_of(state, model.kept, world, vehicle, entry)
        target.bearing = wp.vec3(body_bearing(model, state, world, vehicle, entry))
        target.in_view = state.sight[world, vehicle, entry] == VISIBLE
        target.age = seconds_since(state.tick[world], state.bearing_tick[world, vehicle, entry], model.camera_rate)
    return target


@device_function
def entry_of_neighbour(model: Any, state: Any, world: int, vehicle: int, n: int) -> int:
    """Return the entry of the n-th other vehicle; of those that are kept, where not all are. -1: there is none."""
    if model.kept == 0:
        return model.landmarks + wp.where(n >= vehicle, n + 1, n)
    return kept_entry(state, world, vehicle, kept_before(model, state, world, vehicle, model.landmarks) + n)


@device_function
def neighbour_record(model: Any, state: Any, world: int, vehicle: int, entry: int) -> Neighbour:
    """Return the record of another vehicle; without an entry (-1) its index is -1."""
    neighbour = Neighbour()
    now = state.tick[world]
    neighbour.age = NEVER
    neighbour.std = float(wp.inf)
    if entry < 0:
        neighbour.index = -1
        neighbour.bearing_age = NEVER
        neighbour.seen_age = NEVER
        return neighbour
    box = box_of_entry(model, entry)
    target = agent_of(state, model.kept, world, vehicle, entry)
    sender = target - model.landmarks
    neighbour.index = sender
    neighbour.received = fresh(model, state, world, vehicle, box, now)
    if neighbour.received:
        Rt = wp.transpose(state.estimate_rotation[world, vehicle])
        p = state.estimate_position[world, vehicle]
        neighbour.position = wp.vec3(Rt * state.inbox_position[world, vehicle, box] - p)
        neighbour.rotation = wp.mat33(Rt * state.inbox_rotation[world, vehicle, box])
        neighbour.age = seconds_since(now, state.inbox_stamp[world, vehicle, box], model.camera_rate)
        std = wp.float32(state.inbox_std[world, vehicle, box])
        reports = state.inbox_pose_only[world, vehicle, box] == 0 and state.report_size[world, sender] > POSE_BYTES
        if reports and std > 0.0:
            neighbour.std = std
    neighbour.precedes = neighbour.received and (sender < vehicle or model.motion.kind[target] != DRIVEN)
    seen = state.inbox_seen[world, vehicle, box]
    neighbour.sees = neighbour.received and seen == state.inbox_stamp[world, vehicle, box]
    neighbour.seen_age = seconds_since(now, seen, model.camera_rate)
    neighbour.bearing = wp.vec3(body_bearing(model, state, world, vehicle, entry))
    neighbour.in_view = state.sight[world, vehicle, entry] == VISIBLE
    neighbour.bearing_age = seconds_since(now, state.bearing_tick[world, vehicle, entry], model.camera_rate)
    return neighbour


@device_function
def behind_vehicle(model: Any, state: Any, world: int, vehicle: int, origin: Any, line: Any, inverse_square: Any):
    """Return whether another vehicle, at the pose of its last message, occludes a line of sight."""
    now = state.tick[world]
    for box in range(state.inbox_stamp.shape[2]):
        sender = sender_of(model, state, world, vehicle, box)
        if sender != vehicle and fresh(model, state, world, vehicle, box, now):
            agent = model.landmarks + sender
            half = model.scene.body_half[agent]
            if half[0] > half.dtype(0.0):
                R = state.inbox_rotation[world, vehicle, box]
                center = state.inbox_position[world, vehicle, box] + R * model.scene.body_center[agent]
                if segment_hits_box(origin, line, inverse_square, R, center, half):
                    return True
    return False


@device_function
def expected_in_view(model: Any, state: Any, world: int, vehicle: int, point: Any) -> bool:
    """Return whether a point of the map, m, is visible from a vehicle's estimated pose.

    It is in range, in the image, and occluded by no building and no vehicle at the pose of its last message.
    """
    if model.camera[vehicle].absent == 1:
        return False
    if model.sensed == 0:
        return True
    R = state.estimate_rotation[world, vehicle]
    camera = model.camera[vehicle]
    origin = R * (state.estimate_position[world, vehicle] + camera.position)
    line = point - origin
    if wp.dot(line, line) > camera.range * camera.range:
        return False
    if camera.pinhole == 1:
        _, _, inside = project(camera, wp.transpose(R * camera_to_body(model, state, world, vehicle)) * line)
        if inside == 0:
            return False
    inverse_square = inverse_square_of(line)
    if behind_building(model, origin, line, inverse_square):
        return False
    return not behind_vehicle(model, state, world, vehicle, origin, line, inverse_square)


@device_function
def follower_of(model: Any, state: Any, world: int, vehicle: int, p: Any, last: Any, best: Any, n: int) -> MapLandmark:
    """Return `best`, or landmark n if it comes before that one and behind `last`, in the order of `next_landmark`."""
    offset = mapped_position(model, state, world, vehicle, n) - p
    distance = wp.float32(wp.sqrt(offset[0] * offset[0] + offset[1] * offset[1]))
    behind = distance > last.distance or (distance == last.distance and n > last.index)
    nearer = best.index < 0 or distance < best.distance or (distance == best.distance and n < best.index)
    if state.present[world, n] != 0 and behind and nearer:  # an absent landmark is on no map
        best.index = n
        best.distance = distance
    return best


@device_function
def nearest_in_grid(model: Any, state: Any, world: int, vehicle: int, p: Any, last: Any, best: Any) -> MapLandmark:
    """Return the next landmark for `next_landmark`, from the grid; -1 if the rings of cells about the estimate lack it.

    All that is nearer to p than r cells is in the rings up to r, and what is behind `last` not within its distance.
    """
    edge = type(p[0])(1.0) / model.cells.per_metre
    slack = model.marker_reach * type(edge)(WIDER) + type(edge)(ROUNDING)
    first = int((type(edge)(last.distance) - slack) / (edge * type(edge)(1.5))) - 1
    most = wp.min(model.cells.across / 2, int(wp.sqrt(float(model.landmarks)) / 2.0))  # not more cells than landmarks
    for ring in range(wp.max(first, 0), most):
        for row in range(-ring, ring + 1):
            for column in range(-ring, ring + 1, wp.where(wp.abs(row) == ring, 1, 2 * ring)):
                cell = cell_at(model, cell_of(model, p[0]) + column, cell_of(model, p[1]) + row)
                item = first_in(model, state, world, cell)
                while item >= 0:
                    if item < model.landmarks:
                        best = follower_of(model, state, world, vehicle, p, last, best, item)
                    item = next_in(model, state, world, item, -1)
        if best.index >= 0 and type(edge)(best.distance) < type(edge)(ring) * edge - slack:
            return best
    best.index = -1
    return best


@device_function
def next_landmark(model: Any, state: Any, world: int, vehicle: int, last: MapLandmark) -> MapLandmark:
    """Return the record that follows `last` in the order of the distance from the estimate, then of the index.

    A distance below 0 comes before the first landmark. Behind the end of the map the index is -1.
    """
    landmark = MapLandmark()
    landmark.index = -1
    landmark.age = NEVER
    if last.index < 0 and last.distance >= 0.0:
        return landmark  # `last` was the end of the map
    R = state.estimate_rotation[world, vehicle]
    p = R * state.estimate_position[world, vehicle]
    if model.cells.across > 1 and model.map_errors == 0:
        landmark = nearest_in_grid(model, state, world, vehicle, p, last, landmark)
    if landmark.index < 0:
        for n in range(model.landmarks):
            landmark = follower_of(model, state, world, vehicle, p, last, landmark, n)
    if landmark.index >= 0:
        point = mapped_position(model, state, world, vehicle, landmark.index)
        landmark.exists = True
        landmark.position = wp.vec3(wp.transpose(R) * point - state.estimate_position[world, vehicle])
        if model.scene.anchor[landmark.index] == 0:
            landmark.expected = expected_in_view(model, state, world, vehicle, point)
        entry = entry_of(model, state, world, vehicle, landmark.index)
        if entry >= 0:
            landmark.in_view = state.sight[world, vehicle, entry] == VISIBLE
            landmark.bearing = wp.vec3(body_bearing(model, state, world, vehicle, entry))
            then = state.bearing_tick[world, vehicle, entry]
            landmark.age = seconds_since(state.tick[world], then, model.camera_rate)
    return landmark
