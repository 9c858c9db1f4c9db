"""What the shell completes: environments, drivers, observers, keys of a scenario. None of it loads the simulation."""

from collections.abc import Iterable, Iterator
from typing import Any, get_args

from coopenv.base.installation import SCENES, list_agents, list_envs


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
    return _matching(["zero", "random", *list_agents()], incomplete)


def observers(incomplete: str) -> list[str]:
    """Return lists of observers, names with commas between, that continue this one."""
    from coopenv.observers.registry import observer_names

    return _lists(observer_names(), incomplete)


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
