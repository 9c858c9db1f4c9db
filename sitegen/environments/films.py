"""Films of environments for their pages: from above, and in 3-D behind a vehicle."""

from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from coopenv.api.engine import Engine
from coopenv.episode import Episode, Origin
from coopenv.runs.films import Shot, space_film, top_view_film, write_film
from coopenv.runs.scenes import driver_of, scene_of
from coopenv.scenario import Scenario

FORMATS, MOST_BYTES = ((6.0, 448), (3.0, 320), (3.0, 240)), 280_000
"""Formats of films: pictures a second and width, px; the first within the limit counts, or the last. Limit in bytes."""
_LASTS = 8.0  # s, at most
SEED = 0
"""Of the episode that pages show."""
_IDLE = "zero"  # the driver of a scene without a route


def films(name: str, scenario: Scenario, folder: Path) -> Iterator[str]:
    """Yield the films in a folder and their contents."""
    views = {"from above": folder / f"{name}.webp", "in 3-D": space_path(name, folder)}
    shown = [f"![Film of {name}, {view}]({path.name})" for view, path in views.items() if path.is_file()]
    if shown:
        _, driver = driver_of(None, scenario, name, SEED)
        driven = f" driven by `{driver}`," if driver else ""
        estimated = f" estimated by `{scenario.observer.name}`"
        yield from shown
        yield f"The episode of seed {SEED},{driven}{estimated}, faster than real time: the time stands above the map."
    if len(shown) > 1:
        yield (
            "In 3-D, solid cars are true and faded ones estimated. A car is lost while it is farther from its "
            "estimate than it is long."
        )


def space_path(name: str, folder: Path) -> Path:
    """Return the path of an environment's 3-D film."""
    return folder / f"{name}_3d.webp"


def write_page_films(name: str, scenario: Scenario, folder: Path, on_progress: Callable[[float], None]) -> None:
    """Film an environment for the page in a folder; where nothing moves there is no film.

    Those that are driven are filmed in 3-D too, where the extra is installed: behind the vehicle that drives longest,
    until it leaves the scene.
    """
    path, space = folder / f"{name}.webp", space_path(name, folder)
    policy, driver = driver_of(None, scenario, name, SEED)
    kinds = [vehicle.motion.kind for vehicle in scenario.vehicles] + [mark.motion.kind for mark in scenario.landmarks]
    if driver == _IDLE or not (driver or {*kinds} - {"static"}):
        path.unlink(missing_ok=True)
        return
    with closing(Engine(scenario)) as engine:
        source = Origin.of(name, scenario, policy=driver, seed=SEED)
        record = scene_of(engine, source, policy, lambda share: on_progress(share / 2))
    _write_small(lambda width: top_view_film(record, False), path, record, lambda share: on_progress(0.5 + share / 4))
    if scenario.driven and find_spec("pyvista"):
        longest = int(np.isfinite(record["position_error"]).sum(axis=0).argmax())
        frames = [record.frame(k) for k in range(len(record))]
        distance = np.abs([frame.target_position[:, :2] for frame in frames]).max(axis=-1)
        near = distance[:, len(scenario.landmarks) + longest] <= 1.1 * np.nanmax(distance[0])  # of all at the start
        inside = record.of(np.flatnonzero(near))
        behind = partial(space_film, [("", inside)], cameras=("follow",), vehicle=longest)
        _write_small(behind, space, inside, lambda share: on_progress(0.75 + share / 4))


def _write_small(
    film: Callable[[int], list[list[Shot]]], path: Path, record: Episode, on_progress: Callable[[float], None]
) -> None:
    """Write the film of a width in the first of the formats that makes no larger file."""
    for fps, width in FORMATS:
        write_film(film(width), path, fps, max(1.0, record.length / _LASTS), width, on_progress)
        if path.stat().st_size <= MOST_BYTES:
            break
