"""A belief holds few members; those out of view make room for those in view."""

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from coopenv.observers import run
from coopenv.observers.bound import cramer_rao_ancestors
from coopenv.observers.contract import Message, Received
from coopenv.observers.robust.constants import MAX_MEMBERS, MEAN_TIME
from tests.helpers.robust_observers import OpenRobust
from tests.helpers.robust_scenes import crowd, small_errors

VEHICLES = 12


def test_those_in_view_are_met_when_others_are_gone():
    leaders, gone = 6, 4
    record = crowd(6.0, leaders, gone)
    left = record.ticks // 3 * record.dt
    full, late = [], []

    class Watched(OpenRobust):
        def update(self, tick):
            estimate = super().update(tick)
            if self.setup.vehicle == leaders:
                members = set(self.member_numbers)
                if tick.time < left + MEAN_TIME - tick.dt:
                    full.append(members)
                elif tick.time > left + MEAN_TIME + tick.dt:
                    late.append(members >= set(range(gone, leaders)))
            return estimate

    result = run(Watched, record)
    assert not result.failure
    assert all(len(members) == MAX_MEMBERS and leaders - 1 not in members for members in full[2:])
    assert late and all(late)
    assert (result.nis_dof[-30:, leaders] >= 2).all() and result.nis_dof[-30:, leaders].mean() > 3.9
    assert result.position_rmse(4.0)[leaders] < 3.0 * cramer_rao_ancestors(record).position_rms(4.0)[leaders]


def place(vehicle: int) -> np.ndarray:
    return 5.0 * np.array([np.cos(vehicle), np.sin(2.0 * vehicle), np.cos(3.0 * vehicle)])


def standing(vehicle: int, others: list[int]) -> Message:
    """Return the message of a vehicle that stands still: its pose, and correlations with two others."""
    extra = {"odometry": np.zeros(6, np.float32), "depends_on": np.zeros(1, np.uint64)}
    others = others[:2]
    extra["correlations"] = np.tile(np.diag(np.full(6, 60)).astype(np.int8), (len(others), 1, 1))
    extra["correlated_vehicles"] = np.array(others, np.uint16)
    extra["ages"] = np.zeros(len(others), np.float32)
    return Message(place(vehicle), np.eye(3), 1e-2 * np.eye(6, dtype=np.float32), extra)


some = st.sets(st.integers(1, VEHICLES - 1), max_size=7)
frame = st.tuples(
    st.floats(0.02, 0.8), some, st.dictionaries(st.integers(1, VEHICLES - 1), some.map(sorted), max_size=7)
)


@settings(max_examples=60, deadline=None)
@given(frames=st.lists(frame, min_size=1, max_size=12))
def test_any_meetings_leave_a_belief_in_order(frames):
    """Frames of (time since the last one, who is in view, who is heard and tells of whom)."""
    first = small_errors(12.0).tick(1, 0, {})
    L = len(first.landmarks)
    names = tuple(str(n) for n in range(L + VEHICLES))
    targets = np.arange(L + 1, L + VEHICLES)
    setup = replace(small_errors(12.0).setups[0], target_names=names, targets=targets, marker=np.zeros(3))
    observer, time = OpenRobust(setup), 0.0
    observer.reset((np.eye(3), place(0)), 1e-3 * np.eye(6))
    d = np.array([place(v) - place(0) for v in range(1, VEHICLES)]) - first.lever_arm
    bearings = d / np.linalg.norm(d, axis=1, keepdims=True)
    for index, (dt, in_view, heard) in enumerate(frames, 1):
        time += dt
        messages = {}
        for v, others in heard.items():
            messages[L + v] = Received(standing(v, [o for o in others if o != v]), 0.0)
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
        assert len(set(members)) == len(members) <= MAX_MEMBERS
        assert P.shape == (6 * len(members) + 6, 6 * len(members) + 6)  # with the odometry's errors
        np.testing.assert_array_equal(P, P.T)
        assert np.linalg.eigvalsh(P)[0] > 0.0
        monitored = [observer.memory.source["target"][max(m["source"], 0)] - L for m in observer.others]
        assert monitored == members[1:]
        room = MAX_MEMBERS - len(members)
        for v in in_view & set(heard):
            assert v in members or room == 0
        now = observer.units(time)
        assert all(abs(m["seen_tick"] - now) <= 1 for m in observer.others if m["vehicle"] in in_view)
