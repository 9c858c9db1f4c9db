"""Episodes recorded with what vehicles measure, for logs (`coopenv.sources.mcap` writes them) and comparisons."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from coopenv.api.engine import Engine
from coopenv.base.errors import CoopenvError, is_of_user
from coopenv.episode import RECORDED, Episode, Origin, Views
from coopenv.evaluation.episodes import play
from coopenv.observers.arrays import recorded_names
from coopenv.observers.faults import Interference, interference_of, stacked
from coopenv.observers.recording import Drawn, Recording
from coopenv.observers.sensed import MEASURED, Sensed, Truth, is_due
from coopenv.policies import Policy, load_policy
from coopenv.scenario import ScenarioLike
from coopenv.sources.base import Backend
from coopenv.sources.sources import open_backend

OF_RECORDING = ("position", "rotation", "estimate_position", "estimate_rotation", "inbox_tick")
"""Fields of an engine that a `Recording` is made of, beside what the vehicles measured."""


def source_of(engine: Engine, name: str, seed: int | None, policy: str) -> Origin:
    """Return the heading of an episode; a recording has no seed and no driver, a prescribed motion no driver."""
    scenario, recorded = engine.backend.scenario, engine.backend.capabilities.recorded
    driver = policy if scenario.driven and not recorded else ""
    return Origin.of(name, scenario, policy=driver, seed=None if recorded else seed)


def record(
    source: ScenarioLike | Backend,
    seed: int = 0,
    policy: str | Policy = "zero",
    on_progress: Callable[[float], None] = lambda share: None,
    on_tick: Callable[[Engine, int], None] = lambda engine, tick: None,
) -> Recording:
    """Drive a backend in float64 to its horizon, or as long as it has ticks, and record the measurements.

    Args:
        source: source of ticks: a backend, a scenario as for `coopenv.load_scenario`, or a recording.
        seed: of the episode.
        policy: of driven vehicles: "zero", "random", or what `find_agent` takes.
        on_progress: called with the share of the horizon that is done.
        on_tick: called with the engine and the tick's number after every tick, 0 included.

    Raises:
        CoopenvError: unknown policy or observer, or the backend cannot begin.
    """
    return record_episode(source, seed, policy, on_progress, on_tick, fields=OF_RECORDING).measured


def record_episode(
    source: ScenarioLike | Backend,
    seed: int = 0,
    policy: str | Policy = "zero",
    on_progress: Callable[[float], None] = lambda share: None,
    on_tick: Callable[[Engine, int], None] = lambda engine, tick: None,
    name: str = "",
    fields: Sequence[str] = RECORDED,
    on_failure: Callable[[CoopenvError], None] | None = None,
) -> Episode:
    """Return the episode of a backend with its recording.

    Arguments are those of `record`, and:
        name: stands in its heading.
        fields: of the engine that are recorded, at least `OF_RECORDING`.
        on_failure: called with the error of a user's sensor or drive that ends the episode after its first tick; None:
            the error is raised.
    """
    backend = source if isinstance(source, Backend) else open_backend(source, None, {})
    scenario = backend.scenario
    driver = load_policy(policy, scenario, seed)
    engine = Engine(scenario, 1, "float64", backend=backend)
    views = Views(engine, fields)
    ticks: list[Sensed] = []
    faults: list[Interference | None] = []
    drawn = None
    try:
        for k in play(engine, [seed], scenario.horizon_ticks, driver if scenario.driven else None):
            views.take()
            if k == 0 and backend.capabilities.batched:
                key, number, parameters = (engine.view(name)[0].tolist() for name in ("seed", "episode", "parameter"))
                drawn = Drawn(key, number, tuple(parameters))
            ticks.append(engine.world.sensed(0, k))
            faults.append(interference_of(scenario, engine.world.model, engine.view, 0, k))
            on_tick(engine, k)
            on_progress(k / scenario.horizon_ticks)
    except CoopenvError as error:
        if on_failure is None or not ticks or not is_of_user(error):
            raise
        on_failure(error)
    L, observer_init = len(scenario.landmarks), engine.world.observer_init
    names = [name for name in recorded_names(scenario) if name in MEASURED]
    kept: dict[str, Any] = {name: np.stack([tick.filled(name) for tick in ticks]) for name in names}
    episode = views.episode(scenario, source_of(engine, name, seed, policy if isinstance(policy, str) else "custom"))
    recording = Recording(
        setups=observer_init.setups,
        order=observer_init.order,
        dt=observer_init.dt,
        period=observer_init.period,
        staleness=observer_init.staleness,
        due=is_due(np.arange(len(ticks)), engine.world.model.observer.rate / scenario.rates.camera),
        inbox_tick=episode["inbox_tick"].astype(np.int64),
        start_rotation=episode.rows["rotation_estimate"][0],
        start_position=episode.rows["position_estimate"][0],
        start_covariance=observer_init.start_covariance,
        truth=Truth(episode["target_rotation"][:, L:], episode["target_position"][:, L:]),
        scenario=scenario,
        drawn=drawn,
        readings={name: np.stack([tick.readings[name] for tick in ticks]) for name in ticks[0].readings},
        interference=stacked(faults),
        **kept,
    )
    return replace(episode, recording=recording)
