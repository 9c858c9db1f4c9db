"""The info dictionaries: truth, judgements and reward terms, fresh at every step."""

from __future__ import annotations

from typing import Any

import numpy as np

from coopenv.api.engine import Engine
from coopenv.api.reward import Step
from coopenv.estimation.trajectory import Outcome
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
