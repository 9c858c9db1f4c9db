"""`coopenv view`, `film`, `watch` and `play`."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from coopenv.base.errors import CoopenvError
from coopenv.cli import options

if TYPE_CHECKING:
    from rich.console import Console

    from coopenv.runs.reels import Reel
    from coopenv.viz.scene import SceneRecord

Agent = Annotated[
    str | None,
    typer.Option(
        help="Who drives: zero, random, the name of an agent, its folder, or mine.py:Mine (default: route_follower, "
        "where it can drive).",
        **options.POLICY,
    ),
]
ObserverName = Annotated[
    str | None,
    typer.Option(
        help="Observer by name or as mine.py:Mine (default: that of the environment).",
        show_default=False,
        **options.OBSERVERS,
    ),
]
SceneSource = Annotated[
    str,
    typer.Argument(
        metavar="ENV|FILE.mcap|BAG|RUN",
        help="Environment (name or TOML file), a log file, a ROS bag, recorded robots (mrclam_1 .. mrclam_9), or the "
        "folder of a run.",
        autocompletion=options.environments,
        callback=options.known_source,
    ),
]


def film(
    source: SceneSource,
    out: Annotated[Path, typer.Option(help="File to write: .mp4, .gif or .webp.")],
    agent: Agent = None,
    observer: ObserverName = None,
    seed: options.Seed = 0,
    overrides: options.Overrides = None,
    speed: Annotated[float, typer.Option(min=0.05, max=100.0, help="Times real time.")] = 1.0,
    fps: Annotated[
        float | None, typer.Option(min=1.0, max=50.0, help="Pictures a second (default: 20 for MP4, else 10).")
    ] = None,
    width: Annotated[int, typer.Option(min=64, max=896, help="Width of the pictures, pixels.")] = 896,
    map_only: Annotated[bool, typer.Option("--map-only", help="Leave out the table and the legend.")] = False,
    data: options.DataFolder = None,
    variant: options.Variant = None,
    topics: options.TopicMap = None,
) -> None:
    """Film an episode from above: MP4, GIF or WebP."""
    from coopenv.base.files import check_file
    from coopenv.runs.console import Progress
    from coopenv.runs.live import write_film
    from coopenv.runs.video import film_at

    rate, log = fps or (20.0 if out.suffix == ".mp4" else 10.0), options.console(stderr=True)
    film_at(out, rate)
    check_file(out)
    record = scene(source, agent, observer, seed, options.parse_overrides(overrides), (data, variant, topics), log)
    with Progress(log, f"filming {out.name}", 1.0) as progress:
        pictures = write_film(record, out, rate, speed, width, not map_only, progress.update)
    size = out.stat().st_size / 1e6
    options.console().print(f"{out}: {pictures} pictures, {pictures / rate:.3g} s, {size:.2g} MB", soft_wrap=True)


def scene(
    source: str,
    agent: str | None,
    observer: str | None,
    seed: int,
    overrides: dict[str, object],
    recorded: tuple[Path | None, str | None, Path | None],
    log: "Console",
) -> "SceneRecord":
    """Return the scene of a source: a saved one, or that of an episode that runs now.

    Raises:
        CoopenvError: there is no such source, or an option is not for it.
    """
    from coopenv.api.engine import Engine
    from coopenv.runs.console import Progress, compile_notice
    from coopenv.runs.scenes import driver_of, open_source, saved_scene, scene_of, title_of
    from coopenv.viz.scene import Source

    saved = saved_scene(source)
    if saved is not None:
        refuse_for_saved(source, agent=agent, observer=observer, set=overrides or None, seed=seed or None)
        return saved
    data, variant, topics = recorded
    with options.warned():
        backend = open_source(source, overrides, observer, data, variant, topics)
    if backend.capabilities.recorded and agent is not None:
        raise CoopenvError(f"--agent: is for a simulation, {source} is recorded")
    scenario = backend.scenario
    policy, name = (None, "") if backend.capabilities.recorded else driver_of(agent, scenario, source, seed)
    engine = Engine(scenario, backend=backend)
    of = Source.of(title_of(source), scenario, policy=name, seed=None if backend.capabilities.recorded else seed)
    try:
        with compile_notice(log):
            engine.load()
        with Progress(log, "running", total=1.0) as progress:
            return scene_of(engine, of, policy, progress.update)
    finally:
        engine.close()


def refuse_for_saved(source: str, **given: object) -> None:
    """Refuse options that only an episode that runs has where they are given for one that has been run."""
    for option, value in given.items():
        if value is not None:
            raise CoopenvError(f"--{option}: {source} has been run; name the environment to run it anew")


CARS = "svea"
"""The source that stands for the cars of a deployment."""


def view(
    source: Annotated[
        str,
        typer.Argument(
            metavar="ENV|FILE.mcap|BAG|RUN|svea",
            help="Environment (name or TOML file), a log file, a ROS bag, recorded robots (mrclam_1 .. mrclam_9), the "
            "folder of a run, or svea: the cars of --deployment.",
            autocompletion=options.environments,
            callback=lambda name: name if name == CARS else options.known_source(name),
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
    from coopenv.runs.reels import vehicle_index
    from coopenv.runs.view import Viewer, serving
    from coopenv.viz.web.page import viser_module

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
    from coopenv.runs.reels import EngineReel, SavedReel
    from coopenv.runs.scenes import driver_of, open_source, saved_scene, title_of

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
    from coopenv.runs.reels import EngineReel

    if deployment is None:
        raise CoopenvError("--deployment: needed by coopenv view svea: the file that says which cars drive")
    if agent is not None:
        raise CoopenvError("--agent: is for a simulation; coopenv svea run --arm lets an agent drive cars")
    watching = {} if observer is None else {"observer.name": observer}

    def opened(more: Mapping[str, Any]) -> Any:
        return open_svea(deployment, None, {**changes, **watching, **more}, connect=connect)

    return EngineReel(opened, deployment.stem, seed, lambda scenario: (None, ""))


def watch(
    agent: Annotated[
        str,
        typer.Argument(
            metavar="AGENT",
            help="Name of an agent, its folder, or where its class stands, mine.py:Mine or package.module:Mine.",
            autocompletion=options.agents,
            callback=options.known_agents,
        ),
    ],
    environment: Annotated[
        str | None,
        typer.Option(
            "--env",
            help="Name or TOML file of the environment (default: the first that the agent was made for).",
            **options.ENVIRONMENT,
        ),
    ] = None,
    seed: options.Seed = 0,
    overrides: options.Overrides = None,
    speed: Annotated[float, typer.Option(min=0.01, help="Times real time.")] = 1.0,
    out: Annotated[Path | None, typer.Option(help="Folder for a film, in place of the window.")] = None,
) -> None:
    """Watch an agent drive, in a window or as a film."""
    from coopenv.policies import find_agent

    found, log = find_agent(agent), options.console(stderr=True)
    name = environment or next(iter(found.environments), None)
    if name is None:
        raise CoopenvError(f"{agent} does not say for which environment it was made; name one with --env")
    scenario = options.load(name, options.parse_overrides(overrides))
    from coopenv.runs import live

    policy = found.policy(scenario)
    if out is not None:
        stage = live.film(scenario, policy, seed, out, log)
    else:
        stage = live.watch(scenario, policy, seed, log, clock=live.Clock(speed))
    for line in stage.outcomes():
        options.console().print(line, soft_wrap=True)


def play(
    environment: options.Environment,
    vehicle: Annotated[str | None, typer.Option(help="Name of the vehicle to drive (default: the first).")] = None,
    others: Annotated[
        str | None,
        typer.Option(
            help="Policy of the other vehicles (default: route_follower where it can drive).",
            **options.POLICY,
        ),
    ] = None,
    seed: options.Seed = 0,
    overrides: options.Overrides = None,
) -> None:
    """Drive a vehicle by the arrow keys."""
    scenario, log = options.load(environment, options.parse_overrides(overrides)), options.console(stderr=True)
    from coopenv.runs import live

    index = live.vehicle_index(scenario, vehicle)
    policy = live.others_of(scenario, Path(environment).stem, others, seed)
    stage = live.drive_by_hand(scenario, index, policy, seed, log)
    options.console().print(stage.outcomes()[index], soft_wrap=True)
