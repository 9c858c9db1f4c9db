"""Ticks from outside the simulation: kernels fill the state of worlds from recorded ticks, or from motion on the host.

A `Feed` writes the ticks of a recording, or of any source, to a record. What was measured and received is copied.
Everything after that is as in the simulation. In a co-simulation a program on the host moves the vehicles, and only
their poses and twists are copied; the world measures.
"""

from functools import cache
from typing import Any

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from coopenv.observers.recording import Recording
from coopenv.observers.sensed import MEASURED, Sensed, Truth
from coopenv.scenario import Scenario
from coopenv.scenario.difficulty import PARAMETERS
from coopenv.world.camera import MISSED, OUT_OF_VIEW, VISIBLE, camera_to_body, marker_position, sight_of
from coopenv.world.dynamics import move, remember
from coopenv.world.embedded import Source, arrange_world, begin_sensing, look_around, sense_nothing
from coopenv.world.model import Precision
from coopenv.world.nearby import NOT_A_NEIGHBOUR, sort_into_cells
from coopenv.world.odometry import measure_odometry
from coopenv.world.referee import ARRIVED, COLLIDED, depart, referee, touches_anything
from coopenv.world.reset import place_bodies, set_initial_estimate
from coopenv.world.route import UNDER_WAY
from coopenv.world.state import allocate, array, fields
from coopenv.world.v2x import draw_faults, transmit

BY_RADIO = wp.constant(-2)
"""Value in place of the ticks at which received messages were sent: the scenario's radio decides."""


@wp.func
def row_of(record: Any, tick: int) -> int:
    """Return the index of a tick in a record; a record of one tick holds the present one."""
    return wp.min(tick, record.last)


@wp.func
def recall_truth(model: Any, state: Any, record: Any, world: int, vehicle: int, row: int):
    """Write a vehicle's true pose and twist, NaN where they are not known."""
    agent = model.landmarks + vehicle
    state.rotation[world, agent] = record.true_rotation[row, vehicle]
    state.position[world, agent] = record.true_position[row, vehicle]
    state.velocity[world, agent] = record.true_velocity[row, vehicle]
    state.angular_velocity[world, agent] = record.true_angular_velocity[row, vehicle]


@wp.func
def forget_errors(state: Any, world: int, vehicle: int):
    """Make the lasting errors of a vehicle's sensors unknown: they are not recorded."""
    unknown = type(state.gyro_bias[world, vehicle])()
    for axis in range(3):
        unknown[axis] = unknown.dtype(wp.nan)
    state.odometry_scale[world, vehicle] = unknown[0]
    state.gyro_bias[world, vehicle] = unknown
    state.slip[world, vehicle] = type(state.slip[world, vehicle])(unknown[0], unknown[1])
    state.camera_turn[world, vehicle] = unknown
    state.camera_shift[world, vehicle] = unknown
    state.camera_focal[world, vehicle] = unknown[0]
    state.camera_delay[world, vehicle] = unknown[0]


@wp.func
def explain(model: Any, state: Any, world: int, vehicle: int):
    """Set why targets are not seen, as the simulation does, where the vehicle's pose and their place are known.

    The field of view of a camera without a pinhole model is unknown: a target that it does not see is out of view.
    """
    agent = model.landmarks + vehicle
    camera = model.camera[vehicle]
    R = state.rotation[world, agent]
    origin = state.position[world, agent] + R * camera.position
    to_camera = wp.transpose(R * camera_to_body(model, state, world, vehicle))
    for n in range(model.target_count[vehicle]):
        target = model.targets[vehicle, n]
        if state.sight[world, vehicle, target] == OUT_OF_VIEW:
            line = marker_position(model, state, world, target) - origin
            ray = to_camera * line
            if wp.isfinite(wp.dot(ray, ray)):
                sight = sight_of(model, state, world, vehicle, target, origin, line, ray)
                if sight == VISIBLE:
                    sight = OUT_OF_VIEW
                    if camera.pinhole == 1:
                        sight = MISSED
                state.sight[world, vehicle, target] = sight


@wp.func
def recall_readings(model: Any, state: Any, record: Any, world: int, vehicle: int, tick: int, row: int):
    """Write what the sensors beside the camera have measured."""
    for sensor in range(record.reading.shape[2]):
        for target in range(model.agents):
            reading = record.reading[row, vehicle, sensor, target]
            if wp.isfinite(reading[0]):
                state.reading[world, vehicle, sensor, target] = reading
                state.reading_tick[world, vehicle, sensor, target] = tick


@wp.func
def recall(model: Any, state: Any, record: Any, world: int, tick: int):
    """Write the measurements of a tick, the messages that arrive, and the known truth."""
    row = row_of(record, tick)
    for landmark in range(model.landmarks):
        state.position[world, landmark] = record.landmarks[row, landmark]
    for vehicle in range(model.vehicles):
        recall_truth(model, state, record, world, vehicle, row)
        state.increment_rotation[world, vehicle] = record.rotation[row, vehicle]
        state.increment_translation[world, vehicle] = record.translation[row, vehicle]
        state.odometry_velocity[world, vehicle] = record.velocity[row, vehicle]
        state.odometry_angular_velocity[world, vehicle] = record.angular_velocity[row, vehicle]
        state.odometry_samples[world, vehicle] = record.samples[row, vehicle]
        state.pan[world, vehicle] = record.pan[row, vehicle]
        state.bearing_age[world, vehicle] = record.bearing_age[row, vehicle]
        to_camera = wp.transpose(model.camera[vehicle].rotation)
        for target in range(model.agents):
            state.sight[world, vehicle, target] = NOT_A_NEIGHBOUR
        for n in range(model.target_count[vehicle]):
            target = model.targets[vehicle, n]
            state.sight[world, vehicle, target] = OUT_OF_VIEW
            if record.visible[row, vehicle, target] != wp.uint8(0):
                bearing = to_camera * record.bearings[row, vehicle, target]
                state.bearing[world, vehicle, target] = bearing
                state.bearing_tick[world, vehicle, target] = tick - record.bearing_lag[row, vehicle]
                state.sight[world, vehicle, target] = VISIBLE
        recall_readings(model, state, record, world, vehicle, tick, row)
    sort_into_cells(model, state, world)
    for vehicle in range(model.vehicles):  # now that all poses are those of this tick
        explain(model, state, world, vehicle)
    retransmit(model, state, record, world, tick, row)


@wp.func
def retransmit(model: Any, state: Any, record: Any, world: int, tick: int, row: int):
    """Write which messages arrive at a tick, by the source or else by the scenario's radio."""
    if record.inbox_tick[row, 0, 0] == BY_RADIO:
        for receiver in range(model.vehicles):
            transmit(model, state, world, receiver, tick)
        return
    for receiver in range(model.vehicles):
        for sender in range(model.vehicles):
            sent = record.inbox_tick[row, receiver, sender]
            is_new = sent > state.inbox_tick[world, receiver, sender]
            state.arriving[world, receiver, sender] = wp.where(is_new, sent, -1)


@wp.func
def resense(model: Any, state: Any, record: Any, world: int, tick: int):
    """Recall a tick and judge contacts and arrivals by its truth, where that is known."""
    for vehicle in range(model.vehicles):
        depart(model, state, world, vehicle)
    recall(model, state, record, world, tick)
    for vehicle in range(model.vehicles):
        referee(model, state, world, vehicle)


@wp.func
def rewind(model: Any, state: Any, record: Any, world: int):
    """Go to the start in one world: initial estimates are the record's, or drawn by the scenario."""
    if record.drawn != 0:
        state.seed[world] = record.key
        state.episode[world] = record.episode
        for k in range(record.parameter.shape[0]):
            state.parameter_set[world, k] = record.parameter[k]
    place_bodies(model, state, world)
    for vehicle in range(model.vehicles):
        forget_errors(state, world, vehicle)
        draw_faults(model, state, world, vehicle)
        position = record.true_position[0, vehicle]
        if wp.isfinite(position[0]):
            recall_truth(model, state, record, world, vehicle, 0)
        set_initial_estimate(model, state, world, vehicle)
        R = record.start_rotation[vehicle]
        if wp.isfinite(R[0, 0]):
            state.estimate_rotation[world, vehicle] = R
            state.estimate_position[world, vehicle] = wp.transpose(R) * record.start_position[vehicle]
    recall(model, state, record, world, 0)
    remember(model, state, world, 0)
    for vehicle in range(model.vehicles):
        state.collided[world, vehicle] = touches_anything(model, state, world, vehicle)


@cache
def record_struct(p: Precision) -> Any:
    """Return the Warp struct of a recording in one precision."""
    vec3, mat33 = p.vec3, p.mat33

    @wp.struct
    class Record:
        """K ticks, N vehicles, T targets, L landmarks, R sensors, Q parameters; lengths in m."""

        last: wp.int32  # K - 1
        drawn: wp.int32  # 1: the draws are those of the next fields
        key: wp.uint64
        episode: wp.uint32
        parameter: array("Q", p.scalar)
        rotation: array("KN", mat33)  # odometry increments
        translation: array("KN", vec3)
        velocity: array("KN", vec3)  # m/s, last odometry sample
        angular_velocity: array("KN", vec3)  # rad/s
        samples: array("KN", wp.int32)  # odometry samples so far
        bearings: array("KNT", vec3)  # body frame
        bearing_age: array("KN", p.scalar)  # s since the frame was exposed
        bearing_lag: array("KN", wp.int32)  # likewise, ticks
        visible: array("KNT", wp.uint8)
        pan: array("KN", p.scalar)  # rad
        reading: array("KNRT", p.vec6)  # of sensors beside the camera; NaN: not measured
        landmarks: array("KL", vec3)  # map
        inbox_tick: array("KNN", wp.int32)  # of sending, per receiver and sender; BY_RADIO: not known
        true_rotation: array("KN", mat33)  # NaN: not known
        true_position: array("KN", vec3)
        true_velocity: array("KN", vec3)  # body frame, m/s
        true_angular_velocity: array("KN", vec3)  # rad/s
        start_rotation: array("N", mat33)  # initial estimates; NaN: by the scenario
        start_position: array("N", vec3)  # map

    return Record


class Feed:
    """The record of a world whose ticks come from outside: all of a recording, or the present one of a live source."""

    def __init__(self, ticks: int, model: Any, scenario: Scenario, p: Precision, device: str) -> None:
        """Allocate room for ticks of a scenario."""
        sizes = {"K": ticks, "N": model.vehicles, "T": model.agents, "L": model.landmarks, "Q": len(PARAMETERS)}
        self._odometry_rate, self._sensors = scenario.rates.odometry, [s.label for s in scenario.sensors]
        self.record = allocate(record_struct(p), {**sizes, "R": len(self._sensors)}, device)
        self.record.last = ticks - 1
        self._views: dict[str, np.ndarray] = {}
        for name in fields(record_struct(p)):
            array = getattr(self.record, name)
            if name.startswith("start_"):
                array.fill_(np.nan)
            self._views[name] = array.numpy()

    def fill(self, tick: Sensed, before: Truth) -> None:
        """Write a tick, or all ticks of a recording as one, and the twists that lead there from the truth before."""
        truth = tick.truth or unknown_truth(tick)
        linear, angular = mean_twists(before, truth, tick.dt)
        age = tick.filled("odometry_age")
        sampled = (tick.index * tick.dt - age + 1e-9) * self._odometry_rate
        just_before = ~tick.filled("missing") & np.isfinite(age)  # the first tick
        samples = np.where((sampled >= 0.0) | just_before, np.floor(np.maximum(sampled, 0.0)) + 1, 0)
        lag = tick.filled("bearing_age") / tick.dt
        values = {
            **{name: tick.filled(name) for name in MEASURED},
            "samples": samples,
            "bearing_lag": np.round(np.minimum(lag, tick.index)),
            "inbox_tick": BY_RADIO if tick.inbox_tick is None else tick.inbox_tick,
            "true_rotation": truth.rotation,
            "true_position": truth.position,
            "true_velocity": linear,
            "true_angular_velocity": angular,
        }
        for name, value in values.items():
            self._views[name][...] = value
        self._views["reading"][...] = np.nan
        for d, name in enumerate(self._sensors):
            if name in tick.readings:
                size, targets = tick.readings[name].shape[-1], tick.readings[name].shape[-2]
                self._views["reading"][..., d, :targets, :size] = tick.readings[name]
                self._views["reading"][..., d, :targets, size:] = 0.0

    def fill_recording(self, recording: Recording) -> None:
        """Write all ticks of a recording, its initial estimates and its draws."""
        R, position = recording.truth.rotation, recording.truth.position
        before = Truth(np.concatenate([R[:1], R[:-1]]), np.concatenate([position[:1], position[:-1]]))
        self.fill(recording.stacked(self._odometry_rate), before)
        views = self._views
        views["start_rotation"][...], views["start_position"][...] = recording.start_rotation, recording.start_position
        views["parameter"][...] = 1.0
        if recording.drawn is not None:
            drawn = recording.drawn
            self.record.drawn, self.record.key, self.record.episode = 1, drawn.key, drawn.episode
            views["parameter"][...] = drawn.parameters
        if not self.record.rotation.device.is_cpu:
            for name, values in views.items():
                getattr(self.record, name).assign(values)


def unknown_truth(tick: Sensed) -> Truth:
    """Return the truth of a tick of which it is not known: NaN."""
    return Truth(np.full_like(tick.rotation, np.nan, dtype=float), np.full_like(tick.translation, np.nan, dtype=float))


def mean_twists(before: Truth, now: Truth, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean velocities (..., N, 3) over a tick of dt s, body frame, m/s and rad/s; NaN where truth is."""
    backwards = np.swapaxes(before.rotation, -1, -2)
    linear = (backwards @ (now.position - before.position)[..., None])[..., 0] / dt
    turn = backwards @ now.rotation
    known = np.isfinite(turn).all(axis=(-1, -2))
    angular = np.full_like(linear, np.nan)
    if known.any():
        angular[known] = Rotation.from_matrix(turn[known]).as_rotvec() / dt
    return linear, angular


RECORDED = Source("recorded", rewind, sense_nothing, resense, sense_nothing, record_struct, knows_truth=False)
"""Ticks of a recording, or of any other source that is not on the device."""


PLACED = wp.constant(2)
"""Value of `driven` of a vehicle that starts where the simulation draws it."""


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
        driven: array("WN", wp.int32)  # moved here, by commands, and its other entries are not read; or `PLACED`

    return HostMotion


@wp.func
def take_pose(model: Any, state: Any, motion: Any, world: int, vehicle: int):
    """Write the true pose and twist of a vehicle; the twist holds for all odometry samples of the tick."""
    recall_truth(model, state, motion, world, vehicle, world)
    state.speed[world, vehicle] = motion.speed[world, vehicle]
    state.turn[world, vehicle] = motion.steering[world, vehicle]
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
    place_bodies(model, state, world)
    for vehicle in range(model.vehicles):
        if motion.driven[world, vehicle] != PLACED:
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
    """Act as a simulation does; the moving program may know of past contacts and departures."""
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
