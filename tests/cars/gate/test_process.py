"""The command `coopenv svea gate` in a process of its own, over real Zenoh."""

from __future__ import annotations

import re
import signal
import socket
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest

from coopenv.cars.fake.lockstep import Hub
from coopenv.cars.gate.process import gate_deployment, prepare_gate
from coopenv.cars.gate.wheel_command import NEUTRAL
from coopenv.cars.link.clock import CLOCK
from coopenv.cars.link.keys import load_signer, make_keys
from coopenv.cars.link.zenoh import LEASE, open_zenoh
from coopenv.cars.settings.profile import Role
from coopenv.cli.app import main
from tests.cars.gate import messages
from tests.cars.gate.bench import CAR
from tests.cars.gate.station import Station, running_gate
from tests.helpers.processes import ROOT, wait_until
from tests.helpers.wire import free_endpoint, running

pytest.importorskip("zenoh", reason="needs the extra 'svea'")
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="signals and modes of files")


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("keys")
    make_keys(folder, [CAR, "station", "other"])
    return folder


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    where = free_endpoint()
    with running("router", where):
        yield where


@pytest.fixture
def gate(endpoint: str, keys: Path, tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    with running_gate(endpoint, tmp_path, "--keys", str(keys)) as process:
        yield process


@pytest.fixture
def station(endpoint: str, keys: Path, gate: subprocess.Popen[str]) -> Iterator[Station]:
    with closing(open_zenoh("client", [endpoint])) as transport:
        yield Station(transport, load_signer(keys, "station"))


def test_a_station_arms_drives_and_stops(station: Station) -> None:
    wait_until(lambda: station.present and station.since() and station.status)
    assert station.status.state == "disarmed"
    begun = time.time()
    time.sleep(0.6)
    outputs, most = station.since(begun), 20.0 * (time.time() - begun) + 3
    assert 3 <= len(outputs) <= most and set(outputs) == {NEUTRAL}  # 20 Hz, on a machine that has other things to do
    station.arm("a")
    station.drive()
    wait_until(lambda: station.status.state == "timed_out")
    assert station.since()[-1] == NEUTRAL
    station.drive()
    station.send(Role.STOP, messages.stop())
    wait_until(lambda: station.status.state == "stopped" and len(station.stops) >= 3)  # repeated for who comes late
    station.command()
    wait_until(lambda: station.count("not_armed") > 0)
    assert station.since()[-1] == NEUTRAL
    station.arm("b")
    time.sleep(0.5)  # its own repetitions of the stop must not come back to stop it again
    station.drive()
    assert station.status.state == "armed"


def test_systemd_is_notified_until_the_gate_freezes(
    endpoint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.settimeout(10.0)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        with running_gate(endpoint, tmp_path) as process:
            assert [systemd.recv(64) for _ in range(4)] == [b"READY=1", *[b"WATCHDOG=1"] * 3]
            process.send_signal(signal.SIGSTOP)
            systemd.settimeout(1.0)
            with pytest.raises(TimeoutError):
                for _ in range(50):  # those under way
                    systemd.recv(64)
            process.kill()
            assert process.communicate()[1].startswith("warning: without --keys whoever")


def test_commands_to_a_frozen_gate_move_nothing(station: Station, gate: subprocess.Popen[str]) -> None:
    station.arm("a")
    station.drive()
    frozen = time.time()
    gate.send_signal(signal.SIGSTOP)
    time.sleep(0.05)
    sent = station.sequence
    while time.time() < frozen + 0.2:
        station.command(0.5)
        time.sleep(0.05)
    time.sleep(0.2)  # the youngest is older than it may be, too
    resumed = time.time()
    gate.send_signal(signal.SIGCONT)
    wait_until(lambda: len(station.since(resumed)) > 10)
    if (
        resumed - frozen < 0.6 * LEASE / 1000
    ):  # after a longer while Zenoh has given the session up, with what was under way
        wait_until(lambda: station.count("stale") > 0)
    assert set(station.since(resumed)) == {NEUTRAL}
    assert station.status.state == "timed_out" and station.status.last_sequence <= sent
    station.drive()


@pytest.mark.parametrize(
    ("number", "status"),
    [(signal.SIGINT, 130), (signal.SIGHUP, 143)],  # SIGHUP is answered by SIGTERM
)
def test_a_signal_leaves_the_car_in_neutral(
    station: Station, gate: subprocess.Popen[str], number: signal.Signals, status: int
) -> None:
    station.arm("a")
    station.drive()
    gate.send_signal(number)
    _, errors = gate.communicate(timeout=10)
    assert (gate.returncode, errors) == (status, f"interrupted; {CAR} is in neutral\n")
    wait_until(lambda: station.since()[-5:] == [NEUTRAL] * 5)
    wait_until(lambda: not station.present)


def test_a_router_that_comes_back_finds_the_gate(keys: Path, tmp_path: Path) -> None:
    endpoint = free_endpoint()
    with ExitStack() as stack:
        with running("router", endpoint):
            gate = stack.enter_context(running_gate(endpoint, tmp_path, "--keys", str(keys)))
            transport = stack.enter_context(closing(open_zenoh("client", [endpoint])))
            station = Station(transport, load_signer(keys, "station"))
            station.arm("a")
            station.drive()
        time.sleep(0.5)
        with running("router", endpoint):
            heard = len(station.statuses)
            wait_until(lambda: len(station.statuses) > heard + 1)
            assert station.status.state == "timed_out"
            station.drive()  # the session goes on
            wait_until(lambda: station.present)
        time.sleep(0.5)
        assert gate.poll() is None
        gate.terminate()  # ends without a router as well
        assert gate.wait(timeout=10) == 143


def test_a_deployment_file_contains_all_settings(keys: Path, tmp_path: Path) -> None:
    lines = [
        'environment = "none of its business"',
        f'cars = [{{name = "{CAR}"}}]',
        # Of the station: the gate does not go there, and on its own computer it needs no certificate.
        'network = {connect = ["tls/192.0.2.1:7447"], tls = {root_ca = "not_on_the_car.pem"}}',
        'gate.connect = ["tcp/127.0.0.1:1"]',
        f'security = {{keys = "{keys}", identity = "other"}}',
        "safety.max_speed = 0.2",
    ]
    (tmp_path / "fleet.toml").write_text("\n".join(lines))
    fleet = gate_deployment(CAR, tmp_path / "fleet.toml")
    assert (fleet.network.connect, fleet.network.tls) == (("tcp/127.0.0.1:1",), None)
    hub = Hub()
    station = Station(hub.connect(), load_signer(keys, "other"))
    link = prepare_gate(fleet, CAR)(hub.connect(), CLOCK)
    link.publish_status()
    station.send(Role.ARM, messages.arm(time.time_ns(), "a", station.status.nonce))
    station.session = "a"
    station.command(speed=0.3)
    link.publish_status()
    assert (station.status.state, station.count("limits")) == ("armed", 1)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--car", "a/b"], "--car 'a/b': expected"),
        (["--car", CAR, "--max-speed", "2"], "limit of speed: must be above 0, at most 1.53"),
        (["--car", CAR, "--max-acceleration", "nan"], "limit of acceleration"),
        (["--car", CAR, "--keys", "nowhere"], "nowhere: cannot be read as a file of keys"),
        (["--car", CAR, "--connect", "nonsense"], "'nonsense' is no endpoint"),
        (["--car", CAR, "--connect", "tcp/10.0.0.1:7447"], "tcp/10.0.0.1:7447: is not on this computer"),
        (["away.toml", "--car", CAR], "tcp/lab:7447: is not on this computer"),
        (["mixed.toml", "--car", CAR], "svea7.pem: is not the key of svea7 in keys/public.toml"),
        (["nothing.toml", "--car", CAR], "nothing.toml: cannot be read"),
        (["fleet.toml", "--car", "svea8"], "unknown car 'svea8'"),
        ([], "Missing option '--car'"),
    ],
)
def test_a_mistake_is_one_error_line(
    options: list[str], text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    fleet = f'environment = "x"\ncars = [{{name = "{CAR}"}}]\n'
    Path("fleet.toml").write_text(fleet)
    Path("away.toml").write_text(fleet + 'gate.connect = ["tcp/lab:7447"]\n')
    Path("mixed.toml").write_text(fleet + 'security.keys = "keys"\n')
    make_keys("keys", [CAR, "station"])
    Path("keys/station.pem").replace(f"keys/{CAR}.pem")
    assert main(["svea", "gate", *options]) == 2
    error = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("warning: without --keys")]
    assert len(error) == 1 and text in error[0]


def test_the_health_check_of_the_image_reads_alone(
    station: Station, endpoint: str, keys: Path, gate: subprocess.Popen[str], tmp_path: Path
) -> None:
    """Where a command to the wheels would get through, an armed gate stays armed."""
    links = f'network.connect = ["{endpoint}"]\ngate.connect = ["{endpoint}"]\nsecurity.keys = "{keys}"\n'
    (tmp_path / "fleet.toml").write_text(f'environment = "x"\ncars = [{{ name = "{CAR}" }}]\n{links}')
    check = re.search(r"CMD coopenv (svea health .*) \|\| exit 1\n", (ROOT / "docker/car.Dockerfile").read_text())
    assert check is not None
    here = {"/etc/coopenv/fleet.toml": str(tmp_path / "fleet.toml"), '"$CAR"': CAR}
    words = [here.get(word, word) for word in check[1].split()]
    station.arm("a")
    assert main(words) == 0
    heard = len(station.statuses)
    wait_until(lambda: len(station.statuses) > heard + 1)
    assert station.status.state == "armed" and station.count("foreign") == 0
    gate.kill()
    gate.wait()
    assert main([*words, "--patience", "0.2"]) != 0


@pytest.mark.parametrize("command", ["gate", "health"])
def test_a_car_needs_only_the_packages_of_its_group(command: str) -> None:
    root = Path(__file__).resolve().parents[3]
    with (root / "pyproject.toml").open("rb") as file:
        project = tomllib.load(file)
    needed, small = project["project"]["dependencies"], project["dependency-groups"]["gate"]
    absent = sorted({re.split("[<>]", each)[0].removesuffix("-lang") for each in {*needed} - {*small}})
    assert {"numpy", "scipy", "warp"} <= set(absent)
    code = f"import sys; sys.argv[0] = 'coopenv'; sys.modules |= dict.fromkeys({[*absent, 'rosbags']})"
    code += "; from coopenv.cli.app import main; sys.exit(main(sys.argv[1:]))"
    words = [
        "svea",
        command,
        str(root / "examples/fleet/overtaking.toml"),
        "--car",
        CAR,
        "--connect",
        "tcp/127.0.0.1:1",
    ]
    ended = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, timeout=60)
    assert ended.returncode == 2 and "tcp/127.0.0.1:1: no Zenoh there" in ended.stderr, ended.stderr
