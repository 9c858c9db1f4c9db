"""Drives that were stopped, and those whose end is missing: what is whole is replayed, and why it ended is told."""

from __future__ import annotations

import time
import warnings
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from rosbags.highlevel import AnyReader

import coopenv
from coopenv.backends.base import Command
from coopenv.backends.mcap import read_recording
from coopenv.base.errors import DataError, DataWarning
from coopenv.cars.backend.drive import Drive, is_drive
from coopenv.cars.bags.files import BagFile
from coopenv.cars.codec import encode, make
from coopenv.cars.profile import STOPPED_TOPIC, SVEA, Role, presence_of
from coopenv.runs.command import execute, report
from coopenv.runs.demo import links_report
from coopenv.runs.rollouts import Rollout
from tests.helpers.cars import cars, fakes, write_fleet

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
            time.sleep(0.3)
        finally:
            backend.close()
    return folder / "drive.mcap", text.getvalue(), result


def ticks_of(path: Path) -> list[Any]:
    """Return all ticks of a drive of one episode."""
    drive = Drive(path)
    ticks = [drive.reset(None, {})]
    while True:
        more = list(drive.advance(STILL))
        ticks += more
        if not more:
            return ticks


def test_what_explains_a_stop_is_on_the_tape(recorded: Any) -> None:
    path, _, _ = recorded
    with AnyReader([path]) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
        messages = [(c.topic, reader.deserialize(raw, c.msgtype)) for c, _, raw in reader.messages()]
    for car in ("svea7", "svea1"):
        for role in (Role.GATE, Role.STATE, Role.REMOTE, Role.BATTERY, Role.CAMERA_INFO, Role.COMMAND, Role.ARM):
            assert counts.get(f"/{SVEA.topic_of(car, role)}"), role
        assert counts[f"/{presence_of(car)}"] == 1
    assert counts[f"/{SVEA.topic_of('svea7', Role.STOP)}"] > 1
    gates = [m.state for topic, m in messages if topic == f"/{SVEA.topic_of('svea7', Role.GATE)}"]
    assert gates.index("disarmed") < gates.index("armed") < gates.index("stopped")
    ((reason, car),) = [(m.reason, m.car) for topic, m in messages if topic == f"/{STOPPED_TOPIC}"]
    assert (reason, car) == (REASON, "svea7")


def test_a_replay_says_what_the_live_run_said(recorded: Any, tmp_path: Path) -> None:
    path, printed, live = recorded
    assert f"Stopped: {REASON}" in printed
    backend = Drive(path)
    run = Rollout(backend.scenario, backend=backend)
    text = StringIO()
    log, out = Console(quiet=True), Console(file=text)
    result = execute("lab", run, tmp_path / "out", log, {}, None, None, False)
    report(run, result, tmp_path / "out", out)
    told = text.getvalue()
    assert f"Stopped: {REASON}" in told and "Replayed at" in told and "imulat" not in told
    assert result["policy"] == "recorded" and live["policy"] == "route_follower"
    for key in ("vehicles", "outcome", "simulated_time_s"):
        np.testing.assert_equal(result[key], live[key])
    assert "ended before its time" in result["outcome"]


def test_of_a_drive_that_is_cut_off_what_is_whole_is_replayed(recorded: Any, tmp_path: Path) -> None:
    data, all_ticks = recorded[0].read_bytes(), ticks_of(recorded[0])
    numbers = []
    for size in np.linspace(4000, len(data) - 1, 8).astype(int).tolist():
        path = tmp_path / f"{size}.mcap"
        path.write_bytes(data[:size])
        assert is_drive(path)
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
            np.testing.assert_array_equal(tick.truth.position, same.truth.position)
        numbers.append(len(ticks))
    assert numbers == sorted(numbers) and numbers[-1] == len(all_ticks)
    assert len(set(numbers)) > 3


def test_where_the_disk_holds_nonsense_the_drive_ends(recorded: Any, tmp_path: Path) -> None:
    data, path = recorded[0].read_bytes(), tmp_path / "drive.mcap"
    path.write_bytes(data[: len(data) // 2] + bytes(5000))
    with pytest.warns(DataWarning, match="cut off"):
        ticks = ticks_of(path)
    assert 0 < len(ticks) < len(ticks_of(recorded[0]))


def test_other_files_that_are_cut_off_name_what_mends_them(recorded: Any, tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    path.write_bytes(recorded[0].read_bytes()[:-1])
    said = []
    for read in (read_recording, BagFile):
        with pytest.raises(DataError) as caught:
            read(path)
        said.append(str(caught.value))
    assert said == [f"{path}: cut off, the end of the MCAP file is missing; `mcap recover` mends it"] * 2


def test_rewards_of_own_actions_alone_are_not_those_of_the_drive(recorded: Any) -> None:
    """What docs/cars_records.md says: `control` and `last_action` are those of whoever acts at the replay."""
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
