"""`coopenv film`: a film of an episode."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coopenv.base.errors import CoopenvError
from coopenv.cli import complete, options

if TYPE_CHECKING:
    from rich.console import Console

    from coopenv.viz.scene import SceneRecord

Agent = Annotated[
    str | None,
    typer.Option(
        help="Who drives: zero, random, the name of an agent, its folder, or mine.py:Mine (default: route_follower, "
        "where it can drive).",
        **complete.POLICY,
    ),
]
ObserverName = Annotated[
    str | None,
    typer.Option(
        help="Observer by name or as mine.py:Mine (default: that of the environment).",
        show_default=False,
        **complete.OBSERVERS,
    ),
]
SceneSource = Annotated[
    str,
    typer.Argument(
        metavar="ENV|FILE.mcap|BAG|RUN",
        help="Environment (name or TOML file), a log file, a ROS bag, recorded robots (mrclam_1 .. mrclam_9), or the "
        "folder of a run.",
        autocompletion=complete.environments,
        callback=complete.known_source,
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
    from coopenv.runs.film import write_film
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
