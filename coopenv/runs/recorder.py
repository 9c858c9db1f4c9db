"""Record what every vehicle of a simulated world senses, once per seed, so that all observers see the same ticks."""

from __future__ import annotations

import numpy as np

from coopenv.api.engine import Engine
from coopenv.backends.simulated import SimulatedSenses
from coopenv.observers.briefing import briefing_of
from coopenv.observers.recording import Recording, Truth, due_ticks
from coopenv.policies import Policy, decide, load_policy
from coopenv.scenario import Scenario


def record(scenario: Scenario, seed: int = 0, policy: str | Policy = "zero") -> Recording:
    """Run a world in float64 to its horizon and keep what is sensed.

    Args:
        scenario: what to run.
        seed: of the world.
        policy: of driven vehicles: "zero", "random", the name of an agent, or a function of the observations.

    Raises:
        CoopenvError: unknown policy or observer.
    """
    driver = load_policy(policy, scenario, seed) if isinstance(policy, str) else policy
    engine = Engine(scenario, 1, "float64")
    engine.reset([seed])
    model, senses = engine.world.model, SimulatedSenses(scenario, engine.world)
    briefing = briefing_of(scenario, model)
    L, K = len(scenario.landmarks), scenario.horizon_ticks + 1
    sensed_names = ("rotation", "translation", "velocity", "angular_velocity", "bearings", "visible", "landmarks")
    world_names = {"inbox_tick": "inbox_tick", "true_rotation": "rotation", "true_position": "position"}
    rows: dict[str, list[np.ndarray]] = {name: [] for name in (*sensed_names, *world_names)}
    start_rotation = engine.view("estimate_rotation")[0].copy()
    start_position = (start_rotation @ engine.view("estimate_position")[0][..., None])[..., 0]
    for k in range(K):
        if k > 0:
            if scenario.driven and (k - 1) % scenario.ticks_per_decision == 0:
                engine.set_actions(decide(driver, engine.view("observation")[0].copy())[None])
            engine.step(ticks=1)
        sensed = senses.read(0, k)
        for name in sensed_names:
            rows[name].append(getattr(sensed, name))
        for name, field in world_names.items():
            rows[name].append(engine.view(field)[0].copy())
    kept = {name: np.stack(values) for name, values in rows.items()}
    kept["inbox_tick"] = kept["inbox_tick"].astype(np.int64)
    truth = Truth(kept.pop("true_rotation")[:, L:], kept.pop("true_position")[:, L:])
    for values in (*kept.values(), start_rotation):
        values.setflags(write=False)  # observers get views
    return Recording(
        setups=briefing.setups,
        order=briefing.order,
        dt=briefing.dt,
        period=briefing.period,
        staleness=briefing.staleness,
        due=due_ticks(K, model.observer.rate / scenario.rates.camera),
        start_rotation=start_rotation,
        start_position=start_position,
        start_covariance=briefing.start_covariance,
        truth=truth,
        scenario=scenario,
        **kept,
    )
