"""Measurements of sensors beside the camera: ranges, positions and the other kinds of `coopenv.measurements`.

A measurement enters a frame as pairs of its rows, which are gated and fused one by one like the two rows of a bearing.
The rows are divided by their standard deviations, so that every pair has unit noise. A row that was not measured, or
that a pair lacks, has residual 0 and derivative 0. The noise of a row includes the error of the target's propagation
since its report, and the variance of the linearisation error.

Functions with two overloads do nothing in worlds without such sensors.
"""

from collections.abc import Mapping
from typing import Any

import warp as wp

from coopenv.estimation.linalg import exp_so3, skew
from coopenv.measurements.in_warp import excess
from coopenv.measurements.kinds import WarpFunctions
from coopenv.measurements.sensor import functions_of
from coopenv.measurements.table import KINDS
from coopenv.observers.contract import MIN_BEARING_STD
from coopenv.observers.robust import constants
from coopenv.observers.robust.algebra import mat26d, mat33d, odometry_noise, vec2d, vec3d, vec6d
from coopenv.observers.robust.measurements import (
    HALF_ACCELERATION,
    frames_in,
    linearised_frames,
    relative_spread,
    set_bearing_measurement,
    set_measurement_of_target,
    step_since_report,
)
from coopenv.observers.robust.memory import (
    BearingFrame,
    Derivative,
    FusedReading,
    RobustMemory,
    RobustMemoryWithReadings,
)
from coopenv.world.model import STATIC
from coopenv.world.warp_internals import device_function, overload_of

BEARING, RANGE_BEARING, RELATIVE_POSE = ([*KINDS].index(name) for name in ("bearing", "range_bearing", "relative_pose"))


def rows_in(Memory: Any, kinds: Mapping[int, WarpFunctions]) -> Any:
    """Return the Warp function of the rows of kinds by their numbers, for one struct of the memory."""
    (number, functions), *others = kinds.items()
    predict, jacobian = functions.predict, functions.jacobian
    residual = functions.residual or excess
    further = rows_in(Memory, dict(others)) if others else None

    @device_function
    def last(
        memory: Memory, kind: int, value: Any, R: Any, p: Any, v: Any, target_R: Any, target_p: Any, target_v: Any
    ):
        """Return the rows of the last kind."""
        predicted = predict(R, p, v, target_R, target_p, target_v, vec6d())
        by_own, by_target = jacobian(R, p, v, target_R, target_p, target_v)
        return residual(value, predicted, p), predicted, by_own, by_target

    @device_function
    def rows(
        memory: Memory, kind: int, value: Any, R: Any, p: Any, v: Any, target_R: Any, target_p: Any, target_v: Any
    ):
        """Return residual, prediction, and derivatives by errors of the sensor and of the target."""
        if kind == number:
            return last(memory, kind, value, R, p, v, target_R, target_p, target_v)
        return further(memory, kind, value, R, p, v, target_R, target_p, target_v)

    return last if further is None else rows


rows_of_kind = rows_in(RobustMemoryWithReadings, {number: functions_of(number) for number in range(len(KINDS))})


@device_function
def turn_since_report(model: Any, state: Any, memory: Any, world: int, i: int, n: int, frame: BearingFrame):
    """Set the turn of the n-th measurement's target, a member, since its last fused report; and the variance of it."""
    member = memory.measurement[world, i, n].member
    step, stands = step_since_report(model, state, memory, world, i, frame.tick, member)
    turn = step.R
    age = wp.float64(frame.tick - stands) * model.camera_period
    away = wp.float64(HALF_ACCELERATION) * age * age
    memory.reading[world, i, n].turn = turn * exp_so3(memory.member[world, i, member].w * age)
    variance = odometry_noise(model, i, age)[0] * frames_in(age, frame.period) + away * away
    memory.reading[world, i, n].turn_variance = variance
    memory.reading[world, i, n].turn_known = 1


@device_function
def set_target(model: Any, state: Any, memory: Any, world: int, i: int, frame: BearingFrame, target: int) -> bool:
    """Set the target of the frame's next measurement; return whether the measurement is usable."""
    if not set_measurement_of_target(model, state, memory, world, i, frame, target, vec3d()):
        return False
    n = frame.bearings
    if target < model.landmarks:
        memory.reading[world, i, n].turn = mat33d(state.rotation[world, target])
        memory.reading[world, i, n].turn_known = wp.where(model.motion.kind[target] == STATIC, 1, 0)
    else:
        turn_since_report(model, state, memory, world, i, n, frame)
    return True


@device_function
def set_pairs(model: Any, state: Any, memory: Any, world: int, i: int, first: int, sensor: int, entry: int) -> int:
    """Set the pairs of rows of a measurement, of which the first has its target; return how many they are."""
    pairs = (model.sensor[sensor].rows + 1) // 2
    memory.reading[world, i, first].kind = model.sensor[sensor].kind
    memory.reading[world, i, first].rotation = mat33d(model.sensor[sensor].rotation)
    memory.reading[world, i, first].place = vec3d(model.sensor[sensor].position)
    memory.reading[world, i, first].value = vec6d(state.reading[world, i, sensor, entry])
    memory.reading[world, i, first].std = vec6d(model.sensor[sensor].counted)
    memory.measurement[world, i, first].is_reading = 1
    for part in range(pairs):
        n = first + part
        memory.measurement[world, i, n] = memory.measurement[world, i, first]
        memory.reading[world, i, n] = memory.reading[world, i, first]
        memory.reading[world, i, n].part = part
    return pairs


@device_function
def add_readings(memory: RobustMemory, model: Any, state: Any, world: int, i: int, frame: BearingFrame) -> int:
    """Return the number of the frame's measurements."""
    return frame.bearings


@overload_of(add_readings, subroutine=True)
def add_readings_with_sensors(memory: Any, model: Any, state: Any, world: int, i: int, frame: BearingFrame) -> int:
    """Add the measurements of other sensors to the frame's bearings; return the number of all."""
    own = BearingFrame()
    own.tick = frame.tick
    own.bearings = frame.bearings
    for sensor in range(model.sensor.shape[0]):
        last = memory.reading_tick[world, i, sensor]
        own.period = frame.period
        if last >= 0:
            own.period = wp.float64(frame.tick - last) * model.camera_period
        own.period = wp.clamp(own.period, frame.period, wp.max(wp.float64(constants.MEAN_TIME), frame.period))
        entries = wp.where(model.sensor[sensor].has_target == 1, model.target_count[i], 1)
        for k in range(wp.where(model.carries[i, sensor] == 1, entries, 0)):
            entry = wp.where(model.sensor[sensor].has_target == 1, model.targets[i, k], 0)
            if state.reading_tick[world, i, sensor, entry] == frame.tick:
                memory.reading_tick[world, i, sensor] = frame.tick
                n = own.bearings
                memory.reading[world, i, n] = FusedReading()
                memory.reading[world, i, n].period = own.period
                usable = bool(True)
                if model.sensor[sensor].has_target == 1:
                    usable = set_target(model, state, memory, world, i, own, entry)
                else:
                    set_bearing_measurement(memory, world, i, n, 0, vec3d(), vec3d(), wp.float64(0.0))
                    memory.reading[world, i, n].turn = wp.identity(3, wp.float64)
                if usable:
                    own.bearings += set_pairs(model, state, memory, world, i, n, sensor, entry)
    return own.bearings


@device_function
def bend_variances(memory: Any, world: int, i: int, n: int, along: Any, across: Any):
    """Return the variances of second-order errors, m^4, of rows across the line of sight and along it.

    They are to be multiplied by the squared derivatives by the target's position and divided by the squared distance.
    Ranges alone correct an error across them slowly, that of a landmark as well.
    """
    period = memory.reading[world, i, n].period
    lasting = frames_in(wp.float64(constants.CONSIDERED_LINEARISATION_TIME), period)
    frames = linearised_frames(memory, world, i, n, period)
    return vec2d(frames * along, wp.float64(0.5) * lasting * across) * across


@device_function
def row_scale(memory: Any, world: int, i: int, n: int, row: int, their_turn: Any, their_shift: Any, u: Any, bend: Any):
    """Return the inverse of a row's standard deviation, by its derivatives by the target and `bend_variances`."""
    std = wp.max(memory.reading[world, i, n].std[row], wp.float64(MIN_BEARING_STD))
    radial = wp.dot(u, their_shift)
    square = wp.length_sq(their_shift)
    variance = std * std + bend[0] * (square - radial * radial) + bend[1] * radial * radial
    variance += memory.measurement[world, i, n].variance * square
    variance += memory.reading[world, i, n].turn_variance * wp.length_sq(their_turn)
    return wp.float64(1.0) / wp.sqrt(variance)


@device_function
def linearise_reading(memory: RobustMemory, world: int, i: int, n: Any) -> bool:
    """Return whether its target is ahead."""
    return False


@overload_of(linearise_reading, subroutine=True)
def linearise_reading_with_sensors(memory: Any, world: int, i: int, n: Any) -> bool:
    """Linearise the n-th measurement, one of another sensor; return whether its target is ahead of the sensor."""
    member = memory.measurement[world, i, n].member
    point = memory.measurement[world, i, n].point
    own = memory.member[world, i, 0].pose
    mounted = memory.reading[world, i, n].rotation
    z = point
    target_R = memory.reading[world, i, n].turn
    theirs_R = wp.identity(3, wp.float64)
    if member > 0:
        theirs_R = memory.member[world, i, member].pose.R
        z = memory.member[world, i, member].pose.p + theirs_R * point
        target_R = theirs_R * target_R
    R = own.R * mounted
    place = memory.reading[world, i, n].place
    p = own.p + own.R * place
    v = own.R * (memory.belief[world, i].sample_v + wp.cross(memory.belief[world, i].sample_w, place))
    target_v = p - p
    if member > 0:
        target_v = theirs_R * (memory.member[world, i, member].v + wp.cross(memory.member[world, i, member].w, point))
    kind = memory.reading[world, i, n].kind
    value = memory.reading[world, i, n].value
    residual, predicted, by_own, by_target = rows_of_kind(memory, kind, value, R, p, v, target_R, z, target_v)
    line = z - p
    distance = wp.max(wp.length(line), wp.float64(1.0e-9))
    u = line / distance
    bend = vec2d()
    if kind != RELATIVE_POSE:  # which is linear in the positions
        to_own = wp.transpose(own.R)
        along, across = relative_spread(memory, world, i, n, to_own * theirs_R, to_own * u)
        bend = bend_variances(memory, world, i, n, along, across) / (distance * distance)
    arm = own.R * skew(place)
    reach = theirs_R * skew(point)
    H = mat26d()
    G = mat26d()
    r = vec2d()
    used = int(0)
    for k in range(2):
        row = wp.min(2 * memory.reading[world, i, n].part + k, 5)
        turn = vec3d(by_own[row, 0], by_own[row, 1], by_own[row, 2])
        shift = vec3d(by_own[row, 3], by_own[row, 4], by_own[row, 5])
        their_turn = vec3d(by_target[row, 0], by_target[row, 1], by_target[row, 2])
        their_shift = vec3d(by_target[row, 3], by_target[row, 4], by_target[row, 5])
        measured = wp.length_sq(turn) + wp.length_sq(shift) > wp.float64(0.0)
        known = memory.reading[world, i, n].turn_known == 1 or wp.length_sq(their_turn) == wp.float64(0.0)
        if measured and known:
            scale = row_scale(memory, world, i, n, row, their_turn, their_shift, u, bend)
            own_turn = mounted * turn - wp.transpose(arm) * shift
            own_shift = wp.transpose(own.R) * shift
            member_turn = memory.reading[world, i, n].turn * their_turn - wp.transpose(reach) * their_shift
            member_shift = wp.transpose(theirs_R) * their_shift
            r[k] = scale * residual[row]
            for j in range(3):
                H[k, j] = scale * own_turn[j]
                H[k, j + 3] = scale * own_shift[j]
                G[k, j] = scale * member_turn[j]
                G[k, j + 3] = scale * member_shift[j]
            used += 1
    memory.measurement[world, i, n].rows = used
    memory.derivative[world, i, n, 0] = Derivative(0, H)
    memory.measurement[world, i, n].by_map = -(H[:, 3:] * wp.transpose(own.R))
    memory.derivative[world, i, n, 1] = Derivative(wp.where(member > 0, member, -1), G)
    memory.derivative[world, i, n, 2] = Derivative(-1, mat26d())
    memory.derivative[world, i, n, 3] = Derivative(-1, mat26d())
    memory.measurement[world, i, n].residual = r
    memory.measurement[world, i, n].distance = wp.where(
        wp.ddot(by_target, by_target) > wp.float64(0.0), distance, wp.float64(wp.inf)
    )
    memory.measurement[world, i, n].noise = wp.float64(1.0)
    if kind == BEARING or kind == RANGE_BEARING:  # noqa: SIM109 (Warp has no tuples)
        return predicted[0] * value[0] + predicted[1] * value[1] + predicted[2] * value[2] > wp.float64(0.0)
    return True
