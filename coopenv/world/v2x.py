"""V2X: pose estimates travel with delay, period, loss and limited range."""

from typing import Any

import warp as wp

from coopenv.world.parameters import V2X_LOSS
from coopenv.world.random import RADIO, pair, random_words, uniform


@wp.func
def broadcast(model: Any, state: Any, world: int, vehicle: int, tick: int):
    """Put this vehicle's estimate (Rhat, Rhat phat) on the air if a message is due and it is there."""
    slot = tick % model.radio.slots
    sent = int(-1)
    if tick % model.radio.period == 0 and state.present[world, model.landmarks + vehicle] != 0:
        sent = tick
        R = state.estimate_rotation[world, vehicle]
        state.outbox_rotation[world, vehicle, slot] = R
        state.outbox_position[world, vehicle, slot] = R * state.estimate_position[world, vehicle]
    state.outbox_tick[world, vehicle, slot] = sent


@wp.func
def deliver(model: Any, state: Any, world: int, receiver: int, tick: int):
    """Receive what arrives at this tick from the neighbours that may be heard.

    With delay 0 a follower hears its leaders' estimates of this very tick; a sender later in the order than
    its receiver (possible only without the acyclic restriction) is heard one tick late.
    """
    here = state.position[world, model.landmarks + receiver]
    for n in range(model.target_count[receiver]):
        sender = model.targets[receiver, n] - model.landmarks
        if sender >= 0:
            lag = model.radio.delay
            if lag == 0 and model.rank[sender] > model.rank[receiver]:
                lag = int(1)
            due = tick - lag
            slot = wp.max(due, 0) % model.radio.slots
            if due >= 0 and state.outbox_tick[world, sender, slot] == due:
                heard = int(1)
                there = state.position[world, model.landmarks + sender]
                if wp.length(there - here) > model.radio.range:
                    heard = int(0)
                loss = model.radio.loss * state.parameter[world, V2X_LOSS]
                if loss > type(loss)(0.0):
                    words = random_words(state.seed[world], state.episode[world], tick, pair(receiver, sender), RADIO)
                    if uniform(words[0], loss) < loss:
                        heard = int(0)
                if heard == 1:
                    state.inbox_rotation[world, receiver, sender] = state.outbox_rotation[world, sender, slot]
                    state.inbox_position[world, receiver, sender] = state.outbox_position[world, sender, slot]
                    state.inbox_tick[world, receiver, sender] = due


@wp.func
def fresh(model: Any, state: Any, world: int, receiver: int, sender: int, tick: int) -> bool:
    """Return whether a message has been heard and is not older than the staleness limit."""
    sent = state.inbox_tick[world, receiver, sender]
    if sent < 0:
        return False
    return wp.float64(tick - sent) / model.camera_rate <= model.radio.staleness
