"""Cars as a backend: fakes with their gates, on a network within this process and a simulated clock."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import coopenv
from coopenv.api.parallel_env import CooperativeLocalisationEnv as Env
from coopenv.api.terms.layout import observation_layout
from coopenv.base.errors import CoopenvError
from coopenv.cars.backend import assembler
from coopenv.cars.backend.backend import Svea
from coopenv.cars.backend.recorded_drive import Drive
from coopenv.cars.fake.car import Fake
from coopenv.cars.fake.lockstep import Hub
from coopenv.cars.link.transport import Arrival
from coopenv.cars.messages.codec import encode, header, make
from coopenv.cars.messages.readings import Twist
from coopenv.cars.messages.v2x import report_message
from coopenv.cars.settings.profile import RESET_TOPIC, SVEA, Role
from coopenv.observers.contract import Message
from coopenv.sources.base import VehicleBroadcast
from tests.helpers.cars import OVERTAKING, SAFETY, cars, fakes, send_fault, write_fleet

AHEAD = np.array([0.2, 0.0])  # 0.3 m/s of f1


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, Hub, dict[str, Fake]]]:
    path = write_fleet(tmp_path_factory.mktemp("lab"))
    with fakes(path) as (hub, made):
        yield path, hub, dict(made)


def env_of(backend: Svea) -> Env:
    return coopenv.parallel_env("cars", backend=backend, dtype="float64")


@pytest.fixture
def env(lab: Any) -> Iterator[Env]:
    with closing(env_of(cars(*lab[:2]))) as made:
        yield made


def drive(env: Env, steps: int, action: np.ndarray = AHEAD) -> dict[str, Any]:
    infos: dict[str, Any] = {}
    for _ in range(steps):
        if not env.agents:
            break
        infos = env.step(dict.fromkeys(env.agents, action))[-1]
    return infos


def place(made: dict[str, Fake], car: str) -> np.ndarray:
    world = made[car].world
    return np.array(world.pose(world.agent)[1])


def end_faults(made: dict[str, Fake]) -> None:
    for fake in made.values():
        fake._faults._known.clear()


def listen(hub: Hub, topic: str) -> list[Arrival]:
    heard: list[Arrival] = []
    hub.connect().subscribe(topic, heard.append)
    return heard


def test_armed_cars_drive_and_know_where_they_are(lab: Any, env: Env) -> None:
    _, _, made = lab
    env.reset(seed=3, options={"arm": True})
    before = {car: place(made, car) for car in made}
    infos = drive(env, 40)
    for agent, car in (("vehicle_1", "svea7"), ("vehicle_2", "svea1")):
        assert infos[agent]["car"]["name"] == car and infos[agent]["car"]["armed"], infos[agent]["car"]
        assert infos[agent]["car"]["gate"] in ("armed", "timed_out") and infos[agent]["car"]["stopped"] == ""
        assert np.linalg.norm(place(made, car) - before[car]) > 0.2
        assert infos[agent]["position_error"] < 0.15 and infos[agent]["orientation_error"] < 5.0


def test_cars_that_are_not_armed_stand(lab: Any) -> None:
    path, hub, made = lab
    commands = listen(hub, SVEA.topic_of("*", Role.COMMAND))
    with closing(env_of(cars(path, hub))) as env:
        _, infos = env.reset(seed=3)
        before = {car: place(made, car) for car in made}
        assert not any(info["car"]["armed"] for info in infos.values())
        infos = drive(env, 20)
        assert infos["vehicle_1"]["position_error"] < 0.3  # observers run all the same
        assert not commands
        for car in made:
            np.testing.assert_allclose(place(made, car), before[car], atol=1e-6)


def test_a_car_that_freezes_stops_all_and_arming_anew_recovers(lab: Any, tmp_path: Path) -> None:
    path, hub, made = lab
    with closing(env_of(cars(path, hub))) as env:
        env.reset(seed=4, options={"arm": True})
        drive(env, 20)
        send_fault(hub, "svea1", "freeze=1@0+2.5")
        infos = drive(env, 60)
        assert not env.agents
        for info in infos.values():
            assert "svea1" in info["car"]["stopped"] and info["car"]["stopped_by"] == "svea1"
        hub.clock.sleep(0.8)
        standing = place(made, "svea7")
        hub.clock.sleep(0.3)
        np.testing.assert_allclose(place(made, "svea7"), standing, atol=1e-3)
        end_faults(made)
        env.reset(seed=4, options={"arm": True})
        before = place(made, "svea7")
        infos = drive(env, 30)  # at first it stands until its estimate has settled
        assert env.agents and infos["vehicle_1"]["car"]["stopped"] == ""
        assert np.linalg.norm(place(made, "svea7") - before) > 0.05


def test_a_drive_is_replayed_bit_for_bit_and_under_other_observers(lab: Any, tmp_path: Path) -> None:
    path, hub, _ = lab
    record = tmp_path / "drive.mcap"
    with closing(env_of(cars(path, hub, record=record))) as env:
        env.reset(seed=7)
        env.reset()  # another episode of that seed
        live = [env.reset(seed=5, options={"arm": True})[0]]
        live += [env.step(dict.fromkeys(env.agents, AHEAD))[0] for _ in range(30)]
    with pytest.raises(CoopenvError, match="exists already"):
        cars(path, hub, record=record)
    for observer in (None, "riccati", "mekf"):
        replay = coopenv.parallel_env(record, observer=observer, dtype="float64")
        again: list[Any] = []  # observations tell one's own action as well
        infos: dict[str, Any] = {}
        for _ in range(3):
            observations, _ = replay.reset(seed=99)
            again = [observations]
            while replay.agents:
                after, *_, infos = replay.step(dict.fromkeys(replay.agents, AHEAD))
                again.append(after)
        assert all(info["position_error"] < 0.5 for info in infos.values()), observer
        assert len(again) >= len(live)
        for before, after in zip(live, again, strict=False) if observer is None else ():
            for agent, values in before.items():
                np.testing.assert_array_equal(values, after[agent])


def test_a_drive_that_is_none_is_refused(tmp_path: Path) -> None:
    broken = tmp_path / "drive.mcap"
    broken.write_bytes(b"\x89MCAP0\r\n" + b"x" * 50)
    with pytest.raises(CoopenvError, match=r"drive\.mcap: "):
        Drive(broken)
    with pytest.raises(CoopenvError, match="cannot be read"):
        Drive(tmp_path / "nowhere.mcap")


def test_a_station_of_one_car_receives_the_estimates_of_the_other(lab: Any) -> None:
    """The leader's station is a repeated broadcast of its true pose."""
    path, hub, made = lab
    with closing(env_of(cars(path, hub, car="svea1"))) as env:
        assert env.possible_agents == ["vehicle_2"]
        station = hub.connect()

        def broadcast() -> None:
            R, p = made["svea7"].world.pose(made["svea7"].world.agent)
            extra = {"odometry": np.zeros(6), "depends_on": np.zeros(1, np.uint64)}
            covariance = 1e-4 * np.eye(6)
            sent = VehicleBroadcast(0, R, p, covariance, Message(p, R, covariance, extra))
            message = report_message(sent, hub.clock.wall(), np.zeros(3))
            station.publish(SVEA.topic_of("svea7", Role.REPORT), encode(message))

        end = hub.clock.repeat(0.05, broadcast, "the other station")
        mask = observation_layout(env.scenario)["message_mask"]
        env.reset(seed=3)
        received = list[float]()
        for _ in range(20):
            observations, *_, infos = env.step(dict.fromkeys(env.agents, AHEAD))
            received.append(float(mask.values(observations["vehicle_2"][None]).mean()))
        end()
        assert list(infos) == ["vehicle_2"] and infos["vehicle_2"]["position_error"] < 0.3
        assert np.mean(received) > 0.0 and int(env.engine.view("inbox_tick")[0, 1, 0]) > 0
        of_leader = env.engine.view("estimate_rotation")[0, 0]
        np.testing.assert_allclose(of_leader, made["svea7"].world.pose(made["svea7"].world.agent)[0], atol=0.05)


def refuses(path: Path, hub: Hub, why: str, car: str | None = None) -> None:
    with closing(env_of(cars(path, hub, car=car))) as env:
        with pytest.raises(CoopenvError, match=why):
            env.reset(seed=0, options={"arm": True})
        assert not env.agents


def test_nothing_is_armed_that_should_not_be(lab: Any, tmp_path: Path) -> None:
    _, hub, _ = lab
    strict = write_fleet(tmp_path, safety=SAFETY + "max_clock_offset = 0.1\n")
    send_fault(hub, "svea1", "clock_offset=0.2")
    try:
        refuses(strict, hub, r"not armed: svea1: its clock is \d+ ms ahead of this computer's")
    finally:
        send_fault(hub, "svea1", "clock_offset=0")


def test_absent_cars_are_not_armed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for patience in ("FIRST_MESSAGES_TIME", "CAMERA_INFO_TIME", "READY_TIME"):
        monkeypatch.setattr(f"coopenv.cars.backend.backend.{patience}", 0.1)
    refuses(write_fleet(tmp_path), Hub(), r"not armed: svea7: no odometry on fleet/svea7/mavros/wheel_odometry")


@pytest.mark.parametrize(
    ("safety", "second", "why"),
    [
        ("separation = 0.7\n", -1.0, "m where they come to a stand, 0.7 m is the least"),
        ("geofence = [[-9, -9], [9, -9], [9, AHEAD], [-9, AHEAD]]\n", 1.0, "m to stand in the geofence"),
    ],
)
def test_cars_stand_before_they_break_a_rule(lab: Any, tmp_path: Path, safety: str, second: float, why: str) -> None:
    path, hub, made = lab
    env = env_of(cars(path, hub))
    env.reset(seed=0)  # puts the cars at their start
    env.close()
    ahead = max(place(made, car)[1] for car in made) + 0.4
    fence = safety.replace("AHEAD", str(ahead))
    with closing(env_of(cars(write_fleet(tmp_path, safety=SAFETY + fence), hub))) as env:
        env.reset(seed=0, options={"arm": True})
        infos: dict[str, Any] = {}
        for _ in range(100):
            if not env.agents:
                break
            infos = env.step({"vehicle_1": np.array([1.0, 0.0]), "vehicle_2": np.array([second, 0.0])})[-1]
        assert not env.agents and why in infos["vehicle_1"]["car"]["stopped"]
        hub.clock.sleep(1.0)
        first, second_place = (place(made, car) for car in made)
        kept = (
            max(first[1], second_place[1]) < ahead
            if "geofence" in safety
            else np.linalg.norm(first - second_place) > 0.65
        )
        assert kept, (first, second_place, ahead)


BLIND = "max_error = 1e6\nmax_turn_error = 4.0\n"
RICCATI = 'overrides = { "observer.name" = "riccati" }\n'
LOW = 'overrides = { "camera.position" = [0.165, 0.0, 0.065] }\n'


@pytest.mark.parametrize(
    ("first", "fault", "safety", "why"),
    [
        ("", "swapped_signatures@0+6", "", "from motion capture"),
        ("", "swapped_signatures@0+6", BLIND, "its bearings"),
        pytest.param(LOW, "swapped_signatures@60", "", "m from motion capture", marks=pytest.mark.slow),
        ("", "swapped_signatures@0+6", BLIND + "max_protection_level = 0.5\n", "if one source is faulty"),
        (RICCATI, "", BLIND + "max_protection_level = 0.5\n", "its estimate is inf m off at worst"),
    ],
)
def test_cars_stand_until_an_estimate_settles_that_is_wrong(
    lab: Any, tmp_path: Path, first: str, fault: str, safety: str, why: str
) -> None:
    _, hub, made = lab
    with closing(env_of(cars(write_fleet(tmp_path, first + OVERTAKING, SAFETY + safety), hub))) as env:
        for car in made if fault else ():
            send_fault(hub, car, fault)
        env.reset(seed=3, options={"arm": True})
        before = {car: place(made, car) for car in made}
        infos = drive(env, 60)
        assert not env.agents and why in infos["vehicle_1"]["car"]["stopped"]
        hub.clock.sleep(0.8)
        most = 0.3 if safety else 0.01  # m; bearings take longer to contradict an estimate than motion capture
        assert all(np.linalg.norm(place(made, car) - before[car]) < most for car in made)
        end_faults(made)


@pytest.mark.parametrize(
    ("first", "safety", "why", "car"),
    [
        ("", "geofence = [[-9, -9], [9, -9], [9, -8], [-9, -8]]\n", "not armed: svea7: left the geofence", None),
        ("", "separation = 5.0\n", "not armed: svea7: .* m from svea1, 5 m is the least", "svea7"),
        ('overrides = { "camera.focal_length" = [250.0, 250.0] }\n', "", "publishes focal_length", None),
    ],
)
def test_cars_are_not_armed_where_they_must_not_be_or_with_another_camera(
    lab: Any, tmp_path: Path, first: str, safety: str, why: str, car: str | None
) -> None:
    refuses(write_fleet(tmp_path, first + OVERTAKING, SAFETY + safety), lab[1], why, car)


def test_a_car_stopped_by_another_station_needs_a_release(lab: Any, tmp_path: Path) -> None:
    _, hub, _ = lab
    with closing(env_of(cars(write_fleet(tmp_path, OVERTAKING.replace("fakes = true", "")), hub))) as env:
        env.reset(options={"arm": True, "release": True})
        drive(env, 5)
        hub.connect().publish(SVEA.topic_of("svea1", Role.STOP), encode(make("std_msgs/msg/Bool", data=True)))
        drive(env, 60)
        assert not env.agents
        for _ in range(2):
            with pytest.raises(CoopenvError, match=r"not armed: svea1: it was stopped elsewhere.*--release"):
                env.reset(options={"arm": True})
        env.reset(options={"arm": True, "release": True})
        infos = drive(env, 5)
        assert infos["vehicle_2"]["car"]["gate"] in ("armed", "timed_out")


STICKS = {"rssi": 100, "channels": np.array([1500, 1500, 1800, 1500, 1500], dtype=np.uint16)}


@pytest.mark.parametrize(
    ("car", "role", "fields", "why"),
    [
        ("svea1", Role.REMOTE, STICKS, "svea1: is driven by remote control"),
        ("svea7", Role.STOP, {"data": True}, "svea7: its gate is stopped"),
    ],
)
def test_the_remote_control_and_a_stop_end_the_episode(
    lab: Any, env: Env, car: str, role: Role, fields: dict[str, Any], why: str
) -> None:
    env.reset(seed=0, options={"arm": True})
    drive(env, 5)
    stamped = {"header": header(lab[1].clock.wall())} if role is Role.REMOTE else {}
    lab[1].connect().publish(SVEA.topic_of(car, role), encode(make(SVEA.topics[role].type, **stamped, **fields)))
    infos = drive(env, 60)
    assert not env.agents and infos["vehicle_1"]["car"]["stopped"] == why


def test_a_gate_with_lower_limits_ends_the_episode(lab: Any, tmp_path: Path) -> None:
    """As with `coopenv svea gate --max-speed`: otherwise its car would stand, and nothing would tell why."""
    faster = 'overrides = { "dynamics.max_speed" = 1.0 }\n' + OVERTAKING
    path = write_fleet(tmp_path, faster, SAFETY + "max_speed = 1.0\n")
    with closing(env_of(cars(path, lab[1]))) as env:
        env.reset(seed=0, options={"arm": True})
        infos = drive(env, 60, np.array([1.0, 0.0]))
        assert not env.agents
        why = infos["vehicle_1"]["car"]["stopped"]
        assert "its gate has refused" in why and "its limits are lower" in why


def test_an_error_between_steps_stops_the_cars(lab: Any) -> None:
    path, hub, _ = lab
    backend = cars(path, hub)
    with closing(env_of(backend)) as env:
        env.reset(seed=0, options={"arm": True})
        drive(env, 10)
        with pytest.raises(coopenv.ActionError):
            env.step({"vehicle_1": np.array([np.nan, 0.0]), "vehicle_2": AHEAD})
        hub.clock.sleep(0.5)
        assert {state.state for state in backend.gates.states.values()} == {"stopped"}


@pytest.mark.parametrize("options", [{"arms": True}, {"arm": 1}])
def test_unknown_options_of_a_reset_are_refused(env: Env, options: dict[str, Any]) -> None:
    with pytest.raises(CoopenvError, match="option"):
        env.reset(seed=0, options=options)


@pytest.mark.parametrize("watch", [True, False])
def test_a_station_that_only_watches_sends_nothing(
    watch: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("coopenv.cars.backend.backend.FIRST_MESSAGES_TIME", 0.1)
    hub, sent, seen = Hub(), list[str](), list[str]()
    with closing(hub.connect()) as other:
        other.subscribe("**", lambda arrival: sent.append(arrival.topic))
        other.watch("**", lambda name, _: seen.append(name))
        with closing(env_of(cars(write_fleet(tmp_path), hub, watch=watch))) as env:
            env.reset(seed=0)
            drive(env, 3)
    assert (RESET_TOPIC in sent, bool(sent), bool(seen)) == (not watch,) * 3


def test_a_gyro_that_sends_zeros_stops_the_cars_and_keeps_them_from_arming(
    lab: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, hub, _ = lab
    reading = assembler.read

    def dead(role: Role, *args: Any, **options: Any) -> Any:
        value = reading(role, *args, **options)
        return Twist(None, np.zeros(3)) if role is Role.IMU else value

    monkeypatch.setattr(assembler, "read", dead)
    turn = np.array([0.6, 1.0], np.float32)
    with closing(env_of(cars(path, hub))) as env:
        env.reset(seed=3, options={"arm": True})
        stopped = drive(env, 100, turn)["vehicle_1"]["car"]["stopped"]
        assert re.search(r"svea\d: its turn rate is 0 rad/s in all \d+ messages, while .* turns? it by ", stopped)
        with pytest.raises(CoopenvError, match=r"not armed: svea\d: its turn rate is 0 rad/s"):
            env.reset(options={"arm": True})


def test_cars_whose_sensors_contradict_motion_capture_do_not_arm_again(
    lab: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first episode moves them; the line is that of a bag, see `tests/cars/doctor`."""
    _, hub, _ = lab
    reading = assembler.read

    def reversed_by(role: Role, *args: Any, **options: Any) -> Any:
        value = reading(role, *args, **options)
        return Twist(None, -value.angular) if role is Role.IMU else value

    monkeypatch.setattr(assembler, "read", reversed_by)
    blind = BLIND + "max_std = 1e6\nmax_nis = 1e6\n"
    with closing(env_of(cars(write_fleet(tmp_path, OVERTAKING, SAFETY + blind), hub))) as env:
        env.reset(seed=3, options={"arm": True})
        for turn in (1.0, -1.0, 1.0):
            drive(env, 40, np.array([0.6, turn], np.float32))
        line = r"turn rate of svea\d is -[01]\.\d+\(\d+\) times that of motion capture \(the other sign\)"
        with pytest.raises(CoopenvError, match=f"not armed: .*{line}"):
            env.reset(options={"arm": True})
