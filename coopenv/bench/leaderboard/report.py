"""The report: one HTML file that holds its figures and needs no network."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from html import escape
from pathlib import Path
from string import Template
from typing import Any

from matplotlib.figure import Figure

from coopenv.bench.leaderboard.basin import Basin, Draw
from coopenv.bench.leaderboard.basin_figure import basin_figure
from coopenv.bench.leaderboard.figures import error_figure, nees_figure
from coopenv.bench.leaderboard.judge import Sample
from coopenv.bench.leaderboard.rows import Row
from coopenv.bench.leaderboard.score_figures import cost_figure, variant_figure
from coopenv.bench.leaderboard.tables import failures
from coopenv.runs.output import writing
from coopenv.viz.style import DPI

_PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<title>$title</title>
<style>
body { font: 15px/1.45 system-ui, sans-serif; color: #222; max-width: 1150px; margin: 2em auto; padding: 0 1em; }
h1 { font-size: 1.5em; } h2 { font-size: 1.15em; margin-top: 2em; }
code, pre { font-family: ui-monospace, monospace; font-size: 0.9em; }
pre { background: #f4f4f4; padding: 0.6em; white-space: pre-wrap; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: 0.8em; }
th, td { padding: 0.15em 0.55em; text-align: right; white-space: nowrap; }
th { border-bottom: 1px solid #888; vertical-align: bottom; }
td.name, th.name { text-align: left; }
tr.first td { border-top: 1px solid #ddd; }
td.failure { white-space: normal; text-align: left; color: #a00; }
figure { margin: 0.5em 0; } img { max-width: 100%; }
figcaption { color: #555; font-size: 0.9em; }
dt { font-family: ui-monospace, monospace; font-size: 0.85em; } dd { margin: 0 0 0.3em 1.5em; font-size: 0.85em; }
</style>
</head>
<body>
<h1>$title</h1>
<pre>$command</pre>
<p>$facts</p>
$body
</body>
</html>
""")

_NAMES = ("environment", "variant", "observer", "vehicle")


@dataclass(frozen=True)
class Report:
    """What the report shows."""

    title: str
    content: Mapping[str, Any]
    """Of `leaderboard.json`."""
    rows: Sequence[Row]
    samples: Sequence[Sample]
    draws: Sequence[Draw] = ()
    basins: Sequence[Basin] = ()


def figures_of(report: Report) -> list[tuple[str, str, Figure]]:
    """Return (heading, caption, figure) of every figure that there is something for."""
    variants = list(dict.fromkeys(row.variant for row in report.rows))
    made: list[tuple[str, str, Figure | None]] = [
        (
            "Variants",
            "Mean over the vehicles of the position RMSE in the steady state, m; after × relative to the nominal one.",
            variant_figure(report.rows),
        )
    ]
    first = [row for row in report.rows if row.variant == variants[0]]
    made.append(
        (
            f"Cost against accuracy ({variants[0]})",
            "The area of a mark grows with the bytes that a vehicle sends. Times depend on the machine.",
            cost_figure(first),
        )
    )
    for variant in variants:
        own = [sample for sample in report.samples if sample.variant == variant]
        made.append(
            (
                f"Error against time ({variant})",
                "Observers that failed are not shown, nor more than six vehicles.",
                error_figure(own),
            )
        )
        made.append(
            (
                f"Consistency ({variant})",
                "Above the band an observer believes itself better than it is, below it worse. Those that state no "
                "covariance are not shown.",
                nees_figure(own),
            )
        )
    if report.draws:
        made.append(
            (
                "Basin of attraction",
                "Attitude uniform over SO(3), position uniform in a ball of 15 m; 95 % intervals after Wilson.",
                basin_figure(report.draws),
            )
        )
    return [(heading, caption, figure) for heading, caption, figure in made if figure is not None]


def write_report(report: Report, path: Path) -> None:
    """Write the report as one HTML file.

    Raises:
        OutputError: it cannot be written.
    """
    content = report.content
    seeds = content["seeds"]
    facts = [
        f"Seeds {seeds[0]} to {seeds[-1]}." if len(seeds) > 1 else f"Seed {seeds[0]}.",
        "Versions: " + ", ".join(f"{name} {number}" for name, number in content["versions"].items()) + ".",
    ]
    parts = [_section("Leaderboard", _table(report.rows) + _failures(report.rows))]
    if report.basins:
        parts.append(_section("Basins", _basin_table(report.basins)))
    for heading, caption, figure in figures_of(report):
        parts.append(_section(heading, _figure(heading, caption, figure)))
    parts.append(_section("Columns", _definitions()))
    text = _PAGE.substitute(
        title=escape(report.title),
        command=escape(content["command"]),
        facts=escape(" ".join(facts)),
        body="\n".join(parts),
    )
    with writing(path):
        path.write_text(text, encoding="utf-8")


def _section(heading: str, body: str) -> str:
    return f"<h2>{escape(heading)}</h2>\n{body}"


def _table(rows: Sequence[Row]) -> str:
    columns = [f.name for f in fields(Row) if f.name not in ("environment", "failure")]
    head = "".join(f"<th{_class(name)}>{escape(name).replace('_', '_<wbr>')}</th>" for name in columns)
    body, before = [], None
    for row in rows:
        first = ' class="first"' if before != (row.variant, row.observer) else ""
        before = (row.variant, row.observer)
        cells = "".join(f"<td{_class(name)}>{_cell(getattr(row, name))}</td>" for name in columns)
        body.append(f"<tr{first}>{cells}</tr>")
    return f'<div class="scroll"><table><tr>{head}</tr>\n' + "\n".join(body) + "</table></div>"


def _class(name: str) -> str:
    return ' class="name"' if name in _NAMES else ""


def _cell(value: str | float) -> str:
    if isinstance(value, str):
        return escape(value)
    if not math.isfinite(value):
        return "–"
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def _failures(rows: Sequence[Row]) -> str:
    lines = failures(rows)
    return "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>" if lines else ""


def _basin_table(basins: Sequence[Basin]) -> str:
    head = "<tr><th class='name'>observer</th><th>draws</th><th>all vehicles converge</th><th>95 %</th>"
    head += "<th>by vehicle</th><th>last one settles [s]</th></tr>"
    lines = [
        f"<tr><td class='name'>{escape(b.observer)}</td><td>{b.draws}</td><td>{100 * b.converged_fraction:.1f} %</td>"
        f"<td>{100 * b.interval.low:.1f}–{100 * b.interval.high:.1f} %</td>"
        f"<td>{' '.join(f'{100 * share:.0f}' for share in b.by_vehicle)} %</td><td>{_cell(b.settle_time_s)}</td></tr>"
        for b in basins
    ]
    return f"<table>{head}{''.join(lines)}</table>"


def _figure(heading: str, caption: str, figure: Figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    data = base64.b64encode(buffer.getvalue()).decode("ascii")
    image = f'<img alt="{escape(heading)}" src="data:image/png;base64,{data}">'
    return f"<figure>{image}<figcaption>{escape(caption)}</figcaption></figure>"


def _definitions() -> str:
    lines = [f"<dt>{f.name}</dt><dd>{escape(f.metadata['meaning'])}</dd>" for f in fields(Row)]
    return "<dl>" + "".join(lines) + "</dl>"
