"""What a world is: typed, validated, read from `envs/*.toml`."""

from coopenv.scenario.files import load_scenario, parse_scenario, scenario_path
from coopenv.scenario.schema import Scenario
from coopenv.scenario.warning import ScenarioWarning

__all__ = [
    "Scenario",
    "ScenarioWarning",
    "load_scenario",
    "parse_scenario",
    "scenario_path",
]
