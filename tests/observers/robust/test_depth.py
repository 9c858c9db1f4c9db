"""How sure `robust` is far down a graph of vehicles that measure each other: as sure as it may be, everywhere.

`pytest -s -m slow tests/observers/robust/test_depth.py` prints the table of docs/robust_evidence.md.
"""

from __future__ import annotations

import numpy as np
import pytest

from coopenv.scenario import load_scenario
from tests.helpers.robust_worlds import watched

EDGES = (2, 5, 10, 20, 35, 60)  # s
DEEP = {
    "`lane:8`": ("lane:8", {}),
    "`lane:8`, messages 50 ms late": ("lane:8", {"v2x.delay": 3}),
    "`lane:8`, 30 % of messages lost": ("lane:8", {"v2x.loss": 0.3}),
    "`lane:20`": ("lane:20", {}),
    "`tree:20`": ("tree:20", {}),
    "`random:16,seed=7`": ("random:16,seed=7", {}),
    "`random:50,seed=9`": ("random:50,seed=9", {}),
    "`roots:10`": ("roots:10", {}),
    "`roots:14`": ("roots:14", {}),
    "`roots:14`, scale off by 10 %, little noise": ("roots:14", {"noise.velocity": 0.02, "noise.odometry_scale": 0.1}),
    "`lane:14,seen=5`, scale off by 5 %": ("lane:14,seen=5", {"noise.odometry_scale": 0.05}),
    "`ring:5`": ("ring:5", {}),
}


def by_window(
    name: str, overrides: dict[str, float], seeds: range, edges: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Return (windows, W, N) the mean NEES/6 and (windows, N) the RMS position error, m, between seconds."""
    made = load_scenario(name, {"observer.name": "robust", "horizon": float(edges[-1]) + 1.0, **overrides})
    half = round(made.rates.camera) // 2
    nees, errors, _ = watched(made, seeds, 2 * edges[-1], half, skipped=2 * edges[0])
    windows = 2 * (np.array(edges[1:-1]) - edges[0])
    means = [part.mean(axis=0) for part in np.split(nees, windows)]
    return np.array(means), np.array([np.sqrt((part**2).mean(axis=(0, 1))) for part in np.split(errors, windows)])


@pytest.mark.parametrize(
    ("name", "overrides", "most"),
    [
        ("lane:8", {}, 2.0),
        ("random:12,seed=4", {}, 2.0),
        ("tree:9", {}, 2.0),
        ("ring:5", {}, 1.6),
        ("lane:10", {"noise.velocity": 0.02, "noise.odometry_scale": 0.1}, 1.6),
        ("roots:12", {"noise.velocity": 0.01, "noise.odometry_scale": 0.1}, 1.6),
        ("lane:12,seen=5", {"noise.odometry_scale": 0.05}, 1.6),
        ("lane:8", {"v2x.delay": 12, "noise.velocity": 0.15, "noise.bearing.scale": 0.0005}, 1.6),
    ],
    ids=str,
)
def test_everybody_is_as_sure_as_it_may_be(name: str, overrides: dict[str, float], most: float) -> None:
    """Starts of up to 10 degrees and 1 m; the mean over worlds of each vehicle.

    Also in circles, with wheels that are off by a tenth, with many to hear, and with late messages: up to 12 was seen
    where errors of odometry that last were taken for what senders had learnt.
    """
    anees = by_window(name, overrides, range(12), (2, 5, 10, 15))[0].mean(axis=1)
    assert (anees > 0.3).all() and (anees < most).all(), anees


def test_a_vehicle_at_the_end_of_a_lane_finds_its_place() -> None:
    """The eighth and the twelfth: 0.09 and 0.2 m were seen, 0.15 and 0.9 m with linearisations said to err less."""
    _, errors = by_window("lane:20", {}, range(6), (10, 15))
    assert errors[0, 7] < 0.2 and errors[0, 11] < 0.4


@pytest.mark.slow
@pytest.mark.parametrize("title", DEEP)
def test_how_sure_it_is_in_other_worlds(title: str) -> None:
    name, overrides = DEEP[title]
    anees, errors = by_window(name, overrides, range(700, 716), EDGES)
    mean = anees.mean(axis=1)
    worst = mean.argmax(axis=1)
    spread = anees.std(axis=1, ddof=1) / np.sqrt(anees.shape[1])
    parts = [
        f"{mean[k].min():.2f} .. {mean[k, n]:.2f}({spread[k, n]:.2f}) {100 * np.median(errors[k]):.1f} "
        f"{100 * errors[k].max():.1f}"
        for k, n in enumerate(worst)
    ]
    print(f"\n{title}: ANEES/6 least .. worst, error median and largest, cm: " + " | ".join(parts))
    assert (mean > 0.3).all() and (mean < 3.0).all()
