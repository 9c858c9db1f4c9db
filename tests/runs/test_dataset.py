"""Episodes of single vehicles: what the environment gives when it is stepped, and what Minari reads back of them."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import coopenv
from coopenv.base.errors import CoopenvError
from coopenv.cli import main
from coopenv.policies import load_agent
from coopenv.runs.dataset import drive_vehicles
from tests.helpers.commands import refused
from tests.helpers.four_way import FOUR_WAY

OVERRIDES: dict[str, Any] = {"horizon": 8.0, "termination.after_arrival": "park"}


def follow(observations: np.ndarray) -> np.ndarray:
    """Full speed, and a turn that hits walls sooner or later."""
    return np.column_stack([np.ones(len(observations)), 0.3 * np.sign(observations[:, 0])])


def test_episodes_are_those_of_the_environment() -> None:
    scenario = coopenv.load_scenario(FOUR_WAY, OVERRIDES)
    episodes = drive_vehicles(scenario, follow, 5, 2)
    assert [(e.world, e.vehicle) for e in episodes] == [(w, f"vehicle_{i + 1}") for w in range(2) for i in range(4)]
    env = coopenv.parallel_env(FOUR_WAY, overrides=OVERRIDES)
    for world in range(2):
        mine = {e.vehicle: e for e in episodes if e.world == world}
        observations, infos = env.reset(seed=5, options={"world": world})
        for name, episode in mine.items():
            assert np.array_equal(episode.observations[0], observations[name])
            assert episode.position_error[0] == pytest.approx(infos[name]["position_error"])
        step = 0
        while env.agents:
            actions = {name: follow(observations[name][None])[0].astype(np.float32) for name in env.agents}
            observations, rewards, terminated, truncated, infos = env.step(actions)
            for name, reward in rewards.items():
                episode = mine[name]
                assert np.array_equal(episode.observations[step + 1], observations[name])
                assert np.array_equal(episode.actions[step], actions[name])
                assert episode.rewards[step] == pytest.approx(reward)
                assert episode.terminations[step] == terminated[name] and episode.truncations[step] == truncated[name]
                assert (len(episode.rewards) == step + 1) == (terminated[name] or truncated[name])
            step += 1
    assert any(e.terminations[-1] for e in episodes) and any(e.truncations[-1] for e in episodes)


def test_lengths_agree_and_agents_drive() -> None:
    scenario = coopenv.load_scenario("facade")
    for episode in drive_vehicles(scenario, load_agent("route_follower", scenario), 0, 3):
        steps = len(episode.rewards)
        assert episode.observations.shape == (steps + 1, coopenv.parallel_env("facade").engine.layout.size)
        assert episode.actions.shape == (steps, 2) and episode.position_error.shape == (steps + 1,)
        assert not (episode.terminations | episode.truncations)[:-1].any()
        assert episode.terminations[-1] or episode.truncations[-1]


def test_prescribed_motion_has_no_episodes() -> None:
    with pytest.raises(CoopenvError, match="nothing to drive"):
        drive_vehicles(coopenv.load_scenario("busy_intersection"), follow, 0, 1)


IDENTITY = "coopenv/facade/route_follower-v0"


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    pytest.importorskip("minari", reason="needs the extra minari")
    pytest.importorskip("h5py", reason="needs the extra minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    return tmp_path


def test_a_dataset_holds_the_episodes(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import minari

    assert main(["dataset", "facade", "--worlds", "3", "--seed", "7"]) == 0
    assert "3 episodes" in capsys.readouterr().out
    dataset = minari.load_dataset(IDENTITY)
    scenario = coopenv.load_scenario("facade")
    driven = drive_vehicles(scenario, load_agent("route_follower", scenario), 7, 3)
    assert dataset.total_episodes == 3 and dataset.total_steps == sum(len(e.rewards) for e in driven)
    for number, (read, own) in enumerate(zip(dataset.iterate_episodes(), driven, strict=True)):
        for name in ("observations", "actions", "rewards", "terminations", "truncations"):
            assert np.array_equal(getattr(read, name), getattr(own, name)), name
        assert np.array_equal(read.infos["position_error"], own.position_error)
        (facts,) = dataset.storage.get_episode_metadata([number])
        assert facts["options"] == {"world": number, "vehicle": 1}
    env = dataset.recover_environment()
    assert env.observation_space == dataset.spec.observation_space and env.action_space == dataset.spec.action_space
    assert list(minari.list_local_datasets()) == [IDENTITY]
    assert sorted(path.name for path in root.rglob("*") if path.is_file()) == ["main_data.hdf5", "metadata.json"]


def test_a_dataset_that_is_there_is_kept_unless_forced(root: Path) -> None:
    import minari

    arguments = ["dataset", "facade", "--set", "horizon=2.0", "--id", "own/short-v3", "--worlds"]
    assert main([*arguments, "2"]) == 0
    assert "exists already" in refused(*arguments, "4")
    assert minari.load_dataset("own/short-v3").total_episodes == 2
    assert main([*arguments, "4", "--force"]) == 0
    assert minari.load_dataset("own/short-v3").total_episodes == 4
    assert minari.load_dataset("own/short-v3").spec.env_spec is None  # of an environment that nobody registered


def test_a_full_disk_is_found_before_anything_is_written(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """HDF5 itself would end the process."""
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=100_000))
    error = refused("dataset", "facade", "--worlds", "2")
    assert "the dataset may need" in error and "0.1 MiB are free" in error
    assert not list(root.iterdir())


@pytest.mark.parametrize("identity", ["no_version", "../out-v0", "a b-v0", "-v0"])
def test_identities_that_are_none_are_refused(identity: str, root: Path) -> None:
    assert "expected NAMESPACE/NAME-v0" in refused("dataset", "facade", f"--id={identity}")
    assert not list(root.iterdir())
