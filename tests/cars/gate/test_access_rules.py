"""The configurations of a car's bridge and of the laboratory's router, as they are shipped."""

from __future__ import annotations

import json
import re
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import pytest

from coopenv.base.errors import CoopenvError
from coopenv.cars.backend.station import Gates, neutral_command
from coopenv.cars.fake.lockstep import Hub
from coopenv.cars.gate.attack import Intruder, attack
from coopenv.cars.gate.gate import Gate
from coopenv.cars.gate.process import GateConnection
from coopenv.cars.gate.wheel_command import MotionCommand, write_drive
from coopenv.cars.link.clock import SimulatedClock
from coopenv.cars.link.keys import load_signer, make_keys
from coopenv.cars.link.transport import Tls
from coopenv.cars.link.zenoh import Zenoh, open_zenoh
from coopenv.cars.settings.deployment import parse_deployment
from coopenv.cars.settings.limits import USUAL
from coopenv.cars.settings.profile import SVEA, Role
from tests.cars.gate.bench import CAR
from tests.cars.gate.station import Station, running_gate
from tests.helpers.brokers import Authority
from tests.helpers.frames import BEARINGS, FLEET, FRAMES, grey_frame, seeing
from tests.helpers.processes import COOPENV, ROOT, started, wait_until
from tests.helpers.wire import free_endpoint, free_port, heard_by, running

zenoh = pytest.importorskip("zenoh", reason="needs the extra 'svea'")
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="unix sockets")

CAR_FILE, LAB_FILE = (ROOT / "docker" / f"{name}-zenoh.json5" for name in ("car", "lab"))
WHEELS = SVEA.topic_of(CAR, Role.MANUAL)
DRIVE = write_drive(1, SVEA.command, MotionCommand(0.0, 0.5))
SPELLINGS = (WHEELS, f"{WHEELS}/**", "fleet/**", "**", f"fleet/{CAR}/**/send", "fleet/*/mavros/manual_control/s$*")


class Doors:
    """A car's router with the shipped file, and ends inside and outside of it."""

    def __init__(self, stack: ExitStack, folder: Path) -> None:
        self.inside, self.outside = f"unixsock-stream/{folder}/car.sock", free_endpoint()
        listen = ("--listen", self.inside, "--listen", self.outside)
        stack.enter_context(started((*COOPENV, "svea", "router", "--config", str(CAR_FILE), *listen), folder))
        self.wheels, self.stranger = (
            stack.enter_context(closing(open_zenoh("client", [place]))) for place in (self.inside, self.outside)
        )
        self.moved = heard_by(self.wheels, f"{WHEELS}/**")


@pytest.fixture(scope="module")
def doors(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Doors]:
    with ExitStack() as stack:
        yield Doors(stack, tmp_path_factory.mktemp("doors"))


def test_the_station_drives_through_the_gate_and_a_stranger_does_not_get_past_it(doors: Doors, tmp_path: Path) -> None:
    make_keys(tmp_path / "keys", [CAR, "station"])
    with running_gate(doors.inside, tmp_path, "--keys", str(tmp_path / "keys")):
        station = Station(doors.stranger, load_signer(tmp_path / "keys", "station"))
        station.arm("a")
        for _ in range(20):
            for key in SPELLINGS:
                doors.stranger.publish(key, DRIVE, reliable=True)
            doors.stranger.session.delete(WHEELS)
        station.drive()
        wait_until(lambda: any(arrival.payload != DRIVE for arrival in doors.moved))
        assert DRIVE not in [arrival.payload for arrival in doors.moved]
        assert station.count("foreign") == 0 and station.status.state == "armed"
        doors.wheels.publish(WHEELS, DRIVE)  # as a program on the car might
        wait_until(lambda: station.status.state == "stopped")
        assert station.count("foreign") == 1


def test_bearings_leave_the_car_and_frames_do_not_enter(doors: Doors) -> None:
    pytest.importorskip("cv2", reason="needs the extra 'vision'")
    seen = heard_by(doors.stranger, BEARINGS)
    with seeing(FLEET, doors.inside, doors.wheels) as node:
        doors.stranger.publish(FRAMES, grey_frame(encoding="forged"), reliable=True)
        time.sleep(0.3)
        doors.wheels.publish(FRAMES, grey_frame(), reliable=True)
        wait_until(lambda: seen)
        node.terminate()
        assert node.stderr is not None and "forged" not in node.stderr.read()


def test_queries_and_the_administration_get_no_answer(doors: Doors) -> None:
    asked, before = list[Any](), len(doors.moved)
    kept = doors.wheels.session.declare_queryable(f"fleet/{CAR}/mavros/cmd/arming", asked.append)
    session = doors.stranger.session
    [router] = session.info.routers_zid()
    session.put(f"@/{router}/router/config/access_control/enabled", b"false")
    for key in (f"fleet/{CAR}/mavros/cmd/arming", "fleet/**", f"@/{router}/**"):
        assert not list(session.get(key, timeout=0.3))
    session.put(WHEELS, DRIVE)
    time.sleep(0.2)
    assert not asked and not doors.moved[before:]
    kept.undeclare()


def test_a_bridge_in_the_router_itself_is_behind_the_same_doors(tmp_path: Path) -> None:
    """Subscriptions, services and publications within the process of the router, as those of zenoh-bridge-ros2dds."""
    inside, outside, asked = f"unixsock-stream/{tmp_path}/car.sock", free_endpoint(), list[Any]()
    wheels, seen = list[tuple[str, bytes]](), list[str]()
    with ExitStack() as stack:
        bridge = stack.enter_context(closing(open_zenoh("router", listen=[inside, outside], config=CAR_FILE)))
        gate, stranger = (stack.enter_context(closing(open_zenoh("client", [place]))) for place in (inside, outside))
        kept = [
            bridge.session.declare_subscriber(
                WHEELS,
                lambda sample: wheels.append((str(sample.key_expr), sample.payload.to_bytes())),
                allowed_origin=zenoh.Locality.REMOTE,
            ),
            bridge.session.declare_queryable(f"fleet/{CAR}/mavros/cmd/arming", asked.append),
            stranger.session.declare_subscriber(
                "fleet/**", lambda sample: seen.append(str(sample.key_expr)), allowed_origin=zenoh.Locality.REMOTE
            ),
        ]
        state = f"fleet/{CAR}/mavros/state"

        def publish() -> None:
            gate.publish(WHEELS, b"of the gate", reliable=True)
            bridge.publish(state, b"", reliable=True)

        wait_until(lambda: wheels and {WHEELS, state} <= set(seen), publish)  # all know of each other
        for key in SPELLINGS:
            stranger.publish(key, DRIVE, reliable=True)
        assert not list(stranger.session.get(f"fleet/{CAR}/mavros/cmd/arming", timeout=0.3))
        seen.clear()
        wait_until(lambda: {WHEELS, state} <= set(seen), publish)
        assert set(wheels) == {(WHEELS, b"of the gate")} and not asked and set(seen) == {WHEELS, state}
        kept.clear()


def test_a_gate_behind_an_open_network_is_not_armed_and_stops_at_once() -> None:
    """A hub passes on everything, as a router without access rules does."""
    hub = Hub(clock := SimulatedClock())
    link = GateConnection(Gate(CAR, USUAL, clock), hub.connect())
    link.guard()
    clock.repeat(0.05, link.tick, "gate")
    clock.repeat(0.01, lambda: link.news.is_set() and link.publish_status(), "news")
    transport = hub.connect()
    gates = Gates(transport, (CAR,), USUAL, None)
    with pytest.raises(CoopenvError, match=rf"^not armed: {CAR}: commands get to its wheels that this gate has not"):
        gates.begin()
    unprobed = Gates(transport, (CAR,), USUAL, None, probed=False)
    unprobed.begin(release=True)
    transport.publish(*neutral_command(SVEA, CAR, clock))
    clock.sleep(0.01)
    assert unprobed.states[CAR].state == "stopped"


def test_an_attack_gets_through_an_open_router_alone(
    doors: Doors, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = ("the same under wildcards", "arming, commands without signature", "services: arming, mode")
    monkeypatch.setattr("coopenv.cars.gate.attack.SETTLE", 0.25)
    every = Intruder.kinds
    monkeypatch.setattr(Intruder, "kinds", lambda x: {k: v for k, v in every(x).items() if k.startswith(few)})
    make_keys(tmp_path / "keys", [CAR, "station"])
    endpoint = free_endpoint()
    with running("router", endpoint):
        for inside, outside, open_ in ((doors.inside, doors.outside, False), (endpoint, endpoint, True)):
            security = {} if open_ else {"security": {"keys": str(tmp_path / "keys")}}
            network = {"network": {"connect": [outside]}, **security}
            fleet = parse_deployment({"environment": "e", "cars": [{"name": CAR}], **network}, tmp_path / "f.toml")
            own_keys = () if open_ else ("--keys", str(tmp_path / "keys"))
            with running_gate(inside, tmp_path, *own_keys), closing(Intruder(fleet, [CAR], 0)) as intruder:
                found = {outcome.what: outcome for outcome in attack(intruder, 180)}
                assert [outcome.harmful for outcome in found.values()] == [open_, False, open_]
                assert {outcome.sent for outcome in found.values()} <= {50, 60}
                station = Station(intruder.observer, None if open_ else load_signer(tmp_path / "keys", "station"))
                station.arm("a")
                with pytest.raises(CoopenvError, match=f"^no attack: {CAR}: its gate is armed"):
                    next(attack(intruder, 10))


def entry(path: Path, key: str) -> Any:
    return json.loads(zenoh.Config.from_file(path).get_json(key))


def test_the_files_name_the_topics_of_the_profile() -> None:
    bridge = entry(CAR_FILE, "plugins/ros2dds/allow")
    published = {SVEA.topic_of(CAR, role) for role in Role} - {SVEA.topic_of(CAR, Role.TRUTH)}
    own = {topic for topic in published if "/coopenv/" not in topic and "/v2x/" not in topic}
    assert own == {topic for topic in published if any(re.fullmatch(p, f"/{topic}") for p in bridge["publishers"])}
    assert [topic for topic in published if re.fullmatch(bridge["subscribers"][0], f"/{topic}")] == [WHEELS]
    assert len(bridge["subscribers"]) == 1
    assert not any(bridge[f"{kind}_{end}s"] for kind in ("service", "action") for end in ("server", "client"))
    wanted = {SVEA.topic_of("*", role) for role in (Role.COMMAND, Role.ARM, Role.STOP)}
    for path, rule in ((CAR_FILE, "in"), (LAB_FILE, "command")):
        control = entry(path, "access_control")
        [keys] = [set(each["key_exprs"]) for each in control["rules"] if each["id"] == rule]
        assert control["default_permission"] == "deny" and {each["permission"] for each in control["rules"]} == {
            "allow"
        }
        assert wanted <= keys and not [key for key in keys if zenoh.KeyExpr(key).intersects(zenoh.KeyExpr(WHEELS))]


def test_in_the_laboratory_each_certificate_sends_its_own(tmp_path: Path) -> None:
    authority, where = Authority(tmp_path, "ca"), f"tls/127.0.0.1:{free_port()}"
    allowed: dict[str, Callable[[str], bool]] = {
        "station": lambda key: key.rpartition("/")[2] in ("cmd", "arm"),
        "svea7": lambda key: key.startswith("fleet/svea7/"),
        "svea1": lambda key: key.startswith("fleet/svea1/"),
        "mocap": lambda key: key.startswith("fleet/qualisys/"),
        "mallory": lambda key: False,
    }
    names = ("router", "listener", *allowed)
    files = {name: authority.certify(name) for name in names}
    (tmp_path / "lab.json5").write_text(LAB_FILE.read_text().replace("/etc/coopenv/tls", str(tmp_path)))
    with ExitStack() as stack:
        stack.enter_context(closing(open_zenoh("router", listen=[where], config=tmp_path / "lab.json5")))

        def join(name: str) -> Zenoh:
            certificate, key = files[name]
            tls = Tls(root_ca=authority.file, certificate=certificate, key=key)
            return stack.enter_context(closing(open_zenoh("client", [where], tls=tls)))

        ends = {name: join(name) for name in names[1:]}
        heard = heard_by(ends.pop("listener"), "fleet/**")
        keys = {f"fleet/{car}/{topic}" for car in ("svea7", "svea1") for topic in ("coopenv/cmd", "pixy/objects_info")}
        keys |= {"fleet/qualisys/svea7/odom", "fleet/svea1/coopenv/arm", *SPELLINGS}
        time.sleep(0.3)
        for name, transport in ends.items():
            for key in keys:
                transport.publish(key, name.encode(), reliable=True)
        time.sleep(0.5)
        passed = {(arrival.payload.decode(), arrival.topic) for arrival in heard}
        assert passed == {(name, key) for name in ends for key in keys if allowed[name](key)}


@pytest.mark.parametrize(
    ("text", "said"), [("{ mode: 'rooter' }", "no configuration of Zenoh"), ("{", "no configuration")]
)
def test_a_file_that_is_none_is_refused_in_one_line(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "bad.json5").write_text(text)
    with pytest.raises(CoopenvError, match=said) as caught:
        open_zenoh("router", listen=[free_endpoint()], config=tmp_path / "bad.json5")
    assert "\n" not in str(caught.value)
