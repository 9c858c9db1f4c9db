"""Pages of environments as files: text, picture, film and measured figures of each, and an index."""

from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

from PIL import Image

from coopenv.api.engine import Engine
from coopenv.base.errors import world_keys
from coopenv.base.files import check_file, replace_text, replacing_file, writing
from coopenv.base.format import json_text
from coopenv.bench.cards import measure_value_of_sensing, read_value_of_sensing, value_of_sensing_text
from coopenv.policies import Policy
from coopenv.runs.page import index_text, page_text
from coopenv.runs.scenes import driver_of, scene_of, write_film
from coopenv.scenario import Scenario
from coopenv.viz.scene import Source
from coopenv.viz.topview import TopView

FPS, WIDTH = 6.0, 448
"""Of a film: pictures a second, and their width in pixels."""
_LASTS = 8.0  # s, at most
_SEED = 0
_IDLE = "zero"  # the driver of a scene without a route


def film_words(name: str, scenario: Scenario) -> str:
    """Return what a film shows; empty: nothing moves, so there is no film."""
    _, driver = _driver(name, scenario)
    if not _moves(scenario, driver):
        return ""
    driven = f" driven by `{driver}`," if driver else ""
    estimated = f" estimated by `{scenario.observer.name}`"
    return f"The episode of seed {_SEED},{driven}{estimated}, faster than real time: the time stands above the map."


def write_page_film(name: str, scenario: Scenario, folder: Path, on_progress: Callable[[float], None]) -> None:
    """Film an environment for the page in a folder; where nothing moves there is no film."""
    path = folder / f"{name}.webp"
    policy, driver = _driver(name, scenario)
    if not _moves(scenario, driver):
        path.unlink(missing_ok=True)
        return
    with closing(Engine(scenario)) as engine:
        source = Source.of(name, scenario, policy=driver, seed=_SEED)
        record = scene_of(engine, source, policy, lambda share: on_progress(share / 2))
    drawn = lambda share: on_progress(0.5 + share / 2)  # noqa: E731
    write_film(record, path, FPS, max(1.0, record.length / _LASTS), WIDTH, panel=False, on_progress=drawn)


def _driver(name: str, scenario: Scenario) -> tuple[Policy | None, str]:
    return driver_of(None, scenario, name, _SEED)


def _moves(scenario: Scenario, driver: str) -> bool:
    if driver:
        return driver != _IDLE
    moving = [vehicle.motion.kind for vehicle in scenario.vehicles] + [m.motion.kind for m in scenario.landmarks]
    return any(kind != "static" for kind in moving)


INDEX = "README.md"
COLOURS, REFINED = 256, 2
"""Of a picture, which is a drawing: so it takes a third of the bytes; rounds in which they are improved."""


def prepare(folder: Path, names: list[str]) -> None:
    """Make the folder of pages and find out before any work whether they can be written there.

    Raises:
        OutputError: they cannot.
    """
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        for suffix in ("md", "png", "webp", "json"):
            check_file(folder / f"{name}.{suffix}")


def environment_page(name: str, scenario: Scenario, folder: Path) -> str:
    """Return the page of an environment, with the figures and the film that stand in the folder, if any do."""
    value = read_value_of_sensing(folder / f"{name}.json")
    film = film_words(name, scenario) if (folder / f"{name}.webp").is_file() else ""
    return page_text(name, scenario, "" if value is None else value_of_sensing_text(name, scenario, value), film)


def write_page(name: str, scenario: Scenario, folder: Path, on_film: Callable[[float], None] | None = None) -> None:
    """Write text and picture of an environment's page to a folder.

    Args:
        name: of the environment.
        scenario: what it is.
        folder: which `prepare` has made.
        on_film: called with the share of its film that is done (None: no film is made, one that is there stays).

    Raises:
        CoopenvError: the figures that stand in the folder cannot be read.
    """
    read_value_of_sensing(folder / f"{name}.json")  # before anything is drawn
    if on_film is not None:
        write_page_film(name, scenario, folder, on_film)
    text = environment_page(name, scenario, folder)
    picture = Image.fromarray(first_picture(scenario)).quantize(COLOURS, kmeans=REFINED, dither=Image.Dither.NONE)
    with replacing_file(folder / f"{name}.png") as path:
        picture.save(path, optimize=True)
    replace_text(folder / f"{name}.md", text)


def write_figures(
    environment: str,
    name: str,
    scenario: Scenario,
    folder: Path,
    worlds: int,
    on_progress: Callable[[float, str], None],
) -> dict[str, Any]:
    """Measure what sensing is worth in an environment, and write it for the page."""
    value = measure_value_of_sensing(environment, scenario, worlds, on_progress)
    replace_text(folder / f"{name}.json", json_text(value))
    return value


def write_index(scenarios: dict[str, Scenario], folder: Path) -> None:
    """Write the list of those environments whose pages are in the folder."""
    replace_text(folder / INDEX, index_text({k: s for k, s in scenarios.items() if (folder / f"{k}.md").is_file()}))


def first_picture(scenario: Scenario) -> Any:
    """Return the top view, (H, W, 3) uint8, of the start of the episode of seed 0."""
    with closing(Engine(scenario)) as engine, closing(TopView(engine.backend.scenario)) as view:
        engine.reset([world_keys(0)[0]])
        return view.draw(engine)
