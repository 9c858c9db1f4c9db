"""The network in the deployment file: which wire, where, and its certificates."""

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from coopenv.errors import listed, shown
from coopenv.svea.transport.endpoints import SECURE, address_of


class Part(BaseModel):
    """A section of the file; unknown keys are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)


class Tls(Part):
    """Certificates of the transport; paths are relative to the file."""

    root_ca: Path
    """Certificate of who signs the others'."""
    certificate: Path | None = None
    """Own certificate, where this end listens or the other one asks for it."""
    key: Path | None = None
    """Private key of it, which only its owner can read."""

    @model_validator(mode="after")
    def _both_or_none(self) -> Self:
        if (self.certificate is None) != (self.key is None):
            raise ValueError("certificate and key: give both or none")
        return self


def _endpoint(text: str) -> str:
    """Refuse what is no endpoint such as tcp/127.0.0.1:7447."""
    address_of(text)
    return text


Endpoint = Annotated[str, AfterValidator(_endpoint)]

WIRES = {
    "zenoh": ("tcp/127.0.0.1:7447", ("tcp", "tls", "quic", "udp")),
    "nats": ("nats/127.0.0.1:4222", ("nats", "tcp", "tls")),
    "ros1": ("tcp/127.0.0.1:11311", ("tcp",)),
}
"""Kinds of networks: where they are if nothing is said, and which protocols they have."""


def refuse_foreign(kind: str, endpoints: tuple[str, ...]) -> None:
    """Refuse endpoints of a protocol that a kind of network does not have, with a ValueError that says which."""
    for endpoint in endpoints:
        if address_of(endpoint).protocol not in WIRES[kind][1]:
            raise ValueError(f"connect: {shown(endpoint)}: {kind} has {listed(WIRES[kind][1])}")


class Network(Part):
    """How the cars are reached."""

    kind: Literal["zenoh", "nats", "ros1"] = "zenoh"
    """`zenoh`: CDR under the keys of zenoh-bridge-ros2dds; `nats`: the authors' wire; `ros1`: topics of a ROS
    master."""
    connect: tuple[Endpoint, ...] = Field(
        default_factory=lambda given: (WIRES[given.get("kind", "zenoh")][0],), min_length=1
    )
    """Where the router, the broker or the ROS master is (default: on this computer, at its usual port)."""
    tls: Tls | None = None
    """Needed by endpoints `tls/...`, and only by them."""

    @model_validator(mode="after")
    def _endpoints_fit(self) -> Self:
        if self.kind == "ros1" and len(self.connect) > 1:
            raise ValueError("connect: there is one ROS master, more than one endpoint is given")
        refuse_foreign(self.kind, self.connect)
        for endpoint in self.connect:
            secure = address_of(endpoint).protocol in SECURE
            if secure and self.tls is None:
                raise ValueError(f"tls: is missing, {endpoint} needs at least its root_ca")
            if not secure and self.tls is not None:
                raise ValueError(f"connect: {endpoint} would go in the clear; with network.tls it is tls/...")
        return self


class GateLink(Part):
    """Where the gate of a car connects to, whatever `network` says: no radio may stand between it and the wheels."""

    connect: tuple[Endpoint, ...] | None = Field(default=None, min_length=1)
    """The car's own router, bridge or ROS master, on its loopback (default: at its usual port)."""
