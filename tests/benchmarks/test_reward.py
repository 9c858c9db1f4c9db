"""The comparison of rewards: weights of equal spread, intervals of differences, the page and its figure."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks import reward, reward_page
from benchmarks.learning.study import Study, read_study
from coopenv.base.installation import data_directory
from coopenv.evaluation.metrics import Ratio
from coopenv.scenario import load_scenario
from coopenv.training.settings import TrainingPlan

WORLDS = 6
DOCS = Path(__file__).parents[2] / "docs" / "environments"


def runs(level: float, apart: float = 0.1) -> reward.Runs:
    """Return figures of three runs in worlds that differ by more than the runs."""
    worlds = np.sin(np.arange(WORLDS))
    return {
        name: [Ratio(level + apart * seed + worlds, np.ones(WORLDS)) for seed in (-1, 0, 1)]
        for name in reward_page.FIGURES
    }


def test_differences_are_paired_by_world_and_not_by_seed() -> None:
    found = {"a": {"plain": runs(2.0), "covariance": runs(1.5), "truth": runs(1.0)}}
    own = reward.compared(found, WORLDS, ["plain", "covariance"])["a"]["truth"]["mean_m"]
    mean = 1.0 + np.sin(np.arange(WORLDS)).mean()
    assert own["value"][0] == pytest.approx(mean) and own["plain"][0] == pytest.approx(-1.0)
    assert own["covariance"][0] == pytest.approx(-0.5) and own["value"][1] < mean - 0.3
    assert -1.25 < own["plain"][1] < -1.1 and -0.9 < own["plain"][2] < -0.75  # of seeds alone, drawn in either arm
    assert "plain" not in reward.compared(found, WORLDS, ["plain"])["a"]["plain"]["mean_m"]


def test_the_mean_over_environments_is_that_of_their_differences() -> None:
    found = {place: {"plain": runs(2.0), "truth": runs(level)} for place, level in (("a", 1.0), ("b", 4.0))}
    figures = reward.compared(found, WORLDS, ["plain"])
    value, low, high = figures[reward.MEAN]["truth"]["mean_m"]["plain"]
    assert value == pytest.approx(0.5) and low < 0.5 < high
    for key in ("value", "plain"):  # worlds and runs of different environments are drawn apart
        (_, low, high), (_, start, end) = (figures[place]["truth"]["mean_m"][key] for place in (reward.MEAN, "a"))
        assert high - low < 0.8 * (end - start)


def test_a_weight_gives_the_term_the_spread_of_the_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reward, "TUNING_WORLDS", 2)
    monkeypatch.setattr(reward, "DRAWS", 3)
    study = read_study(data_directory("agents") / "reward_study.toml")
    plan = next(plan for plan in study.plans if plan.arm == "truth")
    settings = plan.settings.model_copy(
        update={"start": "route_follower", "scenario": {**plan.settings.scenario, "horizon": 4.0}}
    )
    plan = TrainingPlan(plan.environment, settings, 1, "truth")
    ((place, arm, weight),) = reward.balanced(Study((plan,)))
    key, own = reward.term_of(plan)
    assert (place, arm, key) == (plan.environment, "truth", "reward.weights.position_error_per_metre") and own > 0.0
    names = load_scenario(place).reward.by_name
    alone = {**{f"reward.weights.{name}": 0.0 for name in names}, key: weight}
    assert reward.spread(plan, alone) == pytest.approx(reward.spread(plan, {key: 0.0}), rel=1e-4)
    assert reward.spread(plan, alone) > 0.0
    still = settings.model_copy(update={"ppo": settings.ppo.model_copy(update={"initial_std": 0.0})})
    unexplored = TrainingPlan(plan.environment, still, 1, "truth")  # then only the worlds differ, which does not count
    assert reward.spread(unexplored, alone) < 1e-3 * reward.spread(plan, alone)


def test_the_judged_return_leaves_the_term_out() -> None:
    study = read_study(data_directory("agents") / "reward_study.toml")
    place, found = study.plans[0].environment, {}
    for plan in study.plans:
        if plan.environment == place and plan.seed == 1 and plan.arm in ("plain", "covariance"):
            key, weight = reward.term_of(plan)
            assert bool(key) == (weight > 0.0) == (plan.arm == "covariance")
            rest = {key: 0.0, "horizon": 4.0} if key else {"horizon": 4.0}
            found[plan.arm] = reward.driven(plan, "route_follower", [3, 4], rest).reward
    np.testing.assert_array_equal(found["plain"], found["covariance"])


def document() -> dict[str, object]:
    found = {place: {name: runs(level) for name, level in (("start", 3.0), ("plain", 2.0), ("covariance", 1.0))}
             for place in ("a", "b")}  # fmt: skip
    return {
        "worlds": WORLDS, "block": 7, "steps": 1000, "seeds": 3, "terms": {"plain": "", "covariance": "uncertainty"},
        "weights": {place: {"plain": 0.0, "covariance": 2.0} for place in ("a", "b")},
        "spreads": {"a": {"covariance": 1.1}, "b": {"covariance": 0.9}},
        "figures": reward.compared(found, WORLDS, ["plain", "covariance"]),
    }  # fmt: skip


def test_the_verdict_is_that_of_the_intervals(tmp_path: Path) -> None:
    made = document()
    *first, last = reward_page.verdict(made)
    assert first[0].startswith("The mean of all: against `plain`, the mean error falls with `covariance` (-100.0 [-")
    assert last.startswith("`b`: against `plain`, the mean error falls with `covariance` (-100.0 [-")
    for cell, words in (
        ((0.1, -0.1, 0.3), "has no clear change with `covariance` (10.0 [-10.0, 30.0] cm)"),
        ((0.2, 0.1, 0.3), "rises with `covariance` (20.0 [10.0, 30.0] cm)"),
    ):
        made["figures"]["b"]["covariance"]["mean_m"]["plain"] = cell  # type: ignore[index]
        *_, last = reward_page.verdict(made)
        assert last == f"`b`: against `plain`, the mean error {words}."
    assert "| `covariance` | `uncertainty` | 2 (1.10) | 2 (0.90) |" in reward_page.page(made)
    assert reward_page.draw(made, tmp_path / "rewards.png").stat().st_size > 5000


def test_the_page_in_the_documents_is_that_of_the_results() -> None:
    made = json.loads((DOCS / "rewards.json").read_text(encoding="utf-8"))
    assert (DOCS / "rewards.md").read_text(encoding="utf-8") == reward_page.page(made)
    study = read_study(data_directory("agents") / "reward_study.toml")
    for plan in study.plans:
        assert made["weights"][plan.environment][plan.arm] == reward.term_of(plan)[1]
        assert made["steps"] == plan.settings.steps
