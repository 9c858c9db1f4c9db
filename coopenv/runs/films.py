"""Films of scenes: from above or in 3-D, one or several side by side, as MP4, GIF or WebP."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from coopenv.base.errors import CoopenvError, OutputError
from coopenv.base.files import replacing_file, writing
from coopenv.base.installation import install_command
from coopenv.episode import Episode, Frame

if TYPE_CHECKING:  # imports Matplotlib, which is only needed where there is a film
    from coopenv.viz.stage import Stage
    from coopenv.viz.topview import TopView
    from coopenv.viz.view3d import View3d

SUFFIXES = (".mp4", ".gif", ".webp")
"""Formats of films: MP4 through ffmpeg where the extra `video` is installed, animated GIF and WebP through Pillow."""
VIDEO_FILES = ("video.mp4", "video.gif")
"""Names of a film in a folder of results, with and without the extra."""
WIDEST, SMALL = 1920, 480
"""Largest widths where none is asked for, pixels: of MP4; of GIF and WebP, held in memory until the end."""


def check_film(path: Path) -> None:
    """Make sure that a film can have the format that its path names.

    Raises:
        OutputError: no such format.
        CoopenvError: the format needs an extra.
    """
    if path.suffix not in SUFFIXES:
        raise OutputError(f"{path}: unknown format of a film; known: {', '.join(SUFFIXES)}")
    if path.suffix == ".mp4" and find_spec("imageio_ffmpeg") is None:
        raise CoopenvError(f"{path}: MP4 needs an extra: {install_command('video')}; GIF and WebP do not")


def video_path(folder: Path) -> Path:
    """Return the path of a film in a folder of results: MP4, or GIF without the extra."""
    return folder / VIDEO_FILES[find_spec("imageio_ffmpeg") is None]


class Shot(NamedTuple):
    """One part of the picture of a film."""

    record: Episode
    view: "TopView | View3d"
    name: str = ""
    """Stands above the picture, with driver, observer and the number of lost vehicles; empty: no heading."""


def write_film(
    shots: Sequence[Sequence[Shot]],
    path: Path,
    fps: float,
    speed: float = 1.0,
    width: int | None = 896,
    on_progress: Callable[[float], None] = lambda share: None,
) -> int:
    """Write a film of scenes that begin together; return how many pictures it has. The views are closed.

    Args:
        shots: rows of the picture; all shots of a row are equally high. Narrower rows end in white.
        path: of the film, which is replaced as a whole; its suffix is the format.
        fps: pictures a second; frames of a scene are repeated where it has fewer.
        speed: times real time.
        width: as for `write_pictures`.
        on_progress: called with the share of the pictures that are drawn; the file is written after the last.

    Raises:
        CoopenvError: unknown format, or it needs an extra.
        OutputError: the file cannot be written.
    """
    check_film(path)
    chosen = [[(shot, frames_at(shot.record.time, fps, speed)) for shot in row] for row in shots]
    count = max(len(frames) for row in chosen for _, frames in row)

    def pictures() -> Iterator[np.ndarray]:
        for k in range(count):
            parts = ([_picture(shot, int(frames[min(k, len(frames) - 1)])) for shot, frames in row] for row in chosen)
            rows = [np.hstack(row) for row in parts]
            widest = max(row.shape[1] for row in rows)
            yield np.vstack([np.pad(r, ((0, 0), (0, widest - r.shape[1]), (0, 0)), constant_values=255) for r in rows])
            on_progress((k + 1) / count)

    with ExitStack() as stack:
        for shot in chain(*shots):
            stack.enter_context(closing(shot.view))
        with replacing_file(path) as new:
            write_pictures(new, fps, pictures(), width)
    return count


def top_view_film(record: Episode, panel: bool = True) -> list[list[Shot]]:
    """Return the film of one scene from above; `panel`: table and legend beside the map."""
    from coopenv.viz.topview import TopView

    return [[Shot(record, TopView(record.scenario, panel=panel))]]


def space_film(
    takes: Sequence[tuple[str, Episode]], width: int, cameras: Sequence[str] = ("overview",), vehicle: int = 0
) -> list[list[Shot]]:
    """Return the 3-D film of scenes.

    Args:
        takes: a column of the picture each, with its name (empty: the name of the environment).
        width: of the whole picture, pixels.
        cameras: a row of the picture each, of `view3d.CAMERAS`.
        vehicle: index of the one that is followed, or whose camera it is.

    Raises:
        CoopenvError: no such camera, or the extra is missing.
    """
    from coopenv.viz.view3d import View3d

    each = width // len(takes)
    size = each, each * 9 // 16 if len(takes) == 1 else each * 3 // 4

    def shot(name: str, record: Episode, camera: str) -> Shot:
        return Shot(record, View3d(record.scenario, size, camera, vehicle), name)

    heading, *rows = cameras
    first = [shot(name or record.source.name, record, heading) for name, record in takes]
    return [first, *([shot("", record, camera) for _, record in takes] for camera in rows)]


def _picture(shot: Shot, k: int) -> np.ndarray:
    """Return the picture of frame k of a shot, below its heading."""
    frame = shot.record.frame(k)
    picture = shot.view.paint(frame)
    return np.vstack([_heading(shot, frame, picture.shape[:2]), picture]) if shot.name else picture


_BAND = (1 / 6, 0.13)  # of the height and of the width of a picture, height of its heading at most
_START = 1.0  # s in which an estimate may still be the one that was drawn


def _heading(shot: Shot, frame: Frame, size: tuple[int, int]) -> np.ndarray:
    """Return a band with a shot's name, driver and observer, the number of lost vehicles, and the cause of the loss."""
    from coopenv.viz.stage import Stage
    from coopenv.viz.style import GREEN, VERMILION

    stage, source = Stage(shot.record.scenario), shot.record.source
    count, total = int(lost(stage, frame).sum()), len(frame.nees)
    found = f"{count} of {total} lost" if count and total > 1 else "lost" if count else "found"
    makers = {
        f"{kind} {name}": name for kind, name in (("driver", source.policy), ("observer", source.observer)) if name
    }
    title = next((words for words, name in makers.items() if name == shot.name), shot.name)
    left = title, ", ".join(words for words in makers if words != title)
    right = found, cause_of_loss(shot.record, stage, frame) if count else ""
    width, height = size[1], round(min(share * edge for share, edge in zip(_BAND, size, strict=True)))
    band = Image.new("RGB", (width, height), VERMILION if count else GREEN)
    draw, margin = ImageDraw.Draw(band), height / 4
    for words, place, anchor in ((left, margin, "lm"), (right, width - margin, "rm")):
        draw.text((place, 0.33 * height), words[0], "white", ImageFont.load_default(0.42 * height), anchor=anchor)
        draw.text((place, 0.75 * height), words[1], "white", ImageFont.load_default(0.23 * height), anchor=anchor)
    return np.asarray(band)


def lost(stage: "Stage", frame: Frame) -> np.ndarray:
    """Return (N,) which vehicles are farther from their estimates than they are long."""
    return np.asarray(frame.position_error > stage.bodies()[0][:, 0])


def cause_of_loss(record: Episode, stage: "Stage", frame: Frame) -> str:
    """Return why vehicles are lost: the observer is wrong, or the vehicle sees too little.

    An error within three stated standard deviations is no mistake of the observer: the drivers kept too few targets in
    view.
    """
    if frame.tick < _START * record.scenario.rates.camera:
        return "initial estimates"
    stated = record.source.honest & (frame.position_error <= frame.three_sigma)
    if (lost(stage, frame) & ~stated).any():
        return "the observer is wrong"
    return "the drivers see too little" if record.source.policy else "stated as uncertain"


def frames_at(time: np.ndarray, fps: float, speed: float) -> np.ndarray:
    """Return the indices of the frames, of times (K,) s, in a film: the latest frame at each of its pictures."""
    count = int(np.floor((time[-1] - time[0]) / speed * fps + 1e-6)) + 1
    moments = time[0] + np.arange(count) * speed / fps
    return np.asarray(np.searchsorted(time, moments + 1e-6, side="right") - 1)


def write_pictures(path: Path, fps: float, pictures: Iterable[np.ndarray], width: int | None = None) -> None:
    """Write pictures, (H, W, 3) uint8, as they come, as a film in the format that its path names; none: no file.

    Those that are wider than `width` pixels are made smaller (None: than `WIDEST` or `SMALL`).

    Raises:
        OutputError: the film cannot be written.
    """
    mp4 = path.suffix == ".mp4"
    widest = width or (WIDEST if mp4 else SMALL)
    images = (_no_wider(Image.fromarray(picture), widest) for picture in pictures)
    if mp4:
        _write_mp4(path, fps, images)
        return
    quality: dict[str, Any] = {"quality": 55, "method": 4, "minimize_size": True} if path.suffix == ".webp" else {}
    if kept := [image if quality else image.quantize(64) for image in images]:
        ends = np.round(np.arange(len(kept) + 1) * 100.0 / fps) * 10.0
        duration = np.diff(ends).astype(int).tolist()  # ms; the format counts in hundredths of a second
        with writing(path):
            kept[0].save(path, save_all=True, append_images=kept[1:], duration=duration, loop=0, **quality)


def _no_wider(image: Image.Image, width: int) -> Image.Image:
    image.thumbnail((width, image.height), Image.Resampling.LANCZOS, reducing_gap=None)
    return image


def _write_mp4(path: Path, fps: float, images: Iterable[Image.Image]) -> None:
    """Write H.264 and read it back: ffmpeg's writer does not report a full disk."""
    import imageio_ffmpeg

    @contextmanager
    def reported() -> Iterator[None]:
        try:
            yield
        except (OSError, RuntimeError):
            raise OutputError(f"cannot write to {path}: ffmpeg could not finish it; the disk may be full") from None

    images, count = iter(images), 0
    first = next(images, None)
    if first is None:
        return
    width, height = (edge // 2 * 2 for edge in first.size)  # even, as the codec asks for
    look: dict[str, Any] = {"fps": fps, "macro_block_size": 2, "ffmpeg_log_level": "quiet"}
    writer = imageio_ffmpeg.write_frames(str(path), (width, height), **look)
    try:
        with reported():
            writer.send(None)
        for image in chain([first], images):
            count += 1
            with reported():
                writer.send(image.crop((0, 0, width, height)).tobytes())
        with reported():
            writer.close()
            if imageio_ffmpeg.count_frames_and_secs(str(path))[0] != count:
                raise OSError
    finally:
        with suppress(OSError, RuntimeError):
            writer.close()
