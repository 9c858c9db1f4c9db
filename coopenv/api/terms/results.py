"""The results of a step: observation, reward, flags, quality of the estimate; one kernel per precision.

The kernel computes the values of all built-in terms and reads from a table which of them an observation holds. Values
of reward terms stand at the places of their rows in `coopenv.scenario.terms`, which `RewardPlace` gives by name. User
terms have kernels of their own (`own.py`), which read the records that this kernel writes for them.
"""

from enum import IntEnum
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from coopenv.api.terms.geometry import (
    entry_of_neighbour,
    estimate_on_route,
    furthest_so_far,
    neighbour_record,
    next_landmark,
    own_records,
    target_record,
)
from coopenv.api.terms.layout import Layout, entries_of, included_fields
from coopenv.api.terms.readings import ReadingEntry, reading_entries, write_readings
from coopenv.api.terms.records import (
    DEGREES,
    EIGENVALUE_FLOOR,
    SOURCES,
    Ego,
    MapLandmark,
    Neighbour,
    Target,
    TruthRecord,
    landmark_values,
    log10,
    neighbour_values,
    target_values,
    vehicle_values,
)
from coopenv.estimation.linalg import rotation_angle
from coopenv.scenario import Scenario, terms
from coopenv.scenario.terms import OBSERVATION_FIELDS, READINGS, REWARD_TERMS
from coopenv.world.model import DRIVEN, Precision
from coopenv.world.quality import (
    cholesky_of,
    gramian_smallest_eigenvalue,
    log_determinant,
    normalised_error_squared,
    observer_error,
    position_variance,
    targets_in_view,
)
from coopenv.world.referee import COLLIDED, OFF_ROUTE
from coopenv.world.route import UNDER_WAY, remaining_way
from coopenv.world.state import FLAG, NUMBER, array, whole
from coopenv.world.warp_internals import device_function


@cache
def results_struct(p: Precision) -> Any:
    """Return the Warp struct of step results in one precision."""
    scalar = p.scalar

    @wp.struct
    class StepResults:
        """W worlds, N vehicles, D observation entries, K reward terms."""

        observation: array("WND", wp.float32)
        terms: array("WNK", wp.float32)
        reward: array("WN", wp.float32)  # 0 for vehicles that had ended before, and right after a reset
        under_way: array("WN", wp.bool)  # had not ended before this step
        alive: array("WN", wp.bool)  # the same; with a team reward: some vehicle of the team had not
        terminated: array("WN", wp.bool)  # ended in this step; with a team reward: all of the team had
        truncated: array("WN", wp.bool)  # the world is over and this vehicle has not just terminated
        over: array("W", wp.int32)  # 1: at the horizon, or every vehicle has ended
        position_error: array("WN", scalar)  # m
        orientation_error: array("WN", scalar)  # deg
        nees: array("WN", scalar)
        log_determinant: array("WN", scalar)  # of P
        position_std: array("WN", scalar)  # m, sqrt of the trace of the position's covariance in the map
        protection_level: array("WN", wp.vec2d)  # m and rad, bounds that the observer states; inf: unknown, or none
        gramian_min_eigenvalue: array("WN", scalar)
        targets_in_view: array("WN", wp.int32)
        last_remaining: array("WN", scalar)  # m of the route to the goal, at the last step
        last_ended: array("WN", wp.int32)  # at the last step
        last_tick: array("WN", wp.int32)  # of the last step
        last_arrivals: array("WN", wp.int32)  # at the last step
        last_log_determinant: array("WN", scalar)  # at the last step
        furthest: array("WN", scalar)  # m, largest estimated progress along the route

    return StepResults


MEMORY = {
    "last_remaining": NUMBER._replace(of_truth=True),
    "last_ended": whole(-1, "last_outcome"),
    "last_arrivals": whole(0, 10**8),
    "last_tick": whole(0, "tick"),
    "last_log_determinant": NUMBER,
    "furthest": NUMBER,
    "over": FLAG,
}
"""Fields that carry over from one step to the next, and their rules in a saved state."""


@wp.struct
class Records:
    """The records that user terms read; without such terms the arrays are empty."""

    ego: array("WN", Ego)
    truth: array("WN", TruthRecord)
    target: array("WNT", Target)
    neighbour: array("WNM", Neighbour)
    landmark: array("WNL", MapLandmark)


@wp.struct
class Entry:
    """One number of an observation that a built-in field computes."""

    source: wp.int32  # its place among the values of its kind of record
    place: wp.int32  # in the observation, for the first target, neighbour or landmark
    stride: wp.int32  # between the places for one and for the next
    center: wp.float32  # the value that reads 0
    factor: wp.float32  # 1 / scale


@wp.struct
class TermTable:
    """The built-in terms of a scenario; user terms need records only."""

    vehicle: wp.array(dtype=Entry)
    target: wp.array(dtype=Entry)
    neighbour: wp.array(dtype=Entry)
    landmark: wp.array(dtype=Entry)
    reading: wp.array(dtype=ReadingEntry)
    weights: wp.array(dtype=wp.float32)  # of the built-in reward terms
    route: wp.bool  # whether anything needs the route as seen from the estimate
    clearance: wp.bool  # whether the closest approach to neighbours is asked for
    targets: wp.int32  # number of records of each kind that are needed
    neighbours: wp.int32
    landmarks: wp.int32


def results_table(scenario: Scenario, layout: Layout, device: str) -> Any:
    """Return the table of the built-in terms of a scenario; fields of the user only mark the records they need."""
    entries: dict[str, list[tuple[float, ...]]] = {"vehicle": [], "target": [], "neighbour": [], "landmark": []}
    needed = dict.fromkeys(entries, 0)
    groups, own = set(), False
    for name, row in included_fields(scenario).items():
        field, kept = layout[name], entries_of(row, scenario)
        if row.group == READINGS:
            continue
        needed[row.per] = field.shape[0] if row.per != "vehicle" else 0
        groups.add(field.group)
        if name not in OBSERVATION_FIELDS.built_in:
            own = True
            continue
        entries[row.per] += [
            (SOURCES[name] + entry, field.start + k, len(kept), field.center, 1.0 / field.scale)
            for k, entry in enumerate(kept)
        ]
    readings = np.array(reading_entries(scenario, layout), dtype=ReadingEntry.numpy_dtype())
    weights = scenario.reward.by_name
    own = own or bool(scenario.termination.own) or len(weights) > len(REWARD_TERMS.built_in)
    table = TermTable()
    for per, rows in entries.items():
        setattr(table, per, wp.array(np.array(rows, dtype=Entry.numpy_dtype()), dtype=Entry, device=device))
    table.reading = wp.array(readings, dtype=ReadingEntry, device=device)
    built_in = [weights[name] for name in REWARD_TERMS.built_in]
    table.weights = wp.array(built_in, dtype=wp.float32, device=device)
    table.clearance = "clearance" in groups
    table.route = own or table.clearance or "route" in groups
    table.targets, table.neighbours, table.landmarks = (needed[per] for per in ("target", "neighbour", "landmark"))
    return table


@device_function
def store_for_next_step(state: Any, results: Any, world: int, vehicle: int, remaining: Any, furthest: Any, tick: int):
    """Store the references of the next step; `assess` comes before."""
    results.last_arrivals[world, vehicle] = state.arrivals[world, vehicle]
    results.last_log_determinant[world, vehicle] = results.log_determinant[world, vehicle]
    results.furthest[world, vehicle] = furthest
    results.last_remaining[world, vehicle] = remaining
    results.last_ended[world, vehicle] = state.ended[world, vehicle]
    results.last_tick[world, vehicle] = tick


@device_function
def assess(model: Any, state: Any, results: Any, world: int, vehicle: int):
    """Compare the estimate with the truth and with its own covariance."""
    agent = model.landmarks + vehicle
    R = state.rotation[world, agent]
    position = state.position[world, agent]
    R_hat = state.estimate_rotation[world, vehicle]
    p_hat = state.estimate_position[world, vehicle]
    angle = rotation_angle(wp.transpose(R_hat) * R)
    results.position_error[world, vehicle] = wp.length(position - R_hat * p_hat)
    results.orientation_error[world, vehicle] = angle * type(angle)(DEGREES)
    I11, L21, I22 = cholesky_of(state.covariance[world, vehicle])
    e1, e2 = observer_error(R, position, R_hat, p_hat, state.coordinates[world, vehicle])
    results.nees[world, vehicle] = normalised_error_squared(I11, L21, I22, e1, e2)
    results.log_determinant[world, vehicle] = log_determinant(I11, I22)
    results.position_std[world, vehicle] = wp.sqrt(position_variance(state.covariance[world, vehicle], p_hat))
    level = state.protection_level[world, vehicle]
    if level[0] == wp.float64(0.0):  # none is stated
        level = wp.vec2d(wp.float64(wp.inf))
    results.protection_level[world, vehicle] = level
    results.gramian_min_eigenvalue[world, vehicle] = gramian_smallest_eigenvalue(model, state, world, vehicle)
    results.targets_in_view[world, vehicle] = targets_in_view(model, state, world, vehicle)


@device_function
def at_end(model: Any, state: Any, world: int) -> bool:
    """Return whether a world is at its horizon, or without further ticks."""
    return state.tick[world] >= model.horizon_ticks or state.exhausted[world] != 0


@device_function
def is_of_team(model: Any, state: Any, world: int, vehicle: int) -> bool:
    """Return whether a vehicle is driven and in this episode."""
    return model.motion.kind[model.landmarks + vehicle] == DRIVEN and state.ended[world, vehicle] >= UNDER_WAY


@device_function
def is_over(model: Any, state: Any, world: int) -> bool:
    """Return whether a world is at its end, or has no vehicle under way."""
    if at_end(model, state, world):
        return True
    for vehicle in range(model.vehicles):
        if state.ended[world, vehicle] == UNDER_WAY:
            return False
    return True


LOST = wp.constant(terms.LOST)
RewardValues = wp.types.vector(len(REWARD_TERMS.built_in), wp.float32)
RewardPlace: Any = IntEnum("RewardPlace", {name: place for place, name in enumerate(REWARD_TERMS.built_in)})
"""Place of a built-in reward term by its name, for kernels."""


@wp.func
def per_metre(ego: Ego, excess: wp.float32, most: wp.float32):
    """Return minus an excess in [0, most] for every metre gained, and `most` for every metre that is missed."""
    paid = wp.where(excess < most, wp.max(excess, 0.0), most)  # NaN costs the most
    return -(paid * ego.metres_gained + most * ego.metres_missed)


@wp.func
def reward_values(ego: Ego, truth: TruthRecord) -> RewardValues:
    """Return the values of the reward terms, without weights."""
    threshold, cap = ego.uncertainty_threshold, ego.uncertainty_cap
    shortfall = ego.observability_level - ego.soft_observability
    largest_shortfall = wp.max(ego.observability_level - ego.observability_floor, 0.0)
    values = RewardValues()
    values[RewardPlace.progress] = truth.progress
    values[RewardPlace.arrival] = wp.float32(ego.arrived)
    values[RewardPlace.collision] = wp.where(ego.outcome == COLLIDED, -1.0, 0.0)
    values[RewardPlace.off_route] = wp.where(ego.outcome == OFF_ROUTE, -1.0, 0.0)
    values[RewardPlace.control] = -ego.effort
    values[RewardPlace.time] = -ego.elapsed
    values[RewardPlace.radio] = -0.001 * wp.float32(ego.bytes_sent)
    values[RewardPlace.position_error] = -truth.position_error
    values[RewardPlace.orientation_error] = -(truth.orientation_error / DEGREES)
    scored = wp.min(truth.position_error, LOST) * truth.scored_time
    values[RewardPlace.scored_error] = -(scored + LOST * truth.lost_time)
    values[RewardPlace.position_uncertainty] = per_metre(ego, ego.position_std - threshold, cap)
    values[RewardPlace.position_error_per_metre] = per_metre(ego, truth.position_error - threshold, cap)
    values[RewardPlace.information_gain] = ego.information_gained
    values[RewardPlace.uncertainty] = -ego.log_determinant / 6.0
    values[RewardPlace.observability] = log10(wp.max(ego.gramian_min_eigenvalue, EIGENVALUE_FLOOR))
    values[RewardPlace.observability_shortfall] = per_metre(ego, shortfall, largest_shortfall)
    values[RewardPlace.visibility] = wp.float32(ego.targets_in_view) / wp.float32(wp.max(ego.possible_targets, 1))
    return values


@wp.func
def write_entries(
    out: wp.array3d(dtype=wp.float32), world: int, vehicle: int, n: int, entries: wp.array(dtype=Entry), values: Any
):
    """Write the entries of the n-th record, (value - center) / scale, clipped to [-1, 1]."""
    for k in range(entries.shape[0]):
        entry = entries[k]
        scaled = (values[entry.source] - entry.center) * entry.factor
        out[world, vehicle, entry.place + n * entry.stride] = wp.clamp(scaled, -1.0, 1.0)


def step_results(
    model: Any,
    state: Any,
    table: TermTable,
    records: Records,
    results: Any,
    fresh: wp.array(dtype=wp.int32),
    chosen: wp.array(dtype=wp.int32),
    first: int,
):
    """Fill the results of every vehicle from `first` on of the chosen worlds, one thread per (world, vehicle).

    `fresh` marks worlds that have just been reset: their memory of the last episode is cleared, and the reward is 0.
    """
    world, n = wp.tid()
    vehicle = first + n
    if chosen[world] == 0:
        return
    remaining = remaining_way(model, state, world, vehicle)
    assess(model, state, results, world, vehicle)
    if fresh[world] != 0:
        _, _, _, progress = estimate_on_route(state, world, vehicle)
        store_for_next_step(state, results, world, vehicle, remaining, progress, 0)
    over = is_over(model, state, world)
    # Over since the last step: no reward before a reset (each thread reads the memory of its own vehicle only).
    waiting = results.last_tick[world, vehicle] >= model.horizon_ticks
    alive = results.last_ended[world, vehicle] == UNDER_WAY and not waiting
    terminated = alive and state.ended[world, vehicle] != UNDER_WAY
    results.under_way[world, vehicle] = alive
    results.alive[world, vehicle] = alive
    results.terminated[world, vehicle] = terminated
    results.truncated[world, vehicle] = over and not terminated
    if vehicle == 0:
        results.over[world] = wp.where(over, 1, 0)
    ego, truth = own_records(model, state, results, world, vehicle, remaining, table.route)
    furthest = furthest_so_far(state, results, world, vehicle) + type(remaining)(ego.metres_gained)
    store_for_next_step(state, results, world, vehicle, remaining, furthest, state.tick[world])
    if records.ego.shape[1] > 0:
        records.ego[world, vehicle] = ego
        records.truth[world, vehicle] = truth

    terms = reward_values(ego, truth)
    total = float(0.0)
    for k in range(table.weights.shape[0]):
        results.terms[world, vehicle, k] = terms[k]
        total += table.weights[k] * terms[k]
    results.reward[world, vehicle] = wp.where(alive and fresh[world] == 0, total, 0.0)

    write_entries(results.observation, world, vehicle, 0, table.vehicle, vehicle_values(ego))
    for n in range(table.targets):
        target = target_record(model, state, world, vehicle, n)
        write_entries(results.observation, world, vehicle, n, table.target, target_values(target))
        if records.target.shape[2] > 0:
            records.target[world, vehicle, n] = target
    for n in range(table.neighbours):
        entry = entry_of_neighbour(model, state, world, vehicle, n)
        neighbour = neighbour_record(model, state, world, vehicle, entry)
        values = neighbour_values(ego, neighbour, table.clearance)
        write_entries(results.observation, world, vehicle, n, table.neighbour, values)
        if records.neighbour.shape[2] > 0:
            records.neighbour[world, vehicle, n] = neighbour
    write_readings(model, state, results.observation, world, vehicle, table.reading)
    landmark = MapLandmark()
    landmark.distance = -1.0
    for n in range(table.landmarks):
        landmark = next_landmark(model, state, world, vehicle, landmark)
        write_entries(results.observation, world, vehicle, n, table.landmark, landmark_values(landmark))
        if records.landmark.shape[2] > 0:
            records.landmark[world, vehicle, n] = landmark


def team_results(
    model: Any, state: Any, results: Any, least: int, own_share: wp.float32, chosen: wp.array(dtype=wp.int32)
):
    """Give every driven vehicle the team's reward, and an episode that ends with the world; one thread per world.

    The reward is the mean over the driven vehicles that are there or, if `least` is 1, the least of those under way,
    but for `own_share` of it, which is the vehicle's own.
    """
    world = wp.tid()
    if chosen[world] == 0:
        return
    there = int(0)  # noqa: RUF046
    total = float(0.0)
    smallest = float(wp.inf)
    for vehicle in range(model.vehicles):
        if is_of_team(model, state, world, vehicle):
            there += 1
            total += results.reward[world, vehicle]
            if results.under_way[world, vehicle]:
                smallest = wp.min(smallest, results.reward[world, vehicle])
    if smallest == wp.inf:
        return
    for vehicle in range(model.vehicles):
        if is_of_team(model, state, world, vehicle):
            team = wp.where(least == 1, smallest, total / float(there))
            own = results.reward[world, vehicle]
            results.reward[world, vehicle] = own_share * own + (1.0 - own_share) * team
            results.alive[world, vehicle] = True
            results.terminated[world, vehicle] = results.over[world] != 0 and not at_end(model, state, world)
            results.truncated[world, vehicle] = at_end(model, state, world)


def write_records(model: Any, state: Any, records: Records, results: Any, first: int):
    """Write the records `Ego` and `Truth` before the user's conditions are checked, one thread per (world, vehicle)."""
    world, n = wp.tid()
    vehicle = first + n
    assess(model, state, results, world, vehicle)
    remaining = remaining_way(model, state, world, vehicle)
    ego, truth = own_records(model, state, results, world, vehicle, remaining, True)
    records.ego[world, vehicle] = ego
    records.truth[world, vehicle] = truth
