"""A source of ticks that shares nothing with the simulator is an environment like any other: real cars will be too."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import coopenv
from coopenv import CoopenvError
from coopenv.api.engine import Engine
from coopenv.observers import Message, Received, register, registry, run
from coopenv.observers.pose_filters import DeadReckoning
from coopenv.observers.recording import check_recording
from coopenv.observers.sensed import Sensed
from coopenv.policies import load_policy
from coopenv.runs import record
from coopenv.sources.base import VehicleBroadcast
from coopenv.world.launch import kernel
from tests.helpers.env_suite import CHECKS, Env, Make, official_tests, rollout
from tests.helpers.fleet import CAMERA, MAX_SPEED, MAX_STEERING, Fleet

OBSERVERS = ("riccati", "robust", "mekf")
TICKS = 3
"""Per decision."""


def make(backend: Fleet, **options: Any) -> Env:
    return coopenv.parallel_env("fleet", backend=backend, **options)


def of(observer: str) -> Make:
    return lambda **options: make(Fleet(observer), **options)


def forwards(env: Env, speed: float = 0.4) -> dict[str, np.ndarray]:
    return {agent: np.array([speed, 0.2]) for agent in env.agents}


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_a_source_passes_the_suite_of_environments(check: Callable[[Make], None]) -> None:
    check(of("riccati"))


@pytest.mark.parametrize("observer", OBSERVERS[1:])
def test_other_observers_pass_the_official_tests(observer: str) -> None:
    official_tests(of(observer))


@pytest.mark.parametrize(
    ("observer", "dtype"),
    [
        ("riccati", "float64"),
        ("robust", "float32"),
        pytest.param("robust", "float64", marks=pytest.mark.slow),
        pytest.param("mekf", "float64", marks=pytest.mark.slow),
    ],
)
def test_vehicles_find_out_where_they_are(observer: str, dtype: str) -> None:
    env = make(Fleet(observer), dtype=dtype)
    last = rollout(env, 2, 100)[-1]
    for info in last[-1].values():
        assert info["position_error"] < 0.1 and info["orientation_error"] < 3.0


def test_options_that_it_does_not_read_are_refused() -> None:
    class Windy(Fleet):
        options = ("wind",)

    with pytest.raises(CoopenvError, match="unknown option 'wind'; known: none"):
        make(Fleet()).reset(seed=0, options={"wind": 1.0})
    with pytest.raises(CoopenvError, match=r"unknown option 'wnd' \(did you mean 'wind'"):
        make(Windy()).reset(seed=0, options={"wnd": 1.0})
    make(Windy()).reset(seed=0, options={"wind": 1.0})


def test_commands_are_in_si_units() -> None:
    fleet = Fleet()
    env = make(fleet)
    env.reset(seed=0)
    actions = [(0.5, -1.0), (-1.0, 0.4), (3.0, 0.0)]  # the last one is clipped
    for speed, steering in actions:
        env.step({agent: np.array([speed, steering], np.float32) for agent in env.agents})
    given = fleet.commands[::TICKS]
    assert len(fleet.commands) == TICKS * len(actions)
    assert all(command is fleet.commands[n - n % TICKS] for n, command in enumerate(fleet.commands))
    for command, (speed, steering) in zip(given, np.clip(actions, -1.0, 1.0), strict=True):
        assert_allclose(command.speed, [(speed + 1.0) / 2.0 * MAX_SPEED] * 3, atol=1e-6)
        assert_allclose(command.steering, [steering * MAX_STEERING] * 3, atol=1e-6)
        assert_allclose(command.acceleration, [2.0] * 3)


def test_an_arrived_vehicle_is_commanded_to_stand() -> None:
    fleet = Fleet()
    env = make(fleet)
    env.reset(seed=0)
    while "vehicle_1" in env.agents:
        _, _, terminated, *_ = env.step({agent: np.array([0.5, 0.0]) for agent in env.agents})
    assert terminated["vehicle_1"] and fleet.commands[-1].speed[0] > 0.5
    env.step({agent: np.array([0.5, 0.0]) for agent in env.agents})
    assert fleet.commands[-1].speed[0] == 0.0 and fleet.commands[-1].speed[1] > 0.5


def test_late_missing_and_empty_ticks_are_reported() -> None:
    fleet = Fleet()
    env = make(fleet)
    _, infos = env.reset(seed=0)
    assert all(info["late_ticks"] == info["missing_ticks"] == 0 for info in infos.values())
    for decision in range(40):
        *_, infos = env.step(forwards(env))
        ticks = range(TICKS * decision + 1, TICKS * decision + TICKS + 1)
        for i, info in enumerate(infos.values()):
            assert info["late_ticks"] == sum(int(fleet.late(k)[i]) for k in ticks)
            assert info["missing_ticks"] == sum(int(fleet.missing(k)[i]) for k in ticks)
            if fleet.empty(ticks[-1])[i] or fleet.missing(ticks[-1])[i]:
                assert info["visible"] == ()
    total = {word: sum(int(getattr(fleet, word)(k).sum()) for k in range(121)) for word in ("late", "missing", "empty")}
    health = env.health
    assert (health.ticks, health.late, health.missing) == (121, total["late"], total["missing"])
    assert health.empty == total["empty"] > 0 and total["late"] > 10 and total["missing"] > 10


def test_without_a_tick_the_last_odometry_goes_on() -> None:
    fleet = Fleet("dead_reckoning")
    engine = Engine(fleet.scenario, 1, "float64", backend=fleet)
    engine.reset([0])
    engine.set_actions(np.full((1, 3, 2), 0.5))
    missed = 0
    for k in range(1, 60):
        v, w = (engine.view(f"odometry_{name}")[0].copy() for name in ("velocity", "angular_velocity"))
        R, samples = engine.view("estimate_rotation")[0].copy(), engine.view("odometry_samples")[0].copy()
        engine.step(ticks=1)
        assert np.isfinite(engine.view("observation")).all()
        for i in np.flatnonzero(fleet.missing(k)):
            missed += 1
            turned = Rotation.from_rotvec(w[i] / CAMERA).as_matrix()
            assert_allclose(engine.view("increment_rotation")[0, i], turned, atol=1e-12)
            assert_allclose(engine.view("estimate_rotation")[0, i], R[i] @ turned, atol=1e-9)
            length = np.linalg.norm(engine.view("increment_translation")[0, i])
            assert length == pytest.approx(np.linalg.norm(v[i]) / CAMERA, rel=1e-2)
            assert engine.view("odometry_samples")[0, i] == samples[i]  # its age grows
            assert_allclose(engine.view("odometry_velocity")[0, i], v[i])
    assert missed > 5


@pytest.mark.parametrize("observer", ["riccati", "mekf"])
@pytest.mark.parametrize("ticks", [1, 8, 10])  # at once, within a decision, with one
def test_a_source_that_ends_truncates(observer: str, ticks: int) -> None:
    env = make(Fleet(observer, ticks=ticks))
    env.reset(seed=0)
    steps = 0
    while env.agents:
        _, _, terminated, truncated, infos = env.step(forwards(env))
        steps += 1
    assert steps == (ticks - 1) // TICKS + 1
    assert all(truncated.values()) and not any(terminated.values())
    assert all(info["time"] == pytest.approx((ticks - 1) / CAMERA) for info in infos.values())
    assert env.step({}) == ({}, {}, {}, {}, {})
    env.reset()
    assert env.agents


def test_unknown_truth_stays_out() -> None:
    weights = {"progress": 1.0, "position_error": 1.0, "orientation_error": 1.0, "time": 1.0}
    reward = {"privileged": True, "weights": weights}
    env = make(Fleet(truth=False, reward=reward, termination={"collision": True}))
    for step in rollout(env, 0, 100)[1:]:
        for agent, info in step[-1].items():
            assert np.isfinite(step[0][agent]).all()
            assert np.isnan(info["truth"]["position"]).all() and np.isnan(info["position_error"])
            assert all(
                info["reward_terms"][name] == 0.0 for name in ("progress", "position_error", "orientation_error")
            )
            assert step[1][agent] == pytest.approx(-1.0 / 10.0)
            assert not step[2][agent]
    assert np.isfinite(env.state()).all() and env.health.missing > 0


def test_failures_and_closing_stop_the_source(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_registered", {})

    class Failing(DeadReckoning):
        def update(self, tick: Any) -> Any:
            raise ZeroDivisionError("no gain")

    register("failing_in_the_fleet", Failing)
    for observer, action, error in (
        ("failing_in_the_fleet", [0.0, 0.0], "ZeroDivisionError: no gain"),
        ("riccati", [np.nan, 0.0], "not finite"),
    ):
        fleet = Fleet(observer)
        env = make(fleet)
        env.reset(seed=0)
        with pytest.raises(CoopenvError, match=error):
            env.step({agent: np.array(action) for agent in env.agents})
        assert error in fleet.reasons[-1]
    env.close()
    env.close()
    assert fleet.reasons[-1] == "closed"


class Broken(Fleet):
    """Gives one tick that is changed."""

    def __init__(self, change: Callable[[Sensed], Sensed]) -> None:
        super().__init__()
        self._change = change

    def tick(self, k: int, *arguments: Any) -> Sensed:
        tick = super().tick(k, *arguments)
        return self._change(tick) if k == 5 else tick


def nan_at(tick: Sensed, name: str) -> Sensed:
    values = getattr(tick, name).copy()
    values[1] = np.nan
    return replace(tick, **{name: values})


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda tick: replace(tick, index=7), "index: got 7"),
        (lambda tick: replace(tick, dt=np.nan), "dt: expected 0.0"),
        (lambda tick: replace(tick, time=-1.0), "time: expected s since the reset, got -1.0"),
        (lambda tick: replace(tick, rotation=2.0 * tick.rotation), "rotation of vehicle_1: not a rotation"),
        (lambda tick: nan_at(tick, "translation"), "translation of vehicle_2: not finite"),
        (lambda tick: replace(tick, bearings=tick.bearings * 1.1), "bearings of vehicle_1: not unit vectors"),
        (lambda tick: replace(tick, visible=tick.visible[:, :4]), r"visible: expected an array of shape \(3, 9\)"),
        (lambda tick: replace(tick, landmarks=tick.landmarks * 1e12), "landmarks: not finite"),
        (lambda tick: replace(tick, odometry_age=np.array([0, -1, 0])), "odometry_age of vehicle_2: not a number of"),
        (lambda tick: replace(tick, inbox_tick=np.full((3, 3), 99)), "inbox_tick of vehicle_1: not -1"),
        (lambda tick: replace(tick, late=[0, 0, 1]), "late: expected an array"),
        (lambda tick: replace(tick, truth=replace(tick.truth, position=np.zeros(3))), "truth.position: expected"),
        (lambda tick: replace(tick, messages={(0, 1): None}), "inbox_tick says"),
    ],
)
def test_ticks_are_checked(change: Any, why: str) -> None:
    fleet = Broken(change)
    env = make(fleet)
    env.reset(seed=0)
    env.step(forwards(env))
    with pytest.raises(CoopenvError, match=f"backend Broken: tick 5: .*{why}"):
        env.step(forwards(env))
    assert why.split(":")[0] in fleet.reasons[-1]
    env.reset(seed=0)
    assert env.agents


class Neighbourly(Fleet):
    """The first vehicle is estimated elsewhere: the third hears the truth from it, at half of the ticks."""

    def __init__(self, observer: str, **extra: np.ndarray) -> None:
        super().__init__(observer)
        self._extra = extra
        self.said: dict[str, Any] = {}

    def tick(self, k: int, *arguments: Any) -> Sensed:
        tick = super().tick(k, *arguments)
        assert tick.truth is not None
        said = Message(tick.truth.position[0], tick.truth.rotation[0], np.eye(6) * 1e-4, self._extra)
        said = replace(said, **self.said)
        messages = {(2, 0): Received(said, 0.0)} if k % 2 == 0 else {}
        return replace(tick, inbox_tick=np.full((3, 3), -1), messages=messages)


SAID = {"odometry": np.zeros(6), "depends_on": np.zeros(1, np.uint64)}
"""Further contents of a message of `robust`."""


@pytest.mark.parametrize(("observer", "extra"), [("riccati", {}), ("mekf", {}), ("robust", SAID)])
def test_messages_may_come_from_elsewhere(observer: str, extra: dict[str, np.ndarray]) -> None:
    fleet = Neighbourly(observer, **extra)
    engine = Engine(fleet.scenario, 1, "float64", backend=fleet)
    engine.reset([0])
    for k in range(7):
        assert engine.view("inbox_tick")[0].tolist() == [[-1] * 3, [-1] * 3, [k - k % 2, -1, -1]]
        if k % 2 == 0:
            assert_allclose(engine.view("inbox_position")[0, 2, 0], engine.view("position")[0, 6])
        engine.step(ticks=1)
    assert (fleet.health.received, fleet.health.rejected) == (4, 0)
    if engine.plugins is not None:
        heard = engine.plugins.groups[0].mail.received
        assert [sorted(h) for h in heard] == [[], [], [0]] and heard[2][0][0] == 6
    if observer == "robust":
        assert engine.world.memory.inbox.numpy()["valid"][0].tolist() == [[0] * 3, [0] * 3, [1, 0, 0]]


class Talkative(Fleet):
    """Takes the broadcasts of vehicles."""

    def __init__(self, observer: str) -> None:
        super().__init__(observer)
        self.broadcasts: list[VehicleBroadcast] = []

    def broadcast(self, sent: Sequence[VehicleBroadcast]) -> None:
        self.broadcasts.extend(sent)

    def notes(self, vehicle: int) -> dict[str, Any]:
        return {}


@pytest.mark.parametrize("observer", ["riccati", "robust"])
def test_a_source_receives_the_broadcasts_of_embedded_observers(observer: str) -> None:
    fleet = Talkative(observer)
    engine = Engine(fleet.scenario, 1, "float64", backend=fleet)
    engine.reset([0])
    engine.step(ticks=9)
    assert [sent.vehicle for sent in fleet.broadcasts] == [0, 1, 2] * 10
    for sent in fleet.broadcasts[-3:]:
        estimate = engine.view("estimate_position")[0, sent.vehicle]
        assert_allclose(sent.rotation.T @ sent.position, estimate)
        assert sent.message is not None
        if observer == "riccati":  # the other one's reports are of a tick before
            marker = sent.rotation @ fleet.scenario.vehicles[sent.vehicle].marker
            assert_allclose(sent.message.position, sent.position + marker, atol=1e-5)


@pytest.mark.parametrize(
    ("observer", "said"),
    [
        ("robust", {}),
        ("riccati", {"rotation": 2.0 * np.eye(3)}),
        ("riccati", {"position": np.array([0.0, 1e12, 0.0])}),
        ("mekf", {"position": np.array([0.0, np.nan, 0.0])}),
    ],
)
def test_messages_that_cannot_be_read_are_rejected(observer: str, said: dict[str, np.ndarray]) -> None:
    fleet = Neighbourly(observer)
    fleet.said = said
    engine = Engine(fleet.scenario, 1, "float64", backend=fleet)
    engine.reset([0])
    engine.step()
    assert (fleet.health.received, fleet.health.rejected) == (2, 2)
    assert (engine.view("inbox_tick") == -1).all()
    assert engine.plugins is None or not engine.plugins.groups[0].mail.received[2]


@pytest.mark.parametrize("observer", ["riccati", "mekf"])
def test_in_real_time_kernels_are_there_before_the_episode_begins(observer: str) -> None:
    class Hurried(Fleet):
        def episode(self, seed: int | None, options: Any) -> Any:
            self.kernels = kernel.cache_info().misses
            return super().episode(seed, options)

    fleet = Hurried(observer)
    fleet.capabilities = replace(fleet.capabilities, real_time=True)
    kernel.cache_clear()
    env = make(fleet)
    env.reset(seed=0)
    env.step(forwards(env))
    assert fleet.kernels == kernel.cache_info().misses > 3


def test_a_source_is_recorded_like_any_other(tmp_path: Any) -> None:
    fleet = Fleet()
    recording = record(fleet, 3, load_policy("random", fleet.scenario, 0))
    check_recording(recording, "fleet")
    assert recording.ticks == 121 and recording.visible.any() and recording.truth.known.all()
    result = run("riccati", recording)
    assert not result.failure and (result.position_rmse(2.0) < 0.1).all()


def test_missing_capabilities_are_named() -> None:
    env = make(Fleet())
    env.reset(seed=0)
    for cannot in (env.get_state, lambda: copy.deepcopy(env)):
        with pytest.raises(CoopenvError, match="backend Fleet gives ticks from elsewhere, so that no state"):
            cannot()
    with pytest.raises(CoopenvError, match=r"observer\.name: Fleet has its scenario already"):
        make(Fleet(), observer="mekf")
    for backend, why in (
        ("svea", "deployment: needed by backend='svea': the file with the cars that drive"),
        (5, "unknown backend '5'"),
    ):
        with pytest.raises(CoopenvError, match=why):
            coopenv.parallel_env("busy_intersection", backend=backend)  # type: ignore[arg-type]
