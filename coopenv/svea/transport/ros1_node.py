"""The one ROS 1 node of a process, its master, and messages that stay bytes."""

import atexit
import os
import socket
import struct
import threading
import xmlrpc.client
from functools import cache
from http.client import HTTPConnection
from typing import Any

from coopenv.errors import CoopenvError
from coopenv.svea.codec import ros1
from coopenv.svea.transport.base import LinkError
from coopenv.svea.transport.endpoints import Address, trouble_at

ENVELOPE = "std_msgs/msg/UInt8MultiArray"
"""Type of topics that the authors do not have: CDR bytes, with what is beside them before them."""

CALLER = "/coopenv"

_lock = threading.Lock()
_master: str | None = None


def rospy() -> Any:
    """Return the library. Raises CoopenvError: it is not installed for this interpreter."""
    try:
        import rospy
    except ImportError:
        raise CoopenvError(
            "ROS 1 needs rospy: install Debian's python3-rospy and python3-rosmaster, or ROS noetic, and use the "
            "system's interpreter (/usr/bin/python3 -m venv --system-site-packages VENV)"
        ) from None
    return rospy


class Master:
    """The ROS master, asked with a time limit, which rospy's own proxy has not."""

    def __init__(self, address: Address, timeout: float) -> None:
        self.uri = f"http://{address.authority}"
        self._proxy = xmlrpc.client.ServerProxy(self.uri, transport=_Timed(timeout))
        self._lock = threading.Lock()

    def ask(self, question: str, *arguments: str) -> Any:
        """Return an answer; None: there is no such thing. Raises OSError: the master does not answer."""
        with self._lock:
            try:
                code, _, value = getattr(self._proxy, question)(CALLER, *arguments)
            except (xmlrpc.client.Error, ValueError, TypeError) as error:
                raise OSError(f"no ROS master ({type(error).__name__})") from None
        return value if code == 1 else None


class _Timed(xmlrpc.client.Transport):
    def __init__(self, timeout: float) -> None:
        super().__init__()
        self._timeout = timeout

    def make_connection(self, host: Any) -> HTTPConnection:
        return HTTPConnection(host, timeout=self._timeout)


def join(address: Address, timeout: float) -> Master:
    """Make this process a node of a master, once.

    Raises:
        LinkError: no master answers, or the process is a node of another one already.
        CoopenvError: rospy is not installed.
    """
    global _master
    library, master = rospy(), Master(address, timeout)
    try:
        master.ask("getPid")
    except OSError as error:
        reason = trouble_at(address, None, timeout) or error
        raise LinkError(f"{address.protocol}/{address.authority}: no ROS master there ({reason})") from None
    with _lock:
        if _master not in (None, master.uri):
            raise LinkError(f"{master.uri}: this process is a node of {_master} already, and can be one of one only")
        if _master is None:
            os.environ["ROS_MASTER_URI"] = master.uri
            if not {"ROS_IP", "ROS_HOSTNAME"} & set(os.environ):
                os.environ["ROS_IP"] = _own_address(address)  # else rospy listens on, and says, whatever it finds
            options = {"disable_signals": True, "disable_rostime": True, "disable_rosout": True}
            library.init_node("coopenv", argv=[], anonymous=True, **options)
            atexit.register(library.signal_shutdown, "the process ends")
            _master = master.uri
    return master


def _own_address(master: Address) -> str:
    """Return the address of this computer as the master sees it; nothing is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect((master.host, master.port))
        return str(probe.getsockname()[0])


@cache
def raw_type(kind: str) -> Any:
    """Return a message class of a ROS 1 type whose content is bytes; peers check its type as ever."""
    text, checksum = ros1().generate_msgdef(kind)
    named = {"_type": kind.replace("/msg/", "/"), "_md5sum": checksum, "_full_text": text, "__slots__": ["_buff"]}
    return type("Raw", (rospy().AnyMsg,), named)


def sealed(payload: bytes, attachment: bytes) -> bytes:
    """Return both as a UInt8MultiArray without dimensions."""
    content = struct.pack("<I", len(attachment)) + attachment + payload
    return struct.pack("<III", 0, 0, len(content)) + content


def opened(message: bytes) -> tuple[bytes, bytes] | None:
    """Return payload and attachment of `sealed`; None: it is not one."""
    if len(message) < 16:
        return None
    dimensions, offset, size, beside = struct.unpack_from("<4I", message)
    if dimensions or offset or size != len(message) - 12 or beside > size - 4:
        return None
    return message[16 + beside :], message[16 : 16 + beside]
