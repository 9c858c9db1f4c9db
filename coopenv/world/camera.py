"""Camera: which targets are in view and not occluded, and their noisy unit bearings.

A bearing is stored as the unit vector from the observing camera to the target, in the camera's optical frame; of a
panning camera, in that frame without pan, because the vehicle knows the angle; readers of a bearing need no pan.
"""

from typing import Any

import warp as wp

from coopenv.estimation import Sight
from coopenv.estimation.linalg import exp_so3
from coopenv.world.dynamics import pose_before
from coopenv.world.model import BLIND, IDEAL
from coopenv.world.nearby import (
    agent_of,
    body_of,
    cell_at,
    entry_at,
    entry_count,
    first_in,
    has_body,
    is_target,
    keep_those_in_range,
    last_of_all,
    next_in,
    window_about,
)
from coopenv.world.random import (
    BEARING,
    BEARING_DRIFT,
    BEARING_NOISE,
    CAMERA_FRAME,
    CAMERA_RANGE,
    EXTRINSICS,
    MAP_ACCURACY,
    four_gaussians,
    gaussian_pair,
    pair,
    random_words,
    signed_uniform,
    uniform,
)
from coopenv.world.warp_internals import device_function, outlined

VISIBLE = wp.constant(wp.uint8(Sight.VISIBLE))
OUT_OF_VIEW = wp.constant(wp.uint8(Sight.OUT_OF_VIEW))
OCCLUDED_BY_BUILDING = wp.constant(wp.uint8(Sight.OCCLUDED_BY_BUILDING))
OCCLUDED_BY_BODY = wp.constant(wp.uint8(Sight.OCCLUDED_BY_BODY))
MISSED = wp.constant(wp.uint8(Sight.MISSED))


@wp.func
def marker_position(model: Any, state: Any, world: int, agent: int):
    """Return the point of an agent that cameras see, map frame."""
    return state.position[world, agent] + state.rotation[world, agent] * model.scene.marker[agent]


@device_function
def draw_map(model: Any, state: Any, world: int):
    """Draw the errors of the landmarks' positions on all maps by the map's accuracy."""
    for landmark in range(wp.where(model.map_errors == 1, model.landmarks, 0)):
        words = random_words(state.seed[world], state.episode[world], 0, landmark, MAP_ACCURACY)
        drawn, _ = four_gaussians(words, state.position[world, landmark])
        state.map_offset[world, landmark] = model.landmark_std[landmark] * drawn


@wp.func
def mapped_position(model: Any, state: Any, world: int, vehicle: int, landmark: int):
    """Return where a landmark's visible point is on a vehicle's map at the next tick.

    It is off by the map's accuracy and by the fault `map_error`.
    """
    point = marker_position(model, state, world, landmark)
    if model.map_errors == 1:
        point += state.map_offset[world, landmark]
        begun = state.map_tick[world, vehicle, landmark]
        if begun >= 0 and state.tick[world] + 1 >= begun:
            point += state.map_error[world, vehicle, landmark]
    return point


@wp.func
def camera_to_body(model: Any, state: Any, world: int, vehicle: int):
    """Return the rotation of a vehicle's camera in its body, as the vehicle knows it."""
    R = model.camera[vehicle].rotation
    pan = state.pan[world, vehicle]
    zero = type(pan)(0.0)
    if pan != zero:
        R = exp_so3(type(model.camera[vehicle].position)(zero, zero, pan)) * R
    return R


@wp.func
def body_bearing(model: Any, state: Any, world: int, vehicle: int, entry: int):
    """Return the last measured unit bearing of an entry's agent in the body frame."""
    return model.camera[vehicle].rotation * state.bearing[world, vehicle, entry]


@wp.func
def segment_hits_box(origin: Any, direction: Any, inverse_square: Any, R: Any, center: Any, half: Any) -> bool:
    """Return whether the segment origin + s direction, 0 < s < 1, passes through an oriented box (slab test).

    `inverse_square` is 1 / |direction|^2; bounding spheres rule most boxes out.
    """
    reach = origin.dtype(1.0e-12)
    to_center = center - origin
    along = wp.clamp(wp.dot(to_center, direction) * inverse_square, origin.dtype(0.0), origin.dtype(1.0))
    miss = to_center - along * direction
    if wp.dot(miss, miss) > wp.dot(half, half):
        return False
    Rt = wp.transpose(R)
    o = -(Rt * to_center)
    d = Rt * direction
    enter = origin.dtype(0.0)
    leave = origin.dtype(1.0)
    for axis in range(3):
        if wp.abs(d[axis]) < reach:
            if wp.abs(o[axis]) > half[axis]:
                return False
        else:
            a = (-half[axis] - o[axis]) / d[axis]
            b = (half[axis] - o[axis]) / d[axis]
            enter = wp.max(enter, wp.min(a, b))
            leave = wp.min(leave, wp.max(a, b))
    return enter < leave


@device_function
def behind_building(model: Any, origin: Any, direction: Any, inverse_square: Any) -> bool:
    """Return whether a building occludes a line of sight; `inverse_square` is 1 / |direction|^2."""
    x, y, columns, rows = window_about(model, origin, origin + direction, direction.dtype(0.0))
    for row in range(rows):
        for column in range(columns):
            cell = cell_at(model, x + column, y + row)
            for entry in range(model.cells.first_building[cell], model.cells.first_building[cell + 1]):
                k = model.cells.building[entry]
                if segment_hits_box(
                    origin,
                    direction,
                    inverse_square,
                    model.scene.obstacle_rotation[k],
                    model.scene.obstacle_center[k],
                    model.scene.obstacle_half[k],
                ):
                    return True
    return False


@wp.func
def inverse_square_of(direction: Any):
    """Return 1 / |direction|^2; of a direction without length something large."""
    return direction.dtype(1.0) / wp.max(wp.dot(direction, direction), direction.dtype(1.0e-12))


@device_function
def occlusion(model: Any, state: Any, world: int, observer: int, target: int, origin: Any, direction: Any):
    """Return VISIBLE, or the obstruction of the line of sight; the bodies at its ends do not count."""
    inverse_square = inverse_square_of(direction)
    if behind_building(model, origin, direction, inverse_square):
        return OCCLUDED_BY_BUILDING
    last = last_of_all(model)
    x, y, columns, rows = window_about(model, origin, origin + direction, state.body_reach[world])
    for row in range(rows):
        for column in range(columns):
            item = first_in(model, state, world, cell_at(model, x + column, y + row))
            while item >= 0:
                if item != observer and item != target and has_body(model, state, world, item):
                    R, center, half = body_of(model, state, world, item)
                    if segment_hits_box(origin, direction, inverse_square, R, center, half):
                        return OCCLUDED_BY_BODY
                item = next_in(model, state, world, item, last)
    return VISIBLE


@wp.func
def distort(camera: Any, x: Any, y: Any):
    """Return distorted image coordinates (plumb-bob model, both at distance 1)."""
    two = type(x)(2.0)
    r2 = x * x + y * y
    radial = type(x)(1.0) + r2 * (camera.k1 + r2 * (camera.k2 + r2 * camera.k3))
    dx = two * camera.p1 * x * y + camera.p2 * (r2 + two * x * x)
    dy = camera.p1 * (r2 + two * y * y) + two * camera.p2 * x * y
    return x * radial + dx, y * radial + dy


@wp.func
def undistort(camera: Any, xd: Any, yd: Any):
    """Return undistorted image coordinates by fixed-point iteration."""
    x = xd
    y = yd
    for _ in range(20):
        ex, ey = distort(camera, x, y)
        last_x = x
        last_y = y
        x = x + (xd - ex)
        y = y + (yd - ey)
        if x == last_x and y == last_y:
            break
    return x, y


@wp.func
def project(camera: Any, bearing: Any):
    """Return (pixel u, pixel v, 1 if inside the image) of a direction of any length in the optical frame.

    A ray beyond the lens's largest radius has the pixel of the nearest ray that the lens can image.
    """
    inside = int(1)
    depth = bearing[2]
    if depth <= bearing.dtype(1.0e-6):
        inside = int(0)
        depth = bearing.dtype(1.0e-6)
    x = bearing[0] / depth
    y = bearing[1] / depth
    square = x * x + y * y
    if square > camera.max_radius * camera.max_radius:
        inside = int(0)
        shrink = camera.max_radius / wp.sqrt(square)
        x = x * shrink
        y = y * shrink
    xd, yd = distort(camera, x, y)
    u = camera.focal_length[0] * xd + camera.principal_point[0]
    v = camera.focal_length[1] * yd + camera.principal_point[1]
    o = bearing.dtype(0.0)
    if u < o or v < o or u >= camera.image_size[0] or v >= camera.image_size[1]:
        inside = int(0)
    return u, v, inside


@wp.func
def through_pixels(camera: Any, bearing: Any):
    """Return the bearing that is computed from the detection's pixel: rounding, distortion, its removal."""
    u, v, _ = project(camera, bearing)
    if camera.quantise == 1:
        u = wp.round(u)
        v = wp.round(v)
    x = (u - camera.principal_point[0]) / camera.focal_length[0]
    y = (v - camera.principal_point[1]) / camera.focal_length[1]
    if camera.undistort == 1:
        x, y = undistort(camera, x, y)
    return wp.normalize(type(bearing)(x, y, bearing.dtype(1.0)))


@wp.func
def has_pixel(model: Any, camera: Any, ray: Any) -> bool:
    """Return whether a measurement along a ray is inside the image: ideal sensing measures beyond it too."""
    if model.sensing != IDEAL:
        return True
    _, _, inside = project(camera, ray)
    return inside == 1


@wp.func
def noisy_bearing(noise: Any, level: Any, bearing: Any, words: Any):
    """Return a unit bearing with noise of a level.

    It is that of the paper's image-plane formula about an axis, or isotropic in the tangent plane.
    """
    one = bearing.dtype(1.0)
    if noise.bearing_paper == 1:
        g = wp.transpose(noise.axis) * bearing
        depth = g[2]
        tiny = bearing.dtype(1.0e-6)
        if wp.abs(depth) < tiny:  # the formula divides by it: docs/method.md, Limits
            depth = wp.where(depth < bearing.dtype(0.0), -tiny, tiny)
        x = g[0] / depth + level * signed_uniform(words[0], one)
        y = g[1] / depth + level * signed_uniform(words[1], one)
        return wp.normalize(noise.axis * type(bearing)(x, y, one)) * wp.sign(depth)
    n1, n2 = gaussian_pair(words[0], words[1], one)
    helper = type(bearing)()
    helper[wp.where(wp.abs(bearing[0]) > bearing.dtype(0.7), 1, 0)] = one
    first = wp.normalize(wp.cross(bearing, helper))
    second = wp.cross(bearing, first)
    return wp.normalize(bearing + level * (n1 * first + n2 * second))


@device_function
def drifting_bearing(model: Any, state: Any, world: int, vehicle: int, entry: int, target: int, tick: int, b: Any):
    """Return a unit bearing with its correlated error, carried here from the exposure of the entry's last bearing.

    The error is a vector whose part across the bearing counts: so it has no axes that could jump.
    """
    noise = model.noise[vehicle]
    one = b.dtype(1.0)
    words = random_words(state.seed[world], state.episode[world], tick, pair(vehicle, target), BEARING_DRIFT)
    fresh, _ = four_gaussians(words, b)
    before = state.bearing_tick[world, vehicle, entry]
    keeps = one - one
    if before >= 0:
        keeps = wp.exp(-b.dtype(wp.float64(tick - before) * model.camera_period) / noise.bearing_correlation_time)
    drift = keeps * state.bearing_drift[world, vehicle, entry] + wp.sqrt(one - keeps * keeps) * fresh
    state.bearing_drift[world, vehicle, entry] = drift
    level = noise.bearing_correlated * state.parameter[world, BEARING_NOISE]
    return wp.normalize(b + level * (drift - wp.dot(drift, b) * b))


@device_function
def sight_of(model: Any, state: Any, world: int, vehicle: int, target: int, origin: Any, line: Any, ray: Any):
    """Return whether a neighbour is in view now, and if not, why; `ray` is `line` in the optical frame.

    An absent vehicle sees no target and is seen by no vehicle.
    """
    if state.present[world, target] == 0 or state.present[world, model.landmarks + vehicle] == 0:
        return OUT_OF_VIEW
    if model.sensing == BLIND or model.camera[vehicle].absent == 1 or model.scene.anchor[target] == 1:
        return OUT_OF_VIEW
    if model.sensed == 1 and model.sensing != IDEAL:
        camera = model.camera[vehicle]
        reach = camera.range * state.parameter[world, CAMERA_RANGE]
        if wp.dot(line, line) > reach * reach:
            return OUT_OF_VIEW
        if camera.pinhole == 1:
            if ray[2] <= ray.dtype(0.0):
                return OUT_OF_VIEW
            _, _, inside = project(camera, ray)
            if inside == 0:
                return OUT_OF_VIEW
        return occlusion(model, state, world, model.landmarks + vehicle, target, origin, line)
    return VISIBLE


@device_function
def expose(model: Any, state: Any, world: int, vehicle: int, tick: int):
    """Return the age of a vehicle's frame at a tick, s; carry the walk of its camera's mounting to that tick."""
    camera = model.camera[vehicle]
    words = random_words(state.seed[world], state.episode[world], tick, vehicle, CAMERA_FRAME)
    turn, jitter = four_gaussians(words, camera.position)
    if tick > 0:
        step = camera.orientation_walk * wp.sqrt(type(jitter)(model.camera_period))
        state.camera_turn[world, vehicle] += step * state.parameter[world, EXTRINSICS] * turn
    state.bearing_age[world, vehicle] = camera.latency
    return camera.latency + state.camera_delay[world, vehicle] + camera.latency_jitter * jitter


@outlined
def observe(model: Any, state: Any, world: int, vehicle: int, tick: int):
    """Take one camera frame of one vehicle; the truth of this tick and the grid are already in place.

    A frame with an age shows where the camera and all targets were when it was exposed; what is present, and what
    occludes a target, is that of this tick, and so is the angle of a panning camera, which is read with the exposure.
    """
    keep_those_in_range(model, state, world, vehicle)
    agent = model.landmarks + vehicle
    camera = model.camera[vehicle]
    noise = model.noise[vehicle]
    level = noise.bearing * state.parameter[world, BEARING_NOISE]
    place = camera.position
    zero = place.dtype(0.0)
    age = zero
    exposed = tick
    if camera.changes == 1:
        age = expose(model, state, world, vehicle, tick)
        exposed = wp.max(tick - camera.latency_ticks, 0)
    R, position = pose_before(model, state, world, agent, tick, age)
    turned = camera_to_body(model, state, world, vehicle)
    to_rest = wp.transpose(camera.rotation) * turned
    if camera.orientation_std > zero or camera.position_std > zero or camera.orientation_walk > zero:
        place = place + state.camera_shift[world, vehicle]
        turned = turned * exp_so3(state.camera_turn[world, vehicle])
    origin = position + R * place
    to_camera = wp.transpose(R * turned)
    if camera.focal_std > zero:  # the image is wider than a vehicle knows: as seen through the nominal lens
        wider = zero + place.dtype(1.0) + state.camera_focal[world, vehicle]
        to_camera = wp.diag(type(place)(wider, wider, place.dtype(1.0))) * to_camera
    random = camera.miss_probability > zero or level > zero
    kept = model.kept
    for n in range(entry_count(model, state, world, vehicle)):
        entry = entry_at(model, state, kept, world, vehicle, n)
        target = agent_of(state, kept, world, vehicle, entry)
        if kept > 0 and not is_target(model, vehicle, target):
            continue
        target_R, target_position = pose_before(model, state, world, target, tick, age)
        line = target_position + target_R * model.scene.marker[target] - origin
        ray = to_camera * line
        sight = sight_of(model, state, world, vehicle, target, origin, line, ray)
        b = ray
        if sight == VISIBLE:
            b = wp.normalize(ray)
        if sight == VISIBLE and random:
            words = random_words(state.seed[world], state.episode[world], tick, pair(vehicle, target), BEARING)
            if model.sensing != IDEAL and uniform(words[2], zero) < camera.miss_probability:
                sight = MISSED
            if level > zero:
                b = noisy_bearing(noise, level, b, words)
        if sight == VISIBLE and noise.bearing_correlated > zero:
            b = drifting_bearing(model, state, world, vehicle, entry, target, exposed, b)
        if sight == VISIBLE:
            if camera.pinhole == 1 and model.sensed == 1 and has_pixel(model, camera, ray):
                b = through_pixels(camera, b)
            if state.pan[world, vehicle] != zero:
                b = to_rest * b
            state.bearing[world, vehicle, entry] = b
            state.bearing_tick[world, vehicle, entry] = exposed
        state.sight[world, vehicle, entry] = sight
