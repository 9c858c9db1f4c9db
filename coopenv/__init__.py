"""Cooperative localisation of connected vehicles as a standard multi-agent environment.

import coopenv
env = coopenv.parallel_env("busy_intersection")
observations, infos = env.reset(seed=0)

Names that need the simulation are loaded when they are first used (PEP 562), so that the import and the command line
start quickly.
"""

import sys
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from coopenv.base.errors import (
    ActionError,
    CoopenvError,
    DataError,
    DeviceError,
    OutputError,
    ScenarioError,
    UnknownEnvironmentError,
)
from coopenv.base.installation import list_envs
from coopenv.base.seeds import EVALUATION_SEEDS, evaluation_seed

if TYPE_CHECKING:
    from coopenv.api.make import make_vec, parallel_env
    from coopenv.api.parallel_env import CooperativeLocalisationEnv
    from coopenv.api.vector_env import CooperativeVectorEnv
    from coopenv.bench.observers.comparison import Comparison, compare
    from coopenv.scenario import Scenario, load_scenario
    from coopenv.scenario.own_terms import register_observation, register_reward, register_termination

    __version__: str
else:
    _HOMES = {
        "CooperativeLocalisationEnv": "coopenv.api.parallel_env",
        "CooperativeVectorEnv": "coopenv.api.vector_env",
        "Comparison": "coopenv.bench.observers.comparison",
        "Scenario": "coopenv.scenario",
        "compare": "coopenv.bench.observers.comparison",
        "load_scenario": "coopenv.scenario",
        "make_vec": "coopenv.api.make",
        "parallel_env": "coopenv.api.make",
        "register_observation": "coopenv.scenario.own_terms",
        "register_reward": "coopenv.scenario.own_terms",
        "register_termination": "coopenv.scenario.own_terms",
    }
    """Module of each name that is loaded when it is first used."""

    def __getattr__(name):
        if name == "__version__":
            from coopenv.base.installation import version

            value = version()
        elif name in _HOMES:
            value = getattr(import_module(_HOMES[name]), name)
        else:
            raise AttributeError(f"module 'coopenv' has no attribute '{name}'")
        globals()[name] = value
        return value

    def __dir__():
        return sorted({*globals(), *_HOMES, "__version__"})


__all__ = [
    "EVALUATION_SEEDS",
    "ActionError",
    "Comparison",
    "CoopenvError",
    "CooperativeLocalisationEnv",
    "CooperativeVectorEnv",
    "DataError",
    "DeviceError",
    "OutputError",
    "Scenario",
    "ScenarioError",
    "UnknownEnvironmentError",
    "compare",
    "evaluation_seed",
    "list_envs",
    "load_scenario",
    "make_vec",
    "parallel_env",
    "register_observation",
    "register_reward",
    "register_termination",
]

# The command makes environments itself; until it runs, no signal is caught, so that it is to begin at once.
if sys.orig_argv[1:3] != ["-m", "coopenv"] and Path(sys.argv[0]).name != "coopenv":
    from coopenv.api.registration import register_all

    register_all()
