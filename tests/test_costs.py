"""Cost as a contract: every reader and checker of foreign input grows with its input as `SECURITY.md` says.

Operations are counted, not seconds: calls of functions in Python and C, and the peak of allocated bytes. An input is
doubled three times.
"""

from __future__ import annotations

import re
import sys
import tracemalloc
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from coopenv import CoopenvError, load_scenario
from coopenv.base.format import read_npz
from coopenv.base.sections import read_toml
from coopenv.cars.bags.topic_map import load_map
from coopenv.cars.settings.deployment import load_deployment
from coopenv.mrclam.dataset import load_dataset
from coopenv.observers import Recording
from coopenv.observers.contract import SensorNoise
from coopenv.policies.loader import read_card
from coopenv.sources.mcap import read_recording, write_recording
from coopenv.sumo import files as sumo_files
from coopenv.training.settings import read_settings
from tests.helpers import bags, builders, mrclam_files


@pytest.fixture(autouse=True)
def bags_are_read_in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Calls of another process are not counted."""
    if find_spec("rosbags") is not None:
        monkeypatch.setattr("coopenv.cars.bags.reader.APART", False)


ROOT = Path(__file__).parents[1]
PAGE = ROOT / "SECURITY.md"
DOUBLINGS = 3
SLACK = 1.35
"""Of a doubling: containers grow in steps."""

Work = Callable[[], object]


@dataclass(frozen=True)
class Row:
    """A reader or checker of input of size n."""

    name: str
    size: str
    """Meaning of n."""
    order: int
    """The cost grows at most with this power of n."""
    make: Callable[[int, Path], Work]
    """Makes an input of a size, in an empty folder, and returns its reader."""
    first: int
    """Smallest size."""
    refused: bool = False
    """True if such inputs are refused."""


def file(folder: Path, text: str, name: str = "input.toml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def toml(text: Callable[[int], str]) -> Callable[[int, Path], Work]:
    def make(n: int, folder: Path) -> Work:
        path = file(folder, text(n))
        return lambda: read_toml(path)

    return make


def scene(change: Callable[[int, dict[str, Any]], None]) -> Callable[[int, Path], Work]:
    """Return the check of a scenario that a change has made of a small one."""

    def make(n: int, folder: Path) -> Work:
        raw = builders.raw([builders.vehicle()])
        change(n, raw)
        return lambda: load_scenario(raw)

    return make


def driven(n: int, apart: float = 5.0, **more: Any) -> list[dict[str, Any]]:
    motion, body = {"kind": "driven"}, {"size": [1.0, 0.5, 0.5]}
    return [builders.vehicle((apart * i, 0.0, 0.0), motion=motion, body=body, **more) for i in range(n)]


def routes(n: int) -> list[dict[str, Any]]:
    return [{"name": f"r{i}", "waypoints": [[0.0, 9.0 * i], [9.0, 9.0 * i]]} for i in range(n)]


def on_routes(n: int, raw: dict[str, Any], names: list[str]) -> None:
    body, spread = {"size": [0.6, 0.3, 0.3]}, {"start_spread": 2.0, "lateral_spread": 0.3}
    raw["routes"] = [{**route, **spread} for route in routes(8)]
    raw["vehicles"] = [{"motion": {"kind": "driven"}, "body": body, "routes": names} for _ in range(n)]


def landmarks(n: int) -> list[dict[str, Any]]:
    return [builders.landmark(f"L{i}", (i, 9.0, 1.0)) for i in range(n)]


def boxes(n: int) -> list[dict[str, Any]]:
    return [{"name": f"o{i}", "center": [6.0 * i, 30.0, 1.0], "size": [2.0, 2.0, 2.0]} for i in range(n)]


def walls(n: int) -> list[dict[str, Any]]:
    return [{"name": f"o{i}", "center": [0.0, 900.0 + i, 1.0], "size": [2000.0, 0.1, 2.0]} for i in range(n)]


def sections(change: Callable[[int], dict[str, Any]]) -> Callable[[int, Path], Work]:
    return scene(lambda n, raw: raw.update(change(n)))


def text_of_map(n: int) -> str:
    return bags.MAP.replace("SL1 = 1,", "SL1 = 1, " + "".join(f"x{i} = {i + 50}, " for i in range(n)))


def topic_map(n: int, folder: Path) -> Work:
    path = file(folder, text_of_map(n))
    return lambda: load_map(path)


def deployment(n: int, folder: Path) -> Work:
    text = (ROOT / "examples" / "fleet" / "crossing.toml").read_text(encoding="utf-8")
    path = file(folder, text.replace("[markers]", "".join(f'overrides."a.{i}" = 1\n' for i in range(n)) + "[markers]"))
    return lambda: load_deployment(path)


def fence(n: int, folder: Path) -> Work:
    text = (ROOT / "examples" / "fleet" / "crossing.toml").read_text(encoding="utf-8")
    angle = np.linspace(0.0, 6.0, n)
    corners = ", ".join(f"[{9 * x:.4f}, {9 * y:.4f}]" for x, y in zip(np.cos(angle), np.sin(angle), strict=True))
    path = file(folder, re.sub(r"(?m)^geofence.*$", "", text).replace("[safety]", f"[safety]\ngeofence = [{corners}]"))
    return lambda: load_deployment(path)


def card(n: int, folder: Path) -> Work:
    text = (ROOT / "agents" / "open_square_quality" / "agent.toml").read_text(encoding="utf-8")
    extra = "".join(f"x{i} = {i}\n" for i in range(n))
    file(folder, text.replace("[training]\n", f"[training]\n{extra}", 1), "agent.toml")
    return lambda: read_card(folder)


def settings(n: int, folder: Path) -> Work:
    path = file(folder, "[scenario]\n" + "".join(f'"vehicles.{i}.x" = 1\n' for i in range(n)))
    return lambda: read_settings(path)


def recording(n: int) -> Recording:
    bearings = np.tile([1.0, 0.0, 0.0], (n, 2, 6, 1))
    zeros, places = np.zeros((n, 2, 3)), np.arange(12.0).reshape(4, 3)
    start = {"start_position": np.eye(3)[:2], "start_rotation": np.tile(np.eye(3), (2, 1, 1))}
    given = {"velocity": zeros, "angular_velocity": zeros, "bearings": bearings, **start}
    return Recording.from_arrays(dt=0.1, landmarks=places, noise=SensorNoise(0.1, 0.1, 0.1, 0.01), **given)


def log(n: int, folder: Path) -> Work:
    path = folder / "log.mcap"
    write_recording(recording(n), path)
    return lambda: read_recording(path)


def arrays(n: int, folder: Path) -> Work:
    path = folder / "arrays.npz"
    np.savez_compressed(path, x=np.zeros((n, 100)))
    return lambda: read_npz(path, "file", {"x": "f K 100"})


def bag(form: str) -> Callable[[int, Path], Work]:
    def make(n: int, folder: Path) -> Work:
        pytest.importorskip("rosbags", reason="needs the extra 'bags'")
        from coopenv.cars.bags.files import BagFile

        kind = "geometry_msgs/msg/PointStamped"
        sent = [bags.Message("/a/point", kind, 10**7 * k, 10**7 * k, {"point": np.zeros(3)}) for k in range(n)]
        path = bags.write(folder / "bag", sent, form)

        def read() -> None:
            with BagFile(path) as opened:
                assert sum(1 for *_, decode in opened.messages(["/a/point"]) if decode()) == n

        return read

    return make


def channels(n: int, folder: Path) -> Work:
    pytest.importorskip("rosbags", reason="needs the extra 'log'")
    from mcap.writer import Writer

    from coopenv.cars.bags.files import BagFile

    path = folder / "topics.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="test")
        kind = writer.register_schema("std_msgs/msg/Header", "ros2msg", b"string frame_id\n")
        for i in range(n):
            writer.register_channel(f"/t{i}", "cdr", kind)
        writer.finish()
    return lambda: BagFile(path).times()


def definition(text: Callable[[int], str]) -> Callable[[int, Path], Work]:
    def make(n: int, folder: Path) -> Work:
        pytest.importorskip("rosbags", reason="needs the extra 'log'")
        from coopenv.cars.bags.definitions import BagChannel, _store, decode

        channel = BagChannel("/t", "x/msg/M", "cdr", "ros2msg", text(n))

        def read() -> None:
            _store.cache_clear()
            decode(channel, bytes(4))

        return read

    return make


def levels(n: int) -> str:
    names = "".join("=" * 80 + f"\nMSG: x/A{k}\nx/A{k + 1} a\nx/A{k + 1} b\n" for k in range(n))
    return f"x/A0 a\n{names}" + "=" * 80 + f"\nMSG: x/A{n}\nuint8 x\n"


def payload(n: int, folder: Path) -> Work:
    codec = pytest.importorskip("coopenv.cars.messages.codec", reason="needs the extra 'svea'")
    one = "pixy_camera/msg/ObjectBearing"
    rows = [codec.make(one, id=i, bearing_x=1.0, bearing_y=0.0, bearing_z=0.0) for i in range(n)]
    kind = "pixy_camera/msg/ObjectBearingArrayStamped"
    sent = codec.encode(codec.make(kind, header=codec.header(1), bearing=rows))
    return lambda: codec.decode(sent, kind)


def image(encoding: str) -> Callable[[int, Path], Work]:
    def make(n: int, folder: Path) -> Work:
        cv2 = pytest.importorskip("cv2", reason="needs the extra 'vision'")
        from coopenv.cars.messages.vision import frame_of

        if encoding == "mono8":
            fields = {"encoding": encoding, "width": 64, "height": n, "step": 64, "is_bigendian": 0}
            message = SimpleNamespace(data=np.zeros(64 * n, np.uint8), **fields)
        else:
            data = cv2.imencode(f".{encoding}", np.zeros((n, 64), np.uint8))[1].ravel()
            message = SimpleNamespace(data=data, format=encoding)
        return lambda: frame_of(message)

    return make


def mrclam(n: int, folder: Path) -> Work:
    mrclam_files.write(folder, seconds=float(n))
    return lambda: load_dataset("mrclam_6", folder)


def network(n: int, folder: Path) -> Work:
    edge = '<edge id="e{0}" from="a" to="j{0}"><lane id="e{0}_0" shape="0,{0} 9,{0}"/></edge>'
    text = '<net><location convBoundary="0,0,9,9"/>' + "".join(edge.format(i) for i in range(n)) + "</net>"
    path = file(folder, text, "a.net.xml")
    return lambda: sumo_files._network.__wrapped__(path, 0)


def nested(n: int, folder: Path) -> Work:
    path = file(folder, "<net><edge>" + "<a/>" * n + "</edge></net>", "a.net.xml")
    return lambda: [element.tag for element in sumo_files._elements(path)]


def state(n: int, folder: Path) -> Work:
    world = builders.simulate(builders.scenario(), n)
    builders.reset(world)
    saved = world.get_state()
    return lambda: world.set_state(saved)


DOTS = toml(lambda n: ".".join("a" * n) + " = 1")
ROWS = (
    Row("TOML: keys", "bytes", 1, toml(lambda n: "".join(f"a{i} = [1.5, 2.5]\n" for i in range(n))), 50),
    Row("TOML: tables", "bytes", 1, toml(lambda n: "".join(f"[a{i}]\nb = 'x'\n" for i in range(n))), 50),
    Row("TOML: parts of a dotted key", "bytes", 1, DOTS, 2000, refused=True),
    Row("TOML: strings", "bytes", 1, toml(lambda n: 'x = """\n' + "a.b = 'c' # d\n" * n + '"""'), 100),
    Row("TOML: nested lists", "bytes", 1, toml(lambda n: "x = " + "[" * n), 2000, refused=True),
    Row("scenario: landmarks", "landmarks", 1, sections(lambda n: {"landmarks": landmarks(n)}), 50),
    Row("scenario: groups of landmarks", "landmarks", 1, sections(lambda n: {"landmark_groups": [
        {"name": "g", "count": n, "height": [1, 2], "lines": [{"start": [0, 0], "end": [1, 1]}]}]}), 100),
    Row("scenario: weights of targets", "targets", 1, sections(lambda n: {
        "landmarks": landmarks(n), "observer": {"q": {f"L{i}": 1.0 for i in range(n)}}}), 100),
    Row("scenario: listed neighbours", "targets", 1, sections(lambda n: {
        "landmarks": landmarks(n), "vehicles": [builders.vehicle(neighbours=[f"L{i}" for i in range(n)])]}), 100),
    Row("scenario: vehicles apart", "vehicles", 2, sections(lambda n: {"vehicles": driven(n)}), 10),
    Row("scenario: vehicles in one place", "vehicles", 2, sections(lambda n: {"vehicles": driven(n, 0.01)}), 10),
    Row("scenario: vehicles on equal routes", "vehicles", 2, scene(lambda n, raw: on_routes(n, raw, ["r0", "r1"])), 10),
    Row("scenario: buildings", "buildings", 1, sections(lambda n: {"obstacles": boxes(n)}), 25),
    Row("scenario: buildings about vehicles", "pairs", 1, sections(lambda n: {
        "obstacles": walls(n), "vehicles": driven(4)}), 50),
    Row("scenario: routes", "routes", 1, sections(lambda n: {"routes": routes(n)}), 25),
    Row("scenario: points of a route", "points", 1, sections(lambda n: {
        "routes": [{"name": "r", "waypoints": [[float(i), float(i % 2)] for i in range(n)]}]}), 100),
    Row("scenario: routes that follow", "pairs", 2, sections(lambda n: {
        "routes": routes(n), "termination": {"after_arrival": "continue"},
        "vehicles": [{"motion": {"kind": "driven"}, "routes": ["r0"], "goal": {"radius": 1e6}}]}), 20),
    Row("scenario: count of vehicles", "vehicles", 2, sections(lambda n: {
        "routes": routes(1), "vehicles": [{"routes": ["r0"], "count": n, "motion": {"kind": "driven"}}]}), 10),
    Row("topic map of a bag", "markers", 1, topic_map, 50),
    Row("deployment", "keys", 1, deployment, 50),
    Row("deployment: geofence", "pairs of corners", 2, fence, 20),
    Row("card of an agent", "entries", 1, card, 50),
    Row("settings of a training", "keys", 1, settings, 50),
    Row("saved state", "worlds", 1, state, 10),
    Row("arrays in a file", "bytes", 1, arrays, 1000),
    Row("recording of arrays", "ticks", 1, lambda n, folder: lambda: recording(n), 50),
    Row("recording in MCAP", "ticks", 1, log, 15),
    Row("bag of ROS 1", "messages", 1, bag("ros1"), 15),
    Row("bag of ROS 2, SQLite", "messages", 1, bag("sqlite3"), 15),
    Row("bag of ROS 2, MCAP", "messages", 1, bag("mcap"), 15),
    Row("bag: topics", "topics", 1, channels, 50),
    Row("bag: fields of a type", "bytes", 1, definition(lambda n: "string[900] a\n" + "uint8 x\n" * n), 50, True),
    Row("bag: types in types", "bytes", 1, definition(levels), 15, refused=True),
    Row("message of a car (CDR)", "entries", 1, payload, 50),
    Row("image", "pixels", 1, image("mono8"), 200),
    Row("image, PNG", "pixels", 1, image("png"), 200),
    Row("image, JPEG", "pixels", 1, image("jpg"), 200),
    Row("robots of MR.CLAM", "seconds", 1, mrclam, 4),
    Row("network of SUMO", "edges", 1, network, 60),
    Row("network of SUMO: one element", "bytes", 1, nested, 500),
)  # fmt: skip


def costs(work: Work, refused: bool) -> tuple[int, int]:
    """Return the number of calls, and the peak of allocated bytes."""

    def run() -> None:
        with pytest.raises(CoopenvError) if refused else nullcontext():
            work()

    calls = 0

    def count(frame: Any, event: str, argument: Any) -> None:
        nonlocal calls
        calls += event in ("call", "c_call")

    run()  # what is loaded, compiled or remembered once does not count
    before = sys.getprofile()
    sys.setprofile(count)
    try:
        run()
    finally:
        sys.setprofile(before)
    tracemalloc.start()
    try:
        run()
        return calls, tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("row", ROWS, ids=lambda row: re.sub(r"\W+", "_", row.name))
def test_costs_grow_as_stated(row: Row, tmp_path: Path) -> None:
    found = []
    for k in range(DOUBLINGS + 1):
        folder = tmp_path / str(k)
        folder.mkdir()
        found.append(costs(row.make(row.first * 2**k, folder), row.refused))
    for what, one in zip(("calls", "bytes"), zip(*found, strict=True), strict=True):
        for before, after in pairwise(one):
            assert after <= SLACK * 2**row.order * before, f"{what}: {one}"


def test_the_page_lists_these_rows() -> None:
    page = PAGE.read_text(encoding="utf-8")
    table = re.findall(r"^\| ([^|]+) \| ([^|]+) \| (n|n\^2) \|$", page, re.MULTILINE)
    assert table == [(row.name, row.size, "n" if row.order == 1 else f"n^{row.order}") for row in ROWS]
