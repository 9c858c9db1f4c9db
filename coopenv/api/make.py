"""Environments by name: `coopenv.parallel_env`, `coopenv.make_vec`, and the entry points of Gymnasium's registry."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv

from coopenv.api.arguments import RewardFunction
from coopenv.api.parallel_env import CooperativeLocalisationEnv
from coopenv.api.vector_env import ActingRows, ArrayKind, CooperativeVectorEnv
from coopenv.base.errors import CoopenvError, explained
from coopenv.observers.contract import Factory
from coopenv.observers.registry import with_observer
from coopenv.scenario import ScenarioLike, scenario_name
from coopenv.sources.base import Backend
from coopenv.sources.sources import open_backend, open_simulation, source_name


@explained
def parallel_env(
    name_or_path: ScenarioLike,
    *,
    render_mode: str | None = None,
    observer: str | Factory | None = None,
    backend: str | Backend | None = None,
    observation: Literal["flat", "dict"] = "flat",
    device: str = "cpu",
    dtype: str = "float32",
    overrides: Mapping[str, Any] | None = None,
    data: str | Path | None = None,
    variant: str | None = None,
    topics: str | Path | None = None,
    reward: RewardFunction | None = None,
    deployment: str | Path | None = None,
    car: str | None = None,
    record: str | Path | None = None,
    connect: str | None = None,
) -> CooperativeLocalisationEnv:
    """Return an environment by name (`coopenv.list_envs()`), from a TOML file, or from a recording.

    A recording is replayed unchanged, actions are ignored; see docs/replay.md, and docs/bags.md for ROS bags.

    Args:
        name_or_path: for example "busy_intersection"; "mrclam_6", "drive.mcap" or "drive.bag" replay what was
            recorded. Whatever else `coopenv.load_scenario` takes is simulated: a TOML file, a dict, a `Scenario`. Where
            `backend` is an object, any name for the environment.
        render_mode: None, "rgb_array" or "human".
        observer: estimator that every vehicle runs, embedded or a plug-in: a name, a class, or an import path
            (`mine.py:Mine`, `package.module:Mine`); None: that of the scenario.
        backend: where measurements come from, "simulated", "highway", "replay" or "svea", or a
            `coopenv.sources.base.Backend`, which has its own scenario; None: by the name.
        observation: "flat" Box or one-level "dict".
        device: "cpu" or a CUDA device.
        dtype: "float32" or "float64" (of the world; observations are float32).
        overrides: dotted scenario keys, for example {"noise.enabled": False}.
        data: folder of recorded data sets; None: COOPENV_DATA.
        variant: of a recorded data set: "landmarks", "landmarks+robots" (the default) or "blind".
        topics: of a ROS bag: the TOML file with the meaning of its topics.
        reward: a function of a `coopenv.api.arguments.Step` that returns the rewards (1, vehicles); None: the weighted
            sum of the scenario's terms.
        deployment: file with the cars; for `backend="svea"`, see docs/cars.md.
        car: name of the car that is estimated and driven here; the other ones only send (None: all cars).
        record: MCAP file for all messages from and to the cars.
        connect: endpoint of the cars' network in place of that of the deployment, for example "tcp/127.0.0.1:7447".

    Raises:
        UnknownEnvironmentError: no such environment.
        ScenarioError: the file or an override is not valid.
        CoopenvError: another argument is not valid.
    """
    return CooperativeLocalisationEnv(
        open_backend(
            name_or_path,
            backend,
            with_observer(overrides, observer),
            data=data,
            variant=variant,
            topics=topics,
            deployment=deployment,
            car=car,
            record=record,
            connect=connect,
        ),
        source_name(name_or_path),
        render_mode=render_mode,
        observation=observation,
        device=device,
        dtype=dtype,
        reward=reward,
    )


@explained
def make_vec(
    name_or_path: ScenarioLike,
    *,
    num_worlds: int,
    device: str = "cpu",
    dtype: str = "float32",
    autoreset: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    overrides: Mapping[str, Any] | None = None,
    arrays: ArrayKind | None = None,
    threads: int | None = None,
    render_mode: str | None = None,
    reward: RewardFunction | None = None,
    observer: str | Factory | None = None,
    observation: Literal["flat", "dict"] = "flat",
) -> CooperativeVectorEnv:
    """Return a batch of worlds as a Gymnasium `VectorEnv` with num_worlds x vehicles rows.

    Stable-Baselines3 has another interface: `coopenv.api.trainers.sb3.make_sb3_vec_env` takes the same arguments.

    Args:
        name_or_path: environment by name, TOML file, dict or scenario, as for `coopenv.load_scenario`.
        num_worlds: how many worlds.
        device: "cpu" or a CUDA device.
        dtype: precision of the worlds; observations and rewards are float32.
        autoreset: "next_step", "same_step" or "disabled".
        overrides: dotted scenario keys.
        arrays: "numpy" (default on the CPU) or "torch" (default on CUDA).
        threads: shares of the batch, or of large worlds, on the CPU; None: by size and cores.
        render_mode: None or "rgb_array".
        reward: a function of a `coopenv.api.arguments.Step` that returns the rewards (num_worlds, vehicles), on the CPU
            only; None: the weighted sum of the scenario's terms.
        observer: estimator that every vehicle runs, as for `coopenv.parallel_env`; None: that of the scenario.
        observation: "flat" rows, or a "dict" of arrays (num_envs, size) by field.

    Raises:
        CoopenvError: any argument is not valid.
    """
    return CooperativeVectorEnv(
        open_simulation(name_or_path, with_observer(overrides, observer)),
        scenario_name(name_or_path),
        num_worlds=num_worlds,
        device=device,
        dtype=dtype,
        autoreset=autoreset,
        arrays=arrays,
        threads=threads,
        render_mode=render_mode,
        reward=reward,
        observation=observation,
    )


def make_rows(
    name_or_path: ScenarioLike,
    num_envs: int = 1,
    vectorization_mode: Literal["vector_entry_point"] | None = None,
    acting: bool = False,
    **options: Any,
) -> VectorEnv[Any, Any, Any]:
    """Entry point of `gymnasium.make_vec("coopenv/...Rows-v0", num_envs=rows)`; `acting`: rows of `ActingRows`.

    Raises:
        CoopenvError: `num_envs` is not a multiple of the vehicles.
    """
    if "num_worlds" in options:
        raise CoopenvError("give num_envs, which counts rows (world, vehicle), instead of num_worlds")
    acts = open_simulation(name_or_path, options.get("overrides")).acting
    vehicles = acts.count(True) if acting else len(acts)
    if not isinstance(num_envs, int | np.integer) or num_envs < 1 or num_envs % max(1, vehicles):
        raise CoopenvError(
            f"num_envs counts rows (world, vehicle): {num_envs} is not a positive multiple of the {vehicles} "
            f"{'acting ' if acting else ''}vehicles of {name_or_path}"
        )
    env = make_vec(name_or_path, num_worlds=int(num_envs) // max(1, vehicles), **options)
    return ActingRows(env) if acting else env
