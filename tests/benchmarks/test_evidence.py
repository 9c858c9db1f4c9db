"""Programs behind the evidence: changed recordings, trained adversaries, lying senders, receipt and theory."""

from __future__ import annotations

import math
from dataclasses import replace
from inspect import signature
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from benchmarks import adversary, evidence, linear_case, linearisation, receipt
from benchmarks.planar.__main__ import main
from benchmarks.planar.changes import changed, clocks, drifting, hidden, misread, odometry, part
from coopenv.bench.observers.faults import variant_of
from coopenv.mrclam.recording import LEAD_S, WHEELS, recording_of
from coopenv.observers import run
from coopenv.observers.recording import Recording
from coopenv.observers.registry import list_observers
from coopenv.observers.robust import constants
from coopenv.runs import record
from coopenv.scenario import load_scenario
from tests.helpers.mrclam_files import barrier_robots


@pytest.fixture(scope="module")
def recording() -> Recording:
    return record(load_scenario(evidence.BASE, {"horizon": 14.0}), 0)


def test_a_landmark_is_moved_in_the_map_alone(recording: Recording) -> None:
    fault = evidence.CHANGES["one landmark off by 0.3 m"]
    moved = evidence.changed(recording, fault, 0)
    assert moved.interference is not None
    for vehicle, k in ((0, 0), (4, recording.ticks - 1)):
        error = moved.interference.map_error_of(vehicle, k)
        np.testing.assert_allclose(error, [[0.0, 0.0, 0.0], [0.24, 0.18, 0.0], [0.0, 0.0, 0.0]], atol=1e-12)
    assert moved.bearings is recording.bearings


def test_the_road_has_two_platoons() -> None:
    scenario = evidence.road()
    assert (len(scenario.vehicles), len(scenario.landmarks)) == (7, 34)


def test_two_platoons_merge_and_each_landmark_of_a_follower_is_wrong_in_turn() -> None:
    scenario = evidence.merging()
    assert (len(scenario.vehicles), len(scenario.landmarks)) == (10, 18)
    made = record(scenario, 0)
    side = [made.truth.position[round(t / made.dt), 6, 0] for t in (0.0, 9.0)]
    assert side[0] > 20.0 and side[1] == pytest.approx(3.5)
    wrong = []
    for seed in range(5):
        moved = evidence.changed(made, evidence.MERGING_CHANGES["one landmark in turn off by 3 m"], seed)
        assert moved.interference is not None
        error = moved.interference.map_error_of(3, 0)
        wrong += [made.setups[0].target_names[n] for n in np.flatnonzero(error.any(axis=1))]
        assert_allclose(np.linalg.norm(error), 3.0)
    assert wrong == ["L1", "L2", "L3", "L5", "L1"]


def test_an_outcome_is_of_honest_vehicles(recording: Recording) -> None:
    found = evidence.outcome({4: recording}, "vehicle_2:lie=jump:1@12", "riccati", 13.0)
    ticks = int((recording.t >= 13.0).sum())
    assert found.rmse.shape == found.anees.shape == (1, 4) and found.error.shape == found.level.shape == (4 * ticks,)
    assert found.exceeded == "-" and found.error.max() >= found.rmse.max() > 0.0
    assert (found.horizontal <= found.error + 1e-12).all()
    wrong = replace(found, error=np.array([6.0, 6.0, 4.0, 6.0]), deviation=np.array([0.5, 2.0, 0.5, 0.9]))
    assert wrong.overconfident == "50"
    levels = replace(found, horizontal=np.full(4, 2.0), level=np.array([1.0, 4.0, 6.0, np.inf]))
    assert levels.levels == "25, 25, 2.0"


def test_a_page_without_marks_is_left_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "page.md"
    page.write_text("A page.\n")
    monkeypatch.setitem(evidence.PARTS, "scenes", lambda seeds, jobs: "| a |")
    assert evidence.main(["scenes", "--page", str(page)]) == 2 and "expected the marks" in capsys.readouterr().err
    page.write_text("A <!-- scenes: begin --> old <!-- scenes: end --> page.\n")
    assert evidence.main(["scenes", "--page", str(page)]) == 0
    assert "| a |" in page.read_text() and "old" not in page.read_text()


HORIZON = 8.0


def test_the_cross_entropy_method_finds_a_maximum() -> None:
    best = np.array([1.0, -2.0, 0.5])
    found = adversary.cross_entropy(
        lambda candidates, generation: -np.square(candidates - best).sum(axis=1), np.zeros(3), np.ones(3), 30, 24
    )
    assert_allclose(found, best, atol=0.05)


def test_a_steering_begins_in_time_and_keeps_the_limit() -> None:
    parameters = adversary.constant(np.array([2.0, 2.0]), np.array([0.1, 0.9]), np.array([0.0, np.pi / 2]))
    steering, features = adversary.linear(parameters, 0.3), np.ones((2, 10))
    assert not steering(1.0, features).any()
    assert_allclose(steering(2.0, features), [[0.1, 0.0], [0.0, 0.3]], atol=1e-12)


@pytest.mark.parametrize("odometry", adversary.ODOMETRY)
def test_an_attack_of_the_worlds_is_replayed_on_a_recording(odometry: str) -> None:
    """Steps of the velocity in the kernels are sums of drifts on the host."""
    seeds, drawn = [3, 4], np.random.default_rng(5).normal(scale=0.3, size=(3, 2, 2))
    worlds = adversary.Worlds(2, "riccati", odometry, {"horizon": HORIZON})
    rollouts = worlds.play(seeds, lambda time, features: drawn[int(time)])
    assert_allclose(rollouts.velocity, drawn.swapaxes(0, 1))
    assert np.isnan(rollouts.error[:, adversary.LIAR]).all()
    for world, seed in enumerate(seeds):
        recording = record(load_scenario(adversary.SCENE, {"horizon": HORIZON}), seed)
        fault = adversary.fault_of(rollouts.velocity[world], odometry)
        changed = variant_of(fault).applied(recording, 0)
        assert changed.interference is not None
        assert_allclose(changed.interference.shift[-1, adversary.LIAR, :2], drawn[:, world].sum(axis=0), atol=1e-3)
        found = run("riccati", changed)
        decisions = found.position_error[306::6]  # 10 Hz at 60 ticks per second, after `START`
        assert_allclose(np.delete(decisions.mean(axis=0), 1), np.delete(rollouts.error[world], 1), rtol=1e-3)


def test_the_table_and_the_worst_case(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(adversary, "OBSERVERS", ("riccati",))
    sizes = ["--generations", "1", "--population", "2", "--seeds", "1", "--held-out", "2"]
    assert adversary.main(["--horizon", "7", *sizes]) == 0
    printed = capsys.readouterr().out
    rows = [line for line in printed.splitlines() if line.startswith("|")]
    assert len(rows) == 2 + 1 + 2 * 4 and rows[2].startswith("| none |")
    fault = printed.rpartition("--fault ")[2].split()[0]
    assert all(part.vehicles == ("vehicle_2",) for part in variant_of(fault).faults)


@pytest.fixture(scope="module")
def data():
    return barrier_robots(3, 30.0, 0.8)


def test_a_part_drives_as_the_whole(data):
    whole, cut = recording_of(data, "landmarks"), recording_of(part(data, 10.0, 15.0), "landmarks")
    k = round(10.0 / whole.dt)
    n = len(cut.t) - 2
    first = 2 + math.ceil((LEAD_S + max(WHEELS.delay)) / whole.dt)  # before it the wheels follow earlier commands
    np.testing.assert_allclose(cut.truth.position[1:n], whole.truth.position[k + 1 : k + n], atol=1e-3)
    np.testing.assert_allclose(cut.translation[first:n], whole.translation[k + first : k + n], atol=1e-6)
    assert cut.visible[: n - 1].sum() == pytest.approx(whole.visible[k : k + n - 1].sum(), abs=10)


def test_odometry_is_changed(data):
    robot = data.robots[0]
    changed_odometry = changed(data, 0, odometry(turns=1.5, speed=1.1)).robots[0].odometry
    np.testing.assert_allclose(changed_odometry, robot.odometry * (1.0, 1.1, 1.5))
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


def test_the_command_prints_a_row_per_variant_and_one_line_about_a_mistake(capsys, tmp_path):
    assert main(["barriers", "--seeds", "1", "--seconds", "4", "--observers", "mekf_covariance"]) == 0
    rows = capsys.readouterr().out.splitlines()
    assert len(rows) == 3 and all(row.startswith("seed 1, turns 0.7, ") for row in rows)
    assert main(["changed", "--data", str(tmp_path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_what_is_left_out_is_part_of_the_observer() -> None:
    found = receipt.parts()
    assert not found["nothing"] and len(found) > 10
    assert all(hasattr(module, name) for changes in found.values() for module, name, _ in changes)
    assert {name for changes in found.values() for _, name, _ in changes if name.isupper()} <= {*receipt.numbers()}
    for module, name, put in (change for changes in found.values() for change in changes if not change[1].isupper()):
        original, replacement = (getattr(f, "func", f) for f in (getattr(module, name), put))
        assert signature(original).parameters.keys() == signature(replacement).parameters.keys(), name


def test_numbers_that_follow_from_a_constant_follow_its_change(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in vars(constants).copy().items():
        monkeypatch.setattr(constants, name, value)  # restored after the test
    before = {name: value for name, value in vars(constants).items() if name.isupper()}
    receipt.leave_out("MARGIN*2")
    assert constants.SQUARED_MARGIN / before["SQUARED_MARGIN"] == pytest.approx(4.0)
    receipt.leave_out("RISK*2")
    assert_allclose([constants.RISK / before["RISK"], constants.MARGIN / before["MARGIN"]], [2.0, 1.0])
    gates = {f"{of}_GATE" for of in ("BEARING", "OFFSET", "POSE", "JUMP")}
    smaller = {name for name in before if getattr(constants, name) < before[name]}
    assert smaller == {*gates, "PRUNE_GAP", "MAX_PRIOR_COST", "MAX_MISFIT", "MAX_EVIDENCE"}
    receipt.leave_out("nothing")
    assert {name: getattr(constants, name) for name in before} == before
    assert {"MARGIN", "RISK", "FAULT_RISK"} <= {*receipt.numbers()}
    assert not {"SQUARED_MARGIN", "ODDS", "MAX_CONDITION", "BEARING_GATE"} & {*receipt.numbers()}


class Source(dict[str, np.ndarray]):
    """Records of two sources."""

    def __len__(self) -> int:
        return 2


def test_exclusions_are_noted_with_their_time_and_target() -> None:
    source = Source(exclusions=np.zeros(2, int), target=np.array([-1, 7]))

    def update(tick: SimpleNamespace) -> float:
        source["exclusions"][1] = tick.time >= 2.0
        return float(tick.time)

    setup = SimpleNamespace(targets=np.array([3, 7]))
    watched = receipt.Watched(SimpleNamespace(memory=SimpleNamespace(source=source), update=update), setup)
    assert [watched.update(SimpleNamespace(time=t)) for t in (1.0, 2.0, 3.0)] == [1.0, 2.0, 3.0]
    assert watched.times == [(2.0, 7)] and len(watched.seconds) == 3 and watched.sees(7) and not watched.sees(4)


def test_an_observer_without_monitors_excludes_nothing() -> None:
    watched = receipt.Watched(SimpleNamespace(update=lambda tick: tick.time), SimpleNamespace(targets=np.array([3])))
    assert watched.update(SimpleNamespace(time=1.0)) == 1.0
    assert watched.times == [] and watched.sees(3)


def test_the_rivals_are_observers_of_the_zoo() -> None:
    assert {*receipt.RIVALS} <= {*list_observers()}
    assert not {*receipt.RIVALS} & {*receipt.parts()}


@pytest.mark.parametrize(
    ("name", "ratio"),
    [
        ("one sender, every report fused", 1.0),
        ("one sender, every twelfth, exact odometry", 1.0),
        ("common ancestor, correlation known", 1.0),
        ("common ancestor, correlation missing", (0.65 + 0.5) / 0.65),
        ("four newcomers, common ancestor", (4.0 + 0.3) / 1.3),
        ("sixteen newcomers, common ancestor", (16.0 + 0.3) / 1.3),
    ],
)
def test_ratios_are_those_of_closed_forms(name: str, ratio: float) -> None:
    own, largest = linear_case.EXAMPLES[name]().ratios()
    assert own == pytest.approx(ratio, rel=1e-5) and largest >= own * (1.0 - 1e-9)


def test_the_statistic_is_a_chi_square_without_senders_errors_and_smaller_with_them() -> None:
    assert_allclose(linear_case.monitor(30, 1e-12), 1.0, atol=1e-6)
    assert linear_case.monitor(1, 1.0)[1] == pytest.approx(0.5, abs=0.05)


def test_the_derivative_of_a_bearing_is_that_of_its_prediction() -> None:
    random = np.random.default_rng(0)
    own, leader = random.normal(size=(2, 5, 3))
    leader[:, 1] += 6.0
    _, H, _ = linearisation.bearing(own, leader)
    for k in range(6):
        error = np.zeros((5, 6))
        error[:, k] = 1e-6
        ends = [
            linearisation.bearing(
                linearisation.moved(own, s * error[:, :3]), linearisation.moved(leader, s * error[:, 3:])
            )
            for s in (1.0, -1.0)
        ]
        assert_allclose(linearisation.wrapped(ends[0][0] - ends[1][0]) / 2e-6, H[:, k], atol=1e-8)


def test_the_constrained_point_has_the_least_bias_in_a_lane_and_the_variance_reduces_it() -> None:
    bias = {
        (point, variance): linearisation.simulate("lane", point, 40, 5.0, variance)[-1].bias
        for point, variance in (("prediction", False), ("prediction", True), ("constrained", False))
    }
    assert abs(bias["constrained", False]) < 0.01 < bias["prediction", True] < 0.5 * bias["prediction", False]
