"""Films of scenes: which frames they show, and in which formats."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import coopenv
from coopenv.api.engine import Engine
from coopenv.base.errors import CoopenvError, OutputError
from coopenv.runs.live import frames_at, write_film
from coopenv.runs.scenes import scene_of
from coopenv.viz.scene import SceneRecord, Source
from coopenv.viz.topview import TopView


@pytest.fixture(scope="module")
def record() -> SceneRecord:
    scenario = coopenv.load_scenario("overtaking", {"horizon": 3.0})
    return scene_of(Engine(scenario), Source.of("overtaking", scenario, seed=0))


def test_a_film_shows_the_frame_that_is_there() -> None:
    time = np.array([0.0, 0.1, 0.2, 0.5])
    np.testing.assert_array_equal(frames_at(time, 10.0, 1.0), [0, 1, 2, 2, 2, 3])
    np.testing.assert_array_equal(frames_at(time, 10.0, 2.5), [0, 2, 3])
    np.testing.assert_array_equal(frames_at(time, 20.0, 1.0)[:4], [0, 0, 1, 1])
    np.testing.assert_array_equal(frames_at(np.array([1.0]), 10.0, 1.0), [0])


@pytest.mark.parametrize("suffix", [".webp", ".gif"])
def test_a_film_is_the_top_view_in_time(suffix: str, record: SceneRecord, tmp_path: Path) -> None:
    path = tmp_path / f"film{suffix}"
    assert write_film(record, path, fps=5.0, width=448, panel=False) == 16
    with Image.open(path) as film:
        assert film.n_frames == 16 and film.size[0] == 448
        film.seek(15)
        film.load()
        assert film.info["duration"] == 200
        shown = np.asarray(film.convert("RGB"), float)
    last = TopView(record.scenario, panel=False).paint(record.frame(len(record) - 1))
    wanted = np.asarray(Image.fromarray(last).resize(shown.shape[1::-1]), float)
    assert np.abs(shown - wanted).mean() < 8.0


def test_mp4_has_every_picture(record: SceneRecord, tmp_path: Path) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="needs the extra 'video'")
    assert write_film(record, tmp_path / "film.mp4", fps=10.0, speed=2.0) == 16
    assert ffmpeg.count_frames_and_secs(str(tmp_path / "film.mp4"))[0] == 16


def test_other_formats_and_missing_extras_are_told(
    record: SceneRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(OutputError, match=r"film\.avi: unknown format of a film; known: \.mp4, \.gif, \.webp"):
        write_film(record, tmp_path / "film.avi", fps=10.0)
    monkeypatch.setattr("coopenv.runs.video.find_spec", lambda name: None)
    with pytest.raises(CoopenvError, match=r"pip install '\.\[video\]'"):
        write_film(record, tmp_path / "film.mp4", fps=10.0)
    assert not list(tmp_path.iterdir())
