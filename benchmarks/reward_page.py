"""The page of the comparison of rewards: tables, figure, and the sentences that intervals decide."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from coopenv.base.errors import listed
from coopenv.report.table import markdown
from coopenv.viz import style

Cell = tuple[float, float, float]
"""A figure or difference and the ends of its 95 % interval."""
Document = Mapping[str, Any]
"""The contents of `rewards.json`."""

FIGURES = {
    "mean_m": ("mean error [cm]", 100.0, 1),
    "e95_m": ("e95 [cm]", 100.0, 0),
    "arrival_rate": ("arrived [%]", 100.0, 0),
    "collision_rate": ("collided [%]", 100.0, 0),
    "return": ("return without the term", 1.0, 1),
}
"""Columns of the tables: heading, factor and decimals of each figure."""
LOOKS = ((style.BLUE, "o"), (style.VERMILION, "s"), (style.GREEN, "^"), (style.PURPLE, "D"))

PAGE = """# Rewards for localisation

Does a [reward for localisation](../terms.md#rewards-for-localisation) pay, and which? {seeds} seeds of PPO per arm, in
{count} environments with several cars. The arms differ in one term of the reward alone:

{arms}

Every arm continues the same agent, `start`: a clone of `route_follower`. It drives {steps:,} decisions of vehicles in
the same worlds, with the same network and a discount by the horizon, and its last policy is judged. The rest of the
reward (progress, arrival, time, losses) is that of the environment. A collision or a lost route costs arrivals in
`plain`, too.

One rule sets all weights: in an environment, every term has the same spread of the discounted return, near that of the
rest of the reward; the brackets have the ratio of both. The spread is the standard deviation between draws of
exploration of `start` in the same world, in tuning worlds.
`truth` has the same form as `covariance`, with the true error in the place of the standard deviation: their difference
is due to the covariance as a measure of the error.

## Answer

A term pays where the interval of the mean error, minus that of `{base}`, is below 0.

{verdict}

![Differences from `plain` in the mean error and in the return without the term, with intervals](rewards.png)

## Figures

Means over seeds in {worlds} held-out worlds of block {block}, with 95 % intervals (bootstrap over worlds and seeds).
The mean error and e95 are those of the position from 3 s on; a lost vehicle counts as 1 m, which is the largest error.
The return is the sum of the reward of a vehicle without the term. `peek` is a scripted driver that steers towards
landmarks.

{values}

The same figures minus those of `{base}` in the same worlds. The last column is the mean error minus that of `{second}`:

{differences}

## Limits

- The bootstrap of {seeds} seeds makes their part of an interval {narrow:.0f} % too narrow. {tests} differences of the
  mean error are tested, so an interval that hardly excludes 0 is weak evidence.
- One size of the weights, one start, one discount and {steps:,} decisions: learning has not converged (compare `peek`),
  and a term that teaches faster looks better than a term that teaches more. With a smaller weight, a term that costs
  arrivals may pay.
- `information` rewards standing near good landmarks until the horizon.
- For speed, cameras have 10 Hz, odometry 20 Hz and decisions 5 Hz in all arms.

```
for ENV in {places}; do
  coopenv train $ENV --settings agents/reward_start.toml --seed 1 --out out/reward/start/$ENV
done
python -m benchmarks.reward --weights                    # weights with the ratio 1
python -m benchmarks.reward --page docs/environments     # trains what is missing, and writes this page
```
"""


def page(document: Document) -> str:
    """Return the page in Markdown."""
    places, terms = list(document["weights"]), document["terms"]
    rows = [
        [f"`{arm}`", f"`{term}`" if term else "none", *(_weight(document, place, arm) for place in places)]
        for arm, term in terms.items()
    ]
    values, differences = tables(document).split("\n\n")
    base, second, *_ = terms
    return PAGE.format(
        **{name: document[name] for name in ("seeds", "steps", "worlds", "block")},
        count=len(places),
        places=" ".join(places),
        arms=markdown(["arm", "term", *(f"`{place}`" for place in places)], rows),
        verdict="\n".join(f"- {sentence}" for sentence in verdict(document)),
        values=values,
        differences=differences,
        base=base,
        second=second,
        narrow=100.0 * (1.0 - (1.0 - 1.0 / document["seeds"]) ** 0.5),
        tests=len(terms) * len(places) - len(places),
    )


def _weight(document: Document, place: str, arm: str) -> str:
    """Return the weight of an arm's term, and its spread by that of the rest of the reward."""
    ratio = document["spreads"][place].get(arm)
    return f"{document['weights'][place][arm]:g} ({ratio:.2f})" if ratio else ""


def tables(document: Document) -> str:
    """Return the table of figures and the table of differences, in Markdown, with an empty line between them."""
    base, second, *_ = document["terms"]
    values, differences = [], []
    for place, rows in document["figures"].items():
        for row, own in rows.items():
            names = [f"`{place}`" if place in document["weights"] else place, f"`{row}`"]
            values.append([*names, *(text(name, own[name]["value"]) for name in FIGURES)])
            if row in document["terms"] and row != base:
                more = text("mean_m", own["mean_m"][second]) if row != second else ""
                differences.append([*names, *(text(name, own[name][base]) for name in FIGURES), more])
    heads = ["environment", "arm", *(heading for heading, *_ in FIGURES.values())]
    return "\n\n".join([markdown(heads, values), markdown([*heads, f"minus `{second}` [cm]"], differences)])


def text(name: str, cell: Cell) -> str:
    """Return a figure or difference with its interval."""
    _, factor, digits = FIGURES[name]
    value, low, high = (f"{round(factor * each, digits) + 0.0:.{digits}f}" for each in cell)
    return f"{value} [{low}, {high}]"


def verdict(document: Document) -> Iterator[str]:
    """Yield the sentences on which terms pay, in the mean of all environments and in each of them."""
    base, second, *_ = document["terms"]
    *places, last = document["figures"]
    error, rest = "mean_m", "return"
    yield f"The {last}: against `{base}`, the mean error {_changes(document, last, error, base)}."
    yield f"Against `{second}`, the mean error {_changes(document, last, error, second)}."
    yield f"Against `{base}`, the return without the term {_changes(document, last, rest, base)}."
    for place in places:
        yield f"`{place}`: against `{base}`, the mean error {_changes(document, place, error, base)}."


def _changes(document: Document, place: str, name: str, base: str) -> str:
    """Return with which arms a figure falls, rises, or does neither clearly, by the intervals of the differences."""
    _, *arms = document["terms"]
    groups: dict[str, list[str]] = {"falls": [], "rises": [], "has no clear change": []}
    for arm in arms:
        if arm != base:
            _, low, high = cell = document["figures"][place][arm][name][base]
            change = "falls" if high < 0.0 else "rises" if low > 0.0 else "has no clear change"
            groups[change].append(f"`{arm}` ({text(name, cell)}{' cm' if name == 'mean_m' else ''})")
    return ", and ".join(f"{change} with {listed(arms)}" for change, arms in groups.items() if arms)


def draw(document: Document, path: Path) -> Path:
    """Draw the differences from the first arm in mean error and return, with intervals, by environment and arm."""
    base, *arms = document["terms"]
    figure, places = style.new_figure(8.4, 3.9), document["figures"]
    for ax, name in zip(figure.subplots(1, 2, sharey=True), ("mean_m", "return"), strict=True):
        factor = FIGURES[name][1]
        for i, (arm, (colour, marker)) in enumerate(zip(arms, LOOKS, strict=False)):
            value, low, high = factor * np.array([rows[arm][name][base] for rows in places.values()]).T
            y = np.arange(len(places)) + 0.18 * (i - 1.5)
            look = {"color": colour, "marker": marker, "label": arm, "markersize": 4.5, "linestyle": ""}
            ax.errorbar(value, y, xerr=[value - low, high - value], elinewidth=style.LINE, **look)
        ax.axvline(0.0, color=style.INK, linewidth=0.8)
        ax.set_yticks(range(len(places)), [*places])
    left, right = figure.axes
    left.invert_yaxis()
    style.tidy(left, x_label=f"mean error minus that of {base} [cm]")
    style.tidy(right, x_label=f"return without the term minus that of {base} [1]")
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=len(arms), fontsize=style.SMALL, frameon=False)
    figure.tight_layout(rect=(0, 0.06, 1, 1))
    return style.save(figure, path)
