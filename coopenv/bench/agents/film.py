"""A film of several drivers in one and the same world, side by side."""

from collections.abc import Iterator
from itertools import zip_longest
from pathlib import Path

import numpy as np
from PIL import Image
from rich.console import Console

from coopenv.api.engine import Engine
from coopenv.bench.agents.contest import Entrant, Evaluation
from coopenv.evaluation import held_out_seeds
from coopenv.runs.console import Progress
from coopenv.runs.episode import play
from coopenv.runs.video import frame_stride, open_film
from coopenv.viz.topview import TopView

COLUMNS = 3
WIDEST = 1920  # px


def write_film(evaluation: Evaluation, folder: Path, log: Console) -> Path:
    """Film the first world of an evaluation, one picture per driver, until the last has ended."""
    scenario = evaluation.entrants[0].scenario
    seed = held_out_seeds(evaluation.block, evaluation.worlds)[0]
    film = open_film(folder, scenario.rates.camera / frame_stride(scenario))
    with film, Progress(log, f"filming {film.path.name}", scenario.horizon_ticks) as progress:
        for done, pictures in enumerate(_together([pictures_of(entrant, seed) for entrant in evaluation.entrants])):
            film.add(tiled(pictures))
            progress.update(done * frame_stride(scenario))
        film.close()
    return film.path


def pictures_of(entrant: Entrant, seed: int) -> Iterator[np.ndarray]:
    """Yield the pictures, (H, W, 3) uint8, of a driver's episode: its name, the error and the time above the map."""
    scenario = entrant.scenario
    engine = Engine(scenario)
    view = TopView(engine.backend.scenario.model_copy(update={"title": entrant.name}), panel=False)
    try:
        for tick in play(engine, [seed], scenario.horizon_ticks, entrant.policy, to_the_end=False):
            if tick % frame_stride(scenario) == 0:
                yield view.draw(engine)
    finally:
        engine.close()
        view.close()


def _together(films: list[Iterator[np.ndarray]]) -> Iterator[list[np.ndarray]]:
    """Yield the pictures of all films at each moment; one that is over stays at its last."""
    last: list[np.ndarray] = []
    for pictures in zip_longest(*films):
        last = [old if new is None else new for new, old in zip(pictures, last or pictures, strict=True)]
        yield last


def tiled(pictures: list[np.ndarray]) -> np.ndarray:
    """Return pictures of one size beside and below each other, at most `COLUMNS` in a row and `WIDEST` wide."""
    height, width, _ = pictures[0].shape
    columns = min(COLUMNS, len(pictures))
    rows = -(-len(pictures) // columns)
    whole = np.full((rows * height, columns * width, 3), 255, np.uint8)
    for i, picture in enumerate(pictures):
        y, x = divmod(i, columns)
        whole[y * height : (y + 1) * height, x * width : (x + 1) * width] = picture
    if whole.shape[1] <= WIDEST:
        return whole
    size = WIDEST, round(whole.shape[0] * WIDEST / whole.shape[1])
    return np.asarray(Image.fromarray(whole).resize(size, Image.Resampling.LANCZOS))
