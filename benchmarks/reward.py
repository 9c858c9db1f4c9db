"""Does a reward for localisation pay, and which? `python -m benchmarks.reward` answers with `agents/reward_study.toml`.

It trains the matched arms that are missing in `out/reward`, drives all of them in held-out worlds, and prints tables
with 95 % intervals (bootstrap over worlds and seeds). `--page docs/environments` writes the page `rewards.md`, its
figure and `rewards.json`. The agents that all arms continue are trained before, as the page states.

`--weights` prints for each arm the weight with which its term has the spread of the rest of the reward: the standard
deviation of the discounted return between draws of exploration in the same world. The agent that all arms continue
drives in tuning worlds, with the exploration that PPO begins with.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.learning.study import Study, perform, place_of, read_study, unfinished
from benchmarks.options import at_least, status_of
from benchmarks.reward_page import FIGURES, Cell, Document, draw, page, tables
from coopenv.api.engine import Engine
from coopenv.base.files import replace_text
from coopenv.base.format import json_text
from coopenv.base.installation import data_directory, install_command, needing
from coopenv.bench.executors import Local
from coopenv.evaluation import Episodes, drive, held_out_seeds
from coopenv.evaluation.metrics import METRICS, Statistic, interval, resamples
from coopenv.policies import Policy, load_agent
from coopenv.scenario import load_scenario
from coopenv.training.settings import TrainingPlan

FOLDER, LOGS = Path("out/reward"), Path("out/tensorboard")
BLOCK, TUNING_BLOCK = 1097, 1098
"""Blocks of held-out seeds: of the tables, and of the weights."""
TUNING_WORLDS, DRAWS = 24, 8
"""Worlds of the weights, and draws of exploration in each of them."""
PREFIX = "reward.weights."
START, REFERENCE = "start", "peek"
"""Rows beside the arms: the agent that all arms continue, and a scripted driver that turns towards landmarks."""
MEAN = "mean of all"
"""Name of the mean over environments."""
Runs = dict[str, list[Statistic]]
"""Figures of the runs of a row, by name."""


def term_of(plan: TrainingPlan) -> tuple[str, float]:
    """Return the key and the weight of the arm's term; the arm `plain` has an empty key."""
    weights = ((key, value) for key, value in plan.all_overrides.items() if key.startswith(PREFIX) and value)
    return next(weights, ("", 0.0))


def driven(plan: TrainingPlan, policy: str | Path, seeds: Sequence[int], weights: Mapping[str, float]) -> Episodes:
    """Return the episodes of an agent in the worlds of an arm, with other weights of the reward."""
    scenario = load_scenario(plan.environment, {**plan.all_overrides, **weights})
    with closing(Engine(scenario, len(seeds))) as engine:
        return drive(engine, load_agent(policy, scenario), seeds)


def spread(plan: TrainingPlan, weights: Mapping[str, float]) -> float:
    """Return the standard deviation of the discounted return under weights, over exploration within a world."""
    scenario = load_scenario(plan.environment, {**plan.all_overrides, **weights})
    driver, rng, std = load_agent(str(plan.settings.start), scenario), np.random.default_rng(0), plan.settings.ppo

    def explore(rows: np.ndarray) -> np.ndarray:
        actions = np.asarray(driver(rows))
        return np.clip(actions + std.initial_std * rng.standard_normal(actions.shape), -1.0, 1.0).astype(np.float32)

    policy: Policy = explore
    with closing(Engine(scenario, TUNING_WORLDS * DRAWS)) as engine:
        reward = drive(engine, policy, np.repeat(held_out_seeds(TUNING_BLOCK, TUNING_WORLDS), DRAWS).tolist()).reward
    returns = np.tensordot(std.discount(scenario) ** np.arange(len(reward)), reward, axes=1)
    return float(np.sqrt(returns.reshape(TUNING_WORLDS, DRAWS, -1).var(axis=1, ddof=1).mean()))


def balanced(study: Study) -> Iterator[tuple[str, str, float]]:
    """Yield environment, arm, and the weight with which the arm's term has the spread of the rest of the reward."""
    rest: dict[str, float] = {}
    for plan, *_ in study.agents.values():
        if key := term_of(plan)[0]:
            if plan.environment not in rest:
                rest[plan.environment] = spread(plan, {key: 0.0})
            scenario = load_scenario(plan.environment, plan.all_overrides)
            alone = {**dict.fromkeys((PREFIX + name for name in scenario.reward.by_name), 0.0), key: 1.0}
            yield plan.environment, str(plan.arm), rest[plan.environment] / spread(plan, alone)


def figures_of(found: Episodes) -> dict[str, Statistic]:
    """Return the figures of the tables."""
    return {name: METRICS[name].of(found) for name in FIGURES}


def measured(study: Study, worlds: int, block: int) -> dict[str, dict[str, Runs]]:
    """Drive every run of a study, and return its figures by environment and row."""
    seeds, found = held_out_seeds(block, worlds), dict[str, dict[str, Runs]]()
    for plan in study.plans:
        key, _ = term_of(plan)
        rows = found.setdefault(plan.environment, {})
        agents: dict[str, str | Path] = {str(plan.arm): FOLDER / place_of(plan)}
        agents |= {} if rows else {REFERENCE: REFERENCE, START: str(plan.settings.start)}
        for name, agent in sorted(agents.items(), key=lambda item: item[0] == plan.arm):
            for figure, value in figures_of(driven(plan, agent, seeds, {key: 0.0} if key else {})).items():
                rows.setdefault(name, {}).setdefault(figure, []).append(value)
    return found


def resampled(runs: Sequence[Statistic], counts: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the mean over runs, (R,), for multiplicities of the worlds, (R, W), and runs drawn with replacement.

    The first figure is that of all runs.
    """
    values = np.stack([run.resampled(counts) for run in runs])
    chosen = rng.integers(0, len(runs), values.shape)
    chosen[:, 0] = np.arange(len(runs))
    return np.asarray(np.take_along_axis(values, chosen, axis=0).mean(axis=0))


def compared(
    found: Mapping[str, Mapping[str, Runs]], worlds: int, bases: Sequence[str]
) -> dict[str, dict[str, dict[str, dict[str, Cell]]]]:
    """Return every figure with its 95 % interval, and its differences from those of some rows.

    Args:
        found: the figures of all runs, by environment and row.
        worlds: number of worlds, the same ones for every run of an environment.
        bases: rows that others are compared with.

    Returns:
        By environment, and for the mean of several ones; by row; by figure; and by `value` or name of the base: the
        figure or difference, and the ends of its interval.
    """
    drawn, rng = dict[str, dict[str, dict[str, np.ndarray]]](), np.random.default_rng(0)
    for number, (place, rows) in enumerate(found.items()):
        counts = np.vstack([np.ones(worlds), resamples(worlds, number)])
        drawn[place] = {row: {name: resampled(own[name], counts, rng) for name in own} for row, own in rows.items()}
    if len(places := [*drawn.values()]) > 1:
        drawn[MEAN] = {
            row: {name: np.mean([each[row][name] for each in places], axis=0) for name in own}
            for row, own in places[0].items()
        }

    def cells(rows: Mapping[str, Mapping[str, np.ndarray]], row: str, name: str) -> dict[str, Cell]:
        differences = {base: rows[row][name] - rows[base][name] for base in bases if base != row}
        return {key: (float(v[0]), *interval(v[1:])) for key, v in {"value": rows[row][name], **differences}.items()}

    return {
        place: {row: {name: cells(rows, row, name) for name in own} for row, own in rows.items()}
        for place, rows in drawn.items()
    }


def document_of(
    study: Study, found: Mapping[str, Mapping[str, Runs]], worlds: int, equal: Iterable[tuple[str, str, float]]
) -> Document:
    """Return the contents of `rewards.json` from the figures of all runs, and the weights of `balanced`."""
    first = [plans[0] for plans in study.agents.values()]
    weights = {(plan.environment, str(plan.arm)): term_of(plan)[1] for plan in first}
    terms = {str(plan.arm): term_of(plan)[0].removeprefix(PREFIX) for plan in first}
    return {
        "worlds": worlds,
        "block": BLOCK,
        "steps": first[0].settings.steps,
        "seeds": len(study.plans) // len(first),
        "terms": terms,
        "weights": {place: {arm: weights[place, arm] for arm in terms} for place in found},
        "spreads": {
            place: {arm: weights[place, arm] / value for at, arm, value in equal if at == place} for place in found
        },
        "figures": compared(found, worlds, [*terms][:2]),
    }


def answer(asked: argparse.Namespace) -> None:
    """Train what is missing, drive, and print the tables; or print the weights."""
    study = read_study(data_directory("agents") / "reward_study.toml")
    if asked.weights:
        for row in balanced(study):
            print("{} {} {:.2g}".format(*row), flush=True)
        return
    with needing(f"training needs the extra train: {install_command('train')}"):
        missing = unfinished(study, FOLDER)
    Local(asked.jobs).map(partial(perform, FOLDER, LOGS), missing, lambda n: print(f"{n}/{len(missing)} trained"))
    document = document_of(study, measured(study, asked.worlds, BLOCK), asked.worlds, [*balanced(study)])
    print(tables(document))
    if asked.page:
        replace_text(asked.page / "rewards.json", json_text(document))
        replace_text(asked.page / "rewards.md", page(document))
        draw(document, asked.page / "rewards.png")


def main(arguments: Sequence[str] | None = None) -> int:
    """Answer; return the exit status: 0, or 2 after a mistake in the input."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.reward", description=__doc__)
    parser.add_argument("--weights", action="store_true", help="print the weights of the arms, and train nothing")
    parser.add_argument("--worlds", type=at_least(2), default=64, help="held-out worlds (default: 64)")
    parser.add_argument("--jobs", type=at_least(1), default=1, help="trainings side by side, one core each")
    parser.add_argument("--page", type=Path, help="folder of the page")
    return status_of(answer, parser.parse_args(arguments))


if __name__ == "__main__":
    sys.exit(main())
