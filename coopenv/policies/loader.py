"""Find and load the drivers of `agents/`: one folder each, with an `agent.toml` and a card."""

import tomllib
from importlib import import_module
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from coopenv.errors import CoopenvError, suggest
from coopenv.policies.base import PLAIN, Policy
from coopenv.scenario import Scenario
from coopenv.shipped import data_directory, list_agents


class AgentCard(BaseModel):
    """The contents of an `agent.toml`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    title: str
    description: str
    entry: str
    """`package.module:Class` within coopenv; called with the scenario and the options."""
    environments: tuple[str, ...]
    """Environments that it was made for."""
    options: dict[str, Any] = {}


def read_card(name_or_path: str | Path) -> AgentCard:
    """Read the `agent.toml` of a shipped driver or of a folder.

    Raises:
        CoopenvError: no such agent, or the file is not valid.
    """
    name, names = str(name_or_path), list_agents()
    path = (data_directory("agents") / name if name in names else Path(name)) / "agent.toml"
    if not path.is_file():
        raise CoopenvError(f"unknown agent '{name}'{suggest(name, names)}; known: {', '.join(names)}")
    try:
        return AgentCard.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
    except tomllib.TOMLDecodeError as error:
        raise CoopenvError(f"{path}: not valid TOML: {error}") from None
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise CoopenvError(f"{path}: {'.'.join(map(str, first['loc']))}: {first['msg']}") from None


def load_agent(name_or_path: str | Path, scenario: Scenario) -> Policy:
    """Return a driver for an environment's vehicles (`env.scenario`).

    Raises:
        CoopenvError: no such agent, its entry lies outside coopenv, or it cannot drive this environment.
    """
    card = read_card(name_or_path)
    module, _, attribute = card.entry.partition(":")
    if not module.startswith("coopenv.") or not attribute:
        raise CoopenvError(f"agent '{name_or_path}': entry must be 'coopenv.module:Class', got '{card.entry}'")
    try:
        factory = getattr(import_module(module), attribute)
        policy: Policy = factory(scenario, **card.options)
    except (ImportError, AttributeError, TypeError, ValueError, KeyError) as error:
        raise CoopenvError(f"agent '{name_or_path}' cannot be built: {error}") from None
    return policy


def load_policy(name: str, scenario: Scenario, seed: int) -> Policy:
    """Return a policy by what `--policy` takes: `zero`, `random` (with a seed), or the name of an agent.

    Raises:
        CoopenvError: there is no such policy, or the agent cannot drive in this scenario.
    """
    if name in PLAIN:
        return PLAIN[name](seed)
    if name not in list_agents():
        known = [*PLAIN, *list_agents()]
        raise CoopenvError(f"unknown policy '{name}'{suggest(name, known)}; known: {', '.join(known)}")
    return load_agent(name, scenario)
