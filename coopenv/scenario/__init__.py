"""Description of a world: typed, validated, read from `envs/*.toml`."""

from coopenv.base.installation import scenario_path
from coopenv.scenario.files import ScenarioLike, load_scenario, parse_scenario, scenario_name
from coopenv.scenario.schema import Scenario

__all__ = ["Scenario", "ScenarioLike", "load_scenario", "parse_scenario", "scenario_name", "scenario_path"]
