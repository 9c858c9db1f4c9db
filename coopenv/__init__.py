"""Cooperative localisation of connected vehicles as a standard multi-agent environment.

import coopenv
env = coopenv.parallel_env("busy_intersection")
observations, infos = env.reset(seed=0)

Names that need the simulation are loaded when they are first used (PEP 562), so that the import and the command line
start quickly.
"""

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from coopenv.base import lazy_names
from coopenv.base.errors import (
    ActionError,
    CoopenvError,
    DataError,
    DeviceError,
    OutputError,
    ScenarioError,
    UnknownEnvironmentError,
)
from coopenv.base.installation import list_agents, list_envs, sample_bags
from coopenv.base.seeds import EVALUATION_SEEDS, evaluation_seed

if TYPE_CHECKING:
    from coopenv.api.make import make_vec, parallel_env
    from coopenv.api.parallel_env import CooperativeLocalisationEnv
    from coopenv.api.vector_env import CooperativeVectorEnv
    from coopenv.bench.cards import Evaluation
    from coopenv.bench.evaluate import evaluate
    from coopenv.bench.observers.comparison import Comparison, compare
    from coopenv.estimation.poses import position_covariance
    from coopenv.observers.registry import list_observers
    from coopenv.runs.command import Results, run
    from coopenv.scenario import Scenario, load_scenario
    from coopenv.scenario.own_terms import register_observation, register_reward, register_termination

    __version__: str
else:
    _lazy, __dir__ = lazy_names(__name__)

    def __getattr__(name):
        from coopenv.base.installation import version

        return version() if name == "__version__" else _lazy(name)


__all__ = [
    "EVALUATION_SEEDS",
    "ActionError",
    "Comparison",
    "CoopenvError",
    "CooperativeLocalisationEnv",
    "CooperativeVectorEnv",
    "DataError",
    "DeviceError",
    "Evaluation",
    "OutputError",
    "Results",
    "Scenario",
    "ScenarioError",
    "UnknownEnvironmentError",
    "__version__",
    "compare",
    "evaluate",
    "evaluation_seed",
    "list_agents",
    "list_envs",
    "list_observers",
    "load_scenario",
    "make_vec",
    "parallel_env",
    "position_covariance",
    "register_observation",
    "register_reward",
    "register_termination",
    "run",
    "sample_bags",
]

# The command makes environments itself; until it runs, no signal is caught, so that it is to begin at once.
if sys.orig_argv[1:3] != ["-m", "coopenv"] and Path(sys.argv[0]).name != "coopenv":
    from coopenv.api.registration import register_all

    register_all()
