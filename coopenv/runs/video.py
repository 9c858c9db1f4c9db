"""Films of a run: MP4 through ffmpeg where the extra `video` is installed, otherwise an animated GIF."""

from importlib.util import find_spec
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from coopenv.errors import OutputError
from coopenv.files import writing
from coopenv.scenario import Scenario

MAX_FPS = 20.0
GIF_SIZE = 480
"""Largest width or height of a GIF, pixels: its frames are held in memory until the end."""


def frame_stride(scenario: Scenario) -> int:
    """Return the camera ticks between pictures: one per decision, but at most `MAX_FPS` a second."""
    return scenario.ticks_per_decision * max(1, ceil(scenario.rates.decision / MAX_FPS - 1e-9))


class Mp4Film:
    """H.264, written while the pictures come."""

    def __init__(self, path: Path, fps: float) -> None:
        self.path, self._fps, self._frames = path, fps, 0
        self._writer: Any = None

    def add(self, picture: np.ndarray) -> None:
        """Append a picture, cut to even width and height as the codec asks for."""
        height, width = picture.shape[0] // 2 * 2, picture.shape[1] // 2 * 2
        try:
            if self._writer is None:
                import imageio_ffmpeg

                self._writer = imageio_ffmpeg.write_frames(
                    str(self.path), (width, height), fps=self._fps, macro_block_size=2, ffmpeg_log_level="quiet"
                )
                self._writer.send(None)
            self._writer.send(np.ascontiguousarray(picture[:height, :width]))
        except OSError:
            raise self._failure() from None
        self._frames += 1

    def close(self) -> None:
        """Finish the file, and read it back: ffmpeg's writer does not say that a disk was full.

        Raises:
            OutputError: not every picture is there.
        """
        if self._writer is not None:
            from imageio_ffmpeg import count_frames_and_secs

            try:
                self._writer.close()
                frames, _ = count_frames_and_secs(str(self.path))
            except (OSError, RuntimeError):
                raise self._failure() from None
            if frames != self._frames:
                raise self._failure()

    def _failure(self) -> OutputError:
        return OutputError(f"cannot write to {self.path}: ffmpeg could not finish it; the disk may be full")


class GifFilm:
    """An animated GIF of at most `GIF_SIZE` pixels, written at the end."""

    def __init__(self, path: Path, fps: float) -> None:
        self.path, self._fps = path, fps
        self._frames: list[Image.Image] = []

    def add(self, picture: np.ndarray) -> None:
        """Append a picture."""
        image = Image.fromarray(picture)
        image.thumbnail((GIF_SIZE, GIF_SIZE))
        self._frames.append(image.quantize(64))

    def close(self) -> None:
        """Write the file; it plays for ever."""
        if self._frames:
            first, *rest = self._frames
            ends = np.round(np.arange(len(self._frames) + 1) * 100.0 / self._fps) * 10.0
            duration = np.diff(ends).astype(int).tolist()  # ms; the format counts in hundredths of a second
            with writing(self.path):
                first.save(self.path, save_all=True, append_images=rest, duration=duration, loop=0)


Film = Mp4Film | GifFilm


def open_film(folder: Path, fps: float) -> Film:
    """Return a film in `folder`: `video.mp4`, or `video.gif` without the extra."""
    mp4 = find_spec("imageio_ffmpeg") is not None
    return Mp4Film(folder / "video.mp4", fps) if mp4 else GifFilm(folder / "video.gif", fps)
