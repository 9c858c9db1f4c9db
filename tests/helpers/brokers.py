"""Debian's servers of other networks on the loopback, and a certificate authority for one test."""

from __future__ import annotations

import datetime
import ipaddress
import os
import shutil
import socket
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from coopenv.cars.link.transport import Tls
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


PEM = serialization.Encoding.PEM


class Authority:
    """Signs certificates for the loopback."""

    def __init__(self, folder: Path, name: str) -> None:
        """Make `NAME.pem` in the folder."""
        self._folder, self._name = folder, x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        self._key = ec.generate_private_key(ec.SECP256R1())
        self.file = folder / f"{name}.pem"
        self.file.write_bytes(self._signed(self._name, self._key, None).public_bytes(PEM))

    def certify(self, name: str, host: str = "127.0.0.1") -> tuple[Path, Path]:
        """Return the files of a new certificate, for an address, and of its key."""
        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        certificate, private = self._folder / f"{name}.pem", self._folder / f"{name}.key"
        certificate.write_bytes(self._signed(subject, key, host).public_bytes(PEM))
        encoded = key.private_bytes(PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
        private.touch(mode=0o600)
        private.write_bytes(encoded)
        return certificate, private

    def tls(self, name: str = "", host: str = "127.0.0.1") -> Tls:
        """Return this authority with a new certificate of a name; without a name none."""
        certificate, key = self.certify(name, host) if name else (None, None)
        return Tls(root_ca=self.file, certificate=certificate, key=key)

    def _signed(self, subject: x509.Name, key: ec.EllipticCurvePrivateKey, host: str | None) -> x509.Certificate:
        now = datetime.datetime.now(datetime.UTC)
        builder = (
            x509.CertificateBuilder()
            .subject_name(subject)
            .issuer_name(self._name)
            .public_key(key.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - datetime.timedelta(days=1))
            .not_valid_after(now + datetime.timedelta(days=1))
            .add_extension(x509.BasicConstraints(ca=host is None, path_length=None), critical=True)
            .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
            .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(self._key.public_key()), critical=False)
            .add_extension(_usage(signs=host is None), critical=True)
        )
        if host is not None:
            names = x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address(host))])
            builder = builder.add_extension(names, critical=False)
        return builder.sign(self._key, hashes.SHA256())


def _usage(signs: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=True,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=signs,
        crl_sign=signs,
        encipher_only=False,
        decipher_only=False,
    )
