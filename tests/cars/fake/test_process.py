"""Fake cars in real time: in a thread behind their gate, and as a process that is reached over Zenoh."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from coopenv.base.errors import CoopenvError
from coopenv.cars.backend.station import Gates
from coopenv.cars.codec import decode, encode, make
from coopenv.cars.fake.fleet import run
from coopenv.cars.keys import load_signer, load_verifier, make_keys
from coopenv.cars.profile import RESET_TOPIC, SVEA, Limits, Role, presence_of
from coopenv.cars.transport.base import Arrival, Transport
from coopenv.cars.transport.zenoh import open_zenoh
from coopenv.cli import app
from tests.helpers.cars import open_fake
from tests.helpers.hub import Hub
from tests.helpers.processes import COOPENV, start, wait_until
from tests.helpers.wire import free_port

LIMITS = Limits(speed=0.5, steering=0.5, acceleration=1.0, steering_rate=2.0)
FLEET = """
environment = "svea_overtaking"
fakes = true
cars = [{ name = "svea7", marker = 7 }, { name = "svea8", marker = 6 }]
markers = { SL1 = 1, SL2 = 2, SL4 = 4, SL5 = 5 }
network = { connect = ["tcp/127.0.0.1:PORT"] }
"""


@pytest.fixture
def fleet(tmp_path: Path) -> Path:
    file = tmp_path / "fleet.toml"
    file.write_text(FLEET.replace("PORT", str(free_port())))
    return file


class Ears:
    """What has come last of each topic of a car."""

    def __init__(self, transport: Transport, car: str) -> None:
        self.last: dict[Role, Any] = {}
        self.there = False
        for role in (Role.TRUTH, Role.WHEEL, Role.DETECTIONS, Role.MANUAL):
            transport.subscribe(SVEA.topic_of(car, role), self._keep(role))
        transport.watch(presence_of(car), lambda _, there: setattr(self, "there", there))

    def _keep(self, role: Role) -> Callable[[Arrival], None]:
        return lambda arrival: self.last.__setitem__(role, decode(arrival.payload, SVEA.topics[role].type))

    @property
    def place(self) -> float:
        return float(self.last[Role.TRUTH].pose.pose.position.y)

    @property
    def speed(self) -> float:
        return float(self.last[Role.TRUTH].twist.twist.linear.x)


def drive(gates: Gates, car: str, speed: float, until: Callable[[], bool]) -> None:
    """Command a speed 20 times a second."""

    def driven() -> bool:
        gates.next()
        gates.command(car, speed, 0.0, 1.0)
        time.sleep(0.05)
        return until()

    wait_until(driven)


@contextmanager
def threaded(fleet: Path, car: str, hub: Hub, **options: Any) -> Iterator[None]:
    stop, transport = threading.Event(), hub.connect()
    fake = open_fake(fleet, car, transport, **options)
    thread = threading.Thread(target=run, args=(fake, stop))
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(10.0)
        transport.close()


def through_its_gate(transport: Transport, ears: Ears) -> None:
    """Arm, drive, and let the commands end: the car stands."""
    gates = Gates(transport, ("svea7",), LIMITS, None)
    wait_until(lambda: ears.there and len(ears.last) >= 3 and gates.states["svea7"].state == "disarmed")
    transport.publish(RESET_TOPIC, encode(make("std_msgs/msg/Int64", data=4)), reliable=True)
    time.sleep(0.3)
    begin = ears.place
    gates.next()
    gates.command("svea7", 0.4, 0.0, 1.0)
    time.sleep(0.3)
    assert ears.place == pytest.approx(begin, abs=1e-6)  # nobody has armed it
    gates.begin()
    drive(gates, "svea7", 0.4, lambda: ears.speed > 0.35)
    assert ears.last[Role.MANUAL].z < 400.0
    wait_until(lambda: ears.speed < 0.01)
    assert ears.place > begin + 0.05
    gates.end()


def test_in_a_thread_behind_its_gate(fleet: Path) -> None:
    hub = Hub()
    station = hub.connect()
    ears = Ears(station, "svea7")
    with threaded(fleet, "svea7", hub):
        through_its_gate(station, ears)
    assert not ears.there


def test_as_a_process_over_zenoh(fleet: Path, tmp_path: Path) -> None:
    endpoint = fleet.read_text().split('"')[-2]
    router = start((*COOPENV, "svea", "router", "--listen", endpoint), tmp_path)
    processes = [router]
    try:
        assert router.stdout is not None
        assert endpoint in router.stdout.readline()
        station = open_zenoh("client", [endpoint])
        ears = Ears(station, "svea7")
        car = start((*COOPENV, "svea", "fake", str(fleet), "--car", "svea7", "--seed", "2"), tmp_path)
        processes.append(car)
        assert car.stdout is not None
        assert car.stdout.readline() == "svea7: fake ready\n"
        through_its_gate(station, ears)
        asked = time.monotonic()
        car.send_signal(signal.SIGTERM)
        car.wait(20.0)
        assert time.monotonic() - asked < 5.0  # a second where nobody else computes
        wait_until(lambda: not ears.there)
        station.close()
        router.send_signal(signal.SIGINT)
        router.wait(20.0)
    finally:
        for process in processes:
            process.kill()
            process.communicate()


def test_what_does_not_fit_is_one_line(fleet: Path) -> None:
    with pytest.raises(CoopenvError, match="unknown car 'svea9'"):
        open_fake(fleet, "svea9", Hub().connect())
    result = CliRunner().invoke(app, ["svea", "fake", str(fleet), "--car", "svea7", "--fault", "melt"])
    assert isinstance(result.exception, CoopenvError) and "unknown fault 'melt'" in str(result.exception)


def test_a_gate_obeys_whom_it_is_told_to(fleet: Path) -> None:
    fleet.write_text(fleet.read_text() + '[security]\nkeys = "keys"\n')
    keys = fleet.parent / "keys"
    make_keys(keys, ["svea7", "svea8", "station"])
    hub = Hub()
    here, verifier = hub.connect(), load_verifier(keys)
    with threaded(fleet, "svea7", hub, station="svea7"):
        own, other = (
            Gates(here, ("svea7",), LIMITS, load_signer(keys, name), verifier) for name in ("svea7", "station")
        )
        wait_until(lambda: other.states["svea7"].state == own.states["svea7"].state == "disarmed")
        with pytest.raises(CoopenvError, match="svea7"):
            other.begin()
        assert own.states["svea7"].state == "disarmed"
        own.begin()
        assert own.states["svea7"].state == "armed"
        own.end()
    with pytest.raises(CoopenvError, match="no public key of 'svea9'"):
        open_fake(fleet, "svea7", hub.connect(), station="svea9")


def test_keys_of_the_gate_are_needed_where_the_deployment_has_some(fleet: Path) -> None:
    fleet.write_text(fleet.read_text() + '[security]\nkeys = "keys"\n')
    with pytest.raises(CoopenvError, match="keys"):
        open_fake(fleet, "svea7", Hub().connect())
