"""MP4 films: whole, or told to be not."""

from __future__ import annotations

from contextlib import suppress
from inspect import GEN_CLOSED, getgeneratorstate
from pathlib import Path

import numpy as np
import pytest

from coopenv.base.errors import OutputError
from coopenv.runs.video import Mp4Film
from tests.helpers.processes import small_disk

ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="needs the extra 'video'")


def pictures(count: int) -> list[np.ndarray]:
    return list(np.random.default_rng(1).integers(0, 256, (count, 241, 321, 3), dtype=np.uint8))


def film(path: Path, count: int) -> None:
    made = Mp4Film(path, 10.0)
    for picture in pictures(count):
        made.add(picture)
    made.close()


def test_a_film_has_every_picture(tmp_path: Path) -> None:
    film(tmp_path / "video.mp4", 12)
    assert ffmpeg.count_frames_and_secs(str(tmp_path / "video.mp4"))[0] == 12


def test_a_film_that_does_not_fit_on_the_disk_is_told(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with (
        small_disk(tmp_path / "disk", "200k") as disk,
        pytest.raises(OutputError, match=r"video.mp4: ffmpeg could not finish it") as error,
    ):
        film(disk / "video.mp4", 12)
    assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")


def test_nobody_writes_to_a_film_that_was_left(tmp_path: Path) -> None:
    with suppress(KeyError), Mp4Film(tmp_path / "video.mp4", 10.0) as made:
        made.add(pictures(1)[0])
        raise KeyError
    assert getgeneratorstate(made._writer) == GEN_CLOSED


def test_a_film_without_pictures_is_no_file(tmp_path: Path) -> None:
    film(tmp_path / "video.mp4", 0)
    assert list(tmp_path.iterdir()) == []
