"""V2X: pose estimates travel with delay, period, loss and limited range."""

from typing import Any

import warp as wp

from coopenv.world.device_function import device_function
from coopenv.world.faults import alter, as_told, content_tick, stamp
from coopenv.world.parameters import V2X_LOSS
from coopenv.world.random import RADIO, pair, random_words, uniform


@device_function
def broadcast(model: Any, state: Any, world: int, vehicle: int, tick: int):
    """Put this vehicle's estimate (Rhat, Rhat phat) on the air if a message is due and it is there."""
    slot = tick % model.radio.slots
    sent = int(-1)
    if tick % model.radio.period == 0 and state.present[world, model.landmarks + vehicle] != 0:
        sent = tick
        R = state.estimate_rotation[world, vehicle]
        told_R, told = as_told(model, state, world, vehicle, R, R * state.estimate_position[world, vehicle])
        state.outbox_rotation[world, vehicle, slot] = told_R
        state.outbox_position[world, vehicle, slot] = told
    state.outbox_tick[world, vehicle, slot] = sent


@device_function
def put_into_inbox(model: Any, state: Any, world: int, receiver: int, sender: int, sent: int, tick: int):
    """Let a receiver hear at a tick what a sender put on the air at another one, unless it has heard something newer.

    By clocks that are off it may seem so.
    """
    believed = stamp(model, state, world, receiver, sender, sent, tick)
    if model.clocks == 1 and believed <= state.inbox_stamp[world, receiver, sender]:
        return
    slot = content_tick(model, state, world, sender, sent) % model.radio.slots
    state.inbox_rotation[world, receiver, sender] = state.outbox_rotation[world, sender, slot]
    state.inbox_position[world, receiver, sender] = state.outbox_position[world, sender, slot]
    state.inbox_tick[world, receiver, sender] = sent
    state.inbox_stamp[world, receiver, sender] = believed


@device_function
def transmit(model: Any, state: Any, world: int, tick: int):
    """Decide which messages arrive at a tick, by the scenario's radio: write when they were sent, -1 where none does.

    With delay 0 a follower receives its leaders' estimates of this very tick; a sender later in the order than
    its receiver (possible only without the acyclic restriction) is received one tick late.
    """
    for receiver in range(model.vehicles):
        here = state.position[world, model.landmarks + receiver]
        for sender in range(model.vehicles):
            state.arriving[world, receiver, sender] = -1
        for n in range(model.target_count[receiver]):
            sender = model.targets[receiver, n] - model.landmarks
            if sender >= 0:
                lag = model.radio.delay
                if lag == 0 and model.rank[sender] > model.rank[receiver]:
                    lag = int(1)
                due = tick - lag
                there = state.position[world, model.landmarks + sender]
                if due >= 0 and due % model.radio.period == 0 and not wp.length(there - here) > model.radio.range:
                    if not is_lost(model, state, world, receiver, sender, tick):
                        state.arriving[world, receiver, sender] = due


@device_function
def is_lost(model: Any, state: Any, world: int, receiver: int, sender: int, tick: int) -> bool:
    """Draw whether the radio loses the message that arrives at a receiver at a tick."""
    loss = model.radio.loss * state.parameter[world, V2X_LOSS]
    if loss > type(loss)(0.0):
        words = random_words(state.seed[world], state.episode[world], tick, pair(receiver, sender), RADIO)
        return uniform(words[0], loss) < loss
    return False


@device_function
def deliver(model: Any, state: Any, world: int, receiver: int, tick: int):
    """Receive what arrives at this tick, where it has been sent, and decide what the own message claims."""
    alter(model, state, world, receiver, tick)
    for sender in range(model.vehicles):
        sent = state.arriving[world, receiver, sender]
        if sent >= 0 and state.outbox_tick[world, sender, sent % model.radio.slots] == sent:
            put_into_inbox(model, state, world, receiver, sender, sent, tick)


@device_function
def fresh(model: Any, state: Any, world: int, receiver: int, sender: int, tick: int) -> bool:
    """Return whether a message has been heard and is not older than the staleness limit."""
    sent = state.inbox_stamp[world, receiver, sender]
    if sent < 0:
        return False
    return wp.float64(tick - sent) / model.camera_rate <= model.radio.staleness
