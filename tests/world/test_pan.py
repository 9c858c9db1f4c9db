"""A camera that pans: how it turns, what it sees, who knows the angle, and that nobody else need care."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

import coopenv
from coopenv.api.engine import Engine
from coopenv.api.terms.layout import observation_layout
from coopenv.backends.mcap.reader import read_recording
from coopenv.backends.mcap.writer import write_recording
from coopenv.backends.replay import Replay
from coopenv.base.errors import ActionError, ScenarioError
from coopenv.estimation.outcomes import Sight
from coopenv.policies.base import decide, random_policy, zero_policy
from coopenv.runs import record
from coopenv.scenario import load_scenario
from tests.helpers.builders import run, same_bits, scenario, simulate, start, vehicle
from tests.helpers.four_way import FOUR_WAY
from tests.helpers.warp_calls import DTYPES

PAN = {"limit": 1.2, "rate": 0.9}
DRIVEN = {"kind": "driven"}
FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
CROSSING: dict[str, Any] = {
    "action.pan": PAN,
    "observation.include": ["estimate", "quality", "bearings", "odometry", "messages", "goal", "pan"],
}


def pans(world: Any, levels: Any) -> None:
    """Stand still and ask for pan angles, levels (N,)."""
    actions = np.zeros((world.worlds, world.model.vehicles, 3))
    actions[..., 0], actions[..., 2] = -1.0, levels
    world.actions.assign(actions.astype(world.precision.numpy))


@pytest.mark.parametrize("dtype", DTYPES)
def test_it_turns_at_its_rate_up_to_its_limit(dtype: str) -> None:
    made = scenario([vehicle(motion=DRIVEN), vehicle((2, -1, 0.5), motion=DRIVEN)], action={"pan": PAN})
    world = start(made, 0, dtype)
    pans(world, [0.5, -2.0])
    angles = np.array([state["pan"][0] for state in run(world, 120)], float)
    time = np.arange(121) / 60
    assert_allclose(angles[:, 0], np.minimum(0.9 * time, 0.6), atol=1e-5)
    assert_allclose(angles[:, 1], -np.minimum(0.9 * time, 1.2), atol=1e-5)


def test_the_last_action_and_its_price_hold_the_angle_that_was_asked_for() -> None:
    """Two entries without a pan, three with one; `control` is minus the square of them all."""
    actions = np.array([[0.3, -0.4, 0.5]] * 4)
    for given, size in (({}, 2), ({"action.pan": PAN}, 3)):
        made = load_scenario("urban_crossing", {**given, "observation.include": ["self"]})
        engine = Engine(made, 1)
        engine.reset([0])
        engine.step(actions[None, :, :size])
        observed = engine.layout["last_action"].values(engine.view("observation")[0])
        assert_allclose(observed, actions[:, :size], atol=1e-6)
        control = engine.view("terms")[0][:, engine.reward_terms.index("control")]
        assert_allclose(control, -np.sum(actions[:, :size] ** 2, axis=1), rtol=1e-5)


def test_dead_time_holds_for_it_too() -> None:
    made = scenario([vehicle(motion=DRIVEN)], action={"pan": PAN}, dynamics={"latency": 0.05})
    world = start(made)
    pans(world, 1.0)
    angles = np.array([state["pan"][0, 0] for state in run(world, 6)])
    assert_allclose(angles, 0.9 / 60 * np.array([0, 0, 0, 0, 1, 2, 3]), atol=1e-12)


def test_it_sees_as_a_camera_that_is_mounted_so() -> None:
    """Same sights, and the same bearings in the body frame, distortion, pixels and mounting error included."""
    camera = {
        "model": "pinhole",
        "position": [0.3, 0.1, 0.2],
        "distortion": [-0.35, 0.14, 0.002, 0.0006, 0.0],
        "quantise": True,
        "extrinsics_error": 0.05,
    }
    sensed = {"topology": {"mode": "sensed"}, "noise": {"bearing": {"scale": 0.01}}, "camera": camera}
    turned = Rotation.from_euler("z", 0.9).as_matrix() @ FORWARD
    quaternion = Rotation.from_matrix(turned).as_quat(scalar_first=True).tolist()
    marks = [
        {"name": f"L{i}", "position": [3.0 * np.cos(a), 3.0 * np.sin(a), 0.6]}
        for i, a in enumerate(np.linspace(0, 2 * np.pi, 24, endpoint=False))
    ]
    panned = start(scenario([vehicle(motion=DRIVEN)], landmarks=marks, action={"pan": PAN}, **sensed), 5)
    fixed = scenario([vehicle(motion=DRIVEN, camera={"orientation": quaternion})], landmarks=marks, **sensed)
    mounted = start(fixed, 5)
    pans(panned, 0.75)
    mounted.actions.assign(np.array([[[-1.0, 0.0]]], dtype=mounted.precision.numpy))
    for world in (panned, mounted):
        world.advance(60)
    a, b = panned.get_state(), mounted.get_state()
    assert_array_equal(a["sight"], b["sight"])
    seen = a["sight"][0, 0] == Sight.VISIBLE
    assert 3 <= seen.sum() <= 6 and not seen[0] and seen[3]  # 73 deg, ahead is out of view
    assert_allclose(a["bearing"][0, 0, seen] @ FORWARD.T, b["bearing"][0, 0, seen] @ turned.T, atol=1e-9)


def test_without_it_nothing_changes() -> None:
    """With a pan of zero, truth, bearings and estimates are what they are without the third entry."""
    plain, able = (simulate(load_scenario(FOUR_WAY, given), 2) for given in ({}, {"action.pan": PAN}))
    for world, size in ((plain, 2), (able, 3)):
        world.reset([3, 4])
        actions = np.random.default_rng(0).uniform(-1, 1, (2, 4, 2))
        world.actions.assign(np.concatenate([actions, np.zeros((2, 4, size - 2))], axis=-1))
        world.advance(120)
    a, b = plain.get_state(), able.get_state()
    for name in a:
        if name not in ("action", "actions"):
            assert same_bits(a[name], b[name]), name


@pytest.mark.parametrize("observer", ["robust", "mekf_covariance"])
def test_estimates_stay_consistent_while_it_pans(observer: str) -> None:
    """Embedded and plug-in observers are told bearings in the body frame: ANEES over six stays about one."""
    worlds = 24 if observer == "robust" else 4
    starts = {"vehicles.*.initial_estimate": {"position_radius": 0.05, "orientation_angle": 0.02}}
    given = {**CROSSING, **starts, "action.longitudinal": "speed", "horizon": 8.0}
    env = coopenv.make_vec(FOUR_WAY, num_worlds=worlds, observer=observer, dtype="float64", overrides=given)
    env.reset(seed=11)
    generator, nees = np.random.default_rng(1), []
    for step in range(70):
        if step % 10 == 0:
            actions = generator.uniform(-1, 1, (4 * worlds, 3))
            actions[:, 0], actions[:, 1] = -0.7, actions[:, 1] * 0.2
        env.step(actions)
        if step >= 20:
            nees.append(np.array(env.engine.view("nees")))
    assert np.abs(env.engine.view("pan")).max() > 0.9
    assert 0.5 < np.mean(nees) / 6 < 1.5, np.mean(nees) / 6
    env.close()


def test_an_action_has_three_entries_everywhere() -> None:
    env = coopenv.parallel_env(FOUR_WAY, overrides=CROSSING)
    observations, _ = env.reset(seed=0)
    assert env.action_space("vehicle_1").shape == (3,)
    layout = env.observation_layout
    assert [(f.name, f.low, f.high) for f in layout.action][2] == ("pan", -1.2, 1.2)
    for _ in range(10):
        observations, *_ = env.step({agent: np.array([-1.0, 0.0, 0.5]) for agent in env.agents})
    assert observations["vehicle_1"][layout["camera_pan"].slice] == pytest.approx([0.5], abs=1e-5)
    with pytest.raises(ActionError, match=r"shape \(2,\), expected \(3,\)"):
        env.step({agent: np.zeros(2) for agent in env.agents})
    vec = coopenv.make_vec(FOUR_WAY, num_worlds=2, overrides=CROSSING)
    vec.reset(seed=0)
    assert vec.action_space.shape == (8, 3)
    vec.step(vec.action_space.sample())
    with pytest.raises(ActionError, match=r"expected \(8, 3\)"):
        vec.step(np.zeros((8, 2)))
    rows = np.stack(list(observations.values()))
    for policy in (zero_policy(0, 3), random_policy(0, 3)):
        assert decide(policy, rows, 3).shape == (4, 3)


def test_a_recording_replays_to_the_same_observations(tmp_path: Path) -> None:
    made = load_scenario(FOUR_WAY, {**CROSSING, "horizon": 3.0})
    policy = lambda observations: np.tile([-0.5, 0.1, 0.8], (len(observations), 1))  # noqa: E731
    recording = record(made, 3, policy)
    assert recording.pan is not None and recording.pan.max() > 0.9
    write_recording(recording, tmp_path / "pan.mcap")
    read = read_recording(tmp_path / "pan.mcap")
    assert read.pan is not None
    assert_array_equal(read.pan, recording.pan)
    replay = Replay(read, "pan").world(1, "float64", "cpu", 1)
    replay.reset([0])
    simulated = simulate(made, 1)
    simulated.reset([3])
    for _ in range(20):
        simulated.actions.assign(np.tile([-0.5, 0.1, 0.8], (1, 4, 1)))
        simulated.advance(made.ticks_per_decision)
        replay.advance(made.ticks_per_decision)
    a, b = simulated.get_state(), replay.get_state()
    for name in ("pan", "estimate_position", "estimate_rotation"):
        assert_allclose(a[name], b[name], atol=1e-9, err_msg=name)
    seen = a["sight"] == Sight.VISIBLE
    assert seen.any()
    assert_allclose(a["bearing"][seen], b["bearing"][seen], atol=1e-9)


def test_what_is_impossible_is_named() -> None:
    for given, word in (({"limit": 4.0, "rate": 1.0}, "action.pan.limit"), ({"limit": 1.0}, "action.pan.rate")):
        with pytest.raises(ScenarioError, match=word):
            scenario([vehicle(motion=DRIVEN)], action={"pan": given})
    assert len(observation_layout(scenario([vehicle(motion=DRIVEN)])).action) == 2
