"""`coopenv view` and `film`."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from coopenv.base.errors import CoopenvError
from coopenv.cli import arguments, commands, options

if TYPE_CHECKING:
    from rich.console import Console

    from coopenv.episode import Episode
    from coopenv.policies import Policy
    from coopenv.runs.films import Shot
    from coopenv.runs.live import Reel
    from coopenv.scenario import Scenario
    from coopenv.sources.base import Backend

Agent = Annotated[
    str | None,
    typer.Option(
        "--agent",
        "--policy",
        help="Driver: zero, random, the name of an agent, its folder, or mine.py:Mine (default: look_ahead or peek, if "
        "made for the environment; else route_follower, where it can drive).",
        **arguments.POLICY,
    ),
]
SceneSource = Annotated[
    str,
    typer.Argument(
        metavar="ENV|FILE.mcap|BAG|RUN",
        help="Environment (name or TOML file), a log file, a ROS bag, recorded robots (mrclam_1 .. mrclam_9), or the "
        "folder of a run.",
        autocompletion=arguments.environments,
        callback=arguments.known_source,
    ),
]


@dataclass(frozen=True, kw_only=True)
class SceneOptions(options.SourceOptions):
    """Source of the picture: an environment, a record, or a saved scene."""

    environment: SceneSource
    agent: Agent = None
    observer: options.ObserverName = None
    seed: options.Seed = 0

    def open(self, more: Mapping[str, Any] | None = None) -> "Backend":
        """Return the source of ticks; `more` overrides of the scenario win over the given ones.

        Raises:
            CoopenvError: there is no such source, or an option is not for it.
        """
        from coopenv.observers.registry import with_observer
        from coopenv.sources.registry import kind_of
        from coopenv.sources.sources import open_backend

        if self.agent is not None and kind_of(self.environment, self.topics).recorded:
            raise CoopenvError(f"--agent: is for a simulation, {self.environment} is recorded")
        observer = (more or {}).get("observer.name", self.observer)
        changes = with_observer({**self.changes, **(more or {})}, observer)
        return open_backend(self.environment, None, changes, self.selection, **self.files)

    def driver(self, scenario: "Scenario") -> "tuple[Policy | None, str]":
        """Return the driver of a scenario, and its name. Raises CoopenvError: it cannot drive here."""
        from coopenv.runs.scenes import LOOKING, driver_of

        return driver_of(self.agent, scenario, self.environment, self.seed, LOOKING)

    def saved(self) -> "Episode | None":
        """Return the scene of an earlier run; None: the source is no such run.

        Raises:
            CoopenvError: an option is only for an episode that runs now.
        """
        from coopenv.runs.scenes import saved_scene

        found = saved_scene(self.environment)
        given = {"agent": self.agent, "observer": self.observer, "set": self.overrides, "seed": self.seed}
        if found is not None and (unfit := next((name for name, value in given.items() if value), None)):
            raise CoopenvError(f"--{unfit}: {self.environment} has been run; name the environment to run it anew")
        return found


@dataclass(frozen=True, kw_only=True)
class FilmOptions(SceneOptions):
    """Options of `coopenv film`."""

    agent: Annotated[
        str | None,
        typer.Option(
            help="Driver, as of `coopenv view`; several with commas between: their films side by side.",
            show_default=False,
            **arguments.POLICIES,
        ),
    ] = None
    observer: Annotated[
        str | None,
        typer.Option(
            help="Observer (default: that of the environment); several with commas between: their films side by side.",
            show_default=False,
            **arguments.OBSERVERS,
        ),
    ] = None
    out: Annotated[Path, typer.Option(help="File to write: .mp4, .gif or .webp.")]
    speed: Annotated[float, typer.Option(min=0.05, max=100.0, help="Times real time.")] = 1.0
    fps: Annotated[
        float | None, typer.Option(min=1.0, max=50.0, help="Pictures a second (default: 20 for MP4, else 10).")
    ] = None
    width: Annotated[
        int, typer.Option(min=64, max=1920, help="Width of the pictures, pixels; a film from above has at most 896.")
    ] = 896
    map_only: Annotated[
        bool, typer.Option("--map-only", help="Leave out the table and the legend of a film from above.")
    ] = False
    space: Annotated[bool, typer.Option("--3d", help="3-D film, lit and with shadows (extra film3d).")] = False
    camera: Annotated[
        str,
        typer.Option(
            help="With --3d: overview, follow, pair or driver; several with commas between: one below another.",
            autocompletion=arguments.completion(lambda: ("overview", "follow", "pair", "driver"), several=True),
        ),
    ] = "overview"
    vehicle: Annotated[
        str | None, typer.Option(help="With --3d: vehicle to follow, or of the camera (default: f1).")
    ] = None
    headings: Annotated[
        str | None, typer.Option(help="Headings of films side by side, with commas between (default: their names).")
    ] = None

    def takes(self, log: "Console") -> "list[tuple[str, Episode]]":
        """Return the scenes that stand side by side, each with what it differs in.

        Raises:
            CoopenvError: one cannot be played.
        """
        saved = self.saved()
        if saved is not None:
            return [(self.headings or "", saved)]
        observers: list[str | None] = [*arguments.words(self.observer)] or [None]
        agents: list[str | None] = [*arguments.words(self.agent)] or [None]
        pairs = [(observer, agent) for observer in observers for agent in agents]
        names = [
            ", ".join(n for n, of in ((observer, observers), (agent, agents)) if n is not None and len(of) > 1)
            for observer, agent in pairs
        ]
        if (headings := arguments.words(self.headings)) and len(headings) != len(pairs):
            raise CoopenvError(f"--headings: expected one for each of {len(pairs)} films, got {len(headings)}")
        return [
            (name, replace(self, observer=observer, agent=agent)._played(log))
            for name, (observer, agent) in zip(headings or names, pairs, strict=True)
        ]

    def _played(self, log: "Console") -> "Episode":
        from coopenv.runs.scenes import played_scene, title_of

        backend = self.open()
        policy, driver = (None, "") if backend.capabilities.recorded else self.driver(backend.scenario)
        return played_scene(backend, title_of(self.environment), log, self.seed, policy, driver)

    def shots(self, takes: "list[tuple[str, Episode]]") -> "list[list[Shot]]":
        """Return the parts of the picture: a column for each scene, a row for each camera.

        Raises:
            CoopenvError: no such camera or vehicle, or the extra is missing.
        """
        from coopenv.runs.films import Shot, space_film
        from coopenv.runs.live import vehicle_index
        from coopenv.viz.topview import TopView

        if not self.space:
            panel = not self.map_only and len(takes) == 1
            return [[Shot(record, TopView(record.scenario, panel=panel), name) for name, record in takes]]
        picked = vehicle_index(takes[0][1].scenario, self.vehicle)
        return space_film(takes, self.width, arguments.words(self.camera), picked)


@commands.command
def film(given: FilmOptions) -> None:
    """Film an episode, or several side by side, from above or in 3-D: MP4, GIF or WebP."""
    from coopenv.base.files import check_file
    from coopenv.runs.console import Progress
    from coopenv.runs.films import check_film, write_film

    out, log = given.out, options.console(stderr=True)
    if given.space:
        commands.refuse(given, ("map_only",), "is for a film from above, without --3d")
    else:
        commands.refuse(given, ("camera", "vehicle"), "is for a 3-D film, with --3d")
    rate = given.fps or (20.0 if out.suffix == ".mp4" else 10.0)
    check_film(out)
    check_file(out)
    shots = given.shots(given.takes(log))
    with Progress(log, f"filming {out.name}", 1.0) as progress:
        pictures = write_film(shots, out, rate, given.speed, given.width, progress.update)
    size = out.stat().st_size / 1e6
    options.console().print(f"{out}: {pictures} pictures, {pictures / rate:.3g} s, {size:.2g} MB", soft_wrap=True)


watched = arguments.late("coopenv.sources.registry:watched")


@dataclass(frozen=True, kw_only=True)
class ViewOptions(SceneOptions):
    """Options of `coopenv view`."""

    environment: Annotated[
        str,
        typer.Argument(
            metavar="ENV|FILE.mcap|BAG|RUN|svea",
            help="Environment (name or TOML file), a log file, a ROS bag, recorded robots (mrclam_1 .. mrclam_9), the "
            "folder of a run, or svea: the cars of --deployment.",
            autocompletion=arguments.environments,
            callback=lambda name: name if name in watched() else arguments.known_source(name),
        ),
    ]
    vehicle: Annotated[str | None, typer.Option(help="Vehicle to look at first, vehicle_1 or f1.")] = None
    port: Annotated[
        int | None, typer.Option(min=1, max=65535, help="Port to listen on (default: 8080, or the next free one).")
    ] = None
    host: Annotated[str, typer.Option(help="Address to listen on; 0.0.0.0 lets other computers watch and switch.")] = (
        "127.0.0.1"
    )
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Open no browser.")] = False
    deployment: Annotated[Path | None, typer.Option(help="Of svea: the deployment file of the cars.")] = None
    connect: options.Connect = None

    def open(self, more: Mapping[str, Any] | None = None) -> "Backend":
        """Return the source of ticks, cars included."""
        if self.environment not in watched() or self.deployment is None:
            return super().open(more)
        from coopenv.sources.sources import open_backend

        watching = {} if self.observer is None else {"observer.name": self.observer}
        changes = {**self.changes, **watching, **(more or {})}
        return open_backend(self.deployment, self.environment, changes, connect=self.connect, watch=True)

    def reel(self) -> "Reel":
        """Return the source of frames; cars are observed and not driven.

        Raises:
            CoopenvError: there is no such source, or an option is not for it.
        """
        from coopenv.runs.live import EngineReel, Reel
        from coopenv.runs.scenes import title_of

        if self.environment in watched():
            if self.deployment is None:
                raise CoopenvError(
                    f"--deployment: needed by coopenv view {self.environment}, the deployment file of the cars"
                )
            if self.agent is not None:
                raise CoopenvError(
                    f"--agent: is for a simulation; coopenv {self.environment} run --arm lets an agent drive cars"
                )
            return EngineReel(self.open, self.deployment.stem, self.seed, lambda scenario: (None, ""))
        for option, value in (("--deployment", self.deployment), ("--connect", self.connect)):
            if value is not None:
                raise CoopenvError(f"{option} {value}: is for coopenv view {' or '.join(watched())}")
        saved = self.saved()
        return (
            EngineReel(self.open, title_of(self.environment), self.seed, self.driver)
            if saved is None
            else Reel.of(saved)
        )


@commands.command
def view(given: ViewOptions) -> None:
    """Watch an environment, a record or cars live in the browser; Ctrl-C ends it.

    The page loads nothing from other computers. Cars are observed only: they are never armed from here.
    """
    from coopenv.runs.console import compile_notice
    from coopenv.runs.live import vehicle_index
    from coopenv.runs.view import Viewer
    from coopenv.viz.web import guarded_server, viser_module

    viser_module()
    log = options.console(stderr=True)
    with compile_notice(log):
        reel = given.reel()
    try:
        picked = None if given.vehicle is None else vehicle_index(reel.scenario, given.vehicle)
        with guarded_server(given.host, given.port) as (server, url):
            viewer = Viewer(server, reel)
            viewer.pick(picked)
            options.console().print(f"{url}  (Ctrl-C ends the view)", soft_wrap=True)
            if given.host not in ("127.0.0.1", "localhost", "::1"):
                warning = "warning: anyone with this address can watch and control the view; it is sent unencrypted"
                log.print(warning, soft_wrap=True)
            if not given.no_browser:
                options.show_page(url)
            viewer.run()
    finally:
        reel.close()
