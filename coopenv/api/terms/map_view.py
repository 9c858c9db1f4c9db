"""Landmarks of the map as a vehicle knows them: where its own estimate puts them, nearest first, and what it measured.

Everybody knows the map, and buildings stand in it; other vehicles are where their messages say. Nothing here depends on
where the vehicles truly are but through estimates and measurements.
"""

from typing import Any

import warp as wp

from coopenv.api.terms.records import NEVER, seconds_since
from coopenv.world.camera import (
    VISIBLE,
    behind_building,
    body_bearing,
    camera_to_body,
    inverse_square_of,
    marker_position,
    project,
    segment_hits_box,
)
from coopenv.world.device_function import device_function
from coopenv.world.v2x import fresh


@wp.struct
class MapLandmark:
    """What a vehicle knows of one of the landmarks that are nearest by its own estimate; 0 where there is none left."""

    index: wp.int32  # of the landmark; -1: there is none
    exists: wp.bool
    position: wp.vec3  # m, seen from the estimate, body
    distance: wp.float32  # m, horizontal, from the estimate
    expected: wp.bool  # to be seen from the estimate: in range, in the image, behind nothing that it knows of
    in_view: wp.bool  # measured in this frame
    bearing: wp.vec3  # unit vector camera to landmark, body, last measured; 0: never
    age: wp.float32  # s since measured


@wp.struct
class Nearest:
    """A landmark in the order of the distance."""

    index: wp.int32  # -1: none
    distance: wp.float32  # m, horizontal


@device_function
def next_nearest(model: Any, state: Any, world: int, vehicle: int, last: Nearest) -> Nearest:
    """Return the landmark that follows `last` in the order of the distance from the estimate, then of the index."""
    p = state.estimate_rotation[world, vehicle] * state.estimate_position[world, vehicle]
    found = Nearest(-1, wp.float32(0.0))
    if last.index < 0 and last.distance >= 0.0:
        return found  # all have been told of
    for n in range(model.landmarks):
        offset = marker_position(model, state, world, n) - p
        distance = wp.float32(wp.sqrt(offset[0] * offset[0] + offset[1] * offset[1]))
        behind = distance > last.distance or (distance == last.distance and n > last.index)
        nearer = found.index < 0 or distance < found.distance
        if state.present[world, n] != 0 and behind and nearer:  # an absent one is on no map
            found.index = n
            found.distance = distance
    return found


@device_function
def behind_vehicle(model: Any, state: Any, world: int, vehicle: int, origin: Any, line: Any, inverse_square: Any):
    """Return whether another vehicle is in the way of a line of sight where its last message puts it."""
    now = state.tick[world]
    for sender in range(model.vehicles):
        agent = model.landmarks + sender
        half = model.scene.body_half[agent]
        if sender != vehicle and half[0] > half.dtype(0.0) and fresh(model, state, world, vehicle, sender, now):
            R = state.inbox_rotation[world, vehicle, sender]
            center = state.inbox_position[world, vehicle, sender] + R * model.scene.body_center[agent]
            if segment_hits_box(origin, line, inverse_square, R, center, half):
                return True
    return False


@device_function
def to_be_seen(model: Any, state: Any, world: int, vehicle: int, point: Any) -> bool:
    """Return whether a point of the map, m, is in view from a vehicle's estimate.

    It is in range, in the image, and behind no building, nor another vehicle as that one believes to stand.
    """
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
def map_record(model: Any, state: Any, world: int, vehicle: int, place: Nearest) -> MapLandmark:
    """Return the record of a landmark."""
    landmark = MapLandmark()
    landmark.index = place.index
    landmark.age = wp.float32(NEVER)
    if place.index >= 0:
        point = marker_position(model, state, world, place.index)
        Rt = wp.transpose(state.estimate_rotation[world, vehicle])
        landmark.exists = True
        landmark.position = wp.vec3(Rt * point - state.estimate_position[world, vehicle])
        landmark.distance = place.distance
        landmark.expected = to_be_seen(model, state, world, vehicle, point)
        landmark.in_view = state.sight[world, vehicle, place.index] == VISIBLE
        landmark.bearing = wp.vec3(body_bearing(model, state, world, vehicle, place.index))
        then = state.bearing_tick[world, vehicle, place.index]
        landmark.age = seconds_since(state.tick[world], then, model.camera_rate)
    return landmark
