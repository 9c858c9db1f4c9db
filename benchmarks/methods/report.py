"""The page of the study: a table for every environment, and the sentence on which method is best."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product

import numpy as np

from benchmarks.methods.study import Results, StudyFile, improvement, rank, with_interval
from coopenv.evaluation.metrics import LOSSES
from coopenv.report.table import markdown

SHOWN = {
    "arrived [%]": ("arrival_rate", 100.0),
    "collided [%]": ("collision_rate", 100.0),
    "e95 [cm]": ("e95_m", 100.0),
}
"""Columns of the table: figure, and its factor."""


PAGE = """# Methods of learning

{count} methods learn the policy that all vehicles share from {decisions:,} decisions of vehicles, driven or recorded,
by the reward of the environment. With each of {seeds} seeds they drive {worlds} held-out worlds.

{methods}

Recordings are Minari datasets of {drivers}, with noise of {noise:g} on the actions. `ppo` and `recurrent` also
differ from `{base}` in their settings, and in that observations are normalised.

A cell is the interquartile mean over seeds with its 95 % interval (bootstrap over seeds). e95 is the 95th percentile of
the position error of all vehicles under way, from 3 s on: score 1, without lost vehicles. *Better* is the probability
that a run is better than one of `{base}`: first by its losses (vehicles that do not arrive, plus those that collide)
in steps of {losses:.0f} %, then by its e95.

{tables}

```
make study                                # {minutes:.0f} minutes of CPU time to learn; continues after an interruption
python -m benchmarks.methods --table      # the tables of the finished runs
```

The runs: [`results.csv`](../../benchmarks/methods/results.csv). Settings:
[`study.toml`](../../benchmarks/methods/study.toml). Made by `python -m benchmarks.methods --page`.
"""


def page(study: StudyFile, results: Results) -> str:
    """Return the whole page, in Markdown."""
    return PAGE.format(
        count=len(study.methods),
        decisions=study.decisions,
        seeds=len(study.seeds),
        worlds=study.worlds,
        methods=markdown(["method", ""], [[f"`{name}`", method.about] for name, method in study.methods.items()]),
        drivers=" and ".join(f"`{driver}` in `{place}`" for place, driver in study.environments.items()),
        noise=study.noise,
        base=next(iter(study.methods)),
        losses=100.0 * LOSSES,
        tables=tables(study, results),
        minutes=sum(figures["cpu_seconds"] for figures in results.values()) / 60.0,
    )


def tables(study: StudyFile, results: Results) -> str:
    """Return the table of every environment and the sentence on which method is best, in Markdown."""
    methods, parts = list(study.methods), []
    found = {(run.environment, run.method, run.seed): figures for run, figures in results.items()}
    wanted = list(product(study.environments, (*study.references, *methods), study.seeds))
    if missing := [key for key in wanted if key not in found]:
        return f"{len(wanted) - len(missing)} of {len(wanted)} runs are finished."
    ranks = {
        name: [np.array([rank(found[place, name, seed]) for seed in study.seeds]) for place in study.environments]
        for name in methods
    }
    for i, place in enumerate(study.environments):
        rows = []
        for name in (*study.references, *methods):
            own = [found[place, name, seed] for seed in study.seeds]
            cells = [
                _cell(factor * np.array([figures[figure] for figures in own]), "{:.0f}")
                for figure, factor in SHOWN.values()
            ]
            compared = name in methods[1:]
            chance = improvement([ranks[name][i]], [ranks[methods[0]][i]]) if compared else None
            spent = np.mean([figures["cpu_seconds"] for figures in own]) / 60.0
            shown = ["" if chance is None else chance_text(chance), f"{spent:.1f}" if name in methods else ""]
            rows.append([f"`{name}`", *cells, *shown])
        heads = [f"`{place}`", *SHOWN, "better", "CPU [min]"]
        parts.append(markdown(heads, rows))
    return "\n\n".join([*parts, verdict(ranks)])


def verdict(ranks: Mapping[str, list[np.ndarray]]) -> str:
    """Return the sentence on which method is better than all others, over all environments."""
    chances = {
        name: {other: improvement(ranks[name], ranks[other]) for other in ranks if other != name} for name in ranks
    }
    best = max(chances, key=lambda name: np.mean([value for value, *_ in chances[name].values()]))
    own = chances[best]
    shown = {other: f"`{other}` ({chance_text(chance)})" for other, chance in own.items()}
    if close := [other for other, (_, low, _) in own.items() if low <= 0.5]:
        beside = ", ".join(shown[other] for other in close)
        return f"No method is apart from all others: `{best}` leads, not apart from {beside}."
    nearest = min(own, key=lambda other: own[other])
    words = "its probability to be better is above one half over every other method, and least over"
    return f"`{best}` wins: {words} {shown[nearest]}."


def chance_text(chance: tuple[float, float, float]) -> str:
    """Return a probability with its interval."""
    return "{:.2f} [{:.2f}, {:.2f}]".format(*chance)


def _cell(values: np.ndarray, form: str) -> str:
    mean, low, high = (form.format(value) for value in with_interval(values))
    return f"{mean} [{low}, {high}]"
