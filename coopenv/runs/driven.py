"""Episodes of single vehicles under a policy, step by step, as offline reinforcement learning wants them."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from coopenv.api.engine import Engine
from coopenv.base.errors import CoopenvError
from coopenv.base.seeds import world_keys
from coopenv.evaluation.episodes import driven_vehicles
from coopenv.policies import Policy, decide, restart
from coopenv.scenario import Scenario

KEPT = ("observation", "reward", "terminated", "truncated", "position_error")


@dataclass(frozen=True)
class DrivenEpisode:
    """What one vehicle observed, did and got, until it ended or its world did; T decisions."""

    world: int
    vehicle: str
    observations: np.ndarray
    """(T + 1, D) float32, from the start to the last."""
    actions: np.ndarray
    """(T, A) float32 in [-1, 1]."""
    rewards: np.ndarray
    """(T,)."""
    terminations: np.ndarray
    """(T,) bool: it arrived, collided or fulfilled another condition."""
    truncations: np.ndarray
    """(T,) bool: the horizon cut it off."""
    position_error: np.ndarray
    """(T + 1,) m, against the truth."""


def drive_vehicles(
    scenario: Scenario,
    policy: Policy,
    seed: int,
    worlds: int,
    on_progress: Callable[[float], None] = lambda share: None,
) -> list[DrivenEpisode]:
    """Let a policy drive an episode in every world of a seed; return one per driven vehicle that is there.

    Args:
        scenario: has driven vehicles.
        policy: chooses for all rows, (world, vehicle).
        seed: of the batch, as of `make_vec(...).reset(seed=...)`.
        worlds: how many.
        on_progress: called with the share of the horizon that is done.

    Raises:
        CoopenvError: nothing is driven, or the policy returns something else than actions.
    """
    if not scenario.driven:
        raise CoopenvError("all motion here is prescribed, there is nothing to drive")
    engine = Engine(scenario, worlds)
    view, steps = engine.view, -(-scenario.horizon_ticks // scenario.ticks_per_decision)
    rows, width = view("alive").size, view("actions").shape[-1]
    kept: dict[str, list[np.ndarray]] = {name: [] for name in KEPT}
    actions: list[np.ndarray] = []
    with engine.stopping():
        engine.reset(world_keys(seed, worlds))
        there = view("alive").copy()
        restart(policy, np.ones(rows, dtype=bool))
        _keep(kept, engine)
        for step in range(steps):
            chosen = decide(policy, kept["observation"][-1].reshape(rows, -1), width)
            actions.append(chosen.reshape(view("actions").shape).astype(np.float32))
            engine.step(actions[-1])
            _keep(kept, engine)
            on_progress((step + 1) / steps)
            if view("over").all():
                break
    engine.close()
    record = {name: np.stack(values) for name, values in kept.items()}
    return list(_episodes(scenario, record, np.stack(actions), there))


def _keep(kept: dict[str, list[np.ndarray]], engine: Engine) -> None:
    for name, values in kept.items():
        values.append(engine.view(name).copy())


def _episodes(
    scenario: Scenario, record: dict[str, np.ndarray], actions: np.ndarray, there: np.ndarray
) -> Iterator[DrivenEpisode]:
    """Yield the episodes in a record of (K + 1, W, N, ...), world by world."""
    terminated, truncated = (record[name][1:].astype(bool) for name in ("terminated", "truncated"))
    ended = terminated | truncated
    for world in range(there.shape[0]):
        for vehicle in driven_vehicles(scenario):
            if not there[world, vehicle]:
                continue
            ends = np.flatnonzero(ended[:, world, vehicle])
            length = int(ends[0]) + 1 if len(ends) else len(actions)
            place = slice(None, length), world, vehicle
            whole = slice(None, length + 1), world, vehicle
            yield DrivenEpisode(
                world=world,
                vehicle=scenario.vehicle_names[vehicle],
                observations=record["observation"][whole],
                actions=actions[place],
                rewards=record["reward"][1:][place].astype(float),
                terminations=terminated[place],
                truncations=truncated[place],
                position_error=record["position_error"][whole].astype(float),
            )
