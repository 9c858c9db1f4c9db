"""Register every shipped environment with Gymnasium and PettingZoo as `coopenv/<CamelCase>-v0`, and by its own name.

Entry points are strings, and what they need is imported when an environment is made: `import coopenv` costs little.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium
import pettingzoo
from pettingzoo import aec_registry, parallel_registry

from coopenv.base.installation import environment_id, list_envs

if TYPE_CHECKING:
    from pettingzoo import AECEnv

    from coopenv.api.parallel_env import CooperativeLocalisationEnv


def make_parallel(name: str, max_cycles: int | None = None, **options: Any) -> CooperativeLocalisationEnv:
    """Entry point of PettingZoo's parallel registry.

    Args:
        name: environment.
        max_cycles: decision steps per episode instead of the scenario's horizon.
        options: those of `coopenv.parallel_env`.
    """
    from coopenv.api.make import parallel_env
    from coopenv.scenario import load_scenario

    if max_cycles is not None:
        rate = load_scenario(name, options.get("overrides")).rates.decision
        options["overrides"] = {**(options.get("overrides") or {}), "horizon": max_cycles / rate}
    return parallel_env(name, **options)


def make_aec(name: str, **options: Any) -> AECEnv[str, Any, Any]:
    """Entry point of PettingZoo's AEC registry; arguments as for `make_parallel`."""
    from pettingzoo.utils import parallel_to_aec

    return parallel_to_aec(make_parallel(name, **options))


def register_all() -> None:
    """Register what is not registered yet."""
    for name in list_envs():
        for identity in (environment_id(name), f"coopenv/{name}", name):
            if identity not in gymnasium.registry:
                gymnasium.register(
                    identity,
                    entry_point="coopenv.policies.single_vehicle:SingleVehicleEnv",
                    vector_entry_point="coopenv.api.make:make_rows",
                    kwargs={"name_or_path": name},
                )
            for kind, registry in (("parallel", parallel_registry), ("aec", aec_registry)):
                if identity not in registry:
                    pettingzoo.register(kind, identity, entry_point=f"{__name__}:make_{kind}", kwargs={"name": name})
