"""The changing side of a world: one record of arrays with leading axes (world, agent or vehicle).

W worlds, A agents (landmarks first), N vehicles (as receivers, then as senders), K ticks of which poses are kept, M
odometry samples a tick, S slots of the radio's outbox, B blocks of the sliding Gramian, P points of a route, Q
parameters, U numbers of an action, Z bodies of the traffic, G cells of the grid, I items in it. Measurements and
messages have X entries, one per agent, and Y boxes, one per sender, or as many as are kept (V), see
`coopenv.world.nearby`; E agents that may be off on maps, C entries with a correlated error. R sensors beside the
camera; F measurements of a frame at most, in pairs of rows. L lanes of scratch: indexed by vehicle, shared by the
vehicles that one thread takes in turn.

A field of a record states its axes once, a letter each, and is allocated by them. It also states the rule of its saved
values; all rules are checked before anything is restored.
"""

import math
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from coopenv.base.errors import CoopenvError, shown
from coopenv.base.sections import LARGEST
from coopenv.estimation import Sight
from coopenv.estimation.poses import Array
from coopenv.estimation.validity import Fields, Mask, Rule, are_covariances, are_rotations, are_unit_vectors, everywhere
from coopenv.measurements.kinds import MOST_ROWS
from coopenv.scenario.difficulty import MOST, PARAMETERS
from coopenv.world.model import Precision
from coopenv.world.warp_internals import field_types, struct_of


def array(axes: str, dtype: Any, rule: Rule | None = None) -> Any:
    """Return the annotation of a struct's field: an array with these axes, a letter each, for example "WN".

    Its rule limits a saved state; numbers of a field without a rule have to be finite.
    """
    annotation: Any = wp.array(dtype=dtype, ndim=len(axes))
    annotation.axes, annotation.rule = axes, rule
    return annotation


def fields(record: Any) -> dict[str, Any]:
    """Return the arrays that a record's struct declares with `array`, by name: annotations with `axes` and `dtype`."""
    return {name: kind for name, kind in field_types(record).items() if hasattr(kind, "axes")}


PAIRS_OF_ROWS = MOST_ROWS // 2  # of a measurement
SCRATCH = "L"
"""The second axis of scratch."""


def size_of(record: Any, sizes: Mapping[str, int]) -> int:
    """Return how many bytes a record's arrays take."""
    arrays = fields(record).values()
    return sum(math.prod(sizes[a] for a in x.axes) * int(wp.types.type_size_in_bytes(x.dtype)) for x in arrays)


def allocate(record: Any, sizes: Mapping[str, int], device: str, shared: str = "", interleaved: bool = False) -> Any:
    """Return a record of zeros of a struct whose fields are declared with `array`; `sizes` are lengths by letter.

    Along the axes in `shared`, where they come second, all indices stand for the same row: functions of
    one vehicle can then index its rows by the vehicle without memory for the other vehicles. If `interleaved`, the
    first axis, that of the worlds, varies fastest in memory.
    """
    result = record()
    for name, field in fields(record).items():
        setattr(result, name, _zeros(field, sizes, device, shared, interleaved))
    return result


def _zeros(field: Any, sizes: Mapping[str, int], device: str, shared: str, interleaved: bool = False) -> Any:
    first, *inner = (sizes[axis] for axis in field.axes)
    is_shared = len(inner) > 0 and field.axes[1] in shared
    stored = [1, *inner[1:]] if is_shared else inner
    if interleaved:
        rows = wp.zeros([*stored, first], dtype=field.dtype, device=device)
        rows = rows.transpose([len(stored), *range(len(stored))])
    else:
        rows = wp.zeros([first, *stored], dtype=field.dtype, device=device)
    return repeated(rows, 1, inner[0]) if is_shared else rows


def interleaves_worlds(device: str) -> bool:
    """Return whether the worlds of a batch are interleaved in memory.

    They are on a GPU, where neighbouring threads step neighbouring worlds and read memory together (CUDA C++ Best
    Practices Guide, coalesced access): 65,536 worlds with `riccati` are twice as fast on an H100. A thread of the CPU
    reads one world after the other.
    """
    return device != "cpu"


def with_own_scratch(record: Any, sizes: Mapping[str, int]) -> Any:
    """Return a record on the CPU that shares everything with another one but its scratch, one lane of it."""
    result = struct_of(record)()
    for name, field in field_types(record).items():
        own = getattr(field, "axes", "")[1:2] == SCRATCH
        setattr(result, name, _zeros(field, sizes, "cpu", SCRATCH) if own else getattr(record, name))
    return result


class FieldPart:
    """One field of the entries of an array of structs, read and written as an array of its own."""

    def __init__(self, array: Any, path: tuple[str, ...]) -> None:
        self._array, self._path = array, path

    def numpy(self) -> np.ndarray:
        """Return it on the host, without a copy on the CPU."""
        return self._of(self._array.numpy())

    def assign(self, values: np.ndarray) -> None:
        """Overwrite it."""
        host = self._array.numpy()
        self._of(host)[...] = values
        if not self._array.device.is_cpu:
            self._array.assign(host)

    def _of(self, host: np.ndarray) -> np.ndarray:
        for name in self._path:
            host = host[name]
        return host


def parts(record: Any, struct: Any) -> dict[str, Any]:
    """Return the arrays of a record but scratch by name, and of arrays of structs every field by a name with dots."""
    arrays = {name: getattr(record, name) for name, field in fields(struct).items() if field.axes[1:2] != SCRATCH}
    paths = [(name, path) for name, array in arrays.items() for path in _paths(array.numpy().dtype)]
    return {".".join((name, *path)): FieldPart(arrays[name], path) if path else arrays[name] for name, path in paths}


def _paths(dtype: np.dtype) -> Iterator[tuple[str, ...]]:
    """Yield the path of every field of a structured type that has no fields itself."""
    if dtype.names is None:
        yield ()
    for name in dtype.names or ():
        yield from ((name, *path) for path in _paths(dtype[name]))


def repeated(row: Any, axis: int, count: int) -> Any:
    """Return a view of an array that repeats its single entry along an axis `count` times."""
    shape, strides = list(row.shape), list(row.strides)
    shape[axis], strides[axis] = count, 0
    result: Any = wp.array(ptr=row.ptr, shape=tuple(shape), strides=tuple(strides), dtype=row.dtype, device=row.device)
    result.row = row  # owns the memory
    return result


TOLERANCE = {np.dtype(np.float32): 1e-4, np.dtype(np.float64): 1e-6}
"""Tolerance of rotations and directions in a precision."""
LEAST_EIGENVALUE = {np.dtype(np.float32): -1e-4, np.dtype(np.float64): -1e-9}
"""Least eigenvalue of the correlations of a covariance, after rounding in a precision."""


def whole(low: int, high: int | str) -> Rule:
    """Return the rule of numbers within bounds; `high` may be a field of one number per world, or one of the model."""

    def holds(values: Array, fields: Fields, model: Any) -> Mask:
        most: Any = high
        if isinstance(high, str):
            of_world = fields[high].reshape(-1, *(1,) * (values.ndim - 1)) if high in fields else None
            most = getattr(model, high) if of_world is None else of_world
        return np.asarray((values >= low) & (values <= most))

    return Rule(f"in {low} .. {high}", holds)


def numbers(largest: float = LARGEST) -> Rule:
    """Return the rule of finite numbers of at most a size."""
    return Rule(f"finite and at most {largest:g}", lambda values, fields, model: np.abs(values) <= largest)


LEVELS = Rule("at least 0", lambda values, fields, model: values >= 0.0)


def _odometry_samples(values: Array, fields: Fields, model: Any) -> Mask:
    """Return flags of valid counts at the tick; sample m has been taken if m / rate is not later."""
    due = fields["tick"][:, None] * (model.camera_period * model.odometry_rate)
    return np.asarray((values >= 0) & (np.abs(values - due) <= 2.0))


ANYTHING = Rule("anything", lambda values, fields, model: np.ones(values.shape, dtype=bool))
FLAG = whole(0, 1)
NUMBER = numbers()
TRUTH = NUMBER._replace(of_truth=True)
TICK = whole(-1, "tick")  # a tick of the past or the present one; -1: never
ODOMETRY_SAMPLES = Rule("as many as at this tick", _odometry_samples)
ROUTE_COUNT = Rule(
    "0, or how many points a route may have",
    lambda values, fields, model: (values == 0) | ((values >= 2) & (values <= model.routes.points)),
)
ROUTE_DRAWN = Rule(
    "a number of a route, or -1",
    lambda values, fields, model: (values >= -1) & (values < max(model.routes.count.size, 1)),
)
TURN = Rule(
    "a steering angle of at most 1.6 rad, or a turn rate",
    lambda values, fields, model: np.abs(values) <= np.where(model.dynamics.numpy()["steers"] == 1, 1.6, LARGEST),
)
KEPT_AGENT = Rule(
    "an agent where one is kept, otherwise -1",
    lambda values, fields, model: np.where(
        np.arange(values.shape[-1]) < fields["kept_count"][..., None],
        (values >= 0) & (values < model.agents),
        values == -1,
    ),
)
KEPT_ORDER = Rule("a number of an entry", lambda values, fields, model: (values >= 0) & (values < model.kept))


def _lists(values: Array, fields: Fields, model: Any) -> Mask:
    """Return flags of grids in which cells and items link to no item twice, so that all lists end.

    A grid of a single cell has none.
    """
    named = np.sort(np.concatenate([fields["first_item"], values], axis=1), axis=1)
    once = np.all((named[:, 1:] > named[:, :-1]) | (named[:, 1:] < 0), axis=1) | (model.cells.across == 1)
    return np.asarray((values >= -1) & (values < values.shape[1]) & once[:, None])


FIRST_ITEM = Rule(
    "-1 or an item", lambda values, fields, model: (values >= -1) & (values < fields["next_item"].shape[1])
)
NEXT_ITEM = Rule("part of lists of items, each once", _lists)
DIRECTION = Rule(
    "a unit vector, or zero",
    lambda values, fields, model: are_unit_vectors(values, TOLERANCE[values.dtype]) | everywhere(values == 0.0, -1),
    axes=1,
)
ROTATION = Rule("a rotation", lambda values, fields, model: are_rotations(values, TOLERANCE[values.dtype]), axes=2)
COVARIANCE = Rule(
    "a covariance", lambda values, fields, model: are_covariances(values, LEAST_EIGENVALUE[values.dtype]), axes=2
)


def checked_state(
    values: Mapping[str, Any], arrays: Mapping[str, Any], rules: Mapping[str, Rule], model: Any, knows_truth: bool
) -> dict[str, Array]:
    """Return copies of a state's values in the types of the Warp arrays, by name, that they are to be written to.

    Numbers of a field without a rule have to be finite; `knows_truth` says whether the truth is always there.

    Raises:
        CoopenvError: a field is missing, has another shape or type, or an element breaks its rule.
    """
    fields = {name: _converted(name, values, target.numpy()) for name, target in arrays.items()}
    begun = has_begun(fields["start_rotation"])
    for name, array in fields.items():
        rule = rules.get(name) or (NUMBER if array.dtype.kind == "f" else ANYTHING)
        valid = rule.valid(array, fields, model, knows_truth)
        valid[~begun] |= rule.elements(array[~begun] == 0)
        if not valid.all():
            index = tuple(np.argwhere(~valid)[0].tolist())
            value = f": {shown(array[index].item())}" if array[index].ndim == 0 else ""
            raise CoopenvError(f"state: field '{name}' at {index}{value} is not {rule.must_be}")
    return fields


def has_begun(start_rotation: Array) -> Mask:
    """Return flags (W,) of worlds that have been reset; before, their fields are zero."""
    return np.asarray(start_rotation.reshape(len(start_rotation), -1).any(axis=1))


def _converted(name: str, values: Mapping[str, Any], like: Array) -> Array:
    if name not in values:
        raise CoopenvError(f"state: field '{name}' is missing: saved by another version of coopenv, or no saved state")
    try:
        given = np.asarray(values[name])
        if given.shape != like.shape:
            raise CoopenvError(f"state: field '{name}' has shape {given.shape}, expected {like.shape}")
        kinds = "fiu" if like.dtype.kind == "f" else "iub"
        with np.errstate(over="ignore"):
            array = np.array(given, dtype=like.dtype, order="C") if given.dtype.kind in kinds else None
    except (TypeError, ValueError, OverflowError) as error:
        raise CoopenvError(f"state: field '{name}': {error}") from None
    if array is None or (like.dtype.kind != "f" and (array != given).any()):
        raise CoopenvError(f"state: field '{name}' of {given.dtype} does not fit into {like.dtype}")
    return array


@cache
def state_struct(p: Precision) -> Any:
    """Return the Warp struct of the state in one precision."""
    scalar, vec2, vec3, vec5, vec6 = p.scalar, p.vec2, p.vec3, p.vec5, p.vec6
    mat33, mat66 = p.mat33, p.mat66

    @wp.struct
    class State:
        """All variables of the worlds. Lengths in m, angles in rad, map and body frames as named."""

        seed: array("W", wp.uint64, ANYTHING)
        episode: array("W", wp.uint32, ANYTHING)
        tick: array("W", wp.int32, whole(0, "horizon_ticks"))  # camera ticks since the reset
        exhausted: array("W", wp.int32, FLAG)  # 1: its source has no more ticks, the episode is over

        parameter: array("WQ", scalar, numbers(MOST**3))  # factors, see `coopenv.world.random`
        parameter_set: array("WQ", scalar, numbers(MOST))  # set by a reset for all later episodes; negative: drawn
        difficulty: array("W", scalar, numbers(1.0))  # in [0, 1], of the episodes to come
        present: array("WA", wp.int32, FLAG)  # 1: in the scene now; landmarks keep their place on the map
        pace: array("WA", scalar, numbers(2.0 * MOST**3))  # of prescribed motions
        entry_tick: array("WN", wp.int32, whole(0, 2**31 - 1))  # from which on an absent vehicle may appear

        route: array("WNP", vec3)  # x, y in m, map; arc length s from the first point, m
        route_count: array("WN", wp.int32, ROUTE_COUNT)  # points of it; 0: no goal
        route_drawn: array("WN", wp.int32, ROUTE_DRAWN)  # the scenario's route that it is drawn from; -1: none
        goal: array("WN", vec3)  # m, map
        arrivals: array("WN", wp.int32, whole(0, 10**8))  # at goals, in this episode

        start_rotation: array("WA", mat33, ROTATION)
        start_position: array("WA", vec3)  # map
        rotation: array("WA", mat33, ROTATION._replace(of_truth=True))  # truth, body to map
        position: array("WA", vec3, TRUTH)  # truth, map
        velocity: array("WA", vec3, TRUTH)  # truth, body, m/s
        angular_velocity: array("WA", vec3, TRUTH)  # truth, body, rad/s
        past_rotation: array("WAK", mat33, ROTATION._replace(of_truth=True))  # the same at a tick k, in slot k % K
        past_position: array("WAK", vec3, TRUTH)
        past_velocity: array("WAK", vec3, TRUTH)
        past_angular_velocity: array("WAK", vec3, TRUTH)
        speed: array("WN", scalar)  # forwards, m/s
        turn: array("WN", scalar, TURN)  # steering angle, rad, or turn rate, rad/s, by the kind of motion
        lateral_speed: array("WN", scalar)  # to the left, m/s
        pan: array("WN", scalar, numbers(3.15))  # angle by which the camera is turned to the left, rad
        action: array("WNU", scalar, numbers(1.001))  # of the current decision, in [-1, 1]
        command: array("WN", vec5)  # see `coopenv.motions.command`
        last_command: array("WN", vec5)  # of the decision before, in force during the dead time
        ended: array("WN", wp.int32, whole(-1, "last_outcome"))  # `Outcome`, then the scenario's own conditions
        collided: array("WN", wp.int32, FLAG)  # touching something now

        traffic_position: array("WZ", vec3)  # centres of boxes without identity, map
        traffic_rotation: array("WZ", mat33, ROTATION)  # body to map
        traffic_half: array("WZ", vec3)  # half of their edges, m; zero: not there

        sampled_velocity: array("WNM", vec3)  # truth at the odometry samples of the last tick, m/s, body
        sampled_angular_velocity: array("WNM", vec3)  # likewise, rad/s; of driven vehicles

        odometry_scale: array("WN", scalar, TRUTH)  # truth: the wheels read (1 + this) times the speed
        gyro_bias: array("WN", vec3, TRUTH)  # truth, rad/s
        slip: array("WN", vec2, TRUTH)  # truth: share that the wheels read too much, side slip angle in rad; zero: none
        camera_turn: array("WN", vec3, TRUTH)  # rotation vector of the camera in its frame, beside the nominal one
        camera_shift: array("WN", vec3, TRUTH)  # truth: of the camera in the body frame, from the nominal position, m
        camera_focal: array("WN", scalar, TRUTH)  # truth: its focal length is (1 + this) times the nominal one
        camera_delay: array("WN", scalar, TRUTH)  # truth: s by which its frames are older than the vehicle knows

        clock: array("WN", wp.int32, whole(-(10**8), 10**8))  # truth: ticks by which a vehicle's clock is ahead
        restart_tick: array("WN", wp.int32, whole(-1, 2**31 - 1))  # before which its observer restarts; -1: never
        lie_tick: array("WN", wp.int32, whole(-1, 2**31 - 1))  # from which on its messages are lies; -1: never
        lie_offset: array("WN", vec3)  # of its lie at that tick, m, map
        lie_velocity: array("WN", vec3)  # at which the offset grows from that tick on, m/s, map
        jammer_tick: array("WN", wp.int32, whole(-1, 2**31 - 1))  # from which on its jammer is on; -1: never
        map_tick: array("WNE", wp.int32, whole(-1, 2**31 - 1))  # from which on its map is wrong there; -1: never
        map_error: array("WNE", vec3)  # of a landmark's place on its map, m
        map_offset: array("WE", vec3)  # of a landmark's place on all maps from the start, m, by the map's accuracy
        broadcast_shift: array("WN", vec3)  # added to the position that it broadcasts at this tick, m, map
        broadcast_turn: array("WN", vec3)  # rotation vector by which the orientation that it broadcasts is turned

        odometry_velocity: array("WN", vec3)  # last sample, m/s
        odometry_angular_velocity: array("WN", vec3)  # last sample, rad/s
        odometry_samples: array("WN", wp.int32, ODOMETRY_SAMPLES)  # samples taken; sample m is at m / rate
        increment_rotation: array("WN", mat33, ROTATION)  # odometry over the last tick
        increment_translation: array("WN", vec3)  # m, in the body frame at the tick's start

        bearing: array("WNX", vec3, DIRECTION)  # camera to target, camera frame without pan, last measured
        bearing_tick: array("WNX", wp.int32, TICK)  # tick of that bearing; -1: never
        bearing_drift: array("WNC", vec3, TRUTH)  # truth: correlated error of that bearing, of standard deviation 1
        bearing_age: array("WN", scalar)  # s since the last frame was exposed, as the vehicle knows it
        sight: array("WNX", wp.uint8, whole(min(Sight), max(Sight)))  # values of `Sight`

        reading: array("WNRX", vec6)  # last value of a sensor beside the camera; of the map: in the first entry
        reading_tick: array("WNRX", wp.int32, TICK)  # tick of that value; -1: never
        information_11: array("WNR", mat33)  # C^T C of a sensor's measurements at this tick, map axes
        information_12: array("WNR", mat33)
        information_22: array("WNR", mat33)
        sensor_drift: array("WNR", vec6, TRUTH)  # truth: correlated error of its rows
        sensor_outage: array("WNR", wp.int32, FLAG)  # truth: 1: it measures nothing for a while

        outbox_rotation: array("WNS", mat33, ROTATION)  # Rhat as sent
        outbox_position: array("WNS", vec3)  # Rhat phat as sent, map
        outbox_std: array("WNS", scalar)  # standard deviation of that position, m; 0: none
        outbox_tick: array("WNS", wp.int32, TICK)  # -1: nothing sent in this slot
        outbox_seen: array("WNSH", wp.int32, TICK)  # ticks at which it last measured each vehicle, as sent; -1: never
        outbox_content: array("WNSH", wp.int32, whole(0, 2))  # per receiver: nothing, the pose alone, the whole report
        report_size: array("WN", wp.int32, whole(0, 10**6))  # bytes of the last report
        bytes_sent: array("WN", wp.int32, whole(0, 10**9))  # since the last decision
        arriving: array("WNY", wp.int32, TICK)  # per receiver and box: sending tick of the arriving message; -1: none
        inbox_rotation: array("WNY", mat33, ROTATION)  # per receiver and box
        inbox_position: array("WNY", vec3)  # map
        inbox_std: array("WNY", scalar)  # standard deviation of that position as sent, m
        inbox_tick: array("WNY", wp.int32, TICK)  # tick of sending; -1: nothing received
        inbox_stamp: array("WNY", wp.int32, TICK)  # the same by the receiver's clock
        inbox_pose_only: array("WNY", wp.int32, FLAG)  # whether the last message was the pose alone
        inbox_seen: array("WNY", wp.int32, TICK)  # likewise: when the sender last measured the receiver; -1: never

        estimate_rotation: array("WN", mat33, ROTATION)  # Rhat
        estimate_position: array("WN", vec3)  # phat, in the body frame
        covariance: array("WN", mat66, COVARIANCE)  # P over (2 lambda, p)
        coordinates: array("WN", wp.int32, whole(0, 2))  # in which it was stated, see `coopenv.world.quality`
        corrected_tick: array("WN", wp.int32, whole(0, "tick"))  # tick of the observer's last correction
        nis: array("WN", wp.float64, numbers(LARGEST**3))  # normalised innovation squared of its last tick, if given
        nis_dof: array("WN", wp.int32, whole(0, 10**6))  # degrees of freedom; 0: no correction, or not given
        protection_level: array("WN", wp.vec2d, LEVELS)  # horizontal, m, and angular, rad; inf: unknown, 0: not given

        gramian_11: array("WNB", mat33, numbers(LARGEST**3))  # block sums of int C^T C dt, map axes
        gramian_12: array("WNB", mat33, numbers(LARGEST**3))
        gramian_22: array("WNB", mat33, numbers(LARGEST**3))
        gramian_time: array("WNB", scalar)  # s, or m where the window is a distance
        gramian_distance_at: array("WN", scalar)  # m, `distance_driven` at its last sample: the most so far
        distance_driven: array("WN", scalar)  # m forwards since the reset, by odometry; where the window is a distance

        kept_count: array("WN", wp.int32, whole(0, "kept"))  # agents that are kept, see `coopenv.world.nearby`
        kept_agent: array("WNV", wp.int32, KEPT_AGENT)  # of each entry; -1: none
        kept_order: array("WNV", wp.int32, KEPT_ORDER)  # entries in the order of their agents
        crowded: array("WN", wp.int32, FLAG)  # 1: since `reset` there was no room for an agent in range

        first_item: array("WG", wp.int32, FIRST_ITEM)  # of each cell; scratch, like the next, see nearby.py
        next_item: array("WI", wp.int32, NEXT_ITEM)  # in the same cell; -1: none
        body_reach: array("W", scalar)  # m, the farthest point of a box from its item

    return State


LASTING_ERRORS = ("odometry_scale", "gyro_bias", "slip", "camera_turn", "camera_shift")
"""Fields with the true errors of a vehicle's sensors, see `coopenv.world.odometry`; beside `camera_focal`."""
FAULTS = ("clock", "restart_tick", "lie_tick", "jammer_tick", "map_tick", "map_error")
"""Fields of faults of a vehicle's clock, computer, messages and map, see `coopenv.world.v2x`."""


def state_sizes(model: Any, worlds: int) -> dict[str, int]:
    """Return the length of every axis of the state, and of an observer's memory, by its letter."""
    kept, A, N = model.kept, model.agents, model.vehicles
    near = {
        "V": kept,
        "H": 0 if kept else N,
        "X": kept or A,
        "Y": kept + 1 if kept else N,
        "E": 0 if kept and not model.map_errors else A,
    }
    near["C"] = near["X"] * model.correlated
    grid = {"G": model.cells.across**2, "I": model.agents + model.traffic}
    ticks = {"K": model.past, "M": model.samples_per_tick, "S": model.radio.slots, "B": model.observer.blocks}
    draws = {"P": model.routes.points, "Q": len(PARAMETERS), "Z": model.traffic, "U": model.action_size}
    sensors = 0 if model.sensor is None else model.sensor.shape[0]
    rows = {"R": sensors, "F": near["X"] * (1 + PAIRS_OF_ROWS * sensors)}
    return {"W": worlds, "A": A, "N": N, "L": N, **rows, **draws, **ticks, **grid, **near}


def allocate_state(model: Any, worlds: int, p: Precision, device: str, shared: str = "") -> Any:
    """Return a `State` of zeros, with an empty grid, for `worlds` worlds of a model; `shared` as for `allocate`."""
    state = allocate(state_struct(p), state_sizes(model, worlds), device, shared, interleaves_worlds(device))
    state.first_item.fill_(-1)
    state.next_item.fill_(-1)
    return state


def state_fields(p: Precision) -> dict[str, Any]:
    """Return the state's fields: name to Warp array type."""
    return fields(state_struct(p))


def overwrite(arrays: Mapping[str, Any], values: Mapping[str, np.ndarray]) -> None:
    """Overwrite device arrays by name, with values that `checked_state` has returned."""
    for name, target in arrays.items():
        target.assign(values[name])
