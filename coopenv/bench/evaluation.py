"""Results of drivers on the same held-out worlds, as tables, figures and in words."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console, ConsoleOptions, RenderResult

from coopenv.base.errors import check_one_of
from coopenv.base.format import NONE
from coopenv.base.installation import load_reference
from coopenv.bench.contest import BASELINE, Contest
from coopenv.evaluation import METRICS, Difference, Episodes, Result, compare_paired, score
from coopenv.evaluation.metrics import LOSSES, ranking_key
from coopenv.report.notebook import WIDTH, one_line, picture_html, terminal_html
from coopenv.report.table import Table
from coopenv.report.tabular import Tabular
from coopenv.report.terminal import text_of
from coopenv.scenario.terms import LOST

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KINDS = {
    "error_along_the_way": "coopenv.bench.evaluate:error_figure",
    "time_against_error": "coopenv.bench.evaluate:pareto_figure",
    "looking": "coopenv.bench.evaluate:looking_figure",
}
"""Functions that draw the figures of an evaluation, loaded when drawn: their module imports this one."""


@dataclass(frozen=True, eq=False)
class Evaluation(Contest, Tabular):
    """Episodes and figures of drivers, by name; printed, it is its tables.

    As a table it has a row per driver and metric: `to_pandas`, `to_polars`, `to_xarray`, `to_csv` and `to_parquet`.
    """

    _PARTS = "episodes"
    episodes: Mapping[str, Episodes]

    @cached_property
    def results(self) -> dict[str, list[Result]]:
        """The figures of every driver."""
        return {name: score(own, self.block) for name, own in self.episodes.items()}

    @property
    def reference(self) -> str:
        """Driver that the differences are to."""
        return BASELINE if BASELINE in self.episodes else self.entrants[0].name

    @cached_property
    def differences(self) -> dict[str, list[Difference]]:
        """The differences of all other drivers to the reference."""
        base, others = self.episodes[self.reference], {**self.episodes}
        del others[self.reference]
        return {name: compare_paired(own, base, self.block) for name, own in others.items()}

    @property
    def ranking(self) -> list[str]:
        """The drivers of the environment as it is, the best first, see `coopenv.evaluation.ranking_key`."""
        here = [each.name for each in self.entrants if each.scenario is self.entrants[0].scenario]
        return sorted(here, key=lambda name: ranking_key({r.metric: r.mean for r in self.results[name]}))

    def __getitem__(self, driver: str) -> list[Result]:
        """Return the figures of one driver. Raises CoopenvError: it was not evaluated."""
        check_one_of("unknown driver", driver, self.results)
        return self.results[driver]

    @cached_property
    def rows(self) -> list[dict[str, Any]]:
        """One flat row per driver and metric."""
        return [
            {"agent": entrant.name, "kind": entrant.kind, "environment": self.environment, **asdict(result)}
            for entrant in self.entrants
            for result in self.results[entrant.name]
        ]

    def columns(self) -> Table:
        """Return `rows`, the figures in the column `unit`."""
        rows = [{**row, "unit": METRICS[row["metric"]].unit} for row in self.rows]
        return Table.of_data(
            {name: [row[name] for row in rows] for name in rows[0]}, ("agent", "metric"), ("mean", "ci_low", "ci_high")
        )

    def __repr__(self) -> str:
        return one_line(self, self.environment, {"agents": tuple(self.episodes), "worlds": self.worlds})

    def figure(
        self,
        kind: str = "time_against_error",
        *,
        width: str | float | None = None,
        path: str | Path | None = None,
        format: str | None = None,
    ) -> "Figure":
        """Draw a figure, and write it where a path is given; width, path, format and errors as of `Comparison.figure`.

        `kind` is "error_along_the_way", "time_against_error" or "looking".
        """
        from coopenv.viz import figures, style

        check_one_of("unknown figure", kind, KINDS)
        drawn: Figure = load_reference(KINDS[kind])(self, figures.inches_of(width))
        if isinstance(width, str):
            figures.restyle(drawn, width)
        if path is not None:
            about = {"environment": self.environment, "worlds": self.worlds, "block": self.block}
            style.save(drawn, Path(path), format or "", about={**about, "agents": ", ".join(self.episodes)})
        return drawn

    def _repr_html_(self) -> str:
        return terminal_html(self) + picture_html(self.figure())

    def __str__(self) -> str:
        return text_of(self, WIDTH)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield f"{self.environment}: {self.worlds} held-out worlds, block {self.block} of the seeds, the same for all."
        yield ""
        yield _results_table(self)
        if self.differences:
            yield ""
            yield _differences_table(self)
        yield ""
        yield "\n".join(f"{words}: {meaning}." for words, meaning in EXPLANATIONS.items())
        yield f"ranking: {', '.join(self.ranking)}."
        for name in self.ranking:
            e = self.episodes[name]
            pairs = [(e.vehicles[i], e.vehicles[j], e.seen_share[i, j]) for i, j in np.argwhere(e.seen_share >= 0.01)]
            if pairs:
                words = ", ".join(f"{own} measures {other} {share:.0%}" for own, other, share in pairs)
                yield f"{name}, share of the time under way: {words}."

    @cached_property
    def difference_rows(self) -> list[dict[str, Any]]:
        """One flat row per driver that was compared with the reference, and metric."""
        return [
            {"agent": name, "reference": self.reference, "environment": self.environment, **asdict(difference)}
            for name, differences in self.differences.items()
            for difference in differences
        ]


COLUMNS = {
    "arrival_rate": ("arrived\n[%]", 100.0),
    "collision_rate": ("collided\n[%]", 100.0),
    "travel_time_s": ("travel\n[s]", 1.0),
    "e50_m": ("e50\n[cm]", 100.0),
    "e95_m": ("e95\n[cm]", 100.0),
    "orientation_e95_deg": ("e95\n[deg]", 1.0),
    "few_targets_share": ("few\n[%]", 100.0),
    "return": ("return\n", 1.0),
}
"""Metric, its heading, and the factor to the heading's unit."""
EXPLANATIONS = {
    "intervals": "95 %, bootstrap over worlds",
    "e50, e95": "median and 95th percentile of the error from 3 s on",
    "lost": f"collided or never arrived: {LOST:g} m for the rest of the way; larger errors count as {LOST:g} m",
    "score": f"e95 [cm] of the fleet; rankings go by losses in steps of {100 * LOSSES:g} %, then by the score",
    "few": "share of the time from 3 s on with fewer than three targets in view",
    "return": "sum of the rewards of a vehicle",
}
"""Legend of the tables."""


def figures(results: Sequence[Result]) -> dict[str, dict[str, float]]:
    """Return results as cards hold them, by metric."""
    return {r.metric: {"mean": r.mean, "ci_low": r.ci_low, "ci_high": r.ci_high, "n": r.n} for r in results}


def changes(differences: Sequence[Difference], metrics: Iterable[str]) -> dict[str, dict[str, float]]:
    """Return differences as shares of the other agent's figures, as cards hold them, by metric."""
    return {
        d.metric: {"relative": d.relative, "ci_low": d.relative_ci_low, "ci_high": d.relative_ci_high}
        for d in differences
        if d.metric in metrics
    }


def shown(found: Mapping[str, Any], factor: float, figure: str = "mean") -> tuple[str, str, str]:
    """Return a figure of a card and the ends of its interval, with the decimals that the interval's width needs.

    Args:
        found: as a card holds it, where null stands for no number.
        factor: to the unit that is shown.
        figure: key of the figure.
    """
    values = [float("nan") if found[key] is None else factor * found[key] for key in (figure, "ci_low", "ci_high")]
    width = values[2] - values[1]
    decimals = 1
    if np.isfinite(width) and width > 0.0:
        decimals = int(np.clip(-np.floor(np.log10(width)), 0, 2))
    first, second, third = (f"{v:z.{decimals}f}" if np.isfinite(v) else NONE for v in values)
    return first, second, third


def cell(result: Mapping[str, Any], factor: float) -> str:
    """Return a figure of a card with its interval in brackets."""
    mean, low, high = shown(result, factor)
    return NONE if mean == NONE else f"{mean} [{low}, {high}]"


def percent(change: Mapping[str, Any]) -> str:
    """Return a relative difference of a card and its interval, in percent."""
    mean, low, high = shown(change, 100.0, "relative")
    return f"{signed(mean)} [{low}, {high}] %"


def signed(text: str) -> str:
    """Return a number with its sign."""
    return text if text.startswith("-") else f"+{text}"


COMPARED = ("travel_time_s", "e50_m", "e95_m", "orientation_e95_deg")
"""Metrics of which the differences are printed."""


def evaluated(contest: Contest, on_progress: Callable[[float, str], None] = lambda done, name: None) -> Evaluation:
    """Let every driver of a contest drive, and return the results; `on_progress` as for `Contest.drive`."""
    return Evaluation(**vars(contest), episodes=contest.drive(on_progress))


def _results_table(board: Evaluation) -> Table:
    """Return one row per driver: figures, with their intervals below."""
    table = Table.of_texts(("agent",), [heading for heading, _ in COLUMNS.values()], gap=0)
    for name, results in board.results.items():
        found = figures(results)
        table.add(name, *(_cell(*shown(found[metric], factor)) for metric, (_, factor) in COLUMNS.items()))
    return table


def _differences_table(board: Evaluation) -> Table:
    """Return one row per driver but the reference: relative differences, with their intervals below."""
    headings = [COLUMNS[metric][0].split("\n")[0] for metric in COMPARED]
    headings[-1] += " (deg)"
    table = Table.of_texts((f"against {board.reference}",), [f"{heading}\n[%]" for heading in headings], gap=0)
    for name, differences in board.differences.items():
        found = changes(differences, COMPARED)
        table.add(name, *(_cell(*map(signed, shown(found[metric], 100.0, "relative"))) for metric in COMPARED))
    return table


def _cell(mean: str, low: str, high: str) -> str:
    return mean if low == NONE else f"{mean}\n{low}..{high}"
