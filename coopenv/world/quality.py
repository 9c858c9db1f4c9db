"""Quality of an estimate: errors, NEES, log-determinant, and the sliding observability Gramian of the measurements."""

from typing import Any

import warp as wp

from coopenv.estimation.linalg import block3, cholesky6, identity3, join6, quaternion_vector, skew, smallest_eigenvalue6
from coopenv.estimation.poses import Coordinates
from coopenv.measurements.sensor import CURVATURE_TIME
from coopenv.world.camera import VISIBLE, body_bearing, mapped_position
from coopenv.world.nearby import agent_of, box_of_entry, entry_at, entry_count
from coopenv.world.v2x import fresh
from coopenv.world.warp_internals import device_function


@wp.func
def log_determinant(I11: Any, I22: Any):
    """Return log det P from the inverses of the diagonal blocks of its Cholesky factor."""
    total = I11.dtype(0.0)
    for i in range(3):
        total -= wp.log(I11[i, i]) + wp.log(I22[i, i])
    return I11.dtype(2.0) * total


@wp.func
def normalised_error_squared(I11: Any, L21: Any, I22: Any, e1: Any, e2: Any):
    """Return e^T P^-1 e for e = (e1, e2) and P = L L^T; a very large number where the precision has no room for it.

    NaN where the error is.
    """
    x1 = I11 * e1
    x2 = I22 * (e2 - L21 * x1)
    square = wp.dot(x1, x1) + wp.dot(x2, x2)
    if wp.isfinite(wp.dot(e1, e1) + wp.dot(e2, e2)) and not wp.isfinite(square):
        square = e1.dtype(1.0e18)
    return square


COORDINATES = (Coordinates.RICCATI, Coordinates.LEFT, Coordinates.RIGHT)
"""Coordinates by their number in the state."""
RICCATI, LEFT, RIGHT = (wp.constant(number) for number in range(len(COORDINATES)))


@wp.func
def observer_error(R: Any, position: Any, R_hat: Any, p_hat: Any, coordinates: int):
    """Return the error with the covariance P, rad and m: (2 lambda, p - phat), of Rtilde = Rhat^T R and p = R^T pbar.

    A covariance stated in other coordinates is kept to first order, see `coopenv.estimation.poses.riccati_covariance`.
    Its error is brought here in the same way: terms of second order grow with the distance from the map's origin.

    Source: the paper, section IV; for the other coordinates `coopenv.estimation.poses.Coordinates`.
    """
    R_tilde = wp.transpose(R_hat) * R
    lam = quaternion_vector(R_tilde)
    e1 = lam * p_hat.dtype(2.0)
    e2 = wp.transpose(R) * position - p_hat
    sine = wp.length(lam)
    if coordinates != RICCATI and sine > p_hat.dtype(1e-4):
        e1 *= wp.asin(wp.min(sine, p_hat.dtype(1.0))) / sine  # the rotation vector
    if coordinates == LEFT:
        e2 = wp.transpose(R_hat) * position - p_hat + wp.cross(p_hat, e1)
    if coordinates == RIGHT:
        e2 = R_tilde * e2
    return e1, e2


@wp.func
def position_covariance(P: Any, p_hat: Any):
    """Return the covariance of the error of the position in the map, along the estimated body's axes, m^2.

    To first order in the errors e = (e1, e2), see `observer_error`: R p - Rhat phat = Rhat (e2 - [phat]x e1), so that
    the attitude's error counts with its lever.
    """
    lever = skew(p_hat)
    cross = lever * block3(P, 0, 3)
    own = block3(P, 3, 3) + lever * block3(P, 0, 0) * wp.transpose(lever)
    return own - cross - wp.transpose(cross)


@wp.func
def position_variance(P: Any, p_hat: Any):
    """Return the trace of the covariance of the position error in the map, m^2; it is the same along any axes."""
    return wp.max(wp.trace(position_covariance(P, p_hat)), p_hat.dtype(0.0))


@device_function
def state_deviation(state: Any, world: int, vehicle: int, slot: int):
    """Add the standard deviation of the position to a vehicle's broadcast estimate."""
    variance = position_variance(state.covariance[world, vehicle], state.estimate_position[world, vehicle])
    state.outbox_std[world, vehicle, slot] = wp.sqrt(variance)


@device_function
def usable(model: Any, state: Any, world: int, vehicle: int, entry: int, target: int, tick: int) -> bool:
    """Return whether the observer can use an entry's agent now: seen, and its position known or received."""
    if state.sight[world, vehicle, entry] != VISIBLE:
        return False
    if target < model.landmarks:
        return True
    return fresh(model, state, world, vehicle, box_of_entry(model, entry), tick)


@device_function
def known_position(model: Any, state: Any, world: int, vehicle: int, entry: int, target: int):
    """Return the position of an entry's agent: a landmark on the map, or a neighbour's message (Rhat_j phat_j)."""
    if target < model.landmarks:
        return mapped_position(model, state, world, vehicle, target)
    box = box_of_entry(model, entry)
    R = state.inbox_rotation[world, vehicle, box]
    return state.inbox_position[world, vehicle, box] + R * model.scene.marker[target]


LASTING = wp.constant(CURVATURE_TIME)  # s


@device_function
def white_share(model: Any, state: Any, world: int, vehicle: int, target: int, R: Any, b: Any, line: Any):
    """Return which share of the variance of a bearing's error is white noise: so much its information counts.

    The rest is what the scenario declares: noise that is correlated, latency, a mounting that walks and the accuracy of
    the map. An error that lasts counts by the number of frames that have it, as in filters without a state for it. R is
    body to map, b the unit bearing and `line` the way (m) to the target, both in map axes, all as estimated.
    """
    camera = model.camera[vehicle]
    noise = model.noise[vehicle]
    white = noise.bearing * noise.bearing
    o = white - white
    if white <= o or (camera.uncertain == 0 and model.map_errors == 0):
        return b.dtype(1.0)
    nearness = b.dtype(1.0) / wp.max(wp.length_sq(line), b.dtype(1.0e-6))
    about_target = wp.sqrt(nearness) * wp.cross(b, R * state.odometry_velocity[world, vehicle])
    rate = wp.length_sq(wp.cross(R * state.odometry_angular_velocity[world, vehicle] + about_target, b))
    lasting = camera.latency_std * camera.latency_std * rate
    lasting += b.dtype(LASTING) * camera.orientation_walk * camera.orientation_walk
    if target < model.landmarks:
        lasting += model.landmark_std[target] * model.landmark_std[target] * nearness
    other = noise.bearing_counted * noise.bearing_counted + camera.latency_jitter * camera.latency_jitter * rate
    return white / (white + other + noise.frames_together * lasting)


@device_function
def accumulate_gramian(model: Any, state: Any, world: int, vehicle: int, tick: int, block: int, dt: Any):
    """Add C^T C dt, dt being the time (or the distance) since the last sample, to a block of the sliding Gramian.

    In map axes the transition matrix of A_i is the identity, so that blocks simply add up; the spectrum is the same
    as in the body frame of the window's start. C is taken at the estimate, as the observer itself knows it.
    """
    R = state.estimate_rotation[world, vehicle]
    p = state.estimate_position[world, vehicle]
    G11 = state.gramian_11[world, vehicle, block]
    G12 = state.gramian_12[world, vehicle, block]
    G22 = state.gramian_22[world, vehicle, block]
    i3 = identity3(p)
    kept = model.kept
    for n in range(entry_count(model, state, world, vehicle)):
        entry = entry_at(model, state, kept, world, vehicle, n)
        target = agent_of(state, kept, world, vehicle, entry)
        if usable(model, state, world, vehicle, entry, target, tick):
            b = R * body_bearing(model, state, world, vehicle, entry)
            z = known_position(model, state, world, vehicle, entry, target)
            m = wp.cross(z, b)
            weight = dt * white_share(model, state, world, vehicle, target, R, b, z - R * p)
            G11 += weight * (wp.dot(z, z) * i3 - wp.outer(z, z) - wp.outer(m, m))
            G12 += weight * (skew(z) - wp.outer(m, b))
            G22 += weight * (i3 - wp.outer(b, b))
    for sensor in range(state.information_11.shape[2]):
        G11 += dt * state.information_11[world, vehicle, sensor]
        G12 += dt * state.information_12[world, vehicle, sensor]
        G22 += dt * state.information_22[world, vehicle, sensor]
    state.gramian_11[world, vehicle, block] = G11
    state.gramian_12[world, vehicle, block] = G12
    state.gramian_22[world, vehicle, block] = G22
    state.gramian_time[world, vehicle, block] = state.gramian_time[world, vehicle, block] + dt


@device_function
def empty_block(state: Any, world: int, vehicle: int, block: int):
    """Reset a block of the sliding Gramian."""
    zero = type(state.gramian_11[world, vehicle, block])()
    state.gramian_11[world, vehicle, block] = zero
    state.gramian_12[world, vehicle, block] = zero
    state.gramian_22[world, vehicle, block] = zero
    state.gramian_time[world, vehicle, block] = zero[0, 0]


@device_function
def sample_by_time(model: Any, state: Any, world: int, vehicle: int, tick: int):
    """Add this tick to the sliding Gramian over a time."""
    block = (tick // model.observer.block_ticks) % model.observer.blocks
    if tick % model.observer.block_ticks == 0:
        empty_block(state, world, vehicle, block)
    dt = type(model.observer.max_turn)(model.camera_period)
    accumulate_gramian(model, state, world, vehicle, tick, block, dt * type(dt)(model.observer.gramian_stride))


@device_function
def sample_by_distance(model: Any, state: Any, world: int, vehicle: int, tick: int):
    """Add the distance since the last sample to the sliding Gramian over a distance."""
    since = state.gramian_distance_at[world, vehicle]
    distance = state.distance_driven[world, vehicle] - since
    if distance > type(distance)(0.0):
        first = int(since / model.observer.block_distance)
        last = int((since + distance) / model.observer.block_distance)
        for k in range(wp.max(first, last - model.observer.blocks) + 1, last + 1):
            empty_block(state, world, vehicle, k % model.observer.blocks)
        accumulate_gramian(model, state, world, vehicle, tick, last % model.observer.blocks, distance)
        state.gramian_distance_at[world, vehicle] = since + distance


@device_function
def sample_gramian(model: Any, state: Any, world: int, vehicle: int, tick: int):
    """Add this tick to the sliding Gramian when a sample is due."""
    by_distance = model.observer.block_distance > type(model.observer.max_turn)(0.0)
    if by_distance:
        forward = state.increment_translation[world, vehicle][0]
        state.distance_driven[world, vehicle] = state.distance_driven[world, vehicle] + forward
    if tick % model.observer.gramian_stride == 0:
        if by_distance:
            sample_by_distance(model, state, world, vehicle, tick)
        else:
            sample_by_time(model, state, world, vehicle, tick)


@device_function
def gramian_smallest_eigenvalue(model: Any, state: Any, world: int, vehicle: int):
    """Return the smallest eigenvalue of (1/T) int Phi^T C^T C Phi dt over the sliding window; 0 before any data.

    For a window of a length, it is the mean over the distance.
    """
    G11 = state.gramian_11[world, vehicle, 0]
    G12 = state.gramian_12[world, vehicle, 0]
    G22 = state.gramian_22[world, vehicle, 0]
    time = state.gramian_time[world, vehicle, 0]
    for block in range(1, model.observer.blocks):
        G11 += state.gramian_11[world, vehicle, block]
        G12 += state.gramian_12[world, vehicle, block]
        G22 += state.gramian_22[world, vehicle, block]
        time += state.gramian_time[world, vehicle, block]
    if time <= type(time)(0.0):
        return time
    G = join6(G11, G12, wp.transpose(G12), G22)
    return smallest_eigenvalue6(G) / time


@wp.func
def cholesky_of(P: Any):
    """Return (L11^-1, L21, L22^-1) of the Cholesky factor of a 6x6 covariance."""
    _, L21, _, I11, I22 = cholesky6(block3(P, 0, 0), block3(P, 0, 3), block3(P, 3, 3))
    return I11, L21, I22


@device_function
def targets_in_view(model: Any, state: Any, world: int, vehicle: int) -> int:
    """Return the number of targets that the vehicle measures in this frame."""
    count = int(0)
    kept = model.kept
    for n in range(entry_count(model, state, world, vehicle)):
        if state.sight[world, vehicle, entry_at(model, state, kept, world, vehicle, n)] == VISIBLE:
            count += 1
    return count
