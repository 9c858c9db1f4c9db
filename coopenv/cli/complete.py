"""Names on the command line: how the shell completes them, and which are refused. None of it loads the simulation."""

import os
from collections.abc import Iterable, Iterator
from typing import Any, get_args

from coopenv.base.installation import SCENES, is_scene, list_agents, list_envs, scenario_path

PLAIN = ("zero", "random")
"""Policies without an agent."""


def environments(incomplete: str) -> list[str]:
    """Return the environments that begin so; the shell completes files itself."""
    return _matching([*list_envs(), *(f"{kind}:" for kind in SCENES)], incomplete)


def agents(incomplete: str) -> list[str]:
    """Return the drivers that begin so."""
    return _matching(list_agents(), incomplete)


def agent_lists(incomplete: str) -> list[str]:
    """Return lists of drivers, names with commas between, that continue this one."""
    return _lists(list_agents(), incomplete)


def policies(incomplete: str) -> list[str]:
    """Return what `--policy` takes and begins so."""
    return _matching([*PLAIN, *list_agents()], incomplete)


def observers(incomplete: str) -> list[str]:
    """Return lists of observers, names with commas between, that continue this one."""
    from coopenv.observers.registry import observer_names

    return _lists(observer_names(), incomplete)


def known_environment(name: str | None) -> str | None:
    """Return the name of an environment, a file or a recording. Raises UnknownEnvironmentError: there is none."""
    from coopenv.backends.sources import is_recorded

    if name is not None and not (os.path.exists(name) or is_scene(name) or is_recorded(name)):  # noqa: PTH110 (never raises)
        scenario_path(name)
    return name


def known_source(name: str) -> str | None:
    """Return the name of what can be shown, an episode's `.npz` included; errors as for `known_environment`."""
    return name if name.endswith(".npz") else known_environment(name)


def known_environments(names: list[str] | None) -> list[str] | None:
    """Return names of which each is known, see `known_environment`."""
    for name in names or ():
        known_environment(name)
    return names


def known_policy(name: str | None) -> str | None:
    """Return the name of a policy, a folder or a place in code. Raises CoopenvError: there is no such policy."""
    if name is not None and name not in PLAIN:
        from coopenv.policies.loader import check_agent

        check_agent(name, "policy", PLAIN)
    return name


def known_agents(names: str | None) -> str | None:
    """Return agents with commas between. Raises CoopenvError: there is no such agent."""
    if names is not None:
        from coopenv.policies.loader import check_agent

        for name in filter(None, map(str.strip, names.split(","))):
            check_agent(name)
    return names


def known_observers(names: str | None) -> str | None:
    """Return observers with commas between. Raises CoopenvError: there is no such observer."""
    if names:
        from coopenv.observers.registry import check_known

        for name in names.split(","):
            check_known(name.strip())
    return names


ENVIRONMENT: dict[str, Any] = {"autocompletion": environments, "callback": known_environment}
POLICY: dict[str, Any] = {"autocompletion": policies, "callback": known_policy}
AGENTS: dict[str, Any] = {"autocompletion": agent_lists, "callback": known_agents}
OBSERVERS: dict[str, Any] = {"autocompletion": observers, "callback": known_observers}
"""Completion and check of an argument or option."""


def override_keys(incomplete: str) -> list[str]:
    """Return the dotted keys of a scenario that begin so, each with its `=`."""
    from coopenv.scenario import Scenario

    return _matching((f"{key}=" for key in dotted_keys(Scenario)), incomplete)


def dotted_keys(model: type[Any]) -> Iterator[str]:
    """Yield the dotted key of every setting below a pydantic model; `*` stands for any entry."""
    for name, info in model.model_fields.items():
        parts = list(_models_in(info.annotation))
        if not parts:
            yield name
        between = ".*." if all(in_list for _, in_list in parts) else "."
        yield from dict.fromkeys(f"{name}{between}{key}" for part, _ in parts for key in dotted_keys(part))


def _models_in(annotation: Any, in_list: bool = False) -> Iterator[tuple[type[Any], bool]]:
    """Yield the models that an annotation refers to, and whether as entries of a list."""
    if hasattr(annotation, "model_fields"):
        yield annotation, in_list
    for argument in get_args(annotation):
        yield from _models_in(argument, in_list or getattr(annotation, "__origin__", None) in (list, tuple, dict))


def _matching(names: Iterable[str], incomplete: str) -> list[str]:
    return [name for name in names if name.startswith(incomplete)]


def _lists(names: Iterable[str], incomplete: str) -> list[str]:
    done, comma, last = incomplete.rpartition(",")
    return [f"{done}{comma}{name}" for name in _matching(names, last) if name not in done.split(",")]
