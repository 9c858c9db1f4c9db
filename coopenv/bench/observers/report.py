"""The report: one HTML file that holds its figures and needs no network."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from coopenv.bench.observers import html_tables as tables
from coopenv.bench.observers.basin import RADIUS, Basin, Draw, basin_failures
from coopenv.bench.observers.basin_figure import basin_figure
from coopenv.bench.observers.faults import NOMINAL
from coopenv.bench.observers.figures import error_figure, nees_figure
from coopenv.bench.observers.judge import Sample
from coopenv.bench.observers.rows import Row
from coopenv.bench.observers.score_figures import cost_figure, variant_figure
from coopenv.bench.observers.tables import failures, honest_line
from coopenv.files import replacing_file
from coopenv.viz.style import DPI

_PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<title>$title</title>
<style>
body { font: 15px/1.45 system-ui, sans-serif; color: #222; max-width: 1240px; margin: 2em auto; padding: 0 1em; }
h1 { font-size: 1.5em; } h2 { font-size: 1.15em; margin-top: 2em; }
code, pre { font-family: ui-monospace, monospace; font-size: 0.9em; }
pre { background: #f4f4f4; padding: 0.6em; white-space: pre-wrap; }
nav { columns: 3; font-size: 0.9em; } nav a { display: block; } a { color: #0072b2; text-decoration: none; }
.scroll { overflow-x: auto; } .full { max-height: 40em; overflow: auto; }
table { border-collapse: collapse; font-size: 0.8em; }
th, td { padding: 0.15em 0.45em; text-align: right; white-space: nowrap; }
th { border-bottom: 1px solid #888; vertical-align: bottom; white-space: normal; }
td.name, th.name { text-align: left; }
tr.first td { border-top: 1px solid #ddd; } tr.bound td { color: #777; font-style: italic; }
.factor { color: #777; } .failure { color: #a00; }
p.note, figcaption { color: #555; font-size: 0.9em; }
figure { margin: 0.5em 0; } img { max-width: 100%; } summary { cursor: pointer; color: #0072b2; }
dt { font-family: ui-monospace, monospace; font-size: 0.85em; } dd { margin: 0 0 0.3em 1.5em; font-size: 0.85em; }
</style>
</head>
<body>
<h1>$title</h1>
<pre>$command</pre>
<p>$facts</p>
<nav>$contents</nav>
$body
</body>
</html>
""")

BOUNDS_NOTE = (
    "Posterior Cramér-Rao bounds: joint over all vehicles, joint over a vehicle and its ancestors (all whose messages "
    "can reach it), and alone with neighbours' poses known. The paper's bearing noise is smaller off the optical axis "
    "than they assume, so errors may lie below them there. "
)


@dataclass(frozen=True)
class Report:
    """What the report shows."""

    title: str
    content: Mapping[str, Any]
    """Of `leaderboard.json`."""
    rows: Sequence[Row]
    samples: Sequence[Sample]
    summaries: Mapping[str, str]
    """What every variant is."""
    draws: Sequence[Draw] = ()
    basins: Sequence[Basin] = ()

    @property
    def variants(self) -> list[str]:
        """In the order in which they were run."""
        return list(dict.fromkeys(row.variant for row in self.rows))


class Section(NamedTuple):
    """A heading with what stands below it, as HTML."""

    heading: str
    body: str


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
    sections = [*_results(report), *_curves(report), _all_rows(report), Section("Columns", tables.definitions())]
    text = _PAGE.substitute(
        title=escape(report.title),
        command=escape(content["command"]),
        facts=escape(" ".join(facts)),
        contents="".join(f'<a href="#s{n}">{escape(s.heading)}</a>' for n, s in enumerate(sections)),
        body="\n".join(f'<h2 id="s{n}">{escape(s.heading)}</h2>\n{s.body}' for n, s in enumerate(sections)),
    )
    with replacing_file(path) as new:
        new.write_text(text, encoding="utf-8")


def _results(report: Report) -> list[Section]:
    """Return the leaderboard, the variants, cost against accuracy, and the basins."""
    first = report.variants[0]
    sections = []
    for variant in report.variants if first != NOMINAL else [first]:
        own = [row for row in report.rows if row.variant == variant]
        bounds = BOUNDS_NOTE if math.isfinite(own[0].bound_m) else ""
        notes = _note(f"Position RMSE per vehicle in the steady state. {bounds}{honest_line(own)}")
        sections.append(Section(f"Leaderboard ({variant})", tables.overview(own) + notes))
    sections[0] = Section(sections[0].heading, sections[0].body + tables.failure_list(failures(report.rows)))
    if (heat := variant_figure(report.rows)) is not None:
        sections.append(Section("Variants", _variants(report, heat)))
    if (cost := cost_figure([row for row in report.rows if row.variant == first])) is not None:
        caption = "The area of a mark grows with the bytes that a vehicle sends. Times depend on the machine."
        sections.append(Section(f"Cost against accuracy ({first})", _figure("cost", caption, cost)))
    if report.basins:
        caption = (
            f"Attitude uniform over SO(3), position uniform in a ball of {RADIUS:g} m. A draw converges if every "
            "vehicle ends below 0.1 m and 1 deg; 95 % intervals after Wilson."
        )
        failed = tables.failure_list(basin_failures(report.basins))
        body = tables.basin_table(report.basins) + failed + _figure("basin", caption, basin_figure(report.draws))
        sections.append(Section("Basin of attraction", body))
    return sections


def _variants(report: Report, heat: Figure) -> str:
    told = [f"<li><code>{escape(name)}</code>: {escape(report.summaries[name])}</li>" for name in report.variants]
    caption = "Mean over the vehicles of the position RMSE in the steady state, m"
    caption += "; after × relative to the nominal variant." if NOMINAL in report.variants else "."
    return f"<ul>{''.join(told)}</ul>" + tables.variants_table(report.rows) + _figure("variants", caption, heat)


def _curves(report: Report) -> list[Section]:
    """Return errors and consistency over time, of every variant."""
    sections = []
    for variant in report.variants:
        own = [sample for sample in report.samples if sample.variant == variant]
        if (errors := error_figure(own)) is not None:
            caption = "Observers that failed are not shown, nor more than six vehicles."
            sections.append(Section(f"Error against time ({variant})", _figure("errors", caption, errors)))
        if (nees := nees_figure(own)) is not None:
            caption = (
                "Above the band an observer believes itself better than it is, below it worse. What is beyond the axis "
                "is drawn at its end. Those that state no covariance are not shown."
            )
            sections.append(Section(f"Consistency ({variant})", _figure("NEES", caption, nees)))
    return sections


def _all_rows(report: Report) -> Section:
    table = tables.full_table(report.rows)
    body = f'<details><summary>{len(report.rows)} rows, every column</summary><div class="full">{table}</div></details>'
    return Section("All rows", body)


def _note(text: str) -> str:
    return f'<p class="note">{escape(text)}</p>'


def _figure(name: str, caption: str, figure: Figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    data = base64.b64encode(buffer.getvalue()).decode("ascii")
    image = f'<img alt="{escape(name)}" src="data:image/png;base64,{data}">'
    return f"<figure>{image}<figcaption>{escape(caption)}</figcaption></figure>"
