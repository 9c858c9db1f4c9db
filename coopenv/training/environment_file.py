"""The environment that an agent learns in, as it goes with the agent: by its name, or as a copy of the user's file."""

import re
import tomllib
from pathlib import Path
from typing import NamedTuple

import tomlkit

from coopenv.base.installation import is_scene, list_envs, scenario_path
from coopenv.policies.loader import AGENT_FILE
from coopenv.scenario.own_terms import SECTIONS, located
from coopenv.scenario.scenes import scene_text
from coopenv.training.settings import SETTINGS_FILE


class EnvironmentFile(NamedTuple):
    """What an agent's folder tells of its environment."""

    title: str
    """What people call it."""
    name: str
    """By which `agent.toml` names it: one of coopenv's, or a file beside `agent.toml`."""
    text: str | None = None
    """Contents of that file."""


def environment_file(environment: str) -> EnvironmentFile:
    """Return an environment, by its name or TOML file, as it goes with an agent. Raises CoopenvError: there is none."""
    if environment in list_envs():
        return EnvironmentFile(environment, environment)
    if is_scene(environment):
        name = re.sub(r"[^A-Za-z0-9]+", "_", environment)
        return EnvironmentFile(environment, f"{name}.toml", scene_text(environment))
    path = scenario_path(environment)
    name = f"{path.stem}.toml"
    if name in (AGENT_FILE, SETTINGS_FILE):  # which stand there
        name = "environment.toml"
    return EnvironmentFile(path.stem, name, _movable(path.read_text(encoding="utf-8-sig"), path.parent))


def _movable(text: str, folder: Path) -> str:
    """Return a scenario of some folder as it means the same in every other: with absolute places of its own terms."""
    raw = tomllib.loads(text)
    changed = located(raw, folder)
    if changed == raw:
        return text
    document = tomlkit.parse(text)
    for section in SECTIONS:
        rows = changed.get(section, {}).get("custom", {})
        for name, row in rows.items():
            document[section]["custom"][name] = row
    return tomlkit.dumps(document)
