"""An environment of highway-env as a scenario's section `[highway]` asks for it."""

from collections.abc import Mapping
from typing import Any

from coopenv.base.errors import CoopenvError, ScenarioError, listed, shown, suggest, told
from coopenv.scenario import Scenario
from coopenv.scenario.highway import Highway

OWNED = {
    "action": "[dynamics] and [action]",
    "controlled_vehicles": "the vehicles whose motion is driven",
    "duration": "horizon",
    "observation": "[observation]",
    "policy_frequency": "rates.decision",
    "simulation_frequency": "rates.camera",
}
"""Keys of highway-env's configuration that follow from other parts of a scenario, named here."""

NO_ENVIRONMENT = "backend 'highway' needs highway-env, which is not installed: pip install '.[highway]'"


def make_environment(scenario: Scenario) -> Any:
    """Return the environment of highway-env, whose every step is one camera tick.

    Raises:
        CoopenvError: highway-env is not installed.
        ScenarioError: it has no such environment or key, or it does not take a value.
    """
    assert scenario.highway is not None  # the schema asks for it
    creator = _creator(scenario.highway.id)
    config = _config(scenario, scenario.highway, creator.default_config())
    try:
        return creator(config=config)
    except Exception as error:  # whatever highway-env makes of it
        raise ScenarioError(f"highway: {scenario.highway.id} cannot be made: {told(error)}") from None


def _creator(name: str) -> Any:
    """Return the class of an environment."""
    try:
        import gymnasium
        import highway_env  # noqa: F401  (registers its environments)
    except ImportError:
        raise CoopenvError(NO_ENVIRONMENT) from None
    from gymnasium.envs.registration import load_env_creator

    known = {i: s.entry_point for i, s in gymnasium.registry.items() if str(s.entry_point).startswith("highway_env.")}
    if name not in known:
        near = suggest(name, known) or f"; known: {listed(sorted(known), 40)}"
        raise ScenarioError(f"highway.id: highway-env has no environment {shown(name)}{near}")
    creator: Any = load_env_creator(str(known[name]))
    if not hasattr(creator, "default_config"):
        raise ScenarioError(f"highway.id: {name} is not one environment but a wrapper of another")
    return creator


def _config(scenario: Scenario, section: Highway, defaults: Mapping[str, Any]) -> dict[str, Any]:
    """Return what highway-env is told: the section's own keys, checked, and what the rest of the scenario says."""
    rate = int(scenario.rates.camera)
    for key, value in section.config.items():
        if key in OWNED:
            raise ScenarioError(f"highway.config.{key}: follows from {OWNED[key]}; leave this out")
        if key not in defaults:
            near = suggest(key, defaults) or f"; allowed: {listed(sorted(set(defaults) - set(OWNED)), 40)}"
            raise ScenarioError(f"highway.config.{key}: unknown key{near}")
        if not _like(value, defaults[key]):
            raise ScenarioError(
                f"highway.config.{key}: expected a value like {shown(defaults[key])}, got {shown(value)}"
            )
    kind = "IntersectionTraffic" if section.id.startswith("intersection") else "Traffic"
    acceleration, steering = most_of_actions(scenario)
    speeds = [limits.max_speed for limits in scenario.limits]
    drive = {
        "type": "ContinuousAction",
        "acceleration_range": [-acceleration, acceleration],
        "steering_range": [-steering, steering],
        "speed_range": [-max(speeds) if any(limits.reverse for limits in scenario.limits) else 0.0, max(speeds)],
        "dynamical": section.dynamical,
    }
    return {
        "other_vehicles_type": f"coopenv.backends.highway.traffic.{kind}",
        **{key: list(value) if isinstance(value, tuple) else value for key, value in section.config.items()},
        "action": {"type": "MultiAgentAction", "action_config": drive},
        "observation": {"type": "AttributesObservation", "attributes": []},
        "simulation_frequency": rate,
        "policy_frequency": rate,
        "controlled_vehicles": sum(vehicle.motion.kind == "driven" for vehicle in scenario.vehicles),
        "duration": scenario.horizon,
    }


def most_of_actions(scenario: Scenario) -> tuple[float, float]:
    """Return the acceleration (m/s^2) and the steering angle (rad) that an action of highway-env of 1 stands for."""
    limits = scenario.limits
    return max(of.max_acceleration for of in limits), max(of.max_steering for of in limits)


def _like(value: Any, default: Any) -> bool:
    """Return whether a value is of the kind of highway-env's default; where that is None anything may be meant."""
    if default is None:
        return True
    if isinstance(default, bool) or isinstance(value, bool):
        return isinstance(default, bool) and isinstance(value, bool)
    kinds = (int | float, str, list | tuple)
    return any(isinstance(value, kind) and isinstance(default, kind) for kind in kinds)
