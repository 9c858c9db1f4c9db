"""Information of sensors beside the camera in the sliding Gramian of observability, see `coopenv.world.quality`."""

from typing import Any

import warp as wp

from coopenv.measurements.in_warp import first_three, last_three
from coopenv.measurements.kinds import MOST_ROWS, WarpFunctions
from coopenv.measurements.sensor import COMPARED_AT
from coopenv.world.quality import known_position
from coopenv.world.v2x import fresh
from coopenv.world.warp_internals import device_function

COMPARED_AT_SQUARE = wp.constant(COMPARED_AT**2)


@device_function
def clear_information(state: Any, world: int, vehicle: int, sensor: int):
    """Clear the information of a sensor at a tick."""
    zero = type(state.information_11[world, vehicle, sensor])()
    state.information_11[world, vehicle, sensor] = zero
    state.information_12[world, vehicle, sensor] = zero
    state.information_22[world, vehicle, sensor] = zero


@device_function
def is_known(model: Any, state: Any, world: int, vehicle: int, target: int, tick: int) -> bool:
    """Return whether a vehicle knows where a target is: by its map, or by a message."""
    return target < model.landmarks or fresh(model, state, world, vehicle, target - model.landmarks, tick)


@device_function
def known_rotation(model: Any, state: Any, world: int, vehicle: int, target: int):
    """Return the orientation of a known target."""
    if target < model.landmarks:
        return state.rotation[world, target]
    return state.inbox_rotation[world, vehicle, target - model.landmarks]


@device_function
def add_information(state: Any, world: int, vehicle: int, sensor: int, row: Any, weight: Any, R: Any, p: Any):
    """Add the information of a row of derivatives by the error of a sensor with axes R at p, see `accumulate_gramian`.

    The error of the state turns the map by phi and shifts it by d: the sensor turns by R^T phi about its own axes, and
    goes by d + phi x p along the map's.
    """
    shift = last_three(row, p)
    turn = R * first_three(row, p) + wp.cross(p, shift)
    state.information_11[world, vehicle, sensor] += weight * wp.outer(turn, turn)
    state.information_12[world, vehicle, sensor] += weight * wp.outer(turn, shift)
    state.information_22[world, vehicle, sensor] += weight * wp.outer(shift, shift)


def inform_of(functions: WarpFunctions) -> Any:
    """Return the Warp function that adds the information of a measurement; it does nothing without derivatives."""
    if functions.jacobian is None:

        @device_function
        def inform_nothing(model: Any, state: Any, world: int, vehicle: int, sensor: int, target: int, tick: int):
            """Leave the Gramian to other sensors."""

        return inform_nothing

    jacobian = functions.jacobian

    @device_function
    def inform(model: Any, state: Any, world: int, vehicle: int, sensor: int, target: int, tick: int):
        """Add the information of a measurement of a known target at the pose that the odometry predicts.

        As for bearings, the Gramian has ticks of its own, and neighbours count as known. The rows of a bearing of the
        camera are not divided by the distance: a row counts by the ratio of that bearing's error across, at the
        distance of the target, to its own.
        """
        own = model.sensor[sensor]
        if tick % model.observer.gramian_stride != 0:
            return
        if own.has_target == 1 and not is_known(model, state, world, vehicle, target, tick):
            return
        R_hat = state.estimate_rotation[world, vehicle]
        body = R_hat * state.increment_rotation[world, vehicle]
        ahead = state.estimate_position[world, vehicle] + state.increment_translation[world, vehicle]
        R = body * own.rotation
        p = R_hat * ahead + body * own.position
        z = p - p
        o = p - p
        turning = wp.cross(state.odometry_angular_velocity[world, vehicle], own.position)
        v = body * (state.odometry_velocity[world, vehicle] + turning)
        target_R = R
        square = p.dtype(COMPARED_AT_SQUARE)
        if own.has_target == 1:
            z = known_position(model, state, world, vehicle, target, target)
            target_R = known_rotation(model, state, world, vehicle, target)
            square = wp.length_sq(z - p)
        by_own, _ = jacobian(R, p, v, target_R, z, o)
        for row in range(MOST_ROWS):
            if own.weight[row] > p.dtype(0.0):
                add_information(state, world, vehicle, sensor, by_own[row], square * own.weight[row], R, p)

    return inform
