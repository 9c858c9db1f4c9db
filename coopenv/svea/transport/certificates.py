"""Certificates and private keys of the transport's TLS, checked before anything is opened."""

import ssl
import stat
from dataclasses import dataclass
from pathlib import Path

from coopenv.errors import CoopenvError

FORBIDDEN = stat.S_IRWXG | stat.S_IRWXO


@dataclass(frozen=True, slots=True)
class Certificates:
    """Files in PEM. Whoever listens with a certificate asks for one of those who connect (mutual TLS)."""

    root_ca: Path  # who signs the others' certificates
    certificate: Path | None = None  # own one
    key: Path | None = None  # private key of it

    def __post_init__(self) -> None:
        """Refuse files that cannot be used. Raises CoopenvError: one line names the field and the file."""
        if (self.certificate is None) != (self.key is None):
            raise CoopenvError("tls.certificate, tls.key: give both or none")
        _check("root_ca", self.root_ca)
        if self.certificate is not None and self.key is not None:
            _check("certificate", self.certificate)
            _check("key", self.key)
            if self.key.stat().st_mode & FORBIDDEN:
                raise CoopenvError(f"tls.key: {self.key} can be read by others; run: chmod 600 {self.key}")
        self.context()

    def context(self) -> ssl.SSLContext:
        """Return what Python connects with. Raises CoopenvError: the files do not hold what they should."""
        try:
            made = ssl.create_default_context(cafile=self.root_ca)
        except (ssl.SSLError, OSError):
            raise CoopenvError(f"tls.root_ca: {self.root_ca} holds no certificate in PEM") from None
        if self.certificate is None or self.key is None:
            return made
        try:
            made.load_cert_chain(self.certificate, self.key, password="")  # never ask at the terminal
        except (ssl.SSLError, OSError):
            files = f"{self.certificate} and {self.key}"
            raise CoopenvError(
                f"tls.certificate, tls.key: {files} are no certificate and its key, in PEM without a password"
            ) from None
        return made

    def for_zenoh(self) -> dict[str, object]:
        """Return the entries of Zenoh's `transport/link/tls`."""
        entries: dict[str, object] = {"root_ca_certificate": str(self.root_ca)}
        if self.certificate is not None:
            for side in ("listen", "connect"):
                entries |= {f"{side}_certificate": str(self.certificate), f"{side}_private_key": str(self.key)}
            entries["enable_mtls"] = True
        return entries


def _check(field: str, path: Path) -> None:
    try:
        with path.open("rb"):
            return
    except OSError as error:
        raise CoopenvError(f"tls.{field}: {path}: cannot be read ({error.strerror or error})") from None
