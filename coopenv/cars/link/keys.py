"""Files of keys: one private key per identity, readable by its owner alone, and one file of all public keys.

A folder of keys holds NAME.pem per identity and `public.toml`. A car needs its own private file and `public.toml`, and
a station likewise; both take the folder in which they are.

They travel beside a message, as the transport's attachment, so that its payload stays what ROS 2 has under that topic.
A signature contains no time of its own: receivers check stamps and sequence numbers, which are part of what is signed.
"""

from __future__ import annotations

import base64
import os
import stat
import struct
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coopenv.base.errors import CoopenvError, listed, shown, suggest
from coopenv.base.files import replace_text, writing
from coopenv.base.installation import install_command, needing
from coopenv.base.sections import toml_of

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

DOMAIN = b"coopenv message 1\0"
"""Prefix of every signed text, so that signatures made for another purpose are invalid here."""

SIGNATURE_BYTES = 64
LONGEST_IDENTITY = 64  # characters, ASCII


class Signer:
    """Signs as one identity, the name of a car or a station, ASCII, at most 64 characters."""

    def __init__(self, identity: str, key: Ed25519PrivateKey) -> None:
        """Take a private key. Raises CoopenvError: the identity is none."""
        check_identity(identity, "identity")
        self.identity, self._key = identity, key

    def sign(self, topic: str, payload: bytes) -> bytes:
        """Return the attachment of a message: the length of the identity (1 byte), the identity, 64 bytes."""
        name = self.identity.encode()
        return bytes([len(name)]) + name + self._key.sign(_signed(name, topic, payload))


class Verifier:
    """Public keys of identities; finds the signer of a message."""

    def __init__(self, keys: Mapping[str, Ed25519PublicKey]) -> None:
        self._keys = dict(keys)

    @property
    def identities(self) -> tuple[str, ...]:
        """Identities with a known public key."""
        return tuple(self._keys)

    def signer(self, topic: str, payload: bytes, attachment: bytes) -> str | None:
        """Return the identity that signed a message under this topic; None: no known one. Never raises."""
        try:
            name = bytes(attachment[1 : 1 + attachment[0]])
            signature = bytes(attachment[1 + len(name) :])
            identity = name.decode("ascii")
            if len(name) != attachment[0] or len(signature) != SIGNATURE_BYTES:
                return None
            self._keys[identity].verify(signature, _signed(name, topic, payload))
        except Exception:  # unknown identity, forged or no signature at all
            return None
        return identity


def is_identity(name: str) -> bool:
    """Return whether a name can be an identity; it is also a part of the name of a file."""
    return 0 < len(name) <= LONGEST_IDENTITY and name.isascii() and name.replace("_", "").replace("-", "").isalnum()


def check_identity(name: str, what: str) -> None:
    """Refuse a name that cannot be an identity, with a CoopenvError that begins with `what`."""
    if not is_identity(name):
        raise CoopenvError(f"{what} {shown(name)}: expected 1 to {LONGEST_IDENTITY} letters, digits, _ or -")


def _signed(name: bytes, topic: str, payload: bytes) -> bytes:
    """Return the signed bytes; the lengths precede the parts, so that no part can pass for another."""
    place = topic.encode()
    return DOMAIN + struct.pack("<BIQ", len(name), len(place), len(payload)) + name + place + payload


PUBLIC = "public.toml"
HEAD = "# Public keys (Ed25519, base64) of cars and stations: not secret, but not to be changed.\n\n[keys]\n"
MOST_BYTES = 65_536  # of a file of keys
OTHERS_READ = stat.S_IRWXG | stat.S_IRWXO
OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


class KeyFileError(CoopenvError):
    """A file of keys is missing, not safe, or malformed."""


def make_keys(folder: str | Path, identities: Iterable[str], force: bool = False) -> tuple[list[str], list[str]]:
    """Make the keys of identities that have none yet.

    Args:
        folder: is made if need be, for its owner alone.
        identities: names of cars and stations.
        force: make new keys of all of them; the old ones are lost.

    Returns:
        Whose keys are new, and whose were there already and have been kept: in `public.toml`, even if the private
        file has been moved to its car, or as a private file.

    Raises:
        CoopenvError: a name that is none, a file in the folder that is not what it must be, or the extra is missing.
        OutputError: the folder cannot be written.
    """
    folder, names = Path(folder), list(dict.fromkeys(identities))
    for name in names:
        check_identity(name, "name of a key")
    library()
    with writing(folder):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    public = _read_public(folder / PUBLIC) if (folder / PUBLIC).exists() else {}
    new, kept = [], []
    for name in names:
        place = folder / f"{name}.pem"
        if not force and (name in public or os.path.lexists(place)):
            public[name] = public[name] if name in public else _public_text(_read_private(place).public_key())
            kept.append(name)
        else:
            public[name] = _write_private(place)
            new.append(name)
    replace_text(folder / PUBLIC, HEAD + "".join(f'{name} = "{text}"\n' for name, text in sorted(public.items())))
    with writing(folder):
        (folder / PUBLIC).chmod(0o644)  # regardless of the umask
    return new, kept


def load_signer(path: str | Path, identity: str) -> Signer:
    """Return the signer of an identity.

    Args:
        path: its private file, or a folder of keys.
        identity: name of a car or a station.

    Raises:
        KeyFileError: the file is missing, no plain file, of another user, open to others, or no key; or in a folder its
            `public.toml` has none of the identity, or another one: what it signs would count nowhere.
    """
    path = Path(path)
    if not path.is_dir():
        return Signer(identity, _read_private(path))
    private, public = path / f"{identity}.pem", path / PUBLIC
    signer, verifier = Signer(identity, _read_private(private)), load_verifier(public)
    check_known(verifier, identity, public)
    if verifier.signer(PUBLIC, b"", signer.sign(PUBLIC, b"")) != identity:
        raise KeyFileError(
            f"{private}: is not the key of {identity} in {public}; copy both anew from where `coopenv svea keys` made "
            f"them, or make new ones (--force) and give {PUBLIC} to all"
        )
    return signer


def load_verifier(path: str | Path) -> Verifier:
    """Return the verifier with the public keys of a file `public.toml`, or of its folder; errors as `load_signer`."""
    path = Path(path)
    path = path / PUBLIC if path.is_dir() else path
    ed25519 = library()
    keys: dict[str, Ed25519PublicKey] = {}
    for name, text in _read_public(path).items():
        try:
            keys[name] = ed25519.Ed25519PublicKey.from_public_bytes(base64.b64decode(text, validate=True))
        except ValueError:
            raise KeyFileError(f"{path}: keys.{name}: expected the base64 text of 32 bytes") from None
    return Verifier(keys)


def load_keys(
    folder: Path | None, identity: str, senders: Iterable[str]
) -> tuple[Signer, Verifier] | tuple[None, None]:
    """Return the signer of an identity, and the verifier of some senders; without a folder neither.

    Raises:
        KeyFileError: a sender's key is missing; others as for `load_signer`.
    """
    if folder is None:
        return None, None
    verifier = load_verifier(folder)
    for name in senders:
        check_known(verifier, name, folder)
    return load_signer(folder, identity), verifier


def check_known(verifier: Verifier, identity: str, path: str | Path) -> None:
    """Refuse public keys among which an identity's is missing. Raises KeyFileError: it is."""
    known = verifier.identities
    if identity not in known:
        raise KeyFileError(f"{path}: no public key of {shown(identity)}{suggest(identity, known)}; has {listed(known)}")


def library() -> Any:
    """Return the library's module of Ed25519. Raises CoopenvError: the extra is not installed."""
    with needing(f"signatures need an extra: {install_command('svea')}"):
        from cryptography.hazmat.primitives.asymmetric import ed25519
    return ed25519


def _write_private(place: Path) -> str:
    """Make a key in a new file that only its owner can read and return its public part as text."""
    from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

    key = library().Ed25519PrivateKey.generate()
    text = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    part = place.with_name(f".{place.name}.part")
    with writing(place):
        part.unlink(missing_ok=True)
        descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "wb") as file:
            file.write(text)
            file.flush()
            os.fsync(descriptor)
        part.replace(place)
    return _public_text(key.public_key())


def _public_text(key: Ed25519PublicKey) -> str:
    return base64.b64encode(key.public_bytes_raw()).decode()


def _read_private(path: Path) -> Ed25519PrivateKey:
    library()
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    text = _read(path, OTHERS_READ, "read by others", "chmod 600")
    try:
        key = load_pem_private_key(text, None)
    except Exception:  # an error of the library could quote what it has read
        raise KeyFileError(f"{path}: no private key in PEM without a password") from None
    if not isinstance(key, Ed25519PrivateKey):
        raise KeyFileError(f"{path}: expected a key of Ed25519, made by `coopenv svea keys`")
    return key


def _read_public(path: Path) -> dict[str, str]:
    text = _read(path, OTHERS_WRITE, "changed by others", "chmod go-w")
    try:
        keys = toml_of(text.decode())["keys"]
        if not all(is_identity(name) and isinstance(key, str) for name, key in keys.items()):
            raise ValueError
    except (ValueError, KeyError, AttributeError, RecursionError):
        raise KeyFileError(f'{path}: expected a table [keys] with lines such as svea7 = "BASE64"') from None
    return dict(keys)


def _read(path: Path, forbidden: int, danger: str, remedy: str) -> bytes:
    """Return the contents of a plain file of this user, unless its mode permits too much to other users."""
    try:
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))  # a pipe would keep us waiting
    except OSError as error:
        why = "there is none" if isinstance(error, FileNotFoundError) else error.strerror or str(error)
        raise KeyFileError(f"{path}: cannot be read as a file of keys ({why}); see `coopenv svea keys`") from None
    try:
        found = os.fstat(descriptor)
        if not stat.S_ISREG(found.st_mode):
            raise KeyFileError(f"{path}: is no plain file")
        if hasattr(os, "geteuid") and found.st_uid not in (os.geteuid(), 0):
            raise KeyFileError(f"{path}: belongs to another user; run: sudo chown {os.geteuid()} {path}")
        if os.name == "posix" and found.st_mode & forbidden:
            raise KeyFileError(f"{path}: can be {danger}; run: {remedy} {path}")
        return os.read(descriptor, MOST_BYTES)
    finally:
        os.close(descriptor)
