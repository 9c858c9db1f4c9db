"""Scenes in the browser, drawn by viser (extra `view`): a page that plays an episode from a file, and the live view.

`replay.html` opens from disk; the server of the live view is guarded.
"""

import errno
import gzip
import logging
import re
import socket
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from html import escape
from http import HTTPStatus
from ipaddress import ip_address
from pathlib import Path
from secrets import compare_digest, token_urlsafe
from threading import Lock
from typing import Any
from urllib.parse import quote, urlsplit

import numpy as np

from coopenv.base.errors import CoopenvError
from coopenv.base.files import replace_text
from coopenv.base.installation import install_command, needing
from coopenv.episode import Episode
from coopenv.viz.meshes import Look
from coopenv.viz.stage import Stage
from coopenv.viz.style import thinned
from coopenv.viz.web_panel import legend_html
from coopenv.viz.web_picture import FIELD_OF_VIEW, Picture, first_camera, first_look

TOKEN_BYTES = 12
"""Random bytes of a page's address."""
_STARTING = Lock()


def viser_module() -> Any:
    """Return the module.

    Raises:
        CoopenvError: it is not installed.
    """
    with needing(f"pictures in the browser need an extra: {install_command('view')}"):
        import viser
    import rich

    rich.get_console().quiet = True  # it would write to standard output when it stops
    return viser


@contextmanager
def guarded_server(host: str, port: int | None = None) -> Iterator[tuple[Any, str]]:
    """Yield a server of viser, and the address of its page with the token that it needs, which `refusal` guards.

    viser itself answers every WebSocket, host name and message and has no setting for it. The guard is put before its
    own `process_request` and its reception of messages, which `is_needed` filters, while it starts.

    Args:
        host: address of this computer.
        port: the one to listen on (None: the first free one from `PORT` on; 0: any).

    Raises:
        CoopenvError: the port is taken, or the address is none of this computer's; the extra is not installed, or this
            version of viser starts its server differently.
    """
    port = free_port(host, port)
    viser = viser_module()
    from websockets.asyncio import server as asyncio_server

    token, names = token_urlsafe(TOKEN_BYTES), {"localhost", host.lower(), socket.gethostname().lower()}
    guards: list[Callable[[Any, Any], Any]] = []

    def guarded_serve(handle: Any, *arguments: Any, process_request: Any, **options: Any) -> Any:
        def guard(connection: Any, request: Any) -> Any:
            reason, path = refusal(request.path, request.headers, token, names)
            if reason:
                return connection.respond(HTTPStatus.FORBIDDEN, f"{reason}\n")
            return folded(process_request(connection, replace(request, path=path)))

        async def filtered(connection: Any) -> None:
            receive = connection.recv

            async def receive_needed() -> Any:
                while not is_needed(message := await receive(), server.gui):
                    pass
                return message

            connection.recv = receive_needed
            await handle(connection)

        guards.append(guard)
        options |= {"max_size": 2**16, "logger": logging.Logger("view", logging.CRITICAL)}  # which is quiet
        return serve(filtered, *arguments, process_request=guard, **options)

    with _STARTING:
        serve = asyncio_server.serve
        asyncio_server.serve = guarded_serve  # type: ignore[assignment,misc]
        try:
            server = viser.ViserServer(host=host, port=port, verbose=False)
        finally:
            asyncio_server.serve = serve  # type: ignore[misc]
    try:
        if not guards:
            raise CoopenvError(f"viser {viser.__version__} would serve without checks; pip install 'viser==1.1.1'")
        shown = "127.0.0.1" if host == "0.0.0.0" else f"[{host}]" if ":" in host else host
        yield server, f"http://{shown}:{server.get_port()}/{token}"
    finally:
        server.stop()


_FOLD = b"""<script>if(matchMedia('(max-width: 36em)').matches)new MutationObserver((_, seen)=>{
const bar=document.querySelector('div[style*="cursor: pointer"][style*="height: 3.5em"]');
if(bar){seen.disconnect();bar.click()}}).observe(document,{childList:true,subtree:true})</script></head>"""


def folded(response: Any) -> Any:
    """Return viser's page with a script that folds the panel of a phone at first; other responses as they are."""
    if response is None or not response.headers.get("Content-Type", "").startswith("text/html"):
        return response
    packed = response.headers["Content-Encoding"] == "gzip"
    page = gzip.decompress(response.body) if packed else response.body
    page = page.replace(b"</head>", _FOLD, 1)
    response.body = gzip.compress(page, 1) if packed else page
    del response.headers["Content-Length"]
    response.headers["Content-Length"] = f"{len(response.body)}"
    return response


def is_needed(message: Any, gui: Any) -> bool:
    """Return whether a client's message is a camera, a click or a value that a control of viser's `gui` offers."""
    import msgspec
    from viser import _messages as known

    kinds = {k.__name__: k for k in (known.ViewerCameraMessage, known.SceneNodeClickMessage, known.GuiUpdateMessage)}
    try:
        given = msgspec.msgpack.decode(message)
        meant: Any = msgspec.convert(given, kinds[given.pop("type")])
        fine: bool = given.keys() == vars(meant).keys()
        if isinstance(meant, known.ViewerCameraMessage):
            fine &= meant.image_height > 0 and bool(np.abs(np.hstack([*vars(meant).values()])).max() < 1e9)  # finite
        elif isinstance(meant, known.GuiUpdateMessage):
            control, value = gui._gui_input_handle_from_uuid[meant.uuid], meant.updates.pop("value")
            options = getattr(control, "options", (False, True))
            offered = control.min <= value <= control.max if hasattr(control, "max") else value in options
            fine &= bool(offered) and not meant.updates
        return fine
    except Exception:  # a message never ends the view
        return False


PORT, PORTS = 8080, 20
"""The first port that is tried where none is asked for, and how many."""


def free_port(host: str, port: int | None) -> int:
    """Return a free port; arguments and errors as for `guarded_server`."""
    for candidate in range(PORT, PORT + PORTS) if port is None else (port,):
        try:
            family, kind, protocol, _, address = socket.getaddrinfo(host, candidate, type=socket.SOCK_STREAM)[0]
            with socket.socket(family, kind, protocol) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(address)
            return candidate
        except socket.gaierror:
            raise CoopenvError(f"--host {host}: no such address") from None
        except OSError as error:
            if error.errno == errno.EADDRNOTAVAIL:
                raise CoopenvError(f"--host {host}: is no address of this computer") from None
            reason = "another program listens there"
            if isinstance(error, PermissionError):
                reason = "ports below 1024 are for the administrator"
            if port is not None:
                raise CoopenvError(f"--port {port}: {reason}; name another one") from None
    raise CoopenvError(f"--port: {PORT} to {PORT + PORTS - 1} are taken; name another one")


def refusal(path: str, headers: Any, token: str, names: set[str]) -> tuple[str, str]:
    """Return why a request is refused (empty: it is not) and its path behind the token.

    A request needs the token as the first part of its path. Its Host must be an IP address or one of `names`, because
    a foreign page that has rebound its own name to this address sends that name. Its Origin, which browsers add to
    every WebSocket, must be the page's own.
    """
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    if len(hosts) != 1 or not _is_own(hosts[0], names):
        return "this Host is not served here", ""
    if any(origin != f"http://{hosts[0]}" for origin in origins):
        return "this Origin is not served here", ""
    route, question, query = path.partition("?")
    first, _, rest = route.removeprefix("/").partition("/")
    if not compare_digest(first.encode(errors="replace"), token.encode()):
        return "the address lacks the token that the terminal shows", ""
    return "", f"/{rest}{question}{query}"


def _is_own(host: str, names: set[str]) -> bool:
    """Return whether a Host header is an IP address or one of the names, whatever its port."""
    try:
        name = urlsplit(f"//{host}").hostname or ""
        if name in names:
            return True
        ip_address(name)
    except ValueError:
        return False
    return True


REPLAY_FILE = "replay.html"
MOST_FRAMES = 300
"""Of a page; longer episodes have fewer frames a second."""
_PHONE = 0.7  # width over height, from which on the camera begins farther away
_LOOPBACK = "127.0.0.1"


def write_replay(
    record: Episode,
    path: Path,
    on_progress: Callable[[float], None] = lambda share: None,
    others: Mapping[str, str] | None = None,
) -> Path:
    """Write the page of an episode and return its path.

    Args:
        record: the episode.
        path: of the page, which is replaced as a whole.
        on_progress: called with the share that is done.
        others: pages in the same folder by the names of their drivers, this one among them, to which this one leads.

    Raises:
        CoopenvError: the extra `view` is not installed.
        OutputError: the file cannot be written.
    """
    record = record.of(thinned(len(record), MOST_FRAMES))
    stage = Stage(record.scenario)
    sigma = np.array([record.frame(k).three_sigma for k in range(0, len(record), max(1, len(record) // 20))])
    look = first_look(sigma, stage, record.source)
    with guarded_server(_LOOPBACK, 0) as (server, _):
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        aim(server.initial_camera, stage)
        picture = Picture(server.scene, stage, record.source, look)
        picture.show(record.frame(0))
        recording, time = server.get_scene_serializer(), record.time
        for k in range(1, len(record)):
            recording.insert_sleep(float(time[k] - time[k - 1]))
            picture.show(record.frame(k))
            on_progress(k / len(record))
        page = recording.as_html()
    replace_text(path, _dressed(page, record, stage, look, others or {}))
    return path


def aim(camera: object, stage: Stage, aspect: float = 1.6, raised: float = 0.0, near: float = 1.0) -> None:
    """Point one of viser's cameras at the scene's middle.

    `raised` lifts it in the picture, in the scene's sides; `near` is a share of the distance at which all is in sight.
    """
    far, middle = first_camera(stage, aspect)
    below = np.array([0.0, near * raised * stage.side, 0.0])
    position, middle = middle + near * (far - middle) - below, middle - below
    settings = {"near": 1e-3 * stage.side, "far": 20.0 * stage.side, "fov": FIELD_OF_VIEW}
    for name, value in {**settings, "position": position, "look_at": middle}.items():
        setattr(camera, name, value)


def _dressed(page: str, record: Episode, stage: Stage, look: Look, others: Mapping[str, str]) -> str:
    """Return viser's page with the title of the episode and the legend, and a camera for narrow screens."""
    title = escape(record.scenario.title)
    far, middle = first_camera(stage, aspect=0.52)
    places = {"Position": far, "LookAt": middle}
    query = "&".join(f"initialCamera{name}={','.join(f'{x:.4g}' for x in at)}" for name, at in places.items())
    head = (
        f"<script>if(innerWidth<{_PHONE}*innerHeight&&!location.search)"
        f"try{{history.replaceState(null,'',location.pathname+'?{query}')}}catch(e){{}}</script>"
        f"<style>{_STYLE}</style>"
    )
    overlay = (
        f'<details id="about" open><summary>{title}</summary><p>{escape(record.source.words)}</p>'
        f"{_choice(record.source.policy, others)}"
        f"{legend_html(stage, record.source, look.magnification)}<p>{_KEYS}</p></details>"
        "<script>if(innerWidth<700)document.getElementById('about').open=false</script>"
    )
    page = re.sub(r"<title>.*?</title>", lambda _: f"<title>{title} - coopenv</title>", page, count=1)
    page = page.replace("</head>", f"{head}</head>", 1)
    place = page.rindex("</body>")
    return page[:place] + overlay + page[place:]


def _choice(driver: str, others: Mapping[str, str]) -> str:
    """Return links to the pages of the other drivers; nothing where there are none."""
    if len(others) < 2:
        return ""
    names = [
        f"<b>{escape(name)}</b>" if name == driver else f'<a href="{escape(quote(file))}">{escape(name)}</a>'
        for name, file in others.items()
    ]
    return f"<p>Driver: {', '.join(names)}</p>"


_KEYS = "Drag to turn, right drag to move, wheel to come nearer. Space: pause."
_STYLE = """
#about{position:fixed;top:10px;right:10px;z-index:2;max-width:min(330px,calc(100vw - 40px));padding:8px 12px;
background:rgba(255,255,255,.92);border:1px solid #ddd;border-radius:6px;font:13px/1.4 system-ui,sans-serif;color:#222}
#about summary{font-weight:600;cursor:pointer}#about p{margin:4px 0;color:#595959}
"""
