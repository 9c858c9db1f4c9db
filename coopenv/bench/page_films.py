"""Films of environments for their pages: the whole episode of seed 0 in a few seconds."""

from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from coopenv.api.engine import Engine
from coopenv.policies import Policy
from coopenv.runs.film import write_film
from coopenv.runs.scenes import driver_of, scene_of
from coopenv.scenario import Scenario
from coopenv.viz.scene import Source

FPS, WIDTH = 6.0, 448
"""Of a film: pictures a second, and their width in pixels."""
_LASTS = 8.0  # s, at most
_SEED = 0
_IDLE = "zero"  # the driver where nobody knows the way


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
