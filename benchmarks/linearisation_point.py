"""`python -m benchmarks.linearisation_point`: range bias of `robust` itself by the point of linearisation.

Two vehicles: the first sees landmarks, the second sees the first alone, in a lane at the same velocity or in a curve.
Each variant runs in a process of its own, in which the share of the correction and the time of the linearisation
variance are replaced before the kernels are compiled. Compilation takes a minute per variant, once per machine.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.console import Console

from coopenv.base.format import in_parentheses
from coopenv.report.table import Table
from coopenv.runs.console import Progress

POINTS = {"prediction": 0.0, "midpoint": 0.5, "correction": 1.0}
TIMES = (0.0, 12.0)
"""s, of the linearisation variance of bearings to members; 12 is the observer's own."""
TURNS = {"lane": 0.0, "curve": 0.4}
"""Yaw rate of the second vehicle, rad/s."""
SECONDS = 30
START: dict[str, Any] = {
    "position": None,
    "position_radius": 0.2,
    "orientation_angle": 0.05,
    "orientation_offset_wxyz": (1.0, 0.0, 0.0, 0.0),
}


def patch(share: float, time: float) -> None:
    """Replace the share of a small correction after which bearings are linearised, and the variance's time, s."""
    import warp as wp

    from coopenv.observers.robust import constants, correction
    from coopenv.world.warp_internals import device_function

    @device_function
    def next_share(memory: Any, world: int, i: int, bearings: int, first: bool):  # type: ignore[no-untyped-def]
        one = wp.float64(1.0)
        turn = correction.turn_of_sight(memory, world, i, bearings, one, wp.float64(0.0))
        chosen = wp.where(turn >= wp.float64(constants.LINEAR_ANGLE), one, wp.float64(share))
        if not first:
            turn = correction.turn_of_sight(memory, world, i, bearings, chosen, one)
            chosen = wp.where(turn < wp.float64(constants.LINEAR_ANGLE), wp.float64(0.0), chosen)
        return chosen

    correction.next_share = next_share
    constants.CONSIDERED_LINEARISATION_TIME = time


def measure(point: str, time: float, worlds: int) -> dict[str, list[float]]:
    """Return per scene the range bias, m, its standard error, ANEES of the second vehicle and its standard error."""
    patch(POINTS[point], time)
    from coopenv.estimation.metrics import nees
    from coopenv.estimation.poses import Coordinates
    from coopenv.scenario import load_scenario
    from coopenv.scenario.bodies import ConstantMotion
    from coopenv.sources.worlds import Simulated

    found = {}
    for scene, turn in TURNS.items():
        made = load_scenario("lane:2", {"observer.name": "robust", "horizon": SECONDS + 1.0})
        leader, follower = (
            v.model_copy(update={"initial_estimate": v.initial_estimate.model_copy(update=START)})
            for v in made.vehicles
        )
        motion = ConstantMotion(kind="constant", linear=(0.0, 0.5, 0.0), angular=(0.0, 0.0, turn))
        follower = follower.model_copy(update={"neighbours": ("vehicle_1",), "motion": motion})
        made = made.model_copy(update={"vehicles": (leader, follower)})
        world = Simulated(made).world(worlds, "float64", "cpu", None)
        world.reset(range(3000, 3000 + worlds))
        world.mask.zero_()
        world.advance(round(SECONDS * made.rates.camera))
        R, p, P = (world.view(name) for name in ("estimate_rotation", "estimate_position", "covariance"))
        estimated, true = np.einsum("wnij,wnj->wni", R, p), world.view("position")[:, -2:]
        error = Coordinates.RICCATI.error(world.view("rotation")[:, -2:], true, R, estimated)
        bias = np.linalg.norm(np.diff(estimated, axis=1), axis=2) - np.linalg.norm(np.diff(true, axis=1), axis=2)
        values = (bias[:, 0], nees(error[:, 1], P[:, 1]) / 6.0)
        found[scene] = [f for v in values for f in (float(v.mean()), float(v.std(ddof=1) / np.sqrt(worlds)))]
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure every variant in a process of its own and print the table; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.linearisation_point", description=__doc__)
    parser.add_argument("--worlds", type=int, default=256, help="number of worlds (default: 256)")
    parser.add_argument("--variant", nargs=2, help=argparse.SUPPRESS)
    asked = parser.parse_args(arguments)
    if asked.variant:
        print(json.dumps(measure(asked.variant[0], float(asked.variant[1]), asked.worlds)))
        return 0
    cases = [(point, time) for time in TIMES for point in POINTS]
    table = Table.of_texts(["\nscene", "\nlinearised at", "\nvariance"], ["range bias\n[cm]", "ANEES\n"])
    with Progress(Console(stderr=True), "simulating", total=len(cases)) as progress:
        for done, (point, time) in enumerate(cases):
            progress.update(done)
            command = [
                sys.executable,
                "-m",
                __spec__.name,
                "--worlds",
                str(asked.worlds),
                "--variant",
                point,
                str(time),
            ]
            result = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
            for scene, (bias, error, anees, spread) in json.loads(result.stdout.splitlines()[-1]).items():
                cells = in_parentheses(100 * bias, 100 * error), in_parentheses(anees, spread)
                table.add(scene, point, f"{time:g} s" if time else "-", *cells)
    Console(markup=False, highlight=False).print(table, f"After {SECONDS} s, {asked.worlds} worlds.", sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
