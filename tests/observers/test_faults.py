"""Faults of messages and observers, against numbers worked out here."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from scipy.spatial.transform import Rotation

from coopenv.estimation import REPLAY
from coopenv.observers.contract import Message
from coopenv.observers.faults import Interference, altered, interference_of, stacked
from tests.helpers import builders


def test_altered_messages_state_another_pose() -> None:
    R, turn = Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix(), np.array([0.0, 0.0, 0.5])
    honest = Message(np.array([1.0, 2.0, 3.0]), R, 2.0 * np.eye(6))
    assert altered(None, honest, np.zeros(3), np.zeros(3)) is honest
    false = altered(None, honest, np.array([1.0, 0.0, -1.0]), turn, 3.0)
    assert false.position is not None and false.position.tolist() == [2.0, 2.0, 2.0]
    assert np.allclose(false.rotation, R @ Rotation.from_rotvec(turn).as_matrix(), atol=1e-12)
    assert np.array_equal(false.covariance, 9.0 * np.eye(6))
    shifted = altered(None, honest, np.array([1.0, 0.0, 0.0]))
    assert shifted.rotation is R and np.array_equal(shifted.covariance, 2.0 * np.eye(6))
    turned = altered(None, honest, np.zeros(3), turn)
    assert not np.array_equal(turned.rotation, R) and np.array_equal(turned.position, honest.position)
    assert np.array_equal(altered(None, honest, np.zeros(3), None, 0.5).covariance, 0.25 * np.eye(6))
    bare = Message(honest.position, R)
    assert altered(None, bare, np.zeros(3), None, 0.5).covariance is None
    assert np.allclose(altered(None, honest, np.zeros(3), None, 0.01).covariance, 1e-4 * np.eye(6), atol=1e-18)
    agreeing = SimpleNamespace(tampered=lambda false, true: (false.position[0], true.position[0]))
    assert altered(agreeing, honest, np.ones(3)) == (2.0, 1.0)
    assert isinstance(altered(agreeing, honest, np.ones(3), consistent=False), Message)


def test_faults_of_a_tick_are_those_that_have_begun() -> None:
    vehicles = [builders.vehicle(), builders.vehicle((3, 0, 0)), builders.vehicle((6, 0, 0))]
    scenario = builders.scenario(vehicles, faults={"lie": {"kind": "jump"}})
    rows = {
        "lie": [REPLAY, 0, REPLAY],
        "lie_replay": [7, 7, 5],
        "lie_std": [0.5, 0.25, 2.0],
        "lie_consistent": [1, 0, 1],
    }
    table = np.array([*zip(*rows.values(), strict=True)], dtype=[(name, "f8") for name in rows])
    state = {
        "lie_tick": [4, 5, -1],
        "broadcast_shift": np.arange(9.0).reshape(3, 3),
        "broadcast_turn": -np.arange(9.0).reshape(3, 3),
        "clock": [1, -2, 3],
        "restart_tick": [4, -1, 3],
        "map_error": np.arange(54.0).reshape(3, 6, 3),
        "map_tick": [[0, 4, 5, -1, 0, 0]] * 3,
    }
    model = SimpleNamespace(fault=SimpleNamespace(numpy=lambda: table), landmarks=4)
    found = interference_of(scenario, model, lambda name: np.array([state[name]]), 0, 4)
    assert found is not None
    assert found.std.tolist() == [0.5, 0.0, 0.0] and found.replay.tolist() == [7, 0, 0]
    assert found.kept.tolist() == [7, 0, 5] and found.consistent.tolist() == [True, False, True]
    assert found.restarts.tolist() == [True, False, False] and found.clock.tolist() == [1, -2, 3]
    assert found.shift.tolist() == state["broadcast_shift"].tolist()  # type: ignore[attr-defined]
    assert found.turn.tolist() == state["broadcast_turn"].tolist()  # type: ignore[attr-defined]
    errors = np.arange(54.0).reshape(3, 6, 3)[1, :4]
    assert np.array_equal(found.map_error_of(1, 4), errors * [[1], [1], [0], [0]])
    assert np.array_equal(found.map_error_of(1, 5), errors * [[1], [1], [1], [0]])
    both = stacked([found, found])
    assert isinstance(both, Interference) and both.at(1).std.tolist() == found.std.tolist() and both.std.shape == (2, 3)
    assert stacked([found]).at(0).replay.tolist() == [7, 0, 0]  # type: ignore[union-attr]
    assert interference_of(builders.scenario(vehicles), model, lambda name: np.array([state[name]]), 0, 4) is None
    assert stacked([None, None]) is None
