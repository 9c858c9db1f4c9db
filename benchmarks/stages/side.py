"""One side of a comparison: steps environments of whichever coopenv is found here. Runs with older checkouts too.

`python side.py CASES`, CASES being a JSON list of {"environment", "worlds", "dtype", "overrides"}. For every line of
standard input, {"case": index, "decisions": number}, it prints the CPU time in s per vehicle tick.
"""

from __future__ import annotations

import json
import sys
import time
import warnings
from collections.abc import Callable
from itertools import cycle
from typing import Any

import numpy as np

import coopenv


def stepper(case: dict[str, Any]) -> Callable[[int], float]:
    """Return a function of a number of decisions that steps an environment and returns s per vehicle tick."""
    shape: dict[str, Any] = {"num_worlds": case["worlds"], "dtype": case["dtype"], "threads": 1}
    env = coopenv.make_vec(case["environment"], overrides=case["overrides"], **shape)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    actions = cycle([rng.uniform(-1, 1, (env.num_envs, 2)).astype(np.float32) for _ in range(8)])
    ticks = env.num_envs * env.scenario.ticks_per_decision

    def step(decisions: int) -> float:
        begin = time.process_time()
        for _ in range(decisions):
            env.step(next(actions))
        return (time.process_time() - begin) / (decisions * ticks)

    step(2)
    return step


def main() -> None:
    """Serve standard input."""
    warnings.simplefilter("ignore")
    steppers = [stepper(case) for case in json.loads(sys.argv[1])]
    print("ready", flush=True)
    for line in sys.stdin:
        request = json.loads(line)
        print(steppers[request["case"]](request["decisions"]), flush=True)


if __name__ == "__main__":
    main()
