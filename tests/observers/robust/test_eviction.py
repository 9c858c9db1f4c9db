"""A belief holds few members; those out of view make room for those in view."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coopenv.observers import run
from coopenv.observers.bound import cramer_rao_ancestors
from coopenv.observers.contract import Message, Received
from coopenv.observers.robust.constants import FORGET_TIME
from tests.helpers.robust_observers import OpenJoint, OpenRobust
from tests.helpers.robust_scenes import crowd, small_errors

VEHICLES = 12


@pytest.mark.parametrize(
    ("kind", "leaders", "gone", "telling"),
    [(OpenRobust, 6, 4, False), (OpenJoint, 9, 7, False), (OpenJoint, 9, 7, True)],
)
def test_those_in_view_are_met_when_others_are_gone(kind, leaders, gone, telling):
    record = crowd(6.0, leaders, gone, telling)
    left = record.ticks // 3 * record.dt
    full, late = [], []

    class Watched(kind):
        def update(self, tick):
            estimate = super().update(tick)
            if self.setup.vehicle == leaders:
                members = set(self.member_numbers)
                if tick.time < left + FORGET_TIME - tick.dt:
                    full.append(members)
                elif tick.time > left + FORGET_TIME + tick.dt:
                    late.append(members >= set(range(gone, leaders)) and set(self.told) >= set(range(gone, leaders)))
            return estimate

    result = run(Watched, record)
    assert not result.failure
    assert all(len(members) == kind.most_members and leaders - 1 not in members for members in full[2:])
    assert late and all(late)
    assert (result.nis_dof[-30:, leaders] >= 2).all() and result.nis_dof[-30:, leaders].mean() > 3.9
    assert result.position_rmse(4.0)[leaders] < 3.0 * cramer_rao_ancestors(record).position_rms(4.0)[leaders]


def place(vehicle: int) -> np.ndarray:
    return 5.0 * np.array([np.cos(vehicle), np.sin(2.0 * vehicle), np.cos(3.0 * vehicle)])


def told(kind: type, vehicle: int, others: list[int]) -> Message:
    """Return what a vehicle says that stands still: its place, and those of others or how it correlates with two."""
    extra = {"odometry": np.zeros(6), "depends_on": np.zeros(1, np.uint64)}
    if kind is OpenRobust:
        extra["odometry"] = np.zeros(6, np.float32)
        others = others[:2]
        extra["correlations"] = np.tile(np.diag(np.full(6, 60)).astype(np.int8), (len(others), 1, 1))
        extra["told"] = np.array(others, np.uint16)
    else:
        n = 6 * (1 + len(others[:3]))
        others = others[:3]
        extra["poses"] = np.array([[0.0, 0.0, 0.0, *place(v)] for v in others]).reshape(-1, 6)
        extra["odometries"] = np.zeros((len(others), 6))
        extra["factor"] = (0.1 * np.eye(n))[np.tril_indices(n)].astype(np.float32)
        extra["complete"] = np.ones(1, np.uint8)
        extra["vehicles"] = np.array(others, np.uint16)
    extra["ages"] = np.zeros(len(others), np.float32)
    return Message(place(vehicle), np.eye(3), 1e-2 * np.eye(6, dtype=np.float32), extra)


some = st.sets(st.integers(1, VEHICLES - 1), max_size=7)
frame = st.tuples(
    st.floats(0.02, 0.8), some, st.dictionaries(st.integers(1, VEHICLES - 1), some.map(sorted), max_size=7)
)


@pytest.mark.parametrize("kind", [OpenRobust, OpenJoint])
@settings(max_examples=60, deadline=None)
@given(frames=st.lists(frame, min_size=1, max_size=12))
def test_any_meetings_leave_a_belief_in_order(kind, frames):
    """Frames of (time since the last one, who is in view, who is heard and tells of whom)."""
    first = small_errors(12.0).tick(1, 0, {})
    L = len(first.landmarks)
    names = tuple(str(n) for n in range(L + VEHICLES))
    targets = np.arange(L + 1, L + VEHICLES)
    setup = replace(small_errors(12.0).setups[0], target_names=names, targets=targets, marker=np.zeros(3))
    observer, time = kind(setup), 0.0
    observer.reset((np.eye(3), place(0)), 1e-3 * np.eye(6))
    d = np.array([place(v) - place(0) for v in range(1, VEHICLES)]) - first.lever_arm
    bearings = d / np.linalg.norm(d, axis=1, keepdims=True)
    for index, (dt, in_view, heard) in enumerate(frames, 1):
        time += dt
        messages = {}
        for v, others in heard.items():
            messages[L + v] = Received(told(kind, v, [o for o in others if o != v]), 0.0)
        valid = np.isin(np.arange(1, VEHICLES), list(in_view))
        observer.update(
            replace(
                first,
                index=index,
                time=time,
                dt=dt,
                rotation=np.eye(3),
                translation=np.zeros(3),
                targets=setup.targets,
                bearings=np.where(valid[:, None], bearings, np.nan),
                valid=valid,
                messages=messages,
            )
        )
        assert not observer.memory.search["active"]
        members, P = observer.member_numbers, observer.P
        assert members[0] == 0 and observer.ignored_messages == 0
        assert len(set(members)) == len(members) <= kind.most_members
        assert P.shape == (6 * len(members), 6 * len(members))
        np.testing.assert_array_equal(P, P.T)
        assert np.linalg.eigvalsh(P)[0] > 0.0
        for v, of in observer.told.items():
            assert v in of and of <= set(members)
        room = kind.most_members - len(members)
        for v in in_view & set(heard) if kind is OpenRobust else ():
            assert v in members or room == 0
        now = observer.units(time)
        assert all(abs(m["seen_tick"] - now) <= 1 for m in observer.members[1:] if m["vehicle"] in in_view)
