"""The sliding observability Gramian of one vehicle, from what it measures and where it believes the targets to be."""

from __future__ import annotations

from typing import Any

import warp as wp

from coopenv.estimation.so3 import identity3, skew
from coopenv.world.camera import VISIBLE, marker_position
from coopenv.world.v2x import fresh


@wp.func
def usable(model: Any, state: Any, world: int, vehicle: int, target: int, tick: int) -> bool:
    """Return whether the observer can use this target now: seen, and its position known or heard."""
    if state.sight[world, vehicle, target] != VISIBLE:
        return False
    if target < model.landmarks:
        return True
    return fresh(model, state, world, vehicle, target - model.landmarks, tick)


@wp.func
def known_position(model: Any, state: Any, world: int, vehicle: int, target: int):
    """Return where a target is: a landmark's known place, or a neighbour's message (Rhat_j phat_j)."""
    if target < model.landmarks:
        return marker_position(model, state, world, target)
    sender = target - model.landmarks
    R = state.inbox_rotation[world, vehicle, sender]
    return state.inbox_position[world, vehicle, sender] + R * model.scene.marker[target]


@wp.func
def accumulate_gramian(model: Any, state: Any, world: int, vehicle: int, tick: int, dt: Any):
    """Add C^T C dt, dt being the time since the last sample, to the current block of the sliding Gramian.

    In map axes the transition matrix of A_i is the identity, so that blocks simply add up; the spectrum is the same
    as in the body frame of the window's start. C is taken at the estimate, as the observer itself knows it.
    """
    block = (tick // model.observer.block_ticks) % model.observer.blocks
    R = state.estimate_rotation[world, vehicle]
    p = state.estimate_position[world, vehicle]
    G11 = R - R
    G12 = R - R
    G22 = R - R
    time = dt - dt
    if tick % model.observer.block_ticks != 0:
        G11 = state.gramian_11[world, vehicle, block]
        G12 = state.gramian_12[world, vehicle, block]
        G22 = state.gramian_22[world, vehicle, block]
        time = state.gramian_time[world, vehicle, block]
    i3 = identity3(p)
    for n in range(model.target_count[vehicle]):
        target = model.targets[vehicle, n]
        if usable(model, state, world, vehicle, target, tick):
            b = R * (model.camera.rotation * state.bearing[world, vehicle, target])
            z = known_position(model, state, world, vehicle, target)
            m = wp.cross(z, b)
            G11 += dt * (wp.dot(z, z) * i3 - wp.outer(z, z) - wp.outer(m, m))
            G12 += dt * (skew(z) - wp.outer(m, b))
            G22 += dt * (i3 - wp.outer(b, b))
    state.gramian_11[world, vehicle, block] = G11
    state.gramian_12[world, vehicle, block] = G12
    state.gramian_22[world, vehicle, block] = G22
    state.gramian_time[world, vehicle, block] = time + dt


@wp.func
def sample_gramian(model: Any, state: Any, world: int, vehicle: int, tick: int):
    """Add this tick to the sliding Gramian when a sample is due."""
    if tick % model.observer.gramian_stride == 0:
        dt = type(model.observer.max_turn)(model.camera_period)
        accumulate_gramian(model, state, world, vehicle, tick, dt * type(dt)(model.observer.gramian_stride))
