"""Register every shipped environment with Gymnasium and PettingZoo as `coopenv/<CamelCase>-v0` and `coopenv/<name>`.

With Gymnasium such an id is one vehicle, and a vector of it has independent worlds. `coopenv/<CamelCase>Rows-v0` is the
batch whose rows are all vehicles of its worlds (`gymnasium.make_vec` alone). `coopenv/Scenario-v0` takes any scenario,
such as `name_or_path="ring:5"`. Entry points are strings, and what they need
is imported when an environment is made: `import coopenv` costs little.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import gymnasium
import pettingzoo
from pettingzoo import aec_registry, parallel_registry

from coopenv.base.installation import environment_id, is_scene, list_envs

if TYPE_CHECKING:
    from gymnasium.envs.registration import EnvSpec
    from pettingzoo import AECEnv

    from coopenv.api.parallel_env import CooperativeLocalisationEnv


def make_parallel(name_or_path: Any, max_cycles: int | None = None, **options: Any) -> CooperativeLocalisationEnv:
    """Entry point of PettingZoo's parallel registry.

    Args:
        name_or_path: environment.
        max_cycles: decision steps per episode instead of the scenario's horizon.
        options: those of `coopenv.parallel_env`.
    """
    from coopenv.api.make import parallel_env
    from coopenv.scenario import load_scenario

    if max_cycles is not None:
        rate = load_scenario(name_or_path, options.get("overrides")).rates.decision
        options["overrides"] = {**(options.get("overrides") or {}), "horizon": max_cycles / rate}
    return parallel_env(name_or_path, **options)


def make_aec(name_or_path: Any, **options: Any) -> AECEnv[str, Any, Any]:
    """Entry point of PettingZoo's AEC registry; arguments as for `make_parallel`."""
    from pettingzoo.utils import parallel_to_aec

    return parallel_to_aec(make_parallel(name_or_path, **options))


def registered_spec(environment: str, overrides: Mapping[str, Any] | None = None) -> EnvSpec | None:
    """Return the specification from which Gymnasium makes a vehicle of an environment; None: of a file's, without."""
    if environment not in list_envs() and not is_scene(environment):
        return None
    register_all()
    spec = gymnasium.spec(environment_id("scenario" if is_scene(environment) else environment))
    changes = {"overrides": dict(overrides)} if overrides else {}
    return replace(spec, kwargs={"name_or_path": environment, **changes})


def register_all() -> None:
    """Register what is not registered yet."""
    given = {identity: {"name_or_path": n} for n in list_envs() for identity in (environment_id(n), f"coopenv/{n}")}
    for name in (*list_envs(), "scenario"):
        if (identity := environment_id(f"{name}_rows")) not in gymnasium.registry:
            kwargs = {} if name == "scenario" else {"name_or_path": name}
            gymnasium.register(identity, vector_entry_point="coopenv.api.make:make_rows", kwargs=kwargs)
    for identity, kwargs in {**given, environment_id("scenario"): {}}.items():
        if identity not in gymnasium.registry:
            gymnasium.register(
                identity,
                entry_point="coopenv.api.single_vehicle:SingleVehicleEnv",
                kwargs=kwargs,
            )
        for kind, registry in (("parallel", parallel_registry), ("aec", aec_registry)):
            if identity not in registry:
                pettingzoo.register(kind, identity, entry_point=f"{__name__}:make_{kind}", kwargs=kwargs)
