"""Fake cars and their router as threads and processes: they are there when asked for, and gone whatever happens."""

from __future__ import annotations

import re
import socket
import sys
import time
import tracemalloc
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from itertools import repeat
from pathlib import Path
from threading import Event
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from coopenv.base.errors import CoopenvError
from coopenv.cars.backend.backend import scenario_of
from coopenv.cars.backend.binding import bind
from coopenv.cars.backend.station import Gates
from coopenv.cars.fake.fleet import FakesError, free_port
from coopenv.cars.fake.fleet import fakes as fake_processes
from coopenv.cars.fake.lockstep import Hub
from coopenv.cars.gate.gate import STATUS
from coopenv.cars.link.clock import SimulatedClock
from coopenv.cars.link.keys import load_signer, load_verifier, make_keys
from coopenv.cars.link.transport import Arrival
from coopenv.cars.link.zenoh import open_zenoh
from coopenv.cars.messages.cdr import write
from coopenv.cars.messages.codec import MOST_BYTES, encode, make
from coopenv.cars.messages.see import next_message
from coopenv.cars.settings.deployment import DeploymentError, Safety, load_deployment
from coopenv.cars.settings.limits import Limits
from coopenv.cars.settings.profile import SVEA, Role, presence_of
from coopenv.cli.app import app
from tests.helpers.cars import OVERTAKING, open_fake, write_fleet
from tests.helpers.processes import ROOT, mentioning, start, wait_until
from tests.helpers.wire import free_endpoint, seen_by

LIMITS = Limits(speed=0.5, steering=0.5, acceleration=1.0, steering_rate=2.0)


@pytest.fixture
def fleet(tmp_path: Path) -> Path:
    return write_fleet(tmp_path, f'{OVERTAKING}[network]\nconnect = ["{free_endpoint()}"]\n', safety="")


def test_unknown_cars_and_faults_are_one_line(fleet: Path) -> None:
    with pytest.raises(CoopenvError, match="unknown car 'svea9'"):
        open_fake(fleet, "svea9", Hub().connect())
    result = CliRunner().invoke(app, ["svea", "fake", str(fleet), "--car", "svea7", "--fault", "melt"])
    assert isinstance(result.exception, CoopenvError) and "unknown fault 'melt'" in str(result.exception)


def test_a_gate_obeys_the_given_senders(fleet: Path) -> None:
    fleet.write_text(fleet.read_text() + '[security]\nkeys = "keys"\n')
    keys = fleet.parent / "keys"
    make_keys(keys, ["svea7", "svea1", "station"])
    hub = Hub(clock := SimulatedClock())
    car = open_fake(fleet, "svea7", hub.connect(), station="svea7")
    clock.join(lambda: car.next, car.advance)
    here, verifier = hub.connect(), load_verifier(keys)
    signers = [load_signer(keys, name) for name in ("svea7", "station")]
    own, other = (Gates(here, ("svea7",), LIMITS, signer, verifier) for signer in signers)
    clock.sleep(0.3)
    assert other.states["svea7"].state == own.states["svea7"].state == "disarmed"
    with pytest.raises(CoopenvError, match="svea7"):
        other.begin()
    assert own.states["svea7"].state == "disarmed"
    own.begin()
    assert own.states["svea7"].state == "armed"
    own.end()
    with pytest.raises(CoopenvError, match="no public key of 'svea9'"):
        open_fake(fleet, "svea7", Hub().connect(), station="svea9")


FLEETS = sorted((ROOT / "examples" / "fleet").glob("*.toml"))
SHIPPED = ROOT / "examples" / "fleet" / "overtaking.toml"


@pytest.mark.parametrize("path", FLEETS, ids=lambda path: path.stem)
def test_the_shipped_fleets_are_those_of_their_environments(path: Path) -> None:
    fleet = load_deployment(path)
    scenario = scenario_of(fleet, None, {})
    binding = bind(scenario, fleet.cars, fleet.markers, path.name, None)
    landmarks = len(scenario.landmarks)
    marked = {landmarks + binding.cars[car.name] for car in fleet.cars if car.marker and car.name in binding.cars}
    assert set(binding.targets.values()) == marked | set(range(landmarks))
    assert len(fleet.cars) == len(scenario.vehicles) + len(binding.leaders)
    assert fleet.fakes and fleet.network.connect == ("tcp/127.0.0.1:7447",)
    commands = [line.removeprefix("#").split() for line in path.read_text().splitlines() if "coopenv svea" in line]
    assert any("demo" in command for command in commands)
    for command in commands:
        for name in command:
            assert not name.endswith(".toml") or name == str(path.relative_to(ROOT))


def test_an_endpoint_takes_the_place_of_the_files() -> None:
    assert load_deployment(SHIPPED, "tcp/10.0.0.1:1").network.connect == ("tcp/10.0.0.1:1",)
    with pytest.raises(DeploymentError, match=r"network\.connect.*is no endpoint"):
        load_deployment(SHIPPED, "nonsense")


def health(file: Path, endpoint: str = "", *options: str) -> Result:
    connect = ("--connect", endpoint) if endpoint else ()
    return CliRunner().invoke(app, ["svea", "health", str(file), "--car", "svea7", *connect, *options])


def test_cars_come_and_go() -> None:
    with pytest.raises(ZeroDivisionError), fake_processes(SHIPPED) as endpoint:
        with closing(open_zenoh("client", [endpoint])) as here:
            seen = seen_by(here)
            wait_until(lambda: set(seen) == {(presence_of("svea7"), True), (presence_of("svea1"), True)})
            assert len(mentioning(endpoint)) == 3
            lines = health(SHIPPED, endpoint, "--clocks", "1").output.splitlines()
            clocks = [line for line in lines if "clock of" in line]
            lines = [line for line in lines if line not in clocks]
            found = [re.match(r"svea7: clock of fleet/(.*): (.*) ms (behind|ahead), .*0 of", line) for line in clocks]
            assert [m and m[1].split("/")[-1] for m in found] == ["velocity", "data_raw", "objects_info", "odom"]
            assert all(m and float(m[2]) < 50.0 for m in found)
            assert lines[0] == "svea7: gate disarmed, 0 commands accepted, 0 messages refused"
            stands = "from 0.5 m/s to a stand 0.8 s and 0.28 m, with safety.deceleration"
            assert lines[1] == f"svea7: station or radio silent: {stands}"
            assert [line.split(": ")[1] for line in lines[1:4]] == [*Safety().stopping(0.5, SVEA.command)]
            assert lines[4].startswith("svea7: not tried from outside: tcp/127.0.0.1:7447: no Zenoh there")
        raise ZeroDivisionError
    assert not mentioning(endpoint)


def test_they_end_with_whoever_started_them(tmp_path: Path) -> None:
    """Also where it is ended by force."""
    port = free_port()
    code = "import time; from coopenv.cars.fake.fleet import fakes\n"
    code += f"with fakes({str(SHIPPED)!r}, {port}):\n time.sleep(300)"
    parent = start((sys.executable, "-c", code), tmp_path)
    try:
        wait_until(lambda: len(mentioning(f"--connect tcp/127.0.0.1:{port}")) == 2 or parent.poll() is not None)
    finally:
        parent.kill()
        parent.communicate()
    wait_until(lambda: not mentioning(f"tcp/127.0.0.1:{port}"))


def test_health_is_asked_where_the_gate_is_and_not_beyond_the_radio(tmp_path: Path) -> None:
    endpoint, file = free_endpoint(), tmp_path / "fleet.toml"
    text = SHIPPED.read_text().replace("tcp/127.0.0.1:7447", "tcp/192.0.2.1:7447")
    file.write_text(f'{text}\n[gate]\nconnect = ["{endpoint}"]\n')
    with closing(open_zenoh("router", listen=[endpoint])):
        absent = "svea7: no gate status on fleet/svea7/coopenv/gate: is `coopenv svea gate` running there?"
        absent += "; with docker/car-zenoh.json5 set [gate] connect"
        assert str(health(file, "", "--patience", "0.2").exception) == absent  # so it has got there
        assert str(health(SHIPPED, endpoint, "--patience", "0.2").exception) == absent
    for there in ("tcp/192.0.2.1:7447", "tcp/lab:7447"):
        assert str(health(file, there).exception).startswith(f"{there}: is not on this computer")
    tried = health(file, "tcp/nowhere.invalid:7447", "--off-board")
    assert str(tried.exception).startswith("tcp/nowhere.invalid:7447: no Zenoh there")


def test_health_takes_no_status_that_the_car_has_not_signed(tmp_path: Path) -> None:
    make_keys(tmp_path / "keys", ["svea7", "svea8", "station"])
    endpoint, file = free_endpoint(), tmp_path / "fleet.toml"
    file.write_text(SHIPPED.read_text() + '\n[security]\nkeys = "keys"\n')
    ended, topic, texts = Event(), SVEA.topic_of("svea7", Role.GATE), ("", "", "n")
    with closing(open_zenoh("router", listen=[endpoint])) as forger:

        def forge() -> None:
            while not ended.wait(0.05):
                forger.publish(topic, write(STATUS, time.time_ns(), *texts, "disarmed", 0, 0, ["foreign"], [0]))
                forger.publish(topic, write(STATUS, time.time_ns(), *texts, "\x1b[2Jdisarmed", 0, 0, [], []))

        with ThreadPoolExecutor(1) as pool:
            forging = pool.submit(forge)
            try:
                signed = str(health(file, endpoint).exception)
                unsigned = health(SHIPPED, endpoint).output
            finally:
                ended.set()
            forging.result()
    assert re.match(r"svea7: the status of its gate is dropped \(signature \d+\)", signed)
    assert "gate disarmed" in unsigned and "\x1b" not in unsigned


def test_a_router_that_cannot_start_is_reported_with_the_reason() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(FakesError, match=rf"router has ended with status 2: tcp/127.0.0.1:{port}: no Zenoh there"):
            fake_processes(SHIPPED, port).__enter__()
    assert not mentioning(f"tcp/127.0.0.1:{port}")


def test_a_slow_router_is_ended_and_reported() -> None:
    port = free_port()
    with pytest.raises(FakesError, match="router is not ready in time: it has printed nothing"):
        fake_processes(SHIPPED, port, patience=0.05).__enter__()
    assert not mentioning(f"tcp/127.0.0.1:{port}")


# Listening to a gate: what is no message of a gate fills no memory and hides none


TOPIC = SVEA.topic_of("svea7", Role.GATE)


class Crowded:
    """A network on which all comes at once as soon as somebody listens."""

    def __init__(self, payloads: Iterator[bytes]) -> None:
        self._payloads = payloads

    def subscribe(self, pattern: str, callback: Any) -> None:
        for payload in self._payloads:
            callback(Arrival(pattern, payload, 0))


def status_message() -> bytes:
    return encode(make(SVEA.topics[Role.GATE].type))


def first_status(payloads: Iterator[bytes]) -> Any:
    return next_message(Crowded(payloads), TOPIC, SVEA.topics[Role.GATE].type, 0.2)  # type: ignore[arg-type]


def test_the_first_status_of_a_gate_is_found_among_other_bytes() -> None:
    good = status_message()
    assert first_status(iter([b"", b"nonsense", good + bytes(MOST_BYTES), good, b"nonsense"])).state == ""


@pytest.mark.parametrize("size", [60_000, MOST_BYTES + 1, 1_000_000])
def test_a_flood_fills_no_memory(size: int) -> None:
    first_status(iter([status_message()]))  # what is loaded at the first time does not count
    tracemalloc.start()
    try:
        assert first_status(b"\xff" * size for _ in repeat(None, 300)) is None
        assert tracemalloc.get_traced_memory()[1] < 4e6
    finally:
        tracemalloc.stop()
