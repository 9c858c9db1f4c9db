"""`python -m benchmarks.adversary`: a lying sender whose drift is trained in batch worlds against an observer.

Every second the adversary chooses the velocity at which the position that its vehicle broadcasts drifts. It sees the
time, its own offset, and its followers' broadcast positions relative to its own estimate. The velocity is linear in
these features and limited to `--rate`; `constant` uses the first feature alone. The parameters are found by the
cross-entropy method, which maximises the honest vehicles' mean position error. The table is Markdown, on evaluation
seeds; the line below it replays the worst attack on a recording.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from rich.console import Console

import coopenv
from benchmarks.options import at_least, status_of
from coopenv.base.format import in_parentheses
from coopenv.base.seeds import EVALUATION_SEEDS
from coopenv.bench.observers.changes import DIRECTION
from coopenv.bench.observers.rows import standard_error
from coopenv.bench.pages import table
from coopenv.estimation.poses import Array
from coopenv.observers.registry import find_embedded
from coopenv.runs.console import Progress

SCENE = "busy_intersection_tracking"
TARGETS = {
    "few": {},
    "many": {
        "vehicles.vehicle_2.neighbours": ["SL1", "SL2", "SL3", "vehicle_1"],
        "vehicles.vehicle_3.neighbours": ["SL2", "SL3", "vehicle_1", "vehicle_2"],
        "vehicles.vehicle_4.neighbours": ["SL2", "SL3", "vehicle_1", "vehicle_2", "vehicle_3"],
        "vehicles.vehicle_5.neighbours": ["SL3", "vehicle_1", "vehicle_2", "vehicle_3", "vehicle_4"],
    },
}
"""Changes of the scene: three targets per vehicle, or at least two honest ones besides the liar, see the page."""
OBSERVERS = ("robust", "schmidt_kalman", "riccati")
"""The first one is attacked in training."""
LIAR = 1
"""Index of the lying vehicle: the second one that has followers."""
START = 5.0
"""s, of the earliest lie; errors count from then on."""
LATEST = 10.0
"""s after `START`, of the latest begin of a lie in training."""
PLAIN_RATE = 0.05
"""m/s, of the drift that is not trained: the default of `lie.speed`."""
NEAR = 20.0
"""m, the scale of positions among the features."""
SLOWEST = 5e-4
"""m/s; smaller changes of a velocity are left out of a fault's text."""
ODOMETRY = ("consistent", "honest")


@dataclass(frozen=True)
class Rollouts:
    """Episodes of W worlds with N vehicles."""

    error: Array  # (W, N) mean position errors from `START` on, m; NaN: of the liar
    velocity: Array  # (W, T, 2) at which the lie drifted in every second from `START` on, m/s

    @property
    def mean(self) -> Array:
        """(W,) of the honest vehicles."""
        return np.asarray(np.nanmean(self.error, axis=1))

    @property
    def worst(self) -> Array:
        """(W,) of the honest vehicle with the largest error."""
        return np.asarray(np.nanmax(self.error, axis=1))


Steering = Callable[[float, Array], Array]
"""(s since `START`, (W, F) features): return (W, 2) the velocity of the drift, m/s, map axes."""


class Worlds:
    """Batch worlds in which one vehicle lies as a `Steering` decides."""

    def __init__(self, count: int, observer: str, odometry: str, scene: Mapping[str, Any]) -> None:
        """Build the worlds; `scene` are dotted keys, `horizon` among them."""
        lie = {"kind": "drift", "start": START, "odometry": odometry}
        overrides = {**scene, f"vehicles.vehicle_{LIAR + 1}.faults": {"lie": lie}}
        self.envs = coopenv.make_vec(
            SCENE,
            num_worlds=count,
            dtype="float64",  # as recordings have it
            observer=observer,
            autoreset="disabled",
            overrides=overrides,
        )
        scenario = self.envs.scenario
        self._seconds = int(scenario.horizon - START)
        self._decisions = round(scenario.rates.decision)
        self._idle = np.zeros((self.envs.num_envs, scenario.action_size), np.float32)
        self._honest = np.arange(self.envs.vehicles) != LIAR

    def play(self, seeds: Sequence[int], steering: Steering) -> Rollouts:
        """Return the episodes of seeds, one per world."""
        self.envs.reset(seed=list(seeds))
        world, count = self.envs.engine.world, self.envs.num_worlds
        for _ in range(round(START * self._decisions)):
            self.envs.step(self._idle)
        offset, total = np.zeros((count, 2)), np.zeros((count, self.envs.vehicles))
        velocities, velocity = [], np.zeros((count, self.envs.vehicles, 3))
        for second in range(self._seconds):
            chosen = steering(float(second), self._features(second, offset))
            velocity[:, LIAR, :2] = chosen
            world.steer_lies(velocity)
            velocities.append(chosen)
            offset = offset + chosen
            for _ in range(self._decisions):
                *_, infos = self.envs.step(self._idle)
                total += self.envs.world_major(infos["position_error"])
        error = np.where(self._honest, total / (self._seconds * self._decisions), np.nan)
        return Rollouts(error, np.stack(velocities, axis=1))

    def _features(self, second: int, offset: Array) -> Array:
        """Return (W, F) what the adversary sees: 1, time, own offset, other vehicles' broadcast positions."""
        R, p = (self.envs.engine.view(f"estimate_{name}") for name in ("rotation", "position"))
        place = np.einsum("wnij,wnj->wni", R, p)[..., :2]
        others = (place[:, LIAR + 1 :] - place[:, LIAR, None]).reshape(len(place), -1)
        time = np.full((len(place), 1), second / self._seconds)
        return np.hstack([np.ones_like(time), time, offset, others / NEAR])


def linear(parameters: Array, rate: float) -> Steering:
    """Return the steering of (W, 1 + 2 F) parameters: begin after `START` (s), then rows of the velocity's matrix."""

    def steering(time: float, features: Array) -> Array:
        matrix = parameters[:, 1:].reshape(len(parameters), 2, -1)
        velocity = np.einsum("wij,wj->wi", matrix, features[:, : matrix.shape[2]])
        speed = np.linalg.norm(velocity, axis=1, keepdims=True)
        limited = velocity * rate / np.maximum(speed, rate)
        return np.where(time >= parameters[:, :1], limited, 0.0)

    return steering


def constant(begin: Array, rate: Array, angle: Array) -> Array:
    """Return the parameters (W, 3) of drifts from their begins on, s after `START`, at rates (m/s) and angles (rad)."""
    return np.stack([begin, rate * np.cos(angle), rate * np.sin(angle)], axis=1)


def cross_entropy(
    score: Callable[[Array, int], Array], mean: Array, std: Array, generations: int, population: int
) -> Array:
    """Return the parameters (F,) of a large score by the cross-entropy method, with a quarter of each population.

    The last population consists of the means of those before; the best of them is returned.

    Args:
        score: (parameters (population, F), generation): return the scores, larger is better.
        mean: (F,) of the first population.
        std: (F,) of the first population.
        generations: how many populations are drawn.
        population: how many candidates are in each.
    """
    random, elite, means = np.random.default_rng(0), max(2, population // 4), [mean]
    for generation in range(generations):
        candidates = mean + std * random.normal(size=(population, len(mean)))
        candidates[0] = mean
        best = candidates[np.argsort(-score(candidates, generation))[:elite]]
        mean = best.mean(axis=0)
        std = 0.5 * std + 0.5 * best.std(axis=0)  # smoothed, so that the search does not end early
        means.append(mean)
    last = np.resize(means[-population:], (population, len(mean)))
    return np.asarray(last[np.argmax(score(last, generations))])


def fault_of(velocity: Array, odometry: str) -> str:
    """Return the fault that replays a drift on a recording: one part per change of its velocity (T, 2), m/s."""
    changes = np.diff(velocity, axis=0, prepend=0.0)
    speeds, angles = np.hypot(*changes.T), np.arctan2(*changes.T[::-1]) % (2.0 * np.pi)
    honest = ",honest_odometry=1" if odometry == "honest" else ""
    return "/".join(
        f"vehicle_{LIAR + 1}:lie=drift:{speed:.4f}@{START + second:g},angle={angle:.4f}{honest}"
        for second, (speed, angle) in enumerate(zip(speeds.tolist(), angles.tolist(), strict=True))
        if speed >= SLOWEST
    )


class Search:
    """Training of both kinds of attack against the first observer."""

    def __init__(self, asked: argparse.Namespace, odometry: str, on_progress: Callable[[], None]) -> None:
        self._asked, self._on_progress = asked, on_progress
        self._worlds = Worlds(asked.population * asked.seeds, OBSERVERS[0], odometry, scene_of(asked))

    def constant(self) -> Array:
        """Return the parameters (3,) of the best drift at a constant velocity."""
        rate = self._asked.rate
        return self._best(np.zeros(3), np.array([0.5 * LATEST, 0.5 * rate, 0.5 * rate]))

    def policy(self, first: Array) -> Array:
        """Return the parameters (1 + 2 F,) of the best linear policy, searched from a constant drift on."""
        features = 2 + 2 + 2 * (self._worlds.envs.vehicles - LIAR - 1)
        matrix = np.zeros((2, features))
        matrix[:, 0] = first[1:]
        spread = np.concatenate([[0.1 * LATEST], np.full(matrix.size, 0.1 * self._asked.rate)])
        return self._best(np.concatenate([first[:1], matrix.ravel()]), spread)

    def _best(self, mean: Array, std: Array) -> Array:
        return cross_entropy(self._score, mean, std, self._asked.generations, self._asked.population)

    def _score(self, candidates: Array, generation: int) -> Array:
        """Return the mean error of every candidate; all meet the same seeds, which change with the generation."""
        count = self._asked.seeds
        seeds = [*range(generation * count, (generation + 1) * count)] * len(candidates)
        steering = linear(np.repeat(candidates, count, axis=0), self._asked.rate)
        errors = self._worlds.play(seeds, steering).mean
        self._on_progress()
        return np.asarray(errors.reshape(len(candidates), count).mean(axis=1))


def attacks(count: int, rate: float, found: dict[str, Array]) -> dict[str, Array]:
    """Return the parameters (count, ...) of all attacks, limited to a rate, m/s; `found`: those that were trained."""
    random = np.random.default_rng(1)
    none, all_rates = np.zeros(count), np.full(count, PLAIN_RATE)
    drawn = random.random((3, count))
    return {
        "default drift": constant(none, all_rates, np.full(count, np.arctan2(DIRECTION[1], DIRECTION[0]))),
        "random drift": constant(LATEST * drawn[0], rate * drawn[1], 2.0 * np.pi * drawn[2]),
        **{name: np.tile(parameters, (count, 1)) for name, parameters in found.items()},
    }


def scene_of(asked: argparse.Namespace) -> dict[str, Any]:
    """Return the dotted keys of the scene."""
    return {"horizon": asked.horizon, **TARGETS[asked.targets]}


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    made = argparse.ArgumentParser(prog="python -m benchmarks.adversary", description=__doc__)
    made.add_argument("--targets", choices=TARGETS, default="many", help="of every vehicle (default: many)")
    made.add_argument("--rate", type=at_least(1e-3), default=0.3, help="fastest drift, m/s (default: 0.3)")
    made.add_argument(
        "--horizon", type=at_least(START + 1.0), default=30.0, help="length of an episode, s (default: 30)"
    )
    made.add_argument("--generations", type=at_least(1), default=12, help="of each search (default: 12)")
    made.add_argument("--population", type=at_least(1), default=16, help="candidates per generation (default: 16)")
    made.add_argument("--seeds", type=at_least(1), default=2, help="training seeds per candidate (default: 2)")
    made.add_argument("--held-out", type=at_least(1), default=16, help="evaluation seeds (default: 16)")
    made.add_argument("--held-out-host", type=at_least(1), default=4, help="of observers on the host (default: 4)")
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    """Train, measure and print; return the exit status: 0, or 2 after a mistake in the input."""
    asked = parser().parse_args(arguments)
    return status_of(measure, asked)


def measure(asked: argparse.Namespace) -> None:
    """Train the attacks, then print the table and the worst attack."""
    steps = len(ODOMETRY) * (2 * (asked.generations + 1) + 4 * len(OBSERVERS)) + len(OBSERVERS)
    done = 0
    with Progress(Console(stderr=True), "training", total=steps) as progress:

        def advance() -> None:
            nonlocal done
            done += 1
            progress.update(done)

        trained = {}
        for odometry in ODOMETRY:
            search = Search(asked, odometry, advance)
            drift = search.constant()
            trained[odometry] = {"trained drift": drift, "trained policy": search.policy(drift)}
        results = evaluate(asked, trained, advance)
    print(table_of(results))
    for odometry in ODOMETRY:
        drift = results["trained drift", odometry, OBSERVERS[0]].velocity[0]
        print(f"\nTrained drift, {odometry} odometry: `{fault_of(drift, odometry)}`")
    print(worst_line(asked, results))


Results = dict[tuple[str, str, str], Rollouts]
"""By attack, odometry and observer."""


def evaluate(
    asked: argparse.Namespace, trained: dict[str, dict[str, Array]], on_progress: Callable[[], None]
) -> Results:
    """Return the episodes of all attacks on evaluation seeds."""
    results = {}
    for observer, odometry in product(OBSERVERS, ODOMETRY):
        count = asked.held_out if find_embedded(observer) else min(asked.held_out, asked.held_out_host)
        worlds = Worlds(count, observer, odometry, scene_of(asked))
        plans = attacks(count, asked.rate, trained[odometry])
        if odometry == ODOMETRY[0]:
            plans = {"none": np.zeros((count, 3)), **plans}
        for name, parameters in plans.items():
            steering = linear(parameters, asked.rate)
            results[name, odometry, observer] = worlds.play(EVALUATION_SEEDS[:count], steering)
            on_progress()
    return results


def table_of(results: Results) -> str:
    """Return the table: errors of the honest vehicles in m, mean and worst vehicle, with standard errors."""
    rows = []
    for name, odometry in dict.fromkeys((name, odometry) for name, odometry, _ in results):
        found = [results[name, odometry, observer] for observer in OBSERVERS]
        cells = [", ".join(map(_with_error, (each.mean, each.worst))) for each in found]
        rows.append([name, "" if name == "none" else odometry, *cells])
    return table(["attack", "odometry", *(f"`{name}`" for name in OBSERVERS)], rows)


def _with_error(values: Array) -> str:
    """Return the mean of (W,) values with its standard error."""
    return in_parentheses(float(values.mean()), standard_error(values))


def worst_line(asked: argparse.Namespace, results: Results) -> str:
    """Return the command that replays the episode with the largest mean error of the first observer."""
    of_first = {key: each for key, each in results.items() if key[2] == OBSERVERS[0]}
    name, odometry, observer = max(of_first, key=lambda key: float(of_first[key].mean.max()))
    rollouts = of_first[name, odometry, observer]
    world = int(np.argmax(rollouts.mean))
    figures = f"{rollouts.mean[world]:.2f} m on average, {rollouts.worst[world]:.2f} m of the worst vehicle"
    keys = " ".join(f"--set '{key}={json.dumps(value)}'" for key, value in scene_of(asked).items())
    command = (
        f"coopenv bench observers {SCENE} --observers {observer} --first {EVALUATION_SEEDS[world]} --seeds 1 {keys} "
        f"--steady-from {START:g} --fault {fault_of(rollouts.velocity[world], odometry)}"
    )
    return f"\nWorst case of `{observer}`, {name}, {odometry} odometry ({figures}):\n\n```\n{command}\n```"


if __name__ == "__main__":
    sys.exit(main())
