"""Any source gives an episode, and every view of it shows where the vehicles were."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image

from coopenv.episode import RECORDED, Episode
from coopenv.estimation.trajectory import Trajectory
from coopenv.runs.exports import STEPS, dataset_place, vehicle_episodes, write_dataset, write_tum
from coopenv.runs.films import top_view_film, write_film
from coopenv.runs.recorder import record_episode
from coopenv.runs.scenes import frame_stride
from coopenv.sources.mcap import read_recording, write_recording
from coopenv.sources.sources import open_backend
from coopenv.viz.figures import draw_figure
from coopenv.viz.stage import Stage
from coopenv.viz.style import vehicle_colour
from coopenv.viz.topview_ground import HEIGHT, LEFT, SIDE
from tests.helpers import bags, mrclam_files
from tests.helpers.four_way import FOUR_WAY
from tests.helpers.pages import messages

SECONDS = 1.0


def simulation(folder: Path) -> Any:
    return open_backend(FOUR_WAY, None, {"horizon": SECONDS})


def log(folder: Path) -> Any:
    write_recording(record_episode(simulation(folder), seed=3, policy="route_follower").measured, folder / "drive.mcap")
    return open_backend(folder / "drive.mcap", None, {})


def cars(folder: Path) -> Any:
    topics = folder / "topics.toml"
    topics.write_text(bags.MAP, encoding="utf-8")
    return open_backend(bags.write(folder / "bag", bags.sent(), "mcap"), None, {"horizon": SECONDS}, topics=topics)


def robots(folder: Path) -> Any:
    mrclam_files.write(folder, seconds=8.0)
    return open_backend("mrclam_6", None, {"horizon": SECONDS}, data=folder)


SOURCES = {source.__name__: source for source in (simulation, log, cars, robots)}


@pytest.fixture(scope="module")
def episode_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Episode]:
    @cache
    def recorded(source: str) -> Episode:
        with warnings.catch_warnings(action="ignore"):  # of a short drive
            backend = SOURCES[source](tmp_path_factory.mktemp(source))
            policy = "route_follower" if source == "simulation" else "zero"
            return record_episode(backend, 3, policy, name=source, fields=(*RECORDED, *STEPS))

    return recorded


def as_trajectory(episode: Episode, folder: Path) -> None:
    episode.trajectory.save(folder / "trajectory.npz")
    again = Trajectory.load(folder / "trajectory.npz")
    np.testing.assert_array_equal(again.position, episode.trajectory.position)
    np.testing.assert_array_equal(again.position_estimate, episode.trajectory.position_estimate)


def as_frames(episode: Episode, folder: Path) -> None:
    stride = frame_stride(episode.scenario)
    episode.drawn(stride).save(folder / "scene.npz")
    again, chosen = Episode.load(folder / "scene.npz"), [*range(0, len(episode) - 1, stride), len(episode) - 1]
    assert again["tick"].tolist() == chosen
    for name in ("position", "position_estimate"):
        expected = getattr(episode.trajectory, name)[chosen]
        np.testing.assert_allclose(getattr(again.trajectory, name), expected, rtol=1e-6, atol=1e-6)


def as_log(episode: Episode, folder: Path) -> None:
    write_recording(episode.measured, folder / "log.mcap")
    again = read_recording(folder / "log.mcap")
    np.testing.assert_array_equal(again.truth.position, episode.trajectory.position)
    np.testing.assert_array_equal(again.bearings, episode.measured.bearings)


def as_foxglove(episode: Episode, folder: Path) -> None:
    pytest.importorskip("foxglove", reason="needs the extra log")
    from coopenv.foxglove.log_views import views
    from coopenv.sources.mcap_container import Container
    from coopenv.sources.mcap_format import codec

    write_recording(episode.measured, folder / "log.mcap", views=views(episode))
    shown = 0
    for channel, schema, message in Container(folder / "log.mcap").messages():
        vehicle, _, topic = channel.topic[1:].partition("/")
        if topic == "estimate":
            point = codec().deserialize_cdr(message.data, schema.name).pose.pose.position
            i, expected = episode.scenario.vehicle_names.index(vehicle), episode.trajectory.position_estimate
            np.testing.assert_allclose([point.x, point.y, point.z], expected[message.sequence, i], rtol=1e-5, atol=1e-6)
            shown += 1
    assert shown >= len(episode.scenario.vehicles)


def as_tum(episode: Episode, folder: Path) -> None:
    for path in write_tum(episode.trajectory, folder / "tum"):
        vehicle, _, kind = path.stem.rpartition("_")
        poses = episode.trajectory.position if kind == "truth" else episode.trajectory.position_estimate
        expected = poses[:, episode.scenario.vehicle_names.index(vehicle)]
        known = np.isfinite(expected).all(axis=1)
        np.testing.assert_allclose(np.loadtxt(path)[:, 1:4], expected[known], atol=1e-8)


def as_minari(episode: Episode, folder: Path) -> None:
    pytest.importorskip("h5py", reason="needs the extra minari")
    minari = pytest.importorskip("minari", reason="needs the extra minari")
    place, driven = dataset_place("own/episode-v0", folder, force=False), vehicle_episodes(episode)
    facts = {"algorithm_name": "none", "description": episode.source.words}
    write_dataset(driven, episode.scenario, None, place, "own/episode-v0", facts)
    dataset, run = minari.MinariDataset(place), episode.trajectory
    assert dataset.total_episodes == len(run.vehicles)
    error = np.linalg.norm(run.position - run.position_estimate, axis=-1)
    for i, read in enumerate(dataset.iterate_episodes()):
        assert dataset.spec.action_space.contains(read.actions[0])
        length = len(read.infos["position_error"])
        np.testing.assert_allclose(read.infos["position_error"], error[:length, i], rtol=1e-6, atol=1e-9)


def as_figure(episode: Episode, folder: Path) -> None:
    figure = draw_figure("trajectories_2d", episode.trajectory, scenario=episode.scenario)
    figure.savefig(folder / "paths.png")
    assert Image.open(folder / "paths.png").getextrema() != ((255, 255),) * 4
    drawn = [line.get_xydata() for line in figure.axes[0].lines]
    for start in episode.trajectory.position[0, :, :2]:
        assert any(len(points) == 1 and np.allclose(points[0], start) for points in drawn)


def as_film(episode: Episode, folder: Path) -> None:
    few, stage = episode.of([0, len(episode) - 1]), Stage(episode.scenario)
    assert write_film(top_view_film(few, panel=False), folder / "film.gif", 2.0) >= 2
    film = Image.open(folder / "film.gif")
    film.seek(film.n_frames - 1)
    picture = np.asarray(film.convert("RGB"), float) / 255.0
    for i, place in enumerate(few.frame(1).position[:, :2]):
        column, row = LEFT + SIDE * (place - stage.low) / stage.side
        around = picture[round(HEIGHT - row) - 8 :, round(column) - 8 :][:17, :17].reshape(-1, 3)
        assert np.abs(around - to_rgb(vehicle_colour(i))).max(axis=1).min() < 0.4, i  # a GIF has 64 colours


def as_page(episode: Episode, folder: Path) -> None:
    pytest.importorskip("viser", reason="needs the extra view")
    from coopenv.viz.web import write_replay

    few = episode.drawn(frame_stride(episode.scenario))
    page = write_replay(few, folder / "replay.html").read_text(encoding="utf-8")
    length, sent = messages(page)
    assert length == pytest.approx(few.length)
    half = Stage(episode.scenario).bodies()[0][:, :1] / 2  # cars lie at the centres of their bodies
    for when, frame in ((0.0, few.frame(0)), (few.length, few.frame(len(few) - 1))):
        parts = [
            message.get("props", message.get("updates", {})).get("batched_positions")
            for time, message in sent
            if message.get("name") == "/world/cars/true" and time <= when + 1e-6
        ]
        places = [part for part in parts if part is not None][-1].reshape(-1, 3)
        assert (np.abs(places[:, :2] - frame.position[:, :2]) < half).all()


VIEWS = {name.removeprefix("as_"): view for name, view in [*globals().items()] if name.startswith("as_")}


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("source", SOURCES)
def test_every_view_of_every_source_has_the_positions_of_the_episode(
    source: str, view: str, episode_of: Callable[[str], Episode], tmp_path: Path
) -> None:
    VIEWS[view](episode_of(source), tmp_path)
