"""What a world is: typed, validated, read from `envs/*.toml`."""

from coopenv.base.installation import scenario_path
from coopenv.scenario.files import load_scenario, parse_scenario
from coopenv.scenario.schema import Scenario

__all__ = ["Scenario", "load_scenario", "parse_scenario", "scenario_path"]
