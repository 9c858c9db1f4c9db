"""A belief holds few members; those out of view make room for those in view."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coopenv.observers import run
from coopenv.observers.bound import cramer_rao_ancestors
from coopenv.observers.contract import Received
from coopenv.observers.robust.constants import FORGET_TIME
from tests.helpers.robust_observers import OpenJoint, OpenRobust
from tests.helpers.robust_scenes import crowd, small_errors
from tests.oracles.robust.belief import Belief, Member
from tests.oracles.robust.eviction import room_for
from tests.oracles.robust.joint import RobustJoint

VEHICLES = 12


def belief(seen: list[float]) -> Belief:
    """Vehicle 0 and others, by when they were last seen."""
    result = Belief(0, np.eye(3), np.zeros(3), np.eye(6))
    members = [Member(n, np.eye(3), np.zeros(3), seen=t) for n, t in enumerate(seen, 1)]
    result.add(members, np.eye(6 * len(members)))
    return result


def test_those_unseen_for_longest_go_and_no_more_than_needed():
    b = belief([3.0, 1.0, 9.0, 2.0])
    assert room_for(b, {7}, 6, 10.0) == set()
    assert room_for(b, {7}, 5, 10.0) == {2}
    assert room_for(b, {7, 8}, 5, 10.0) == {2, 4}
    assert room_for(b, {7, 8, 9}, 5, 10.0) == {2, 4, 1}
    assert room_for(b, {7, 2}, 5, 10.0) == {4}  # who comes in again does not go
    assert [m.vehicle for m in b.members] == [0, 1, 2, 3, 4]


def test_nobody_goes_if_that_is_not_enough_or_too_early():
    b = belief([3.0, 1.0, 9.0, 2.0])
    assert room_for(b, {6, 7, 8, 9}, 5, 10.0) is None
    assert room_for(b, {7}, 5, 1.0 + FORGET_TIME) is None
    assert room_for(b, {7}, 5, 1.01 + FORGET_TIME) == {2}
    assert room_for(belief([]), {1, 2}, 2, 10.0) is None


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


class Sender(RobustJoint):
    """One that stands still and believes in whomever it is told to."""

    def believe(self, others: list[int]) -> None:
        self.reset((np.eye(3), place(self.vehicle)), 1e-2 * np.eye(6))
        self.belief.add(
            [Member(v, np.eye(3), place(v), odometry=(np.eye(3), np.zeros(3))) for v in others],
            1e-2 * np.eye(6 * len(others)),
        )
        self.depends_on = 0


def place(vehicle: int) -> np.ndarray:
    return 5.0 * np.array([np.cos(vehicle), np.sin(2.0 * vehicle), np.cos(3.0 * vehicle)])


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
            sender = Sender(replace(setup, vehicle=v))
            sender.believe([o for o in others if o != v])
            for member in sender.belief.members:
                member.time = time
            messages[L + v] = Received(sender.message(), 0.0)
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
        for v, told in observer.told.items():
            assert v in told and told <= set(members)
        room = kind.most_members - len(members)
        for v in in_view & set(heard) if kind is OpenRobust else ():
            assert v in members or room == 0
        now = observer.units(time)
        assert all(abs(m["seen_tick"] - now) <= 1 for m in observer.members[1:] if m["vehicle"] in in_view)
