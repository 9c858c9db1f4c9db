"""`coopenv run`, `record`, `figures` and `export`."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from coopenv.base.errors import CoopenvError, DataWarning
from coopenv.cli import arguments, commands, options


@dataclass(frozen=True, kw_only=True)
class RunOptions(options.SourceOptions):
    """Options of `coopenv run`."""

    seed: options.Seed = 0
    steps: Annotated[int | None, typer.Option(min=1, help="Decisions to run (default: up to the horizon).")] = None
    out: Annotated[Path | None, typer.Option(help="Folder of the results (default: out/ENV).")] = None
    device: Annotated[str, typer.Option(help="Device that computes: cpu, cuda, cuda:0, ...")] = "cpu"
    dtype: Annotated[str, typer.Option(help="Precision: float32 or float64.")] = "float64"
    policy: options.PolicyName = "zero"
    observer: options.ObserverName = None
    steady_from: options.SteadyFrom = None
    figures: Annotated[options.FigureFormat, typer.Option(help="Format of the figures.")] = options.FigureFormat.png
    width: options.FigureWidth = None
    no_figures: Annotated[bool, typer.Option("--no-figures", help="Draw no figures and no replay.")] = False
    video: Annotated[bool, typer.Option("--video", help="Also write a video of the top view.")] = False
    open_out: Annotated[
        bool,
        typer.Option("--open", help="Show the replay in a browser when it is done, or else the folder."),
    ] = False
    as_json: options.AsJson = False

    @property
    def changes(self) -> dict[str, Any]:
        """The overrides of the scenario, its observer included."""
        from coopenv.observers.registry import with_observer

        return with_observer(super().changes, self.observer)


@commands.command
def run(given: RunOptions) -> None:
    """Run an environment; write metrics, arrays, figures and a page that plays the episode."""
    name = Path(given.environment).stem
    refuse_for_recordings(given.environment, seed=given.seed, policy=given.policy)
    backend = given.open()
    from coopenv.runs.command import REPLAY_FILE, execute, report
    from coopenv.runs.console import compile_notice
    from coopenv.runs.rollouts import Rollout

    folder, log = given.out or Path("out") / name, options.console(stderr=True)
    with compile_notice(log):
        rollout = Rollout(backend.scenario, given.seed, given.steps, given.dtype, given.device, given.policy, backend)
    result = execute(
        name,
        rollout,
        folder,
        log,
        given.changes,
        given.steady_from,
        None if given.no_figures else given.figures.value,
        given.video,
        width=given.width and given.width.value,
    )
    if given.as_json:
        options.print_json({**result.metrics, "files": result.files})
    else:
        report(rollout, result, folder, options.console())
    if given.open_out:
        page = folder / REPLAY_FILE
        options.show_page(page) if page in result.files else options.show(folder)


RunFolder = Annotated[
    Path,
    typer.Argument(metavar="RUN", help="Folder that `coopenv run` has written.", callback=arguments.existing("run")),
]


def refuse_for_recordings(environment: str, seed: int, policy: str) -> None:
    """Refuse options that only a simulation knows where they are given for a recording.

    Of a bag the initial estimates may be drawn.
    """
    from coopenv.sources.registry import kind_of

    kind = kind_of(environment)
    for option, value in (("--seed", seed if kind.reader else 0), ("--policy", policy)):
        if kind.recorded and value not in (0, "zero"):
            raise CoopenvError(f"{option}: is for a simulation, {environment} is recorded")


@dataclass(frozen=True, kw_only=True)
class RecordOptions(options.SourceOptions):
    """Options of `coopenv record`."""

    out: Annotated[Path, typer.Option(help="MCAP file to write; with --ros a folder.")]
    seed: options.Seed = 0
    policy: options.PolicyName = "zero"
    observer: options.LogObserver = None
    scene: options.LogScene = True
    ros: Annotated[bool, typer.Option("--ros", help="Write a plain ROS 2 bag, with the map to read it back.")] = False
    no_replay: Annotated[bool, typer.Option("--no-replay", help="Write no page that plays the episode.")] = False
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False


@commands.command
def record(given: RecordOptions) -> None:
    """Write what vehicles sense to an MCAP file, and beside it a page that plays the episode.

    The file holds every tick; coopenv replays it, Foxglove and Lichtblick show it with the estimates of an observer.
    """
    from coopenv.base.files import check_new
    from coopenv.observers.registry import with_observer
    from coopenv.runs.console import Progress
    from coopenv.runs.recorder import record_episode
    from coopenv.runs.scenes import (
        MOST_SHOWN,
        frame_stride,
        observer_of,
        pages_can_be_written,
        played_scene,
        title_of,
        write_log,
        write_page,
    )
    from coopenv.sources.registry import kind_of, write_as
    from coopenv.sources.sources import allow_kinds, open_backend, open_recording

    out, page, observer, environment = given.out, given.out.with_suffix(".html"), given.observer, given.environment
    check_log(out.with_suffix(".mcap") if given.ros else out, observer, given.scene)
    for path in (out, *([] if given.no_replay else [page])):
        check_new(path, given.force)
    kind = kind_of(environment, given.topics)
    if given.topics is not None and "topics" not in kind.options:
        raise CoopenvError(f"--map {given.topics}: is for ROS bags, {environment} is none")
    refuse_for_recordings(environment, given.seed, given.policy)
    log, played, failures = options.console(stderr=True), None, list[CoopenvError]()
    if kind.reader:
        if allow_kinds(given.changes):
            raise CoopenvError(f"--override: is for a simulation, {environment} is recorded")
        recording = open_recording(environment, given.data, given.variant, given.selection)
    else:
        backend = given.open()
        with Progress(log, "recording", total=1.0) as progress:
            episode = record_episode(
                backend, given.seed, given.policy, progress.update, name=out.name, on_failure=failures.append
            )
        recording, played = episode.measured, episode.drawn(frame_stride(episode.scenario))
    if given.ros:
        write_as("ros2", recording, out, (observer or observer_of(recording)) if given.scene else None)
    else:
        write_log(recording, out, log, observer, given.scene)
    count = len(recording.setups)
    facts = f"{count} vehicle{'' if count == 1 else 's'}, {recording.ticks} ticks, {recording.t[-1]:g} s"
    options.console().print(f"{out}: {facts}", soft_wrap=True)
    if failures:
        raise CoopenvError(f"{failures[0]} (the {recording.t[-1]:g} s before it are in {out})") from failures[0]
    if given.no_replay or not pages_can_be_written(page, log):
        return
    if played is None:
        with warnings.catch_warnings(action="ignore", category=DataWarning):  # these have been printed
            shown = observer or observer_of(recording)
            backend = open_backend(environment, None, with_observer({}, shown), given.selection, **given.files)
            whole = backend.scenario.horizon
            first = f", first {MOST_SHOWN:g} s of {whole:.0f} s" if whole > MOST_SHOWN else ""
            played = played_scene(backend, title_of(environment) + first, log, longest=MOST_SHOWN)
    write_page(played, page, log)
    options.console().print(f"{page}: the episode, to watch in a browser", soft_wrap=True)


def check_log(out: Path, observer: str | None, scene: bool) -> None:
    """Refuse before any work a log that cannot be written. Raises CoopenvError: its path, the observer, or no SDK."""
    from coopenv.observers.registry import find, named
    from coopenv.sources.mcap import check_target, log_views

    check_target(out)
    if not scene and observer is not None:
        raise CoopenvError(f"--observer {observer}: is for a scene, --no-scene has none")
    if scene:
        for program in log_views().values():
            program.check_installed()
    if observer is not None:
        find(named(observer))


ExportFormat = StrEnum(
    "ExportFormat",
    {"tum": "tum", "csv": "csv", "parquet": "parquet", "layout": "foxglove-layout", "ros2": "ros2"},
)
Exported = Annotated[
    Path,
    typer.Argument(
        metavar="RUN|FILE.mcap",
        help="Folder that `coopenv run` has written, or log of `record`.",
        callback=arguments.existing("run or log"),
    ),
]
LAYOUT_FILE = "foxglove_layout.json"


def figures(
    run: RunFolder,
    file_format: Annotated[
        options.FigureFormat, typer.Option("--format", help="Format of the files.")
    ] = options.FigureFormat.pdf,
    width: options.FigureWidth = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the figures (default: RUN/figures).")] = None,
) -> None:
    """Draw the figures of an earlier run again, for example for a paper."""
    from coopenv.runs.command import Results
    from coopenv.runs.console import Progress

    results, folder = Results.read(run), out or run / "figures"
    with Progress(options.console(stderr=True), "drawing figures"):
        paths = results.save_figures(folder, file_format.value, width and width.value)
    options.console().print(f"Files in {folder}: {', '.join(path.name for path in paths)}", soft_wrap=True)


def export(
    source: Exported,
    file_format: Annotated[
        ExportFormat,
        typer.Option(
            "--format",
            help="tum: true and estimated trajectories of a run, which evo reads. csv, parquet: its table, a row per "
            "tick and vehicle. foxglove-layout: how Foxglove arranges a log. ros2: a log as a plain ROS 2 bag.",
        ),
    ] = ExportFormat.tum,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the trajectories (default: RUN/tum) or of the bag (default: FILE), or file (default: "
            f"RUN/trajectory.csv or .parquet; {LAYOUT_FILE})."
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing bag.")] = False,
) -> None:
    """Write a run or a log in the formats of other programs."""
    if file_format is ExportFormat.layout:
        _export_layout(source, out or Path(LAYOUT_FILE))
        return
    if file_format is ExportFormat.ros2:
        _export_log(source, out or source.with_suffix(""), file_format.value, force)
        return
    from coopenv.runs.command import Results
    from coopenv.runs.exports import write_tum

    results = Results.read(source)
    if file_format in (ExportFormat.csv, ExportFormat.parquet):
        path = out or source / f"trajectory.{file_format.value}"
        results.to_csv(path) if file_format is ExportFormat.csv else results.to_parquet(path)
        options.console().print(f"{path}: {len(results.trajectory.t)} ticks", soft_wrap=True)
        return
    folder = out or source / file_format.value
    paths = write_tum(results.trajectory, folder)
    options.console().print(f"Files in {folder}: {', '.join(path.name for path in paths)}", soft_wrap=True)


def _export_log(log: Path, out: Path, form: str, force: bool) -> None:
    from coopenv.base.files import check_new
    from coopenv.runs.scenes import observer_of
    from coopenv.sources.registry import write_as
    from coopenv.sources.sources import open_recording

    check_new(out, force)
    recording = open_recording(log)
    write_as(form, recording, out, observer_of(recording))
    options.console().print(f"{out}: {len(recording.setups)} vehicles, {recording.ticks} ticks", soft_wrap=True)


def _export_layout(log: Path, out: Path) -> None:
    from coopenv.base.errors import DataError
    from coopenv.base.files import replace_text
    from coopenv.sources.mcap import log_views
    from coopenv.sources.mcap_format import codec, reading

    codec()
    from coopenv.sources.mcap_container import Container

    if log.is_dir():
        raise DataError(f"{log}: a folder; expected a log file (.mcap)")
    with reading(str(log)):
        topics = Container(log).topics()
    if "/scene/world" not in topics:
        raise DataError(f"{log}: has no scene, `coopenv record --scene` writes one")
    replace_text(out, log_views()["foxglove"].layout_text(topics))
    options.console().print(f"{out}: import it in Foxglove or Lichtblick (Layouts, Import from file)", soft_wrap=True)
