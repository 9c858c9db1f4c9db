"""The gate on drives that are computed here: each fault is named by its cause, and sound drives are silent."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coopenv.cars.backend.binding import Binding, bind
from coopenv.cars.bags.clocks import SampledSignal
from coopenv.cars.calibration.drives import drive_of_car, streams_of_recording
from coopenv.cars.doctor import doctor
from coopenv.cars.doctor.doctor import examine, examine_cars, examine_constants
from coopenv.cars.doctor.finding import Diagnosis, Finding, Treatment, with_error
from coopenv.cars.doctor.live import StreamMonitor
from coopenv.cars.doctor.motion import of_frozen_streams, velocity_relations
from coopenv.cars.doctor.relation import relation
from coopenv.cars.doctor.sight import BAD, sight_of, thinned
from coopenv.cars.doctor.streams import CarStreams, Streams
from coopenv.cars.messages.readings import CarPose, Detections, Sample, Twist
from coopenv.cars.messages.vision import Calibration
from coopenv.cars.settings.deployment import Car
from coopenv.cars.settings.profile import Role
from coopenv.runs.recorder import record
from coopenv.scenario import load_scenario

PLACES = np.array([[0.3, 2.6, 0.45], [-1.9, 2.2, 0.08], [2.1, 1.5, 0.25], [2.4, -1.3, 0.5], [-0.8, -2.3, 0.3]])
NAMES = ("SL1", "SL2", "SL4", "SL5", "ML")
LENS = Calibration((316, 208), (213.0, 213.0), (158.0, 104.0), (0.0,) * 5)
LEVER = np.array([0.3218, 0.0, 0.2233])
AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
S = 1_000_000_000


def turn(yaw: float) -> np.ndarray:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def binding(places: np.ndarray = PLACES) -> Binding:
    """A car among five standing landmarks, whose camera looks ahead and has no distortion."""
    overrides: dict[str, Any] = {f"landmarks.{n}.position": p.tolist() for n, p in zip(NAMES, places, strict=True)}
    overrides |= {"camera.distortion": [0.0] * 5, "camera.focal_length": [213.0, 213.0]}
    overrides |= {"camera.principal_point": [158.0, 104.0], "landmarks.ML.motion": {"kind": "static"}}
    overrides |= {f"landmarks.{n}.marker": [0.0, 0.0, 0.0] for n in NAMES}
    scenario = load_scenario("svea_crossing", overrides)
    return bind(scenario, (Car(name="car", marker=9),), {n: k + 1 for k, n in enumerate(NAMES)}, "here", None)


@cache
def driven(seed: int = 0, seconds: float = 24.0) -> tuple[Sample, ...]:
    """Return the samples of a car that drives loops among the landmarks, by formulas of its own."""
    rng, dt = np.random.default_rng(seed), 0.005
    t = np.arange(0.0, seconds, dt)
    speed = 0.5 + 0.2 * np.sin(0.9 * t + seed)
    rate = 0.5 + 0.7 * np.sin(2.0 * np.pi * t / 7.0 + seed)
    yaw = 1.0 + seed + np.cumsum(rate) * dt
    place = np.cumsum(speed * np.exp(1j * yaw)) * dt
    place -= 0.5 * (place.real.min() + place.real.max()) + 0.5j * (place.imag.min() + place.imag.max())
    found = []

    def sample(role: Role, k: int, value: Any) -> None:
        found.append(Sample("car", role, S + round(S * t[k]), S + round(S * t[k]), value))

    for k in range(0, len(t), 2):
        turning = 0.01 * rng.normal(size=3) + [0.0, 0.0, rate[k] + 0.003]
        sample(Role.IMU, k, Twist(None, turning))
    for k in range(1, len(t), 4):
        sample(Role.WHEEL, k, Twist(np.array([1.01 * speed[k] + 0.01 * rng.normal(), 0.0, 0.0]), None))
        noise = 0.0005 * rng.normal(size=2)
        at = np.array([place[k].real + noise[0], place[k].imag + noise[1], 0.0])
        sample(Role.TRUTH, k, CarPose(at, turn(yaw[k] + 0.001 * rng.normal())))
    for k in range(2, len(t), 6):
        ray = ((PLACES - [place[k].real, place[k].imag, 0.0]) @ turn(yaw[k]) - LEVER) @ AHEAD
        pixel = np.rint(
            213.0 * ray[:, :2] / np.maximum(ray[:, 2:], 1e-3) + [158.0, 104.0] + rng.normal(size=(5, 2)) * 0.4
        )
        seen = np.flatnonzero((ray[:, 2] > 0.3) & ((pixel >= 0.0) & (pixel < [316.0, 208.0])).all(axis=1))
        units = np.column_stack([(pixel[seen] - [158.0, 104.0]) / 213.0, np.ones(len(seen))])
        units /= np.linalg.norm(units, axis=1, keepdims=True)
        sample(Role.DETECTIONS, k, Detections(tuple((seen + 1).tolist()), units))
    return tuple(sorted(found, key=lambda one: one.stamp))


Change = Callable[[Any, float], Any]


def twist(linear: float = 1.0, angular: float = 1.0, after: float = 0.0) -> Change:
    def change(value: Any, t: float) -> Any:
        if not isinstance(value, Twist) or t < after:
            return value
        v, w = value.linear, value.angular
        return Twist(None if v is None else linear * v, None if w is None else angular * w)

    return change


def axes(value: Any, _: float) -> Any:
    return replace(value, angular=value.angular[::-1]) if getattr(value, "angular", None) is not None else value


def pose(place: Callable[[np.ndarray], np.ndarray], heading: Callable[[float], float]) -> Change:
    def change(value: Any, _: float) -> Any:
        if not isinstance(value, CarPose) or value.rotation is None:
            return value
        return CarPose(place(value.position), turn(heading(float(np.arctan2(*value.rotation[1::-1, 0])))))

    return change


def whole_pose(convention: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]) -> Change:
    """Rotations and positions as another convention states them."""

    def change(value: Any, _: float) -> Any:
        if not isinstance(value, CarPose) or value.rotation is None:
            return value
        rotation, position = convention(value.rotation, value.position)
        return CarPose(position, rotation)

    return change


def scalar_first(R: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    x, y, z, w = Rotation.from_matrix(R).as_quat()
    return Rotation.from_quat([w, x, y, z]).as_matrix(), p


Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def flipping(value: Any, t: float) -> Any:
    """Every twentieth pose has its heading turned by 180 deg."""
    if not isinstance(value, CarPose) or value.rotation is None or round(50.0 * t) % 20:
        return value
    return CarPose(value.position, value.rotation @ turn(np.pi))


def slipping(value: Any, t: float) -> Any:
    return twist(linear=2.0)(value, t) if 8.0 < t < 12.0 else value


def seen(ray: Callable[[np.ndarray], np.ndarray], number: Callable[[int], int] = int) -> Change:
    def change(value: Any, _: float) -> Any:
        if not isinstance(value, Detections):
            return value
        units = ray(value.bearings.copy()) if len(value.bearings) else value.bearings
        units = units / np.linalg.norm(units, axis=1, keepdims=True)
        return Detections(tuple(map(number, value.markers)), units)

    return change


def shaken(value: Any, t: float) -> Any:
    noise = 0.3 * np.random.default_rng(round(1e6 * t)).normal(size=3)
    return replace(value, angular=value.angular + noise) if getattr(value, "angular", None) is not None else value


def sometimes_elsewhere(ray: np.ndarray) -> np.ndarray:
    rng = np.random.default_rng(round(1e9 * abs(float(ray[0, 0]))))
    return ray + 0.5 * rng.normal(size=ray.shape) * [1.0, 1.0, 0.0] * (rng.random((len(ray), 1)) < 0.2)


def stuck(value: Any, t: float) -> Any:
    return CarPose(np.array([0.3, 0.2, 0.0]), turn(1.0)) if isinstance(value, CarPose) and 8.0 < t < 14.0 else value


def same(value: Any) -> Any:
    return value


def narrow(factor: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda ray: ray * [1.0 / factor, 1.0 / factor, 1.0]


FAULTS: dict[str, tuple[Change, str, Treatment | None]] = {
    "gyro reversed": (
        twist(angular=-1.0),
        r"turn rate of car is -[01]\.\d+\(\d+\) times .* other sign",
        Treatment.MENDED,
    ),
    "gyro in degrees": (twist(angular=57.29578), "turn rate .*deg/s instead of rad/s", Treatment.MENDED),
    "gyro of a wrong scale": (twist(angular=1.3), r"turn rate of car is 1\.(30|29)\d*\(", Treatment.REFUSED),
    "gyro is zero": (twist(angular=0.0), "turn rate of car is 0 rad/s in all", Treatment.REFUSED),
    "gyro ends": (twist(angular=0.0, after=12.0), "turn rate of car is 0 rad/s in a row for 12", Treatment.REFUSED),
    "gyro with noise": (shaken, r"noise of the turn rate of car is \d+\.\d\(\d+\) times the declared", Treatment.USED),
    "gyro with other axes": (axes, "turns about the x axis", Treatment.REFUSED),
    "wheels reversed": (twist(linear=-1.0), "velocity of car .* other sign", Treatment.MENDED),
    "wheels in km/h": (twist(linear=3.6), "velocity of car .*km/h instead of m/s", Treatment.MENDED),
    "wheels in mph": (twist(linear=2.237), "velocity of car .*mph instead of m/s", Treatment.MENDED),
    "wheels in mm/s": (twist(linear=1000.0), "velocity of car .*mm/s instead of m/s", Treatment.MENDED),
    "wheels in rpm": (
        twist(linear=9.549 / 0.05),
        r"velocity of car is 19\d\(?\d?.* in rad/s, or of 0.0[45]\d? m in rpm",
        Treatment.REFUSED,
    ),
    "wheels end": (twist(linear=0.0, after=12.0), "velocity of car is 0 m/s in a row", Treatment.REFUSED),
    "truth in mm": (pose(lambda p: 1000.0 * p, float), "motion capture of car.* it is in mm", Treatment.USED),
    "truth mirrored": (pose(lambda p: p * [1, -1, 1], lambda a: -a), "motion capture .* mirrored", Treatment.USED),
    "truth with one other sign": (
        pose(lambda p: p * [-1, 1, 1], float),
        "motion capture .* x has the other sign, and its heading is right",
        Treatment.USED,
    ),
    "truth in another frame": (
        pose(lambda p: turn(0.6) @ p + [1.0, 0.0, 0.0], lambda a: a + 0.6),
        r"its frame is -34\.\d deg",
        Treatment.USED,
    ),
    "body of truth turned": (pose(same, lambda a: a + np.pi / 2), "its body is turned by 90 deg", Treatment.USED),
    "quaternions with the scalar first": (
        whole_pose(scalar_first),
        r"motion capture .*order w, x, y, z.*bearings, turn rates, velocities agree",
        Treatment.REFUSED,
    ),
    "the y axis is up": (
        whole_pose(lambda R, p: (Y_UP @ R @ Y_UP.T, Y_UP @ p)),
        "its axis y is up. With",
        Treatment.REFUSED,
    ),
    "the y axis of the room is up": (
        whole_pose(lambda R, p: (Y_UP @ R, Y_UP @ p)),
        "its axis y is up. With",
        Treatment.REFUSED,
    ),
    "inverse poses": (whole_pose(lambda R, p: (R.T, -R.T @ p)), "its poses are inverse", Treatment.REFUSED),
    "poses of the camera": (
        whole_pose(lambda R, p: (R @ AHEAD, p + R @ LEVER)),
        "poses are those of the camera's optical frame",
        Treatment.REFUSED,
    ),
    "positions of the camera": (
        whole_pose(lambda R, p: (R, p + R @ LEVER)),
        "its positions are those of the camera",
        Treatment.REFUSED,
    ),
    "truth flips": (flipping, r"flips to another heading .* in 60 of 1200 poses, 5.0%", Treatment.LEFT_OUT),
    "wheels slip": (slipping, r"slips for \d\.\d s, 1\d% of the drive, from [78]\.\d to 12\.\d s", Treatment.USED),
    "truth stuck": (stuck, r"repeats one pose of car for 6\.0 s", Treatment.LEFT_OUT),
    "image mirrored": (seen(lambda ray: ray * [-1, 1, 1]), "its image is mirrored", Treatment.REFUSED),
    "twice the focal length": (seen(narrow(2.0)), r"focal length is (2\.0|1\.9)\d*\(\d+\) times", Treatment.REFUSED),
    "markers exchanged": (seen(same, lambda n: {1: 4, 4: 1}.get(n, n)), "SL1 and SL5 are exchanged", Treatment.REFUSED),
    "every marker one further": (
        seen(same, lambda n: n % 5 + 1),
        r"SL1, SL2, SL4, SL5, ML stand at ML, SL1, SL2, SL4, SL5.* = \{ SL1 = 2, SL2 = 3, .* ML = 1 \}",
        Treatment.REFUSED,
    ),
    "false detections": (
        seen(sometimes_elsewhere),
        r"most bearings fit: false detections.*: 1\d% of the bearings are off",
        Treatment.USED,
    ),
    "focal length 3 % off": (seen(narrow(1.03)), "focal length: a wrong constant", Treatment.USED),
    "camera to the right": (
        seen(lambda ray: ray @ np.array([[0.9962, 0, 0.0872], [0, 1, 0], [-0.0872, 0, 0.9962]])),
        "camera orientation|mounting is 5",
        None,
    ),
}
"""Changes of values, words of the true cause, and the treatment (None: either)."""


def streams_of(change: Change | None, truth: bool = True, seed: int = 0, places: np.ndarray = PLACES) -> Streams:
    """Return the streams of a drive with a fault."""
    given = [s for s in driven(seed) if truth or s.role is not Role.TRUTH]
    if change is not None:
        given = [replace(s, value=change(s.value, 1e-9 * s.stamp - 1.0)) for s in given]
    topics = {("car", s.role): f"/car/{s.role.value}" for s in given}
    return Streams(given, binding(places), topics, {"car": LENS})


def findings_of(streams: Streams, trusted: tuple[str, ...] = ()) -> list[Any]:
    found = examine(streams, trusted)
    return [*found.findings, *examine_constants(found, partial(drive_of_car, streams), trusted)]


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_named_by_its_cause(name: str) -> None:
    change, words, treatment = FAULTS[name]
    found = findings_of(streams_of(change))
    named = [finding for finding in found if re.search(words, str(finding))]
    assert named, [str(finding) for finding in found]
    assert treatment in (None, named[0].treatment)
    assert len(found) == len(named), [str(finding) for finding in found]


@pytest.mark.parametrize("truth", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_a_sound_drive_is_silent(truth: bool, seed: int) -> None:
    assert not [str(finding) for finding in findings_of(streams_of(None, truth, seed))]


def test_flipped_poses_are_left_out_and_no_other() -> None:
    streams = streams_of(FAULTS["truth flips"][0])
    mended = [s for s in examine(streams).mended(streams.samples) if s.role is Role.TRUTH]
    right = {s.stamp: s.value.rotation for s in driven() if s.role is Role.TRUTH}
    assert len(mended) == len(right) - 60
    assert all(np.array_equal(s.value.rotation, right[s.stamp]) for s in mended)


def test_a_body_that_jumps_once_does_not_flip() -> None:
    def change(value: Any, t: float) -> Any:
        return FAULTS["body of truth turned"][0](value, t) if t > 12.0 else value

    assert not any("flips" in str(finding) for finding in findings_of(streams_of(change)))


def test_without_motion_capture_a_scale_of_turn_rates_is_named_and_no_camera() -> None:
    [found] = findings_of(streams_of(twist(angular=1.4), truth=False))
    assert re.search(r"turn rate of car is about 1\.[345]\d? times that by bearings", str(found))


def unsigned(value: Any, _: float) -> Any:
    return replace(value, angular=np.abs(value.angular)) if getattr(value, "angular", None) is not None else value


ELSEWHERE = np.random.default_rng(0).uniform(-2.5, 2.5, PLACES.shape) * [1.0, 1.0, 0.0] + [0.0, 0.0, 0.3]


@pytest.mark.parametrize(("change", "places"), [(unsigned, PLACES), (None, ELSEWHERE)])
def test_without_motion_capture_a_fault_of_no_constant_is_one_finding_with_alternatives(
    change: Change | None, places: np.ndarray
) -> None:
    [found] = findings_of(streams_of(change, truth=False, places=places))
    assert "(gyro, wheels, map, markers or camera?)" in str(found)


BLIND = ("gyro reversed", "gyro in degrees", "gyro is zero", "wheels reversed", "wheels in km/h", "markers exchanged")


@pytest.mark.parametrize("name", BLIND)
def test_bearings_name_a_fault_without_motion_capture(name: str) -> None:
    change, words, _ = FAULTS[name]
    assert any(re.search(words, str(finding)) for finding in findings_of(streams_of(change, truth=False)))


@pytest.mark.parametrize(
    ("move", "words"),
    [(lambda p: 100.0 * p, "in cm, and not in m"), (lambda p: p * [-1, 1, 1], "map is mirrored: x")],
)
def test_a_wrong_map_is_named(move: Callable[[np.ndarray], np.ndarray], words: str) -> None:
    [found] = findings_of(streams_of(None, places=move(PLACES)))
    assert found.subject == "landmarks" and words in found.text and found.treatment is Treatment.REFUSED


def test_two_faults_are_both_named() -> None:
    mirrored, swapped = FAULTS["image mirrored"][0], FAULTS["markers exchanged"][0]

    def change(value: Any, t: float) -> Any:
        return swapped(mirrored(FAULTS["gyro reversed"][0](value, t), t), t)

    text = "\n".join(map(str, findings_of(streams_of(change))))
    assert all(re.search(FAULTS[name][1], text) for name in ("gyro reversed", "image mirrored", "markers exchanged"))


def test_mended_turn_rates_are_those_of_the_sound_drive() -> None:
    streams = streams_of(FAULTS["gyro in degrees"][0])
    mended = examine(streams).mended(streams.samples)
    rates = [s.value.angular for s in mended if s.role is Role.IMU]
    np.testing.assert_allclose(rates, [s.value.angular for s in driven() if s.role is Role.IMU], rtol=1e-6)


def test_a_trusted_topic_stays_unchanged_and_is_named() -> None:
    streams = streams_of(FAULTS["gyro reversed"][0])
    [found] = (moving := examine(streams, ("/car/imu",))).findings
    assert found.treatment is Treatment.TRUSTED and str(found).endswith("; trusted") and not moving.mends


def test_a_pose_of_their_own_turns_velocities_of_the_room() -> None:
    truth = [s for s in driven() if s.role is Role.TRUTH]

    def change(value: Any, t: float) -> Any:
        if not isinstance(value, Twist) or value.linear is None:
            return value
        near = truth[min(int(t * 50.0), len(truth) - 1)].value
        return Twist(near.rotation @ value.linear, None, near)

    streams = streams_of(change)
    [found] = examine(streams).findings
    assert "in the frame of its own poses" in found.text and found.treatment is Treatment.MENDED
    mended = [s.value.linear for s in examine(streams).mended(streams.samples) if s.role is Role.WHEEL]
    np.testing.assert_allclose(mended, [s.value.linear for s in driven() if s.role is Role.WHEEL], atol=1e-9)


def test_a_window_of_live_samples_gives_the_same_line() -> None:
    streams = streams_of(FAULTS["gyro reversed"][0])
    monitor, right = StreamMonitor(streams.binding), StreamMonitor(streams.binding)
    for one, sound in zip(streams.samples, driven(), strict=True):
        monitor.put(one)
        right.put(sound)
    [found] = monitor.findings()
    assert re.search(FAULTS["gyro reversed"][1], str(found)) and not right.findings()


def test_live_motion_capture_that_repeats_a_pose_is_refused() -> None:
    streams = streams_of(FAULTS["truth stuck"][0])
    monitor = StreamMonitor(streams.binding)
    for sample in streams.samples:
        monitor.put(sample)
    [found] = monitor.findings()
    assert "repeats one pose" in found.text and found.treatment is Treatment.REFUSED


def test_live_samples_are_kept_for_seconds_whatever_their_rate() -> None:
    """A fault of the first seconds is gone after 20 s, and a fault within them counts at a rate of 4 kHz, too."""
    streams = streams_of(None)
    monitor = StreamMonitor(streams.binding)
    for sample in streams.samples:
        for late in range(20 if sample.role is Role.IMU else 1):
            monitor.put(replace(sample, stamp=sample.stamp + 500_000 * late))
    kept = monitor._kept["car"]
    assert 19.0 < 1e-9 * (kept[-1].received - kept[0].received) <= 20.0


def test_a_clock_that_is_set_back_begins_anew() -> None:
    """The wrong samples after it are found; those before it, of a later time, are forgotten."""
    hour, wrong = 3600 * S, streams_of(FAULTS["gyro reversed"][0])
    monitor = StreamMonitor(wrong.binding)
    for sample in driven():
        monitor.put(replace(sample, stamp=sample.stamp + hour, received=sample.received + hour))
    assert not monitor.findings()
    for sample in wrong.samples:
        monitor.put(sample)
    assert re.search(FAULTS["gyro reversed"][1], str(monitor.findings()[0]))


@pytest.mark.parametrize(("factor", "scale"), [(1.0, 0.3), (-2.0, 1.0), (57.3, 0.1)])
def test_a_relation_has_the_error_that_noise_gives_it(factor: float, scale: float) -> None:
    """Factors of 200 draws scatter by the standard error that is stated."""
    rng, t = np.random.default_rng(1), np.arange(0.0, 60.0, 0.1)
    x = np.sin(t) + 0.3 * np.sin(2.7 * t)
    found = [relation(t, factor * x + scale * rng.normal(size=len(t)), x) for _ in range(200)]
    values = np.array([f.factor.real for f in found if f is not None])
    stated = np.mean([f.error for f in found if f is not None])
    assert abs(values.mean() - factor) < 4.0 * values.std() / np.sqrt(200)
    assert 0.7 < stated / values.std() < 1.3


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [(57.312, 0.04, "57.31(4)"), (-1.0, 0.002, "-1.000(2)"), (0.5, 0.0, "0.5"), (12.0, 3.0, "12(3)")],
)
def test_a_standard_error_is_in_brackets(value: float, error: float, text: str) -> None:
    assert with_error(value, error) == text


def cut(samples: Sequence[Sample], begin: float, seconds: float) -> list[Sample]:
    """Return the samples of a part of a drive."""
    return [s for s in samples if S * (1.0 + begin) <= s.stamp < S * (1.0 + begin + seconds)]


@pytest.mark.parametrize("seconds", [4.0, 6.0, 9.0, 13.0])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_short_sound_drive_is_silent(seconds: float, seed: int) -> None:
    for begin in (0.0, 5.0, 10.0):
        whole = streams_of(None)
        assert not examine(replace(whole, samples=cut(driven(seed), begin, seconds))).findings


@pytest.mark.parametrize("begin", [0.0, 4.0, 8.0, 12.0, 16.0])
def test_four_seconds_on_the_map_of_another_room_have_no_cause(begin: float) -> None:
    other = streams_of(None, places=PLACES[[2, 3, 1, 4, 0]] * [0.8, 1.2, 1.0] + [0.3, -0.2, 0.0])
    found = examine(replace(other, samples=cut(driven(), begin, 4.0))).findings
    assert all(f.subject == "/car/truth" and "no single cause" in f.text for f in found)


def test_the_map_of_another_room_is_to_blame_if_wheels_and_gyro_follow_motion_capture() -> None:
    other = streams_of(None, places=PLACES[[2, 3, 1, 4, 0]] * [0.8, 1.2, 1.0] + [0.3, -0.2, 0.0])
    [found] = examine(other).findings
    assert found.subject == "landmarks" and found.treatment is Treatment.REFUSED and "no single cause" in found.text


def test_counts_of_an_encoder_and_a_gyro_of_a_wrong_scale_are_no_noise() -> None:
    def counted(value: Any, _: float) -> Any:
        if not isinstance(value, Twist) or value.linear is None:
            return value
        return replace(value, linear=np.round(10.0 * value.linear) / 10.0)

    assert not [f for f in examine(streams_of(counted)).findings if "noise" in f.text]
    assert not [f for f in examine(streams_of(twist(angular=0.02))).findings if "noise" in f.text]


def test_a_number_that_is_read_by_mistake_moves_no_landmark() -> None:
    """Marker 2 is never seen; five times its number is read from another one."""
    swapped, few = FAULTS["markers exchanged"][0], iter(range(10**6))

    def change(value: Any, t: float) -> Any:
        value = swapped(value, t)
        if not isinstance(value, Detections):
            return value
        kept = np.array(value.markers, int) != 2
        markers, bearings = np.array(value.markers, int)[kept], value.bearings[kept]
        if len(markers) and next(few) % 60 == 0:
            markers[0] = 2
        return Detections(tuple(markers.tolist()), bearings)

    [found] = [f for f in examine(streams_of(change)).findings if f.subject == "markers"]
    assert "SL1 and SL5 are exchanged" in found.text and "SL2 = 2" in found.key


def test_ghosts_among_right_bearings_are_of_the_camera_and_not_of_motion_capture() -> None:
    rng = np.random.default_rng(0)

    def change(value: Any, _: float) -> Any:
        if not isinstance(value, Detections) or rng.random() > 0.5:
            return value
        return replace(value, bearings=value.bearings[:, [1, 0, 2]] * [1.0, -1.0, 1.0])

    found = examine(streams_of(change)).findings
    assert [f.subject for f in found] == ["/car/detections"] and found[0].treatment is Treatment.USED


def test_motion_capture_of_two_cars_that_is_exchanged_is_named_for_both() -> None:
    one, two = (streams_of(None, seed=seed).car("car") for seed in (0, 1))
    two = replace(two, name="other", topics={role: f"/other/{role.value}" for role in two.topics})
    names = ("truth_time", "truth", "truth_yaw")
    assert not examine_cars([one, two]).findings
    pairs = ((one, two), (two, one))
    wrong = [a.with_tracks(**{name: b.tracks[name] for name in names}) for a, b in pairs]
    found = examine_cars(wrong).findings
    assert [f.subject for f in found] == ["/car/truth", "/other/truth"]
    assert all("of car and other is exchanged" in f.text for f in found)


@pytest.mark.parametrize("kind", ["linear", "angular"])
def test_a_stream_with_noise_that_sticks_is_found_without_motion_capture(kind: str) -> None:
    held: list[Any] = []

    def change(value: Any, t: float) -> Any:
        given = getattr(value, kind, None)
        if given is None or not 8.0 < t < 12.0:
            return value
        held.append(given)
        return replace(value, **{kind: held[0]})

    [found] = examine(streams_of(change, truth=False)).findings
    assert re.search(r"in a row for 4\.\d s, and has noise", found.text) and found.treatment is Treatment.REFUSED


def test_a_velocity_without_noise_that_is_held_does_not_stick() -> None:
    """A ramp, an even speed and a ramp, as a simulator or a setpoint has them."""
    t = np.arange(0.0, 25.0, 0.05)
    speed = np.clip(np.minimum(0.2 * (t - 2.0), 0.2 * (23.0 - t)), 0.0, 0.35)
    noise = 0.01 * np.random.default_rng(0).normal(size=len(t)) * ((t < 8.0) | (t > 12.0))

    def found(values: np.ndarray, **truth: np.ndarray) -> list[Any]:
        tracks = {"wheel_time": t, "wheel": values + 0j, "gyro_time": t, "gyro": 0.1 * np.sin(t), "truth_time": t[:0]}
        tracks |= truth
        car: Any = SimpleNamespace(name="car", tracks=tracks, topic=lambda roles: "/wheel")
        return [*of_frozen_streams(car)]

    place = np.cumsum(speed) * 0.05 + 0j
    truth = {"truth_time": t, "truth": place, "truth_yaw": np.cumsum(0.1 * np.sin(t)) * 0.05}
    for given in ({}, truth):  # which moves the car as the held velocity says
        assert not found(speed, **given)
        [diagnosis] = found(speed + noise, **given)
        assert "0.35 in a row for" in diagnosis.finding.text


def test_a_landmark_elsewhere_is_named_where_few_bearings_are_to_it() -> None:
    """The mean over all bearings is below what counts as bad."""
    car = streams_of(None).car("car")
    rows = np.flatnonzero(car.target != 1)
    rows = np.sort(np.append(rows, np.flatnonzero(car.target == 1)[::2]))
    car = replace(car, time=car.time[rows], target=car.target[rows], ray=car.ray[rows])
    places = car.places.copy()
    places[1, 0] += 1.5
    wrong = replace(car, places=places)
    thin = thinned(wrong)
    assert thin is not None and sight_of(thin).misfit() < BAD
    [found] = examine_cars([wrong]).findings
    assert "landmark SL2 stands at" in found.text
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("coopenv.cars.doctor.sight.MEETING", np.inf)
        [found] = examine_cars([wrong]).findings
    assert "to landmark SL2 are off by more than 3.6 deg: is it elsewhere?" in found.text, "lines that do not meet"
    assert not found.explained


def test_the_scale_of_wheels_is_that_of_the_arc_in_tight_turns() -> None:
    """A chord is shorter than its arc: by 1/24 of the square of the turn within a second."""
    t = np.arange(0.0, 40.0, 0.02)
    rate = 1.2 + 0.5 * np.sin(0.7 * t)
    speed = 0.6 + 0.2 * np.sin(0.9 * t)
    yaw = np.cumsum(rate) * 0.02
    place = np.cumsum(speed * np.exp(1j * (yaw - 0.5 * rate * 0.02))) * 0.02
    noise = np.random.default_rng(0).normal(size=len(t))
    tracks = {"wheel_time": t, "wheel": 1.2 * speed + 0.01 * noise + 0j}
    car: Any = SimpleNamespace(tracks=tracks)
    path = SampledSignal(t, np.column_stack([place.real, place.imag])), SampledSignal(t, yaw)
    body, _ = velocity_relations(car, *path)
    assert body is not None and abs(body.factor - 1.2) < max(0.002, 3.0 * body.error)


def test_a_heading_of_motion_capture_that_jumps_contradicts_no_turn_rate() -> None:
    """A body whose markers are mistaken for 1.6 s, of a car that drives straight on with a turn rate of 0."""
    t = np.arange(0.0, 20.0, 0.05)
    tracks = {"truth_time": t, "truth": 0.3 * t + 0j, "truth_yaw": np.where((t > 8.0) & (t < 9.6), 0.4, 0.0)}
    tracks |= {"wheel_time": t, "wheel": 0.3 + 0.01 * np.random.default_rng(0).normal(size=len(t)) + 0j}
    car: Any = SimpleNamespace(
        name="car", tracks=tracks | {"gyro_time": t, "gyro": 0.0 * t}, topic=lambda roles: "/imu"
    )
    assert not [*of_frozen_streams(car)]


def test_a_velocity_that_sticks_after_a_stand_is_found() -> None:
    t = np.arange(0.0, 40.0, 0.02)
    place = 0.3 * np.maximum(t - 20.0, 0.0) + 0j
    wheel = np.where(t < 20.0, 0.0, 0.3) + np.where(t < 20.0, 0.0, 0.01) * np.random.default_rng(0).normal(size=len(t))
    wheel[(t > 28.0) & (t < 36.0)] = 0.0
    tracks = {"truth_time": t, "truth": place, "truth_yaw": 0.0 * t, "wheel_time": t, "wheel": wheel + 0j}
    car: Any = SimpleNamespace(name="car", tracks=tracks | {"gyro_time": t, "gyro": t}, topic=lambda roles: "/wheels")
    [found] = [each.finding for each in of_frozen_streams(car) if "velocity" in each.finding.text]
    assert "in a row for 8.0 s" in found.text and "2.37 m" in found.text


def test_a_car_that_stands_beside_noisy_wheels_does_not_repeat_its_pose() -> None:
    t = np.arange(0.0, 20.0, 0.02)
    noise = 0.05 * np.random.default_rng(0).normal(size=len(t))
    tracks = {"truth_time": t, "truth": 0.0 * t + 0j, "truth_yaw": 0.0 * t, "wheel_time": t, "wheel": noise + 0j}
    car: Any = SimpleNamespace(name="car", tracks=tracks | {"gyro_time": t, "gyro": t}, topic=lambda roles: "/truth")
    assert not [*of_frozen_streams(car)]


def test_a_map_without_standing_landmarks_is_compared_with_nothing() -> None:
    assert thinned(replace(streams_of(None).car("car"), places=np.zeros((0, 3)))) is None


def test_an_error_that_is_not_known_has_no_brackets() -> None:
    assert with_error(1.5, np.inf) == "1.5"


def test_a_landmark_that_stands_elsewhere_is_named_with_its_place() -> None:
    streams = streams_of(None)
    car = streams.car(next(iter(streams.binding.cars)))
    k, places = int(np.bincount(car.target.copy()).argmax()), car.places.copy()
    places[k, 0] += 1.5
    (found,) = examine_cars([replace(car, places=places)]).findings
    assert found.treatment is Treatment.REFUSED and found.size == pytest.approx(1.5, abs=0.05)
    assert f"landmark {car.names[k]} stands at {car.places[k, 0]:.1f}" in found.text


def test_exchanged_markers_are_mended_by_the_whole_table() -> None:
    found = [f for f in findings_of(streams_of(FAULTS["markers exchanged"][0])) if f.subject == "markers"]
    assert tomllib.loads(found[0].key)["markers"] == {"SL1": 4, "SL2": 2, "SL4": 3, "SL5": 1, "ML": 5}
    assert "0% with that mended" in found[0].text


def test_a_velocity_that_points_aside_has_no_scale_as_its_key() -> None:
    def change(value: Any, _: float) -> Any:
        if not isinstance(value, Twist) or value.linear is None:
            return value
        return Twist(turn(np.radians(12.0)) @ value.linear, value.angular)

    [found] = [f for f in examine(streams_of(change)).findings if "velocity" in f.text]
    assert re.search(r"points 1[12]\.\d*\(\d+\) deg to the left", found.text) and not found.key


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("truth mirrored", "focal length 3 % off"),
        ("gyro is zero", "wheels in km/h"),
        ("body of truth turned", "image mirrored"),
        ("wheels end", "truth in another frame"),
    ],
)
def test_a_fault_that_another_one_hides_is_named(first: str, second: str) -> None:
    one, two = FAULTS[first], FAULTS[second]
    text = "\n".join(map(str, found := findings_of(streams_of(lambda value, t: two[0](one[0](value, t), t)))))
    assert len(found) == 2 and re.search(one[1], text) and re.search(two[1], text), text


def test_a_cause_without_which_the_others_explain_all_is_taken_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first check names a harmless cause as well, which no other check needs."""
    right = doctor._of_motion

    def eager(car: CarStreams, unexplained: bool) -> Any:
        wrong = Finding("/harmless", "nothing is wrong")
        yield from [Diagnosis(wrong, lambda car: car), *right(car, unexplained)]

    faulty = streams_of(FAULTS["wheels in km/h"][0]).car("car")
    monkeypatch.setattr(doctor, "_of_motion", eager)
    assert "/harmless" in [each.finding.subject for each in doctor.diagnosed(faulty)]

    def while_there_is_a_fault(car: CarStreams, unexplained: bool) -> Any:
        return eager(car, unexplained) if [*right(car, unexplained)] else []

    monkeypatch.setattr(doctor, "_of_motion", while_there_is_a_fault)
    assert [each.finding.subject for each in doctor.diagnosed(faulty)] == ["/car/wheel"]


def test_a_velocity_that_is_measured_in_no_message_refuses_the_drive() -> None:
    def change(value: Any, _: float) -> Any:
        return Twist(None, value.angular) if isinstance(value, Twist) else value

    [found] = [f for f in findings_of(streams_of(change)) if f.treatment is Treatment.REFUSED]
    assert "velocity of car is measured in none of" in found.text and found.subject == "/car/wheel"


def test_recordings_go_through_the_same_checks() -> None:
    """Without an environment, as MR.CLAM: bearings in the body frame."""
    recording = replace(record(load_scenario("svea_overtaking", {"horizon": 10.0}), 1), scenario=None)
    assert not examine_cars(streams_of_recording(recording)).findings
    place = recording.truth.position * 1000.0
    wrong = replace(recording, truth=replace(recording.truth, position=place))
    found = examine_cars(streams_of_recording(wrong)).findings
    assert any("it is in mm" in finding.text for finding in found)


@pytest.mark.parametrize(
    ("change", "words", "treatment"),
    [
        (FAULTS["wheels in km/h"][0], "km/h instead of m/s", Treatment.REFUSED),
        (FAULTS["wheels in mm/s"][0], "mm/s instead of m/s", Treatment.REFUSED),
        (FAULTS["inverse poses"][0], "its poses are inverse", Treatment.REFUSED),
        (FAULTS["truth flips"][0], "flips to another heading", Treatment.REFUSED),
        (FAULTS["wheels slip"][0], "slips for", Treatment.USED),
        (FAULTS["truth mirrored"][0], "it is mirrored", Treatment.REFUSED),
        (FAULTS["image mirrored"][0], "its image is mirrored", Treatment.REFUSED),
        (twist(linear=1.15), r"velocity of car is 1\.1[67]", Treatment.USED),
        (FAULTS["focal length 3 % off"][0], "focal length: a wrong constant", Treatment.USED),
    ],
)
def test_live_cars_refuse_what_nothing_mends_and_warn_of_what_a_bag_warns_of(
    change: Change, words: str, treatment: Treatment
) -> None:
    streams = streams_of(change)
    monitor = StreamMonitor(streams.binding, lenses=streams.lenses)
    for sample in streams.samples:
        monitor.put(sample)
    found = [f for f in (*monitor.findings(), *monitor.constants()) if re.search(words, str(f))]
    assert found and found[0].treatment is treatment
