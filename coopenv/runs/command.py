"""`coopenv run`: simulate with progress shown, write the results, print the table."""

import json
import math
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill
from typing import Any

from rich.console import Console

from coopenv.backends.base import Repeating
from coopenv.base.errors import CoopenvError, DataError, listed
from coopenv.base.files import replace_text, replacing_folder
from coopenv.base.format import json_text
from coopenv.estimation.metrics import steady_start
from coopenv.estimation.observability import analyse_observability
from coopenv.estimation.trajectory import Trajectory
from coopenv.observers.registry import states_covariance
from coopenv.runs.console import Progress, compile_notice, legend, metrics_table, rates, remarks
from coopenv.runs.rollouts import Rollout, run_metrics, theory_rates, vehicle_metrics
from coopenv.runs.scenes import Keeper, write_page
from coopenv.runs.video import Film, GifFilm, frame_stride, open_film
from coopenv.scenario import Scenario, load_scenario
from coopenv.viz import FIGURE_NAMES, FORMATS
from coopenv.viz.scene import SceneRecord, Source
from coopenv.viz.scene.record import SCENE_FILE

METRICS_FILE, TRAJECTORY_FILE, VIDEO_FILES = "metrics.json", "trajectory.npz", ("video.mp4", "video.gif")
REPLAY_FILE = "replay.html"


def result_names() -> list[str]:
    """Return the names of all files that a run can write."""
    figures = [f"{name}.{file_format}" for name in FIGURE_NAMES for file_format in FORMATS]
    return [METRICS_FILE, TRAJECTORY_FILE, SCENE_FILE, REPLAY_FILE, *figures, *VIDEO_FILES]


class NoTruthError(CoopenvError):
    """At no two ticks of a run are the true poses of all vehicles known."""


def execute(
    name: str,
    run: Rollout,
    out: Path,
    log: Console,
    overrides: Mapping[str, Any],
    steady_from: float | None,
    figures: str | None,
    video: bool,
    describe: Callable[[], str] | None = None,
    width: str | None = None,
) -> dict[str, Any]:
    """Run, write to the folder `out`, and return what `run --json` prints: the metrics, and the paths of the files.

    A run that does not reach its end writes nothing. `figures` is their format; None: no figures. `width` is a column
    of `coopenv.viz.figures`; None: a page's. `describe` returns the text beside the bar.

    Raises:
        NoTruthError: no true poses are known.
        CoopenvError: an argument is not valid, or the results cannot be written.
    """
    scenario = run.scenario
    if run.policy_name not in ("zero", "recorded") and not scenario.driven:
        log.print("note: all motion here is prescribed, the policy has no effect", soft_wrap=True)
    steady = steady_start(steady_from, scenario.horizon, run.ticks_planned / scenario.rates.camera)
    with replacing_folder(out, result_names()) as folder, ExitStack() as films:
        with compile_notice(log):
            run.engine.load()
        film = open_film(folder, scenario.rates.camera / frame_stride(scenario)) if video else None
        if film is not None:
            films.enter_context(film)
        scene = _simulate(name, run, film, log, describe)
        trajectory = run.trajectory()
        judged, endings = trajectory.of_vehicles(run.vehicles).where_truth_is_known(), run.endings()
        if len(judged.t) < 2:
            raise NoTruthError(f"{name}: no true poses are known, so there are no errors to show")
        observability = analyse_observability(judged)
        rates = theory_rates(run, judged)
        vehicles = vehicle_metrics(judged, observability, endings, steady, rates)
        metrics = run_metrics(name, overrides, run, vehicles, steady)
        replace_text(folder / METRICS_FILE, json_text(metrics))
        trajectory.save(folder / TRAJECTORY_FILE)
        scene.save(folder / SCENE_FILE)
        paths = [folder / METRICS_FILE, folder / TRAJECTORY_FILE, folder / SCENE_FILE]
        if figures is not None:
            with Progress(log, "drawing figures"):
                from coopenv.viz.figures import save_figures

                ends = [ending.time for ending in endings]
                options: dict[str, Any] = {"scenario": scenario, "steady_from": steady, "file_format": figures}
                options |= figure_words(metrics, width)
                paths += save_figures(judged, folder, observability, ends=ends, **options)
            page = write_page(scene, folder / REPLAY_FILE, log)
            paths += [] if page is None else [page]
        if film is not None:
            with Progress(log, f"finishing {film.path.name}"):
                film.close()
            if isinstance(film, GifFilm):
                log.print("video: written as GIF; for MP4: pip install '.[video]'", soft_wrap=True)
            paths.append(film.path)
    return {**metrics, "files": [out / path.name for path in paths]}


def figure_words(metrics: Mapping[str, Any], width: str | None) -> dict[str, Any]:
    """Return the arguments of `save_figures` that describe a run.

    Figures for a column of a journal have them in the metadata alone.
    """
    about = {name: metrics[name] for name in ("environment", "observer", "seed", "policy", "overrides")}
    note = f"{about['environment']}, {about['observer']}, seed {about['seed']}"
    words = {"coopenv": metrics["versions"]["coopenv"], **about}
    gain = not states_covariance(about["observer"])
    return {"about": words, "gain": gain, "width": width, "note": note if width is None else ""}


def _simulate(
    name: str, run: Rollout, film: Film | None, log: Console, describe: Callable[[], str] | None
) -> SceneRecord:
    """Play a run to its end and return its scene."""
    view = None
    if film is not None:
        from coopenv.viz.topview import TopView

        view = TopView(run.scenario)
    recorded = run.engine.backend.capabilities.recorded
    policy = run.policy_name if run.scenario.driven and not recorded else ""
    source = Source.of(name, run.scenario, seed=None if recorded else run.seed, policy=policy)
    keeper = Keeper(run.engine, source)
    rate = run.scenario.rates.camera if run.engine.backend.capabilities.real_time else None
    with Progress(log, _doing(run), run.ticks_planned, rate) as progress:
        for tick in run.play():
            if (frame := keeper.tick(tick)) is not None:
                if film is not None and view is not None:
                    film.add(view.paint(frame))
                progress.update(tick, describe() if describe is not None else None)
    return keeper.record()


def _doing(run: Rollout) -> str:
    """Return the activity of a run by its backend: simulating, replaying or driving."""
    abilities = run.engine.backend.capabilities
    return "replaying" if abilities.recorded else "driving" if abilities.real_time else "simulating"


def report(run: Rollout, result: Mapping[str, Any], folder: Path, out: Console) -> None:
    """Print what `execute` returned for people."""
    able, pace = run.engine.backend.capabilities, f"{result['real_time_factor']:.3g} times real time"
    source = f"seed {run.seed}, noise {'on' if run.scenario.noise.enabled else 'off'}"
    done = f"Simulated at {pace}"
    if able.recorded:
        source, done = "recorded", f"Replayed at {pace}"
    elif able.real_time:
        source, done = f"in real time, seed {run.seed}", f"It took {result['simulated_time_s']:.4g} s of real time"
    out.print(f"{run.scenario.title}: {source}, {result['dtype']} on {result['device']}", soft_wrap=True)
    out.print()
    out.print(metrics_table(result["vehicles"]))
    out.print()
    for part in rates(result["vehicles"]):
        out.print(part)
    explained = legend(result["steady_from_s"], result["simulated_time_s"])
    for line in (*explained, *remarks(result["vehicles"])):
        out.print(line)
    if others := [name for i, name in enumerate(run.scenario.vehicle_names) if i not in run.vehicles]:
        out.print(f"{listed(others)}: heard by radio, not estimated here", soft_wrap=True)
    out.print(f"Outcome: {result['outcome']}. {done}.")
    if isinstance(run.engine.backend, Repeating) and run.engine.backend.stopped:
        out.print(f"Stopped: {run.engine.backend.stopped}", soft_wrap=True, markup=False)
    out.print(f"Files in {folder}:", soft_wrap=True)
    names = ", ".join(path.name for path in result["files"])
    out.print(fill(names, out.width, initial_indent="  ", subsequent_indent="  "))
    if (page := folder / REPLAY_FILE) in result["files"]:
        out.print(f"To watch it in a browser, open {page}", soft_wrap=True)


_NEEDED = ("environment", "seed", "policy", "overrides", "versions", "steady_from_s", "vehicles")


@dataclass(frozen=True)
class Results:
    """A folder of `coopenv run`."""

    folder: Path
    metrics: dict[str, Any]
    trajectory: Trajectory
    """Of the vehicles that were estimated, at the ticks at which their truth is known."""

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
            judged = [names.index(row["vehicle"]) for row in metrics["vehicles"]]
            metrics.setdefault("observer", "unknown observer")  # of a run before 0.2
            ends = [row["ended_at_s"] for row in metrics["vehicles"]]
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(f"{path}: vehicles are not those of {TRAJECTORY_FILE} ({error})") from None
        if not all(end is None or isinstance(end, float | int) for end in ends):
            raise DataError(f"{path}: ended_at_s: expected numbers")
        return cls(folder, metrics, whole.of_vehicles(judged).where_truth_is_known())

    @property
    def ends(self) -> list[float]:
        """When each vehicle ended, s; NaN: it did not."""
        return [math.nan if row["ended_at_s"] is None else float(row["ended_at_s"]) for row in self.metrics["vehicles"]]

    @property
    def steady_from(self) -> float:
        """Start of the steady state, s."""
        return float(self.metrics["steady_from_s"])

    def scenario(self) -> Scenario | None:
        """Return the world of the run; None where only its file could tell, such as of a recording."""
        try:
            return load_scenario(self.metrics["environment"], self.metrics["overrides"])
        except CoopenvError:
            return None
