"""Names that a user types: their completion in the shell, and their check."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from pkgutil import resolve_name
from typing import Any, get_args, get_origin

from coopenv.base.errors import CoopenvError
from coopenv.base.installation import BAGS, SCENES, is_scene, list_agents, list_envs, scenario_path

PLAIN = ("zero", "random")
"""Policies without an agent."""


def completion(names: Callable[[], Iterable[str]], several: bool = False) -> Callable[[str], list[str]]:
    """Return the shell's completion of a name; `several`: of a list of names with commas between."""

    def complete(incomplete: str) -> list[str]:
        done, comma, last = incomplete.rpartition(",") if several else ("", "", incomplete)
        left = (name for name in names() if not (several and name in done.split(",")))
        return [f"{done}{comma}{name}" for name in left if name.startswith(last)]

    return complete


def late(place: str) -> Callable[..., Any]:
    """Return a function, `module:name`, whose module is loaded by the first call."""
    return lambda *arguments: resolve_name(place)(*arguments)


observer_names = late("coopenv.observers.registry:list_observers")
check_agent = late("coopenv.policies.loader:check_agent")
check_observer = late("coopenv.observers.registry:check_known")
environments = completion(lambda: [*list_envs(), *(f"{kind}:" for kind in SCENES)])  # the shell completes files itself
agents, agent_lists = completion(list_agents), completion(list_agents, several=True)
policies, policy_lists = (completion(lambda: [*PLAIN, *list_agents()], several) for several in (False, True))
observers = completion(observer_names, several=True)
override_keys = completion(lambda: (f"{key}=" for key in dotted_keys(resolve_name("coopenv.scenario:Scenario"))))


def existing(what: str) -> Callable[[Any], Any]:
    """Return the check that a path, or each of several, exists; `what` it is called."""

    def check(given: Any) -> Any:
        for path in given if isinstance(given, list) else [given]:
            if path is not None and not os.path.exists(path):  # noqa: PTH110 (never raises)
                raise CoopenvError(f"no such {what}: {path}")
        return given

    return check


def known_environment(name: str | None) -> str | None:
    """Return the name of an environment, a file or a recording. Raises CoopenvError: there is none."""
    from coopenv.sources.registry import ENVIRONMENT, LOG_SUFFIX, kind_of

    if name is not None and name.endswith((*BAGS, LOG_SUFFIX)):
        existing("log" if name.endswith(LOG_SUFFIX) else "bag")(name)
    if name is not None and not os.path.exists(name) and kind_of(name) is ENVIRONMENT and not is_scene(name):  # noqa: PTH110 (never raises)
        for kind, names in (("agent", list_agents()), ("observer", observer_names())):
            if name in names:
                raise CoopenvError(f"expected an environment, {name} is an {kind}: coopenv list, coopenv list {kind}s")
        scenario_path(name)
    return name


def known_source(name: str) -> str | None:
    """Return the name of what can be shown, an episode's `.npz` included; errors as for `known_environment`."""
    return name if name.endswith(".npz") else known_environment(name)


def known_policy(name: str | None) -> str | None:
    """Return the name of a policy, a folder or a place in code. Raises CoopenvError: there is no such policy."""
    if name is not None and name not in PLAIN:
        check_agent(name, "policy", PLAIN)
    return name


def each(check: Callable[[str], object]) -> Callable[[Any], Any]:
    """Return the check of several names, a list or a text with commas between, each by a check."""

    def checked(names: Any) -> Any:
        for name in names if isinstance(names, list) else words(names):
            check(name)
        return names

    return checked


known_environments, known_agents = each(known_environment), each(check_agent)


def words(text: str | None) -> list[str]:
    """Return the parts between commas."""
    return [word.strip() for word in (text or "").split(",") if word.strip()]


ENVIRONMENT: dict[str, Any] = {"autocompletion": environments, "callback": known_environment}
POLICY: dict[str, Any] = {"autocompletion": policies, "callback": known_policy}
POLICIES: dict[str, Any] = {"autocompletion": policy_lists, "callback": each(known_policy)}
AGENT: dict[str, Any] = {"autocompletion": agents, "callback": known_agents}
AGENTS: dict[str, Any] = {"autocompletion": agent_lists, "callback": known_agents}
OBSERVERS: dict[str, Any] = {"autocompletion": observers, "callback": each(check_observer)}
"""Completion and check of an argument or option."""


def dotted_keys(annotation: Any) -> Iterator[str]:
    """Yield the dotted key of every setting below a pydantic model, or below those of a type; `*`: any entry."""
    if hasattr(annotation, "model_fields"):
        for name, info in annotation.model_fields.items():
            parts = list(dict.fromkeys(dotted_keys(info.annotation)))
            yield from (f"{name}.{key}" for key in parts) if parts else [name]
        return
    entries = "*." if get_origin(annotation) in (list, tuple, dict) else ""
    for argument in get_args(annotation):
        yield from (f"{entries}{key}" for key in dotted_keys(argument))
