"""The part of a learned agent's card that tells of all its seeds, and of the drivers beside them."""

from typing import Any

from coopenv.bench.agents.table import COLUMNS, cell, shown

WITHIN = 0.15
"""Seeds whose e95 is at most so much above the best one's count as alike."""


def seeds_section(study: dict[str, Any]) -> list[str]:
    """Return lines of Markdown: figures of every seed and of scripted drivers, differences, spread."""
    headings = [heading.strip().replace("\n", " ") for heading, _ in COLUMNS.values()]
    lines = [f"| on the same worlds | {' | '.join(headings)} | trained |", "|---" * (len(headings) + 2) + "|"]
    for seed, entry in study["seeds"].items():
        best = " (best)" if int(seed) == study["best"] else ""
        minutes = f"{entry['runs']['steps'] / 1e6:.1f} M steps, {entry['runs']['cpu_minutes']:.1f} min"
        lines.append(_row(f"seed {seed}{best}", entry["results"], minutes))
    lines += [_row(name, figures, "") for name, figures in study["beside"].items()]
    lines += [
        "",
        "Minutes are of one core. The best has the highest return by its own reward, in worlds that are not these.",
        "",
    ]
    for name, changes in study["against"].items():
        told = ", ".join(f"{word} {percent(changes[metric])}" for metric, word in CHANGES.items())
        lines.append(f"- Best against `{name}`: {told}.")
    command = study["seeds"][str(study["best"])]["runs"]["command"]
    lines += [f"- {_spread(study)}", "", "Trained with, in this folder,", "", f"    {command}"]
    return lines


CHANGES = {"e95_m": "e95", "e50_m": "e50", "travel_time_s": "travel time"}


def _row(name: str, figures: dict[str, Any], trained: str) -> str:
    cells = [cell(figures[metric], factor) for metric, (_, factor) in COLUMNS.items()]
    return f"| {name} | {' | '.join(cells)} | {trained} |"


def percent(change: dict[str, float]) -> str:
    """Return a relative difference and its interval, in percent."""
    mean, low, high = shown(*(100.0 * change[key] for key in ("relative", "ci_low", "ci_high")))
    return f"{mean if mean.startswith('-') else '+' + mean} [{low}, {high}] %"


def _spread(study: dict[str, Any]) -> str:
    errors = sorted(entry["results"]["e95_m"]["mean"] for entry in study["seeds"].values())
    alike = sum(error <= (1.0 + WITHIN) * errors[0] for error in errors)
    span = f"e95 over seeds: {100 * errors[0]:.1f} to {100 * errors[-1]:.1f} cm"
    return f"{span}; {alike} of {len(errors)} within {100 * WITHIN:.0f} % of the least."
