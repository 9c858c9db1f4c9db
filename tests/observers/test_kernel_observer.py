"""Observers in kernels, embedded in worlds and called from the host; where the registry finds them."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp
from numpy.testing import assert_allclose

import coopenv
from coopenv.api.engine import Engine
from coopenv.base.errors import CoopenvError
from coopenv.observers import Estimate, Message, Received, Recording, Tick, register, registry
from coopenv.observers.kernel_observer import MOST_UNITS, UNITS_PER_TICK
from coopenv.observers.pose_filters import DeadReckoning
from coopenv.observers.registry import find, find_embedded, named, portable
from coopenv.scenario.schema import neighbour_sets
from coopenv.sources.worlds import Replay
from coopenv.world.embedded import Embedded, send_nothing, start_nothing
from coopenv.world.state import array
from tests.helpers.commands import refused
from tests.helpers.recordings import completed, simulated
from tests.helpers.robust_worlds import small_errors


def merged(recording: Recording, first: int, last: int, vehicle: int) -> Tick:
    """Return the last of some ticks, with the odometry of all of them."""
    R, p = np.eye(3), np.zeros(3)
    for k in range(first, last + 1):
        p, R = p + R @ recording.translation[k, vehicle], R @ recording.rotation[k, vehicle]
    tick = recording.tick(last, vehicle, {})
    return replace(tick, rotation=R, translation=p, dt=(last - first + 1) * recording.dt)


def played(
    factory: Callable[..., Any], recording: Recording, shift: Callable[[int], float], ticks: int = 200
) -> tuple[list[Estimate], list[Any]]:
    """Run observers on ticks of which some do not come, with messages of which some are lost.

    Args:
        factory: of the observers.
        recording: whose ticks.
        shift: (tick) -> s by which its time is late.
        ticks: how many of them.
    """
    draw, L = np.random.default_rng(0), recording.setups[0].landmarks
    observers = [factory(setup) for setup in recording.setups]
    for observer, R, p, P in zip(
        observers, recording.start_rotation, recording.start_position, recording.start_covariance, strict=True
    ):
        observer.reset((R, p), P)
    estimates, sent, last, time = [], {}, 0, 0.0
    while last < ticks:
        first, last = last + 1, last + int(draw.integers(1, 4)) if last else 1
        before, time = time, last * recording.dt + shift(last)
        for vehicle in recording.order:
            tick = merged(recording, first, last, vehicle)
            heard = {t: sent[t] for t in tick.targets.tolist() if t in sent and draw.random() < 0.7}
            messages = {t: Received(message, time - sent_at) for t, (message, sent_at) in heard.items()}
            estimates.append(observers[vehicle].update(replace(tick, time=time, dt=time - before, messages=messages)))
            sent[L + vehicle] = observers[vehicle].message(), time
    return estimates, observers


def test_ticks_may_come_at_any_time() -> None:
    """Late by whole ticks errors stay small; by milliseconds it rounds to 64ths of a tick, which changes little."""
    recording = small_errors(12.0)
    regular, _ = played(find("robust"), recording, lambda k: 0.0)
    late, _ = played(find("robust"), recording, lambda k: 2e-3 * np.sin(7.0 * k) * (k > 1))
    used = [[estimate.nis_dof for estimate in part] for part in (late, regular)]
    assert np.mean(np.not_equal(*used)) < 0.01  # by bearings that are about as far off as the gate
    for estimates in (regular, late):
        for estimate, vehicle in zip(estimates[-5:], recording.order, strict=True):
            assert np.linalg.norm(estimate.position - recording.truth.position[200, vehicle]) < 0.6
    for a, b in zip(late[::5], regular[::5], strict=True):  # of who sees landmarks alone
        assert_allclose(a.position, b.position, rtol=0, atol=5e-3)
        assert_allclose(a.rotation, b.rotation, rtol=0, atol=2e-3)


def observer_and_leader() -> tuple[Any, Any, Recording]:
    """Return a follower and its leader, who have started, and their ticks."""
    recording = small_errors(12.0)
    pair = []
    for vehicle in (3, 2):
        observer = find("robust")(recording.setups[vehicle])
        pose = recording.truth.rotation[0, vehicle], recording.truth.position[0, vehicle]
        observer.reset(pose, 1e-4 * np.eye(6))
        pair.append(observer)
    return *pair, recording


def damaged(message: Message) -> list[Message]:
    """Return messages that nobody should send."""
    extra = message.extra
    assert message.position is not None and message.rotation is not None and message.covariance is not None
    return [
        replace(message, position=np.full(3, np.nan)),
        replace(message, position=np.full(3, 1e12)),
        replace(message, position=np.zeros(2)),
        replace(message, position=None),
        replace(message, rotation=2.0 * message.rotation),
        replace(message, rotation=np.diag([1.0, 1.0, -1.0])),
        replace(message, rotation=None),
        replace(message, covariance=np.zeros((6, 6))),
        replace(message, covariance=-message.covariance),
        replace(message, covariance=np.tri(6)),
        replace(message, covariance=np.eye(3)),
        replace(message, extra={}),
        replace(message, extra={**extra, "odometry": np.zeros(5)}),
        replace(message, extra={**extra, "odometry": np.full(6, np.inf)}),
        replace(message, extra={**extra, "odometry": np.array(["x"] * 6)}),
        replace(message, extra={**extra, "depends_on": np.zeros(1)}),
        replace(message, extra={**extra, "depends_on": np.zeros(0, np.uint64)}),
    ]


def test_malformed_messages_are_as_none_and_counted() -> None:
    follower, leader, recording = observer_and_leader()
    L = recording.setups[0].landmarks
    target = L + 2
    known = int(recording.setups[2].targets[recording.setups[2].targets >= L][0]) - L
    third = find("robust")(recording.setups[known])
    third.reset((recording.truth.rotation[0, known], recording.truth.position[0, known]), 1e-4 * np.eye(6))
    leader.update(recording.tick(1, 2, {L + known: Received(third.message(), 0.0)}))
    bad = damaged(leader.message())
    for k, message in enumerate(bad, 1):
        follower.update(recording.tick(k, 3, {target: Received(message, 0.0)}))
        assert follower.ignored_messages == k
    deaf, _, _ = observer_and_leader()
    for k in range(1, len(bad) + 1):
        deaf.update(recording.tick(k, 3, {}))
    assert (follower.state.estimate_position == deaf.state.estimate_position).all()
    good = recording.tick(len(bad) + 1, 3, {target: Received(leader.message(), 0.0)})
    assert (follower.update(good).position != deaf.update(replace(good, messages={})).position).any()
    assert follower.ignored_messages == len(bad)


def test_a_message_from_before_the_start_is_not_received() -> None:
    follower, leader, recording = observer_and_leader()
    target = recording.setups[0].landmarks + 2
    follower.update(recording.tick(1, 3, {target: Received(leader.message(), 1.0)}))
    assert follower.state.inbox_tick.tolist() == [-1] * 5 and follower.ignored_messages == 0


def test_time_has_an_end() -> None:
    follower, _, recording = observer_and_leader()
    follower.update(recording.tick(1, 3, {}))
    late = replace(recording.tick(2, 3, {}), time=MOST_UNITS / UNITS_PER_TICK * recording.dt + 1.0)
    with pytest.raises(CoopenvError, match="of the start"):
        follower.update(late)


def test_the_kernels_know_no_truth() -> None:
    follower, _, recording = observer_and_leader()
    follower.update(recording.tick(1, 3, {}))
    L = recording.setups[0].landmarks
    for name in ("position", "rotation", "velocity", "angular_velocity"):
        assert np.isnan(getattr(follower.state, name)[L:]).all(), name


@wp.struct
class Counter:
    """Memory of the toy observer."""

    ticks: array("WN", wp.int32)
    heard: array("WN", wp.int32)


@wp.func
def start(model: Any, state: Any, memory: Any, world: int, vehicle: int):
    memory.ticks[world, vehicle] = 0
    memory.heard[world, vehicle] = 0


@wp.func
def estimate(model: Any, state: Any, memory: Any, world: int, vehicle: int, now: Any):
    """Count, and put the count where the position estimate stands."""
    memory.ticks[world, vehicle] = memory.ticks[world, vehicle] + 1
    for sender in range(model.vehicles):
        if state.inbox_tick[world, vehicle, sender] == now.tick:
            memory.heard[world, vehicle] = memory.heard[world, vehicle] + 1
    p = state.estimate_position[world, vehicle]
    p[0] = p.dtype(memory.ticks[world, vehicle])
    p[1] = p.dtype(memory.heard[world, vehicle])
    state.estimate_position[world, vehicle] = p


COUNTER = Embedded("toy_counter", estimate, start, send_nothing, Counter)
register(COUNTER.name, embedded=COUNTER)


def test_functions_that_are_no_kernels_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(CoopenvError, match=r"observer 'plain': estimate: expected a Warp function \(@wp.func\) of 6"):
        Embedded("plain", lambda model, state, memory, world, vehicle, now: None, start, send_nothing)
    with pytest.raises(CoopenvError, match=r"observer 'few': send: expected a Warp function \(@wp.func\) of 6 arg"):
        Embedded("few", estimate, start, start)
    source = """
from typing import Any
import warp as wp
from coopenv.world.embedded import Embedded, send_nothing, start_nothing

@wp.func
def estimate(model: Any, state: Any, memory: Any, world: int, vehicle: int, now: Any):
    x = state.nope[world, vehicle]

WRONG = Embedded("wrong", estimate, start_nothing, send_nothing)
"""
    (tmp_path / "wrong.py").write_text(source)
    out = ("--observer", f"{tmp_path}/wrong.py:WRONG", "--no-figures", "--out", str(tmp_path / "out"))
    assert "Warp cannot compile a kernel: " in (line := refused("run", "overtaking", *out)) and "`nope` is not" in line


@wp.func
def lose(model: Any, state: Any, memory: Any, world: int, vehicle: int, now: Any):
    """Estimate nothing from the third tick on."""
    if now.tick > 2:
        state.estimate_position[world, vehicle][1] = type(model.camera_period)(wp.nan)


def test_an_estimate_that_is_no_number_ends_a_run() -> None:
    lost = Embedded("lost", lose, start_nothing, send_nothing)
    with pytest.raises(CoopenvError, match=r"observer 'lost' at vehicle_1 at 0.\d+ s: its estimate is not finite"):
        coopenv.run("overtaking", observer=lost, steps=5)


@pytest.mark.parametrize("observer", ["toy_counter", COUNTER])
def test_embedded_observers_run_in_an_environment(observer: str | Embedded) -> None:
    env = coopenv.parallel_env("busy_intersection", observer=observer, dtype="float64")
    env.reset(seed=0)
    env.step({agent: np.zeros(2) for agent in env.agents})
    memory = env.engine.world.memory
    ticks = env.engine.world.model.ticks_per_decision
    assert memory.ticks.numpy().tolist() == [[ticks] * 5]
    leaders = [sum(target >= 3 for target in targets) for targets in neighbour_sets(env.scenario)]
    assert memory.heard.numpy()[0].tolist() == [ticks * count for count in leaders]
    assert env.engine.view("estimate_position")[0, :, 0].tolist() == [ticks] * 5
    env.reset(seed=0)
    assert not memory.ticks.numpy().any()


def test_batch_replay_and_saved_states_keep_its_memory() -> None:
    rows = coopenv.make_vec(
        "busy_intersection", num_worlds=3, dtype="float64", overrides={"observer.name": "toy_counter"}
    )
    rows.reset(seed=0)
    rows.step(rows.action_space.sample())
    assert (rows.engine.world.memory.ticks.numpy() == rows.engine.world.model.ticks_per_decision).all()
    state = rows.engine.get_state()
    rows.step(rows.action_space.sample())
    rows.engine.set_state(state)
    assert np.array_equal(rows.engine.get_state()["observer_ticks"], state["observer_ticks"])
    recording = simulated()
    replay = Replay(recording, "second", {"observer.name": "toy_counter"})
    engine = Engine(replay.scenario, dtype="float64", backend=replay)
    engine.reset()
    engine.step(ticks=7)
    assert engine.world.memory.ticks.numpy().tolist() == [[7] * 5]


def test_embedded_observers_are_compared_with_others() -> None:
    recording = simulated()
    for observer in ("toy_counter", COUNTER):
        result = completed(observer, recording)
        counted = np.einsum("knji,knj->kni", result.rotation, result.position)
        assert (counted[1:, :, 0] == np.arange(1, recording.ticks)[:, None]).all()
        leaders = [(setup.targets >= 3).sum() for setup in recording.setups]
        assert_allclose(counted[1:, :, 1], np.arange(1, recording.ticks)[:, None] * leaders)
        assert (result.bytes_per_second > 0).all()
    own = Embedded("mine_alone", estimate, start, send_nothing, Counter)
    rows = coopenv.compare([own, "dead_reckoning"], "overtaking", 1, overrides={"horizon": 0.5}).rows
    assert {row.observer for row in rows} == {"mine_alone", "dead_reckoning"} and not any(row.failure for row in rows)


def test_a_saved_plug_in_goes_on() -> None:
    recording = simulated()
    observer = find("toy_counter")(recording.setups[0])
    observer.reset((np.eye(3), np.zeros(3)), np.eye(6))
    for k in range(1, 10):
        observer.update(recording.tick(k, 0, {}))
    for copied in (copy.deepcopy(observer), pickle.loads(pickle.dumps(observer))):
        assert copied.update(recording.tick(10, 0, {})).position[0] == 10.0
    assert observer.update(recording.tick(10, 0, {})).position[0] == 10.0


def test_names_are_taken_once() -> None:
    register("toy_counter", embedded=COUNTER)
    for name in ("robust", "toy_counter"):
        with pytest.raises(CoopenvError, match=f"'{name}' exists already"):
            register(name, embedded=Embedded(name, estimate, start, send_nothing))
    with pytest.raises(CoopenvError, match="expected a class, a function or an Embedded"):
        register("nothing")
    assert find_embedded("toy_counter") is COUNTER and find_embedded("mekf") is None


SOURCE = """
from coopenv.observers.pose_filters import DeadReckoning

class Mine(DeadReckoning):
    pass

class Riccati(DeadReckoning):
    pass

number = 3
"""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "mine.py").write_text(SOURCE)
    monkeypatch.chdir(tmp_path)
    for known in ("_registered", "_places"):
        monkeypatch.setattr(registry, known, {})
    register(COUNTER.name, embedded=COUNTER)
    return tmp_path


class Other(DeadReckoning):
    """An observer of this program."""


def test_a_place_gets_the_name_of_its_class(folder: Path) -> None:
    assert named("mine.py:Mine") == "Mine" == named(f"{folder}/mine.py:Mine")
    assert find("Mine") is find("mine.py:Mine")
    assert portable("Mine") == f"{folder.resolve()}/mine.py:Mine"
    assert (
        named("coopenv.observers.pose_filters:Ukf") == "Ukf" and portable("Ukf") == "coopenv.observers.pose_filters:Ukf"
    )


def test_classes_get_their_name() -> None:
    assert named(Other) == "Other" == named(Other)
    assert portable("Other") is Other and find(Other) is Other
    assert named("riccati") == "riccati" == portable("riccati")


def test_a_name_that_is_taken_comes_with_the_file(folder: Path) -> None:
    (folder / "yours.py").write_text(SOURCE)
    assert (named("mine.py:Mine"), named("yours.py:Mine")) == ("Mine", "yours.Mine")
    (folder / "riccati.py").write_text(SOURCE.replace("Mine", "riccati"))
    assert named("riccati.py:riccati") == "riccati.riccati"
    (folder / "deep").mkdir()
    (folder / "deep/yours.py").write_text(SOURCE)
    with pytest.raises(CoopenvError, match=r"'Mine' and 'yours\.Mine' exist already"):
        named("deep/yours.py:Mine")


def test_a_class_of_a_notebook_may_have_the_name_of_one_in_a_file(folder: Path) -> None:
    assert named("mine.py:Mine") == "Mine"
    here = type("Mine", (DeadReckoning,), {"__module__": "__main__"})
    assert named(here) == "main.Mine"
    coopenv.parallel_env("overtaking", observer=here).reset(seed=0)


def test_a_class_that_is_defined_once_more_takes_the_place_of_the_old_one() -> None:
    def defined() -> type:
        return type("Mine", (DeadReckoning,), {"__module__": __name__})

    first, second = defined(), defined()
    assert named(first) == named(second) == "Mine"
    assert find("Mine") is second


@pytest.mark.parametrize("observer", ["mine.py:number", 3, lambda setup: None, object()])
def test_objects_that_are_no_observers_are_refused(observer: object) -> None:
    with pytest.raises(CoopenvError, match="expected a"):
        named(observer)  # type: ignore[arg-type]


@pytest.mark.parametrize("observer", ["mine.py:Mine", Other])
def test_observers_in_files_estimate_in_an_environment(observer: str | type) -> None:
    """It estimates as the observer of the zoo that it is derived from."""
    options = {"dtype": "float64", "overrides": {"horizon": 0.5}}
    estimates = []
    for choice in (observer, "dead_reckoning"):
        env = coopenv.parallel_env("overtaking", observer=choice, **options)
        env.reset(seed=0)
        env.step({agent: np.zeros(2, np.float32) for agent in env.agents})
        estimates.append(env.engine.view("estimate_position").copy())
    np.testing.assert_allclose(*estimates, rtol=1e-9)


def test_a_scenario_cannot_name_code() -> None:
    with pytest.raises(CoopenvError, match=r"observer\.name"):
        coopenv.load_scenario("overtaking", {"observer.name": "mine.py:Mine"})
