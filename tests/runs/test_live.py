"""Episodes as films, without a display."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from inspect import GEN_CLOSED, getgeneratorstate
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import coopenv
from coopenv.api.engine import Engine
from coopenv.base.errors import CoopenvError, OutputError
from coopenv.episode import Episode, Origin
from coopenv.runs.films import Shot, frames_at, top_view_film, write_film, write_pictures
from coopenv.runs.scenes import frame_stride, scene_of
from coopenv.viz.stage import Stage
from coopenv.viz.topview import TopView
from tests.helpers.processes import small_disk


@pytest.fixture(scope="module")
def record() -> Episode:
    scenario = coopenv.load_scenario("overtaking", {"horizon": 1.0})
    return scene_of(Engine(scenario), Origin.of("overtaking", scenario, seed=0))


def test_a_film_shows_the_frame_that_is_there() -> None:
    time = np.array([0.0, 0.1, 0.2, 0.5])
    np.testing.assert_array_equal(frames_at(time, 10.0, 1.0), [0, 1, 2, 2, 2, 3])
    np.testing.assert_array_equal(frames_at(time, 10.0, 2.5), [0, 2, 3])
    np.testing.assert_array_equal(frames_at(time, 20.0, 1.0)[:4], [0, 0, 1, 1])
    np.testing.assert_array_equal(frames_at(np.array([1.0]), 10.0, 1.0), [0])


@pytest.mark.parametrize("suffix", [".webp", ".gif"])
def test_a_film_is_the_top_view_in_time(suffix: str, record: Episode, tmp_path: Path) -> None:
    path = tmp_path / f"film{suffix}"
    assert write_film(top_view_film(record, False), path, fps=5.0, width=448) == 6
    with Image.open(path) as film:
        assert film.n_frames == 6 and film.size[0] == 448
        film.seek(5)
        film.load()
        assert film.info["duration"] == 200
        shown = np.asarray(film.convert("RGB"), float)
    last = TopView(record.scenario, panel=False).paint(record.frame(len(record) - 1))
    wanted = np.asarray(Image.fromarray(last).resize(shown.shape[1::-1]), float)
    assert np.abs(shown - wanted).mean() < 8.0


def test_films_stand_side_by_side_with_who_is_lost(record: Episode, tmp_path: Path) -> None:
    """Both vehicles are placed 3 and 0.1 m off, and 0.1 m each: they are about half a metre long."""
    (size, _), count = Stage(record.scenario).bodies(), len(record)
    assert (size[:, 0] > 0.2).all() and (size[:, 0] < 2.5).all()
    error = {name: np.tile(off, (count, 1)) for name, off in (("one", [3.0, 0.1]), ("none", [0.1, 0.1]))}
    records = {
        name: Episode(record.scenario, record.source, {**record.rows, "position_error": off})
        for name, off in error.items()
    }
    shots = [[Shot(each, TopView(each.scenario, panel=False), name) for name, each in records.items()]]
    write_film(shots, tmp_path / "film.webp", fps=1.0, width=1304)
    with Image.open(tmp_path / "film.webp") as film:
        picture = np.asarray(film.convert("RGB"), float)
        assert film.n_frames == 2 and film.size[0] == 1304
    left, right = picture[20, 300], picture[20, 652 + 300]
    assert left[0] > left[1] + 60.0 and right[1] > right[0] + 60.0  # vermilion, green


def test_a_short_row_of_a_film_ends_in_white(record: Episode, tmp_path: Path) -> None:
    shots = [Shot(record, TopView(record.scenario, panel=False)) for _ in range(3)]
    write_film([shots[:2], shots[2:]], tmp_path / "film.webp", fps=1.0, width=400)
    with Image.open(tmp_path / "film.webp") as film:
        picture = np.asarray(film.convert("RGB"), float)
    upper, lower = np.vsplit(picture[: len(picture) // 2 * 2], 2)
    assert np.abs(upper[:, :200] - lower[:, :200]).mean() < 4.0 and lower[:, 204:].min() > 240.0


def test_mp4_has_every_picture(record: Episode, tmp_path: Path) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="needs the extra 'video'")
    assert write_film(top_view_film(record), tmp_path / "film.mp4", fps=10.0, speed=2.0) == 6
    assert ffmpeg.count_frames_and_secs(str(tmp_path / "film.mp4"))[0] == 6


def test_other_formats_and_missing_extras_are_reported(
    record: Episode, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(OutputError, match=r"film\.avi: unknown format of a film; known: \.mp4, \.gif, \.webp"):
        write_film(top_view_film(record), tmp_path / "film.avi", fps=10.0)
    monkeypatch.setattr("coopenv.runs.films.find_spec", lambda name: None)
    with pytest.raises(CoopenvError, match=r"pip install '\.\[video\]'"):
        write_film(top_view_film(record), tmp_path / "film.mp4", fps=10.0)
    assert not list(tmp_path.iterdir())


def test_films_play_in_real_time(tmp_path: Path) -> None:
    assert frame_stride(coopenv.load_scenario("busy_intersection")) == 6
    assert frame_stride(coopenv.load_scenario("busy_intersection", {"rates.decision": 60.0})) == 3
    path = tmp_path / "video.gif"
    write_pictures(path, 15.0, (np.full((300, 960, 3), 10 * shade, dtype=np.uint8) for shade in range(15)))
    with Image.open(path) as image:
        assert image.size == (480, 150)
        duration = 0
        for frame in range(image.n_frames):
            image.seek(frame)
            duration += image.info["duration"]
    assert duration == 1000


def pictures(count: int) -> Iterator[np.ndarray]:
    return iter(np.random.default_rng(1).integers(0, 256, (count, 241, 321, 3), dtype=np.uint8))


def test_a_film_that_does_not_fit_on_the_disk_is_reported(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("imageio_ffmpeg", reason="needs the extra 'video'")
    with (
        small_disk(tmp_path / "disk", "200k") as disk,
        pytest.raises(OutputError, match=r"video.mp4: ffmpeg could not finish it") as error,
    ):
        write_pictures(disk / "video.mp4", 10.0, pictures(12))
    assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")


def test_nobody_writes_to_a_film_that_was_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="needs the extra 'video'")
    writers: list[Any] = []
    begin = ffmpeg.write_frames
    monkeypatch.setattr(ffmpeg, "write_frames", lambda *a, **k: (writers.append(begin(*a, **k)), writers[0])[1])

    def broken() -> Iterator[np.ndarray]:
        yield from pictures(1)
        raise KeyError

    with suppress(KeyError):
        write_pictures(tmp_path / "video.mp4", 10.0, broken())
    assert getgeneratorstate(writers[0]) == GEN_CLOSED


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_a_film_without_pictures_is_no_file(suffix: str, tmp_path: Path) -> None:
    if suffix == ".mp4":
        pytest.importorskip("imageio_ffmpeg", reason="needs the extra 'video'")
    write_pictures(tmp_path / f"video{suffix}", 10.0, [])
    assert list(tmp_path.iterdir()) == []
