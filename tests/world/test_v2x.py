"""Messages: delay, period, loss, range, staleness, and who hears whom within one tick."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tests.helpers.builders import circling, constant, estimated_position, landmark, raw, run, scenario, start, vehicle

State = dict[str, np.ndarray]
ESTIMATE = {"position_offset": [0.5, -0.4, 0.2], "orientation_offset_wxyz": [0.98, 0.0, 0.0, 0.198997487]}


def fleet(neighbours: list[list[str]] | None = None, v2x: dict[str, Any] | None = None, **sections: Any) -> Any:
    """Return three vehicles that drive circles; by default each hears all before it."""
    return scenario(circling(neighbours, initial_estimate=ESTIMATE), v2x=v2x or {}, **sections)


def assert_heard(now: State, then: State, receiver: int, sender: int, sent: int) -> None:
    assert now["inbox_tick"][0, receiver, sender] == sent
    if sent >= 0:
        assert_allclose(now["inbox_rotation"][0, receiver, sender], then["estimate_rotation"][0, sender], atol=0)
        assert_allclose(now["inbox_position"][0, receiver, sender], estimated_position(then)[0, sender], atol=1e-13)


@pytest.mark.parametrize(
    ("delay", "period"), [(0, 1), (1, 1), (2, 1), (5, 1), (30, 1), (0, 2), (0, 7), (3, 7), (12, 5)]
)
def test_delay_and_period_in_ticks(delay: int, period: int) -> None:
    """Delay 0: the leader's estimate of this very tick; d: the one of d ticks ago; nothing before the first.

    There is one message every `period` ticks, the first at the start.
    """
    states = run(start(fleet(v2x={"delay": delay, "period": period})), 70)
    for tick, state in enumerate(states):
        sent = (tick - delay) // period * period if tick >= delay else -1
        for receiver, sender in ((1, 0), (2, 0), (2, 1)):
            assert_heard(state, states[sent], receiver, sender, sent)
    assert (np.array([s["inbox_tick"][0, 0] for s in states]) == -1).all()
    assert (np.array([s["inbox_tick"][0, 1, 1:] for s in states]) == -1).all()


def test_followers_use_messages_of_the_same_tick() -> None:
    """The observer corrects with the message of this tick: without it P along the leader's bearing would not shrink."""
    instant, never = (
        run(start(fleet([["L1", "L2", "L3"], ["vehicle_1"], ["vehicle_1"]], v2x)), 1)[1]
        for v2x in ({"delay": 0}, {"delay": 600})
    )
    assert np.linalg.det(instant["covariance"][0, 1]) < 0.9 * np.linalg.det(never["covariance"][0, 1])
    assert_allclose(np.diag(never["covariance"][0, 1]), [1 + 0.1 / 60] * 3 + [100 + 1 / 60] * 3, rtol=1e-12)


def test_order_follows_the_neighbours_not_the_index() -> None:
    """A chain that runs backwards through the indices is worked off leaders first, so delay 0 means this tick."""
    names = [["L1", "vehicle_2"], ["L2", "vehicle_3"], ["L1", "L2", "L3"]]
    states = run(start(fleet(names)), 20)
    for tick, state in enumerate(states):
        assert_heard(state, state, 0, 1, tick)
        assert_heard(state, state, 1, 2, tick)


def test_renaming_the_vehicles_changes_nothing() -> None:
    """The same fleet listed in another order gives the same estimates, vehicle by vehicle."""
    shuffled = [2, 0, 1]  # place in the new list -> vehicle in the old one
    parts = circling(initial_estimate=ESTIMATE)
    new_name = {f"vehicle_{old + 1}": f"vehicle_{new + 1}" for new, old in enumerate(shuffled)}
    renamed = [{**parts[old], "neighbours": [new_name.get(n, n) for n in parts[old]["neighbours"]]} for old in shuffled]
    first = run(start(scenario(parts)), 120)[-1]
    second = run(start(scenario(renamed)), 120)[-1]
    for name in ("estimate_rotation", "estimate_position", "covariance"):
        assert_allclose(second[name][0], first[name][0, shuffled], atol=1e-9)


def test_messages_against_the_order_arrive_one_tick_late() -> None:
    """Without the acyclic restriction a vehicle hears those after it in the order with the next tick."""
    names = [["L1", "vehicle_2", "vehicle_3"], ["L1", "vehicle_1"], ["L1", "vehicle_2"]]
    states = run(start(fleet(names, topology={"acyclic": False})), 20)
    for tick, state in enumerate(states):
        assert_heard(state, state, 1, 0, tick)
        assert_heard(state, state, 2, 1, tick)
        assert_heard(state, states[tick - 1], 0, 1, tick - 1)
        assert_heard(state, states[tick - 1], 0, 2, tick - 1)


def test_cycles_with_delay_are_alike_in_both_directions() -> None:
    names = [["L1", "vehicle_2"], ["L1", "vehicle_1"], ["L1", "vehicle_2"]]
    states = run(start(fleet(names, {"delay": 2}, topology={"acyclic": False})), 20)
    for tick, state in enumerate(states):
        for receiver, sender in ((0, 1), (1, 0)):
            assert_heard(state, states[tick - 2], receiver, sender, tick - 2 if tick >= 2 else -1)


def test_loss_frequency_and_independence() -> None:
    world = start(fleet(v2x={"loss": 0.3}), range(100))
    states = run(world, 200)
    ticks = np.arange(201)[:, None]
    lost = {
        pair: np.array([s["inbox_tick"][:, pair[0], pair[1]] for s in states]) != ticks
        for pair in ((1, 0), (2, 0), (2, 1))
    }
    for x in lost.values():
        assert abs(x.mean() - 0.3) < 4 * np.sqrt(0.21 / x.size)
        assert abs(np.corrcoef(x[:-1].ravel(), x[1:].ravel())[0, 1]) < 0.03
    assert abs(np.corrcoef(lost[1, 0].ravel(), lost[2, 0].ravel())[0, 1]) < 0.03  # each receiver on its own
    assert abs(np.corrcoef(lost[2, 0].ravel(), lost[2, 1].ravel())[0, 1]) < 0.03


def test_a_lost_message_leaves_the_one_before() -> None:
    states = run(start(fleet(v2x={"loss": 0.5}), 4), 60)
    ages = []
    for tick, state in enumerate(states):
        sent = int(state["inbox_tick"][0, 2, 1])
        ages.append(tick - sent if sent >= 0 else -1)
        assert_heard(state, states[sent], 2, 1, sent)
    assert max(ages) >= 2


def test_radio_range() -> None:
    """Heard at 2 m while within range, by the true distance; the last message stays."""
    names = [["L1", "L2", "L3"], ["L1", "L2", "vehicle_1"]]
    vehicles = [
        vehicle((0.0, 0, 0.5), neighbours=names[0]),
        vehicle((1.0, 0, 0.5), neighbours=names[1], motion=constant([1.0, 0, 0])),
    ]
    states = run(start(scenario(vehicles, v2x={"range": 2.02})), 120)
    heard = [int(s["inbox_tick"][0, 1, 0]) for s in states]
    assert heard == [*range(62), *[61] * 59]  # 1 m + 61/60 m is the last within 2.02 m


def test_a_vehicle_without_a_radio_is_measured_and_neither_sends_nor_receives() -> None:
    """The last of three leaders, and a follower without a radio: what the others exchange stays as it is."""
    made, every = circling(initial_estimate=ESTIMATE), start(fleet())
    made[1]["connected"] = False
    silent, connected = run(start(scenario(made)), 30), run(every, 30)
    for now, then in zip(silent, connected, strict=True):
        assert (now["inbox_tick"][0, 1] == -1).all() and (now["inbox_tick"][0, :, 1] == -1).all()
        assert now["inbox_tick"][0, 2, 0] == then["inbox_tick"][0, 2, 0] >= 0
        assert np.array_equal(now["bearing"], then["bearing"]) and np.array_equal(now["sight"], then["sight"])
    assert silent[-1]["bytes_sent"][0, 1] == 0 < silent[-1]["bytes_sent"][0, 0]
    assert not np.array_equal(silent[-1]["estimate_position"][0, 2], connected[-1]["estimate_position"][0, 2])


@pytest.mark.parametrize("staleness", [None, 0.05, 0.1])
def test_stale_messages_are_not_used(staleness: float | None) -> None:
    """With one message per second, the leader's bearing shrinks P only while the message is young enough."""
    names = [["L1", "L2", "L3"], ["vehicle_1"]]
    vehicles = [vehicle((2.0 * i, -1, 0.5), initial_estimate=ESTIMATE, neighbours=n) for i, n in enumerate(names)]
    v2x = {"period": 60} if staleness is None else {"period": 60, "staleness": staleness}
    states = run(start(scenario(vehicles, v2x=v2x)), 70)
    V = np.diag([0.1 / 60] * 3 + [1 / 60] * 3)
    grown = np.array([np.allclose(b["covariance"][0, 1], a["covariance"][0, 1] + V) for a, b in pairwise(states)])
    age = np.arange(1, 71) % 60
    limit = 1000 if staleness is None else round(staleness * 60)
    np.testing.assert_array_equal(grown, age > limit)


def test_messages_carry_the_marker() -> None:
    """A follower sees the leader's marker, so it must place it by the leader's estimated attitude."""
    marker = [0.3, 0.2, 0.6]
    vehicles = [
        vehicle((0, 0, 0.5), 0.9, marker=marker, neighbours=["L1", "L2", "L3", "L4"]),
        vehicle((2, -1, 0.5), neighbours=["vehicle_1"], initial_estimate={"position_offset": [0.2, 0, 0]}),
        vehicle((2, -1.5, 0.5), neighbours=["lamp"], initial_estimate={"position_offset": [0.2, 0, 0]}),
    ]
    landmarks = raw()["landmarks"]
    turned = [0.3 * np.cos(0.9) - 0.2 * np.sin(0.9), 0.3 * np.sin(0.9) + 0.2 * np.cos(0.9), 1.1]
    vehicles[2]["initial_pose"]["position"] = [2.0, -1.0 + 1e-5, 0.5]
    landmarks.append(landmark("lamp", turned))
    states = run(start(scenario(vehicles, landmarks=landmarks)), 60)
    estimate = estimated_position(states[-1])[0]
    assert_allclose(estimate[1], estimate[2], atol=1e-4)
    assert np.linalg.norm(estimate[1] - estimated_position(states[0])[0, 1]) > 0.05


def test_with_links_to_all_every_message_arrives_and_estimates_are_the_same() -> None:
    """Estimators use the messages of neighbours alone."""
    states = [run(start(fleet(v2x={"delay": 1, "links": links})), 20)[-1] for links in ("neighbours", "all")]
    assert (states[0]["inbox_tick"][0] >= 0).tolist() == np.tri(3, k=-1, dtype=bool).tolist()
    assert (states[1]["inbox_tick"][0] >= 0).tolist() == (~np.eye(3, dtype=bool)).tolist()
    assert_allclose(states[0]["estimate_position"], states[1]["estimate_position"], atol=0)


def test_links_to_all_end_at_the_range_of_the_radio() -> None:
    state = run(start(fleet(v2x={"links": "all", "range": 3.0})), 5)[-1]  # 2 m apart, 4 m from first to last
    assert (state["inbox_tick"][0] >= 0).tolist() == [[False, True, False], [True, False, True], [False, True, False]]
