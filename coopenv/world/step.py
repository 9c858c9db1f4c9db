"""The pipeline of one camera tick, fused into kernels for a given source of ticks and a given observer.

Each kernel is a closure over the Warp functions that it is made of. Its Warp module is named after the source and the
observer, so that a pair is compiled once per precision and machine.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import warp as wp

from coopenv.world.command import decide
from coopenv.world.embedded import Embedded, Now, Source, regular_tick
from coopenv.world.faults import forget_everything
from coopenv.world.launch import near_inlining
from coopenv.world.quality import sample_gramian
from coopenv.world.v2x import broadcast

Kernel = Callable[..., None]


@wp.func
def finish(model: Any, state: Any, world: int, tick: int):
    """Put a decision that is over on record, and count the tick."""
    if tick % model.ticks_per_decision == 0 or tick == model.horizon_ticks:
        for vehicle in range(model.vehicles):
            state.last_command[world, vehicle] = state.command[world, vehicle]
    state.tick[world] = tick


def _named(kernel: Kernel, *parts: str, **options: Any) -> Kernel:
    """Name a kernel after what it is made of, and keep the options of its module (see `launch.kernel`)."""
    kernel.__name__ = "_".join((kernel.__name__, *parts))
    kernel.options = options  # type: ignore[attr-defined]
    return kernel


@cache
def advance_kernel(source: Source, observer: Embedded) -> Kernel:
    """Return the kernel that runs whole ticks: sense -> receive -> estimate -> send, leaders before followers."""
    sense, deliver, estimate, send = source.sense, source.deliver, observer.estimate, observer.send

    def advance(
        model: Any,
        state: Any,
        memory: Any,
        record: Any,
        actions: wp.array3d(dtype=Any),
        hold: wp.array(dtype=wp.int32),
        ticks: int,
    ):
        """Advance by up to `ticks` camera ticks, not beyond the horizon; worlds marked in `hold` stay as they are."""
        world = wp.tid()
        count = wp.where(hold[world] == 0, wp.min(ticks, model.horizon_ticks - state.tick[world]), 0)
        if count > 0:
            decide(model, state, actions, world)
        for _ in range(count):
            tick = state.tick[world] + 1
            now = regular_tick(model, tick)
            sense(model, state, record, world, tick)
            for place in range(model.vehicles):
                vehicle = model.order[place]
                deliver(model, state, record, world, vehicle, tick)
                estimate(model, state, memory, world, vehicle, now)
                sample_gramian(model, state, world, vehicle, tick)
                broadcast(model, state, world, vehicle, tick)
                send(model, state, memory, world, vehicle, tick)
            finish(model, state, world, tick)

    return _named(advance, source.name, observer.name, **observer.options)


@cache
def restart_kernel(source: Source, observer: Embedded) -> Kernel:
    """Return the kernel that starts the next episode."""
    begin, start, send = source.begin, observer.start, observer.send

    def restart(model: Any, state: Any, memory: Any, record: Any, mask: wp.array(dtype=wp.int32)):
        """Start the next episode in every world whose mask is set."""
        world = wp.tid()
        if mask[world] != 0:
            state.episode[world] = state.episode[world] + wp.uint32(1)
            begin(model, state, record, world)
            for place in range(model.vehicles):
                vehicle = model.order[place]
                start(model, state, memory, world, vehicle)
                send(model, state, memory, world, vehicle, 0)

    return _named(restart, source.name, observer.name, **{**near_inlining(), **observer.options})


@cache
def revive_kernel(observer: Embedded) -> Kernel:
    """Return the kernel that lets vehicles lose all and start anew; it runs before a decision, where any may."""
    start = observer.start

    def revive(model: Any, state: Any, memory: Any, hold: wp.array(dtype=wp.int32), ticks: int):
        """Start the observers anew whose vehicle's restart falls into the next ticks. One thread per world."""
        world = wp.tid()
        if hold[world] == 0:
            tick = state.tick[world]
            for place in range(model.vehicles):
                vehicle = model.order[place]
                begun = state.restart_tick[world, vehicle]
                if begun > tick and begun <= tick + ticks:
                    state.restart_tick[world, vehicle] = tick + 1
                    forget_everything(model, state, world, vehicle)
                    start(model, state, memory, world, vehicle)

    return _named(revive, observer.name, **{**near_inlining(), **observer.options})


def decide_kernel(model: Any, state: Any, actions: wp.array3d(dtype=Any), hold: wp.array(dtype=wp.int32)):
    """Make commands of actions, where `advance` would. One thread per world."""
    world = wp.tid()
    if hold[world] == 0 and state.tick[world] < model.horizon_ticks:
        decide(model, state, actions, world)


@cache
def sense_kernel(source: Source) -> Kernel:
    """Return the kernel of the first stage alone. The stages' `active` (W,) marks the worlds that take part."""
    sense_tick = source.sense

    def sense(model: Any, state: Any, record: Any, active: wp.array(dtype=wp.int32)):
        """Move and measure. One thread per world; the tick has its number from the start."""
        world = wp.tid()
        if active[world] != 0:
            sense_tick(model, state, record, world, state.tick[world] + 1)

    return _named(sense, source.name)


@cache
def deliver_kernel(source: Source) -> Kernel:
    """Return the kernel that lets one vehicle receive."""
    deliver_messages = source.deliver

    def deliver(model: Any, state: Any, record: Any, active: wp.array(dtype=wp.int32), vehicle: int):
        """Receive. One thread per world."""
        world = wp.tid()
        if active[world] != 0:
            deliver_messages(model, state, record, world, vehicle, state.tick[world] + 1)

    return _named(deliver, source.name)


@cache
def start_kernel(observer: Embedded) -> Kernel:
    """Return the kernel that starts one vehicle's observer. It and the next two serve observers that are plug-ins."""
    start_vehicle = observer.start

    def start(model: Any, state: Any, memory: Any, vehicle: int):
        """Start the observer. One thread per world."""
        start_vehicle(model, state, memory, wp.tid(), vehicle)

    return _named(start, observer.name, **observer.options)


@cache
def estimate_kernel(observer: Embedded) -> Kernel:
    """Return the kernel that lets one vehicle estimate."""
    estimate_pose = observer.estimate

    def estimate(
        model: Any,
        state: Any,
        memory: Any,
        vehicle: int,
        tick: wp.array(dtype=wp.int32),
        period: wp.array(dtype=wp.float64),
        due: wp.array(dtype=wp.int32),
    ):
        """Take a tick, see `Now`. One thread per world."""
        world = wp.tid()
        now = Now()
        now.tick = tick[world]
        now.period = period[world]
        now.due = due[world] != 0
        estimate_pose(model, state, memory, world, vehicle, now)

    return _named(estimate, observer.name, **observer.options)


@cache
def send_kernel(observer: Embedded) -> Kernel:
    """Return the kernel that lets one vehicle put a message on the air."""
    send_message = observer.send

    def send(model: Any, state: Any, memory: Any, vehicle: int, tick: wp.array(dtype=wp.int32)):
        """Send. One thread per world."""
        world = wp.tid()
        send_message(model, state, memory, world, vehicle, tick[world])

    return _named(send, observer.name, **observer.options)


def broadcast_kernel(model: Any, state: Any, active: wp.array(dtype=wp.int32), vehicle: int):
    """Take what has been written as the vehicle's estimate, and send it. One thread per world."""
    world = wp.tid()
    if active[world] != 0:
        tick = state.tick[world] + 1
        sample_gramian(model, state, world, vehicle, tick)
        broadcast(model, state, world, vehicle, tick)


def finish_kernel(model: Any, state: Any, active: wp.array(dtype=wp.int32)):
    """End the tick. One thread per world."""
    world = wp.tid()
    if active[world] != 0:
        finish(model, state, world, state.tick[world] + 1)
