"""`coopenv run` and `coopenv.run`: simulate with progress shown, write the results, print the table."""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

from rich.console import Console, ConsoleOptions, RenderResult

from coopenv.base.errors import CoopenvError, DataError, explained, is_of_user, listed
from coopenv.base.files import replace_text, replacing_folder
from coopenv.base.format import json_text
from coopenv.base.installation import install_command
from coopenv.base.seeds import checked_seed
from coopenv.episode import OF_TRAJECTORY, RECORDED, SCENE_FILE
from coopenv.estimation.metrics import shown_note, shown_vehicles, steady_start
from coopenv.estimation.observability import Observability, analyse_observability
from coopenv.estimation.trajectory import Trajectory
from coopenv.observers.contract import Factory
from coopenv.observers.registry import states_covariance, with_observer
from coopenv.policies import Policy
from coopenv.report.notebook import WIDTH, one_line, picture_html, terminal_html
from coopenv.report.table import Table
from coopenv.report.tabular import Tabular
from coopenv.report.terminal import Terminal, text_of
from coopenv.runs import console as lines
from coopenv.runs.console import Progress, compile_notice
from coopenv.runs.films import VIDEO_FILES, top_view_film, video_path, write_film
from coopenv.runs.rollouts import Rollout, estimates, run_metrics, theory_rates, vehicle_metrics
from coopenv.runs.scenes import frame_stride, write_page
from coopenv.scenario import Scenario, ScenarioLike, load_scenario
from coopenv.sources.base import Repeating
from coopenv.sources.selection import Selection
from coopenv.sources.sources import open_backend, source_name
from coopenv.viz import FIGURE_NAMES, FORMATS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from coopenv.observers.recording import Recording

METRICS_FILE, TRAJECTORY_FILE, REPLAY_FILE = "metrics.json", "trajectory.npz", "replay.html"


def result_names() -> list[str]:
    """Return the names of all files that a run can write."""
    figures = [f"{name}.{file_format}" for name in FIGURE_NAMES for file_format in FORMATS]
    return [METRICS_FILE, TRAJECTORY_FILE, SCENE_FILE, REPLAY_FILE, *figures, *VIDEO_FILES]


def execute(
    name: str,
    run: Rollout,
    out: Path | None,
    log: Console,
    overrides: Mapping[str, Any],
    steady_from: float | None = None,
    figures: str | None = None,
    video: bool = False,
    describe: Callable[[], str] | None = None,
    width: str | None = None,
    check: Callable[[], None] | None = None,
) -> "Results":
    """Run, write to the folder `out` (None: no files), and return what came of it.

    A run that does not reach its end writes nothing to `out`, unless a user's sensor has ended it. `figures` is their
    format; None: no figures. `width` is a column of `coopenv.viz.figures`; None: a page's. `describe` returns the text
    beside the bar. `check` is called when the run is over, and raises CoopenvError if it is not worth its files.

    Raises:
        CoopenvError: an argument is not valid, or the results cannot be written.
        UserCodeError: a user's sensor has failed; the results up to then are written.
    """
    scenario = run.scenario
    if run.policy_name not in ("zero", "recorded") and not scenario.driven:
        log.print("note: all motion here is prescribed, the policy has no effect", soft_wrap=True)
    steady = steady_start(steady_from, scenario.horizon, run.ticks_planned / scenario.rates.camera)
    able = run.engine.backend.capabilities
    paced = scenario.rates.camera if able.real_time and not able.simulated_clock else None
    doing = "replaying" if able.recorded else "driving" if able.real_time else "simulating"
    lines.note_overwritten(out, result_names(), log)
    with nullcontext() if out is None else replacing_folder(out, result_names()) as folder:
        with compile_notice(log):
            run.engine.load()
        stride = frame_stride(scenario)
        with Progress(log, doing, run.ticks_planned, paced) as progress:
            failure = _played(run, OF_TRAJECTORY if out is None else RECORDED, stride, progress, describe)
            if failure is not None and (out is None or run.ticks_recorded < 1):
                raise failure
            if check is not None and failure is None:
                check()
            episode = run.episode(name)
            results, observability = _figures_of(name, overrides, run, episode.trajectory, steady)
        if folder is None or out is None:
            return results
        scene = episode.drawn(stride)
        paths = [folder / METRICS_FILE, folder / TRAJECTORY_FILE, folder / SCENE_FILE]
        replace_text(paths[0], json_text(results.metrics))
        episode.trajectory.save(paths[1])
        scene.save(paths[2])
        if figures is not None and observability is not None:
            with Progress(log, "drawing figures"):
                paths += results.save_figures(folder, figures, width, observability)
        if figures is not None:
            page = write_page(scene, folder / REPLAY_FILE, log)
            paths += [] if page is None else [page]
        if video:
            paths.append(video_path(folder))
            with Progress(log, f"filming {paths[-1].name}", 1.0) as progress:
                fps = scenario.rates.camera / stride
                write_film(top_view_film(scene), paths[-1], fps, width=None, on_progress=progress.update)
            if paths[-1].suffix == ".gif":
                log.print(f"video: written as GIF; for MP4: {install_command('video')}", soft_wrap=True)
    if failure is not None:
        time = run.ticks_recorded / scenario.rates.camera
        raise CoopenvError(f"{failure} (the {time:g} s before it are in {out})") from failure
    return replace(results, files=tuple(out / path.name for path in paths))


def _played(
    run: Rollout, fields: Sequence[str], stride: int, progress: Progress, describe: Callable[[], str] | None
) -> CoopenvError | None:
    """Play a run, and return the error of a user's sensor that has ended it; None: it has reached its end."""
    try:
        for tick in run.play(fields):
            if tick % stride == 0:
                progress.update(tick, describe() if describe is not None else None)
    except CoopenvError as error:
        if not is_of_user(error):
            raise
        return error
    return None


def _figures_of(
    name: str, overrides: Mapping[str, Any], run: Rollout, whole: Trajectory, steady: float
) -> tuple["Results", Observability | None]:
    """Return the results of a run with the record `whole`, and its observability where any truth is known."""
    chosen = whole.with_truth(run.vehicles)
    known, unknown = whole.of_vehicles(chosen).where_truth_is_known(), [i for i in run.vehicles if i not in chosen]
    observability = analyse_observability(known) if chosen else None
    rows, without = [], []
    if observability is not None:
        rows = vehicle_metrics(known, observability, run.endings(chosen), steady, theory_rates(run, known))
    if unknown:
        covariance = states_covariance(run.scenario.observer.name)
        without = estimates(whole.of_vehicles(unknown), steady, covariance)
    metrics = run_metrics(name, overrides, run, rows, steady, without)
    return Results(metrics, known if chosen else whole.of_vehicles(unknown), run.scenario), observability


@partial(explained, hint="; several seeds or observers: coopenv.compare")
def run(
    environment: "ScenarioLike | Recording",
    seed: int = 0,
    *,
    policy: str | Policy = "zero",
    observer: str | Factory | None = None,
    overrides: Mapping[str, Any] | None = None,
    steps: int | None = None,
    out: str | Path | None = None,
    steady_from: float | None = None,
    data: str | Path | None = None,
    variant: str | None = None,
    topics: str | Path | None = None,
    start: float | None = None,
    until: float | None = None,
    robots: Sequence[str | int] | None = None,
    trust: Sequence[str] = (),
    device: str = "cpu",
    dtype: str = "float64",
) -> "Results":
    """Run an episode and judge its estimates, as `coopenv run` does; printed, the result is its table.

    For example `coopenv.run("facade", seed=1, policy="peek", observer="robust").trajectory.to_pandas()`.

    Args:
        environment: name, TOML file, dict or scenario, as for `coopenv.load_scenario`, or recorded data: an MCAP file,
            a ROS bag, `mrclam_6`, or a `Recording`.
        seed: of all that is drawn.
        policy: of driven vehicles: "zero", "random", or what `coopenv.policies.find_agent` takes.
        observer: name, class or import path; None: that of the scenario.
        overrides: dotted scenario keys, for example {"noise.enabled": False}.
        steps: decisions; None: up to the horizon.
        out: folder for files, figures and replay; None: no files.
        steady_from: start of the steady state, s; None: after 70 % of the horizon.
        data: folder of recorded data sets.
        variant: of a data set.
        topics: TOML file with the map of a ROS bag's topics.
        start: begin of the part of recorded data that is used, s.
        until: its end, s.
        robots: recorded robots that are used, by name or number; None: all.
        trust: topics of a ROS bag that are used although other streams contradict, see `coopenv doctor`.
        device: "cpu" or a CUDA device.
        dtype: "float32" or "float64".

    Raises:
        CoopenvError: an argument is not valid, or the results cannot be written.
    """
    changes, log = with_observer(overrides, observer), Terminal(stderr=True)
    chosen = Selection.of(start, until, robots, trust)
    backend = open_backend(environment, None, changes, chosen, data=data, variant=variant, topics=topics)
    with compile_notice(log):
        made = Rollout(backend.scenario, checked_seed(seed), steps, dtype, device, policy, backend)
    name, folder = source_name(environment), None if out is None else Path(out)
    return execute(name, made, folder, log, changes, steady_from, "png")


def report(run: Rollout, result: "Results", folder: Path, out: Console) -> None:
    """Print the results of `execute` for people."""
    able, metrics = run.engine.backend.capabilities, result.metrics
    source = f"seed {run.seed}, {noise_note(run.scenario)}"
    done = f"Simulated at {metrics['real_time_factor']:.3g} times real time"
    if able.recorded:
        source, done = "recorded", done.replace("Simulated", "Replayed")
    elif able.simulated_clock:
        source, done = f"on a simulated clock, seed {run.seed}", done.replace("Simulated", "Driven")
    elif able.real_time:
        source, done = f"in real time, seed {run.seed}", f"It took {metrics['simulated_time_s']:.4g} s of real time"
    out.print(f"{run.scenario.title}: {source}, {metrics['dtype']} on {metrics['device']}", soft_wrap=True)
    out.print()
    out.print(result)
    if others := [name for i, name in enumerate(run.scenario.vehicle_names) if i not in run.vehicles]:
        why = "left out" if able.recorded else "received by radio, not estimated here"
        out.print(f"{listed(others)}: {why}", soft_wrap=True)
    out.print(f"Outcome: {metrics['outcome']}. {done}.")
    if isinstance(run.engine.backend, Repeating) and run.engine.backend.stopped:
        out.print(f"Stopped: {run.engine.backend.stopped}", soft_wrap=True, markup=False)
    out.print(f"Files in {folder}:", soft_wrap=True)
    names = ", ".join(path.name for path in result.files)
    out.print(fill(names, out.width, initial_indent="  ", subsequent_indent="  "))
    if (page := folder / REPLAY_FILE) in result.files:
        out.print(f"To watch it in a browser, open {page}", soft_wrap=True)


def noise_note(scenario: Scenario) -> str:
    """Return whether noise is on, and which sensors have none."""
    noise = scenario.noise
    if not noise.enabled:
        return "noise off"
    odometry = noise.velocity or noise.angular_velocity or noise.lasts
    sensors = {"bearings": noise.bearing.scale, "odometry": odometry}
    exact = " and ".join(name for name, size in sensors.items() if not size)
    return f"no noise is set for {exact}" if exact else "noise on"


_NEEDED = ("environment", "seed", "policy", "overrides", "versions", "steady_from_s", "vehicles")


@dataclass(frozen=True, eq=False)
class Results(Tabular):
    """Results of a run, as in its folder; printed, it is its table.

    The trajectory as a table: `to_pandas`, `to_polars`, `to_xarray`, `to_csv` and `to_parquet`.
    """

    _PARTS = "trajectory"
    metrics: dict[str, Any]
    """Contents of `metrics.json`."""
    trajectory: Trajectory
    """Of the vehicles that were estimated and whose truth is known, at these ticks.

    Where nothing is known, as without motion capture: of all that were estimated, at all ticks, errors being NaN.
    """
    scenario: Scenario | None = None
    """The world of the run; None where only its file has it, such as a recording."""
    files: tuple[Path, ...] = ()
    """Files that were written."""

    @classmethod
    def read(cls, folder: str | Path) -> "Results":
        """Read a folder.

        Raises:
            DataError: it is no folder of a run, or a file of it cannot be read.
        """
        folder = Path(folder)
        path = folder / METRICS_FILE
        try:
            metrics = json.loads(path.read_text(encoding="utf-8"))
        except NotADirectoryError:
            raise DataError(f"{folder}: a file; expected a folder that `coopenv run` has written") from None
        except OSError as error:
            raise DataError(f"{folder}: no folder of `coopenv run` ({METRICS_FILE}: {error.strerror})") from None
        except ValueError as error:
            raise DataError(f"{path}: not JSON ({error})") from None
        missing = [key for key in _NEEDED if not isinstance(metrics, dict) or key not in metrics]
        if missing:
            raise DataError(f"{path}: not of a run, missing: {', '.join(missing)}")
        whole = Trajectory.load(folder / TRAJECTORY_FILE)
        names = whole.vehicles.tolist()
        try:
            others = metrics.setdefault("without_truth", [])  # of a run before 0.9
            judged = [names.index(row["vehicle"]) for row in metrics["vehicles"] or others]
            metrics.setdefault("observer", "unknown observer")  # of a run before 0.2
            ends = [row["ended_at_s"] for row in metrics["vehicles"]]
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(f"{path}: vehicles differ from {TRAJECTORY_FILE}'s ({error})") from None
        if not all(end is None or isinstance(end, float | int) for end in ends):
            raise DataError(f"{path}: ended_at_s: expected numbers")
        metrics |= {key: _with_nan(metrics[key]) for key in ("vehicles", "without_truth")}
        try:
            scenario = load_scenario(metrics["environment"], metrics["overrides"])
        except CoopenvError:
            scenario = None
        chosen = whole.of_vehicles(judged)
        return cls(metrics, chosen.where_truth_is_known() if metrics["vehicles"] else chosen, scenario)

    def __getitem__(self, vehicle: str) -> Trajectory:
        """Return the trajectory of one vehicle."""
        return self.trajectory[vehicle]

    def columns(self) -> Table:
        """Return the trajectory, a row per tick and vehicle."""
        return self.trajectory.columns()

    def __repr__(self) -> str:
        facts = {key: self.metrics.get(key) for key in ("observer", "policy", "seed", "outcome")}
        return one_line(self, self.metrics["environment"], facts)

    def _repr_html_(self) -> str:
        table = terminal_html(self)
        return table + picture_html(self.figure("trajectories_2d")) if self.metrics["vehicles"] else table

    def __str__(self) -> str:
        return text_of(self, WIDTH)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        if others := self.metrics.get("without_truth"):
            yield lines.estimates_table(others)
            yield f"No true poses, and so no errors. Standard deviations: mean after {self.steady_from:g} s."
        if not self.metrics["vehicles"]:
            return
        if others:
            yield ""
        shown, end = shown_vehicles(self.trajectory, self.steady_from, self.ends), float(self.trajectory.t[-1])
        vehicles = [self.metrics["vehicles"][i] for i in shown]
        yield Table.of(lines.COLUMNS, vehicles, folds=True)
        if note := shown_note(len(self.trajectory.vehicles)):
            yield f"{note}; all of them: {METRICS_FILE}"
        yield ""
        yield from lines.rates(vehicles)
        yield from lines.gaps(self.metrics, len(self.trajectory.t), end)
        yield from lines.legend(self.steady_from, end, self.trajectory.nees_dof)
        yield from lines.remarks(vehicles)

    @property
    def ends(self) -> list[float]:
        """Time (s) of each vehicle's end; NaN: still under way."""
        return [float(row["ended_at_s"]) for row in self.metrics["vehicles"]]

    @property
    def steady_from(self) -> float:
        """Start of the steady state, s."""
        return float(self.metrics["steady_from_s"])

    def figure(
        self,
        kind: str = "errors",
        *,
        width: str | float | None = None,
        path: str | Path | None = None,
        format: str | None = None,
    ) -> "Figure":
        """Draw a figure of `coopenv.viz.FIGURE_NAMES`, and write it where a path is given.

        Width, path, format and errors are those of `Comparison.figure`.
        """
        from coopenv.viz.figures import draw_figure
        from coopenv.viz.style import save

        drawn = draw_figure(kind, self.trajectory, width=width, **self._drawn)
        if path is not None:
            save(drawn, Path(path), format or "", about=self._about)
        return drawn

    @property
    def _about(self) -> dict[str, Any]:
        """Metadata of the files of figures."""
        names = ("environment", "observer", "seed", "policy", "overrides")
        return {"coopenv": self.metrics["versions"]["coopenv"], **{name: self.metrics[name] for name in names}}

    @property
    def _drawn(self) -> dict[str, Any]:
        """Options of all figures. Raises CoopenvError: no true poses are known."""
        if not self.metrics["vehicles"]:
            raise CoopenvError(f"{self.metrics['environment']}: no true poses are known, which figures need")
        gain = not states_covariance(self.metrics["observer"])
        return {"scenario": self.scenario, "ends": self.ends, "steady_from": self.steady_from, "gain": gain}

    def save_figures(
        self,
        folder: Path,
        file_format: str,
        width: str | None,
        observability: Observability | None = None,
    ) -> list[Path]:
        """Write the figures to a folder and return their paths; arguments as of `coopenv.viz.figures.save_figures`.

        Figures for a column of a journal have the words that describe the run in the metadata alone.
        """
        from coopenv.viz.figures import save_figures

        about = self._about
        note = f"{about['environment']}, {about['observer']}, seed {about['seed']}" if width is None else ""
        return save_figures(
            self.trajectory,
            folder,
            observability,
            file_format=file_format,
            about=about,
            width=width,
            note=note,
            **self._drawn,
        )


def _with_nan(value: Any) -> Any:
    """Return data from JSON with NaN in place of null."""
    if isinstance(value, dict):
        return {key: _with_nan(entry) for key, entry in value.items()}
    return [_with_nan(entry) for entry in value] if isinstance(value, list) else math.nan if value is None else value
