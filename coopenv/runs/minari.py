"""Episodes as a Minari dataset, a row of single-agent episodes; needs the extra `minari`."""

import os
import shutil
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium

from coopenv.api.registration import register_all
from coopenv.api.terms.layout import action_space, flat_space, observation_layout
from coopenv.base.errors import CoopenvError, OutputError
from coopenv.base.files import replacing_folder, writing
from coopenv.base.installation import environment, environment_id, version
from coopenv.runs.driven import DrivenEpisode
from coopenv.scenario import Scenario

FILES = ("main_data.hdf5", "metadata.json")
"""Of a dataset, in its folder `data`."""
PER_EPISODE = 1 << 16
"""Bytes that an episode takes at most besides its arrays."""


def dataset_place(identity: str, root: Path | None, force: bool) -> Path:
    """Return the folder of a dataset's files.

    Args:
        identity: `namespace/name-v0`.
        root: folder of datasets; None: Minari's own, the variable MINARI_DATASETS_PATH or ~/.minari/datasets.
        force: whether it may be there.

    Raises:
        CoopenvError: Minari is not installed, or the identity is not one.
        OutputError: the dataset is there.
    """
    try:
        import h5py  # noqa: F401 (Minari imports it late)
        from minari.dataset.minari_dataset import parse_dataset_id
    except ImportError as error:
        raise CoopenvError(f"a dataset needs Minari: pip install '.[minari]' ({error})") from None
    try:
        parse_dataset_id(identity)
    except (ValueError, TypeError):
        raise CoopenvError(f"--id {identity}: expected NAMESPACE/NAME-v0, of letters, digits, - and _") from None
    own = os.environ.get("MINARI_DATASETS_PATH") or Path.home() / ".minari" / "datasets"
    place = (root or Path(own)) / identity / "data"
    if place.exists() and not force:
        raise OutputError(f"{place.parent}: exists already; --force replaces it")
    return place


def write_dataset(
    episodes: Sequence[DrivenEpisode], scenario: Scenario, name: str, place: Path, identity: str, facts: dict[str, str]
) -> None:
    """Write episodes as a dataset, which takes the place of an older one.

    Args:
        episodes: in their order.
        scenario: that they were driven in.
        name: of the registered environment; empty for another one.
        place: what `dataset_place` returned.
        identity: the dataset's.
        facts: what Minari keeps of algorithm and description.

    Raises:
        OutputError: it cannot be written.
    """
    with writing(place):
        _check_room(place, episodes)
        place.parent.mkdir(parents=True, exist_ok=True)
    with replacing_folder(place, FILES) as new, _datasets_in(new), writing(place):
        import minari

        register_all()
        spaces = {"observation_space": flat_space(observation_layout(scenario)), "action_space": action_space(scenario)}
        minari.create_dataset_from_buffers(
            dataset_id=identity,
            buffer=list(_buffers(episodes)),
            env=gymnasium.spec(environment_id(name)) if name else None,
            requirements=[f"coopenv=={version()}"],
            data_format="hdf5",
            **spaces,
            **facts,
        )
        for file in FILES:
            (new / identity / "data" / file).rename(new / file)
        shutil.rmtree(new / identity.split("/")[0])


def _check_room(place: Path, episodes: Sequence[DrivenEpisode]) -> None:
    """Make sure that the disk has room: HDF5 ends the process where it has none (seen with h5py 3.16).

    Raises:
        OutputError: it has not.
    """
    arrays = sum(value.nbytes for episode in episodes for value in vars(episode).values() if hasattr(value, "nbytes"))
    needed = 2 * arrays + PER_EPISODE * len(episodes)
    free = shutil.disk_usage(next(folder for folder in place.absolute().parents if folder.is_dir())).free
    if free < needed:
        told = f"{needed / 2**20:.1f} MiB, {free / 2**20:.1f} MiB are free"
        raise OutputError(f"cannot write to {place.parent}: the dataset may need {told}")


def _buffers(episodes: Sequence[DrivenEpisode]) -> Iterator[Any]:
    from minari.data_collector import EpisodeBuffer

    for number, episode in enumerate(episodes):
        yield EpisodeBuffer(
            id=number,
            options={"world": episode.world, "vehicle": int(episode.vehicle.rpartition("_")[2])},
            observations=episode.observations,
            actions=episode.actions,
            rewards=episode.rewards,
            terminations=episode.terminations,
            truncations=episode.truncations,
            infos={"position_error": episode.position_error},
        )


@contextmanager
def _datasets_in(folder: Path) -> Iterator[None]:
    """Let Minari write its datasets to a folder meanwhile, and say nothing of authors."""
    with environment({"MINARI_DATASETS_PATH": str(folder)}), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        yield
