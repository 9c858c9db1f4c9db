"""Cooperative localisation of connected vehicles as a standard multi-agent environment.

import coopenv
env = coopenv.parallel_env("busy_intersection")
observations, infos = env.reset(seed=0)
"""

from coopenv.api.parallel_env import CooperativeLocalisationEnv, parallel_env
from coopenv.api.registration import register_all
from coopenv.api.vector_env import CooperativeVectorEnv, make_vec
from coopenv.errors import (
    ActionError,
    CoopenvError,
    DataError,
    DeviceError,
    OutputError,
    ScenarioError,
    UnknownEnvironmentError,
)
from coopenv.scenario import Scenario, list_envs, load_scenario

__version__ = "0.1.0"

__all__ = [
    "ActionError",
    "CoopenvError",
    "CooperativeLocalisationEnv",
    "CooperativeVectorEnv",
    "DataError",
    "DeviceError",
    "OutputError",
    "Scenario",
    "ScenarioError",
    "UnknownEnvironmentError",
    "list_envs",
    "load_scenario",
    "make_vec",
    "parallel_env",
]

register_all()
