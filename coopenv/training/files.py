"""Files beside a trained agent: its settings and the environment that it learnt in. Needs the extra `train`."""

import re
import shutil
import tomllib
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import tomlkit

from coopenv.base.errors import CoopenvError, OutputError
from coopenv.base.files import writing
from coopenv.base.installation import is_scene, list_envs, scenario_path
from coopenv.policies.loader import AGENT_FILE
from coopenv.scenario.own_terms import SECTIONS, located
from coopenv.scenario.scenes import scene_text
from coopenv.training.settings import SETTINGS_FILE, Plan, read_settings


def settings_text(plan: Plan) -> str:
    """Return the settings of a training, defaults and overrides among them, as TOML."""
    values = plan.settings.model_dump(mode="json", exclude_none=True)
    return tomlkit.dumps({**values, "scenario": plan.all_overrides})


def settings_digest(plan: Plan) -> str:
    """Return the SHA-256 of `settings_text`, by which a later training knows the file for the agent's."""
    return sha256(settings_text(plan).encode()).hexdigest()


def check(folder: Path, plan: Plan, environment: str) -> None:
    """Find out before any work whether `write` can be done.

    Raises:
        OutputError: a folder holds other settings, and they are not those of an agent in it but the user's own.
    """
    path = folder / SETTINGS_FILE
    if path.exists() and not _says(path, plan, environment) and not _is_the_agents(path):
        raise OutputError(
            f"{path}: no agent's, and this training has other settings: name another folder with --out, or move it"
        )


def write(folder: Path, old: Path, plan: Plan, environment: str) -> None:
    """Write the settings of a training to the new folder of its agent; a file that says the same goes along as it is.

    Args:
        folder: to write to.
        old: whose place it takes.
        plan: of the training.
        environment: how the agent names its own.

    Raises:
        OutputError: it cannot be written, or see `check`.
    """
    check(old, plan, environment)
    new = folder / SETTINGS_FILE
    with writing(new):
        if (old / SETTINGS_FILE).exists() and _says(old / SETTINGS_FILE, plan, environment):
            shutil.copy2(old / SETTINGS_FILE, new, follow_symlinks=False)
        else:
            new.write_text(settings_text(plan), encoding="utf-8", newline="\n")


def _says(path: Path, plan: Plan, environment: str) -> bool:
    """Return whether `coopenv train` with a file and no other option has the settings of a plan."""
    try:
        settings = read_settings(path, None, Path(environment).stem)
    except CoopenvError:
        return False
    return settings == plan.settings.model_copy(update={"scenario": plan.all_overrides})


def _is_the_agents(path: Path) -> bool:
    """Return whether `coopenv train` has written a file that was not changed since."""
    try:
        card: dict[str, Any] = tomllib.loads((path.parent / AGENT_FILE).read_text(encoding="utf-8"))
        known = card["training"].get("settings")  # earlier versions noted none
        return known is None or known == sha256(path.read_bytes()).hexdigest()
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, KeyError, AttributeError):
        return False


class EnvironmentFile(NamedTuple):
    """The environment as an agent's folder holds it."""

    title: str
    """Its name in texts."""
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
