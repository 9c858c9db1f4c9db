"""Films: MP4 through ffmpeg where the extra `video` is installed, animated GIF and WebP through Pillow."""

from contextlib import suppress
from importlib.util import find_spec
from math import ceil
from pathlib import Path
from typing import Any, Self

import numpy as np
from PIL import Image

from coopenv.base.errors import CoopenvError, OutputError
from coopenv.base.files import writing
from coopenv.scenario import Scenario

MAX_FPS = 20.0
GIF_SIZE = 480
"""Largest width or height of a GIF, pixels: its frames are held in memory until the end."""


def frame_stride(scenario: Scenario) -> int:
    """Return the camera ticks between pictures: one per decision, but at most `MAX_FPS` a second."""
    return scenario.ticks_per_decision * max(1, ceil(scenario.rates.decision / MAX_FPS - 1e-9))


class Mp4Film:
    """H.264, written while the pictures come, by a process that ends with the context of the film."""

    def __init__(self, path: Path, fps: float) -> None:
        self.path, self._fps, self._frames = path, fps, 0
        self._writer: Any = None

    def __enter__(self) -> Self:
        """Return the film."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stop writing; what `close` has not finished is no film."""
        if self._writer is not None:
            with suppress(OSError, RuntimeError):
                self._writer.close()

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
    """An animated GIF, written at the end."""

    def __init__(self, path: Path, fps: float, size: int = GIF_SIZE) -> None:
        """Begin; pictures are made smaller where they are wider or higher than `size` pixels."""
        self.path, self._fps, self._size = path, fps, size
        self._frames: list[Image.Image] = []

    def __enter__(self) -> Self:
        """Return the film."""
        return self

    def __exit__(self, *_: object) -> None:
        """Forget the pictures."""
        self._frames.clear()

    def add(self, picture: np.ndarray) -> None:
        """Append a picture."""
        image = Image.fromarray(picture)
        image.thumbnail((self._size, self._size))
        self._frames.append(self._kept(image))

    def _kept(self, image: Image.Image) -> Image.Image:
        return image.quantize(64)

    def close(self) -> None:
        """Write the file; it plays for ever."""
        if self._frames:
            first, *rest = self._frames
            ends = np.round(np.arange(len(self._frames) + 1) * 100.0 / self._fps) * 10.0
            duration = np.diff(ends).astype(int).tolist()  # ms; the format counts in hundredths of a second
            with writing(self.path):
                first.save(self.path, save_all=True, append_images=rest, duration=duration, loop=0, **self._options())

    def _options(self) -> dict[str, Any]:
        return {}


class WebpFilm(GifFilm):
    """An animated WebP, written at the end: a tenth of a GIF's size, in all colours."""

    def _kept(self, image: Image.Image) -> Image.Image:
        return image

    def _options(self) -> dict[str, Any]:
        return {"quality": 70, "method": 4, "minimize_size": True}


Film = Mp4Film | GifFilm
_ANY_SIZE = 100_000  # px
SUFFIXES = (".mp4", ".gif", ".webp")
"""Formats of films."""


def film_at(path: Path, fps: float) -> Film:
    """Return a film in the format that a path names; pictures keep their size.

    Raises:
        OutputError: no such format.
        CoopenvError: the format needs an extra.
    """
    if path.suffix not in SUFFIXES:
        raise OutputError(f"{path}: unknown format of a film; known: {', '.join(SUFFIXES)}")
    if path.suffix == ".mp4":
        if find_spec("imageio_ffmpeg") is None:
            raise CoopenvError(f"{path}: MP4 needs an extra: pip install '.[video]'; GIF and WebP do not")
        return Mp4Film(path, fps)
    return (WebpFilm if path.suffix == ".webp" else GifFilm)(path, fps, _ANY_SIZE)


def open_film(folder: Path, fps: float) -> Film:
    """Return a film in `folder`: `video.mp4`, or `video.gif` without the extra."""
    mp4 = find_spec("imageio_ffmpeg") is not None
    return Mp4Film(folder / "video.mp4", fps) if mp4 else GifFilm(folder / "video.gif", fps)
