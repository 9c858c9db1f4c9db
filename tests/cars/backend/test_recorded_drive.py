"""Drives on record: as other tools read them, and those that were stopped or cut off."""

from __future__ import annotations

import errno
import json
import struct
import threading
import warnings
from collections import Counter
from contextlib import suppress
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from rich.console import Console
from rosbags.highlevel import AnyReader

import coopenv
from coopenv.base.errors import DataError, DataWarning, OutputError
from coopenv.cars.backend.recorded_drive import PRESENCE, Drive, DriveRecorder, RecordedTransport
from coopenv.cars.backend.sources import DRIVE
from coopenv.cars.commands.demo import links_report
from coopenv.cars.fake.lockstep import Hub
from coopenv.cars.messages.codec import MOST_BYTES, TICK, encode, header, make
from coopenv.cars.settings.profile import STOPPED_TOPIC, SVEA, TICK_TOPIC, Role, presence_of
from coopenv.runs.command import execute, report
from coopenv.runs.rollouts import Rollout
from coopenv.sources.base import Command
from coopenv.sources.mcap import read_recording
from coopenv.sources.registry import kind_of
from tests.helpers.cars import cars, fakes, write_fleet
from tests.helpers.processes import wait_until

WHEEL, FRAMES = SVEA.topic_of("svea7", Role.WHEEL), SVEA.topic_of("svea7", Role.DETECTIONS)
TYPES = {WHEEL: SVEA.topics[Role.WHEEL].type, FRAMES: SVEA.topics[Role.DETECTIONS].type}


@pytest.fixture
def written(tmp_path: Path) -> Path:
    recorder = DriveRecorder(tmp_path / "drive.mcap", json.dumps({"cars": 1}).encode(), TYPES)
    recorder.tick(0, 10**9, 2**64 - 1, 3)
    for k in range(20):
        now = 10**9 + k * 10**7
        moved = {"twist": ((0.1 * k, 0.0, 0.0), (0.0, 0.0, 0.0))}
        recorder.write(WHEEL, encode(make(TYPES[WHEEL], header=header(now - 5, "base_link"), twist=moved)), now)
        frame = make(TYPES[FRAMES], header=header(now), objects=[{}] * (k % 3))
        recorder.write(FRAMES, encode(frame), now)
        recorder.write("fleet/nobody/knows", b"123", now)
        recorder.tick(k + 1, now)
    recorder.close()
    return tmp_path / "drive.mcap"


def messages_of(path: Path) -> list[tuple[str, Any]]:
    """Return topics and messages as rosbags reads them."""
    with AnyReader([path]) as reader:
        return [(c.topic, reader.deserialize(raw, c.msgtype)) for c, _, raw in reader.messages()]


def test_rosbags_reads_it_as_a_bag_of_ros_2(written: Path) -> None:
    with AnyReader([written]) as reader:
        found = {c.topic: c.msgtype for c in reader.connections}
        assert found == {f"/{WHEEL}": TYPES[WHEEL], f"/{FRAMES}": TYPES[FRAMES], f"/{TICK_TOPIC}": TICK}
    messages = messages_of(written)
    speeds = [m.twist.twist.linear.x for topic, m in messages if topic == f"/{WHEEL}"]
    assert speeds == [0.1 * k for k in range(20)]
    assert [len(m.objects) for topic, m in messages if topic == f"/{FRAMES}"] == [k % 3 for k in range(20)]
    first = next(m for topic, m in messages if topic == f"/{TICK_TOPIC}")
    assert (first.index, first.key, first.episode) == (0, 2**64 - 1, 3)


def test_messages_that_are_sent_or_set_aside_and_presences_are_recorded(tmp_path: Path) -> None:
    hub, heard, read = Hub(), [], []
    hub.connect().subscribe(WHEEL, heard.append)
    state, stop, wheels = (SVEA.topic_of("svea7", role) for role in (Role.STATE, Role.STOP, Role.WHEEL))
    types = {
        **TYPES,
        state: SVEA.topics[Role.STATE].type,
        stop: SVEA.topics[Role.STOP].type,
        "fleet/alive/svea7": PRESENCE,
    }
    recorder = DriveRecorder(tmp_path / "drive.mcap", b"{}", types)
    recorded = RecordedTransport(hub.connect(), recorder, (state, stop))
    for topic in (state, wheels):
        recorded.subscribe(topic, read.append)
    recorder.tick(0, 1)
    others = hub.connect()
    for name in ("svea7", "stranger"):
        others.announce(f"fleet/alive/{name}")
    others.publish(state, encode(make(types[state])))
    others.publish(state, bytes(MOST_BYTES + 1))  # is not read, and makes no file that nobody reads
    others.publish(stop, encode(make(types[stop], data=True)))
    others.publish(WHEEL, encode(make(TYPES[WHEEL])))  # for ticks: whoever makes them writes it down
    others.close()
    recorded.publish(WHEEL, encode(make(TYPES[WHEEL])), b"signature")
    recorder.stopped("svea7: is gone", "svea7", 3 * 10**9 + 5)
    recorder.close()
    assert [arrival.attachment for arrival in heard] == [b"", b"signature"] and len(read) == 4
    messages = messages_of(tmp_path / "drive.mcap")
    (stopped,) = [m for topic, m in messages if topic == f"/{STOPPED_TOPIC}"]
    assert (stopped.reason, stopped.car) == ("svea7: is gone", "svea7")
    assert (stopped.header.stamp.sec, stopped.header.stamp.nanosec) == (3, 5)
    assert Counter(topic for topic, _ in messages) == {
        f"/{STOPPED_TOPIC}": 1,
        f"/{TICK_TOPIC}": 1,
        f"/{WHEEL}": 1,
        f"/{state}": 1,
        f"/{stop}": 1,
        "/fleet/alive/svea7": 2,
    }
    assert [m.data for topic, m in messages if topic == "/fleet/alive/svea7"] == [True, False]


def test_the_order_of_each_thread_is_kept(tmp_path: Path) -> None:
    recorder, each, writers = DriveRecorder(tmp_path / "drive.mcap", b"{}", TYPES), 500, 4
    frame = encode(make(TYPES[FRAMES]))

    def write(number: int) -> None:
        for k in range(each):
            recorder.write(FRAMES, frame, number * each + k)

    threads = [threading.Thread(target=write, args=(number,)) for number in range(writers)]
    for thread in threads:
        thread.start()
    recorder.tick(0, 1)
    for k in range(1, each):
        recorder.tick(k, k)
    for thread in threads:
        thread.join()
    recorder.close()
    with (tmp_path / "drive.mcap").open("rb") as stream:
        found = [(c.topic, m.log_time) for _, c, m in make_reader(stream).iter_messages(log_time_order=False)]
    frames = [time for topic, time in found if topic == f"/{FRAMES}"]
    for number in range(writers):
        assert [t for t in frames if t // each == number] == [*range(number * each, (number + 1) * each)]
    assert [time for topic, time in found if topic == f"/{TICK_TOPIC}"] == [1, *range(1, each)]


def whole(path: Path) -> list[tuple[str, int]]:
    """Return topic and time of the messages that the library finds in a file before it comes upon its end."""
    channels, found = {}, []
    with path.open("rb") as stream, suppress(EndOfFile, struct.error):
        for record in StreamReader(stream, validate_crcs=True).records:
            if isinstance(record, Channel):
                channels[record.id] = record.topic
            elif isinstance(record, Message):
                found.append((channels[record.channel_id], record.log_time))
    return found


@pytest.fixture
def recorder(tmp_path: Path) -> DriveRecorder:
    made = DriveRecorder(tmp_path / "drive.mcap", b"{}", TYPES)
    made.tick(0, 1)
    return made


def test_records_reach_the_file_without_an_end_and_a_stop_at_once(
    recorder: DriveRecorder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A process that is killed loses what came after the last flush, and no stop."""
    found: list[tuple[str, int]] = []

    def has(*last: tuple[str, int]) -> bool:
        found[:] = whole(tmp_path / "drive.mcap")
        return found[-len(last) :] == [*last]

    recorder.write(FRAMES, encode(make(TYPES[FRAMES])), 2)
    wait_until(lambda: has((f"/{TICK_TOPIC}", 1), (f"/{FRAMES}", 2)))
    monkeypatch.setattr("coopenv.cars.backend.recorded_drive.FLUSH", 1e6)
    recorder.tick(1, 3)
    recorder.stopped("sent at once", "", 4)
    wait_until(lambda: has((f"/{FRAMES}", 2), (f"/{TICK_TOPIC}", 3), (f"/{STOPPED_TOPIC}", 4)))
    recorder.close()


def test_a_full_disk_is_one_line_and_the_written_part_can_be_read(
    recorder: DriveRecorder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flush, flushed = recorder._writer.flush, list[bool]()

    def full() -> None:
        if flushed:
            raise OSError(errno.EFBIG, "File too large")
        flush()
        flushed.append(True)

    monkeypatch.setattr(recorder._writer, "flush", full)
    recorder.stopped("written", "", 2)
    wait_until(lambda: flushed)
    recorder.stopped("lost", "", 3)
    with pytest.raises(OutputError, match=r"^cannot write to .*drive\.mcap: File too large$"):
        recorder.close()
    assert whole(tmp_path / "drive.mcap") == [(f"/{TICK_TOPIC}", 1), (f"/{STOPPED_TOPIC}", 2)]


def test_a_file_without_an_episode_is_removed(tmp_path: Path) -> None:
    recorder = DriveRecorder(tmp_path / "drive.mcap", b"{}", TYPES)
    recorder.write(FRAMES, encode(make(TYPES[FRAMES])), 1)
    recorder.close()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "why"),
    [("a.bag", r"must end in \.mcap"), ("no/drive.mcap", "cannot write to"), ("drive.mcap", "exists already")],
)
def test_a_path_that_cannot_be_written_is_named_and_nothing_is_overwritten(written: Path, name: str, why: str) -> None:
    before = written.read_bytes()
    with pytest.raises(OutputError, match=why):
        DriveRecorder(written.parent / name, b"{}", TYPES)
    assert written.read_bytes() == before


STILL = Command(*np.zeros((3, 2)))
REASON = "svea7: its gate is stopped"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, dict[str, Any]]:
    """Drive until somebody presses the emergency stop; return the record, what the run printed, and its figures."""
    folder = tmp_path_factory.mktemp("recorded")
    path = write_fleet(folder)
    with fakes(path) as (hub, _):
        backend = cars(path, hub, record=folder / "drive.mcap")
        text = StringIO()
        log, out = Console(quiet=True), Console(file=text)
        try:
            run = Rollout(backend.scenario, 3, policy="route_follower", backend=backend, options={"arm": True})

            def press_after_a_while() -> str:
                if run.ticks_recorded > 120:
                    hub.connect().publish(
                        SVEA.topic_of("svea7", Role.STOP), encode(make("std_msgs/msg/Bool", data=True))
                    )
                return ""

            result = execute("lab", run, folder / "out", log, {}, None, None, False, press_after_a_while)
            links_report(backend, out)
            hub.clock.sleep(0.3)
        finally:
            backend.close()
    return folder / "drive.mcap", text.getvalue(), result.metrics


def ticks_of(path: Path) -> list[Any]:
    """Return all ticks of a drive of one episode."""
    drive = Drive(path)
    ticks = [drive.reset(None, {})]
    while True:
        more = list(drive.advance(STILL))
        ticks += more
        if not more:
            return ticks


def test_the_messages_that_explain_a_stop_are_recorded(recorded: Any) -> None:
    messages = messages_of(recorded[0])
    counts = Counter(topic for topic, _ in messages)
    for car in ("svea7", "svea1"):
        for role in (Role.GATE, Role.STATE, Role.REMOTE, Role.BATTERY, Role.CAMERA_INFO, Role.COMMAND, Role.ARM):
            assert counts[f"/{SVEA.topic_of(car, role)}"], role
        assert counts[f"/{presence_of(car)}"] == 1
    assert counts[f"/{SVEA.topic_of('svea7', Role.STOP)}"] > 1
    gates = [m.state for topic, m in messages if topic == f"/{SVEA.topic_of('svea7', Role.GATE)}"]
    assert gates.index("disarmed") < gates.index("armed") < gates.index("stopped")
    ((reason, car),) = [(m.reason, m.car) for topic, m in messages if topic == f"/{STOPPED_TOPIC}"]
    assert (reason, car) == (REASON, "svea7")


def test_a_replay_has_the_report_of_the_live_run(recorded: Any, tmp_path: Path) -> None:
    path, printed, live = recorded
    assert f"Stopped: {REASON}" in printed
    backend = Drive(path)
    run = Rollout(backend.scenario, backend=backend)
    text = StringIO()
    log, out = Console(quiet=True), Console(file=text)
    found = execute("lab", run, tmp_path / "out", log, {}, None, None, False)
    result = found.metrics
    report(run, found, tmp_path / "out", out)
    printed = text.getvalue()
    assert f"Stopped: {REASON}" in printed and "Replayed at" in printed and "imulat" not in printed
    assert result["policy"] == "recorded" and live["policy"] == "route_follower"
    for key in ("vehicles", "outcome", "simulated_time_s"):
        np.testing.assert_equal(result[key], live[key])
    assert "ended before its time" in result["outcome"]


def test_the_whole_part_of_a_drive_that_is_cut_off_is_replayed(recorded: Any, tmp_path: Path) -> None:
    data, all_ticks = recorded[0].read_bytes(), ticks_of(recorded[0])
    numbers = []
    for size in np.linspace(4000, len(data) - 1, 8).astype(int).tolist():
        path = tmp_path / f"{size}.mcap"
        path.write_bytes(data[:size])
        assert kind_of(path) is DRIVE
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                ticks = ticks_of(path)
            except DataError as error:
                assert (
                    str(error) == f"{path}: cut off, the end of the MCAP file is missing, and no episode begins in it"
                )
                numbers.append(0)
                continue
        (warning,) = caught
        assert issubclass(warning.category, DataWarning)
        assert str(warning.message).startswith(f"{path}: cut off, the end of the MCAP file is missing: nothing after ")
        for tick, same in zip(ticks, all_ticks, strict=False):
            np.testing.assert_array_equal(tick.bearings, same.bearings)
            assert (tick.truth is None) == (same.truth is None)  # no motion capture for a while: a busy computer
            if tick.truth is not None:
                np.testing.assert_array_equal(tick.truth.position, same.truth.position)
        numbers.append(len(ticks))
    assert numbers == sorted(numbers) and numbers[-1] == len(all_ticks)
    assert len(set(numbers)) > 3


def test_a_drive_ends_at_damaged_bytes(recorded: Any, tmp_path: Path) -> None:
    data, path = recorded[0].read_bytes(), tmp_path / "drive.mcap"
    path.write_bytes(data[: len(data) // 2] + bytes(5000))
    with pytest.warns(DataWarning, match="cut off"):
        ticks = ticks_of(path)
    assert 0 < len(ticks) < len(ticks_of(recorded[0]))


def test_a_recording_that_is_cut_off_names_the_tool_that_mends_it(recorded: Any, tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    path.write_bytes(recorded[0].read_bytes()[:-1])
    with pytest.raises(DataError) as caught:
        read_recording(path)
    assert str(caught.value) == f"{path}: cut off, the end of the MCAP file is missing; `mcap recover` mends it"


def test_rewards_of_own_actions_alone_are_not_those_of_the_drive(recorded: Any) -> None:
    """As in docs/cars_records.md: `control` and `last_action` belong to the policy of the replay."""
    outcomes = []
    for action in (np.zeros(2), np.array([0.5, -0.5])):
        env = coopenv.parallel_env(recorded[0], dtype="float64", overrides={"reward.weights.control": 1.0})
        env.reset(seed=0)
        outcomes.append(env.step(dict.fromkeys(env.agents, action)))
    (first, *_, before), (second, *_, after) = outcomes
    for agent in before:
        assert (first[agent] != second[agent]).sum() == 2  # speed and steering of one's own action
        different = {k for k, v in before[agent]["reward_terms"].items() if v != after[agent]["reward_terms"][k]}
        assert different == {"control"}
        np.testing.assert_equal(before[agent]["estimate"], after[agent]["estimate"])
