"""Faults of clocks, computers, maps and messages: when they begin, their size, and what other vehicles receive."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats
from scipy.spatial.transform import Rotation

from coopenv.base.errors import CoopenvError
from coopenv.scenario import Scenario
from tests.helpers.builders import circling, estimated_position, run, same_bits, scenario, start

WORLDS = 1000
State = dict[str, np.ndarray]


def fleet(own: dict[int, dict[str, Any]], **sections: Any) -> Scenario:
    """Return three vehicles that drive circles, each of which hears all before it; `own`: faults by vehicle."""
    vehicles = circling(initial_estimate={"position_radius": 0.3, "orientation_angle": 0.1})
    for i, faults in own.items():
        vehicles[i]["faults"] = faults
    return scenario(vehicles, **sections)


def broadcast_error(state: State, vehicle: int) -> tuple[np.ndarray, np.ndarray]:
    """Return what a vehicle put on the air at the state's tick beside its estimate: shift (W, 3), turn (W, 3, 3)."""
    slot = int(state["tick"][0]) % state["outbox_tick"].shape[-1]
    shift = state["outbox_position"][:, vehicle, slot] - estimated_position(state)[:, vehicle]
    back = state["estimate_rotation"][:, vehicle].swapaxes(-1, -2)
    return shift, back @ state["outbox_rotation"][:, vehicle, slot]


def test_a_jump_is_of_its_size_from_its_time_on() -> None:
    lie = {"kind": "jump", "start": 0.5, "offset": 3.0, "direction": [0.0, 3.0, 4.0]}
    for state in run(start(fleet({0: {"lie": lie}})), 60):
        shift, turn = broadcast_error(state, 0)
        assert_allclose(shift[0], [0.0, 1.8, 2.4] if state["tick"][0] >= 30 else 0.0, atol=1e-12)
        assert_allclose(turn[0], np.eye(3), atol=1e-12)
        assert_allclose(broadcast_error(state, 1)[0], 0.0, atol=1e-12)
        assert_allclose(
            state["inbox_position"][0, 2, 0] - estimated_position(state)[0, 0], shift[0], atol=1e-12
        )  # all hear the same


def test_a_drift_grows_with_time() -> None:
    lie = {"kind": "drift", "start": 0.2, "speed": 0.3, "direction": [1.0, 0.0, 0.0]}
    for state in run(start(fleet({1: {"lie": lie}})), 40):
        expected = 0.3 * max(0.0, state["tick"][0] / 60 - 0.2)
        assert_allclose(broadcast_error(state, 1)[0][0], [expected, 0.0, 0.0], atol=1e-12)


def test_liars_times_and_offsets_are_drawn() -> None:
    lie = {"kind": "jump", "chance": 0.4, "start": 1.0, "start_spread": 2.0, "offset": 2.0}
    state = start(fleet({0: {"lie": lie}, 1: {"lie": lie}}), range(WORLDS)).get_state()
    lies = state["lie_tick"][:, :2] >= 0
    low, high = stats.binom.ppf([1e-4, 1 - 1e-4], 2 * WORLDS, 0.4)
    assert low <= lies.sum() <= high and (state["lie_tick"][:, 2] == -1).all()
    assert abs(np.corrcoef(lies.T)[0, 1]) < 4.5 / np.sqrt(WORLDS)
    begun = state["lie_tick"][:, :2][lies] / 60
    assert stats.kstest((begun - 1.0) / 2.0, "uniform").pvalue > 1e-4
    vectors = state["lie_offset"][:, :2][lies]
    assert_allclose(np.linalg.norm(vectors, axis=1), 2.0)
    assert not vectors[:, 2].any()
    assert stats.kstest(np.arctan2(*vectors[:, :2].T) / (2 * np.pi) + 0.5, "uniform").pvalue > 1e-4


def test_colluding_vehicles_broadcast_the_same_error() -> None:
    lie = {"kind": "collude", "chance": 0.5, "start_spread": 1.0, "offset": 2.0}
    state = start(fleet({0: {"lie": lie}, 1: {"lie": lie}}), range(100)).get_state()
    assert_array_equal(state["lie_tick"][:, 0], state["lie_tick"][:, 1])
    assert_array_equal(state["lie_offset"][:, 0], state["lie_offset"][:, 1])
    assert len(np.unique(state["lie_offset"][:, 0, 0])) > 20


def test_a_lie_is_steered() -> None:
    """The offset is the sum of what each velocity has added, in the worlds and vehicles that lie."""
    lie = {"kind": "drift", "start": 0.2, "speed": 0.3, "direction": [1.0, 0.0, 0.0]}
    world = start(fleet({1: {"lie": lie}}), [1, 2])
    velocities = np.random.default_rng(0).normal(size=(8, 2, 3, 3))
    expected, now = np.zeros((2, 3)), np.array([0.3, 0.0, 0.0])
    for velocity in velocities:
        for _ in range(6):
            world.advance(1)
            if world.view("tick")[0] > 12:
                expected = expected + now / 60
            assert_allclose(broadcast_error(world.get_state(), 1)[0], expected, atol=1e-12)
            assert_allclose(broadcast_error(world.get_state(), 0)[0], 0.0, atol=1e-12)
        world.steer_lies(velocity)
        if world.view("tick")[0] >= 12:
            now = velocity[:, 1]


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_on_a_shifted_map_estimates_are_shifted_likewise(dtype: str) -> None:
    """Without noise, every observer converges to the pose that its map shows."""
    offset = np.array([0.0, 0.06, 0.08])
    error = {"chance": 1.0, "offset": 0.1, "direction": offset.tolist(), "start": 1.0}
    made = fleet({}, faults={"map_error": error}, observer={"name": "riccati"}, horizon=60.0)
    world = start(made, [5], dtype=dtype)
    world.advance(59)
    before = world.get_state()
    assert_array_equal(before["map_tick"][..., :4], 60)
    world.advance(1)
    assert_allclose(world.get_state()["map_error"][0, :, :4], np.broadcast_to(offset, (3, 4, 3)), rtol=1e-6)
    world.advance(3000)
    state = world.get_state()
    off = estimated_position(state)[0] - state["position"][0, 4:]
    assert_allclose(off, np.broadcast_to(offset, (3, 3)), atol=1e-3)


def test_entries_of_a_map_are_wrong_by_chance_the_same_for_all() -> None:
    error = {"chance": 0.3, "offset": 1.0, "offset_spread": 2.0, "start": 1.0, "start_spread": 3.0}
    one = {"landmark": "L2", "chance": 1.0}
    state = start(fleet({1: {"map_error": one}}, faults={"map_error": error}), range(WORLDS)).get_state()
    begun, vectors = state["map_tick"][..., :4], state["map_error"][..., :4, :]
    wrong = begun >= 0
    assert_array_equal(wrong[:, 1], np.arange(4) == np.broadcast_to(1, (WORLDS, 4)))
    assert_array_equal(begun[:, 0], begun[:, 2])
    assert_array_equal(vectors[:, 0], vectors[:, 2])
    assert_array_equal(vectors[:, 0, 1][wrong[:, 0, 1]], vectors[:, 1, 1][wrong[:, 0, 1]])
    low, high = stats.binom.ppf([1e-4, 1 - 1e-4], 4 * WORLDS, 0.3)
    assert low <= wrong[:, 0].sum() <= high
    drawn = vectors[:, 0][wrong[:, 0]]
    assert stats.kstest(np.linalg.norm(drawn, axis=1) / 2.0 - 0.5, "uniform").pvalue > 1e-4
    assert stats.kstest(np.arctan2(*drawn[:, :2].T) / (2 * np.pi) + 0.5, "uniform").pvalue > 1e-4
    assert stats.kstest((begun[:, 0][wrong[:, 0]] / 60 - 1.0) / 3.0, "uniform").pvalue > 1e-4
    assert not vectors[~wrong].any() and not drawn[:, 2].any()


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("delay", [0, 3])
def test_a_jammer_blocks_the_receivers_in_its_range(dtype: str, delay: int) -> None:
    """The expected messages follow from true distances and from whole ticks: 12 of each 30 jam, from 15 to 75."""
    jammers = {
        0: {"chance": 1.0, "range": 2.1, "start": 0.25, "duration": 1.0, "period": 0.5, "duty": 0.4},
        2: {"chance": 1.0, "range": 1.5, "position": [4.0, -1.0, 0.5], "start": 1.5},
    }
    made = fleet({i: {"jammer": jammer} for i, jammer in jammers.items()}, v2x={"delay": delay})
    states, expected = run(start(made, dtype=dtype), 120), np.full((3, 3), -1)
    seen = set()
    for tick, state in enumerate(states):
        places = state["position"][0, 4:]
        first = 15 <= tick < 75 and (tick - 15) % 30 < 12
        jammed = first & (np.linalg.norm(places - places[0], axis=-1) <= 2.1)
        jammed |= (tick >= 90) & (np.linalg.norm(places - [4.0, -1.0, 0.5], axis=-1) <= 1.5)
        seen.add(tuple(jammed.tolist()))
        for receiver, senders in ((1, [0]), (2, [0, 1])):
            if tick >= delay and not jammed[receiver]:
                expected[receiver, senders] = tick - delay
        assert_array_equal(state["inbox_tick"][0], expected)
    assert len(seen) > 2


@pytest.mark.parametrize(
    ("faults", "message"),
    [
        ({"map_error": {"landmark": "L9"}}, r"faults.map_error.landmark: unknown landmark 'L9'; known: "),
        ({"map_error": {"chance": 1.5}}, "faults.map_error.chance"),
        ({"jammer": {"duty": 0.0}}, "faults.jammer.duty"),
    ],
)
def test_impossible_faults_are_refused(faults: dict[str, Any], message: str) -> None:
    with pytest.raises(CoopenvError, match=message):
        fleet({}, faults=faults)


@pytest.mark.parametrize(("delay", "period"), [(0, 1), (3, 1), (2, 4)])
def test_a_replay_is_an_older_message_as_if_new(delay: int, period: int) -> None:
    lie = {"kind": "replay", "start": 0.5, "age": 0.2}
    states = run(start(fleet({0: {"lie": lie}}, v2x={"delay": delay, "period": period})), 80)
    for tick, state in enumerate(states):
        sent = (tick - delay) // period * period
        if sent < 0:
            continue
        content = states[max(sent - 12, 0) if sent >= 30 else sent]
        assert state["inbox_tick"][0, 2, 0] == state["inbox_stamp"][0, 2, 0] == sent
        assert_allclose(state["inbox_position"][0, 2, 0], estimated_position(content)[0, 0], atol=1e-12)
        assert_array_equal(state["inbox_rotation"][0, 2, 0], content["estimate_rotation"][0, 0])


def test_ages_are_wrong_by_the_difference_of_two_clocks() -> None:
    made = fleet({}, faults={"clock_offset": 0.1}, v2x={"delay": 2})
    states = run(start(made, range(200)), 40, "clock", "inbox_stamp")
    clock = states[0]["clock"]
    assert_array_equal(states[-1]["clock"], clock)
    assert np.std(clock / 60) == pytest.approx(0.1, rel=4 / np.sqrt(2 * clock.size))
    heard, tick = states[-1]["inbox_stamp"], 40
    for receiver, sender in ((1, 0), (2, 0), (2, 1)):
        ahead = clock[:, sender] - clock[:, receiver]
        late = np.array([np.clip(k - 2 + ahead, 0, k) for k in range(2, tick + 1)])
        assert_array_equal(heard[:, receiver, sender], late.max(axis=0))


def test_messages_older_than_the_limit_by_the_receiver_s_clock_are_not_used() -> None:
    made = fleet({}, faults={"clock_offset": 0.1}, v2x={"delay": 2, "staleness": 0.05}, observer={"name": "riccati"})
    fresh = fleet({}, v2x={"delay": 2, "staleness": 0.05})
    world, plain = start(made, range(50)), start(fresh, range(50))
    world.advance(60), plain.advance(60)
    state, other = world.get_state(), plain.get_state()
    ahead = state["clock"][:, 0] - state["clock"][:, 1]
    assert (ahead >= 0).any() and (ahead < -1).any()
    same = (state["estimate_position"][:, 1] == other["estimate_position"][:, 1]).all(axis=-1)
    assert same[ahead >= 0].all()  # the pose of a message that counts is the same whatever its date
    assert not same[ahead < -1].any()  # it seems to be older than 3 ticks


def test_corruption_alters_a_share_of_the_messages() -> None:
    corruption = {"probability": 0.3, "start": 0.25, "size": 4.0, "turn": 0.5}
    states = run(start(fleet({0: {"corruption": corruption}}), range(40)), 60)
    shifts, turns = zip(*(broadcast_error(state, 0) for state in states), strict=True)
    shift, turn = np.array(shifts), np.array(turns)
    off = np.abs(shift).max(axis=-1) > 1e-9
    assert not off[:15].any()
    low, high = stats.binom.ppf([1e-4, 1 - 1e-4], off[15:].size, 0.3)
    assert low <= off[15:].sum() <= high
    for axis in range(3):
        assert stats.kstest(shift[off][:, axis] / 8.0 + 0.5, "uniform").pvalue > 1e-4
        vectors = Rotation.from_matrix(turn[off]).as_rotvec()
        assert stats.kstest(vectors[:, axis] + 0.5, "uniform").pvalue > 1e-4
    assert_allclose(turn[~off], np.broadcast_to(np.eye(3), turn[~off].shape), atol=1e-12)
    assert not any(np.abs(broadcast_error(state, 1)[0]).max() > 1e-9 for state in states)


def test_a_restart_loses_all_at_the_next_decision() -> None:
    """The observer begins in the landmarks' middle with the paper's P(0), and has heard nothing."""
    made = fleet({1: {"restart": {"chance": 1.0, "time": 0.42}}}, rates={"decision": 10.0}, v2x={"delay": 3})
    world = start(made)
    assert world.get_state()["restart_tick"].tolist() == [[-1, 31, -1]]
    world.advance(30)
    before = world.get_state()
    world.advance(1)
    after = world.get_state()
    spread = [np.trace(state["covariance"][0, 1]) for state in (before, after)]
    assert spread[1] > 3 * spread[0]  # 303 less the information of one frame
    middle = before["position"][0, :4].mean(axis=0)
    moved = np.linalg.norm(estimated_position(after)[0, 1] - middle)
    assert moved < np.linalg.norm(estimated_position(before)[0, 1] - middle)
    assert after["inbox_tick"][0, 1].tolist() == [28, -1, -1]  # again, as the radio delivers at this tick


@pytest.mark.parametrize(
    ("fault", "options", "decision"),
    [("jammer", {"start": 5.0, "start_spread": 20.0}, 1), ("restart", {"time": 5.0, "time_spread": 20.0}, 6)],
)
def test_jammers_and_restarts_are_drawn(fault: str, options: dict[str, float], decision: int) -> None:
    """A restart waits for the tick after a decision."""
    state = start(fleet({}, faults={fault: {"chance": 0.25, **options}}), range(WORLDS)).get_state()
    begun = state[f"{fault}_tick"][state[f"{fault}_tick"] >= 0] - (fault == "restart")
    low, high = stats.binom.ppf([1e-4, 1 - 1e-4], 3 * WORLDS, 0.25)
    assert low <= len(begun) <= high and (begun % decision == 0).all()
    assert stats.kstest((begun / 60 - 5.0) / 20.0, "uniform").pvalue > 1e-4


def test_others_go_on_as_if_there_were_no_fault() -> None:
    """A vehicle that receives no faulty sender has the same bits, and so have all vehicles with faults off."""
    faults = {
        "clock_offset": 0.2,
        "corruption": {"probability": 0.5},
        "restart": {"chance": 1.0, "time": 0.2},
        "lie": {"kind": "drift"},
    }
    noise = {"velocity": 0.1, "angular_velocity": 0.02, "bearing": {"scale": 0.003}}
    plain, off, faulty = (
        run(start(made, [3, 4]), 40)[-1]
        for made in (
            fleet({}, noise=noise),
            fleet({1: {"lie": {"kind": "none", "offset": 9.0}}}, noise=noise),
            fleet({1: faults}, noise=noise),
        )
    )
    for name in (
        "estimate_position",
        "estimate_rotation",
        "covariance",
        "bearing",
        "inbox_position",
        "odometry_velocity",
    ):
        assert same_bits(plain[name], off[name]), name
        assert same_bits(plain[name][:, 0], faulty[name][:, 0]), name
    assert not same_bits(plain["estimate_position"][:, 2], faulty["estimate_position"][:, 2])
    assert (plain["jammer_tick"] == -1).all() and (plain["map_tick"][..., :4] == -1).all()
    assert (plain["restart_tick"] == -1).all() and (plain["lie_tick"] == -1).all() and not plain["clock"].any()


def test_vehicles_have_faults_of_their_own() -> None:
    made = fleet({1: {"lie": {"kind": "replay", "age": 0.5}}}, faults={"lie": {"offset": 7.0}, "clock_offset": 0.1})
    own = made.all_faults
    assert [f.lie.kind for f in own] == ["none", "replay", "none"]
    assert own[1].lie.offset == 7.0 and own[1].clock_offset == 0.1
    assert made.replay_ticks == 30
