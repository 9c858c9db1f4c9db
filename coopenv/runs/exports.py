"""Episodes in the formats of other programs: trajectories in the TUM format, and datasets of Minari."""

import os
import shutil
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from io import StringIO
from itertools import product
from pathlib import Path
from typing import Any, Self

import numpy as np
from gymnasium.spaces import Box

from coopenv.api.engine import Engine
from coopenv.api.terms.layout import action_space, observation_layout, observation_space
from coopenv.base.errors import CoopenvError, OutputError
from coopenv.base.files import check_new, replace_text, replacing_folder, writing
from coopenv.base.installation import environment, install_command, needing, version
from coopenv.episode import Episode, Views
from coopenv.estimation.poses import quaternion_wxyz
from coopenv.estimation.trajectory import Trajectory
from coopenv.evaluation.episodes import play
from coopenv.policies import Policy
from coopenv.scenario import Scenario


def write_tum(trajectory: Trajectory, folder: str | Path) -> list[Path]:
    """Write `VEHICLE_truth.tum` and `VEHICLE_estimate.tum` of every vehicle, and return their paths.

    Poses are of the body in the map frame, m; ticks at which a pose is not finite are left out.

    Raises:
        OutputError: the folder cannot be made or written to.
    """
    folder = Path(folder)
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for i, name in enumerate(trajectory.vehicles.tolist()):
        poses = {
            "truth": (trajectory.position[:, i], trajectory.rotation[:, i]),
            "estimate": (trajectory.position_estimate[:, i], trajectory.rotation_estimate[:, i]),
        }
        for kind, (position, rotation) in poses.items():
            known = np.isfinite(position).all(axis=1) & np.isfinite(rotation).all(axis=(1, 2))
            quaternion = quaternion_wxyz(rotation[known])[:, [1, 2, 3, 0]]
            text = StringIO()
            np.savetxt(text, np.column_stack([trajectory.t[known], position[known], quaternion]), "%.9f")
            paths.append(folder / f"{name}_{kind}.tum")
            replace_text(paths[-1], text.getvalue())
    return paths


STEPS = ("observation", "actions", "reward", "terminated", "truncated")
"""Arrays of an engine that a dataset is made of, beside those of an episode."""


@dataclass(frozen=True)
class DrivenEpisode:
    """Observations, actions and rewards of one vehicle until it ended or its world did; T decisions."""

    world: int
    vehicle: str
    observations: np.ndarray
    """(T + 1, D) float32, from the start to the last."""
    actions: np.ndarray
    """(T, A) float32 in [-1, 1]; of a recording the measured velocities, m/s and rad/s."""
    rewards: np.ndarray
    """(T,)."""
    terminations: np.ndarray
    """(T,) bool: it arrived, collided or fulfilled another condition."""
    truncations: np.ndarray
    """(T,) bool: the horizon cut it off."""
    position_error: np.ndarray
    """(T + 1,) m, against the truth."""

    @classmethod
    def of(cls, kept: Mapping[str, np.ndarray], world: int, name: str, actions: np.ndarray) -> Self:
        """Return the episode of a vehicle from its arrays (K, ...) by name, and the actions (K - 1, A) between rows."""
        ended = (kept["terminated"] + kept["truncated"])[1:] > 0
        length = int(next(iter(np.flatnonzero(ended)), len(ended) - 1)) + 1
        after, whole = slice(1, length + 1), slice(length + 1)
        return cls(
            world=world,
            vehicle=name,
            observations=kept["observation"][whole].astype(np.float32),
            actions=actions[:length].astype(np.float32),
            rewards=kept["reward"][after].astype(float),
            terminations=kept["terminated"][after].astype(bool),
            truncations=kept["truncated"][after].astype(bool),
            position_error=kept["position_error"][whole].astype(float),
        )


def drive_vehicles(
    scenario: Scenario,
    policy: Policy,
    seed: int,
    worlds: int,
    on_progress: Callable[[float], None] = lambda share: None,
) -> list[DrivenEpisode]:
    """Let a policy drive an episode in every world of a seed; return one per acting vehicle that is there.

    Args:
        scenario: has acting vehicles.
        policy: chooses for all rows, (world, vehicle).
        seed: of the batch, as of `make_vec(...).reset(seed=...)`.
        worlds: number of worlds.
        on_progress: called with the share of the horizon that is done.

    Raises:
        CoopenvError: nothing is driven, or the policy returns something else than actions.
    """
    if not any(scenario.acting):
        raise CoopenvError("all motion here is prescribed or has a driver, there is nothing to drive")
    engine = Engine(scenario, worlds)
    views, ticks = Views(engine, (*STEPS, "position_error")), scenario.horizon_ticks
    for tick in play(engine, seed, ticks, policy, False, stride=scenario.ticks_per_decision):
        views.take()
        on_progress(tick / ticks)
        if tick == 0:
            there = engine.view("alive").copy()
    engine.close()
    kept, episodes = {name: views[name] for name in (*STEPS, "position_error")}, []
    for world, i in product(range(worlds), np.flatnonzero(scenario.acting)):
        if there[world, i]:
            own = {name: array[:, world, i] for name, array in kept.items()}
            episodes.append(DrivenEpisode.of(own, world, scenario.vehicle_names[i], own["actions"][1:]))
    return episodes


def vehicle_episodes(episode: Episode) -> list[DrivenEpisode]:
    """Return one per vehicle of an episode that has been recorded with `STEPS`; each tick counts as a decision.

    The actions of a recording are not known; the measured velocities stand in their place.
    """
    L, kept = len(episode.scenario.landmarks), {name: episode[name] for name in (*STEPS, "position_error")}
    actions = kept["actions"][1:]
    if episode.source.seed is None:
        twist = (episode.measured.velocity[1:], episode.measured.angular_velocity[1:])
        actions = np.concatenate(twist, axis=-1)
    there = episode.rows["present"][0][L:] != 0
    return [
        DrivenEpisode.of({name: array[:, i] for name, array in kept.items()}, 0, vehicle, actions[:, i])
        for i, vehicle in enumerate(episode.scenario.vehicle_names)
        if there[i]
    ]


FILES = ("main_data.hdf5", "metadata.json")
"""Files of a dataset, in its folder `data`."""
PER_EPISODE = 1 << 16
"""Bytes that an episode takes at most besides its arrays."""


def dataset_place(identity: str, root: Path | None, force: bool) -> Path:
    """Return the folder of a dataset's files.

    Args:
        identity: `namespace/name-v0`.
        root: folder of datasets; None: Minari's own, the variable MINARI_DATASETS_PATH or ~/.minari/datasets.
        force: permit an existing one.

    Raises:
        CoopenvError: Minari is not installed, or the identity is not one.
        OutputError: the dataset is there.
    """
    with needing(f"a dataset needs Minari: {install_command('minari')}"):
        import h5py  # noqa: F401 (Minari imports it late)
        from minari.dataset.minari_dataset import parse_dataset_id
    try:
        parse_dataset_id(identity)
    except (ValueError, TypeError):
        raise CoopenvError(
            f"--id {identity}: expected NAMESPACE/NAME-v0, each two or more letters, digits, - and _"
        ) from None
    own = os.environ.get("MINARI_DATASETS_PATH") or Path.home() / ".minari" / "datasets"
    place = (root or Path(own)) / identity / "data"
    check_new(place, force, place.parent)
    return place


def write_dataset(
    episodes: Sequence[DrivenEpisode], scenario: Scenario, spec: Any, place: Path, identity: str, facts: dict[str, str]
) -> None:
    """Write episodes as a dataset, which takes the place of an older one.

    Args:
        episodes: in their order, at least one.
        scenario: scenario of the episodes.
        spec: Gymnasium's, of the environment that readers recover; None: of none.
        place: the result of `dataset_place`.
        identity: the dataset's.
        facts: Minari's entries of algorithm and description.

    Raises:
        OutputError: it cannot be written.
    """
    space = action_space(scenario)
    if episodes[0].actions.shape[1:] != space.shape:
        space = Box(-np.inf, np.inf, episodes[0].actions.shape[1:])
    size = sum(value.nbytes for episode in episodes for value in vars(episode).values() if hasattr(value, "nbytes"))
    needed = 2 * size + PER_EPISODE * len(episodes)
    with writing(place):  # HDF5 ends the process where the disk has no room (seen with h5py 3.16)
        free = shutil.disk_usage(next(folder for folder in place.absolute().parents if folder.is_dir())).free
        if free < needed:
            sizes = f"{needed / 2**20:.1f} MiB, {free / 2**20:.1f} MiB are free"
            raise OutputError(f"cannot write to {place.parent}: the dataset may need {sizes}")
        place.parent.mkdir(parents=True, exist_ok=True)
    with (
        replacing_folder(place, FILES) as new,
        environment({"MINARI_DATASETS_PATH": str(new)}),
        warnings.catch_warnings(action="ignore", category=UserWarning),  # notes on authors
        writing(place),
    ):
        import minari
        from minari.data_collector import EpisodeBuffer

        arrays = ("observations", "actions", "rewards", "terminations", "truncations")
        buffers: list[Any] = [
            EpisodeBuffer(
                id=number,
                options={"world": episode.world, "vehicle": _number(episode.vehicle)},
                infos={"position_error": episode.position_error},
                **{name: getattr(episode, name) for name in arrays},
            )
            for number, episode in enumerate(episodes)
        ]
        minari.create_dataset_from_buffers(
            dataset_id=identity,
            buffer=buffers,
            env=spec,
            requirements=[f"coopenv=={version()}"],
            data_format="hdf5",
            observation_space=observation_space(observation_layout(scenario)),
            action_space=space,
            **facts,
        )
        for file in FILES:
            (new / identity / "data" / file).rename(new / file)
        shutil.rmtree(new / identity.split("/")[0])


def _number(vehicle: str) -> int | str:
    """Return 1 of `vehicle_1`, and a name without a number as it is."""
    number = vehicle.rpartition("_")[2]
    return int(number) if number.isdigit() else vehicle
