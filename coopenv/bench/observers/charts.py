"""What the interactive charts of the report show, packed into the page.

plotly.js (MIT) stands beside the page's template as its authors publish it, from `npm pack plotly.js-basic-dist-min`:
the bundle that the Python package brings is four times as large.
"""

import json
from base64 import b64encode
from gzip import compress
from importlib.resources import files
from typing import Any

import numpy as np

from coopenv.base.format import jsonable
from coopenv.bench.observers.leaderboard import Leaderboard
from coopenv.bench.observers.rows import mean_of
from coopenv.bench.observers.samples import Sample
from coopenv.estimation.arrays import Array
from coopenv.estimation.consistency import mean_bounds
from coopenv.viz.style import VEHICLE_COLOURS

PLOTLY = "plotly-basic-4.1.1.min.js.gz"
MOST_POINTS, FEWEST_POINTS = 400, 40  # of a curve
MOST_NUMBERS = 300_000  # of all curves together: about half a megabyte once packed
SHOWN = 4  # of the best observers, at first; the legend shows others
_DIGITS = 3
_LEAST_MARK, _GROWTH = 9.0, 0.08  # px, and px per root of bytes/s


def page_file(name: str) -> bytes:
    """Return a file of the page."""
    return (files("coopenv.bench.observers") / "page" / name).read_bytes()


def packed(data: bytes) -> str:
    """Return data as text that `charts.js` unpacks."""
    return b64encode(data).decode()


def plotly() -> str:
    """Return plotly.js, packed."""
    return packed(page_file(PLOTLY))


def chart_data(board: Leaderboard) -> str:
    """Return the data of all charts, packed."""
    text = json.dumps(jsonable(_document(board)), separators=(",", ":"))
    return packed(compress(text.encode(), 9, mtime=0))


def _document(board: Leaderboard) -> dict[str, Any]:
    first = next(iter(board.variants))
    scene, sample = board.samples[0].scene, board.samples[0]
    curves = len(board.variants) * len(board.observers) * len(scene.vehicles) * 3
    points = int(np.clip(MOST_NUMBERS / curves, FEWEST_POINTS, MOST_POINTS))
    return {
        "vehicles": list(scene.vehicles),
        "observers": board.ranked,
        "colours": VEHICLE_COLOURS,
        "shown": SHOWN,
        "dof": sample.nees_dof,
        "band": [float(end) for end in mean_bounds(sample.nees_dof, len(board.seeds))],
        "variants": [_variant(board, name, points) for name in board.variants],
        "cost": _cost(board, first),
    }


def _variant(board: Leaderboard, name: str, points: int) -> dict[str, Any]:
    groups = board.samples_in(name)
    samples = [sample for sample in board.samples if sample.variant == name]
    t = samples[0].scene.t
    keep = np.unique(np.linspace(0, len(t) - 1, min(len(t), points)).round().astype(int))
    own = groups[next(iter(groups))] if groups else samples[:1]
    bound = np.sqrt(np.mean([sample.scene.bound**2 for sample in own], axis=0))
    return {
        "name": name,
        "t": _short(t[keep]),
        "bound": [_short(column) for column in bound[keep].T],
        "curves": {observer: _curves(chosen, keep) for observer, chosen in groups.items()},
    }


def _curves(samples: list[Sample], keep: Array) -> dict[str, list[list[float]]]:
    """Return medians over the seeds of errors and claims, m, and mean NEES over its dimension, a list per vehicle."""
    error = np.median([sample.series.position_error[keep] for sample in samples], axis=0)
    std = 3.0 * np.median([sample.series.position_std[keep] for sample in samples], axis=0)
    nees = np.mean([sample.series.nees[keep] for sample in samples], axis=0) / samples[0].nees_dof
    columns = {"error": error, "std": std, "nees": nees}
    return {name: [_short(column) for column in values.T] for name, values in columns.items()}


def _cost(board: Leaderboard, variant: str) -> list[dict[str, Any]]:
    found = []
    for name in board.samples_in(variant):
        rows, total = board.rows_in(variant, name), board.totals[variant, name].rmse
        sent = mean_of(rows, "bytes_per_s")
        point = {"observer": name, "rmse": total.value, "se": total.error, "us": mean_of(rows, "us_per_update")}
        found.append({**point, "bytes": round(sent), "size": _LEAST_MARK + _GROWTH * float(np.sqrt(sent))})
    return found


def _short(values: Array) -> list[float]:
    """Return numbers with few digits; what a logarithmic axis cannot show is NaN."""
    return [
        float(f"{value:.{_DIGITS}g}") if value == 0 or 1e-9 < abs(value) < 1e9 else float("nan") for value in values
    ]
