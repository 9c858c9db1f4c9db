"""`coopenv view`: live in the browser."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from coopenv.base.errors import CoopenvError
from coopenv.cli import complete, options
from coopenv.cli.film import Agent, ObserverName, refuse_for_saved

if TYPE_CHECKING:
    from rich.console import Console

    from coopenv.runs.view.reels import Reel

CARS = "svea"
"""The source that stands for the cars of a deployment."""


def view(
    source: Annotated[
        str,
        typer.Argument(
            metavar="ENV|FILE.mcap|BAG|RUN|svea",
            help="Environment (name or TOML file), a log file, a ROS bag, recorded robots (mrclam_1 .. mrclam_9), the "
            "folder of a run, or svea: the cars of --deployment.",
            autocompletion=complete.environments,
            callback=lambda name: name if name == CARS else complete.known_source(name),
        ),
    ],
    agent: Agent = None,
    observer: ObserverName = None,
    vehicle: Annotated[str | None, typer.Option(help="Vehicle to look at first, vehicle_1 or f1.")] = None,
    seed: options.Seed = 0,
    overrides: options.Overrides = None,
    port: Annotated[
        int | None, typer.Option(min=1, max=65535, help="Port to listen on (default: 8080, or the next free one).")
    ] = None,
    host: Annotated[
        str, typer.Option(help="Address to listen on; 0.0.0.0 lets other computers watch and switch.")
    ] = "127.0.0.1",
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Open no browser.")] = False,
    deployment: Annotated[Path | None, typer.Option(help="Of svea: the file that says which cars.")] = None,
    connect: options.Connect = None,
    data: options.DataFolder = None,
    variant: options.Variant = None,
    topics: options.TopicMap = None,
) -> None:
    """Watch an environment, a record or cars live in the browser; Ctrl-C ends it.

    Nothing is asked of any other computer. Cars are observed only: they are never armed from here.
    """
    from coopenv.runs.console import compile_notice
    from coopenv.runs.view.reels import vehicle_index
    from coopenv.runs.view.serving import serving
    from coopenv.runs.view.viewer import Viewer
    from coopenv.viz.web.extra import viser_module

    viser_module()
    log, changes = options.console(stderr=True), options.parse_overrides(overrides)
    with options.warned(), compile_notice(log):
        reel = _reel(source, agent, observer, seed, changes, (deployment, connect), (data, variant, topics))
    try:
        picked = vehicle_index(reel.scenario, vehicle)
        with serving(host, port) as (server, url):
            viewer = Viewer(server, reel)
            viewer.pick(picked)
            _announce(url, host, log, no_browser)
            viewer.run()
    finally:
        reel.close()


def _announce(url: str, host: str, log: "Console", no_browser: bool) -> None:
    """Say where the view is."""
    options.console().print(f"{url}  (Ctrl-C ends the view)", soft_wrap=True)
    if host not in ("127.0.0.1", "localhost", "::1"):
        log.print(
            "warning: everybody who has this address can watch, and switch what runs here; it is sent unencrypted",
            soft_wrap=True,
        )
    if not no_browser:
        options.show_page(url)


def _reel(
    source: str,
    agent: str | None,
    observer: str | None,
    seed: int,
    changes: dict[str, Any],
    cars: tuple[Path | None, str | None],
    recorded: tuple[Path | None, str | None, Path | None],
) -> "Reel":
    """Return where the frames of a source come from.

    Raises:
        CoopenvError: there is no such source, or an option is not for it.
    """
    from coopenv.runs.scenes import driver_of, open_source, saved_scene, title_of
    from coopenv.runs.view.reels import EngineReel, SavedReel

    if source == CARS:
        return _cars(*cars, agent, observer, seed, changes)
    for option, value in zip(("--deployment", "--connect"), cars, strict=True):
        if value is not None:
            raise CoopenvError(f"{option} {value}: is for coopenv view svea")
    saved = saved_scene(source)
    if saved is not None:
        refuse_for_saved(source, agent=agent, observer=observer, set=changes or None, seed=seed or None)
        return SavedReel(saved)
    data, variant, topics = recorded

    def opened(more: Mapping[str, Any]) -> Any:
        watching = None if "observer.name" in more else observer
        return open_source(source, {**changes, **more}, watching, data, variant, topics)

    from coopenv.backends.sources import is_bag, is_recorded

    if agent is not None and (is_recorded(source) or is_bag(source, topics)):
        raise CoopenvError(f"--agent: is for a simulation, {source} is recorded")
    return EngineReel(opened, title_of(source), seed, partial(_driver, driver_of, agent, source, seed))


def _driver(driver_of: Any, agent: str | None, source: str, seed: int, scenario: Any) -> Any:
    return driver_of(agent, scenario, source, seed)


def _cars(
    deployment: Path | None,
    connect: str | None,
    agent: str | None,
    observer: str | None,
    seed: int,
    changes: dict[str, Any],
) -> "Reel":
    """Return the cars of a deployment, which are observed and not driven."""
    from coopenv.cars.backend.opening import open_svea
    from coopenv.runs.view.reels import EngineReel

    if deployment is None:
        raise CoopenvError("--deployment: needed by coopenv view svea: the file that says which cars drive")
    if agent is not None:
        raise CoopenvError("--agent: is for a simulation; coopenv svea run --arm lets an agent drive cars")
    watching = {} if observer is None else {"observer.name": observer}

    def opened(more: Mapping[str, Any]) -> Any:
        return open_svea(deployment, None, {**changes, **watching, **more}, connect=connect)

    return EngineReel(opened, deployment.stem, seed, lambda scenario: (None, ""))
