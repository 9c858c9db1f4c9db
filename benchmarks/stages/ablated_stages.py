"""A tick with stages switched off, one after the other, through what the world is handed and flags of its model."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from coopenv.observers.registry import find_embedded
from coopenv.observers.riccati import DEAD_RECKONING
from coopenv.observers.setups import start_covariances
from coopenv.scenario import load_scenario
from coopenv.world.dynamics import move
from coopenv.world.embedded import HOST, SIMULATED, Embedded, Source, sense_nothing
from coopenv.world.referee import referee
from coopenv.world.v2x import transmit
from coopenv.world.world import World

NEVER = 1 << 30
"""Ticks between what then does not happen."""


@wp.func
def without_camera(model: Any, state: Any, record: Any, world: int, vehicle: int, tick: int) -> None:
    """Look for contact, and receive."""
    referee(model, state, world, vehicle)
    transmit(model, state, world, vehicle, tick)


@wp.func
def contact(model: Any, state: Any, record: Any, world: int, vehicle: int, tick: int) -> None:
    """Look for contact."""
    referee(model, state, world, vehicle)


@wp.func
def without_odometry(model: Any, state: Any, record: Any, world: int, vehicle: int, tick: int) -> None:
    """Move, and count the odometry samples by which a driven vehicle moves."""
    move(model, state, world, vehicle, tick)
    time = wp.float64(tick) * model.camera_period + wp.float64(1.0e-9)
    state.odometry_samples[world, vehicle] = int(time / model.odometry_period) + 1


@wp.func
def no_arrangement(model: Any, state: Any, record: Any, world: int, tick: int) -> None:
    """Do nothing."""


@dataclass(frozen=True)
class Setting:
    """A tick with some of its stages."""

    observer: Embedded | None = None
    """Observer; None: the scenario's."""
    source: Source = SIMULATED
    overrides: Mapping[str, Any] | None = None
    """Changes of the scenario."""
    visibility: bool = True
    sending: bool = True
    gramian: bool = True

    def world(self, environment: str, overrides: Mapping[str, Any], worlds: int, dtype: str) -> World:
        """Return worlds with these stages, on one thread, reset."""
        scenario = load_scenario(environment, {**overrides, **(self.overrides or {})})
        observer = self.observer or find_embedded(scenario.observer.name) or HOST
        world = World(scenario, worlds, dtype, "cpu", 1, observer, start_covariances(scenario))
        world.source = self.source
        if not self.visibility:
            world.model.sensed = 0
        if not self.sending:
            world.model.radio.period = NEVER
        if not self.gramian:
            world.model.observer.gramian_stride = NEVER
        world.reset(range(worlds))
        return world


def ablated_settings() -> Iterator[tuple[str, Setting]]:
    """Yield the stages in the order in which they are switched off, each with what is left then."""
    setting = Setting()
    for stage, change in STAGES:
        setting = replace(setting, **change)
        yield stage, setting


def simulated(**stages: Any) -> Source:
    """Return the simulation with other stages."""
    return replace(SIMULATED, name="_".join(["simulated", *(stage.key for stage in stages.values())]), **stages)


STAGES: tuple[tuple[str, dict[str, Any]], ...] = (
    ("correction of the estimate", {"observer": DEAD_RECKONING}),
    ("noise and initial errors", {"overrides": {"noise.enabled": False}}),
    ("visibility (view, occlusion)", {"visibility": False}),
    ("bearings", {"source": simulated(look=without_camera)}),
    ("radio", {"sending": False}),
    ("Gramian", {"gramian": False}),
    ("prediction of the estimate", {"observer": HOST}),
    ("odometry", {"source": simulated(move=without_odometry, look=contact)}),
    ("contact and arrival", {"source": simulated(move=without_odometry, arrange=no_arrangement, look=sense_nothing)}),
    ("motion", {"source": simulated(move=sense_nothing, arrange=no_arrangement, look=sense_nothing)}),
)


def stepper(world: World, warm_up: int, advance: Callable[[int], None] | None = None) -> Callable[[int], float]:
    """Return a function that runs decisions and returns the CPU time in s per vehicle tick.

    Worlds start anew where the next decisions would reach the horizon, and then run for a while before time counts.

    Args:
        world: what is stepped.
        warm_up: decisions after a start that do not count.
        advance: runs the camera ticks of one decision; None: `world.advance`.
    """
    ticks, (W, N) = int(world.model.ticks_per_decision), world.actions.shape[:2]
    world.actions.assign(np.random.default_rng(0).uniform(-1, 1, (W, N, 2)).astype(world.precision.numpy))

    def run(decisions: int) -> None:
        for _ in range(decisions):
            (advance or world.advance)(ticks)

    def step(decisions: int) -> float:
        if int(world.view("tick")[0]) + decisions * ticks >= world.model.horizon_ticks:
            world.reset()
            run(warm_up)
        begin = time.process_time()
        run(decisions)
        return (time.process_time() - begin) / (decisions * ticks * int(W) * int(N))

    run(warm_up)
    return step
