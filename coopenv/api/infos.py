"""What one world tells beside observations: infos of its agents, and the state of everybody."""

from typing import Any

import numpy as np
from gymnasium import spaces

from coopenv.api.engine import Engine
from coopenv.api.reward import Step
from coopenv.estimation.outcomes import Outcome
from coopenv.scenario import Scenario

NUMBERS = ("position_error", "orientation_error", "nees", "log_determinant", "gramian_min_eigenvalue")


def outcome_words(scenario: Scenario) -> tuple[str, ...]:
    """Return the words of `info["outcome"]` by the values of the field `ended`."""
    return (*(outcome.words for outcome in Outcome), *scenario.termination.own)


class InfoWriter:
    """Builds {agent: info} for world 0 of an engine."""

    def __init__(self, engine: Engine, scenario: Scenario) -> None:
        self._engine, self._step = engine, Step(engine.view, scenario)
        self._index = {agent: i for i, agent in enumerate(scenario.vehicle_names)}
        self._targets, self._outcomes = scenario.target_names, outcome_words(scenario)

    def __call__(self, agents: list[str]) -> dict[str, dict[str, Any]]:
        """Return one info per agent, always with the same keys."""
        step, world = self._step, self._engine.world
        truth, estimate = ({key: a[0].copy() for key, a in step[part].items()} for part in ("truth", "estimate"))
        numbers = [step[name][0].tolist() for name in NUMBERS]
        ended, terms = step["ended"][0].tolist(), self._engine.view("terms")[0].tolist()
        seen: list[list[str]] = [[] for _ in ended]
        for i, target in np.argwhere(step["visible"][0]).tolist():
            seen[i].append(self._targets[target])
        late, missing, time = world.late.tolist(), world.missing.tolist(), float(step["time"][0, 0])
        infos = {}
        for agent in agents:
            i = self._index[agent]
            infos[agent] = {
                "truth": {key: values[i] for key, values in truth.items()},
                "estimate": {key: values[i] for key, values in estimate.items()},
                **{name: values[i] for name, values in zip(NUMBERS, numbers, strict=True)},
                "visible": tuple(seen[i]),
                "reward_terms": dict(zip(self._engine.reward_terms, terms[i], strict=True)),
                "time": time,
                "outcome": self._outcomes[ended[i]],
                "late_ticks": late[i],
                "missing_ticks": missing[i],
            }
        return infos


PER_AGENT = 12
"""position (3), first two columns of R (6), linear velocity (3), all of truth"""
PER_VEHICLE = 9
"""estimated position (3) and first two columns of Rhat (6)"""
LIMIT = 1e6


def state_space(scenario: Scenario) -> spaces.Box:
    """Return the space of `state_vector`: metres and m/s, clipped far beyond any scene."""
    size = PER_AGENT * len(scenario.target_names) + PER_VEHICLE * len(scenario.vehicles) + 1
    return spaces.Box(-LIMIT, LIMIT, shape=(size,), dtype=np.float32)


def state_vector(engine: Engine) -> np.ndarray:
    """Return the state of world 0: every agent's truth (landmarks first), every vehicle's estimate, episode share.

    Truth that a recording does not know reads 0.
    """
    R, position, velocity = (engine.view(name)[0] for name in ("rotation", "position", "velocity"))
    R_hat, p_hat = engine.view("estimate_rotation")[0], engine.view("estimate_position")[0]
    position_hat = np.einsum("nij,nj->ni", R_hat, p_hat)
    truth = np.hstack([position, R[:, :, 0], R[:, :, 1], velocity])
    estimate = np.hstack([position_hat, R_hat[:, :, 0], R_hat[:, :, 1]])
    share = engine.view("tick")[:1] / engine.world.model.horizon_ticks
    whole = np.concatenate([truth.ravel(), estimate.ravel(), share]).astype(np.float32)
    result: np.ndarray = np.nan_to_num(whole.clip(-LIMIT, LIMIT), nan=0.0)
    return result
