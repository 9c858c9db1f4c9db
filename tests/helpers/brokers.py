"""Debian's servers of other networks, on the loopback."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.helpers.processes import wait_until
from tests.helpers.wire import free_port


def program(name: str) -> str:
    """Return where a program is, or skip the test."""
    found = shutil.which(name, path=os.pathsep.join((os.environ.get("PATH", ""), "/usr/sbin")))
    if found is None:
        pytest.skip(f"there is no {name}")
    return found


@contextmanager
def serving(command: Sequence[str], port: int, folder: Path, **environment: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run a server until the block is left; it listens."""
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    server = subprocess.Popen(command, cwd=folder, env={**os.environ, **environment}, start_new_session=True, **quiet)

    def answers() -> bool:
        assert server.poll() is None, f"{command[0]} has ended"
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", port)) == 0

    try:
        wait_until(answers)
        yield server
    finally:
        server.kill()
        server.wait()


@contextmanager
def nats_server(port: int, folder: Path, *options: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run a NATS broker."""
    command = (program("nats-server"), "--addr", "127.0.0.1", "--port", str(port), *options)
    with serving(command, port, folder) as server:
        yield server


ROS_PORT = free_port()
"""Of the master: a process can be a node of one master only, so all tests of this process use the same."""


@contextmanager
def ros_master() -> Iterator[str]:
    """Run a ROS master and yield its endpoint."""
    pytest.importorskip("rospy", reason="needs rospy: make test-ros1")
    command = (program("rosmaster"), "--core", "--port", str(ROS_PORT))
    environment = {"ROS_IP": "127.0.0.1", "ROS_MASTER_URI": f"http://127.0.0.1:{ROS_PORT}"}
    with serving(command, ROS_PORT, Path.cwd(), **environment):
        yield f"tcp/127.0.0.1:{ROS_PORT}"
