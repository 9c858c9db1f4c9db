"""What a gate is told when it starts, by a deployment file and by options."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coopenv.errors import CoopenvError, shown
from coopenv.svea.limits import USUAL, Limits
from coopenv.svea.signing import LONGEST_IDENTITY, is_identity
from coopenv.svea.transport.endpoints import SECURE, address_of

if TYPE_CHECKING:
    from coopenv.svea.deployment import Deployment
    from coopenv.svea.signing import Signer, Verifier
    from coopenv.svea.transport.base import Transport


@dataclass(frozen=True)
class Settings:
    """Of one gate."""

    car: str
    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    limits: Limits = USUAL
    keys: Path | None = None  # folder
    station: str = "station"
    fleet: Deployment | None = None  # of the file, if there is one

    @classmethod
    def of(cls, car: str, path: Path | None) -> Settings:
        """Return the settings for a car by a deployment file, or the usual ones.

        Raises:
            CoopenvError: the name is none, the file cannot be read, or knows no such car.
        """
        if path is None:
            if not is_identity(car):
                raise CoopenvError(f"--car {shown(car)}: expected 1 to {LONGEST_IDENTITY} letters, digits, _ or -")
            return cls(car)
        from coopenv.svea.deployment import load_deployment

        read = load_deployment(path)
        keys = None if read.security.keys is None else read.folder / read.security.keys
        return cls(read.car(car).name, read.gate_connect, read.safety.limits, keys, read.security.identity, read)

    def changed(self, limits: Mapping[str, Any], **values: Any) -> Settings:
        """Return these settings with others in place of some; None leaves one as it is.

        Raises:
            CoopenvError: a limit is beyond the hardest.
        """
        bounds = replace(self.limits, **{name: value for name, value in limits.items() if value is not None})
        rest = {name: value for name, value in values.items() if value is not None}
        return replace(self, limits=bounds.check(), **rest)

    def check_place(self, off_board: bool) -> None:
        """Refuse a router that is not on the car, where neutral would get lost with the link; `off_board` allows it.

        Raises:
            CoopenvError: an endpoint is none, or not on this computer.
        """
        for endpoint in self.connect:
            if not address_of(endpoint).loopback and not off_board:
                raise CoopenvError(
                    f"{endpoint}: is not on this computer, and when the link to it dies the wheels get no neutral: "
                    "expected the car's own router, e.g. tcp/127.0.0.1:7447 ([gate] connect, --connect), or --off-board"
                )

    def open(self) -> Transport:
        """Connect to the network; errors as for `coopenv.svea.transport.open.open_transport`."""
        if self.fleet is None:
            from coopenv.svea.transport.zenoh import open_zenoh

            return open_zenoh("client", self.connect)
        from coopenv.svea.transport.open import open_transport

        secure = any(address_of(endpoint).protocol in SECURE for endpoint in self.connect)
        tls = self.fleet.network.tls if secure else None  # on the car itself nothing need be
        network = self.fleet.network.model_copy(update={"connect": self.connect, "tls": tls})
        return open_transport(self.fleet.model_copy(update={"network": network}))

    def identities(self) -> tuple[Signer | None, Verifier | None]:
        """Return what signs as the car and what knows the station. Raises CoopenvError: a key is missing or unsafe."""
        if self.keys is None:
            return None, None
        from coopenv.svea.keys import check_known, load_signer, load_verifier

        own = None if self.fleet is None else self.fleet.security.keys
        if self.fleet is not None and own is not None and self.keys == self.fleet.folder / own:
            verifier = load_verifier(self.fleet.keys or self.keys)  # which names the field where there is none
        else:
            verifier = load_verifier(self.keys)
        check_known(verifier, self.station, self.keys)
        return load_signer(self.keys, self.car), verifier
