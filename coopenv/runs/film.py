"""`coopenv film`: a scene as MP4, GIF or WebP, drawn from above."""

from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
from PIL import Image

from coopenv.base.files import replacing_file
from coopenv.runs.video import film_at
from coopenv.viz.scene import SceneRecord
from coopenv.viz.topview import TopView


def write_film(
    record: SceneRecord,
    path: Path,
    fps: float,
    speed: float = 1.0,
    width: int = 896,
    panel: bool = True,
    on_progress: Callable[[float], None] = lambda share: None,
) -> int:
    """Write a film of a scene; return how many pictures it has.

    Args:
        record: the scene.
        path: of the film, which is replaced as a whole; its suffix is the format.
        fps: pictures a second; frames of the scene are repeated where it has fewer.
        speed: times real time.
        width: of the pictures, pixels, at most.
        panel: table and legend beside the map.
        on_progress: called with the share of the pictures that are drawn; the file is written after the last.

    Raises:
        CoopenvError: unknown format, or it needs an extra.
        OutputError: the file cannot be written.
    """
    film_at(path, fps)  # before anything is drawn
    chosen = frames_at(record.time, fps, speed)
    with (
        replacing_file(path) as new,
        closing(TopView(record.scenario, panel=panel)) as view,
        film_at(new, fps) as film,
    ):
        for done, k in enumerate(chosen, start=1):
            film.add(_within(view.paint(record.frame(int(k))), width))
            on_progress(done / len(chosen))
        film.close()
    return len(chosen)


def frames_at(time: np.ndarray, fps: float, speed: float) -> np.ndarray:
    """Return which frames, of times (K,) s, a film shows: the last one that is there at each of its pictures."""
    count = int(np.floor((time[-1] - time[0]) / speed * fps + 1e-6)) + 1
    moments = time[0] + np.arange(count) * speed / fps
    return np.asarray(np.searchsorted(time, moments + 1e-6, side="right") - 1)


def _within(picture: np.ndarray, width: int) -> np.ndarray:
    """Return a picture that is no wider than that."""
    if picture.shape[1] <= width:
        return picture
    size = width, round(picture.shape[0] * width / picture.shape[1])
    return np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.LANCZOS))
