"""The live view without a browser: reels, the loop's answers to wishes, and the server's port."""

from __future__ import annotations

import gzip
import socket
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from time import monotonic
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest

import coopenv
from coopenv.api.engine import Engine
from coopenv.base.errors import CoopenvError
from coopenv.episode import Origin
from coopenv.runs.live import FAULTS, EngineReel, Reel, vehicle_index
from coopenv.runs.scenes import driver_of, scene_of
from coopenv.runs.view import Viewer
from coopenv.sources.sources import open_backend
from coopenv.viz.web import free_port, guarded_server
from tests.helpers.fleet import Fleet
from tests.helpers.processes import wait_until

pytest.importorskip("viser", reason="needs the extra view")


def reel_of(name: str, **overrides: Any) -> EngineReel:
    changes = {"horizon": 4.0, **overrides}
    opened = lambda more: open_backend(name, None, {**changes, **more})  # noqa: E731
    return EngineReel(opened, name, 3, lambda scenario: driver_of(None, scenario, name, 3))


def run_to(reel: Reel, frames: int) -> None:
    while len(reel.frames) < frames:
        assert reel.more()


def test_another_observer_sees_the_same_episode() -> None:
    reel = reel_of("busy_intersection")
    run_to(reel, 20)
    before = reel.frames
    reel.change(observer="robust")
    assert reel.source.observer == "robust" and reel.source.honest
    assert [frame.tick for frame in reel.frames] == [frame.tick for frame in before]
    for old, new in zip(before, reel.frames, strict=True):
        np.testing.assert_array_equal(old.position, new.position)
    assert (before[-1].position_estimate != reel.frames[-1].position_estimate).any()
    before = reel.frames
    with pytest.raises(CoopenvError, match="unknown observer"):
        reel.change(observer="nobody")
    assert reel.frames is before and reel.source.observer == "robust" and reel.more()
    reel.close()


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_begins_now(fault: str) -> None:
    reel = reel_of("busy_intersection", **{"observer.name": "robust", "noise.enabled": False})
    run_to(reel, 20)
    now = float(reel.frames[-1].tick) / reel.scenario.rates.camera
    before = reel.frames
    reel.change(fault=FAULTS[fault](now, 1))
    assert len(reel.frames) == 20
    if "whole episode" not in fault:
        for old, new in zip(before[:-1], reel.frames[:-1], strict=True):
            np.testing.assert_array_equal(old.position_estimate, new.position_estimate)
    run_to(reel, 40)
    wrong = reel.frames[-1]
    reel.change(fault={})
    run_to(reel, 40)
    if "detections" not in fault:  # here every neighbour is always measured
        assert (wrong.position_estimate != reel.frames[-1].position_estimate).any()
    reel.close()


@pytest.fixture
def viewer() -> Iterator[Viewer]:
    reel = reel_of("urban_crossing")
    with guarded_server("127.0.0.1") as (server, url):
        assert url.startswith(f"http://127.0.0.1:{server.get_port()}/")
        yield Viewer(server, reel)
    reel.close()


def turns(count: int) -> Callable[[], bool]:
    left = iter(range(count))
    return lambda: next(left, None) is not None


def wish(viewer: Viewer, *wishes: tuple[str, Any]) -> None:
    viewer._panel.wishes.update(wishes)
    viewer.run(turns(1))


def test_the_user_goes_through_the_episode(viewer: Viewer) -> None:
    reel = viewer._reel
    wish(viewer, ("play", None))
    assert not viewer.playing
    wish(viewer, ("seek", 2.0))
    assert viewer._frame.tick == pytest.approx(2.0 * reel.scenario.rates.camera, abs=2)
    kept = len(reel.frames)
    wish(viewer, ("step", None))
    assert len(reel.frames) == kept + 1
    wish(viewer, ("seek", 0.5))
    assert len(reel.frames) == kept + 1  # what has been is kept
    assert viewer._frame.tick == pytest.approx(0.5 * reel.scenario.rates.camera, abs=2)
    wish(viewer, ("restart", None), ("play", None))
    assert viewer._frame.tick == 0 and not viewer.playing


def test_switches_change_what_is_shown_and_the_view_goes_along_with_the_picked_vehicle(viewer: Viewer) -> None:
    picture, root = viewer._picture, viewer._picture.ground.root
    wish(viewer, ("play", None), ("seek", 1.0), ("magnification", 1.0), ("vehicle", 2))
    place = viewer._frame.position[2, :2] + root.position[:2]
    np.testing.assert_allclose(place, viewer._stage.middle[:2], atol=1e-3)
    small = np.array(picture.actors._ellipsoids.handle.batched_scales)
    wish(viewer, ("magnification", 10.0), *((f"show {name}", False) for name in ("names", "views", "follow")))
    np.testing.assert_allclose(root.position, 0.0)
    large = np.array(picture.actors._ellipsoids.handle.batched_scales)
    np.testing.assert_allclose(large[small > 0.05] / small[small > 0.05], 10.0, rtol=0.05)
    assert not any(node.visible for node in (*picture._labels._cars, *picture._views))


def test_names_state_the_errors_of_another_observer_at_the_same_time(viewer: Viewer) -> None:
    wish(viewer, ("play", None), ("seek", 3.0))
    before = [label.text for label in viewer._picture._labels._cars]
    wish(viewer, ("observer", "riccati"))
    texts = [label.text for label in viewer._picture._labels._cars]
    assert texts == [f"f{i + 1}  {error:.2f} m" for i, error in enumerate(viewer._frame.position_error)] != before


def test_what_stands_still_is_not_sent_again(viewer: Viewer, monkeypatch: pytest.MonkeyPatch) -> None:
    """A frame that is shown twice costs nothing but the time, and while playing every other name and view waits."""
    from viser.infra._async_message_buffer import AsyncMessageBuffer

    sent: list[str] = []
    push = AsyncMessageBuffer.push
    monkeypatch.setattr(
        AsyncMessageBuffer, "push", lambda buffer, message: (sent.append(repr(message)), push(buffer, message))
    )
    wish(viewer, ("play", None), ("seek", 1.0))
    picture, frame = viewer._picture, viewer._frame
    sent.clear()
    picture.show(frame)
    assert sent == []
    later = viewer._reel.frames[len(viewer._reel.frames) // 2]
    for turn in (0, 1):
        picture.show(later, turn)
    by_turns = [handle.vertices.copy() for handle in picture._views]
    picture.show(later)
    for kept, handle in zip(by_turns, picture._views, strict=True):
        np.testing.assert_array_equal(kept, handle.vertices)


def client(url: str, **more: Any) -> Any:
    """Connect to the live view as a program; `more` are options of the WebSocket."""
    import viser
    from websockets.sync.client import connect

    versions = [f"viser-v{viser.__version__}"]
    return connect(url.replace("http", "ws"), subprotocols=versions, max_size=None, **more)


CAMERA = {
    "type": "ViewerCameraMessage",
    **{"wxyz": (1.0, 0.0, 0.0, 0.0), "position": (0.0, 0.0, 50.0)},
    **{"look_at": (0.0, 0.0, 0.0), "up_direction": (0.0, 1.0, 0.0)},
    **{"fov": 1.0, "near": 0.1, "far": 10.0, "image_height": 10, "image_width": 10},
}


def control(server: Any, label: str) -> tuple[str, Any]:
    """Return the identifier of a control and the control."""
    handles = server.gui._gui_input_handle_from_uuid.items()
    return next((uuid, handle) for uuid, handle in handles if getattr(handle, "label", "") == label)


def update(server: Any, label: str, value: Any, name: str = "value") -> dict[str, Any]:
    """Return a client's message that changes a control."""
    return {"type": "GuiUpdateMessage", "uuid": control(server, label)[0], "updates": {name: value}}


def send(link: Any, *messages: Any) -> None:
    import msgspec

    for message in messages:
        link.send(msgspec.msgpack.encode(message))


def status_of(url: str, host: str) -> int:
    """Return the status of a page that is asked for under a Host."""
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers={"Host": host}), timeout=20) as answer:
            return int(answer.status)
    except urllib.error.HTTPError as error:
        return error.code


@pytest.fixture
def address() -> Iterator[str]:
    with guarded_server("127.0.0.1") as (_, url):
        yield url


@pytest.mark.parametrize("encoding", ["gzip", "identity"])
def test_the_page_folds_the_panel_of_a_phone(encoding: str, address: str) -> None:
    with urllib.request.urlopen(urllib.request.Request(address, headers={"Accept-Encoding": encoding})) as answer:
        assert answer.headers["Content-Encoding"] == encoding
        page = answer.read()
    page = gzip.decompress(page) if encoding == "gzip" else page
    assert page.count(b"(max-width: 36em)") >= 1 and page.count(b"bar.click()") == 1


@pytest.mark.parametrize("origin", ["http://evil.example", "http://127.0.0.1:1", "null", "https://127.0.0.1"])
def test_a_websocket_of_a_foreign_page_is_refused(origin: str, address: str) -> None:
    from websockets.exceptions import InvalidStatus

    with pytest.raises(InvalidStatus, match="403"):
        client(address, origin=origin)
    with client(address, origin=address.rpartition("/")[0]) as link:
        assert link.recv(timeout=20)


def test_without_the_token_nothing_is_served(address: str) -> None:
    from websockets.exceptions import InvalidStatus

    base, host = address.rpartition("/")[0], urlsplit(address).netloc
    for path in ("", "/", "/index.html", "/x", "//", "/%2e%2e/", address.removeprefix(base)[:-1]):
        assert status_of(base + path, host) == 403
        with pytest.raises(InvalidStatus, match="403"):
            client(base + path)


@pytest.mark.parametrize(
    ("hosts", "status"),
    [
        (["evil.example", "evil.example:8080", "127.0.0.1.evil.example", "[", ""], 403),
        (["localhost:8080", "127.0.0.1", "[::1]:9000", "192.168.1.7:8080"], 200),
    ],
)
def test_addresses_and_localhost_are_served_behind_any_port(hosts: list[str], status: int, address: str) -> None:
    """A page whose name has been rebound to this computer sends that name, which is refused."""
    for host in hosts:
        assert status_of(address, host) == status_of(f"{address}/?initialCameraFov=1", host) == status


def test_bytes_that_are_no_request_leave_the_terminal_quiet(
    address: str, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    where = urlsplit(address)
    host = f"Host: {where.netloc}".encode()
    for request, status in (
        (b"GET /\xff HTTP/1.1\r\n" + host, b"HTTP/1.1 403"),
        (b"GET /\xff HTTP/1.1\r\nHost: \xff", b"HTTP/1.1 403"),
        (b"POST / HTTP/1.1\r\n" + host, b""),
        (b"\x16\x03\x01", b""),
    ):
        with socket.create_connection((where.hostname, where.port), timeout=20) as link:
            link.sendall(request + b"\r\n\r\n")
            assert link.recv(4096).startswith(status)
    assert not caplog.text and capfd.readouterr().err == ""


def test_what_viser_starts_unguarded_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    viser = pytest.importorskip("viser", reason="needs the extra 'view'")

    monkeypatch.setattr(viser, "ViserServer", lambda **unused: SimpleNamespace(stop=lambda: None))
    with pytest.raises(CoopenvError, match="would serve without checks"), guarded_server("127.0.0.1"):
        pass


@pytest.fixture
def worked() -> Iterator[tuple[Viewer, Any, Any]]:
    """A view that pauses, viser's server and a client."""
    reel = reel_of("urban_crossing")
    with guarded_server("127.0.0.1") as (server, url), client(url) as link:
        shown = Viewer(server, reel)
        wish(shown, ("play", None))
        send(link, CAMERA)
        yield shown, server, link
    reel.close()


def check_works(shown: Viewer, server: Any, link: Any) -> None:
    """Check that a view still carries out what its panel offers."""
    send(link, update(server, "Vehicle", "f2"))
    wait_until(lambda: shown._look.picked == 1, lambda: shown.run(turns(1)))
    shown._faded_at = -np.inf
    wish(shown, ("step", None))
    assert len(shown._reel.frames) == 2 and not shown._panel._status.visible


NAN = float("nan")


@pytest.mark.parametrize(
    ("label", "values"),
    [
        ("Fault", ["zzz"]),
        ("Observer", ["../mine.py:Observer"]),
        ("Vehicle", ["f99", "x" * 50_000]),
        ("Speed", ["0", "nan", 1]),
        ("Time [s]", [NAN, 1e9, -1.0, "1", [1.0], None]),
    ],
)
def test_values_that_are_not_offered_are_refused(
    label: str, values: list[Any], worked: tuple[Viewer, Any, Any], caplog: pytest.LogCaptureFixture
) -> None:
    shown, server, link = worked
    before = control(server, label)[1].value
    send(link, *(update(server, label, value) for value in values), update(server, "Names", False))
    wait_until(lambda: "show names" in shown._panel.wishes)
    assert list(shown._panel.wishes) == ["show names"] and control(server, label)[1].value == before
    check_works(*worked)
    assert not caplog.text


PLACES: list[Any] = [{**CAMERA, "position": at} for at in ([1.0, 2.0], [NAN] * 3, [1e200] * 3, CAMERA["look_at"])]
LENSES: list[Any] = [{**CAMERA, name: value} for name, value in (("image_height", 0), ("fov", "x"), ("more", 1))]
UPDATES: list[Any] = [
    {"type": "GuiFormDirtyMessage", "uuid": "x" * 10_000},
    {"type": ["GuiUpdateMessage"]},
    {"type": "GuiUpdateMessage", "uuid": "nothing", "updates": {"value": 1}},
]


@pytest.mark.parametrize(
    "messages", [PLACES, [*LENSES, {"type": "ViewerCameraMessage"}], UPDATES, [[1]], [b"\xff"]], ids=range(5)
)
def test_no_message_of_a_client_ends_the_view(
    messages: list[Any],
    worked: tuple[Viewer, Any, Any],
    caplog: pytest.LogCaptureFixture,
    capfd: pytest.CaptureFixture[str],
) -> None:
    _, server, link = worked
    send(link, *messages)
    check_works(*worked)
    kept = server._websock_server._broadcast_buffer.message_from_id.values()
    assert not any(type(each).__name__ == "GuiFormDirtyMessage" for each in kept)
    assert not caplog.text and capfd.readouterr().err == ""


def test_vehicles_can_be_clicked_on_and_nothing_else(worked: tuple[Viewer, Any, Any]) -> None:
    shown, _, link = worked
    name = shown._picture.actors.cars.handle.name
    where = {"screen_pos": (0.5, 0.5), "ray_origin": (0.0, 0.0, 1.0), "ray_direction": (0.0, 0.0, -1.0)}
    for index, picked in ((0, 0), (99, 0), (-1, 0), (2**63, 0), (2, 2), (None, None)):
        click = {"name": name, "instance_index": index, "modifier": None, "owner": "", **where}
        send(link, {"type": "SceneNodeClickMessage", **click})
        wait_until(lambda index=index: shown._panel.wishes == {"vehicle": index})
        shown.run(turns(1))
        assert shown._look.picked == picked and not shown._panel._status.visible


def test_neither_properties_nor_files_can_be_sent(worked: tuple[Viewer, Any, Any]) -> None:
    _, server, link = worked
    slider = control(server, "Time [s]")
    part = {"source_component_uuid": slider[0], "transfer_uuid": "t"}
    start = {"filename": "f", "mime_type": "m", "part_count": 1, "size_bytes": 1, **part}
    send(link, {"type": "FileTransferStartUpload", **start})
    send(link, {"type": "FileTransferPart", "part_index": 0, "content": b"x", **part})
    send(link, update(server, "Time [s]", value=True, name="removed"))
    check_works(*worked)
    assert not slider[1]._impl.removed and isinstance(slider[1].value, float)


def test_no_client_can_share_the_view_or_send_much(
    worked: tuple[Viewer, Any, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    from websockets.exceptions import ConnectionClosed

    _, server, link = worked
    asked: list[str] = []
    for name in ("request_share_url", "disconnect_share_url"):
        monkeypatch.setattr(server, name, lambda: asked.append("share"))
    send(link, {"type": "ShareUrlRequest"}, {"type": "ShareUrlDisconnect"})
    check_works(*worked)
    assert not asked
    link.send(bytes(2**20))
    with pytest.raises(ConnectionClosed, match="1009"):
        while link.recv(timeout=20):
            pass


def test_of_queued_wishes_for_one_thing_the_last_one_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    reel, asked = reel_of("urban_crossing"), []
    monkeypatch.setattr(reel, "change", lambda **changes: asked.append(changes))
    with guarded_server("127.0.0.1") as (server, url), client(url) as link:
        shown = Viewer(server, reel)
        send(link, CAMERA, *(update(server, "Observer", name) for name in 10 * ["riccati", "mekf"]))
        send(link, update(server, "Vehicle", "f2"))
        wait_until(lambda: shown._panel.wishes == {"observer": "mekf", "vehicle": 1})
        shown.run(turns(1))
    assert asked == [{"observer": "mekf"}]
    reel.close()


def test_any_error_of_a_wish_is_reported_and_the_view_goes_on(viewer: Viewer, monkeypatch: pytest.MonkeyPatch) -> None:
    wish(viewer, ("play", None), ("seek", 1.0))
    kept = viewer._reel.frames

    def fail(reel: EngineReel) -> bool:
        raise RuntimeError("the observer fails")

    with monkeypatch.context() as patched:
        patched.setattr(EngineReel, "more", fail)
        wish(viewer, ("observer", "riccati"))
    assert "That cannot be: RuntimeError: the observer fails" in viewer._panel._status.content.replace("\\", "")
    assert viewer._reel.frames is kept and viewer._reel.source.observer == "robust"
    before = len(kept)
    wish(viewer, ("seek", 2.0), ("observer", "nobody"))
    assert len(viewer._reel.frames) > before
    assert "That cannot be: unknown observer" in viewer._panel._status.content
    wish(viewer, ("observer", "riccati"))
    assert "observer riccati" in viewer._panel._head.content and not viewer._panel._status.visible


def test_the_end_is_reported(viewer: Viewer) -> None:
    wish(viewer, ("seek", 100.0), ("play", None))
    viewer.run(turns(3))
    assert not viewer.playing and "over" in viewer._panel._status.content


def test_when_cars_end_the_view_stays_and_waits() -> None:
    fleet = Fleet(horizon=0.5)
    fleet.capabilities = replace(fleet.capabilities, real_time=True)
    reel = EngineReel(lambda _: fleet, "fleet", 0, lambda _: (None, ""))
    with guarded_server("127.0.0.1") as (server, _):
        shown = Viewer(server, reel)
        shown.run(turns(100))
        assert "The episode is over." in shown._panel._status.content
        begun = monotonic()
        shown.run(turns(10))
        assert monotonic() - begun > 0.4  # it sleeps
    reel.close()


def test_a_kept_scene_is_shown_and_cannot_be_changed() -> None:
    scenario = coopenv.load_scenario("overtaking", {"horizon": 1.0})
    record = scene_of(Engine(scenario), Origin.of("overtaking", scenario, seed=0))
    reel = Reel.of(record)
    with guarded_server("127.0.0.1") as (server, _):
        shown = Viewer(server, reel)
        wish(shown, ("seek", 1.0))
        assert shown._frame.tick == record["tick"][-1]
    assert not reel.more()
    with pytest.raises(CoopenvError, match="nothing can be changed"):
        reel.change(observer="robust")


def test_a_port_that_is_taken_is_reported() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(CoopenvError, match=f"--port {port}: another program listens there"):
            free_port("127.0.0.1", port)
    assert free_port("127.0.0.1", port) == port
    with pytest.raises(CoopenvError, match=r"--host 192\.0\.2\.1: is no address of this computer"):
        free_port("192.0.2.1", port)
    with pytest.raises(CoopenvError, match="--host no such host: no such address"):
        free_port("no such host", port)


def test_vehicles_are_found_by_either_name() -> None:
    scenario = coopenv.load_scenario("overtaking")
    found = partial(vehicle_index, scenario)
    assert [found(name) for name in (None, "f2", "vehicle_1")] == [0, 1, 0]
    with pytest.raises(CoopenvError, match="--vehicle f9: no such vehicle"):
        found("f9")
