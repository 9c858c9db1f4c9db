"""The pipeline of one camera tick as kernels of a source of ticks, and kernels of an observer.

An episode starts with `begin`. A decision is `decide`, then per tick `sense` (the source) and `follow` (the observer:
receive, estimate, send). Neither knows the other, so that each is compiled once per precision. For a small observer of
simulated worlds (`Embedded.fused`) one kernel, `advance`, runs all ticks of a decision without leaving a world.

A thread takes a world with all its vehicles, or every `lanes`-th vehicle of a world. The stages of `sense` are then
launches of their own, and so is `finish`. `follow` is launched once, because received messages were sent at earlier
ticks; or, without a delay of the radio, level by level (`Turns`). On a GPU it is a kernel for each part of a large
observer: one for all takes minutes to compile and several kilobytes of stack per thread.
"""

from functools import cache
from typing import Any

import warp as wp

from coopenv.world.dynamics import decide as make_commands
from coopenv.world.embedded import Embedded, Now, Source, regular_tick
from coopenv.world.launch import module_kernels
from coopenv.world.model import Precision, model_struct
from coopenv.world.nearby import sender_of
from coopenv.world.quality import sample_gramian, state_deviation
from coopenv.world.state import array, state_struct
from coopenv.world.v2x import broadcast as broadcast_estimate
from coopenv.world.v2x import count_bytes, deliver, forget_everything
from coopenv.world.warp_internals import device_function, host_only, lanes_guest

Kernels = dict[str, wp.Kernel]
"""Kernels by name."""


@device_function
def is_active(model: Any, state: Any, hold: Any, world: int) -> bool:
    """Return whether a world takes part in the next tick: it is not marked in `hold`, nor at its horizon."""
    return hold[world] == 0 and state.tick[world] < model.horizon_ticks


@device_function
def finish_tick(model: Any, state: Any, world: int, tick: int):
    """Record a decision that is over, and count the tick."""
    if tick % model.ticks_per_decision == 0 or tick == model.horizon_ticks:
        for vehicle in range(model.vehicles):
            state.last_command[world, vehicle] = state.command[world, vehicle]
    state.tick[world] = tick


@wp.struct
class Turns:
    """The order in which the vehicles of a world take their turns in a tick: level by level, then leaders first.

    A vehicle is one level above the highest sender whose message of this very tick arrives at it.
    """

    vehicle: array("WN", wp.int32)  # in this order
    first: array("WD", wp.int32)  # places in it at which levels begin, N behind the last level; D = N + 1
    level: array("WN", wp.int32)  # of each vehicle; scratch of `find_levels`
    due: array("WF", wp.int32)  # the levels that `follow` takes: from the first of F = 2 numbers up to the second


MOVE, ARRANGE, LOOK = 1, 2, 4
SENSE = MOVE | ARRANGE | LOOK
"""Stages of `sense`, from the source of ticks."""


@cache
def _sense_tick(source: Source) -> Any:
    """Return the Warp function that moves some of the vehicles to a tick and measures."""
    move, arrange, look = source.move, source.arrange, source.look

    @device_function
    def sense_tick(model: Any, state: Any, record: Any, world: int, tick: int, stages: int, lane: int, lanes: int):
        """Run stages of one world, for every `lanes`-th vehicle from `lane` on."""
        if stages & MOVE != 0:
            for vehicle in range(lane, model.vehicles, lanes):
                move(model, state, record, world, vehicle, tick)
        if stages & ARRANGE != 0:
            arrange(model, state, record, world, tick)
        if stages & LOOK != 0:
            for vehicle in range(lane, model.vehicles, lanes):
                look(model, state, record, world, vehicle, tick)

    return sense_tick


@device_function
def receive_messages(model: Any, state: Any, memory: Any, world: int, vehicle: int, now: Any):
    """Let one vehicle receive."""
    deliver(model, state, world, vehicle, now.tick)


@cache
def _sending(send: Any) -> Any:
    """Return the Warp function that ends the tick of one vehicle with a function of its observer that sends."""

    @device_function
    def sending(model: Any, state: Any, memory: Any, world: int, vehicle: int, now: Any):
        """Send the estimate."""
        sample_gramian(model, state, world, vehicle, now.tick)
        broadcast_estimate(model, state, world, vehicle, now.tick)
        state_deviation(state, world, vehicle, now.tick % model.radio.slots)
        send(model, state, memory, world, vehicle, now.tick)
        count_bytes(model, state, world, vehicle, now.tick)

    return sending


@cache
def _in_turn(*functions: Any) -> Any:
    """Return the Warp function that calls functions of one vehicle's tick in turn."""
    if len(functions) == 1:
        return functions[0]
    first, others = functions[0], _in_turn(*functions[1:])

    @device_function
    def in_turn(model: Any, state: Any, memory: Any, world: int, vehicle: int, now: Any):
        """Call the first function, then the others."""
        first(model, state, memory, world, vehicle, now)
        others(model, state, memory, world, vehicle, now)

    return in_turn


def _follow(observer: Embedded, p: Precision, *parts: Any) -> Any:
    """Return the function of the kernel that runs parts of a tick."""
    Model, State, Memory, Hold = model_struct(p), state_struct(p), observer.memory, wp.array(dtype=wp.int32)
    follow_tick = _in_turn(*parts)

    def follow(model: Model, state: State, memory: Memory, hold: Hold, turns: Turns, ends: int, first: int, lanes: int):
        """Let every vehicle of the levels that are due receive, estimate and send. One thread per world and lane.

        With `ends` the tick ends thereby.
        """
        world, lane = wp.tid()
        if is_active(model, state, hold, world):
            now = regular_tick(model, state.tick[world] + 1)
            begin = turns.first[world, turns.due[world, 0]] + first + lane
            for place in range(begin, turns.first[world, turns.due[world, 1]], lanes):
                follow_tick(model, state, memory, world, turns.vehicle[world, place], now)
            if ends == 1:
                finish_tick(model, state, world, now.tick)

    return follow


@cache
def follow_kernels(observer: Embedded, p: Precision, in_parts: bool) -> list[wp.Kernel]:
    """Return the kernels that are `follow` in turn: one, or if `in_parts`, one per part in modules of their own."""
    if not in_parts or len(observer.parts) == 1:
        return [observer_kernels(observer, p)["follow"]]
    parts = [(f.func.__name__, [f]) for f in observer.parts]
    parts[0][1].insert(0, receive_messages)
    parts[-1][1].append(_sending(observer.send))
    of_part = {name: _follow(observer, p, *functions) for name, functions in parts}
    modules = [module_kernels(f"{observer.name}_{name}", p, f, **observer.options) for name, f in of_part.items()]
    return [module["follow"] for module in modules]


def _begin(source: Source, p: Precision) -> Any:
    """Return the function of the kernel that starts the next episode in the worlds of the mask.

    Observers start then. It shares most functions with the kernels that sense, and so their modules.
    """
    Model, State, Record, begin_episode = model_struct(p), state_struct(p), source.record(p), source.begin

    def begin(model: Model, state: State, record: Record, mask: wp.array(dtype=wp.int32)):
        """Begin, and send the first pose estimates. One thread per world."""
        world = wp.tid()
        if mask[world] != 0:
            state.episode[world] = state.episode[world] + wp.uint32(1)
            begin_episode(model, state, record, world)
            for place in range(model.vehicles):
                vehicle = model.order[place]
                deliver(model, state, world, vehicle, 0)
                broadcast_estimate(model, state, world, vehicle, 0)

    return begin


@cache
def source_kernels(source: Source, p: Precision) -> Kernels:
    """Return `begin`, `decide` and `sense`, the stages before observers; worlds marked in `hold` stay as they are."""
    Model, State, Record, Hold = model_struct(p), state_struct(p), source.record(p), wp.array(dtype=wp.int32)
    sense_tick = _sense_tick(source)

    def decide(model: Model, state: State, actions: wp.array3d(dtype=p.scalar), hold: Hold):
        """Make commands of actions. One thread per world."""
        world = wp.tid()
        if is_active(model, state, hold, world):
            make_commands(model, state, actions, world)

    def sense(model: Model, state: State, record: Record, hold: Hold, stages: int, first: int, lanes: int):
        """Move to the next tick and measure. One thread per world and lane."""
        world, lane = wp.tid()
        if is_active(model, state, hold, world):
            sense_tick(model, state, record, world, state.tick[world] + 1, stages, first + lane, lanes)

    return module_kernels(f"sense_{source.name}", p, _begin(source, p), decide, sense, max_unroll=1)


@cache
def observer_kernels(observer: Embedded, p: Precision) -> Kernels:
    """Return the stages of an embedded observer: `follow`, `start` and `revive`; and float64 stages of one vehicle.

    The latter serve observers that are plug-ins (`coopenv.observers.kernel_observer`).
    """
    Model, State, Memory, Hold = model_struct(p), state_struct(p), observer.memory, wp.array(dtype=wp.int32)
    start_vehicle, send_message, estimate_pose = observer.start, observer.send, _in_turn(*observer.parts)
    follow = _follow(observer, p, receive_messages, *observer.parts, _sending(observer.send))
    follow = host_only(follow) if len(observer.parts) > 1 else follow

    def start(model: Model, state: State, memory: Memory, mask: Hold):
        """Start the observers of the worlds whose episode has just begun. One thread per world."""
        world = wp.tid()
        if mask[world] != 0:
            for place in range(model.vehicles):
                vehicle = model.order[place]
                start_vehicle(model, state, memory, world, vehicle)
                send_message(model, state, memory, world, vehicle, 0)

    def revive(model: Model, state: State, memory: Memory, hold: Hold, ticks: int):
        """Restart the observers of vehicles whose restart falls into the next ticks. One thread per world."""
        world = wp.tid()
        if hold[world] == 0:
            tick = state.tick[world]
            for place in range(model.vehicles):
                vehicle = model.order[place]
                begun = state.restart_tick[world, vehicle]
                if begun > tick and begun <= tick + ticks:
                    state.restart_tick[world, vehicle] = tick + 1
                    forget_everything(model, state, world, vehicle)
                    start_vehicle(model, state, memory, world, vehicle)

    @host_only
    def start_one(model: Model, state: State, memory: Memory, vehicle: int):
        """Start one vehicle's observer. One thread per world."""
        start_vehicle(model, state, memory, wp.tid(), vehicle)

    @host_only
    def estimate_one(
        model: Model,
        state: State,
        memory: Memory,
        vehicle: int,
        tick: wp.array(dtype=wp.int32),
        period: wp.array(dtype=wp.float64),
        due: wp.array(dtype=wp.int32),
    ):
        """Let one vehicle take a tick, see `Now`. One thread per world."""
        world = wp.tid()
        now = Now()
        now.tick = tick[world]
        now.period = period[world]
        now.due = due[world] != 0
        estimate_pose(model, state, memory, world, vehicle, now)

    @host_only
    def send_one(model: Model, state: State, memory: Memory, vehicle: int, tick: wp.array(dtype=wp.int32)):
        """Let one vehicle send. One thread per world."""
        world = wp.tid()
        send_message(model, state, memory, world, vehicle, tick[world])

    of_one_vehicle = (start_one, estimate_one, send_one) if p.name == "float64" else ()
    return module_kernels(observer.name, p, follow, start, revive, *of_one_vehicle, **observer.options)


@cache
def fused_kernels(source: Source, observer: Embedded, p: Precision, lanes: str | None = None) -> Kernels:
    """Return `begin`, and `advance`, which runs whole decisions of a source and an observer.

    With `lanes` the latter takes several worlds at once, at least `coopenv.lanes.WIDTH`; "cell": their grid has a
    single cell, "grid": any number. Few worlds start at once.
    """
    Model, State, Memory, Record = model_struct(p), state_struct(p), observer.memory, source.record(p)
    sense_tick, follow_tick = _sense_tick(source), _in_turn(receive_messages, *observer.parts, _sending(observer.send))

    def advance(
        model: Model,
        state: State,
        memory: Memory,
        record: Record,
        actions: wp.array3d(dtype=p.scalar),
        hold: wp.array(dtype=wp.int32),
        ticks: int,
    ):
        """Advance by up to `ticks` camera ticks, not beyond the horizon. One thread per world."""
        world = wp.tid()
        count = wp.where(hold[world] == 0, wp.min(ticks, model.horizon_ticks - state.tick[world]), 0)
        if count > 0:
            make_commands(model, state, actions, world)
        for _ in range(count):
            tick = state.tick[world] + 1
            now = regular_tick(model, tick)
            sense_tick(model, state, record, world, tick, SENSE, 0, 1)
            for place in range(model.vehicles):
                follow_tick(model, state, memory, world, model.order[place], now)
            finish_tick(model, state, world, tick)

    name, options = f"{source.name}_{observer.name}", dict(observer.options)
    if lanes is not None:
        stages = (*source.in_lanes, deliver, *observer.parts, sample_gramian, broadcast_estimate, count_bytes)
        name, functions = f"{name}_{lanes}_in_lanes", (f.func.__name__ for f in stages)
        options["in_lanes"] = lanes_guest().lanes_option("advance", functions, grid=lanes == "grid")
    return module_kernels(name, p, _begin(source, p), advance, **options)


@cache
def host_kernels(p: Precision) -> Kernels:
    """Return the stages around observers on the host: `receive`, `broadcast` and `finish`; and `find_levels`."""
    Model, State, Hold = model_struct(p), state_struct(p), wp.array(dtype=wp.int32)

    def receive(model: Model, state: State, hold: Hold, vehicle: int):
        """Let one vehicle receive. One thread per world."""
        world = wp.tid()
        if is_active(model, state, hold, world):
            deliver(model, state, world, vehicle, state.tick[world] + 1)

    def broadcast(model: Model, state: State, hold: Hold, vehicle: int):
        """Use the written values as the vehicle's estimate, and broadcast it. One thread per world."""
        world = wp.tid()
        if is_active(model, state, hold, world):
            tick = state.tick[world] + 1
            sample_gramian(model, state, world, vehicle, tick)
            broadcast_estimate(model, state, world, vehicle, tick)
            state_deviation(state, world, vehicle, tick % model.radio.slots)

    def finish(model: Model, state: State, hold: Hold):
        """End the tick. One thread per world."""
        world = wp.tid()
        if is_active(model, state, hold, world):
            finish_tick(model, state, world, state.tick[world] + 1)

    def find_levels(model: Model, state: State, hold: Hold, turns: Turns):
        """Sort the vehicles by their levels in the next tick. One thread per world."""
        world = wp.tid()
        if not is_active(model, state, hold, world):
            return
        for n in range(model.vehicles + 1):
            turns.first[world, n] = 0
        for place in range(model.vehicles):
            vehicle = model.order[place]
            level = int(0)
            for box in range(state.arriving.shape[2]):
                if state.arriving[world, vehicle, box] == state.tick[world] + 1:
                    level = wp.max(level, turns.level[world, sender_of(model, state, world, vehicle, box)] + 1)
            turns.level[world, vehicle] = level
            turns.first[world, level + 1] += 1
        for n in range(model.vehicles):
            turns.first[world, n + 1] += turns.first[world, n]
        for place in range(model.vehicles):
            level = turns.level[world, model.order[place]]
            turns.vehicle[world, turns.first[world, level]] = model.order[place]
            turns.first[world, level] += 1
        for back in range(model.vehicles):  # now they are where levels end
            turns.first[world, model.vehicles - back] = turns.first[world, model.vehicles - back - 1]
        turns.first[world, 0] = 0

    return module_kernels("host", p, receive, broadcast, finish, find_levels)
