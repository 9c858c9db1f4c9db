"""Fake cars in real time: in a thread behind their gate, and as a process that is reached over Zenoh."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from coopenv.base.errors import CoopenvError
from coopenv.cars.backend.station import Gates
from coopenv.cars.codec import decode, encode, make
from coopenv.cars.keys import load_signer, load_verifier, make_keys
from coopenv.cars.profile import RESET_TOPIC, SVEA, Limits, Role, presence_of
from coopenv.cars.transport.base import Arrival, Transport
from coopenv.cars.transport.zenoh import open_zenoh
from coopenv.cli import app
from tests.helpers.cars import OVERTAKING, fakes, open_fake, write_fleet
from tests.helpers.hub import Hub
from tests.helpers.processes import COOPENV, start, wait_until
from tests.helpers.wire import free_endpoint

LIMITS = Limits(speed=0.5, steering=0.5, acceleration=1.0, steering_rate=2.0)


@pytest.fixture
def fleet(tmp_path: Path) -> Path:
    return write_fleet(tmp_path, f'{OVERTAKING}[network]\nconnect = ["{free_endpoint()}"]\n', safety="")


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
    with fakes(fleet) as (hub, _):
        station = hub.connect()
        ears = Ears(station, "svea7")
        through_its_gate(station, ears)
    assert not ears.there


def test_as_a_process_over_zenoh(fleet: Path, tmp_path: Path) -> None:
    endpoint = fleet.read_text().split('"')[-2]
    with ExitStack() as stack:

        def launch(*command: str) -> tuple[subprocess.Popen[str], str]:
            process = stack.enter_context(start((*COOPENV, "svea", *command), tmp_path))
            stack.callback(process.kill)
            assert process.stdout is not None
            return process, process.stdout.readline()

        router, line = launch("router", "--listen", endpoint)
        assert endpoint in line
        station = stack.enter_context(closing(open_zenoh("client", [endpoint])))
        ears = Ears(station, "svea7")
        car, line = launch("fake", str(fleet), "--car", "svea7", "--seed", "2")
        assert line == "svea7: fake ready\n"
        through_its_gate(station, ears)
        asked = time.monotonic()
        car.send_signal(signal.SIGTERM)
        car.wait(20.0)
        assert time.monotonic() - asked < 5.0  # a second where nobody else computes
        wait_until(lambda: not ears.there)
        router.send_signal(signal.SIGINT)
        router.wait(20.0)


def test_what_does_not_fit_is_one_line(fleet: Path) -> None:
    with pytest.raises(CoopenvError, match="unknown car 'svea9'"):
        open_fake(fleet, "svea9", Hub().connect())
    result = CliRunner().invoke(app, ["svea", "fake", str(fleet), "--car", "svea7", "--fault", "melt"])
    assert isinstance(result.exception, CoopenvError) and "unknown fault 'melt'" in str(result.exception)


def test_a_gate_obeys_whom_it_is_told_to(fleet: Path) -> None:
    fleet.write_text(fleet.read_text() + '[security]\nkeys = "keys"\n')
    keys = fleet.parent / "keys"
    make_keys(keys, ["svea7", "svea1", "station"])
    with fakes(fleet, station="svea7") as (hub, _):
        here, verifier = hub.connect(), load_verifier(keys)
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
        open_fake(fleet, "svea7", Hub().connect(), station="svea9")


def test_keys_of_the_gate_are_needed_where_the_deployment_has_some(fleet: Path) -> None:
    fleet.write_text(fleet.read_text() + '[security]\nkeys = "keys"\n')
    with pytest.raises(CoopenvError, match="keys"):
        open_fake(fleet, "svea7", Hub().connect())
