"""Recordings as environments, on the device and tick by tick."""

from __future__ import annotations

import pickle
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

import coopenv
from coopenv import CoopenvError
from coopenv.api.engine import Engine
from coopenv.api.parallel_env import CooperativeLocalisationEnv as Env
from coopenv.mrclam.recording import load_dataset, recording_of
from coopenv.observers import Recording, run
from coopenv.runs import record
from coopenv.scenario import Scenario
from coopenv.sources.base import Backend, Command
from coopenv.sources.mcap import read_recording, write_recording
from coopenv.sources.tick_world import TickWorld, open_world
from coopenv.sources.worlds import Replay, Simulated
from tests.helpers import builders, mrclam_files
from tests.helpers.four_way import FOUR_WAY
from tests.helpers.recordings import simulated

CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "plain": ("busy_intersection", {}),
    "radio": ("busy_intersection", {"v2x__delay": 3, "v2x__loss": 0.4, "v2x__period": 2, "v2x__staleness": 0.2}),
    "cyclic, slow corrections": ("busy_intersection", {"topology__acyclic": False, "rates__observer": 25.0}),
    "sensed": (FOUR_WAY, {}),
    "three moving landmarks": ("crossing_path", {"rates__odometry": 37.0}),
}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    parent = tmp_path_factory.mktemp("data")
    mrclam_files.write(parent, seconds=8.0)
    return parent


@cache
def robots(parent: Path, variant: Any = "landmarks+robots") -> Recording:
    return recording_of(load_dataset("mrclam_6", parent), variant)


def replayed(recording: Recording, observer: str | None = None, **options: Any) -> Env:
    overrides = {} if observer is None else {"observer.name": observer}
    return Env(Replay(recording, "drive", overrides), "drive", **{"dtype": "float64", **options})


def play(env: Env, seed: int = 0) -> list[Any]:
    rng = np.random.default_rng(seed)
    record: list[Any] = [env.reset(seed=seed)]
    while env.agents:
        record.append(env.step({agent: rng.uniform(-1, 1, 2).astype(np.float32) for agent in env.agents}))
    return record


def same(a: Any, b: Any) -> bool:
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, float | np.ndarray):
        return np.array_equal(a, b, equal_nan=True)
    return bool(a == b)


@pytest.mark.parametrize("case", CASES)
def test_a_recorded_simulation_looks_as_it_did(case: str) -> None:
    """The kernels run on the record as they ran on the world: same observations, rewards, flags and estimates."""
    name, overrides = CASES[case]
    recording = simulated(name, 5, **overrides)
    assert recording.scenario is not None
    engines = [Engine(recording.scenario, 1, "float64")]
    backend = Replay(recording, "drive")
    engines.append(Engine(backend.scenario, 1, "float64", backend=backend))
    for engine, seed in zip(engines, (5, 77), strict=True):
        engine.reset([seed])
    first, second = engines
    for _ in range(recording.scenario.horizon_ticks // 6 + 1):
        for field in ("observation", "reward"):
            assert_allclose(second.view(field), first.view(field), atol=1e-6, err_msg=field)
        for field in ("alive", "terminated", "truncated", "tick", "inbox_tick", "bearing_tick", "sight"):
            assert np.array_equal(first.view(field), second.view(field)), field
        for field in ("estimate_rotation", "estimate_position", "covariance", "nees", "position_error"):
            assert_allclose(second.view(field), first.view(field), rtol=1e-9, atol=1e-12, err_msg=field)
        for engine in engines:
            engine.step(np.zeros((1, len(recording.setups), 2)))
    assert first.view("over")[0] == 1


@pytest.mark.parametrize("observer", ["riccati", "mekf", "centralised"])
def test_observers_in_the_replay_do_as_in_the_runner(observer: str) -> None:
    recording = simulated(v2x__delay=2, v2x__loss=0.3)
    result, step = run(observer, recording), 6
    assert not result.failure
    for k, (*_, infos) in enumerate(play(replayed(recording, observer))[1:], start=1):
        for i, agent in enumerate(infos):
            estimate = infos[agent]["estimate"]
            assert_allclose(estimate["position"], result.position[step * k, i], atol=1e-9)
            assert_allclose(estimate["rotation"], result.rotation[step * k, i], atol=1e-9)


def test_a_record_runs_no_code_of_a_driver(tmp_path: Path) -> None:
    code = tmp_path / "mine.py"
    code.write_text("def drive(observations):\n    return [[0.1, 0.1]] * len(observations)\n")
    driven = {"vehicles.0.motion.driver": f"{code}:drive", "horizon": 1.0}
    write_recording(record(coopenv.load_scenario("facade", driven)), tmp_path / "drive.mcap")
    code.write_text("raise RuntimeError('code of a record runs')\n")
    assert coopenv.run(tmp_path / "drive.mcap").metrics["policy"] == "recorded"


def test_actions_and_seeds_change_nothing(data: Path) -> None:
    env = replayed(robots(data))
    for first, second in zip(play(env, 1), play(env, 2), strict=True):
        assert same(first[0], second[0])
        assert same(*({a: {**info, "reward_terms": {}} for a, info in step[-1].items()} for step in (first, second)))


def test_unknown_truth_stays_out_of_rewards_and_state(data: Path) -> None:
    whole = robots(data)
    position, rotation = whole.truth.position.copy(), whole.truth.rotation.copy()
    position[40:], rotation[40:] = np.nan, np.nan
    blind = replace(whole, truth=replace(whole.truth, position=position, rotation=rotation))
    weights = {"reward.privileged": True, "reward.weights.position_error": 1.0, "reward.weights.orientation_error": 1.0}
    env = Env(Replay(blind, "drive", weights), "drive", dtype="float64")
    other = Env(Replay(whole, "drive", weights), "drive", dtype="float64")
    for k, (a, b) in enumerate(zip(play(env), play(other), strict=True)):
        assert same(a[0], b[0])  # observations
        if k > 0:
            assert (a[1] == b[1]) is (k < 20) and np.isfinite(list(a[1].values())).all()
            assert np.isnan(a[4]["vehicle_1"]["position_error"]) == (k >= 20)
    assert np.isfinite(env.state()).all()


def test_a_replay_is_drawn_and_saved_like_any_other(data: Path) -> None:
    env = replayed(robots(data), render_mode="rgb_array")
    env.reset(seed=0)
    env.step({agent: np.zeros(2) for agent in env.agents})
    picture = env.render()
    assert picture is not None and picture.std() > 1
    twin = pickle.loads(pickle.dumps(env))
    state = env.get_state()
    actions = {agent: np.zeros(2) for agent in env.agents}
    first = env.step(actions)
    env.set_state(state)
    assert same(first, env.step(actions)) and same(first, twin.step(actions))


def test_recorded_keys_cannot_be_overridden(data: Path) -> None:
    options: dict[str, Any] = {"data": data, "backend": "replay"}
    short = coopenv.parallel_env("mrclam_6", overrides={"horizon": 2.0, "observer.k": 2.0}, **options)
    assert short.scenario.horizon_ticks == 40 and short.scenario.observer.k == 2.0
    for overrides, why in (
        ({"noise.enabled": False}, "override 'noise.enabled': mrclam_6 is recorded"),
        ({"horizon": 1000.0}, r"horizon: 1000 s are more than mrclam_6 has \(7.35 s\)"),
        ({"observer.k": 0.1}, "observer.k|k > 0.5"),
        ({"observer.name": "meckf"}, "did you mean 'mekf'"),
    ):
        with pytest.raises(CoopenvError, match=why):
            coopenv.parallel_env("mrclam_6", overrides=overrides, **options)


def test_names(data: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("COOPENV_DATA", raising=False)
    for arguments, why in (
        (("mrclam_6",), "mrclam_6: name its folder with --data DIR or COOPENV_DATA"),
        (("mrclam_scene",), "unknown environment 'mrclam_scene'"),
        (("mrclam_66",), "unknown data set 'mrclam_66' .did you mean 'mrclam_6'"),
        ((tmp_path / "none.mcap",), "none.mcap: cannot be read"),
    ):
        with pytest.raises(CoopenvError, match=why):
            coopenv.parallel_env(*arguments)
    for name in ("drive.mcap", "mrclam_6"):
        with pytest.raises(CoopenvError, match=f"'{name}' is recorded.*parallel_env"):
            coopenv.make_vec(name, num_worlds=2)
    shutil.copy(Path(__file__).parents[2] / "envs" / "overtaking.toml", tmp_path / "mrclam_scene.toml")
    monkeypatch.chdir(tmp_path)
    assert coopenv.parallel_env("mrclam_scene.toml").possible_agents == ["vehicle_1", "vehicle_2"]
    for options, why in (
        ({"backend": "replay"}, "'busy_intersection' is no recording; known: FILE.mcap, mrclam_1 .. mrclam_9"),
        ({"backend": "reply"}, r"unknown backend 'reply' \(did you mean 'replay'\?\); known: simulated, highway, sumo"),
        ({"variant": "blind"}, "variant is for recorded data, 'busy_intersection' is simulated"),
        ({"data": data}, "data is for recorded data"),
    ):
        with pytest.raises(CoopenvError, match=why):
            coopenv.parallel_env("busy_intersection", **options)
    with pytest.raises(CoopenvError, match=r"unknown variant 'blindd'.*did you mean 'blind'"):
        coopenv.parallel_env("mrclam_6", data=data, variant="blindd")
    monkeypatch.setenv("COOPENV_DATA", str(data))
    assert coopenv.parallel_env("mrclam_6", variant="blind").scenario.title == "mrclam_6"


def test_recordings_without_a_scenario_are_refused(data: Path) -> None:
    whole = robots(data)
    gains = replace(whole.setups[2].gains, V=(1.0, 2.0))
    other = replace(whole, setups=(*whole.setups[:2], replace(whole.setups[2], gains=gains), *whole.setups[3:]))
    arm = replace(whole, setups=(*whole.setups[:4], replace(whole.setups[4], lever_arm=np.ones(3))))
    due = whole.due.copy()
    due[5:9] = False
    for recording, why in (
        (other, "vehicle_3 has other gains than vehicle_1"),
        (arm, "the camera of vehicle_5 sits elsewhere"),
        (replace(whole, due=due), "not due at a fixed rate"),
    ):
        with pytest.raises(CoopenvError, match=f"drive: .*{why}"):
            replayed(recording)


def everything_drawn() -> Scenario:
    """Routes that go on, landmarks and vehicles that may be absent, and parameters."""
    routes = [{"name": f"r{k}", "waypoints": [[2.0 * k, 0], [2.0 * k + 2.0, 0]], "wander": 0.1} for k in range(9)]
    routes.append({"name": "on", "waypoints": [[18, 0], [50, 0], [50, 40], [18, 40], [18, 0.1]], "corner_radius": 5.0})
    car = {"motion": {"kind": "driven", "initial_speed": 0.5}, "body": {"size": [0.5, 0.2, 0.2]}}
    group = {
        "name": "g",
        "count": 6,
        "boxes": [{"center": [4, 4], "half": [4, 1]}],
        "height": [0.5, 1.0],
        "presence": 0.7,
    }
    return builders.scenario(
        [
            {"routes": ["r0"], **car},
            {"routes": ["r2"], "presence": 0.5, **car},
            {"routes": ["r4"], "presence": 0.5, **car},
        ],
        routes=routes,
        landmark_groups=[group],
        termination={"after_arrival": "continue", "collision": False},
        randomisation={"camera_range": [0.3, 1.0], "landmark_presence": [0.5, 1.0]},
        camera={"orientation": "body", "range": 8.0},
        topology={"mode": "sensed"},
        observation={"include": ["estimate", "goal", "bearings", "map", "route"]},
        horizon=5.0,
    )


def test_draws_are_repeated_and_go_through_a_file(tmp_path: Path) -> None:
    made = everything_drawn()
    recording = record(made, seed=2**31 + 3)
    write_recording(recording, tmp_path / "drive.mcap")
    stored = read_recording(tmp_path / "drive.mcap")
    assert stored.drawn == recording.drawn
    env, again = Env(made, "drive", dtype="float64"), replayed(stored)
    env.reset(seed=2**31 + 3)
    again.reset(seed=5)
    names = ("goal", "route", "route_count", "route_drawn", "present", "arrivals", "parameter", "observation")
    decisions = 0
    while env.agents:
        for name in names:
            assert_allclose(env.engine.view(name), again.engine.view(name), atol=1e-9, err_msg=name)
        for drive in (env, again):
            drive.step({agent: np.zeros(2, np.float32) for agent in drive.agents})
        decisions += 1
    assert decisions == 50
    assert env.engine.view("arrivals").max() >= 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"key": -1}, "drawn.key: -1 is not in 0"),
        ({"episode": 2**32}, "drawn.episode"),
        ({"parameters": (1.0,)}, "drawn.parameters: not 12 numbers"),
        ({"parameters": (-1.0,) * 12}, "drawn.parameters: -1.0 is not in 0"),
    ],
)
def test_draws_of_a_recording_are_checked(change: dict[str, Any], message: str) -> None:
    recording = simulated()
    assert recording.drawn is not None
    with pytest.raises(CoopenvError, match=message):
        Replay(replace(recording, drawn=replace(recording.drawn, **change)), "drive")


TICK_CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "radio": ("busy_intersection", {"v2x.delay": 2, "v2x.loss": 0.2, "v2x.period": 2, "v2x.staleness": 0.2}),
    "driven": (FOUR_WAY, {"dynamics.latency": 0.05}),
    "accelerations": (FOUR_WAY, {"action.longitudinal": "acceleration"}),
    "slow corrections": ("crossing_path", {"rates.observer": 25.0, "rates.odometry": 37.0}),
    "robust": ("busy_intersection", {"observer.name": "robust"}),
    "plug-in": ("busy_intersection", {"observer.name": "mekf", "v2x.loss": 0.2}),
}
EXACT = ("tick", "inbox_tick", "bearing_tick", "odometry_samples", "alive", "terminated", "truncated")
CLOSE = ("observation", "reward", "collided", "estimate_rotation", "estimate_position", "covariance", "position_error")


def tick_by_tick(backend: Any) -> Backend:
    """Return a backend that does not make worlds itself."""
    backend.capabilities = replace(backend.capabilities, batched=False)
    return backend


@pytest.mark.parametrize("case", TICK_CASES)
def test_a_simulated_world_given_tick_by_tick_is_the_one_on_the_device(case: str) -> None:
    name, overrides = TICK_CASES[case]
    scenario = coopenv.load_scenario(name, {"horizon": 1.0, **overrides})
    engines = [Engine(scenario, 1, "float64")]
    engines.append(Engine(scenario, 1, "float64", backend=tick_by_tick(Simulated(scenario))))
    assert isinstance(engines[1].world, TickWorld) and not isinstance(engines[0].world, TickWorld)
    rng = np.random.default_rng(0)
    for seeds in ([5], None):  # and the next episode of that seed
        for engine in engines:
            engine.reset(seeds)
        for _ in range(11):
            first, second = engines
            for field in EXACT:
                assert np.array_equal(first.view(field), second.view(field)), field
            for field in CLOSE:
                assert_allclose(second.view(field), first.view(field), rtol=1e-6, atol=1e-9, err_msg=field)
            actions = rng.uniform(-1, 1, (1, len(scenario.vehicles), 2))
            for engine in engines:
                engine.step(actions)


@pytest.mark.parametrize("observer", ["riccati", "mekf"])
def test_a_recording_given_tick_by_tick_is_the_one_on_the_device(observer: str) -> None:
    recording = simulated("busy_intersection", 3, v2x__loss=0.3)
    options = {"observer.name": observer}
    backends = [Replay(recording, "drive", options), tick_by_tick(Replay(recording, "drive", options))]
    engines = [Engine(backend.scenario, 1, "float64", backend=backend) for backend in backends]
    for engine in engines:
        engine.reset([3])  # whose initial estimates the recording has
    for _ in range(11):
        for field in EXACT:
            assert np.array_equal(engines[0].view(field), engines[1].view(field)), field
        for field in CLOSE:
            assert_allclose(engines[1].view(field), engines[0].view(field), rtol=1e-6, atol=1e-9, err_msg=field)
        for engine in engines:
            engine.step(np.zeros((1, len(recording.setups), 2)))
    assert backends[1].health.ticks == recording.ticks


def test_a_recording_of_a_recording_is_the_recording() -> None:
    recording = simulated(FOUR_WAY, 1, v2x__loss=0.2)
    for backend in (Replay(recording, "drive"), tick_by_tick(Replay(recording, "drive"))):
        again = record(backend, 1)
        for name in ("rotation", "translation", "velocity", "bearings", "visible", "landmarks", "inbox_tick", "due"):
            assert np.array_equal(getattr(again, name), getattr(recording, name), equal_nan=True), name
        assert_allclose(again.truth.position, recording.truth.position, atol=1e-12)
        assert_allclose(again.start_position, recording.start_position, atol=1e-12)


def test_commands_and_their_rows() -> None:
    rows = np.arange(10.0).reshape(2, 5)
    for columns in (5, 4, 3):
        command = Command.of(rows[:, :columns])
        assert command.speed.tolist() == [0, 5] and command.turn.tolist() == command.steering.tolist() == [1, 6]
        assert command.acceleration.tolist() == [2, 7]
        assert np.array_equal(command.rows, np.where(np.arange(5) < columns, rows, 0.0))


def test_ticks_are_for_one_world_on_the_cpu() -> None:
    backend = tick_by_tick(Simulated(coopenv.load_scenario("overtaking")))
    with pytest.raises(CoopenvError, match="backend Simulated gives the ticks of one world to the CPU, not of 3 "):
        open_world(backend, 3, "float32", "cpu", None)


def test_a_stopped_source_has_no_more_ticks() -> None:
    scenario = coopenv.load_scenario("overtaking", {"horizon": 1.0})
    backend = Simulated(scenario)
    first = backend.reset(0, {})
    command = Command.of(np.zeros((2, 3)))
    ticks = list(backend.advance(command))
    assert (first.index, [tick.index for tick in ticks]) == (0, [1, 2, 3, 4, 5, 6])
    assert backend.clock == pytest.approx(0.1) and backend.health.ticks == 7
    backend.stop("enough")
    backend.stop("enough")
    assert list(backend.advance(command)) == []
    assert backend.reset(0, {}).index == 0
    assert len([tick for _ in range(12) for tick in backend.advance(command)]) == scenario.horizon_ticks
