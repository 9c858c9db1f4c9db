"""Observers in NumPy inside the environment: the world that they estimate in is the embedded observer's."""

from __future__ import annotations

import pickle
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

import coopenv
import coopenv.observers.registry as registry
from coopenv import CoopenvError
from coopenv.api.engine import Engine
from coopenv.estimation.metrics import nees
from coopenv.estimation.poses import left_covariance, riccati_covariance
from coopenv.observers import Coordinates, Estimate, Setup, Tick, find, register, run
from coopenv.observers.pose_filters import DeadReckoning
from coopenv.runs.recorder import record
from tests.helpers import mrclam_files
from tests.helpers.four_way import FOUR_WAY

CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "the paper's start": ("busy_intersection", {"horizon": 3.0}),
    "radio": (
        "busy_intersection",
        {"horizon": 3.0, "v2x.delay": 3, "v2x.loss": 0.4, "v2x.period": 2, "v2x.staleness": 0.2},
    ),
    "slow corrections": ("busy_intersection", {"horizon": 2.0, "observer.k": 2.0, "rates.observer": 25.0}),
    "cyclic": ("busy_intersection", {"horizon": 1.0, "topology.acyclic": False}),
    "driven": (FOUR_WAY, {"horizon": 3.0}),
}
EXACT = ("estimate_rotation", "estimate_position", "inbox_rotation", "inbox_position", "position_error")
CLOSE = ("covariance", "nees", "log_determinant", "gramian_min_eigenvalue")


class Late(DeadReckoning):
    """Dead reckoning until 0.1 s."""

    def update(self, tick: Tick) -> Estimate:
        if tick.index == 6:
            return self.fail(super().update(tick))
        return super().update(tick)

    def fail(self, estimate: Estimate) -> Estimate:
        raise ZeroDivisionError("no gain")


class Nan(Late):
    def fail(self, estimate: Estimate) -> Estimate:
        return Estimate(estimate.rotation, estimate.position * np.nan)


class Locked(DeadReckoning):
    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        self.lock = threading.Lock()


@pytest.fixture(autouse=True)
def plugins(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(registry, "_registered", {})
    on_the_host = {f"{name}_on_the_host": find(name) for name in ("riccati", "robust")}
    for name, factory in {**on_the_host, "late": Late, "nan": Nan, "locked": Locked}.items():
        register(name, factory)
    yield


def short(observer: str | None, **options: Any) -> coopenv.CooperativeLocalisationEnv:
    return coopenv.parallel_env("busy_intersection", observer=observer, overrides={"horizon": 0.5}, **options)


def still(env: coopenv.CooperativeLocalisationEnv) -> dict[str, np.ndarray]:
    return {agent: np.zeros(2, dtype=np.float32) for agent in env.agents}


@pytest.mark.parametrize(
    ("case", "observer"),
    [*((case, "riccati") for case in CASES), *((case, "robust") for case in CASES if case != "cyclic")],
)
def test_an_observer_as_a_plugin_is_the_embedded_one(case: str, observer: str) -> None:
    name, overrides = CASES[case]
    names = (observer, f"{observer}_on_the_host")
    engines = [Engine(coopenv.load_scenario(name, {**overrides, "observer.name": n}), 1, "float64") for n in names]
    embedded, plugin = engines
    assert embedded.plugins is None and plugin.plugins is not None
    vehicles = len(embedded.world.scenario.vehicles)
    actions = np.linspace(-0.3, 0.6, 2 * vehicles).reshape(1, vehicles, 2)
    for engine in engines:
        engine.reset([5])
    for _ in range(embedded.world.scenario.horizon_ticks // 6):
        for engine in engines:
            engine.step(actions)
        for field in (*EXACT, *CLOSE):
            rtol = 1e-6 if observer == "robust" and field in CLOSE else 1e-7
            assert_allclose(plugin.view(field), embedded.view(field), rtol=rtol, atol=1e-9, err_msg=field)
        for field in ("observation", "reward"):
            atol = 1e-6 if observer == "riccati" else 1e-5
            assert_allclose(plugin.view(field), embedded.view(field), atol=atol, err_msg=field)
        for field in ("bearing", "inbox_tick", "position", "odometry_velocity", "action", "command", "tick", "ended"):
            assert np.array_equal(plugin.view(field), embedded.view(field)), field


@pytest.mark.parametrize("name", ["mekf", "right_invariant", "covariance_intersection", "centralised"])
def test_the_environment_and_the_runner_agree(name: str) -> None:
    """Simulated once tick by tick and once recorded first: the same estimates, and the same NEES of a small error."""
    nearly = {"position_offset": [0.02, 0.01, 0.0], "orientation_offset_wxyz": [1.0, 0.0, 0.0, 0.0], "position": None}
    overrides = {"horizon": 1.0, "v2x.loss": 0.2, "v2x.delay": 1, "vehicles.*.initial_estimate": nearly}
    env = coopenv.parallel_env("busy_intersection", observer=name, dtype="float64", overrides=overrides)
    result = run(name, record(coopenv.load_scenario("busy_intersection", overrides), 3))
    env.reset(seed=3)
    tick = 0
    while env.agents:
        infos = env.step(still(env))[4]
        tick += 6
        for i, agent in enumerate(infos):
            assert_allclose(infos[agent]["estimate"]["position"], result.position[tick, i], atol=1e-9)
            assert_allclose(infos[agent]["estimate"]["rotation"], result.rotation[tick, i], atol=1e-9)
            assert_allclose(infos[agent]["nees"], result.nees[tick, i], rtol=0.2)
    assert result.coordinates is not Coordinates.RICCATI and not result.failure


def test_joint_observers_correct_both_driven_cars_by_the_bearing_between_them() -> None:
    """The first of two cars measures nothing, the second the first."""
    overrides = {"horizon": 2.0, "vehicles.vehicle_1.neighbours": [], "vehicles.vehicle_2.neighbours": ["vehicle_1"]}
    std = {}
    for name in ("dead_reckoning", "covariance_intersection", "centralised"):
        env = coopenv.parallel_env("scout_platoon", observer=name, dtype="float64", overrides=overrides)
        env.reset(seed=0)
        while env.agents:
            infos = env.step(still(env))[4]
        P = [infos[f"vehicle_{i}"]["estimate"]["covariance"][3:, 3:] for i in (1, 2)]
        std[name] = np.sqrt(np.trace(P, axis1=1, axis2=2))
    assert_allclose(std["covariance_intersection"][0], std["dead_reckoning"][0], rtol=1e-3)
    assert (std["centralised"] < 0.8 * std["dead_reckoning"]).all()


class Silent(DeadReckoning):
    """States no covariance."""

    def update(self, tick: Tick) -> Estimate:
        return replace(super().update(tick), covariance=None)


def test_for_an_observer_without_covariance_stands_p_of_0() -> None:
    register("silent", Silent)
    env = short("silent")
    _, before = env.reset(seed=0)
    _, _, _, _, after = env.step(still(env))
    for agent in after:
        P = after[agent]["estimate"]["covariance"]
        assert np.array_equal(P, np.diag(np.repeat(env.scenario.observer.P0, 3)))
        assert not np.array_equal(before[agent]["estimate"]["position"], after[agent]["estimate"]["position"])


def test_ticks_of_a_single_precision_world_are_exact_rotations_and_unit_vectors() -> None:
    class Strict(DeadReckoning):
        def update(self, tick: Tick) -> Estimate:
            assert_allclose(tick.rotation @ tick.rotation.T, np.eye(3), atol=1e-13)
            assert_allclose(np.linalg.norm(tick.bearings[tick.valid], axis=1), 1.0, atol=1e-13)
            assert tick.bearings.dtype == tick.landmarks.dtype == np.float64 and tick.valid.any()
            return super().update(tick)

    register("strict", Strict)
    env = short("strict", dtype="float32")
    env.reset(seed=0)
    while env.agents:
        env.step(still(env))


@pytest.mark.parametrize(
    ("name", "why"), [("late", "ZeroDivisionError: no gain"), ("nan", "CoopenvError: position is not a finite array")]
)
def test_a_failing_observer_is_named_and_a_reset_helps(name: str, why: str) -> None:
    env = short(name)
    env.reset(seed=0)
    with pytest.raises(CoopenvError, match=f"observer '{name}' at vehicle_1 at 0.100 s: {why}") as caught:
        env.step(still(env))
    assert caught.value.__cause__ is not None
    with pytest.raises(CoopenvError, match="reset starts anew"):
        env.step(still(env))
    env.reset(seed=0)
    assert env.agents and env.engine.view("tick")[0] == 0


def test_a_batch_is_its_single_worlds() -> None:
    options: dict[str, Any] = {"overrides": {"horizon": 0.5, "observer.name": "mekf"}, "dtype": "float64"}
    batch = coopenv.make_vec("busy_intersection", num_worlds=3, **options)
    rows, _ = batch.reset(seed=4)
    alone = coopenv.parallel_env("busy_intersection", **options)
    observations, _ = alone.reset(seed=4, options={"world": 2})
    for step in range(7):  # five to the horizon, one that resets, one of the next episode
        assert np.array_equal(batch.world_major(rows)[2], np.stack(list(observations.values())))
        rows = batch.step(np.zeros((batch.num_envs, 2), dtype=np.float32))[0]
        observations = alone.step(still(alone))[0] if step != 5 else alone.reset()[0]


@pytest.mark.parametrize("observer", ["mekf_covariance", "robust"])
def test_saved_states_go_on_as_if_nothing_had_happened(observer: str) -> None:
    env = short(observer, dtype="float64")
    env.reset(seed=1)
    env.step(still(env))
    state, twin = env.get_state(), pickle.loads(pickle.dumps(env))
    first = env.step(still(env))[0]
    env.set_state(state)
    again, other = env.step(still(env))[0], twin.step(still(twin))[0]
    for agent in first:
        assert np.array_equal(first[agent], again[agent]) and np.array_equal(first[agent], other[agent])


def test_a_state_that_cannot_be_copied_is_reported() -> None:
    locked = short("locked")
    locked.reset(seed=0)
    with pytest.raises(CoopenvError, match="observers' state cannot be copied: TypeError"):
        locked.get_state()


def test_recorded_robots_have_observers_on_the_host(tmp_path: Path) -> None:
    mrclam_files.write(tmp_path, seconds=4.0)
    env = coopenv.parallel_env("mrclam_6", data=tmp_path, observer="self_calibrating", dtype="float64")
    assert env.engine.plugins is not None
    env.reset(seed=0)
    while env.agents:
        observation = env.step({agent: np.zeros(2, dtype=np.float32) for agent in env.agents})[0]
    assert all(np.isfinite(value).all() for value in observation.values())


def test_a_plugin_begins_with_the_covariance_of_its_start() -> None:
    """So do the infos and figures of t = 0. P of `hamel_samson`, which is none, is P(0) of the gains."""
    for name, states in (("mekf_covariance", True), ("hamel_samson", False)):
        env = coopenv.parallel_env("open_square", dtype="float64", overrides={"observer.name": name})
        _, infos = env.reset(seed=0)
        start = env.engine.world.observer_init.start_covariance
        for P, info in zip(start, infos.values(), strict=True):
            estimate = info["estimate"]
            expected = riccati_covariance(Coordinates.LEFT, estimate["rotation"], estimate["position"], P)
            assert np.allclose(estimate["covariance"], expected, rtol=1e-9, atol=1e-12) == states


@pytest.mark.parametrize("observer", ["hamel_samson", "right_invariant", "mekf_covariance", Silent])
def test_nees_is_in_the_coordinates_of_the_observer_also_of_a_restored_world(observer: Any) -> None:
    """Three seconds from a start in error; without a covariance P is P(0)."""
    env = coopenv.parallel_env(FOUR_WAY, observer=observer, dtype="float64")
    env.reset(seed=4)
    ahead = dict.fromkeys(env.agents, np.array([0.5, 0.1], np.float32))
    for _ in range(10):
        env.step(ahead)
    restored = coopenv.parallel_env(FOUR_WAY, observer=observer, dtype="float64")
    restored.reset(seed=99)
    restored.set_state(env.get_state())
    for _ in range(3):
        infos, again = (each.step(ahead)[4] for each in (env, restored))
        for agent, info in infos.items():
            assert again[agent]["nees"] == info["nees"]
    kind = Coordinates.RICCATI if observer is Silent else env.engine.plugins.groups[0].coordinates
    for i, (agent, info) in enumerate(infos.items()):
        truth, estimate = env.engine.view("rotation")[0, len(env.scenario.landmarks) + i], info["estimate"]
        R, P = estimate["rotation"], estimate["covariance"]
        stated = {
            Coordinates.RICCATI: P,
            Coordinates.LEFT: left_covariance(R.T @ estimate["position"], P),
            Coordinates.RIGHT: np.kron(np.eye(2), R) @ P @ np.kron(np.eye(2), R.T),
        }[kind]
        e = kind.error(truth, info["truth"]["position"], R, estimate["position"])
        assert info["nees"] == pytest.approx(float(nees(e, stated)), rel=1e-6), agent
