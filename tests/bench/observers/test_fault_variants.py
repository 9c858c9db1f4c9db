"""Faults with parameters on the command line: how they are written, what they become, and what is refused."""

from __future__ import annotations

import json
import re
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from coopenv.backends.mcap.writer import write_recording
from coopenv.base.errors import CoopenvError
from coopenv.bench.observers import compare
from coopenv.bench.observers.command import figure_files
from coopenv.bench.observers.faults import FAULTS, present_spelling, variant_of, with_loss
from coopenv.bench.observers.sources import Simulated, find_source, variants_of
from coopenv.cli import main
from coopenv.cli.bench import ObserverOptions
from coopenv.observers.interference import Interference
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario

ENV = "busy_intersection_tracking"


def source(*faults: str, env: str = ENV, **overrides: Any) -> Simulated:
    made = find_source(env, {"horizon": 0.5, **overrides}, faults=faults)
    assert isinstance(made, Simulated)
    return made


def test_how_a_fault_is_written() -> None:
    lie, bias = variant_of("vehicle_2,vehicle_3:lie=drift:0.05@10,std=1e-2/gyro_bias=1e+1").faults
    assert (lie.name, lie.word, lie.value, lie.vehicles) == ("lie", "drift", 0.05, ("vehicle_2", "vehicle_3"))
    assert lie.start_in(60.0) == 10.0 and lie.options == {"std": 0.01}
    assert (bias.name, bias.value, bias.vehicles, bias.options) == ("gyro_bias", 10.0, (), {})
    (lost,) = variant_of("landmarks_lost@60%+10").faults
    assert lost.start_in(50.0) == 30.0 and lost.duration == 10.0


@pytest.mark.parametrize(
    ("old", "now"),
    [
        ("lie=drift:0.05@vehicle_2,from=10", "vehicle_2:lie=drift:0.05@10"),
        ("gyro_bias=0.1+odometry_scale=0.2", "gyro_bias=0.1/odometry_scale=0.2"),
        ("lying_neighbour=2@vehicle_3,from=1,std=0.5", "vehicle_3:lie=jump:2@1,std=0.5"),
        ("lying_neighbour=2", "lie=jump:2,std=0.01"),
        ("restart=15@vehicle_3,spread=2", "vehicle_3:restart@15,spread=2"),
        ("landmarks_lost=10,from=3", "landmarks_lost@3+10"),
        ("landmarks_lost=10", "landmarks_lost@60%+10"),
        ("lie=collude:4@vehicle_1:vehicle_2", "vehicle_1,vehicle_2:lie=collude:4"),
    ],
)
def test_an_earlier_spelling_is_refused_with_the_present_one(old: str, now: str) -> None:
    assert present_spelling(old) == now == present_spelling(now)
    assert variant_of(now).faults
    with pytest.raises(CoopenvError, match=re.escape(f"write {now}")):
        variant_of(old)


@pytest.mark.parametrize(
    ("text", "key", "value"),
    [
        ("odometry_scale=0.05", "noise.odometry_scale", 0.05),
        ("vehicle_2:gyro_bias=0.0175", "noise.gyro_bias", 0.0175),
        ("slip=2,size=0.4", "noise.slip.size", 0.4),
        ("extrinsics=0.02,position=0.1", "camera.extrinsics_position_error", 0.1),
        ("focal_length=0.02", "camera.focal_length_error", 0.02),
        ("clock=0.05", "faults.clock_offset", 0.05),
        ("vehicle_3:restart@15,spread=2", "faults.restart.time_spread", 2.0),
        ("corruption=0.1@3", "faults.corruption.start", 3.0),
    ],
)
def test_a_fault_is_a_key_of_those_vehicles(text: str, key: str, value: float) -> None:
    made, plain = source(text), load_scenario(ENV)
    world = made.added[0].scenario
    assert world is not None and world.horizon == 0.5 and made.scenario.all_faults == plain.all_faults
    (fault,) = made.added[0].faults
    of_one = FAULTS[fault.name].of_one
    who = fault.vehicles or (("vehicle_2",) if of_one else tuple(plain.vehicle_names))
    section, *path = key.split(".")
    of_all = {"noise": world.noises, "camera": world.cameras, "faults": world.all_faults}[section]
    for name, found in zip(plain.vehicle_names, of_all, strict=True):
        for step in path:
            found = getattr(found, step)
        assert (found == value) == (name in who), name


def test_several_faults_make_one_variant() -> None:
    made = source("gyro_bias=0.1/odometry_scale=0.2", "v2x_loss=0.4")
    first, second = made.added
    assert first.scenario is not None and second.scenario is None
    assert {n.odometry_scale for n in first.scenario.noises} == {0.2}
    recording = made.recording("v2x_loss=0.4", 3)
    expected = with_loss(record(made.scenario, 3), 0.4, 3)
    assert_array_equal(recording.inbox_tick, expected.inbox_tick)
    assert set(made.variants) > {"nominal", "gyro_bias=0.1/odometry_scale=0.2", "v2x_loss=0.4"}


def test_the_recorded_world_has_the_fault() -> None:
    made = source("vehicle_1:lie=jump:2@0.25,std=0.1/vehicle_3:restart@0.2")
    recording = made.recording(made.added[0].name, 0)
    nominal = made.recording("nominal", 0)
    found = recording.interference
    assert nominal.interference is None and found is not None
    assert_allclose(np.linalg.norm(found.shift[:, 0], axis=-1), np.where(recording.t >= 0.25 - 1e-9, 2.0, 0.0))
    assert_allclose(found.std[:, 0], np.where(recording.t >= 0.25 - 1e-9, 0.1, 0.0), rtol=1e-6)
    assert found.restarts[:, 2].sum() == 1 and not found.restarts[:, [0, 1, 3, 4]].any()
    assert_array_equal(recording.bearings, nominal.bearings)


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("gyro_bias", "needs a value, gyro_bias=NUMBER"),
        ("=1", r"expected \[VEHICLE:\]NAME"),
        ("gyro_bais=1", "unknown fault 'gyro_bais' .did you mean 'gyro_bias'"),
        ("gyro_bias=-1", "gyro_bias: value: expected a number from 0 to inf, got '-1'"),
        ("gyro_bias=nan", "expected a number"),
        ("gyro_bias=1@3", "gyro_bias: has no start"),
        ("v2x_loss=1.5", "v2x_loss: value: expected a number from 0 to 1"),
        ("lie=drfit:1", "unknown lie 'drfit' .did you mean 'drift'.*jump, drift, replay"),
        ("vehicle_2:lie=collude:5", "two vehicles collude"),
        ("lie=replay:1000", "expected an age up to 60 s"),
        ("vehicle_9:lie=jump", "unknown vehicle 'vehicle_9'.*there are vehicle_1"),
        ("lie=jump,size=3", "lie: no option 'size'; allowed: std"),
        ("lie=jump,std", "'std' is not OPTION=VALUE"),
        ("vehicle_1:v2x_loss=0.1", "v2x_loss: has no vehicles"),
        ("landmarks_lost", r"expected landmarks_lost@START\+DURATION"),
        ("restart", "expected restart@START"),
        ("corruption=2", "corruption: value: expected a number from 0 to 1"),
    ],
)
def test_what_is_wrong_with_a_fault_is_one_line(fault: str, message: str) -> None:
    with pytest.raises(CoopenvError, match=message) as error:
        source(fault)
    assert "\n" not in str(error.value)


def test_errors_of_sensors_need_noise() -> None:
    with pytest.raises(CoopenvError, match=r"fault gyro_bias=0.1: needs noise.enabled = true"):
        source("gyro_bias=0.1", **{"noise.enabled": False})


def test_recorded_robots_and_logs(tmp_path: Path) -> None:
    with pytest.raises(CoopenvError, match="recorded robots have variants of their own, landmarks"):
        find_source("mrclam_6", faults=["v2x_loss=0.5"])
    with pytest.raises(CoopenvError, match="--policy zero: mrclam_6 is recorded"):
        find_source("mrclam_6", policy="zero")


def test_nobody_to_lie_to() -> None:
    with pytest.raises(CoopenvError, match="no vehicle has another one as its neighbour"):
        variants_of(source("lie=jump", env="crossing_path"), None)
    with pytest.raises(CoopenvError, match="no vehicle has another one as its neighbour; name one"):
        source("restart@1", env="crossing_path")


def test_who_drives() -> None:
    """The records of an environment with driven vehicles are those of the policy, for all variants."""
    driven = find_source("urban_crossing", {"horizon": 1.0}, faults=["v2x_loss=0.5"], policy="random")
    expected = record(load_scenario("urban_crossing", {"horizon": 1.0}), 2, "random")
    for variant in ("nominal", "v2x_loss=0.5"):
        assert_array_equal(driven.recording(variant, 2).truth.position, expected.truth.position)
    standing = find_source("urban_crossing", {"horizon": 1.0}).recording("nominal", 2)
    assert np.abs(standing.truth.position - expected.truth.position).max() > 0.01
    with pytest.raises(CoopenvError, match="no vehicle of this environment is driven"):
        find_source(ENV, policy="random")
    with pytest.raises(CoopenvError, match="nobody_at_all"):
        find_source("urban_crossing", policy="nobody_at_all")


def test_variants_and_the_command_that_gives_them_again() -> None:
    faults = ["lie=drift:0.5@0.1", "v2x_loss=0.5"]
    given = ObserverOptions(source=ENV, observers="mekf", seeds=2, first=7, overrides=["horizon=0.5"], faults=faults)
    plan = given.plan()
    assert plan.variants == ("nominal", *faults)
    assert given.command_of(plan) == (
        f"coopenv bench observers {ENV} --observers mekf --variants nominal "
        "--fault lie=drift:0.5@0.1 --fault v2x_loss=0.5 --seeds 2 --first 7 --set horizon=0.5"
    )
    names = figure_files(plan.variants, "svg")
    assert all("/" not in name and ":" not in name and "," not in name for name in names)


def test_compare_takes_faults() -> None:
    board = compare(["mekf"], ENV, [3], overrides={"horizon": 0.4}, faults=["corruption=0.5"])
    assert list(board.variants) == ["nominal", "corruption=0.5"]
    worse, fine = (np.array([row.position_rmse_m for row in board.rows if row.variant == v]) for v in board.variants)
    assert fine[0] == worse[0] and not np.allclose(worse, fine)  # the first one hears nobody


def test_the_command_line(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["bench", "observers", ENV, "--observers", "dead_reckoning", "--seeds", "1", "--set", "horizon=0.3"]
    assert main([*words, "--jobs", "1", "--fault", "gyro_bias=0.1", "--fault", "lie=replay:0.1", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert {row["variant"] for row in document["rows"]} == {"nominal", "gyro_bias=0.1", "lie=replay:0.1"}
    assert main([*words, "--fault", "gyro_bais=1"]) != 0
    assert "did you mean 'gyro_bias'" in capsys.readouterr().err
    assert main(["list", "variants"]) == 0
    assert "lie=KIND" in capsys.readouterr().out


def test_a_log_has_the_faults_of_its_world(tmp_path: Path) -> None:
    """A log keeps no messages: what faults make of them is drawn again, the same for every vehicle and tick."""
    faults = {"corruption": {"probability": 0.3}, "lie": {"kind": "drift", "chance": 0.5}, "clock_offset": 0.1}
    made = record(load_scenario(ENV, {"horizon": 0.5, "faults": {**faults, "restart": {"chance": 0.5}}}), 5)
    write_recording(made, tmp_path / "log.mcap")
    log = find_source(str(tmp_path / "log.mcap"), faults=["v2x_delay=0.1"])
    found, expected = log.recording("nominal", 0).interference, made.interference
    assert found is not None and expected is not None
    for field in fields(Interference):
        assert_array_equal(getattr(found, field.name), getattr(expected, field.name), err_msg=field.name)
    assert expected.shift.any() and expected.clock.any() and expected.restarts.any()
    log.check()
    with pytest.raises(CoopenvError, match="is of a simulated world"):
        find_source(str(tmp_path / "log.mcap"), faults=["gyro_bias=0.1"]).check()
