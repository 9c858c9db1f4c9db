"""When messages come: what is stated of outages, duplicates, delays, drifts and frames, and what is ordinary."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from coopenv.cars.doctor.finding import Treatment
from coopenv.cars.doctor.timing import of_delays, of_drift, of_duplicates, of_frames, of_losses, of_outages, of_repeats
from coopenv.cars.messages.readings import CarPose, Detections, Sample, Twist
from coopenv.cars.messages.stated import Stated
from coopenv.cars.settings.profile import Role

S = 1_000_000_000
EVERY = np.arange(0.0, 20.0, 0.02)


def samples(times: np.ndarray, role: Role = Role.IMU, stated: Stated | None = None) -> list[Sample]:
    values = {
        Role.IMU: lambda t: Twist(None, np.array([0.0, 0.0, np.sin(t)])),
        Role.TRUTH: lambda t: CarPose(np.array([np.floor(50.0 * t) / 50.0, 0.0, 0.0])),
        Role.DETECTIONS: lambda t: Detections((1,), np.array([[0.0, 0.0, 1.0]])),
    }
    made = values[role]
    return [Sample("car", role, round(S * t), round(S * t), made(t), stated or Stated()) for t in times]


def silent(*gaps: tuple[float, float]) -> np.ndarray:
    kept = np.ones(len(EVERY), dtype=bool)
    for begin, end in gaps:
        kept &= (begin > EVERY) | (end < EVERY)
    return EVERY[kept]


def test_an_outage_is_stated_and_short_ones_are_ordinary() -> None:
    [found] = of_outages(samples(silent((5.0, 8.0), (12.0, 14.0))), "/imu", 0, 20 * S)
    assert found.treatment is Treatment.USED and "an outage of 3.0 s after 5.0 s, the longest of 2" in str(found)
    assert not [*of_outages(samples(silent((5.0, 6.0), (9.0, 9.5))), "/imu", 0, 20 * S)]
    [ended] = of_outages(samples(EVERY[EVERY < 12.0]), "/imu", 0, 20 * S)
    assert ended.size == pytest.approx(8.0, abs=0.05)


def test_a_camera_that_is_silent_without_a_marker_has_no_outage() -> None:
    often = silent(*((begin, begin + 2.0) for begin in np.arange(1.0, 19.0, 3.0)))
    assert not [*of_outages(samples(often, Role.DETECTIONS), "/camera", 0, 20 * S)]
    assert [*of_outages(samples(silent((5.0, 9.0)), Role.DETECTIONS), "/camera", 0, 20 * S)]


def test_messages_that_come_twice_are_left_out_by_their_stamp() -> None:
    sent = samples(np.repeat(np.arange(1, 200) * 0.01, 2))
    [found] = of_duplicates(sent, "/imu")
    assert found.treatment is Treatment.LEFT_OUT and "199 of 398 messages are duplicates" in found.text
    undated = [replace(sample, stamp=0) for sample in sent]
    assert not [*of_duplicates(sent[::2], "/imu")] and not [*of_duplicates(undated, "/imu")]


def test_other_values_with_the_same_stamp_are_no_duplicates() -> None:
    coarse = [replace(sample, stamp=sample.stamp // 40_000_000 * 40_000_000) for sample in samples(EVERY + 1.0)]
    [found] = of_duplicates(coarse, "/imu")
    assert "stamps are coarse" in found.text and "duplicate" not in found.text


def test_a_topic_that_begins_late_has_an_outage() -> None:
    [found] = of_outages(samples(EVERY[EVERY > 15.0]), "/pose", 0, 20 * S)
    assert found.size == pytest.approx(15.0, abs=0.05) and "after 0.0 s" in found.text


def test_poses_that_repeat_under_new_stamps_are_duplicates() -> None:
    assert [*of_repeats(samples(np.arange(0.0, 20.0, 0.01), Role.TRUTH), "/pose")]
    assert not [*of_repeats(samples(EVERY + 0.001, Role.TRUTH), "/pose")] and not [*of_repeats(samples(EVERY), "/imu")]


def test_frames_that_a_camera_holds_are_duplicates() -> None:
    """Of every rate; whole pixels of a slow car repeat themselves too, yet not as often each."""
    rng, held = np.random.default_rng(0), []
    for n in (2, 3):
        ray = np.repeat(rng.normal(size=(300, 3)), n, axis=0)
        held.append([replace(s, value=Detections((1,), r[None])) for s, r in zip(samples(EVERY), ray, strict=False)])
    slow = np.repeat(rng.normal(size=(300, 3)), rng.integers(1, 6, 300), axis=0)
    own = [replace(s, value=Detections((1,), r[None])) for s, r in zip(samples(EVERY), slow, strict=False)]
    empty = [replace(s, value=Detections((), np.zeros((0, 3)))) for s in samples(EVERY)]
    for some in held:
        [found] = of_repeats([replace(s, role=Role.DETECTIONS) for s in some], "/camera")
        assert "repeat the value of the one before" in found.text
    assert not [f for some in (own, empty) for f in of_repeats([replace(s, role=Role.DETECTIONS) for s in some], "/c")]


@pytest.mark.parametrize("pattern", [(1, 2), (1, 1, 3), (2, 3)])
def test_frames_held_in_a_pattern_are_duplicates(pattern: tuple[int, ...]) -> None:
    ray = np.random.default_rng(0).normal(size=(900, 3))
    number = np.repeat(np.arange(900), np.resize(pattern, 900))
    held = [replace(s, value=Detections((1,), ray[n][None])) for s, n in zip(samples(EVERY), number, strict=False)]
    assert [*of_repeats([replace(s, role=Role.DETECTIONS) for s in held], "/camera")]


def test_messages_lost_at_random_are_stated_and_other_irregular_ones_are_not() -> None:
    rng, sent = np.random.default_rng(0), samples(EVERY)
    kept = [sample for sample in sent if rng.random() < 0.5]
    [found] = of_losses(kept, "/imu")
    assert found.size == pytest.approx(0.5, abs=0.06) and "multiples of 20 ms" in found.text
    jitter = samples(np.cumsum(rng.uniform(0.01, 0.04, 800)))
    few = [sample for sample in sent if rng.random() < 0.9]
    burst = [sample for sample in sent if not 5 * S < sample.stamp < 12 * S]
    assert not [f for some in (sent, sent[::2], jitter, few, burst) for f in of_losses(some, "/imu")]


def test_a_delay_that_changes_is_stated() -> None:
    stamps = np.arange(1, 1000) * 10_000_000
    jitter = np.abs(np.random.default_rng(0).normal(0.0, 0.005 * S, len(stamps))).astype(np.int64)
    assert not [*of_delays(stamps, stamps + S + jitter, "/imu", "car")]
    emptied = -(-stamps // (S // 2)) * (S // 2)
    [found] = of_delays(stamps, emptied, "/imu", "car")
    assert "up to 0.4" in found.text and found.treatment is Treatment.USED


def test_no_crystal_drifts_by_two_milliseconds_per_second() -> None:
    assert not [*of_drift(80e-6, "/imu", "car")]
    [found] = of_drift(-0.002, "/imu", "car")
    assert "-2000 us per s" in found.text and found.treatment is Treatment.MENDED


@pytest.mark.parametrize(
    ("child", "in_the_room", "words"),
    [("car", False, ""), ("car", True, "pose's frame"), ("odom", False, "body's frame"), ("odom", True, "")],
)
def test_the_frame_that_a_twist_states_is_tested(child: str, in_the_room: bool, words: str) -> None:
    about = samples(EVERY, stated=Stated(frame="odom", child_frame=child))
    found = [str(finding) for finding in of_frames(about, "/odom", {"mocap"}, in_the_room)]
    assert bool(found) == bool(words) and all(words in line for line in found)
