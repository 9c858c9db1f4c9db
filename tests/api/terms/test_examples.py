"""The examples of terms of one's own."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

import coopenv
from coopenv.estimation.outcomes import Outcome

EXAMPLES = Path(__file__).parents[3] / "examples"


def test_the_program_runs(capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(EXAMPLES / "own_terms.py"))
    printed = capsys.readouterr().out
    assert printed.count("smooth -0.") == 4 and "mean return" in printed


def test_the_scenario_with_terms_beside_it() -> None:
    env = coopenv.parallel_env(EXAMPLES / "lane_keeping" / "lane_keeping.toml", dtype="float64")
    observations, infos = env.reset(seed=0)
    while env.agents:
        observations, rewards, _, _, infos = env.step({"vehicle_1": np.array([1.0, 1.0])})  # left, in a circle
    offset = infos["vehicle_1"]["estimate"]["position"][0] - 1.0
    terms = infos["vehicle_1"]["reward_terms"]
    assert terms["lane"] == pytest.approx(-(offset**2), rel=1e-5)
    assert rewards["vehicle_1"] == pytest.approx(terms["lane"] + 0.1 * terms["control"], rel=1e-5)
    lane_offset = env.observation_layout["lane_offset"]
    assert observations["vehicle_1"][lane_offset.slice] == pytest.approx(np.clip(offset / 3.0, -1.0, 1.0), rel=1e-5)
    assert infos["vehicle_1"]["outcome"] in ("under way", "off_the_road")


def test_leaving_the_road_ends_an_episode() -> None:
    path = EXAMPLES / "lane_keeping" / "lane_keeping.toml"
    overrides = {"vehicles.0.initial_pose.yaw": 0.0}  # straight off the road
    envs = coopenv.make_vec(path, num_worlds=2, overrides=overrides, autoreset="disabled")
    envs.reset(seed=0)
    ended = np.array([envs.step(np.tile([1.0, 0.0], (2, 1)))[4]["ended"] for _ in range(25)])  # 2 m at 1.5 m/s
    assert set(ended[:10].ravel()) == {0} and set(ended[-1]) == {len(Outcome)}
