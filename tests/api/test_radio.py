"""The radio as an action: what is sent to whom, what it costs, and what receivers know by it."""

from __future__ import annotations

import numpy as np
import pytest

import coopenv
from coopenv.api.engine import Engine
from coopenv.base.errors import CoopenvError
from coopenv.policies import load_agent
from coopenv.scenario import load_scenario

RADIO = {"action.radio": True, "v2x.loss": 0.0, "reward.team": "own", "reward.weights.radio": 1.0}
SILENT, POSE, REPORT = -1.0, 0.5, 1.0


def driven(name: str, entries: np.ndarray | None, steps: int = 40, **more: object) -> Engine:
    """Return an engine after decisions of `peek` with radio entries (N, N - 1)."""
    scenario = load_scenario(
        name, {**RADIO, **more} if entries is not None else {**RADIO, "action.radio": False, **more}
    )
    engine, vehicles = Engine(scenario, 2, "float64"), len(scenario.vehicles)
    engine.reset([3, 4])
    policy = load_agent("peek", scenario)
    for _ in range(steps):
        actions = policy(engine.view("observation").reshape(2 * vehicles, -1)).reshape(2, vehicles, -1)
        if entries is not None:
            actions[..., 2:] = entries
        engine.step(actions)
    return engine


def test_reports_sent_to_all_equal_broadcasts() -> None:
    broadcast, chosen = driven("scout_platoon", None), driven("scout_platoon", np.full((3, 2), REPORT))
    for name in ("position", "estimate_position", "covariance", "inbox_tick", "inbox_position"):
        assert np.array_equal(broadcast.view(name), chosen.view(name)), name
    sent = broadcast.view("bytes_sent")
    assert np.array_equal(chosen.view("bytes_sent"), 2 * sent)  # every receiver counts
    ticks = broadcast.world.model.ticks_per_decision
    assert set(np.unique(sent)) <= {172 * ticks + 42 * k for k in range(60)}
    place = broadcast.reward_terms.index("radio")
    assert broadcast.view("terms")[..., place] == pytest.approx(-sent / 1000.0)


def test_a_message_reaches_only_its_receiver() -> None:
    entries = np.full((3, 2), SILENT)
    entries[0] = [POSE, REPORT]  # vehicle_1 to vehicle_2, and to vehicle_3
    engine = driven("scout_platoon", entries)
    ticks = engine.world.model.ticks_per_decision
    assert (engine.view("inbox_tick")[:, [1, 2], 0] == 40 * ticks - 1).all()  # the radio's delay is one tick
    assert (engine.view("inbox_tick")[:, [0, 0, 1, 2], [1, 2, 2, 1]] <= 0).all()  # before the first decision all send
    sent = engine.view("bytes_sent")
    more = sent[:, 0] - ticks * (56 + 172)  # correlations
    assert (sent[:, 1:] == 0).all() and (more >= 0).all() and (more % 42 == 0).all()


def test_a_pose_alone_is_for_drivers_and_not_for_estimators() -> None:
    """Follower 2 can measure the first car alone: without its reports it localises as if it heard nothing."""
    silent, pose, report = (driven("scout_platoon", np.full((3, 2), kind)) for kind in (SILENT, POSE, REPORT))
    std = [engine.view("position_std")[:, 1] for engine in (silent, pose, report)]
    assert std[1] == pytest.approx(std[0], rel=0.2)
    assert (std[2] < 0.7 * std[0]).all()
    assert (pose.view("inbox_tick")[:, 1, 0] > 100).all() and (silent.view("inbox_tick")[:, 1, 0] <= 0).all()


def test_an_action_has_an_entry_for_every_other_vehicle() -> None:
    env = coopenv.parallel_env("scout_platoon", overrides=RADIO)
    assert env.action_space("vehicle_1").shape == (4,)
    assert [field.name for field in env.observation_layout.action] == ["speed", "steering", "radio_1", "radio_2"]


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("facade", {}, "action.radio: no vehicle receives messages of another one"),
        ("take_turns", {"v2x.links": "neighbours", "vehicles.*.neighbours": ["left_post_1"]},
         "action.radio: no vehicle receives"),
        ("take_turns", {"observer.name": "mekf"}, "observer 'mekf' runs on the host"),
    ],
)  # fmt: skip
def test_a_radio_action_without_radio(name: str, changes: dict[str, object], message: str) -> None:
    with pytest.raises(CoopenvError, match=message) as caught:
        coopenv.parallel_env(name, overrides={"action.radio": True, **changes})
    assert "\n" not in str(caught.value)
