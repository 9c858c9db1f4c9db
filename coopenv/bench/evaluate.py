"""`coopenv evaluate`: from the options to tables, files and figures; `coopenv.evaluate`.

Figures are the error along the way, time against error, and where drivers looked.
"""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from rich.console import Console

from coopenv.base.errors import explained
from coopenv.base.files import check_new, replace_text, replacing_folder
from coopenv.base.format import json_text
from coopenv.base.installation import names_of, version, versions
from coopenv.bench.contest import Contest
from coopenv.bench.evaluation import KINDS, Evaluation, evaluated
from coopenv.episode import Episode
from coopenv.evaluation import METRICS, held_out_seeds
from coopenv.evaluation.episodes import Episodes
from coopenv.evaluation.metrics import SCORE, Quantile, interval, resamples
from coopenv.report.terminal import Terminal
from coopenv.runs import films
from coopenv.runs.command import REPLAY_FILE
from coopenv.runs.console import Progress, compile_notice
from coopenv.runs.films import Shot, video_path
from coopenv.runs.scenes import frame_stride, played_scene, write_page
from coopenv.scenario import ScenarioLike
from coopenv.sources.sources import simulation_of
from coopenv.viz import FORMATS, style
from coopenv.viz.style import INK, NORMAL, SMALL
from coopenv.viz.topview import TopView

JSON_FILE = "evaluation.json"


def document(evaluation: Evaluation, command: str) -> dict[str, Any]:
    """Return the content of `evaluation.json`; `command` is the line that gives the same figures again."""
    return {
        "command": command,
        "coopenv": version(),
        "versions": versions("numpy", "warp-lang"),
        "environment": evaluation.environment,
        "overrides": dict(evaluation.overrides),
        "worlds": evaluation.worlds,
        "seed_block": evaluation.block,
        "score": SCORE,
        "ranking": evaluation.ranking,
        "metrics": {name: {"unit": metric.unit, "meaning": metric.meaning} for name, metric in METRICS.items()},
        "rows": evaluation.rows,
        "reference": evaluation.reference,
        "differences": evaluation.difference_rows,
        "seen_share": {
            name: {
                own: dict(zip(e.vehicles, row, strict=True))
                for own, row in zip(e.vehicles, e.seen_share.tolist(), strict=True)
            }
            for name, e in evaluation.episodes.items()
        },
    }


def run(
    contest: Contest,
    command: str,
    log: Console,
    *,
    out: Path | None = None,
    figures: str | None = None,
    width: str | None = None,
    film: bool = False,
    force: bool = False,
) -> Evaluation:
    """Evaluate, with progress shown, and write the files.

    Args:
        contest: the evaluation.
        command: the command line that gives the same figures again.
        log: console of the progress.
        out: folder of the files, which is replaced as a whole; None: no files.
        figures: their format; None: no figures and no replay.
        width: column of `coopenv.viz.figures` that figures are drawn for; None: a page's.
        film: write a film.
        force: replace an earlier evaluation in the folder.

    Raises:
        OutputError: the folder holds an earlier evaluation that is not to be replaced, or it cannot be written.
    """

    def driven() -> Evaluation:
        with Progress(log, "driving", total=len(contest.entrants)) as progress, compile_notice(log):
            return evaluated(contest, lambda done, name: progress.update(done, f"driving: {name}"))

    if out is None:
        return driven()
    check_new(out / JSON_FILE, force)
    names = [JSON_FILE, *(f"{name}.{form}" for name in KINDS for form in FORMATS), *films.VIDEO_FILES, REPLAY_FILE]
    with replacing_folder(out, [*names, *(path.name for path in out.glob("replay_*.html"))]) as new:
        evaluation = driven()
        replace_text(new / JSON_FILE, json_text(document(evaluation, command)))
        if figures is not None or film:
            scenes = scenes_of(evaluation, log)
        if figures is not None:
            with Progress(log, "drawing figures"):
                save_figures(evaluation, new, figures, width)
            write_replays(evaluation, scenes, new, log)
        if film:
            write_film(scenes, new, log)
    return evaluation


@explained
def evaluate(
    environment: ScenarioLike,
    agents: str | Callable[..., Any] | Iterable[str | Callable[..., Any]] = (),
    worlds: int = 256,
    *,
    overrides: Mapping[str, Any] | None = None,
    seed_block: int = 0,
    ideal: bool = False,
) -> Evaluation:
    """Let agents drive in the same held-out worlds, as `coopenv evaluate` does; printed, the result is its tables.

    For example `coopenv.evaluate("facade", ["route_follower", "peek"], worlds=64).to_pandas()`.

    Args:
        environment: name, TOML file, dict or scenario, as for `coopenv.load_scenario`.
        agents: one or several names, folders, import paths (`mine.py:Mine`), classes or functions; none: every shipped
            agent made for the environment.
        worlds: number of worlds.
        overrides: dotted scenario keys.
        seed_block: number of the block of held-out seeds.
        ideal: let `route_follower` drive under ideal sensing, too.

    Raises:
        CoopenvError: an argument is not valid, or an agent cannot drive here.
    """
    contest = Contest.of(environment, overrides or {}, names_of(agents), worlds, seed_block, ideal)
    return run(contest, "", Terminal(stderr=True))


BINS = 24
_RESAMPLES, _FINE = 300, 300
_PANEL = 2.0  # inches
_MARKS = "osD^vPX*"
_RAREST = 1e-3
"""Share of time that is at the centre of the directions looked in."""


def save_figures(evaluation: Evaluation, folder: Path, file_format: str, width: str | None = None) -> None:
    """Write all figures of an evaluation to a folder, for a page or a column of `coopenv.viz.figures`."""
    for name in KINDS:
        evaluation.figure(name, width=width, path=folder / f"{name}.{file_format}")


def error_figure(evaluation: Evaluation, width: float | None = None) -> Figure:
    """Draw median and 95th percentile of the position error over the distance driven, with their intervals."""
    figure, _ = style.canvas(width, 3.9, _note(evaluation, "bands: 95 % intervals over worlds"))
    panels = figure.subplots(1, 2)
    farthest = max(float(np.quantile(own.distance[-1], 0.9)) for own in evaluation.episodes.values())
    edges = np.linspace(0.0, max(farthest, 1e-3), BINS + 1)
    for ax, share, words in zip(panels, (0.5, 0.95), ("median", "95th percentile"), strict=True):
        style.tidy(ax, x_label="distance driven [m]", y_label="position error [m], log" if share == 0.5 else "")
        ax.set_title(words, fontsize=NORMAL, color=INK)
        ax.set_yscale("log")
        for look, episodes in zip(_looks(evaluation), evaluation.episodes.values(), strict=True):
            _draw_error(ax, episodes, share, edges, look["color"])
    style.share_decades(panels)
    style.legend_above(figure, [Line2D([], [], lw=1.5, **look) for look in _looks(evaluation, marks=False)])
    return figure


def _draw_error(ax: Axes, episodes: Episodes, share: float, edges: np.ndarray, colour: str) -> None:
    counts = resamples(episodes.worlds, 0, _RESAMPLES)
    place = np.where(episodes.under_way, np.searchsorted(edges, episodes.distance, side="right") - 1, -1)
    found = []
    for number in range(len(edges) - 1):
        chosen = place == number
        quantile = Quantile(episodes.position_error[chosen], np.nonzero(chosen)[1], episodes.worlds, share, _FINE)
        found.append((quantile.value, *interval(quantile.resampled(counts))))
    middle, (value, low, high) = (edges[1:] + edges[:-1]) / 2, style.drawable(np.array(found).T, positive=True)
    ax.plot(middle, value, color=colour, linewidth=style.LINE)
    ax.fill_between(middle, low, high, color=colour, alpha=0.18, linewidth=0)


def pareto_figure(evaluation: Evaluation, width: float | None = None) -> Figure:
    """Draw travel time against the 95th percentile of the position error, with the intervals of both."""
    figure, _ = style.canvas(width or 5.2, 3.9, _note(evaluation, "bars: 95 % intervals over worlds"))
    ax = figure.subplots()
    style.tidy(ax, x_label="travel time [s]", y_label="95th percentile of the position error [m], log")
    ax.set_yscale("log")
    for look, results in zip(_looks(evaluation), evaluation.results.values(), strict=True):
        known = {result.metric: result for result in results}
        time, error = known["travel_time_s"], known["e95_m"]
        bars = [[[max(0.0, r.mean - r.ci_low)], [max(0.0, r.ci_high - r.mean)]] for r in (time, error)]
        if np.isfinite([time.mean, error.mean]).all() and error.mean > 0:
            ax.errorbar([time.mean], [error.mean], xerr=bars[0], yerr=bars[1], ms=6, lw=1.0, capsize=2, **look)
    style.show_decades(ax)
    style.legend_above(figure, [Line2D([], [], ls="", ms=6, **look) for look in _looks(evaluation)])
    return figure


def looking_figure(evaluation: Evaluation, width: float | None = None) -> Figure:
    """Draw how often each driver's camera looked in which direction, 0 being straight ahead along its way.

    Radii are logarithms of the shares: most views are straight ahead, which would hide the rest.
    """
    columns = min(style.fitting(width or style.PAGE, _PANEL * 0.8, 4), len(evaluation.episodes))
    rows = -(-len(evaluation.episodes) // columns)
    note = _note(evaluation, f"0: along the way, positive: left; shares from {100 * _RAREST:g} %")
    figure, _ = style.canvas(width, 0.5 + _PANEL * rows, note)
    edges = np.radians(np.arange(-93, 94, 6))
    rings = _RAREST * 10.0 ** np.arange(1, 4)
    for number, (look, episodes) in enumerate(zip(_looks(evaluation), evaluation.episodes.values(), strict=True)):
        ax: Any = figure.add_subplot(rows, columns, number + 1, projection="polar")
        ax.set_theta_zero_location("N")
        ax.set(thetamin=-93, thetamax=93, rlim=(0, _radius(rings[-1])))
        ax.tick_params(labelsize=SMALL, pad=1)
        ax.set_rticks(_radius(rings), [f"{100 * ring:g} %" for ring in rings], fontsize=SMALL - 1)
        bars = {"width": np.diff(edges), "align": "edge", "color": look["color"], "alpha": 0.75, "linewidth": 0}
        ax.bar(edges[:-1], _radius(_shares(episodes, edges)), **bars)
        ax.set_title(look["label"], fontsize=NORMAL, color=INK, pad=6)
        ax.set_xlabel("share of time, log", fontsize=SMALL, color=INK, labelpad=-20)
    return figure


def _radius(share: np.ndarray) -> np.ndarray:
    """Return decades above the rarest share that is drawn; 0 below it."""
    return np.asarray(np.log10(np.maximum(share, _RAREST) / _RAREST))


def _shares(episodes: Episodes, edges: np.ndarray) -> np.ndarray:
    """Return the share of the time of vehicles under way that they look between edges, rad; beyond: at the ends."""
    offset = episodes.looking[episodes.under_way]
    offset = np.clip(offset[np.isfinite(offset)], edges[0], edges[-1])
    return np.asarray(np.histogram(offset, edges)[0] / max(1, len(offset)))


def _looks(evaluation: Evaluation, marks: bool = True) -> list[dict[str, Any]]:
    """Return colour, mark and label of every driver, the same in every figure."""
    return [
        {"color": style.vehicle_colour(i), "label": name, **({"marker": _MARKS[i % len(_MARKS)]} if marks else {})}
        for i, name in enumerate(evaluation.episodes)
    ]


def _note(evaluation: Evaluation, words: str) -> str:
    return f"{evaluation.environment}, {evaluation.worlds} held-out worlds (block {evaluation.block}); {words}"


COLUMNS = 3
"""Pictures in a row of the film."""


def scenes_of(evaluation: Evaluation, log: Console) -> list[Episode]:
    """Return every driver's episode in the first world of an evaluation."""
    seed = held_out_seeds(evaluation.block, evaluation.worlds)[0]
    return [
        played_scene(simulation_of(each.scenario), evaluation.environment, log, seed, each.policy, each.name)
        for each in evaluation.entrants
    ]


def write_film(scenes: Sequence[Episode], folder: Path, log: Console) -> None:
    """Write the film of all drivers, side by side and below each other, until the last episode has ended."""
    shots = [Shot(record, TopView(record.scenario, panel=False), record.source.policy) for record in scenes]
    rows = [shots[first : first + COLUMNS] for first in range(0, len(shots), COLUMNS)]
    path, scenario = video_path(folder), scenes[0].scenario
    with Progress(log, f"filming {path.name}", 1.0) as progress:
        fps = scenario.rates.camera / frame_stride(scenario)
        films.write_film(rows, path, fps, width=None, on_progress=progress.update)


def write_replays(evaluation: Evaluation, scenes: Sequence[Episode], folder: Path, log: Console) -> None:
    """Write a page per driver; none, and a line, where the extra `view` is missing.

    `replay.html` is that of the first driver that has learnt, else of the first of all.
    """
    kinds, files = [entrant.kind for entrant in evaluation.entrants], dict[str, str]()
    shown = kinds.index("learned") if "learned" in kinds else 0
    for number, record in enumerate(scenes):
        plain = re.sub(r"[^\w.-]+", "_", record.source.policy)
        file = REPLAY_FILE if number == shown else f"replay_{plain}.html"
        files[record.source.policy] = file if file not in files.values() else f"replay_{plain}_{number}.html"
    for record in (scenes[shown], *scenes[:shown], *scenes[shown + 1 :]):
        if write_page(record, folder / files[record.source.policy], log, files) is None:
            return
