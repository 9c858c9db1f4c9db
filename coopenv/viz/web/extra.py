"""viser, which draws in the browser; it comes with the extra `view`, its client included."""

import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from http import HTTPStatus
from ipaddress import ip_address
from secrets import compare_digest, token_urlsafe
from threading import Lock
from typing import Any
from urllib.parse import urlsplit

from coopenv.base.errors import CoopenvError

TOKEN_BYTES = 12
"""Random bytes of a page's address."""
_STARTING = Lock()


def has_viser() -> bool:
    """Return whether the extra is installed."""
    try:
        viser_module()
    except CoopenvError:
        return False
    return True


def viser_module() -> Any:
    """Return the module.

    Raises:
        CoopenvError: it is not installed.
    """
    try:
        import viser
    except ImportError:
        raise CoopenvError("pictures in the browser need an extra: pip install '.[view]'") from None
    import rich

    rich.get_console().quiet = True  # it would write to standard output when it stops
    return viser


@contextmanager
def guarded_server(host: str, port: int) -> Iterator[tuple[Any, str]]:
    """Yield a server of viser, and the address of its page, which `refusal` guards.

    viser itself answers every WebSocket and every host name and has no setting for it. The guard is put before its
    own `process_request` while it starts.

    Raises:
        CoopenvError: the extra is not installed, or this version of viser starts in another way.
    """
    viser = viser_module()
    from websockets.asyncio import server as asyncio_server

    token, names = token_urlsafe(TOKEN_BYTES), {"localhost", host.lower(), socket.gethostname().lower()}
    guards: list[Callable[[Any, Any], Any]] = []

    def guarded_serve(*arguments: Any, process_request: Callable[[Any, Any], Any], **options: Any) -> Any:
        def guard(connection: Any, request: Any) -> Any:
            reason, path = refusal(request.path, request.headers, token, names)
            if reason:
                return connection.respond(HTTPStatus.FORBIDDEN, f"{reason}\n")
            return process_request(connection, replace(request, path=path))

        guards.append(guard)
        return serve(*arguments, process_request=guard, **options)

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
    if not compare_digest(first.encode(), token.encode()):
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
