"""`coopenv run`: simulate with progress shown, write the results, print the table."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from textwrap import fill
from typing import Any, NamedTuple

from rich.console import Console

from coopenv.backends.base import Backend
from coopenv.errors import CoopenvError
from coopenv.estimation.metrics import steady_start
from coopenv.estimation.observability import Observability, analyse_observability
from coopenv.estimation.trajectory import Trajectory
from coopenv.files import replacing_folder
from coopenv.runs.console import Progress, compile_notice
from coopenv.runs.metrics import run_metrics, vehicle_metrics
from coopenv.runs.output import result_names, write_results
from coopenv.runs.rollouts import Rollout
from coopenv.runs.table import legend, metrics_table, remarks
from coopenv.runs.video import Film, GifFilm, frame_stride, open_film
from coopenv.scenario import Scenario


@dataclass(frozen=True)
class RunRequest:
    """What `coopenv run` was asked for; see its help."""

    name: str
    backend: Backend
    folder: Path
    overrides: dict[str, Any] = field(default_factory=dict)
    seed: int = 0
    steps: int | None = None
    device: str = "cpu"
    dtype: str = "float64"
    policy: str = "zero"
    steady_from: float | None = None
    figures: str | None = "png"
    """Format of the figures; None: no figures."""
    video: bool = False

    @property
    def scenario(self) -> Scenario:
        """What is run."""
        return self.backend.scenario


class RunResult(NamedTuple):
    """What a run came to, and the files that it wrote."""

    metrics: dict[str, Any]
    paths: list[Path]

    def document(self) -> dict[str, Any]:
        """Return what `run --json` prints."""
        return {**self.metrics, "files": self.paths}


def execute(request: RunRequest, log: Console) -> RunResult:
    """Run and write; a run that does not reach its end writes nothing.

    Raises:
        CoopenvError: an argument is not valid, or the results cannot be written.
    """
    scenario = request.scenario
    recording = Rollout(
        scenario, request.seed, request.steps, request.dtype, request.device, request.policy, request.backend
    )
    if request.policy != "zero" and not scenario.driven:
        log.print("note: all motion here is prescribed, the policy has no effect", soft_wrap=True)
    end = recording.ticks_planned / scenario.rates.camera
    steady_from = steady_start(request.steady_from, scenario.horizon, end)
    with replacing_folder(request.folder, result_names()) as folder:
        with compile_notice(log):
            recording.engine.load()
        film = open_film(folder, _fps(scenario)) if request.video else None
        _simulate(recording, film, log)
        trajectory = recording.trajectory()
        judged = trajectory.where_truth_is_known()
        if len(judged.t) < 2:
            raise CoopenvError(f"{request.name}: no true poses are known, so there are no errors to show")
        observability = analyse_observability(judged)
        vehicles = vehicle_metrics(judged, observability, recording.endings(), steady_from)
        metrics = run_metrics(request.name, request.overrides, recording, vehicles, steady_from)
        paths = write_results(folder, trajectory, metrics)
        if request.figures is not None:
            paths += _draw(folder, judged, recording, observability, steady_from, request.figures, log)
        if film is not None:
            paths.append(_finish(film, log))
    return RunResult(metrics, [request.folder / path.name for path in paths])


def _fps(scenario: Scenario) -> float:
    return scenario.rates.camera / frame_stride(scenario)


def _simulate(recording: Rollout, film: Film | None, log: Console) -> None:
    """Play the recording to its end."""
    view = None
    if film is not None:
        from coopenv.viz.topview import TopView

        view = TopView(recording.scenario)
    stride = frame_stride(recording.scenario)
    with Progress(log, "simulating", recording.ticks_planned) as progress:
        for tick in recording.play():
            if tick % stride == 0:
                if film is not None and view is not None:
                    film.add(view.draw(recording.engine))
                progress.update(tick)


def _draw(
    folder: Path,
    judged: Trajectory,
    recording: Rollout,
    observability: Observability,
    steady_from: float,
    file_format: str,
    log: Console,
) -> list[Path]:
    with Progress(log, "drawing figures"):
        from coopenv.viz.figures import save_figures

        return save_figures(
            judged,
            folder,
            observability,
            scenario=recording.scenario,
            ends=[ending.time for ending in recording.endings()],
            steady_from=steady_from,
            file_format=file_format,
        )


def _finish(film: Film, log: Console) -> Path:
    with Progress(log, f"finishing {film.path.name}"):
        film.close()
    if isinstance(film, GifFilm):
        log.print("video: written as GIF; for MP4: pip install '.[video]'", soft_wrap=True)
    return film.path


def report(request: RunRequest, result: RunResult, out: Console) -> None:
    """Print the result for people."""
    metrics, scenario = result.metrics, request.scenario
    source = f"seed {request.seed}, noise {'on' if scenario.noise.enabled else 'off'}"
    if request.backend.capabilities.recorded:
        source = "recorded"
    out.print(f"{scenario.title}: {source}, {metrics['dtype']} on {metrics['device']}", soft_wrap=True)
    out.print()
    out.print(metrics_table(metrics["vehicles"]))
    out.print()
    explained = legend(metrics["steady_from_s"], metrics["simulated_time_s"])
    for line in (*explained, *remarks(metrics["vehicles"])):
        out.print(line)
    factor = metrics["real_time_factor"]
    out.print(f"Outcome: {metrics['outcome']}. Simulated at {factor:.3g} times real time.")
    out.print(f"Files in {request.folder}:", soft_wrap=True)
    names = ", ".join(path.name for path in result.paths)
    out.print(fill(names, out.width, initial_indent="  ", subsequent_indent="  "))
