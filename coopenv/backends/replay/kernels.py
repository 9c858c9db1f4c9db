"""A tick of a recording: what was sensed and what arrived is copied, everything after that is as in the simulation."""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.world.camera import NOT_A_NEIGHBOUR, OUT_OF_VIEW, VISIBLE
from coopenv.world.collision import referee, touches_anything
from coopenv.world.embedded import Source
from coopenv.world.reset import believe, place_agent, place_vehicle
from coopenv.world.v2x import broadcast


@wp.func
def recall(model: Any, state: Any, record: Any, world: int, tick: int):
    """Write what was sensed at a tick, and the truth that is known."""
    for landmark in range(model.landmarks):
        state.position[world, landmark] = record.landmarks[tick, landmark]
    for vehicle in range(model.vehicles):
        agent = model.landmarks + vehicle
        state.rotation[world, agent] = record.true_rotation[tick, vehicle]
        state.position[world, agent] = record.true_position[tick, vehicle]
        state.velocity[world, agent] = record.true_velocity[tick, vehicle]
        state.angular_velocity[world, agent] = record.true_angular_velocity[tick, vehicle]
        state.increment_rotation[world, vehicle] = record.rotation[tick, vehicle]
        state.increment_translation[world, vehicle] = record.translation[tick, vehicle]
        state.odometry_velocity[world, vehicle] = record.velocity[tick, vehicle]
        state.odometry_angular_velocity[world, vehicle] = record.angular_velocity[tick, vehicle]
        state.odometry_samples[world, vehicle] = record.samples[tick]
        for target in range(model.agents):
            state.sight[world, vehicle, target] = NOT_A_NEIGHBOUR
        for n in range(model.target_count[vehicle]):
            target = model.targets[vehicle, n]
            state.sight[world, vehicle, target] = OUT_OF_VIEW
            if record.visible[tick, vehicle, target] != wp.uint8(0):
                bearing = wp.transpose(model.camera.rotation) * record.bearings[tick, vehicle, target]
                state.bearing[world, vehicle, target] = bearing
                state.bearing_tick[world, vehicle, target] = tick
                state.sight[world, vehicle, target] = VISIBLE


@wp.func
def redeliver(model: Any, state: Any, record: Any, world: int, receiver: int, tick: int):
    """Receive the messages that arrived at this tick when it was recorded."""
    for sender in range(model.vehicles):
        sent = record.inbox_tick[tick, receiver, sender]
        slot = wp.max(sent, 0) % model.radio.slots
        if sent > state.inbox_tick[world, receiver, sender] and state.outbox_tick[world, sender, slot] == sent:
            state.inbox_rotation[world, receiver, sender] = state.outbox_rotation[world, sender, slot]
            state.inbox_position[world, receiver, sender] = state.outbox_position[world, sender, slot]
            state.inbox_tick[world, receiver, sender] = sent


@wp.func
def resense(model: Any, state: Any, record: Any, world: int, tick: int):
    """Recall a tick and judge contacts and arrivals by its truth."""
    recall(model, state, record, world, tick)
    for vehicle in range(model.vehicles):
        referee(model, state, world, vehicle)


@wp.func
def rewind(model: Any, state: Any, record: Any, world: int):
    """Go to the start of the recording in one world."""
    state.tick[world] = 0
    for agent in range(model.agents):
        place_agent(model, state, world, agent)
    for vehicle in range(model.vehicles):
        place_vehicle(model, state, world, vehicle)
        believe(model, state, world, vehicle)
        R = record.start_rotation[vehicle]
        state.estimate_rotation[world, vehicle] = R
        state.estimate_position[world, vehicle] = wp.transpose(R) * record.start_position[vehicle]
    recall(model, state, record, world, 0)
    for vehicle in range(model.vehicles):
        state.collided[world, vehicle] = touches_anything(model, state, world, vehicle)
    for place in range(model.vehicles):
        vehicle = model.order[place]
        redeliver(model, state, record, world, vehicle, 0)
        broadcast(model, state, world, vehicle, 0)


RECORDED = Source("recorded", rewind, resense, redeliver, knows_truth=False)
"""Ticks of a recording."""
