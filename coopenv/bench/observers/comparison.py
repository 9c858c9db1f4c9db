"""Observers compared on the same records: Monte Carlo over seeds and variants."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console, ConsoleOptions, RenderResult

from coopenv.base.errors import CoopenvError, DataWarning, check_one_of, explained
from coopenv.base.installation import names_of
from coopenv.base.seeds import checked_seed
from coopenv.bench.executors import Executor, Local
from coopenv.bench.observers import tables
from coopenv.bench.observers.judge import JudgedRun, Task, judge_all
from coopenv.bench.observers.rows import EDGES, Leaderboard, checked_edges
from coopenv.bench.observers.sources import ALL, RecordSource, find_source, variants_of, with_sensor_sets
from coopenv.observers.contract import Factory
from coopenv.observers.registry import find, list_observers, named, obstacle, portable
from coopenv.report.notebook import one_line, picture_html, terminal_html
from coopenv.report.table import Table
from coopenv.report.tabular import Tabular, written
from coopenv.report.terminal import Terminal, text_of
from coopenv.runs.console import Progress
from coopenv.scenario import ScenarioLike
from coopenv.sources.selection import Selection

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from coopenv.observers.recording import Recording


SEEDS = 5
"""Number of seeds by default."""


class Comparison(Leaderboard, Tabular):
    """Results of observers on the same records, as tables, files and figures.

    Printed, it is its tables; `found["riccati"]` has the results of one observer. Tables of whole runs, or with
    `windows=True` of every window of time: `to_pandas`, `to_polars`, `to_xarray`, `to_csv` and `to_parquet`.
    """

    _PARTS = "observers"

    def table(self, variant: str | None = None) -> Table:
        """Return the position RMSE of every observer and vehicle beside the bounds, m, as a table for a terminal.

        0.0123(4) stands for 0.0123 with a standard error of 0.0004 over the seeds.

        Args:
            variant: None: the first one.

        Raises:
            CoopenvError: it was not run.
        """
        return tables.error_table(self, self._checked(variant))

    def columns(self, windows: bool = False) -> Table:
        """Return the rows with all columns, of whole runs or of every window of time."""
        keys = ("variant", "observer", *(("window",) if windows else ()), "vehicle")
        return Table.of_rows(self.window_rows if windows else self.rows, *keys)

    def __getitem__(self, observer: str) -> Comparison:
        """Return the results of one observer alone.

        Raises:
            CoopenvError: it was not compared.
        """
        check_one_of("unknown observer", observer, self.observers)
        samples = [sample for sample in self.samples if sample.observer == observer]
        draws = [draw for draw in self.draws if draw.observer == observer]
        return replace(self, observers=(observer,), samples=samples, draws=draws)

    def to_latex(self, path: str | Path | None = None, variant: str | None = None) -> str:
        """Return the position RMSE with standard errors as a LaTeX table (package booktabs); write it to a path.

        Args:
            path: None: no file.
            variant: None: the first one.

        Raises:
            CoopenvError: the variant was not run, or the file cannot be written.
        """
        return written(tables.latex(self, self._checked(variant)), path)

    def figure(
        self,
        kind: str = "errors",
        *,
        variant: str | None = None,
        width: str | float | None = None,
        path: str | Path | None = None,
        format: str | None = None,
    ) -> Figure:
        """Draw a figure, and write it where a path is given.

        Args:
            kind: "errors" or "consistency" over time, "variants" (a map of errors), "cost" (error against time) or
                "protection" (Stanford diagrams).
            variant: of all but variants; None: the first one.
            width: a column of `coopenv.viz.figures.COLUMNS`, whose fonts the figure then has, such as "ieee1", or
                inches; None: a page's.
            path: file to write.
            format: "png", "pdf" or "svg"; None: as the path ends.

        Raises:
            CoopenvError: no such kind or variant, nothing to draw, or the file cannot be written.
        """
        from coopenv.bench.observers.figures import KINDS
        from coopenv.viz import figures
        from coopenv.viz.style import save

        check_one_of("unknown figure", kind, KINDS)
        drawn = KINDS[kind](self, self._checked(variant), figures.inches_of(width))
        if drawn is None:
            raise CoopenvError(f"figure '{kind}': there is nothing to draw")
        if isinstance(width, str):
            figures.restyle(drawn, width)
        if path is not None:
            about = {"environment": self.environment, "observers": ", ".join(self.observers)}
            about |= {"variant": variant or "all", "seeds": ", ".join(map(str, self.seeds))}
            save(drawn, Path(path), format or "", about=about)
        return drawn

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        return tables.everything(self, options.max_width)

    def __repr__(self) -> str:
        facts = {"observers": self.observers, "variants": tuple(self.variants), "seeds": len(self.seeds)}
        return one_line(self, self.environment, facts)

    def _repr_html_(self) -> str:
        drawn = any(self.samples_in(next(iter(self.variants))))  # unless all observers failed
        return terminal_html(self) + (picture_html(self.figure()) if drawn else "")

    def __str__(self) -> str:
        return text_of(self, tables.WIDTH)

    def _checked(self, variant: str | None) -> str:
        if variant is None:
            return next(iter(self.variants))
        if variant not in self.variants:
            raise CoopenvError(f"variant '{variant}' was not run; there are {', '.join(self.variants)}")
        return variant


@explained
def compare(
    observers: str | Factory | Iterable[str | Factory] | None,
    environment: ScenarioLike | Recording,
    seeds: int | Iterable[int] | None = None,
    *,
    variants: str | Sequence[str] | None = None,
    overrides: Mapping[str, Any] | None = None,
    steady_from: float | None = None,
    windows: Sequence[float] | None = None,
    data: str | Path | None = None,
    topics: str | Path | None = None,
    start: float | None = None,
    until: float | None = None,
    robots: Sequence[str | int] | None = None,
    faults: Sequence[str] = (),
    policy: str | None = None,
    sensors: bool = False,
    jobs: int = 1,
) -> Comparison:
    """Compare observers on the same records.

    For example `coopenv.compare(["riccati", Mine], "busy_intersection_tracking", seeds=20)`.

    Args:
        observers: one or several names, classes, or import paths (`mine.py:Mine`, `package.module:Mine`); None: all
            that suit.
        environment: name, TOML file, dict or scenario, as for `coopenv.load_scenario`; recorded robots (`mrclam_1`,
            `mrclam_1_space`, ...), MCAP file, ROS bag or `Recording`.
        seeds: their number (0, 1, ...), or a list; None: 5. Of a bag they draw the initial estimates; other recorded
            data are one record.
        variants: names, or "all": faults of an environment, what recorded robots see; None: the usual ones.
        overrides: dotted scenario keys, for example {"noise.enabled": False}.
        steady_from: start of the steady state, s; None: after 70 % of the run.
        windows: edges of stretches of the run that are judged one by one, s; None: 5, 10, 20 and 35, of recorded
            robots none.
        data: folder of recorded data sets; None: the variable COOPENV_DATA.
        topics: TOML file with the map of a ROS bag's topics.
        start: begin of the part of recorded data that is used, s.
        until: its end, s.
        robots: recorded robots that are used, by name or number; None: all.
        faults: further variants with parameters, such as "vehicle_2:lie=drift:0.05@10", see docs/observers.md.
        policy: agent or policy that drives in the records of an environment; None: action zero.
        sensors: also compare with the camera alone, each other sensor alone, the camera with each, and all of them.
        jobs: processes. More than one need a script whose own work stands below `if __name__ == "__main__":`, and
            classes that a module or file holds.

    Raises:
        CoopenvError: an argument is not valid, or names what does not exist.
    """
    if isinstance(environment, str) and environment in list_observers():
        raise CoopenvError(f"compare: environment '{environment}' is an observer; observers come first")
    source = find_source(environment, overrides, data, topics, faults, policy, Selection.of(start, until, robots))
    source = with_sensor_sets(source) if sensors else source
    plan = Plan.of(observers, source, seeds, variants, steady_from, windows)
    plan.source.check()
    with Progress(Terminal(stderr=True), plan.work, total=1.0) as progress:
        return plan.run(Local(jobs), progress.update)


@dataclass(frozen=True)
class Plan:
    """Observers, records and numbers of a comparison, all checked to exist."""

    source: RecordSource
    observers: tuple[str, ...]
    variants: tuple[str, ...]
    seeds: tuple[int, ...]
    steady_from: float | None
    """s; None: the source's own."""
    edges: tuple[float, ...] = ()
    """s, of the windows that are judged one by one."""
    left_out: Mapping[str, str] = field(default_factory=dict)
    """Observers and variants that would be compared if they could be, each with the obstacle."""

    @classmethod
    def of(
        cls,
        observers: Iterable[str | Factory] | None,
        source: RecordSource,
        seeds: int | Iterable[int] | None,
        variants: str | Sequence[str] | None = None,
        steady_from: float | None = None,
        windows: Sequence[float] | str | None = None,
    ) -> Plan:
        """Return a checked plan for a source; the other arguments, and errors, as for `compare`."""
        names, chosen = _observers(observers), variants_of(source, variants)
        given = seeds if isinstance(seeds, Iterable) else range(checked_seed(SEEDS if seeds is None else seeds))
        numbers = tuple(dict.fromkeys(map(checked_seed, given)))
        if not numbers:
            raise CoopenvError("seeds: expected at least one")
        if seeds is not None and not source.seeded and numbers != (0,):
            warnings.warn(DataWarning(f"{source.name}: one recording, in which seeds draw nothing"), stacklevel=2)
        edges = checked_edges(windows) if windows is not None else EDGES if source.windowed else ()
        obstacles = {} if observers is not None else {name: obstacle(name) for name in list_observers()}
        if ALL in ([variants] if isinstance(variants, str) else variants or ()):
            obstacles |= {name: source.obstacle(name) for name in source.variants}
        left_out = {name: reason for name, reason in obstacles.items() if reason}
        return cls(source, names, chosen, numbers, steady_from, edges, left_out)

    @property
    def work(self) -> str:
        """The work to do, for the progress bar."""
        parts = {"observer": self.observers, "variant": self.variants, "seed": self._used}
        return ", ".join(f"{len(part)} {word}{'s' if len(part) > 1 else ''}" for word, part in parts.items())

    def run(self, executor: Executor, on_progress: Callable[[float], None] = lambda share: None) -> Comparison:
        """Judge the observers; the result does not depend on the executor.

        Raises:
            CoopenvError: a record cannot be made, or the steady state would start beyond it.
        """
        tasks = self.tasks
        return self.compared(judge_all(executor, tasks, lambda done: on_progress(done / len(tasks))))

    @property
    def tasks(self) -> list[Task]:
        """Tasks of one record each, with its observers.

        Raises:
            CoopenvError: the steady state would start beyond the record.
        """
        self.source.steady_from(self.steady_from)
        # One record serves all observers. Recorded robots are few and long records: their observers are shared out.
        groups = [self.observers] if self.source.seeded else [(name,) for name in self.observers]
        sent = [{name: portable(name) for name in group} for group in groups]
        made = product(self.variants, self._used, sent)
        first = (self.variants[0], self._used[0])  # one record shows an observer's mistakes
        return [Task(self.source, *parts, self.steady_from, self.edges, parts[:2] == first) for parts in made]

    @property
    def _used(self) -> tuple[int, ...]:
        return self.seeds if self.source.seeded else (0,)

    def compared(self, judged: Iterable[Iterable[JudgedRun]]) -> Comparison:
        """Return the comparison from the results of the tasks."""
        order = list(product(self.variants, self.observers))
        samples = sorted(chain(*judged), key=lambda sample: order.index((sample.variant, sample.observer)))
        summaries = {variant: self.source.variants[variant] for variant in self.variants}
        return Comparison(
            self.source.name,
            self.observers,
            summaries,
            self._used,
            samples,
            recorded=self.source.recorded,
            sensor_sets=self.source.sensor_sets,
        )


def _observers(observers: Iterable[str | Factory] | None) -> tuple[str, ...]:
    """Return the names of observers, each once; None: of all that can be used here."""
    if observers is None:
        return tuple(name for name in list_observers() if not obstacle(name))
    given = list(dict.fromkeys(names_of(observers)))
    if not given:
        raise CoopenvError("observers: expected at least one name or class")
    names = [named(observer) for observer in given]
    for observer, name in zip(given, names, strict=True):
        if find(observer) != find(name):  # factories of kernels are made anew
            raise CoopenvError(f"two observers are named '{name}': register them under names of their own")
    return tuple(dict.fromkeys(names))
