"""`coopenv record`: keep what vehicles sense, simulated or recorded elsewhere, as an MCAP file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from coopenv.api.engine import Engine
from coopenv.errors import CoopenvError
from coopenv.observers.recording import Recording
from coopenv.policies import load_policy
from coopenv.runs.recorder import record
from coopenv.scenario import Scenario


def simulate(scenario: Scenario, seed: int, policy: str) -> Recording:
    """Return the recording of one run up to the horizon.

    Args:
        scenario: the world.
        seed: of everything that is drawn.
        policy: "zero", "random" or the name of an agent.

    Raises:
        CoopenvError: unknown policy or observer.
    """
    decide = load_policy(policy, scenario, seed)

    def act(engine: Engine) -> np.ndarray[Any, Any]:
        actions = np.asarray(decide(engine.view("observation")[0].copy()), dtype=np.float64)
        return np.clip(actions, -1.0, 1.0)[None]

    driver: Callable[[Engine], Any] | None = act if scenario.driven else None
    return record(scenario, seed, driver)


def read_recorded(name: str, data: Path | None, variant: str | None, options: dict[str, Any]) -> Recording:
    """Return a data set or file as a recording.

    Args:
        name: `mrclam_1` .. `mrclam_9`, or an MCAP file.
        data: folder of the data sets.
        variant: of a data set.
        options: what the user asked for that only a simulation knows, by name.

    Raises:
        CoopenvError: it cannot be read, or an option was given.
    """
    from coopenv.backends.replay import open_recording

    if options:
        raise CoopenvError(f"{next(iter(options))}: is for a simulation, {name} is recorded")
    return open_recording(name, data, variant)
