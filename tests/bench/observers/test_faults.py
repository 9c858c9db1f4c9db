"""Faults: how they are written, what they become, what they change and nothing else."""

from __future__ import annotations

import re
from dataclasses import fields, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation
from scipy.stats import binom

import coopenv
from coopenv.base.errors import CoopenvError
from coopenv.bench.observers.changes import DIRECTION, usual_sender
from coopenv.bench.observers.command import figure_files
from coopenv.bench.observers.faults import FAULTS, VARIANTS, variant_of
from coopenv.bench.observers.sources import SimulatedRecords, find_source, variants_of
from coopenv.cli.bench import ObserverOptions
from coopenv.observers import Message, Recording
from coopenv.observers.faults import Interference, altered
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario
from coopenv.sources.mcap import write_recording

ENV = "busy_intersection_tracking"


def source(*faults: str, env: str = ENV, **overrides: Any) -> SimulatedRecords:
    made = find_source(env, {"horizon": 0.5, **overrides}, faults=faults)
    assert isinstance(made, SimulatedRecords)
    return made


def test_how_a_fault_is_written() -> None:
    lie, bias = variant_of("vehicle_2,vehicle_3:lie=drift:0.05@10,std=1e-2/gyro_bias=1e+1").faults
    assert (lie.name, lie.word, lie.value, lie.vehicles) == ("lie", "drift", 0.05, ("vehicle_2", "vehicle_3"))
    assert lie.start_in(60.0) == 10.0 and lie.options == {"std": 0.01}
    assert (bias.name, bias.value, bias.vehicles, bias.options) == ("gyro_bias", 10.0, (), {})
    wrong, jammer = variant_of("map_error=SL2:0.3@10/jammer=5@2+3,x=-4,duty=0.5").faults
    assert (wrong.word, wrong.value, wrong.start) == ("SL2", 0.3, 10.0)
    assert (jammer.value, jammer.duration, jammer.options) == (5.0, 3.0, {"x": -4.0, "duty": 0.5})
    (lost,) = variant_of("landmarks_lost@60%+10").faults
    assert lost.start_in(50.0) == 30.0 and lost.duration == 10.0


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
    expected = variant_of("v2x_loss=0.4").applied(record(made.scenario, 3), 3)
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
        ("gyro_bais=1", "unknown fault 'gyro_bais' .did you mean 'gyro_bias'"),
        ("gyro_bias=-1", r"gyro_bias: value: expected a number from 0 to 1e\+09, got '-1'"),
        ("gyro_bias=1@3", "gyro_bias: has no start"),
        ("lie=drfit:1", "unknown lie 'drfit' .did you mean 'drift'.*jump, drift, replay"),
        ("vehicle_2:lie=collude:5", "two vehicles collude"),
        ("lie=replay:1000", "expected an age up to 60 s"),
        ("vehicle_9:lie=jump", "unknown vehicle 'vehicle_9'.*there are vehicle_1"),
        ("lie=jump,size=3", "lie: no option 'size'; allowed: std"),
        ("lie=jump,std", "'std' is not OPTION=VALUE"),
        ("vehicle_1:v2x_loss=0.1", "v2x_loss: has no vehicles"),
        ("landmarks_lost", r"expected landmarks_lost@START\+DURATION"),
        ("restart", "expected restart@START"),
        ("map_error=SL9:0.3", "unknown landmark 'SL9' .did you mean.*there are SL1, SL2, SL3"),
        ("jammer=5", "expected jammer, VEHICLE:jammer=METRES or jammer=METRES,x=X,y=Y"),
        ("jammer,period=0", "jammer: period: expected a number from 0.001 to"),
        ("lie=jump,honest_odometry=2", "honest_odometry: expected a whole number from 0 to 1, got '2'"),
        ("lie=replay:1@1,turn=1", "lie: no option 'turn'; allowed: std, honest_odometry"),
        ("lie=jump,std=1,std=2", "'std=2' is not OPTION=VALUE, each option once"),
        ("gyro=offset:1,share=1", "gyro: no option 'share'; allowed: none"),
        ("gyro=sometimes:1", "unknown gyro 'sometimes'.*offset, ramp, drift, walk, intermittent"),
        ("nosuch=1", "known: v2x_loss, .*gyro_step, .*31 in all"),
        ("restart@101%", "restart: start: expected a number from 0 to 100, got '101'"),
    ],
)
def test_what_is_wrong_with_a_fault_is_one_line(fault: str, message: str) -> None:
    with pytest.raises(CoopenvError, match=message) as error:
        source(fault)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("env", "options", "message"),
    [
        (ENV, {"overrides": {"noise.enabled": False}, "faults": ["gyro_bias=0.1"]}, "needs noise.enabled = true"),
        ("mrclam_6", {"faults": ["v2x_loss=0.5"]}, "recorded robots have variants of their own, landmarks"),
        ("mrclam_6", {"policy": "zero"}, "--policy zero: mrclam_6 is recorded"),
        ("crossing_path", {"faults": ["lie=jump"]}, "no vehicle has another one as its neighbour"),
        ("crossing_path", {"faults": ["restart@1"]}, "no vehicle has another one as its neighbour; name one"),
        (ENV, {"policy": "random"}, "no vehicle of this environment is driven"),
        ("urban_crossing", {"policy": "nobody_at_all"}, "nobody_at_all"),
    ],
)
def test_what_a_source_cannot_have(env: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(CoopenvError, match=message):
        variants_of(find_source(env, **options), None)


def test_a_fault_after_the_end_is_refused() -> None:
    """Its row would be the nominal one."""
    for fault in ("restart@2", "lie=jump@2", "landmarks_lost@2+1"):
        records = find_source(ENV, {"horizon": 1.0}, faults=[fault])
        with pytest.raises(CoopenvError, match=rf"^fault {re.escape(fault)}: it begins after the run's end at 1 s$"):
            records.recording(fault, 0)


def test_who_drives() -> None:
    """The records of an environment with driven vehicles are those of the policy, for all variants."""
    driven = find_source("urban_crossing", {"horizon": 1.0}, faults=["v2x_loss=0.5"], policy="random")
    expected = record(load_scenario("urban_crossing", {"horizon": 1.0}), 2, "random")
    for variant in ("nominal", "v2x_loss=0.5"):
        assert_array_equal(driven.recording(variant, 2).truth.position, expected.truth.position)
    standing = find_source("urban_crossing", {"horizon": 1.0}).recording("nominal", 2)
    assert np.abs(standing.truth.position - expected.truth.position).max() > 0.01


def test_variants_and_the_command_that_gives_them_again() -> None:
    faults = ["lie=drift:0.5@0.1", "v2x_loss=0.5"]
    given = ObserverOptions(source=ENV, observers="mekf", seeds=2, first=7, overrides=["horizon=0.5"], faults=faults)
    plan = given.plan()
    assert plan.variants == ("nominal", *faults)
    assert given.command_of(plan) == (
        f"coopenv bench observers {ENV} --observers mekf --variants nominal "
        "--fault lie=drift:0.5@0.1 --fault v2x_loss=0.5 --seeds 2 --first 7 --override horizon=0.5"
    )
    names = figure_files(plan.variants, "svg")
    assert all("/" not in name and ":" not in name and "," not in name for name in names)


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


@cache
def made(**overrides: float) -> Recording:
    options = {key.replace("__", "."): value for key, value in overrides.items()}
    return record(coopenv.load_scenario("busy_intersection", {"horizon": 5.0, **options}), 0)


def changed_by(fault: str, seed: int = 0) -> Recording:
    return variant_of(fault).applied(made(), seed)


def differing(before: Recording, after: Recording) -> set[str]:
    arrays = [f.name for f in fields(Recording) if isinstance(getattr(before, f.name), np.ndarray)]
    return {a for a in arrays if not np.array_equal(getattr(before, a), getattr(after, a), equal_nan=True)}


@pytest.mark.parametrize(
    ("name", "arrays"),
    [
        ("nominal", set()),
        ("v2x_loss", {"inbox_tick"}),
        ("v2x_delay", {"inbox_tick"}),
        ("wrong_association", {"bearings"}),
        ("lying_neighbour", set()),
        ("landmarks_lost", {"bearings", "visible"}),
    ],
)
def test_a_fault_changes_what_it_names(name: str, arrays: set[str]) -> None:
    after, again = (VARIANTS[name].applied(made(), 3) for _ in range(2))
    assert differing(made(), after) == arrays and not differing(after, again)
    assert (after.interference is not None) == (name == "lying_neighbour")
    assert after.truth is made().truth


def test_the_delay_is_the_radio_s() -> None:
    """The recorded world with the same delay in its radio delivers at the same ticks."""
    expected, found = made(v2x__delay=12).inbox_tick, changed_by("v2x_delay=0.2").inbox_tick
    for receiver, setup in enumerate(made().setups):
        senders = setup.targets[setup.targets >= setup.landmarks] - setup.landmarks
        assert_array_equal(found[:, receiver, senders], expected[:, receiver, senders])
    assert (changed_by("v2x_delay=100").inbox_tick == -1).all()


def test_messages_are_lost_independently() -> None:
    sent, heard = made().inbox_tick[:, 1, 0], changed_by("v2x_loss=0.3", 1).inbox_tick[:, 1, 0]
    arrived = np.diff(heard, prepend=-1) > 0
    low, high = binom.ppf([0.001, 0.999], len(sent), 0.7)
    assert low <= arrived.sum() <= high
    assert_array_equal(heard[arrived], sent[arrived])  # those that arrive are the ones of that tick
    assert_array_equal(changed_by("v2x_loss=0").inbox_tick, made().inbox_tick)
    assert (changed_by("v2x_loss=1").inbox_tick == -1).all()


def test_bearings_are_swapped_within_their_frame() -> None:
    after = changed_by("wrong_association=0.05", 1)
    wrong = (after.bearings != made().bearings).any(axis=-1) & made().visible
    n = int(made().visible.sum())
    assert abs(wrong.sum() / n - 0.05) < 4 * np.sqrt(2 * 0.05 / n) + 0.002  # they come in pairs
    for k, i in np.argwhere(wrong.any(axis=-1)):
        seen = made().visible[k, i]
        before, now = (sorted(map(tuple, r.bearings[k, i, seen])) for r in (made(), after))
        assert before == now


@pytest.mark.parametrize(
    ("fault", "arrays"),
    [
        ("gyro_step=0.3", {"angular_velocity", "rotation"}),
        ("camera_step=0.3", {"bearings"}),
        ("focal_step=0.1", {"bearings"}),
    ],
)
def test_a_step_changes_its_vehicle_from_its_time_on(fault: str, arrays: set[str]) -> None:
    """A gyro's increments turn by the bias; a camera turns left; tangents to the optical axis grow by the share."""
    after, late, dt = changed_by(f"vehicle_2:{fault}@1"), made().t >= 1.0 - 1e-9, made().dt
    assert differing(after, made()) == arrays
    for name in arrays:
        assert_array_equal(getattr(after, name)[~late], getattr(made(), name)[~late])
        assert_array_equal(*(np.delete(getattr(r, name), 1, axis=1) for r in (after, made())))
    before, now = made().bearings[late, 1], after.bearings[late, 1]
    if fault.startswith("gyro"):
        difference = (after.angular_velocity - made().angular_velocity)[late, 1]
        assert_allclose(difference, np.broadcast_to([0.0, 0.0, 0.3], difference.shape), atol=1e-12)
        turned = made().rotation[late, 1].swapaxes(-1, -2) @ after.rotation[late, 1]
        assert_allclose(np.arctan2(turned[:, 1, 0], turned[:, 0, 0]), 0.3 * dt, atol=1e-12)
    elif fault.startswith("camera"):
        turned = Rotation.from_euler("z", -0.3).apply(before.reshape(-1, 3))
        assert_allclose(now.reshape(-1, 3), turned, atol=1e-12)
    else:
        along, along_now = (bearings @ np.array(made().setups[1].optical_axis) for bearings in (before, now))
        tangents, tangents_now = (np.sqrt(1.0 - share**2) / share for share in (along, along_now))
        assert_allclose(tangents_now, 1.1 * tangents, rtol=1e-9)
        assert_allclose(np.linalg.norm(now[np.isfinite(now[..., 0])], axis=-1), 1.0)


def test_initial_estimates_are_off() -> None:
    """By a distance, in a direction that is drawn or given."""
    shift = changed_by("vehicle_2:prior_error=3").start_position - made().start_position
    assert_allclose(np.linalg.norm(shift[:, :2], axis=1), 3.0 * (np.arange(len(shift)) == 1))
    given = changed_by("prior_error=2,angle=0")
    assert_allclose(given.start_position - made().start_position, np.tile([2.0, 0.0, 0.0], (len(shift), 1)), atol=1e-12)
    assert differing(given, made()) == {"start_position"}


def test_the_scale_error_grows_to_its_value() -> None:
    after, end = changed_by("scale_drift=0.1@1"), made().t[-1]
    for name in ("velocity", "translation"):
        expected = (
            getattr(made(), name) * (1.0 + 0.1 * np.clip((made().t - 1.0) / (end - 1.0), 0.0, 1.0))[:, None, None]
        )
        assert_allclose(getattr(after, name), expected)
    assert differing(after, made()) == {"velocity", "translation"}


def test_a_constant_scale_error_begins_at_its_time() -> None:
    after, late = changed_by("vehicle_1:scale=offset:0.02@2"), made().t >= 2.0 - 1e-9
    for name in ("velocity", "translation"):
        expected = getattr(made(), name).copy()
        expected[late, 0] *= 1.02
        assert_allclose(getattr(after, name), expected)
    assert differing(after, made()) == {"velocity", "translation"}


def test_cameras_turn_slowly() -> None:
    after = changed_by("vehicle_2:camera=drift:0.1@2")
    turned = Rotation.from_euler("z", -0.1 * 2.0).apply(made().bearings[240, 1].copy())  # 4 s after the start
    assert_allclose(after.bearings[240, 1], turned, atol=1e-9)
    assert_array_equal(after.bearings[:120], made().bearings[:120])
    assert_array_equal(np.delete(after.bearings, 1, axis=1), np.delete(made().bearings, 1, axis=1))


def test_late_frames_show_the_world_as_it_was() -> None:
    """A delay by whole frames shifts bearings; half a frame lies between two; the first frames are not measured."""
    after, halved = changed_by("vehicle_1:late_frames=0.05"), changed_by(f"late_frames={made().dt / 2:.17g}")
    assert_allclose(after.bearings[3:, 0], made().bearings[:-3, 0], atol=1e-9)
    assert_array_equal(np.delete(after.bearings, 0, axis=1), np.delete(made().bearings, 0, axis=1))
    mean = made().bearings[:-1] + made().bearings[1:]
    assert_allclose(halved.bearings[1:], mean / np.linalg.norm(mean, axis=-1, keepdims=True), atol=1e-9)
    assert_allclose(changed_by("late_frames=0").bearings, made().bearings, atol=1e-12)
    assert_array_equal(after.visible, made().visible & np.isfinite(after.bearings).all(axis=-1))


def test_reflections_come_in_bursts_to_landmarks_alone() -> None:
    """A mirrored bearing keeps its height and its part along the vehicle's way."""
    after, L = changed_by("reflections=0.3,burst=0.25", 1), made().landmarks.shape[1]
    wrong = (after.bearings != made().bearings).any(axis=-1) & made().visible
    assert not wrong[:, :, L:].any() and 0.1 < wrong[:, :, :L].sum() / made().visible[:, :, :L].sum() < 0.5
    starts = np.flatnonzero(np.diff(wrong[:, 0, 0].astype(int), prepend=0) != 0)
    assert len(starts) > 2 and (starts % 15 == 0).all()  # a landmark in view of the first vehicle throughout
    before, now = made().bearings[wrong], after.bearings[wrong]
    vehicle = np.nonzero(wrong)[1]
    way = made().velocity.mean(axis=0)[vehicle, :2]
    assert_allclose(now[:, 2], before[:, 2])
    assert_allclose(np.sum(now[:, :2] * way, axis=-1), np.sum(before[:, :2] * way, axis=-1), atol=1e-9)
    assert_allclose(now[:, 0] * way[:, 1] - now[:, 1] * way[:, 0], before[:, 1] * way[:, 0] - before[:, 0] * way[:, 1])


def test_correlated_errors_of_bearings_last_for_their_time() -> None:
    after = changed_by("correlated_bearings=0.01,time=0.5", 2)
    error = (after.bearings - made().bearings).reshape(made().ticks, -1)
    error = error[:, np.isfinite(error).all(axis=0)]
    assert_allclose(np.linalg.norm(after.bearings[made().visible], axis=-1), 1.0)
    tangent = 2.0 / 3.0  # of the variance of three axes stays in a unit vector
    assert_allclose(error.std(), 0.01 * np.sqrt(tangent), rtol=0.3)
    correlation = np.mean(error[6:] * error[:-6]) / np.mean(error**2)
    assert_allclose(correlation, np.exp(-0.1 / 0.5), atol=0.1)


def test_maps_are_wrong_everywhere() -> None:
    noise = changed_by("map_noise=0.5", 3).landmarks - made().landmarks
    assert_allclose(noise, np.broadcast_to(noise[0], noise.shape), atol=1e-12)
    assert 0.2 < noise[0].std() < 0.9 and np.unique(noise[0].round(9)).size == noise[0].size
    exchanged = changed_by("map_exchange", 1).landmarks
    moved = np.flatnonzero((exchanged != made().landmarks).any(axis=(0, 2)))
    assert len(moved) == 2
    assert_array_equal(exchanged[:, moved], made().landmarks[:, moved[::-1]])


def test_a_landmark_moves_on_maps_alone() -> None:
    shift = changed_by("landmark=drift:0.5@1,landmark=2,angle=0").landmarks - made().landmarks
    expected = np.zeros_like(shift)
    expected[:, 1, 0] = 0.5 * np.maximum(0.0, made().t - 1.0)
    assert_allclose(shift, expected, atol=1e-12)
    drawn = changed_by("landmark=offset:0.5", 4).landmarks - made().landmarks
    assert_allclose(np.sort(np.linalg.norm(drawn, axis=-1), axis=1)[:, -2:], [[0.0, 0.5]] * made().ticks)
    with pytest.raises(CoopenvError, match=r"landmark=offset,landmark=9: landmark: expected a number up to 3, got 9"):
        changed_by("landmark=offset,landmark=9")


def test_an_error_walks_at_random() -> None:
    """Over time t its variance is the square of its value times t, for each vehicle on its own."""
    steps = []
    for seed in range(8):
        bias = (changed_by("gyro=walk:0.1@1", seed).angular_velocity - made().angular_velocity)[..., 2]
        assert not bias[made().t < 1.0].any()
        steps.append(np.diff(bias[60:], axis=0))
    walked = np.array(steps)
    assert_allclose(walked.std(), 0.1 * np.sqrt(made().dt), rtol=0.05)
    assert abs(np.corrcoef(walked[..., 0].ravel(), walked[..., 1].ravel())[0, 1]) < 0.1


def test_an_error_comes_and_goes() -> None:
    bias = changed_by("vehicle_1:gyro=intermittent:0.3@1,share=0.4,burst=0.1", 2).angular_velocity
    there = (bias - made().angular_velocity)[:, 0, 2].round(9)
    assert set(there) == {0.0, 0.3} and not there[:60].any()
    assert 0.2 < np.mean(there[60:] > 0.0) < 0.6
    assert (np.flatnonzero(np.diff(there)) % 6 == 5).all()  # bursts of six ticks


def test_a_share_of_the_bearings_is_random() -> None:
    after = changed_by("random_bearings=0.1", 1)
    wrong = (after.bearings != made().bearings).any(axis=-1)[made().visible]
    assert abs(wrong.mean() - 0.1) < 4 * np.sqrt(0.09 / len(wrong))
    assert_allclose(np.linalg.norm(after.bearings[made().visible], axis=-1), 1.0)


def test_a_single_bearing_keeps_its_identity() -> None:
    alone = np.zeros_like(made().visible)
    alone[:, :, 0] = made().visible[:, :, 0]
    lonely = replace(made(), visible=alone, bearings=np.where(alone[..., None], made().bearings, np.nan))
    assert not differing(lonely, variant_of("wrong_association=1").applied(lonely, 0))


def test_landmarks_are_lost_for_a_while() -> None:
    after = changed_by("landmarks_lost@1+2")
    during = (made().t >= 1.0) & (made().t < 3.0)
    assert during.sum() == 120
    assert not after.visible[during, :, :3].any() and np.isnan(after.bearings[during, :, :3]).all()
    assert_array_equal(after.visible[:, :, 3:], made().visible[:, :, 3:])
    assert_array_equal(after.visible[~during], made().visible[~during])
    assert differing(after, made()) == {"bearings", "visible"}


LIE = {"start": 0.33, "std": 0.1, "direction": list(DIRECTION)}
MAP = {"landmark": "SL2", "offset": 0.3, "direction": [0.0, 1.0, 0.0], "start": 0.33}


@pytest.mark.parametrize(
    ("text", "faults", "delay"),
    [
        ("vehicle_3:lie=jump:3@33%,std=0.1", {"lie": {"kind": "jump", "offset": 3.0, **LIE}}, 0),
        ("vehicle_3:lie=drift:0.5@33%,std=0.1", {"lie": {"kind": "drift", "speed": 0.5, **LIE}}, 0),
        ("vehicle_3:lie=replay:0.3@33%,std=0.1", {"lie": {"kind": "replay", "age": 0.3, **LIE}}, 0),
        ("jammer@33%+0.4", {"jammer": {"start": 0.33, "duration": 0.4}}, 2),
        ("vehicle_3:jammer=20,period=0.2,duty=0.5", {"jammer": {"range": 20.0, "period": 0.2, "duty": 0.5}}, 2),
        ("jammer=17,x=-2,y=-2,z=2", {"jammer": {"range": 17.0, "position": [-2.0, -2.0, 2.0]}}, 2),
        (f"vehicle_3:map_error=SL2:0.3@33%,angle={np.pi / 2}", {"map_error": MAP}, 0),
    ],
)
def test_faults_of_a_recording_are_those_of_a_scenario(text: str, faults: dict[str, Any], delay: int) -> None:
    (name,) = faults
    drawn = {} if name == "lie" else {"chance": 1.0}
    overrides = {"horizon": 1.0, "vehicles.vehicle_3.faults": {name: {**drawn, **faults[name]}}, "v2x.delay": delay}
    expected = record(coopenv.load_scenario("busy_intersection", overrides), 0)
    plain = made(horizon=1.0, v2x__delay=delay)
    after = variant_of(text).applied(plain, 0)
    assert not differing(after, expected)
    assert differing(plain, after) == ({"inbox_tick"} if name == "jammer" else set())
    for field in fields(Interference) if name != "jammer" else ():
        found, wanted = (getattr(r.interference, field.name) for r in (after, expected))
        assert_allclose(found, wanted, atol=1e-12 if name == "map_error" else 1e-6, err_msg=field.name)
    if name == "map_error":
        assert after.interference is not None
        assert_allclose(after.interference.map_error_of(2, 20), [[0, 0, 0], [0, 0.3, 0], [0, 0, 0]], atol=1e-12)
        assert not after.interference.map_error_of(2, 19).any() and not after.interference.map_error_of(1, 20).any()


def test_drawn_errors_of_a_map() -> None:
    after = variant_of("map_error=0.5,spread=0.2").applied(made(), 4)
    assert after.interference is not None
    size = np.linalg.norm(after.interference.map_error, axis=-1)
    assert (size >= 0.5).all() and (size <= 0.7).all() and np.ptp(size) > 0.0
    assert (after.interference.map_error == after.interference.map_error[:1]).all()
    assert_array_equal(after.landmarks, made().landmarks)  # the truth, of which bounds and figures are made


def test_a_jammer_needs_true_positions() -> None:
    unknown = replace(made(), truth=replace(made().truth, position=np.full_like(made().truth.position, np.nan)))
    with pytest.raises(CoopenvError, match="true positions are not known"):
        variant_of("vehicle_2:jammer=10").applied(unknown, 0)
    assert (variant_of("jammer").applied(unknown, 0).inbox_tick == -1).all()


def test_the_direction_of_a_lie() -> None:
    drift, step = (variant_of(f"lie=drift:0.5@{at},angle={angle}") for at, angle in ((0.5, 0.0), (0.25, np.pi / 2)))
    both = step.applied(drift.applied(made(horizon=1.0), 0), 0).interference
    assert both is not None
    assert_allclose(both.shift[-1, 1], [0.25, 0.375, 0.0], atol=1e-12)


def test_an_observer_adapts_its_own_entries_to_a_lie() -> None:
    class Own:
        def tampered(self, made: Message, honest: Message) -> Message:
            return replace(made, extra={"twice": made.position + honest.position})

    shift = np.array([3.0, 4.0, 0.0])
    assert_array_equal(altered(Own(), Message(position=np.ones(3)), shift).extra["twice"], [5.0, 6.0, 2.0])
    assert not altered(Own(), Message(position=np.ones(3)), shift, consistent=False).extra
    bare = Message(position=np.ones(3), covariance=np.eye(6, dtype=np.float32))
    bare = altered(object(), bare, shift, std=0.01)
    assert bare.covariance is not None and bare.covariance.shape == (6, 6) and bare.rotation is None
    assert bare.covariance.dtype == np.float32  # a lie takes no more bytes


def test_a_record_without_followers_has_no_usual_sender() -> None:
    assert usual_sender(made()) == 1
    lonely = replace(made(), setups=tuple(replace(s, targets=np.arange(3)) for s in made().setups))
    with pytest.raises(CoopenvError, match="no vehicle has another one"):
        usual_sender(lonely)
