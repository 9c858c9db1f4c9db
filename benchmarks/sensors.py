"""`python -m benchmarks.sensors`: what a measurement of each kind costs beside a bearing of the camera.

Kernels: CPU time of the sensor's stage per measurement, 256 worlds on one thread, over that of the camera's stage per
bearing. Filters: CPU time of an update with the sensor beside the camera over that with the camera alone. Each time is
the least of many rounds in turn, because other programs disturb single ones.
"""

import argparse
import warnings
from collections.abc import Callable
from functools import partial
from time import thread_time
from typing import Any

import numpy as np

from benchmarks.stages.ablated_stages import Setting, simulated, stepper, without_camera
from coopenv.base.errors import ScenarioWarning
from coopenv.measurements.table import KINDS
from coopenv.observers import group, runner
from coopenv.observers.registry import find
from coopenv.observers.riccati import DEAD_RECKONING
from coopenv.report.table import Table
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario

ENVIRONMENT, WORLDS, WARM_UP = "busy_intersection_tracking", 256, 5
SENSED: dict[str, Any] = {"topology.mode": "sensed"}
SETS = {kind: [{"kind": kind}] for kind in KINDS} | {
    "range, position, attitude": [{"kind": kind} for kind in ("range", "position", "attitude")]
}


def least(steps: dict[str, Callable[[], Any]], rounds: int) -> dict[str, Any]:
    """Return the least of what each step returns in some rounds, element by element."""
    found = {name: step() for name, step in steps.items()}
    for _ in range(rounds - 1):
        found = {name: np.fmin(found[name], step()) for name, step in steps.items()}
    return found


def kernel_costs(rounds: int) -> dict[str, float]:
    """Return the CPU time in s per bearing of the camera, and per measurement of each kind."""
    blind = Setting(DEAD_RECKONING, source=simulated(look=without_camera))
    worlds = {"": blind.world(ENVIRONMENT, SENSED, WORLDS, "float32")}
    for name, sensors in {"camera": [], **{kind: SETS[kind] for kind in KINDS}}.items():
        worlds[name] = Setting(DEAD_RECKONING).world(ENVIRONMENT, SENSED | {"sensors": sensors}, WORLDS, "float32")
    steps = {name: stepper(world, WARM_UP) for name, world in worlds.items()}
    times = least({name: partial(step, 2) for name, step in steps.items()}, rounds)
    costs = {}
    for name, world in worlds.items():
        ticks = world.view("bearing_tick" if name == "camera" else "reading_tick") if name else np.zeros(1)
        share = (ticks == world.view("tick").max()).sum() / (WORLDS * world.model.vehicles)
        if name:
            costs[name] = (times[name] - times["" if name == "camera" else "camera"]) / share
    return costs


def filter_costs(observer: str, rounds: int) -> dict[str, float]:
    """Return the CPU time in s of an update with the camera alone, and with other sensors beside it."""
    group.perf_counter = thread_time  # type: ignore[attr-defined]

    def played(sensors: list[dict[str, str]]) -> Callable[[], Any]:
        overrides = {"horizon": 0.5, **({"sensors": sensors} if sensors else {})}
        recording = record(load_scenario(ENVIRONMENT, overrides), 0)

        def play() -> Any:
            observers = group.ObserverGroup(find(observer), recording.observer_init)
            observers.start(recording.start_rotation, recording.start_position)
            return np.array([seconds for _, _, (_, seconds) in runner._play(observers, recording)])

        return play

    times = least({name: played(sensors) for name, sensors in {"camera": [], **SETS}.items()}, rounds)
    return {name: float(each.mean()) for name, each in times.items()}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.sensors", description=__doc__)
    parser.add_argument("--observers", default="mekf_covariance,schmidt_kalman", help="of the zoo")
    parser.add_argument("--rounds", type=int, default=20)
    asked = parser.parse_args()
    warnings.simplefilter("ignore", ScenarioWarning)  # worlds of kernels have an observer that ignores sensors
    columns: dict[str, dict[str, float]] = {"kernel\n[ns]": kernel_costs(asked.rounds)}
    scales = {"kernel\n[ns]": 1e9}
    for observer in asked.observers.split(","):
        name = f"{observer}\n[us]".replace("_", "_\n", 1)
        columns[name], scales[name] = filter_costs(observer, asked.rounds), 1e6
    table = Table.of_texts(["sensor"], [heading for name in columns for heading in (name, "/\ncamera")])
    for kind in ("camera", *SETS):
        cells = []
        for name, costs in columns.items():
            known = kind in costs
            cells += (
                [f"{scales[name] * costs[kind]:.0f}", f"{costs[kind] / costs['camera']:.2f}"] if known else ["", ""]
            )
        table.add(kind, *cells)
    from rich.console import Console

    Console().print(table)


if __name__ == "__main__":
    main()
