"""Sensors beside the camera: which targets each one measures at a tick, and the values with their errors.

This stage of a tick stands between the source of ticks and the observers, in worlds with `[[sensors]]` alone. It is a
kernel per kind (`coopenv.measurements`). A user's kind is computed on the host (`coopenv.world.sensor_stage`): its
kernel writes which targets are measured, and the noise.
"""

import math
import warnings
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from coopenv.base.errors import ScenarioWarning, listed
from coopenv.estimation import Sight
from coopenv.estimation.poses import Array
from coopenv.measurements.bearing import Bearing
from coopenv.measurements.kinds import MOST_ROWS, WarpFunctions
from coopenv.measurements.sensor import number_of
from coopenv.scenario import Scenario
from coopenv.scenario.sensors import SensorSection
from coopenv.world.camera import behind_building, inverse_square_of, marker_position, occlusion
from coopenv.world.embedded import Nothing
from coopenv.world.launch import module_kernels
from coopenv.world.model import BLIND, IDEAL, Precision, model_struct
from coopenv.world.random import SENSOR, STREAMS_PER_SENSOR, gaussian_pair, pair, random_words, uniform
from coopenv.world.sensor_information import clear_information, inform_of
from coopenv.world.state import array, state_struct
from coopenv.world.step import is_active
from coopenv.world.warp_internals import device_function

WHITE, BIAS, DRIFT, OUTAGE, DETECTION = (wp.constant(wp.uint32(n)) for n in (0, 2, 4, 6, 7))
"""Streams of a sensor, from its first one on; the first three take two each."""
SKY = 1_000.0
"""Height (m) up to which buildings hide the sky."""
VISIBLE = wp.constant(wp.uint8(Sight.VISIBLE))


def sensor_entries(section: SensorSection, scenario: Scenario) -> dict[str, Any]:
    """Return the values of the model's `SensorValues`. Raises CoopenvError: its kind or its noise cannot be used."""
    kind, on, camera = section.made, float(scenario.noise.enabled), scenario.rates.camera
    outages, correlated, outliers = section.outages, section.correlated, section.outliers
    begin, end = outages.rate, 1.0 / outages.duration
    unused = (0, MOST_ROWS - kind.rows)
    return {
        "rotation": section.mounting,
        "position": section.position,
        "kind": number_of(section.kind, kind),
        "rows": kind.rows,
        "has_target": kind.has_target,
        "ratio": min(1.0, (section.rate or camera) / camera),
        "std": on * np.pad(section.white, unused),
        "counted": on * np.pad(section.counted(camera), unused),
        "weight": _weights(section, scenario),
        "bias": on * np.pad(section.by_row("bias", section.bias), unused),
        "correlated": on * np.pad(section.by_row("correlated.std", correlated.std), unused),
        "correlation": math.exp(-1.0 / (camera * correlated.time)),
        "outlier": on * np.pad(section.by_row("outliers.size", outliers.size), unused),
        "outlier_probability": outliers.probability,
        "miss_probability": section.miss_probability,
        "outage_share": begin / (begin + end),
        "outage_correlation": math.exp(-(begin + end) / camera),
        "range": section.range,
        "least_cosine": -2.0 if section.field_of_view is None else math.cos(min(section.field_of_view / 2.0, math.pi)),
        "occluded": section.occluded,
        "under_sky": kind.under_sky,
    }


def _weights(section: SensorSection, scenario: Scenario) -> Array:
    """Return the squares (6,) of the ratios of the error of a camera's bearing, rad, to those of the rows."""
    bearing, counted = scenario.noise.bearing.scale or Bearing.noise[0], section.counted(scenario.rates.camera)
    return np.pad(np.square(bearing / counted), (0, MOST_ROWS - len(counted)))


def sensor_tables(scenario: Scenario) -> dict[str, Any]:
    """Return the model's arrays of which vehicles have which sensors, and which agents these measure."""
    sensors, names, targets = scenario.sensors, scenario.vehicle_names, range(len(scenario.target_names))
    measures = [[section.measures(scenario, target) for target in targets] for section in sensors]
    for section, row in zip(sensors, measures, strict=True):
        if section.made.has_target and not any(row):
            towards = listed(section.made.towards if section.towards is None else section.towards)
            text = f"sensors.{section.label}.towards: no landmark or vehicle is among {towards}: it measures nothing"
            warnings.warn(text, ScenarioWarning, stacklevel=2)
    return {"carries": [[section.is_on(name) for section in sensors] for name in names], "measures": measures}


@wp.func
def stream_of(sensor: int, purpose: wp.uint32) -> wp.uint32:
    """Return a stream of random numbers of a sensor."""
    return SENSOR + wp.uint32(sensor) * STREAMS_PER_SENSOR + purpose


@wp.func
def normals(state: Any, world: int, index: int, subject: int, stream: wp.uint32, rows: int, empty: Any):
    """Return a vector of six numbers, of which at least the first `rows` are independent and standard normal.

    Numbers that no row needs are not drawn: most kinds have one to three rows.
    """
    one = empty.dtype(1.0)
    seed = state.seed[world]
    episode = state.episode[world]
    words = random_words(seed, episode, index, subject, stream)
    x, y = gaussian_pair(words[0], words[1], one)
    result = type(empty)(x, y, one - one, one - one, one - one, one - one)
    if rows > 2:
        x, y = gaussian_pair(words[2], words[3], one)
        result[2] = x
        result[3] = y
    if rows > 4:
        words = random_words(seed, episode, index, subject, stream + wp.uint32(1))
        x, y = gaussian_pair(words[0], words[1], one)
        result[4] = x
        result[5] = y
    return result


@wp.func
def is_due_at(ratio: wp.float64, tick: int) -> bool:
    """Return whether a tick is the nearest one to a measurement; number m is at tick m / ratio."""
    before = (wp.float64(tick) - wp.float64(0.5)) * ratio - wp.float64(1.0e-9)
    return wp.ceil(before + ratio) > wp.ceil(before)


@device_function
def carry_errors(model: Any, state: Any, world: int, vehicle: int, sensor: int, tick: int):
    """Draw the lasting errors and outages of one vehicle's sensor at tick 0, or carry them there from the last tick."""
    own = model.sensor[sensor]
    like = own.position
    one = like.dtype(1.0)
    zero = like.dtype(0.0)
    seed = state.seed[world]
    episode = state.episode[world]
    if wp.length_sq(own.correlated) > zero:
        fresh = normals(state, world, tick, vehicle, stream_of(sensor, DRIFT), own.rows, own.std)
        keeps = wp.where(tick == 0, zero, own.correlation)
        step = wp.cw_mul(own.correlated, fresh) * wp.sqrt(one - keeps * keeps)
        state.sensor_drift[world, vehicle, sensor] = keeps * state.sensor_drift[world, vehicle, sensor] + step
    if own.outage_share > zero:
        words = random_words(seed, episode, tick, vehicle, stream_of(sensor, OUTAGE))
        chance = own.outage_share
        if tick > 0:
            was = like.dtype(state.sensor_outage[world, vehicle, sensor])
            chance += (was - chance) * own.outage_correlation
        state.sensor_outage[world, vehicle, sensor] = wp.where(uniform(words[0], one) < chance, 1, 0)


@device_function
def forget_readings(state: Any, world: int, vehicle: int, sensor: int):
    """Clear what a sensor has measured, and its errors."""
    empty = type(state.sensor_drift[world, vehicle, sensor])()
    state.sensor_drift[world, vehicle, sensor] = empty
    state.sensor_outage[world, vehicle, sensor] = 0
    clear_information(state, world, vehicle, sensor)
    for entry in range(state.reading.shape[3]):
        state.reading[world, vehicle, sensor, entry] = empty
        state.reading_tick[world, vehicle, sensor, entry] = -1


@device_function
def is_in_view(model: Any, state: Any, world: int, vehicle: int, sensor: int, target: int, R: Any, origin: Any) -> bool:
    """Return whether a sensor at `origin` with axes R may measure a target, or the map, at this moment."""
    own = model.sensor[sensor]
    agent = model.landmarks + vehicle
    if model.sensing == IDEAL:
        return True
    if own.has_target == 0:
        up = type(origin)(origin.dtype(0.0), origin.dtype(0.0), origin.dtype(SKY))
        hides = own.occluded == 1 and own.under_sky == 1
        return not (hides and behind_building(model, origin, up, inverse_square_of(up)))
    line = marker_position(model, state, world, target) - origin
    distance = wp.length(line)
    if distance > own.range or (wp.transpose(R) * line)[0] < own.least_cosine * distance:
        return False
    if own.occluded == 0:
        return True
    return occlusion(model, state, world, agent, target, origin, line) == VISIBLE


@device_function
def is_detected(
    model: Any, state: Any, world: int, vehicle: int, sensor: int, target: int, tick: int, R: Any, origin: Any
) -> bool:
    """Return whether a measurement of a target, or of the map, is possible now and is not missed."""
    if not is_in_view(model, state, world, vehicle, sensor, target, R, origin):
        return False
    miss = model.sensor[sensor].miss_probability
    zero = miss - miss
    if model.sensing == IDEAL or miss <= zero:
        return True
    subject = pair(vehicle, target)
    words = random_words(state.seed[world], state.episode[world], tick, subject, stream_of(sensor, DETECTION))
    return uniform(words[0], miss) >= miss


@device_function
def noise_of(model: Any, state: Any, world: int, vehicle: int, sensor: int, target: int, tick: int):
    """Return the errors of the rows of one measurement."""
    own = model.sensor[sensor]
    like = own.position
    one = like.dtype(1.0)
    subject = pair(vehicle, target)
    white = normals(state, world, tick, subject, stream_of(sensor, WHITE), own.rows, own.std)
    noise = wp.cw_mul(own.std, white) + state.sensor_drift[world, vehicle, sensor]
    if wp.length_sq(own.bias) > one - one:
        noise += wp.cw_mul(own.bias, normals(state, world, 0, vehicle, stream_of(sensor, BIAS), own.rows, own.std))
    if own.outlier_probability > one - one:
        words = random_words(state.seed[world], state.episode[world], tick, subject, stream_of(sensor, DETECTION))
        if uniform(words[1], one) < own.outlier_probability:
            noise += own.outlier * -wp.log(uniform(words[2], one))
    return noise


@device_function
def point_velocity(model: Any, state: Any, world: int, agent: int, point: Any):
    """Return the velocity, map axes, m/s, of a point of a body in its frame, m."""
    turning = wp.cross(state.angular_velocity[world, agent], point)
    return state.rotation[world, agent] * (state.velocity[world, agent] + turning)


def _sensing(write: Any) -> Any:
    """Return the Warp function of a sensor's stage.

    `write` writes one measurement; its arguments are (model, state, drawn, world, vehicle, sensor, target, tick, R,
    origin), the last two axes and place of the sensor.
    """

    @device_function
    def sense_with(model: Any, state: Any, drawn: Any, world: int, vehicle: int, sensor: int, tick: int):
        """Take the measurements of one vehicle's sensor at a tick; the truth of this tick and the grid are in place."""
        own = model.sensor[sensor]
        agent = model.landmarks + vehicle
        if tick == 0:
            forget_readings(state, world, vehicle, sensor)
        if model.carries[vehicle, sensor] == 0:
            return
        if tick % model.observer.gramian_stride == 0:
            clear_information(state, world, vehicle, sensor)
        carry_errors(model, state, world, vehicle, sensor, tick)
        out = state.sensor_outage[world, vehicle, sensor] == 1 and model.sensing != IDEAL
        if out or model.sensing == BLIND or state.present[world, agent] == 0 or not is_due_at(own.ratio, tick):
            return
        R = state.rotation[world, agent] * own.rotation
        origin = state.position[world, agent] + state.rotation[world, agent] * own.position
        for n in range(wp.where(own.has_target == 1, model.target_count[vehicle], 1)):
            target = int(0)
            if own.has_target == 1:
                target = model.targets[vehicle, n]
                if model.measures[sensor, target] == 0 or state.present[world, target] == 0:
                    continue
            if is_detected(model, state, world, vehicle, sensor, target, tick, R, origin):
                write(model, state, drawn, world, vehicle, sensor, target, tick, R, origin)

    return sense_with


def _value_writer(functions: WarpFunctions) -> Any:
    """Return the Warp function that writes the value of a kind."""
    predict, sample, inform = functions.predict, functions.sample, inform_of(functions)

    @device_function
    def write_value(
        model: Any,
        state: Any,
        drawn: Any,
        world: int,
        vehicle: int,
        sensor: int,
        target: int,
        tick: int,
        R: Any,
        origin: Any,
    ):
        """Write a value with its errors."""
        own = model.sensor[sensor]
        predicted = predict(
            R,
            origin,
            point_velocity(model, state, world, model.landmarks + vehicle, own.position),
            state.rotation[world, target],
            marker_position(model, state, world, target),
            point_velocity(model, state, world, target, model.scene.marker[target]),
            type(own.std)(),
        )
        noise = noise_of(model, state, world, vehicle, sensor, target, tick)
        state.reading[world, vehicle, sensor, target] = sample(predicted, noise, origin)
        state.reading_tick[world, vehicle, sensor, target] = tick
        inform(model, state, world, vehicle, sensor, target, tick)

    return write_value


@device_function
def write_noise(
    model: Any,
    state: Any,
    drawn: Any,
    world: int,
    vehicle: int,
    sensor: int,
    target: int,
    tick: int,
    R: Any,
    origin: Any,
):
    """Write the noise of a measurement whose value is computed on the host."""
    drawn.noise[world, vehicle, sensor, target] = noise_of(model, state, world, vehicle, sensor, target, tick)
    drawn.measured[world, vehicle, sensor, target] = 1


@cache
def drawn_struct(p: Precision) -> Any:
    """Return the Warp struct of the measurements of users' kinds, in one precision."""

    @wp.struct
    class DrawnNoise:
        """Measurements that are made, without their values."""

        noise: array("WNRX", p.vec6)  # in the rows of the kind
        measured: array("WNRX", wp.int32)  # 1: a value of this tick is to be computed

    return DrawnNoise


@cache
def sensor_kernel(name: str, functions: WarpFunctions | None, p: Precision) -> wp.Kernel:
    """Return the kernel of the stage of a kind; without functions, of all kinds that the host computes."""
    Model, State, Hold = model_struct(p), state_struct(p), wp.array(dtype=wp.int32)
    Drawn = drawn_struct(p) if functions is None else Nothing
    sense_with = _sensing(write_noise if functions is None else _value_writer(functions))

    def measure(model: Model, state: State, drawn: Drawn, hold: Hold, sensor: int, begins: int, first: int, lanes: int):
        """Take the measurements of the next tick, or with `begins` those of tick 0 in the worlds of a mask.

        One thread per world and lane.
        """
        world, lane = wp.tid()
        tick = int(0)
        if begins == 1:
            if hold[world] == 0:
                return
        elif is_active(model, state, hold, world):
            tick = state.tick[world] + 1
        else:
            return
        for vehicle in range(first + lane, model.vehicles, lanes):
            sense_with(model, state, drawn, world, vehicle, sensor, tick)

    return module_kernels(f"sensor_{name}", p, measure, max_unroll=1)["measure"]
