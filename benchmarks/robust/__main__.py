"""`python -m benchmarks.robust STUDY`: a table of `docs/robust_evidence.md`, minutes to an hour each."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.options import status_of
from benchmarks.robust.scenes import DEEP, LIES, ROBUST, all_lost, draw
from benchmarks.robust.studies import by_vehicle, by_window, consistency, costs, judged, search
from benchmarks.robust.worlds import nees_of, steps_of, watched
from coopenv.estimation.poses import Array
from coopenv.scenario import load_scenario

EDGES = (2, 5, 10, 20, 35, 60)
"""s, of the windows of the depth."""
LASTING = {"noise.odometry_scale": 0.03, "noise.gyro_bias": 0.0087}
TURNED = {"camera.extrinsics_error": 0.01745}
"""rad per axis, 1 deg."""


def with_error(values: Array, digits: int = 2) -> str:
    """Return the mean over worlds (W, ...) of each entry with its standard error in brackets."""
    rows = values.reshape(len(values), -1)
    pairs = zip(rows.mean(axis=0), rows.std(axis=0, ddof=1) / np.sqrt(len(rows)), strict=True)
    return " ".join(f"{mean:.{digits}f}({error:.{digits}f})" for mean, error in pairs)


def depth() -> None:
    """Print ANEES and errors along chains of messages."""
    print("scene: ANEES least .. worst, error median and largest, cm, by window")
    for title, (name, overrides) in DEEP.items():
        anees, errors = by_window(name, overrides, range(700, 716), EDGES)
        mean = anees.mean(axis=1)
        parts = [
            f"{mean[k].min():.2f} .. {with_error(anees[k, :, n])} {100 * np.median(errors[k]):.1f} "
            f"{100 * errors[k].max():.1f}"
            for k, n in enumerate(mean.argmax(axis=1))
        ]
        print(f"{title}: " + " | ".join(parts))


def drawn() -> None:
    """Print ANEES in sixty drawn scenes."""
    typical, worst = [], []
    for number in range(500, 560):
        scene = draw(number)
        anees = np.nanmean(consistency(scene), axis=1)
        typical.append(np.nanmedian(anees, axis=1))
        worst.append(np.nanmax(anees, axis=1))
        print(f"{number} {scene.name}: largest ANEES {worst[-1].round(2)}, median {typical[-1].round(2)}")
    print(f"median over scenes of the median {np.median(typical, axis=0).round(2)}", end="")
    print(f", of the largest {np.median(worst, axis=0).round(2)}; above 2: {(np.array(worst) > 2.0).mean(axis=0)}")


def errors() -> None:
    """Print ANEES with declared systematic errors and without them."""
    for lasting in (LASTING, {}):
        for environment in ("open_square", "facade", "behind_truck", "urban_crossing"):
            for agent in ("route_follower", "peek"):
                means, std, off = by_vehicle(environment, agent, lasting, 128)
                each = ", ".join(f"{mean:.2f}({error:.2f})" for mean, error in zip(means, std, strict=True))
                print(f"{environment}, {agent}, {lasting or 'none'}: {each}, e95 {_e95(off)} cm")
    for declared in (LASTING, LASTING | {"noise.gyro_bias": [0.0, 0.0, 0.0087]}, {}):
        tracking = load_scenario("busy_intersection_tracking", {**ROBUST, **declared})
        nees, off, _ = watched(tracking, range(1000, 1032), 400, 6, skipped=20)
        print(f"tracking, {declared or 'none'}: {with_error(nees.mean(axis=(0, 2)))}, e95 {_e95(off)} cm")


def _e95(off: Array) -> str:
    return f"{100.0 * np.nanpercentile(off, 95):.0f}"


def camera() -> None:
    """Print ANEES and errors with a turned camera and with a true one."""
    for name in ("busy_intersection_tracking", "lane:8", "tree:15"):
        for title, changes in (("turned", TURNED), ("true", {})):
            nees, error, _ = judged(name, range(700, 732), 10, 40, **changes)
            print(f"{name}, {title}: ANEES {with_error(nees)}, error {with_error(100.0 * error, 1)} cm")


def lies() -> None:
    """Print the costs of lies."""
    for name in LIES:
        ratio, means = costs(name, range(900, 924), 45)
        each = " ".join("-" if np.isnan(r) else f"{r:.2f}" for r in ratio)
        print(f"{name}: {with_error(means)}, by vehicle {each}")


def searches() -> None:
    """Print the times after which lost vehicles have found their places."""
    for name in ("busy_intersection", "lane:8", "lane:12", "tree:12", "tree:20", "random:20,seed=31", "roots:12"):
        found = search(all_lost(name, 60.0), range(7000, 7016), 60.0)
        middle = np.median(found.settled, axis=0)
        print(
            f"| `{name}` | {np.median(middle):.1f} | {middle.max():.1f} | {np.isinf(found.settled).mean():.3f} "
            f"| {100.0 * found.wrong.mean():.2f} | {np.nanmean(found.nees, axis=0).max():.2f} |"
        )


def meetings() -> None:
    """Print the consistency of sixteen cars that meet again and again."""
    found, marked = [], []
    for engine in steps_of("route_follower", load_scenario("large_crossing", ROBUST), 16, 3):
        found.append(nees_of(engine.world))
        memory: Any = engine.world.memory
        marked.append(memory.member.numpy()["correlation_unknown"].mean())
    nees, off = (np.array(part)[15:] for part in zip(*found, strict=True))
    rms = np.sqrt(np.nanmean(off**2))
    print(f"ANEES {with_error(np.nanmean(nees, axis=(0, 2)))}, {100.0 * rms:.0f} cm, marked {np.mean(marked):.3f}")


STUDIES: dict[str, Callable[[], None]] = {
    "depth": depth,
    "drawn": drawn,
    "errors": errors,
    "camera": camera,
    "lies": lies,
    "search": searches,
    "meetings": meetings,
}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m benchmarks.robust", description=__doc__)
    parser.add_argument("study", choices=STUDIES)
    sys.exit(status_of(lambda asked: STUDIES[asked.study](), parser.parse_args()))
