"""Changed recordings and lying senders, as `python -m benchmarks.planar` makes them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.planar.__main__ import main
from benchmarks.planar.changes import blindfolded, changed, clocks, drifting, hidden, misread, odometry, part
from benchmarks.planar.lies import Drifting, Replaying
from coopenv.backends.mrclam import recording_of
from coopenv.observers.contract import Message
from tests.helpers.barrier_robots import barrier_robots


@pytest.fixture(scope="module")
def data():
    return barrier_robots(3, 30.0, 0.8)


def test_a_part_drives_as_the_whole(data):
    whole, cut = recording_of(data, "landmarks"), recording_of(part(data, 10.0, 15.0), "landmarks")
    k = round(10.0 / whole.dt)
    n = len(cut.t) - 2
    np.testing.assert_allclose(cut.truth.position[1:n], whole.truth.position[k + 1 : k + n], atol=1e-3)
    np.testing.assert_allclose(cut.translation[2:n], whole.translation[k + 2 : k + n], atol=1e-6)
    assert cut.visible[: n - 1].sum() == pytest.approx(whole.visible[k : k + n - 1].sum(), abs=10)


def test_odometry_is_told_otherwise(data):
    robot = data.robots[0]
    told = changed(data, 0, odometry(turns=1.5, speed=1.1)).robots[0].odometry
    np.testing.assert_allclose(told, robot.odometry * (1.0, 1.1, 1.5))
    assert len(changed(data, 0, odometry(rate=4.0)).robots[0].odometry) == pytest.approx(120, abs=3)
    assert (changed(data, 0, drifting(0.01)).robots[0].odometry[:, 2] > robot.odometry[:, 2]).all()


def test_sightings_are_hidden_misread_and_late(data):
    gap = [changed(data, 0, hidden((1, 2), (5, 6))).robots[n].detections for n in range(5)]
    for before, after in zip(data.robots, gap, strict=True):
        landmarks = after[after[:, 1] > 5]
        assert (after[:, 1] <= 5).sum() == (before.detections[:, 1] <= 5).sum()
        assert np.diff(np.r_[0.0, np.unique(landmarks[:, 0]), 30.0]).max() > 4.9
    wrong = changed(data, 0, misread(0.3)).robots[0].detections
    assert 0.15 < (wrong[:, 1] != data.robots[0].detections[:, 1]).mean() < 0.4
    np.testing.assert_allclose(
        changed(data, 0, clocks(0.1)).robots[0].detections[:, 0], data.robots[0].detections[:, 0] + 0.1
    )
    blind = blindfolded(data, 2)
    assert (blind.robots[1].detections[:, 1] <= 5).all() and blind.robots[0] is data.robots[0]


class Speaker:
    def tampered(self, made, honest):
        return made


def test_messages_of_lying_senders():
    honest = Message(position=np.zeros(3), covariance=np.eye(3))
    liar = Drifting([1], jump=1.0, drift=0.5, since=10.0)
    assert not liar.applies(0, 20.0) and not liar.applies(1, 9.0) and liar.applies(1, 12.0)
    assert np.linalg.norm(liar.broadcast(Speaker(), honest).position) == pytest.approx(2.0)
    assert liar.broadcast(Speaker(), Message()).position is None
    echo = Replaying([1], 3)
    sent = [
        echo.broadcast(Speaker(), replace(honest, position=np.full(3, k))).position[0]
        for k in range(6)
        if echo.applies(1, 20)
    ]
    assert sent == [0, 0, 0, 0, 1, 2]


def test_the_command_prints_a_row_per_lie_and_one_line_about_a_mistake(capsys, tmp_path):
    assert main(["lies", "--seeds", "1", "--seconds", "20", "--only", "all see"]) == 0
    rows = capsys.readouterr().out.splitlines()
    assert len(rows) == 4 and all(row.startswith("seed 1, all see landmarks, 1 lies, ") for row in rows)
    assert main(["changed", "--data", str(tmp_path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1
