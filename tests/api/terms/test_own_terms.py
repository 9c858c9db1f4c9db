"""Terms from outside the package: registered in a program, or named by their place in a scenario's file."""

from __future__ import annotations

import json
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp

import coopenv
from coopenv.api.terms.records import Ego, FleetRecord, Target, TruthRecord
from coopenv.base.errors import CoopenvError, ScenarioError
from coopenv.base.installation import scenario_path
from coopenv.cli.app import main
from coopenv.estimation import Outcome
from coopenv.estimation.trajectory import Trajectory
from coopenv.scenario.terms import REWARD_TERMS
from tests.helpers.four_way import FOUR_WAY


def error_again(ego: Any, truth: Any) -> Any:
    """Minus the position error, as coopenv's.

    More lines do not stand in tables.
    """
    return -truth.position_error


def control_again(ego: Any) -> Any:
    return -wp.dot(ego.action, ego.action)


@wp.func
def velocity_again(ego: Ego):
    return ego.velocity


@wp.func
def bearing_again(ego: Ego, target: Target):
    return target.bearing


def age_again(ego: Any, neighbour: Any) -> Any:
    return neighbour.age


def worst_error(ego: Any, truth: Any, fleet: Any) -> Any:
    return fleet.worst_error


def spread(ego: Any, truth: Any, fleet: Any) -> Any:
    return fleet.worst_std - fleet.mean_std


@wp.func
def under_way(ego: Ego, truth: TruthRecord, fleet: FleetRecord):
    return fleet.vehicles


def second_decision(ego: Any) -> Any:
    return ego.time > 0.15


@wp.func
def far_off(ego: Ego, truth: TruthRecord):
    return truth.position_error > 1.0e6


@pytest.fixture(scope="module", autouse=True)
def registered() -> None:
    coopenv.register_reward("error_again", error_again, unit="m")
    coopenv.register_reward("control_again", control_again)
    for name, function in {"worst_error": worst_error, "spread": spread, "under_way": under_way}.items():
        coopenv.register_reward(name, function)
    coopenv.register_observation("velocity_again", velocity_again, size=3, unit="m/s", scale="velocity_scale")
    coopenv.register_observation("bearing_again", bearing_again, per="target", size=3)
    coopenv.register_observation("age_again", age_again, per="neighbour", unit="s", scale="age_scale", low=0)
    coopenv.register_termination("second_decision", second_decision, meaning="Late enough")
    coopenv.register_termination("far_off", far_off)


OWN = {
    "reward.privileged": True,
    "reward.weights.error_again": 2.0,
    "reward.weights.control_again": 0.5,
    "observation.include": ["velocity_again", "odometry", "bearings", "bearing_again", "messages", "age_again"],
}
COPIES = {"velocity_again": "velocity", "bearing_again": "bearing", "age_again": "message_age"}


@pytest.mark.parametrize("autoreset", ["next_step", "same_step"])
def test_copies_of_built_in_terms_agree_in_a_batch(autoreset: str) -> None:
    none = dict.fromkeys(REWARD_TERMS.built_in, 0.0)
    own_weights = {**none, "control_again": 0.0, "error_again": 1.0}
    options: dict[str, Any] = {"num_worlds": 3, "autoreset": autoreset}
    own = coopenv.make_vec(FOUR_WAY, **options, overrides={**OWN, "horizon": 0.5, "reward.weights": own_weights})
    plain = {"reward": {"privileged": True, "weights": {**none, "position_error": 1.0}}, "horizon": 0.5}
    other = coopenv.make_vec(FOUR_WAY, **options, overrides=plain)
    own_layout, layout = own.observation_layout, other.observation_layout
    assert list(own_layout)[-3:] == ["velocity_again", "bearing_again", "age_again"]
    assert own_layout["bearing_again"].shape == (len(own.scenario.target_names), 3)
    assert own_layout["age_again"].shape == (3,) and own_layout["age_again"].scale == own.scenario.observation.age_scale
    rng = np.random.default_rng(0)
    steps = [(own.reset(seed=0)[0], other.reset(seed=0)[0])]
    for _ in range(12):
        actions = rng.uniform(-1, 1, own.action_space.shape).astype(np.float32)
        one, two = own.step(actions), other.step(actions)
        assert all(np.array_equal(a, b) for a, b in zip(one[1:4], two[1:4], strict=True))
        steps.append((one[0], two[0]))
    for one, two in steps:
        for copy, original in COPIES.items():
            assert np.array_equal(one[:, own_layout[copy].slice], two[:, layout[original].slice])
    assert np.any(one[:, own_layout["bearing_again"].slice])


@pytest.mark.parametrize("face", ["parallel", "vector"])
def test_conditions_of_ones_own_end_episodes(face: str) -> None:
    overrides = {"termination.second_decision": True, "termination.far_off": True, "termination.privileged": True}
    if face == "parallel":
        env = coopenv.parallel_env(FOUR_WAY, overrides=overrides)
        env.reset(seed=0)
        for terminates in (False, True):
            _, _, terminated, truncated, infos = env.step({agent: np.zeros(2, np.float32) for agent in env.agents})
            assert set(terminated.values()) == {terminates} and not any(truncated.values())
        assert {info["outcome"] for info in infos.values()} == {"second_decision"} and not env.agents
        return
    env = coopenv.make_vec(FOUR_WAY, num_worlds=2, overrides=overrides)
    env.reset(seed=0)
    ended = [env.step(np.zeros(env.action_space.shape, np.float32))[4]["ended"].tolist() for _ in range(3)]
    assert ended == [[0] * 8, [len(Outcome)] * 8, [0] * 8]  # the first own outcome; then a new episode


def test_a_reward_of_the_fleet_counts_the_vehicles_under_way() -> None:
    weights = {f"reward.weights.{name}": 1.0 for name in ("worst_error", "spread", "under_way")}
    short = {"horizon": 3.0, "termination.off_route": 0.3, "reward.privileged": True}
    env = coopenv.make_vec("open_square", num_worlds=4, autoreset="disabled", overrides={**weights, **short})
    env.reset(seed=0)
    rng, fewer = np.random.default_rng(0), False
    for _ in range(30):
        *_, infos = env.step(rng.uniform(-1, 1, (16, 2)))
        alive, error = (env.world_major(infos[name]) for name in ("alive", "position_error"))
        terms = {name: env.world_major(values) for name, values in infos["reward_terms"].items()}
        assert np.array_equal(terms["under_way"], np.broadcast_to(alive.sum(axis=1)[:, None], (4, 4)))
        for world in np.flatnonzero(alive.any(axis=1)):
            counted = error[world, alive[world]]
            assert terms["worst_error"][world] == pytest.approx(counted.max(), rel=1e-4)
            stds = env.engine.view("position_std")[world, alive[world]]
            assert terms["spread"][world] == pytest.approx(stds.max() - stds.mean(), rel=1e-3, abs=1e-6)
        fewer |= bool((alive.sum(axis=1) < 4).any())
    assert fewer


def test_conditions_that_are_off_and_terms_without_weight_cost_nothing() -> None:
    scenario = coopenv.load_scenario("crossing_path", {"termination.second_decision": False})
    assert not scenario.termination.own and "error_again" not in scenario.reward.by_name


TERMS = """
GAIN = 3.0

def error(ego, truth):
    return -GAIN * truth.position_error

def ahead(ego):
    return ego.velocity[0]

def nearest(ego, target):
    return target.age

def heard(ego, neighbour):
    return neighbour.received

def late(ego):
    return ego.time > 0.25
"""
TABLES = """
[reward.custom]
error = "my_terms.py:error"

[observation.custom]
ahead = { function = "my_terms.py:ahead", unit = "m/s", scale = "velocity_scale", meaning = "speed [m/s]" }
nearest = { function = "my_terms.py:nearest", per = "target", scale = "age_scale", low = 0 }
heard = { function = "my_terms.py:heard", per = "neighbour", low = 0 }

[termination.custom]
late = "my_terms.py:late"
"""


def scenario_file(folder: Path, tables: str, terms: str = TERMS) -> Path:
    """Write a scenario with terms of its own, and the file with their functions beside it."""
    text = scenario_path("overtaking").read_text(encoding="utf-8")
    (folder / "mine.toml").write_text(f"{text}\n{tables}", encoding="utf-8")
    (folder / "my_terms.py").write_text(terms, encoding="utf-8")
    return folder / "mine.toml"


SWITCHED_ON = {
    "reward.weights.error": 1.0,
    "reward.privileged": True,
    "observation.include": ["ahead", "nearest", "heard", "odometry", "messages"],
    "termination.late": True,
}


def test_terms_in_a_file_beside_the_scenario(tmp_path: Path) -> None:
    (tmp_path / "away").mkdir()
    path = scenario_file(tmp_path, TABLES)
    env = coopenv.parallel_env(path, overrides=SWITCHED_ON)
    env.reset(seed=0)
    layout, infos = env.observation_layout, {}
    for _ in range(3):
        observations, rewards, terminated, _, infos = env.step({a: np.zeros(2, np.float32) for a in env.agents})
    for agent, info in infos.items():
        seen = observations[agent]
        assert info["reward_terms"]["error"] == pytest.approx(-3.0 * info["position_error"], rel=1e-5)
        assert rewards[agent] == info["reward_terms"]["error"]
        assert seen[layout["ahead"].slice] == seen[layout["velocity"].slice][0] != 0.0
        assert np.array_equal(seen[layout["heard"].slice], seen[layout["message_mask"].slice])
        assert terminated[agent] and info["outcome"] == "late"
    for gain in (3.0, 4.0):  # a file that has changed is read again
        path = scenario_file(tmp_path, TABLES, TERMS.replace("3.0", str(gain)))
        batch = coopenv.make_vec(path, num_worlds=2, overrides=SWITCHED_ON)
        batch.reset(seed=0)
        first = batch.step(np.zeros(batch.action_space.shape, np.float32))
        assert first[1] == pytest.approx(-gain * first[4]["position_error"], rel=1e-5)


@pytest.mark.parametrize(
    ("terms", "message"),
    [
        ("def error(ego:\n", "my_terms.py:error' cannot be loaded: SyntaxError"),
        ("def eror(ego):\n    return 1.0\n", "no 'error' in .*my_terms.py .did you mean 'eror'"),
        ("error = 3\n", "expected a function with a name .*, got 3"),
        ("def error(ego, truth, fleet, more):\n    return 1.0\n", "takes 4 records, expected 1 or 2 or 3"),
        ("def error(ego):\n    return ego.poistion\n", "cannot compile .* to return a number: .*poistion"),
        ("def error(ego):\n    return {1: ego.time}\n", "cannot compile .* to return a number: .*Dict"),
        ("def error(ego):\n    return ego.velocity\n", "cannot compile .* to return a number: .*vec3f"),
        ("import numpy\ndef error(ego):\n    return numpy.median(ego.velocity)\n", "cannot compile .*numpy.median"),
        ("def error(ego, truth):\n    return truth.nees\n", "uses the truth: reward.privileged must be true"),
    ],
)
def test_errors_of_functions_are_one_line(terms: str, message: str, tmp_path: Path) -> None:
    path = scenario_file(tmp_path, TABLES, terms)
    with pytest.raises(CoopenvError, match=f"reward term 'error'.*{message}") as caught:
        coopenv.parallel_env(path, overrides={"reward.weights.error": 1.0})
    assert str(caught.value).isprintable()


@pytest.mark.parametrize(
    ("size", "value", "message"),
    [
        ("2", "ego.velocity", "a vector of 2: .* length 3"),
        ("1", "ego.velocity", "a number: .*vec3f"),
    ],
)
def test_a_field_of_another_size_is_refused(size: str, value: str, message: str, tmp_path: Path) -> None:
    wrong = TABLES.replace('unit = "m/s"', f"size = {size}")
    path = scenario_file(tmp_path, wrong, TERMS.replace("ego.velocity[0]", value))
    with pytest.raises(CoopenvError, match=f"observation field 'ahead': .* to return {message}"):
        coopenv.make_vec(path, num_worlds=1, overrides=SWITCHED_ON)


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ('[reward.custom]\nmine = "missing.py:mine"\nweights.mine = 1.0\n', r"mine.toml: reward.custom.weights"),
        ('[reward.custom]\nmine = "nowhere"\n', r"reward.custom.mine.function: expected file.py:name"),
        ('[reward.custom]\nprogress = "my_terms.py:error"\n', r"reward.custom.progress: .* cannot be named 'progress'"),
        ('[observation.custom]\nquality = "my_terms.py:ahead"\n', "cannot be named 'quality', which coopenv uses"),
        ('[reward.custom]\n"1st" = "my_terms.py:error"\n', "is an identifier, got '1st'"),
        ('[observation.custom]\na = { function = "a.py:a", per = "car" }\n', "'vehicle', 'target', 'neighbour'"),
        ('[observation.custom]\na = { function = "a.py:a", size = 0 }\n', "observation.custom.a.size: .*got 0"),
        ('[observation.custom]\na = { function = "a.py:a", scal = 1 }\n', r"scal: unknown key .did you mean 'scale'"),
        ('[termination]\nlaet = true\n[termination.custom]\nlate = "a.py:b"\n', "laet: unknown key"),
    ],
)
def test_errors_of_tables_are_one_line(tables: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=message) as caught:
        coopenv.load_scenario(scenario_file(tmp_path, tables))
    assert str(caught.value).isprintable() and "mine.toml" in str(caught.value)


@pytest.mark.parametrize(
    ("register", "message"),
    [
        (lambda: coopenv.register_reward("progress", control_again), "reward term cannot be named 'progress'"),
        (lambda: coopenv.register_reward("error_again", control_again), "'error_again' is registered already"),
        (lambda: coopenv.register_reward("mine", 3), "reward term 'mine': expected a function with a name .*, got 3"),
        (lambda: coopenv.register_observation("goal", velocity_again), "cannot be named 'goal'"),
        (lambda: coopenv.register_observation("mine", velocity_again, per="target"), "takes 1 records, expected 2"),
        (lambda: coopenv.register_observation("mine", velocity_again, size=99), "'mine': size: .*got 99"),
        (lambda: coopenv.register_termination("collision", far_off), "cannot be named 'collision'"),
    ],
)
def test_errors_of_registration_are_one_line(register: Any, message: str) -> None:
    with pytest.raises(CoopenvError, match=message):
        register()


def test_a_function_without_a_file_is_refused() -> None:
    program: dict[str, Any] = {}
    exec("def typed(ego):\n    return ego.time\n", program)
    coopenv.register_reward("typed", program["typed"])
    with pytest.raises(CoopenvError, match=r"reward term 'typed': .* please save it to a file"):
        coopenv.parallel_env("crossing_path", overrides={"reward.weights.typed": 1.0})


def test_a_function_that_is_defined_anew_replaces_its_former_self_in_new_worlds() -> None:
    def make(gain: float) -> Any:
        def gained(ego: Any) -> Any:
            return gain * ego.elapsed

        return gained

    envs = []
    for gain in (2.0, 5.0):
        coopenv.register_reward("gained", make(gain))
        envs.append(coopenv.make_vec("crossing_path", num_worlds=1, overrides={"reward.weights.gained": 1.0}))
        envs[-1].reset(seed=0)
    for _ in range(2):
        earned = [float(env.step(np.zeros((1, 2)))[1][0]) for env in envs]
        assert earned == pytest.approx([0.2, 0.5], rel=1e-6)


def test_recordings_are_judged_by_terms_of_ones_own_and_name_none(tmp_path: Path) -> None:
    path = scenario_file(tmp_path, TABLES)
    log = tmp_path / "drive.mcap"
    assert (
        main(["record", str(path), "--set", "horizon=0.5", "--set", "reward.weights.error=0", "--out", str(log)]) == 0
    )
    assert b"my_terms" not in log.read_bytes()
    rewards = {"reward.custom.error": f"{tmp_path}/my_terms.py:error"}
    weighed = {**rewards, "reward.weights.error": 1.0, "reward.privileged": True}
    env = coopenv.parallel_env(log, overrides=weighed, dtype="float64")
    env.reset()
    _, earned, _, _, infos = env.step({agent: np.zeros(2, np.float32) for agent in env.agents})
    for agent, info in infos.items():
        assert earned[agent] == pytest.approx(-3.0 * info["position_error"], rel=1e-5)


def test_describe_and_a_run_show_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = scenario_file(tmp_path, TABLES)
    changes = [f"--set={key}={json.dumps(value)}" for key, value in SWITCHED_ON.items()]
    assert main(["describe", str(path), *changes]) == 0
    summary = " ".join(capsys.readouterr().out.split())
    assert "Reward 1 error" in summary and "for a vehicle at late" in summary and "nearest 6" in summary
    assert main(["describe", str(path), "--all", *changes]) == 0
    whole = capsys.readouterr().out
    assert all(text in whole for text in ("custom.error *", "weights.error *", "late *", "speed [m/s]"))
    assert main(["run", str(path), *changes, "--no-figures", "--out", str(tmp_path / "out")]) == 0
    assert "2 late" in capsys.readouterr().out
    run = Trajectory.load(tmp_path / "out" / "trajectory.npz")
    column = run.terms.tolist().index("error")
    assert np.allclose(run.reward_terms[1:, :, column], -3.0 * run.position_error[1:], rtol=1e-5)


def test_the_use_of_truth_has_to_be_declared() -> None:
    with pytest.raises(ScenarioError, match=r"reward.privileged: must be true, because the reward term 'error_again'"):
        coopenv.load_scenario("crossing_path", {"reward.weights.error_again": 1.0})
    with pytest.raises(ScenarioError, match=r"termination.privileged: must be true, because the .* 'far_off'"):
        coopenv.load_scenario("crossing_path", {"termination.far_off": True})


NO_NUMBER = "(ego.time / (ego.time - ego.time))"


@pytest.mark.parametrize(
    ("face", "replaced", "message"),
    [
        ("parallel", "truth.position_error", "reward term 'error': -?nan for vehicle_1 of world 0"),
        ("vector", "ego.velocity[0]", "observation field 'ahead': -?nan for vehicle_1 of"),
    ],
)
def test_a_value_that_is_not_finite_is_an_error(face: str, replaced: str, message: str, tmp_path: Path) -> None:
    path = scenario_file(tmp_path, TABLES, TERMS.replace(replaced, NO_NUMBER))
    env: Any = (
        coopenv.parallel_env(path, overrides=SWITCHED_ON)
        if face == "parallel"
        else coopenv.make_vec(path, num_worlds=2, overrides=SWITCHED_ON)
    )
    with pytest.raises(CoopenvError, match=message):
        env.reset(seed=0)
        actions = np.zeros((4, 2), np.float32)
        env.step(dict(zip(env.agents, actions, strict=False)) if face == "parallel" else actions)


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
