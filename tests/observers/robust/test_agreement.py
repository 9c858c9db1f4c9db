"""The embedded observer `robust` does as the one in NumPy does, tick by tick, to 1e-9 in float64."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from itertools import count
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from coopenv.bench.observers.basin import random_start, with_start
from coopenv.bench.observers.faults import FAULTS, Lie
from coopenv.observers import Estimate, Recording, Tick, run
from coopenv.observers.riccati_coordinates import riccati_covariance
from coopenv.observers.robust.constants import MIN_DOUBTFUL_TIME, PATIENCE
from coopenv.policies import Policy
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario
from coopenv.world.world import World
from tests.helpers.builders import constant, scenario, vehicle
from tests.helpers.four_way import FOUR_WAY
from tests.helpers.replays import Played, replayed
from tests.helpers.robust_scenes import crowd, everybody_sees_everybody, noise_free, small_errors
from tests.oracles.robust.joint import RobustJoint
from tests.oracles.robust.spoken import Spoken

ISOTROPIC = {"noise.bearing.model": "isotropic", "noise.bearing.scale": 0.0029}
LOSSY = {"v2x.delay": 6, "v2x.loss": 0.3}
LOST = {"position_radius": 4.0, "orientation_angle": "uniform"}
LASTING = {"noise.odometry_scale": 0.03, "noise.gyro_bias": (0.0, 0.0, 0.0087)}
WALKING = {"noise.odometry_scale_walk": 0.003, "noise.gyro_bias_walk": 0.001}
TURNED = {"camera.extrinsics_error": 0.02, "camera.extrinsics_position_error": 0.02}
STALE = {"v2x.delay": 3, "v2x.loss": 0.4, "v2x.period": 2, "v2x.staleness": 0.2}


def driven() -> Policy:
    """Return a policy of random actions, one generator per decision."""
    decisions = count()
    return lambda observations: np.random.default_rng(6 * next(decisions)).uniform(-1, 1, (len(observations), 2))


@cache
def recorded(name: str = "busy_intersection", seed: int = 0, **overrides: Any) -> Recording:
    options = ISOTROPIC if name == "busy_intersection" else {}
    return record(
        load_scenario(name, {**options, **{k.replace("__", "."): v for k, v in overrides.items()}}), seed, driven()
    )


def near(recording: Recording) -> Recording:
    start = recording.truth.position[0] + 0.05
    return with_start(recording, recording.truth.rotation[0], start, np.diag([1e-4] * 3 + [4e-3] * 3))


def dotted(options: dict[str, Any]) -> dict[str, Any]:
    return {key.replace(".", "__"): value for key, value in options.items()}


CASES: dict[str, Callable[[float], Recording]] = {
    "near": lambda horizon: near(recorded(horizon=horizon)),
    "the paper's start": lambda horizon: recorded(horizon=horizon),
    "noise off": lambda horizon: random_start(recorded(horizon=horizon, noise__enabled=False), 1),
    "any start": lambda horizon: random_start(recorded(horizon=horizon), 2),
    "stale radio": lambda horizon: random_start(recorded(horizon=horizon, **dotted(STALE)), 3),
    "late radio": lambda horizon: near(recorded(horizon=horizon, **dotted(LOSSY))),
    "wrong association": lambda horizon: FAULTS["wrong_association"].applied(near(recorded(horizon=horizon)), 4)[0],
    "landmarks lost": lambda horizon: FAULTS["landmarks_lost"].applied(near(recorded(horizon=horizon)), 4)[0],
    "slow corrections": lambda horizon: near(recorded(horizon=horizon, rates__observer=25.0, rates__odometry=37.0)),
    "cyclic": lambda horizon: near(recorded(horizon=horizon, topology__acyclic=False)),
    "sensed": lambda horizon: recorded(FOUR_WAY, horizon=horizon),
    "three landmarks": lambda horizon: recorded("crossing_path", horizon=horizon),
    "errors that last": lambda horizon: near(recorded(horizon=horizon, **dotted(LASTING))),
    "errors that last, any start": lambda horizon: random_start(recorded(horizon=horizon, **dotted(LASTING)), 2),
    "errors that walk": lambda horizon: recorded("busy_intersection_tracking", horizon=horizon, **dotted(WALKING)),
    "a camera that is turned": lambda horizon: recorded(
        "busy_intersection_tracking", horizon=horizon, **dotted(TURNED)
    ),
    "a turned camera, any start": lambda horizon: random_start(recorded(horizon=horizon, **dotted(TURNED)), 2),
    "clocks that are off": lambda horizon: near(recorded(horizon=horizon, **dotted({"faults.clock_offset": 0.05}))),
    "mirror": lambda horizon: recorded("busy_intersection_mirror", horizon=horizon),
}


def check(recording: Recording, played: Played, tamper: Lie | None = None) -> None:
    result = run(Spoken, recording, tamper)
    assert not result.failure
    assert_allclose(played.position[1:], result.position[1:], rtol=0, atol=1e-9)
    assert_allclose(played.rotation[1:], result.rotation[1:], rtol=0, atol=1e-9)
    for k in range(1, recording.ticks, 50):
        for i in range(len(recording.setups)):
            P = result.covariance[k, i]
            expected = riccati_covariance(Estimate(result.rotation[k, i], result.position[k, i], P))
            assert expected is not None
            scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
            assert_allclose(played.covariance[k, i] / scale, expected / scale, rtol=0, atol=1e-7)


@pytest.mark.parametrize("case", CASES)
def test_it_does_as_the_one_in_numpy(case: str) -> None:
    recording = CASES[case](4.0)
    check(recording, replayed(recording))


@pytest.mark.parametrize("case", ["the paper's start", "any start", "stale radio", "slow corrections", "cyclic"])
def test_its_plug_in_face_does_so_too(case: str) -> None:
    recording = CASES[case](4.0)
    expected, result = run(Spoken, recording), run("robust", recording)
    assert not result.failure
    for name in ("position", "rotation", "nees", "nis"):
        assert_allclose(getattr(result, name), getattr(expected, name), rtol=1e-7, atol=1e-9, err_msg=name)
    assert (result.nis_dof == expected.nis_dof).all()
    assert (result.bytes_per_second == expected.bytes_per_second).all()


JOINT_CASES = {
    "small errors": lambda: small_errors(4.0),
    "rumours": lambda: everybody_sees_everybody(2.0),
    "any start": lambda: random_start(noise_free(4.0), 0),
    "late radio": CASES["late radio"],
    "eviction": lambda: crowd(6.0, 9, 7),
    "eviction of those told of": lambda: crowd(6.0, 9, 7, True),
    "a turned camera": lambda: recorded("busy_intersection_tracking", horizon=3.0, **dotted(TURNED)),
    "errors that last": lambda: recorded("busy_intersection_tracking", horizon=3.0, **dotted(LASTING)),
    "a liar": lambda: FAULTS["lying_neighbour"].applied(small_errors(4.0), 0),
}


@pytest.mark.parametrize("case", JOINT_CASES)
def test_joint_messages_do_as_in_numpy(case: str) -> None:
    made = JOINT_CASES[case](4.0) if case == "late radio" else JOINT_CASES[case]()
    recording, lie = made if isinstance(made, tuple) else (made, None)
    expected, result = run(RobustJoint, recording, lie), run("robust_joint", recording, lie)
    assert not result.failure
    for name in ("position", "rotation", "nees", "nis"):
        assert_allclose(getattr(result, name), getattr(expected, name), rtol=1e-6, atol=1e-9, err_msg=name)
    assert (result.nis_dof == expected.nis_dof).all()
    assert (result.bytes_per_second == expected.bytes_per_second).all()


@pytest.mark.slow
@pytest.mark.parametrize("case", ["small errors", "eviction of those told of"])
def test_joint_messages_in_a_world_do_as_on_the_host(case: str) -> None:
    recording = JOINT_CASES[case]()
    result, played = run("robust_joint", recording), replayed(recording, observer="robust_joint")
    assert_allclose(played.position[1:], result.position[1:], rtol=0, atol=1e-9)
    assert_allclose(played.rotation[1:], result.rotation[1:], rtol=0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_it_does_so_over_a_whole_episode(case: str) -> None:
    recording = CASES[case](50.0)
    check(recording, replayed(recording))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_it_does_so_while_a_follower_waits_for_its_leaders(seed: int) -> None:
    recording = random_start(recorded(horizon=20.0, seed=seed), seed)
    played = replayed(recording)
    check(recording, played)
    found = (~played.searching).argmax(axis=0) * recording.dt
    assert found[3] < 5.0 < 10.0 < found[4] < 20.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_it_does_so_when_patience_ends(seed: int) -> None:
    """Where two solutions nearly meet and the vehicle hardly moves, it goes on with badly determined ones at last."""
    slow = vehicle((-3.0, -2.0, 0.2), initial_estimate=LOST, motion=constant([0.005, 0, 0]))
    noise = {"velocity": 0.1, "angular_velocity": 0.05, "bearing": {"model": "isotropic", "scale": 0.003}}
    recording = record(scenario([slow], horizon=18.0, noise=noise), seed, driven())
    played = replayed(recording)
    check(recording, played)
    found = (~played.searching[:, 0]).argmax() * recording.dt
    assert PATIENCE + MIN_DOUBTFUL_TIME < found < 16.0


@pytest.mark.parametrize(("leaders", "gone"), [(6, 4), (9, 7)])
def test_the_same_members_make_room(leaders: int, gone: int) -> None:
    recording = crowd(6.0, leaders, gone)
    members = {}

    def note(world: World, tick: int) -> None:
        memory: Any = world.memory
        count = memory.belief.numpy()["members"][0, leaders]
        members[tick] = memory.member.numpy()["vehicle"][0, leaders, :count].tolist()

    class Noted(Spoken):
        def update(self, tick: Tick) -> Estimate:
            estimate = super().update(tick)
            if self.vehicle == leaders:
                expected[tick.index] = [member.vehicle for member in self.belief.members]
            return estimate

    expected: dict[int, list[int]] = {}
    check(recording, replayed(recording, note))
    run(Noted, recording)
    assert {tick: members[tick] for tick in expected} == expected
    assert members[100] == [leaders, 0, 1, 2, 3]
    assert members[recording.ticks - 1][-2:] == [leaders - 2, leaders - 1]


def test_a_search_ends_for_leaders_first() -> None:
    played = replayed(CASES["any start"](4.0))
    found = (~played.searching).argmax(axis=0)
    assert played.searching[0].all()
    assert 0 < found[0] < found[1] < found[2] < found[3]


def test_a_liar_is_found_out_as_in_numpy() -> None:
    recording = near(recorded(horizon=5.0, v2x__delay=1))
    lie = Lie(sender=1, start=2.0, std=2.0**-7)  # whose square single precision holds exactly
    told = {}

    def meddle(world: World, tick: int) -> None:
        if lie.applies(1, tick * recording.dt):
            slot = tick % world.model.radio.slots
            memory: Any = world.memory
            report = memory.outbox.numpy()[0, 1, slot]
            report["pose"]["p"] += lie.offset
            report["P"] = lie.std**2 * np.eye(6)
        told[tick] = world.memory.member.numpy()["distrusted"][0, 2].max()

    check(recording, replayed(recording, meddle), lie)
    assert told[119] == 0 and told[180] == 1


def test_single_precision_worlds_estimate_alike() -> None:
    recording = CASES["any start"](4.0)
    wide, narrow = replayed(recording), replayed(recording, dtype="float32")
    assert narrow.world.view("estimate_position").dtype == np.float32
    late = slice(-30, None)
    assert_allclose(narrow.position[late, :4], wide.position[late, :4], atol=2e-3)
    assert_allclose(narrow.rotation[late, :4], wide.rotation[late, :4], atol=2e-4)
