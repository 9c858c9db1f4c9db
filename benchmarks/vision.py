"""`python -m benchmarks.vision`: the detector of tags on rendered frames, by distance and tilt.

Frames of 640 x 480 pixels have four tags before clutter: rectangles of random shades, blur and noise. Per row: share of
the tags that are found with their number, RMSE and 99th percentile of the bearing error, false tags, and CPU time per
frame (median and 99th percentile). Errors are standard errors; seeds are those of no test.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from time import process_time
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from scipy.spatial.transform import Rotation

from coopenv.base.errors import CoopenvError, check_one_of
from coopenv.base.sections import FAMILIES
from coopenv.cars.fake.frames import WALL, FrameRenderer, PlacedTag
from coopenv.cars.messages.vision import Calibration, find_tags
from coopenv.estimation.poses import Array
from coopenv.runs.console import number_table

CAMERA = Calibration((640, 480), (450.0, 455.0), (322.3, 236.1), (-0.30, 0.10, 0.002, 0.0006, 0.0))
DISTANCES, TILTS = (1.0, 2.0, 3.0, 4.0), (0.0, 30.0, 60.0)
"""m and deg."""
PLACES = ((-0.36, -0.24), (0.36, -0.24), (-0.36, 0.24), (0.36, 0.24))
"""Directions of the tags at distance 1, each moved by up to `SPREAD`."""
SPREAD, SHADES = 0.08, 40.0
RECTANGLES = 60
BLUR, NOISE = 0.7, 3.0
"""Standard deviations: pixels and shades."""
PARTS = 10  # of the frames, whose spread gives the standard error of the CPU time


class Measured(NamedTuple):
    """Frames of one distance and tilt."""

    placed: int
    errors: Array  # (n,) deg, of those that were found
    false: int  # tags that are not there
    cpu: Array  # (f,) ms per frame


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print the table; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--family", default="tag36h11", help="as in [vision]")
    parser.add_argument("--side", type=float, default=0.16, help="of the black square, m")
    parser.add_argument("--frames", type=int, default=100, help="per row, at least 10")
    parser.add_argument("--seed", type=int, default=70_000)
    asked = parser.parse_args(arguments)
    try:
        check_one_of("unknown family", asked.family, FAMILIES)
        if asked.frames < PARTS or asked.side <= 0.0:
            raise CoopenvError(f"--frames is at least {PARTS}, --side above 0")
        report(asked)
    except CoopenvError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def report(asked: argparse.Namespace) -> None:
    """Print the table."""
    names = ("\nfound [%]", "bearing error\nRMSE [deg]", "\n99 % [deg]", "\nfalse", "CPU per frame\n[ms]", "\n99 %")
    table = number_table([f"{asked.family}\ndistance [m]", "\ntilt [deg]"], names)
    renderer, every = FrameRenderer(CAMERA, asked.family), list[Measured]()
    for distance in DISTANCES:
        for tilt in TILTS:
            rng = np.random.default_rng([asked.seed, round(100 * distance), round(tilt)])
            every.append(measured(renderer, distance, tilt, asked.side, asked.frames, rng))
            table.add_row(f"{distance:g}", f"{tilt:g}", *cells(every[-1]))
    whole = Measured(*(sum(m.placed for m in every), np.concatenate([m.errors for m in every])),
                     *(sum(m.false for m in every), np.concatenate([m.cpu for m in every])))  # fmt: skip
    table.add_row("all", "", *cells(whole))
    Console().print(table)


def cells(m: Measured) -> Iterator[str]:
    """Yield the figures of a row."""
    n, share = len(m.errors), len(m.errors) / m.placed
    yield f"{100 * share:.1f}({100 * np.sqrt(share * (1 - share) / m.placed):.1f})"
    rmse = float(np.sqrt((m.errors**2).mean())) if n else float("nan")
    yield f"{rmse:.4f}({(m.errors**2).std() / (2.0 * rmse * np.sqrt(n)):.4f})" if n else "-"
    yield f"{np.quantile(m.errors, 0.99):.3f}" if n else "-"
    yield str(m.false)
    medians = [np.median(part) for part in np.array_split(m.cpu, PARTS)]
    yield f"{np.median(m.cpu):.1f}({np.std(medians, ddof=1) / np.sqrt(PARTS):.1f})"
    yield f"{np.quantile(m.cpu, 0.99):.1f}"


def measured(
    renderer: FrameRenderer, distance: float, tilt: float, side: float, frames: int, rng: np.random.Generator
) -> Measured:
    """Render and search frames with tags at a distance, m, and a tilt away from the camera, deg."""
    placed, errors, false, cpu = 0, [], 0, []
    for _ in range(frames):
        tags = [tag_at(distance, tilt, n, np.array(at) + rng.uniform(-SPREAD, SPREAD, 2), side, rng)
                for n, at in enumerate(PLACES)]  # fmt: skip
        frame = renderer.render(tags, BLUR, NOISE, rng, clutter(rng))
        begin = process_time()
        found = find_tags(frame, renderer.family, CAMERA)
        cpu.append(1e3 * (process_time() - begin))
        rays = {tag.number: tag.place / np.linalg.norm(tag.place) for tag in tags}
        hits = {tag.number: tag.ray for tag in found if tag.ray is not None}
        true = [n for n in rays.keys() & hits.keys() if np.dot(rays[n], hits[n]) > 0.99]
        placed, false = placed + len(tags), false + len(found) - len(true)
        errors += [np.degrees(np.linalg.norm(rays[n] - hits[n])) for n in true]
    return Measured(placed, np.array(errors), false, np.array(cpu))


def tag_at(distance: float, tilt: float, number: int, at: Array, side: float, rng: np.random.Generator) -> PlacedTag:
    """Return a tag in the direction of a place (2,) at distance 1, turned about a random axis across, and its own."""
    ray = np.array([*at, 1.0]) / np.linalg.norm([*at, 1.0])
    facing, _ = Rotation.align_vectors([ray], [[0.0, 0.0, 1.0]])
    angle = rng.uniform(0.0, 2.0 * np.pi)
    away = Rotation.from_rotvec(np.radians(tilt) * np.array([np.cos(angle), np.sin(angle), 0.0]))
    own = Rotation.from_rotvec([0.0, 0.0, rng.uniform(0.0, 2.0 * np.pi)])
    return PlacedTag(number, (facing * away * own).as_matrix(), distance * ray, side)


def clutter(rng: np.random.Generator) -> NDArray[np.float32]:
    """Return what is behind the tags, (480, 640) shades: rectangles, the later ones before the others."""
    width, height = CAMERA.image_size
    behind = np.full((height, width), WALL, np.float32)
    for _ in range(RECTANGLES):
        (x, y), (w, h) = rng.integers((width, height)), rng.integers(4, 160, 2)
        behind[y : y + h, x : x + w] = rng.normal(WALL, SHADES)
    return behind


if __name__ == "__main__":
    sys.exit(main())
