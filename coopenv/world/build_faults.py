"""Turn what may go wrong with a vehicle into the numbers of the `Model`."""

from typing import Any

import numpy as np

from coopenv.scenario import Scenario
from coopenv.scenario.sensing import Faults
from coopenv.world.fault_kinds import KINDS


def fault_entries(f: Faults, scenario: Scenario) -> dict[str, Any]:
    """Return the values of the model's `Fault`."""
    restart, corruption, lie = f.restart, f.corruption, f.lie
    direction = np.zeros(3) if lie.direction is None else np.array(lie.direction) / np.linalg.norm(lie.direction)
    return {
        "clock": f.clock_offset,
        "restart_chance": restart.chance,
        "restart_time": restart.time,
        "restart_spread": restart.time_spread,
        "corruption": corruption.probability,
        "corruption_start": corruption.start,
        "corruption_size": corruption.size,
        "corruption_turn": corruption.turn,
        "lie": int(KINDS[lie.kind]),
        "lie_chance": lie.chance,
        "lie_start": lie.start,
        "lie_spread": lie.start_spread,
        "lie_size": lie.speed if lie.kind == "drift" else lie.offset,
        "lie_replay": scenario.ticks_of_replay(lie.age),
        "lie_direction": direction,
        "lie_std": lie.std or 0.0,
    }


def fault_switches(scenario: Scenario) -> dict[str, int]:
    """Return which faults any vehicle has, so that the others cost nothing."""
    everybody = scenario.all_faults
    return {
        "clocks": int(any(f.clock_offset > 0.0 for f in everybody)),
        "restarts": int(any(f.restart.chance > 0.0 for f in everybody)),
        "alters": int(any(f.alters for f in everybody)),
    }
