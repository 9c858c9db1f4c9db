"""Signatures of messages, Ed25519: who has sent one, and that it is as it was sent.

They travel beside a message, as the transport's attachment, so that its payload stays what ROS 2 has under that topic.
A signature says nothing of when: receivers look at stamps and sequence numbers, which are part of what is signed.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import TYPE_CHECKING

from coopenv.errors import CoopenvError, shown

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

DOMAIN = b"coopenv message 1\0"
"""What every signed text begins with, so that a signature made for anything else is none here."""

SIGNATURE_BYTES = 64
LONGEST_IDENTITY = 64  # characters, ASCII


class Signer:
    """Signs as one identity."""

    def __init__(self, identity: str, key: Ed25519PrivateKey) -> None:
        """Take a key.

        Args:
            identity: name of a car or a station, ASCII, at most 64 characters.
            key: its private key.

        Raises:
            CoopenvError: the identity is none.
        """
        if not is_identity(identity):
            raise CoopenvError(f"identity {shown(identity)}: expected 1 to {LONGEST_IDENTITY} letters, digits, _ or -")
        self.identity = identity
        self._key = key

    def sign(self, topic: str, payload: bytes) -> bytes:
        """Return the attachment of a message: the length of the identity (1 byte), the identity, 64 bytes."""
        name = self.identity.encode()
        return bytes([len(name)]) + name + self._key.sign(_signed(name, topic, payload))


class Verifier:
    """Knows public keys, and with them who has signed a message; keeps nothing of the messages."""

    def __init__(self, keys: Mapping[str, Ed25519PublicKey]) -> None:
        self._keys = dict(keys)

    @property
    def identities(self) -> tuple[str, ...]:
        """Those whose signatures are known."""
        return tuple(self._keys)

    def signer(self, topic: str, payload: bytes, attachment: bytes) -> str | None:
        """Return who has signed a message under this topic; None: nobody who is known. Never raises."""
        try:
            name = bytes(attachment[1 : 1 + attachment[0]])
            signature = bytes(attachment[1 + len(name) :])
            identity = name.decode("ascii")
            if len(name) != attachment[0] or len(signature) != SIGNATURE_BYTES:
                return None
            self._keys[identity].verify(signature, _signed(name, topic, payload))
        except Exception:  # nobody known, forged or no signature at all: whatever came, it is from a stranger
            return None
        return identity


def is_identity(name: str) -> bool:
    """Return whether a name can be an identity; it is also a part of the name of a file."""
    return 0 < len(name) <= LONGEST_IDENTITY and name.isascii() and name.replace("_", "").replace("-", "").isalnum()


def _signed(name: bytes, topic: str, payload: bytes) -> bytes:
    """Return what is signed; the lengths stand before the parts, so that none can pass for another."""
    place = topic.encode()
    return DOMAIN + struct.pack("<BIQ", len(name), len(place), len(payload)) + name + place + payload
