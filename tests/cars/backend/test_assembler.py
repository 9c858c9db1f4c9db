"""Ticks of samples: on a path that is known in closed form, with sensors that are not in step."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from coopenv.base.errors import CoopenvError
from coopenv.cars.backend.assembler import Assembler, Intake, TopicClock
from coopenv.cars.backend.binding import Binding, bind
from coopenv.cars.backend.buffers import LONGEST_GAP, PoseTrack
from coopenv.cars.link.transport import Arrival
from coopenv.cars.messages.codec import decode, encode, header, make
from coopenv.cars.messages.readings import CarPose, Detections, Sample, Twist, Value, read
from coopenv.cars.messages.v2x import estimate_message, report_message
from coopenv.cars.settings.deployment import Car, Sensors
from coopenv.cars.settings.profile import SVEA, Role
from coopenv.estimation.poses import exp_so3
from coopenv.observers.contract import Message
from coopenv.observers.sensed import Sensed
from coopenv.scenario import Scenario
from coopenv.sources.base import VehicleBroadcast
from tests.helpers.builders import landmark, scenario, vehicle
from tests.helpers.paths import Path

MS = 1_000_000
START = 1_000_000_000_000
LANDMARKS = {"A": (3.0, 1.0, 0.4), "B": (4.0, -1.0, 0.2), "C": (5.0, 0.5, 0.3)}
LATE, SILENT, STALE = (SVEA.topics[role].max_age_ns for role in (Role.DETECTIONS, Role.ODOMETRY, Role.ESTIMATE))
MARKERS = {"A": 1, "B": 2, "C": 3}
LEVER = np.array([0.3, 0.0, 0.2])
AHEAD, ORIGIN = np.array([[0.0, 0.0, 1.0]]), CarPose(np.zeros(3), np.eye(3))
TO_BODY = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def world(cars: int = 1, **sections: Any) -> Scenario:
    vehicles = [vehicle((-k, 0.0, 0.0), 0.0, motion={"kind": "driven"}, marker=[0.1, 0, 0.2]) for k in range(cars)]
    given = {
        "horizon": 5.0,
        "landmarks": [landmark(name, place) for name, place in LANDMARKS.items()],
        "topology": {"mode": "sensed"},
        "rates": {"camera": 60.0, "odometry": 100.0, "decision": 20.0},
        "camera": {"model": "pinhole", "position": LEVER.tolist()},
    }
    return scenario(vehicles, **{**given, **sections})


def binding(cars: int = 1, only: str | None = None, **sections: Any) -> Binding:
    fleet = [Car(name=f"car{k}", marker=5 + k) for k in range(cars)]
    return bind(world(cars, **sections), fleet, MARKERS, "lab.toml", only)


def begun(bound: Binding, now: int = START) -> Assembler:
    assembler = Assembler(bound)
    assembler.begin(now)
    return assembler


def sample(role: Role, stamp: int, value: Value, car: str = "car0", delay: int = 2 * MS) -> Sample:
    return Sample(car, role, stamp, stamp + delay, value)


class Senses:
    """Messages of the sensors of a car on a path, each at its own pace and with its own delay."""

    def __init__(self, path: Path, until: float) -> None:
        self.path = path
        rng = np.random.default_rng(5)
        self.samples = sorted(
            (*self._twists(until), *self._frames(until, rng), *self._poses(until)), key=lambda s: s.received
        )

    def _twists(self, until: float) -> Iterator[Sample]:
        for k in range(int(until * 1000)):  # so often that holding them does not matter
            stamp = START + k * MS
            v, w = self.path.twist(k * 1e-3 + 0.5e-3)
            yield sample(Role.IMU, stamp, Twist(None, w))
            yield sample(Role.WHEEL, stamp, Twist(v, None))

    def _frames(self, until: float, rng: np.random.Generator) -> Iterator[Sample]:
        for k in range(int(until * 60)):
            t = k / 60 + rng.uniform(0.0, 3e-3)
            R, p = self.path.pose(t)
            rays = (np.array(list(LANDMARKS.values())) - p) @ R - LEVER
            bearings = rays / np.linalg.norm(rays, axis=1, keepdims=True) @ TO_BODY
            delay = int(rng.uniform(8, 14) * MS)
            yield sample(Role.DETECTIONS, START + round(t * 1e9), Detections((1, 2, 3), bearings), delay=delay)

    def _poses(self, until: float) -> Iterator[Sample]:
        for k in range(int(until * 100)):
            R, p = self.path.pose(k / 100)
            yield sample(Role.TRUTH, START + k * 10 * MS, CarPose(p, R))


def ticks(assembler: Assembler, samples: list[Sample], first: float, count: int) -> Iterator[tuple[int, Sensed]]:
    """Yield (time in ns, tick) from a time in s on, at 60 Hz."""
    waiting = iter(samples)
    following = next(waiting, None)
    for k in range(count):
        now = START + round((first + k / 60) * 1e9)
        while following is not None and following.received <= now:
            assembler.put(following)
            following = next(waiting, None)
        yield now, assembler.begin(now) if k == 0 else assembler.tick(k, now)


def test_odometry_and_bearings_are_of_the_moment_when_the_frame_was_exposed() -> None:
    path = Path(3.0)
    assembler = Assembler(binding())
    before = None
    seen = 0
    for _, tick in ticks(assembler, Senses(path, 3.0).samples, 0.5, 120):
        t = (assembler.moment(0) - START) * 1e-9
        R, p = path.pose(t)
        if before is not None:
            R0, p0 = before
            np.testing.assert_allclose(tick.rotation[0], R0.T @ R, atol=2e-5)
            np.testing.assert_allclose(tick.translation[0], R0.T @ (p - p0), atol=2e-5)
        before = R, p
        assert tick.truth is not None
        np.testing.assert_allclose(tick.truth.position[0], p, atol=5e-4)  # between poses 10 ms apart
        np.testing.assert_allclose(tick.truth.rotation[0], R, atol=1e-3)
        if tick.visible[0, :3].all():
            seen += 1
            rays = (np.array(list(LANDMARKS.values())) - p) @ R - LEVER
            np.testing.assert_allclose(
                tick.bearings[0, :3], rays / np.linalg.norm(rays, axis=1, keepdims=True), atol=1e-6
            )
    assert seen > 110  # hardly a frame is lost to the drift of two clocks


def test_a_moving_landmark_is_where_it_was_when_the_frame_was_exposed() -> None:
    given = [landmark(name, place) for name, place in LANDMARKS.items()]
    ml = landmark("ML", (3.0, 0.0, 0.0), motion={"kind": "constant", "linear": [0.5, 0, 0]}, marker=[0.0, 0.0, 0.3])
    fleet = [Car(name="car0", marker=5), Car(name="lead", landmark="ML", marker=4)]
    assembler = Assembler(bind(world(landmarks=[*given, ml]), fleet, MARKERS, "lab.toml", None))
    said = [
        sample(Role.ESTIMATE, START + k * 16 * MS, CarPose(np.array([3.0 + 0.5 * 0.016 * k, 0, 0]), np.eye(3)), "lead")
        for k in range(120)
    ]
    samples = sorted((*Senses(Path(3.0), 2.0).samples, *said), key=lambda s: s.received)
    for now, tick in ticks(assembler, samples, 0.5, 60):
        t = (assembler.moment(0) - START) * 1e-9
        assert assembler.moment(0) < now
        if tick.index > 1:
            np.testing.assert_allclose(tick.landmarks[3], [3.0 + 0.5 * t, 0.0, 0.3], atol=1e-6)


def test_frames_that_do_not_come_leave_a_tick_in_which_nothing_is_seen() -> None:
    path = Path(3.0)
    samples = Senses(path, 3.0).samples
    dark = [s for s in samples if s.role is not Role.DETECTIONS or not 1.0 < (s.stamp - START) * 1e-9 < 1.5]
    assembler = Assembler(binding())
    travelled, ages = 0.0, []
    for k, (now, tick) in enumerate(ticks(assembler, dark, 0.5, 90)):
        travelled += float(np.linalg.norm(tick.translation[0]))
        if 1.05 < (now - START) * 1e-9 < 1.45:
            assert not tick.visible.any() and not np.asarray(tick.missing).any(), k
            ages.append(float(np.asarray(tick.bearing_age)[0]))
    assert ages == sorted(ages) and ages[-1] > 0.4
    assert travelled == pytest.approx(0.4 * 89 / 60, abs=0.02)


def test_without_odometry_nothing_has_come() -> None:
    path = Path(3.0)
    samples = [s for s in Senses(path, 3.0).samples if s.role is not Role.IMU or (s.stamp - START) * 1e-9 < 1.0]
    missing = [
        ((now - START) * 1e-9, bool(np.asarray(tick.missing)[0]))
        for now, tick in ticks(Assembler(binding()), samples, 0.5, 90)
    ]
    limit = 1.0 + SILENT * 1e-9
    assert all(gone == (t > limit) for t, gone in missing if abs(t - limit) > 0.01)


def test_late_frames_are_used_and_marked() -> None:
    assembler = begun(binding())
    exposed = START + 10 * MS
    assembler.put(sample(Role.DETECTIONS, exposed, Detections((1,), AHEAD), delay=LATE))
    tick = assembler.tick(1, exposed + LATE + 5 * MS)
    assert np.asarray(tick.late)[0] and tick.visible[0, 0]
    np.testing.assert_allclose(np.asarray(tick.bearing_age)[0], (LATE + 5 * MS) * 1e-9)


def test_duplicates_and_older_frames_are_left_out() -> None:
    assembler = begun(binding())
    for stamp, marker in ((20, 1), (20, 2), (10, 3)):
        assembler.put(sample(Role.DETECTIONS, START + stamp * MS, Detections((marker,), AHEAD)))
    tick = assembler.tick(1, START + 30 * MS)
    assert tick.visible[0].tolist() == [True, False, False, False]
    assert not assembler.tick(2, START + 50 * MS).visible.any()


def test_samples_of_unknown_cars_and_of_the_future_are_refused_and_counted() -> None:
    assembler, good = Assembler(binding()), sample(Role.WHEEL, START, Twist(np.ones(3), None))
    for change in ({"car": "nobody"}, {"stamp": START + 200 * MS, "received": START}):
        assert not assembler.put(replace(good, **change))
    assert assembler.refused == {"unknown car": 1, "stamp in the future": 1}


def test_own_and_unknown_markers_are_refused() -> None:
    assembler = begun(binding())
    rays = np.repeat(AHEAD, 3, axis=0)
    assembler.put(sample(Role.DETECTIONS, START + MS, Detections((1, 5, 7), rays)))
    tick = assembler.tick(1, START + 10 * MS)
    assert tick.visible[0].tolist() == [True, False, False, False]
    assert assembler.refused["unknown marker"] == 2


def heard(tick: Sensed) -> dict[tuple[int, int], tuple[np.ndarray, float]]:
    return {pair: (np.asarray(received.message.position), received.age) for pair, received in tick.messages.items()}


def test_messages_of_other_cars_are_received_by_a_station_of_one_car() -> None:
    assembler = begun(binding(2, only="car1"))
    turned = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    said = CarPose(np.array([1.0, 2.0, 0.0]), turned, np.diag([0.1, 0.2, 0.3, 0.0, 0.0, 0.04]))
    assembler.put(sample(Role.ESTIMATE, START + MS, said, "car0"))
    assembler.put(sample(Role.ESTIMATE, START + MS, said, "car1"))  # its own
    tick = assembler.tick(1, START + 11 * MS)
    [(pair, (position, age))] = heard(tick).items()
    assert pair == (1, 0) and age == pytest.approx(0.01)
    np.testing.assert_allclose(position, [1.0, 2.1, 0.2])  # the marker, 0.1 m ahead
    covariance = tick.messages[1, 0].message.covariance
    np.testing.assert_allclose(covariance, np.diag([0.1 + 0.04 * 0.01, 0.2, 0.3]), atol=1e-12)
    assert np.asarray(tick.missing).tolist() == [True, True] and (np.asarray(tick.inbox_tick) == -1).all()
    assert not heard(assembler.tick(2, START + 20 * MS))


def test_the_observers_own_message_counts_before_the_pose_and_a_stale_one_not_at_all() -> None:
    assembler = begun(binding(2, only="car1"))
    assembler.put(sample(Role.ESTIMATE, START + MS, ORIGIN, "car0"))
    report = Message(np.ones(3), np.eye(3), np.eye(6), {"odometry": np.zeros(6)})
    assembler.put(sample(Role.REPORT, START + MS, report, "car0"))
    assert set(assembler.tick(1, START + 5 * MS).messages[1, 0].message.extra) == {"odometry"}
    for older in (MS, 0):  # replayed, and from before
        assembler.put(sample(Role.ESTIMATE, START + older, ORIGIN, "car0", delay=6 * MS))
    assert not heard(assembler.tick(2, START + 8 * MS)) and assembler.refused["message out of order"] == 2
    assembler.put(sample(Role.ESTIMATE, START + 10 * MS, ORIGIN, "car0"))
    assert not heard(assembler.tick(3, START + 11 * MS + STALE))
    assert assembler.refused["stale message"] == 1


WITH_LORRY = [Car(name="car0"), Car(name="lorry", landmark="C", marker=3)]


def test_a_moving_landmark_counts_as_long_as_its_messages_come() -> None:
    assembler = begun(bind(world(), WITH_LORRY, {"A": 1, "B": 2}, "lab.toml", None))

    def look(k: int) -> Sensed:
        stamp = START + k * 10 * MS
        assembler.put(sample(Role.DETECTIONS, stamp, Detections((3,), AHEAD), delay=MS))
        return assembler.tick(k, stamp + 5 * MS)

    assert not look(1).visible.any() and assembler.refused["landmark of unknown position"] == 1
    assembler.put(sample(Role.ESTIMATE, START + 15 * MS, CarPose(np.array([2.0, 2.0, 0.1]), np.eye(3)), "lorry"))
    tick = look(2)
    assert tick.visible[0, 2]
    np.testing.assert_allclose(tick.landmarks[2], [2.0, 2.0, 0.1])
    assert not look(40).visible.any()


def test_messages_of_a_moving_landmark_count_once_and_expire() -> None:
    assembler = begun(bind(world(), WITH_LORRY, {"A": 1, "B": 2}, "lab.toml", None))

    def say(stamp: int, place: float, delay: int = MS) -> None:
        said = CarPose(np.array([place, 2.0, 0.0]), np.eye(3))
        assembler.put(sample(Role.ESTIMATE, START + stamp, said, "lorry", delay))

    for stamp, place in ((0, 2.0), (50, 3.0), (50, 9.0), (20, 9.0)):  # again, with another place, and older
        say(stamp * MS, place)
    assert assembler.refused == {"message out of order": 2}
    say(60 * MS, 9.0, delay=STALE + MS)
    assert assembler.refused["stale message"] == 1
    np.testing.assert_allclose(assembler.tick(1, START + 70 * MS).landmarks[2, 0], 3.0, atol=0.5)
    lost = assembler.tick(2, START + 50 * MS + STALE + MS)
    np.testing.assert_allclose(lost.landmarks[2], [3.0, 2.0, 0.0])  # not where it would be if it had gone on


def test_a_velocity_of_no_car_moves_none() -> None:
    assembler = begun(binding())
    for k, speed in ((1, 1.0), (2, 400.0)):
        twist = Twist(np.array([speed, 0.0, 0.0]), np.zeros(3))
        assert assembler.put(sample(Role.ODOMETRY, START + k * MS, twist)) == (speed == 1.0)
    assert assembler.refused["velocity of no car"] == 1
    assert assembler.tick(1, START + 20 * MS).velocity[0, 0] == 1.0


def test_samples_left_out_by_queues_are_counted() -> None:
    assembler = Assembler(binding())
    ray = Detections((1,), AHEAD)
    for k in range(60):  # before anybody asks
        assembler.put(sample(Role.DETECTIONS, START - (60 - k) * 16 * MS, ray))
    assembler.begin(START)
    assert not assembler.refused["frame left out"]
    for stamp in (10, 5, 20, 30, 40, 50):
        assembler.put(sample(Role.DETECTIONS, START + stamp * MS, ray))
    for stamp in (20, 10, 20):
        assembler.put(sample(Role.IMU, START + stamp * MS, Twist(None, np.ones(3))))
    for stamp in (20, 10):
        assembler.put(sample(Role.TRUTH, START + stamp * MS, ORIGIN))
    for k in (1, 2):
        assembler.tick(k, START + (50 + k) * MS)
    assert {why: count for why, count in assembler.refused.items() if count} == {
        "frame out of order": 1,
        "frame left out": 2,
        "odometry out of order": 2,
        "motion capture out of order": 1,
    }


@pytest.mark.parametrize(
    ("topology", "hearing"),
    [({"acyclic": True}, {1: {0}, 2: {0, 1}}), ({"acyclic": False}, {0: {1, 2}, 1: {0, 2}, 2: {0, 1}})],
)
def test_a_vehicle_receives_from_the_neighbours_of_the_environment_alone(
    topology: Any, hearing: dict[int, set[int]]
) -> None:
    for receiver in range(3):
        assembler = begun(binding(3, only=f"car{receiver}", topology={"mode": "sensed", **topology}))
        for sender in range(3):
            assembler.put(sample(Role.ESTIMATE, START + MS, ORIGIN, f"car{sender}"))
        messages = assembler.tick(1, START + 5 * MS).messages
        assert set(messages) == {(receiver, sender) for sender in hearing.get(receiver, set())}
        assert not assembler.refused


def test_the_truth_is_unknown_where_motion_capture_has_lost_the_body() -> None:
    track = PoseTrack()
    for k in (0, 1, 30, 31):
        track.put(START + k * 10 * MS, np.eye(3), np.array([0.1 * k, 0.0, 0.0]))
    known = [np.isfinite(track.at(START + t * MS)[1]).all() for t in (5, 150, 305, 310)]
    assert known == [True, False, True, True]
    np.testing.assert_allclose(track.at(START + 5 * MS)[1], [0.05, 0.0, 0.0])
    assert not np.isfinite(track.at(START + 310 * MS + LONGEST_GAP + MS)[1]).any()


def test_origins_of_maps_are_taken_off() -> None:
    bound = binding(map={"origin": [1.0, 2.0, 0.0]})
    assembler = Assembler(bound)
    assembler.put(sample(Role.TRUTH, START, CarPose(np.array([1.5, 2.5, 0.0]), np.eye(3))))
    tick = assembler.begin(START + 20 * MS)
    assert tick.truth is not None
    np.testing.assert_allclose(tick.truth.position[0], [0.5, 0.5, 0.0])
    np.testing.assert_allclose(tick.landmarks[0], np.array(LANDMARKS["A"]) - [1.0, 2.0, 0.0])


@pytest.mark.parametrize(
    ("fleet", "markers", "why"),
    [
        ([Car(name="a"), Car(name="b")], {}, "2 of them are vehicles, the environment has 1"),
        ([Car(name="a", vehicle="vehicle_2")], {}, "cars.a.vehicle: unknown name 'vehicle_2' (did you mean"),
        ([Car(name="a")], {"Q": 1}, "markers: unknown name 'Q'"),
        ([Car(name="a"), Car(name="b", landmark="Z")], {}, "cars.b.landmark: unknown name 'Z'"),
    ],
)
def test_unknown_vehicles_markers_and_landmarks_are_named(fleet: list[Car], markers: dict[str, int], why: str) -> None:
    with pytest.raises(CoopenvError) as caught:
        bind(world(), fleet, markers, "lab.toml", None)
    assert str(caught.value).startswith("lab.toml: ") and why in str(caught.value)


def test_a_vehicle_without_a_radio_is_refused() -> None:
    with pytest.raises(CoopenvError, match=r"^lab\.toml: vehicles\.0\.connected: must be true, cars send"):
        bind(scenario([vehicle(connected=False)]), [Car(name="a")], {}, "lab.toml", None)


def test_cars_take_steering_not_turn_rates() -> None:
    with pytest.raises(CoopenvError, match=r"^lab\.toml: dynamics\.model: must be 'bicycle', cars take steering; got"):
        bind(scenario([vehicle()], dynamics={"model": "differential_drive"}), [Car(name="a")], {}, "lab.toml", None)


def test_a_camera_without_calibration_is_refused() -> None:
    with pytest.raises(CoopenvError, match="the camera of vehicle_1 has no calibration"):
        binding(camera={"model": "omnidirectional"})


@pytest.mark.parametrize(
    ("odometry", "turned"),
    [("wheel+imu", 1.0), ("wheel", 0.6)],  # rad: 2 s of the gyro's 0.5 rad/s, or of the wheels' 0.3
)
def test_the_wheels_turn_rate_counts_only_without_a_gyro(odometry: Any, turned: float) -> None:
    bound = binding()
    intake, assembler, heading = Intake(bound, Sensors(odometry=odometry)), begun(bound), 0.0
    for k in range(2001):
        now, spoken = START + k * MS, dict[Role, dict[str, Any]]()
        if k % 10 == 0:
            spoken[Role.IMU] = {"angular_velocity": (0.0, 0.0, 0.5)}
        if k % 20 == 3:
            spoken[Role.WHEEL] = {"twist": {"twist": ((0.2, 0.0, 0.0), (0.0, 0.0, 0.3))}}
        for role, fields in spoken.items():
            payload = encode(make(SVEA.topics[role].type, header=header(now), **fields))
            for sample in intake.samples(Arrival(SVEA.topic_of("car0", role), payload, now)):
                assembler.put(sample)
        if k % 50 == 0 and k > 0:
            R = assembler.tick(k // 50, now).rotation[0]
            heading += float(np.arctan2(R[1, 0], R[0, 0]))
    assert heading == pytest.approx(turned, abs=0.015)


LAB = np.array([1.0, 2.0, 0.0])
PLACE, ROTATION = np.array([0.7, -0.4, 0.1]), exp_so3(np.array([0.0, 0.0, 0.8]))
ODOMETRY = np.array([0.0, 0.0, 0.3, 0.5, 0.2, 0.0])


def own_broadcast() -> VehicleBroadcast:
    extra = {"odometry": ODOMETRY, "depends_on": np.array([2], dtype=np.uint64)}
    covariance = np.diag([1e-3, 1e-3, 2e-3, 0.01, 0.02, 0.03])
    return VehicleBroadcast(0, ROTATION, PLACE, covariance, Message(PLACE, ROTATION, covariance, extra))


@pytest.mark.parametrize(("role", "write"), [(Role.ESTIMATE, estimate_message), (Role.REPORT, report_message)])
def test_a_sent_estimate_is_received_at_the_same_place(role: Role, write: Any) -> None:
    message = decode(encode(write(own_broadcast(), START, LAB)), SVEA.topics[role].type)
    place = getattr(message.pose, "pose", message.pose).position
    np.testing.assert_allclose([place.x, place.y, place.z], PLACE + LAB)  # as in the laboratory's coordinates
    assembler = begun(binding(2, only="car1", map={"origin": LAB.tolist()}), START - MS)
    assembler.put(Sample("car0", role, START, START + MS, read(role, message)))
    heard = assembler.tick(1, START + 2 * MS).messages[1, 0].message
    marker = np.array([0.1, 0.0, 0.2]) if role is Role.ESTIMATE else np.zeros(3)  # a report is of the marker already
    np.testing.assert_allclose(np.asarray(heard.position), PLACE + ROTATION @ marker, atol=1e-12)
    np.testing.assert_allclose(np.asarray(heard.rotation), ROTATION, atol=1e-12)
    if role is Role.REPORT:
        np.testing.assert_allclose(heard.extra["odometry"], ODOMETRY, atol=1e-12)  # from where it began


def test_the_clock_of_each_topic_is_checked_against_a_few_wrong_stamps() -> None:
    intake, wheel = Intake(binding(), Sensors(odometry="wheel+imu")), SVEA.topic_of("car0", Role.WHEEL)
    camera = SVEA.topic_of("car0", Role.DETECTIONS)
    fields = {Role.WHEEL: {"twist": {"twist": ((0.2, 0.0, 0.0), (0.0, 0.0, 0.3))}}, Role.DETECTIONS: {"objects": []}}

    def send(role: Role, delay: int) -> None:
        for k in range(100):
            stamp = START + k * 20 * MS - (-3_000 if k % 33 == 7 else delay) * MS
            payload = encode(make(SVEA.topics[role].type, header=header(stamp), **fields[role]))
            list(intake.samples(Arrival(SVEA.topic_of("car0", role), payload, START + k * 20 * MS)))

    send(Role.WHEEL, 450)
    send(Role.DETECTIONS, 40)
    assert list(intake.unsynchronised("car0", 0.05)) == [
        f"stamps of {wheel} are 450 ms behind this computer's, 50 ms are allowed"
    ]
    assert intake.offset_of("car0") == pytest.approx(0.04)
    send(Role.WHEEL, 1)
    assert not list(intake.unsynchronised("car0", 0.02))  # the camera may take its time besides
    send(Role.DETECTIONS, -100)
    assert list(intake.unsynchronised("car0", 0.02))[1].startswith(f"stamps of {camera} are 100 ms ahead of this")


@pytest.mark.parametrize("drift", [50e-6, -500e-6])
def test_a_live_clock_has_offset_and_drift_and_outlying_stamps_are_dropped(drift: float) -> None:
    """Stamps of 50 s at 60 Hz, 1 % of them 3 s ahead, with a mean delay of 2 ms besides the clock's."""
    rng, clock, S = np.random.default_rng(3), TopicClock(), 1000 * MS
    true = START + (np.arange(3000) * S) // 60
    received = true + (rng.exponential(0.002, len(true)) * S).astype(np.int64)
    wrong = (rng.random(len(true)) < 0.01) & (np.arange(len(true)) > 0)
    stamps = true - 300 * MS - np.round(drift * (true - START)).astype(np.int64) + 3 * S * wrong
    kept = [clock.put(int(s), int(r)) for s, r in zip(stamps, received, strict=True)]
    np.testing.assert_array_equal(kept, ~wrong)
    line = clock.line()
    assert line is not None and clock.dropped == wrong.sum() > 20
    assert line.drift == pytest.approx(drift, abs=1e-5) and not line.jump
    assert line.offset / S == pytest.approx(0.3 + 50.0 * drift, abs=1e-3)
    assert clock.seconds == pytest.approx(0.3 + 50.0 * drift, abs=2e-3)
    assert str(clock).endswith(
        f" behind, drifts by {1e6 * line.drift:+.0f} us per s, {wrong.sum()} of 3000 stamps dropped"
    )


@pytest.mark.parametrize("jump", [0.4, -0.4])
def test_a_live_clock_that_jumps_is_followed(jump: float) -> None:
    rng, clock, S = np.random.default_rng(4), TopicClock(), 1000 * MS
    true = START + (np.arange(1200) * S) // 60
    stamps = true + round(jump * S) * (np.arange(1200) >= 600) - np.round(1e-4 * (true - START)).astype(np.int64)
    kept = [
        clock.put(int(s), int(s_) + int(d * S))
        for s, s_, d in zip(stamps, true, rng.exponential(0.001, 1200), strict=True)
    ]
    assert all(kept[:600]) and all(kept[650:]) and clock.dropped < 50
    line = clock.line()
    assert line is not None and line.jump / S == pytest.approx(-jump, abs=0.01)
    assert line.drift == pytest.approx(1e-4, abs=2e-5) and line.offset / S == pytest.approx(20e-4 - jump, abs=2e-3)
    assert f"jumped by {jump:+.1f}" in str(clock)


def test_outlying_stamps_of_a_topic_give_no_samples() -> None:
    """Of a car whose clock is behind by 3 s, so that a stamp of now would keep later ones from counting."""
    intake, topic = Intake(binding(), Sensors(odometry="wheel+imu")), SVEA.topic_of("car0", Role.DETECTIONS)
    found = 0
    for k in range(60):
        stamp = START + k * 20 * MS - (0 if k == 40 else 3_000 * MS)
        payload = encode(make(SVEA.topics[Role.DETECTIONS].type, header=header(stamp), objects=[]))
        found += len(list(intake.samples(Arrival(topic, payload, START + k * 20 * MS))))
    assert found == 59 and intake.rejected["car0"] == {"outlying stamp": 1}
