"""A signature names who has sent a message under a topic, and anything else names nobody."""

from __future__ import annotations

import struct
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from hypothesis import given
from hypothesis import strategies as st

from coopenv.base.errors import CoopenvError
from coopenv.cars.keys import DOMAIN, Signer, Verifier

KEYS = {name: Ed25519PrivateKey.from_private_bytes(bytes([i]) * 32) for i, name in enumerate(("station", "svea7"))}
VERIFIER = Verifier({name: key.public_key() for name, key in KEYS.items()})
STATION = Signer("station", KEYS["station"])
TOPICS = st.text(st.characters(codec="utf-8"), max_size=30)


@given(TOPICS, st.binary(max_size=200), st.sampled_from(sorted(KEYS)))
def test_the_signer_is_named(topic: str, payload: bytes, name: str) -> None:
    attachment = Signer(name, KEYS[name]).sign(topic, payload)
    assert VERIFIER.signer(topic, payload, attachment) == name


@given(TOPICS, st.binary(max_size=60), TOPICS, st.binary(max_size=60))
def test_a_signature_is_for_one_topic_and_one_payload(topic: str, payload: bytes, other: str, more: bytes) -> None:
    attachment = STATION.sign(topic, payload)
    if (other, more) != (topic, payload):
        assert VERIFIER.signer(other, more, attachment) is None
    if other:
        assert VERIFIER.signer(topic + other, payload, attachment) is None
        assert VERIFIER.signer(topic, other.encode() + payload, attachment) is None


def test_what_is_signed_is_what_the_documentation_says() -> None:
    attachment = STATION.sign("a/b", b"xyz")
    assert attachment[:8] == b"\x07station" and len(attachment) == 8 + 64
    text = DOMAIN + struct.pack("<BIQ", 7, 3, 3) + b"station" + b"a/b" + b"xyz"
    KEYS["station"].public_key().verify(attachment[8:], text)  # raises if it is none


@given(st.binary(max_size=120))
def test_bytes_name_nobody(attachment: bytes) -> None:
    assert VERIFIER.signer("a", b"b", attachment) is None


def test_each_changed_byte_and_each_length_names_nobody() -> None:
    attachment = STATION.sign("a", b"b")
    for i in range(len(attachment)):
        assert VERIFIER.signer("a", b"b", attachment[:i]) is None
        assert VERIFIER.signer("a", b"b", attachment[:i] + bytes([attachment[i] ^ 1]) + attachment[i + 1 :]) is None
    assert VERIFIER.signer("a", b"b", attachment + b"\0") is None


def test_one_identity_cannot_sign_as_another() -> None:
    attachment = Signer("station", KEYS["svea7"]).sign("a", b"b")
    assert VERIFIER.signer("a", b"b", attachment) is None
    renamed = b"\x05svea7" + STATION.sign("a", b"b")[8:]
    assert VERIFIER.signer("a", b"b", renamed) is None
    unknown = Signer("nobody", KEYS["station"]).sign("a", b"b")
    assert VERIFIER.signer("a", b"b", unknown) is None


@pytest.mark.parametrize("attachment", [None, 3, "text", [300], object(), b""])
def test_what_is_no_attachment_raises_nothing(attachment: Any) -> None:
    assert VERIFIER.signer("a", b"b", attachment) is None
    assert VERIFIER.signer("\ud800", b"b", STATION.sign("a", b"b")) is None


@pytest.mark.parametrize("identity", ["", "a/b", "..", "ä", "a" * 65, "a b"])
def test_an_identity_is_a_plain_name(identity: str) -> None:
    with pytest.raises(CoopenvError, match="identity"):
        Signer(identity, KEYS["station"])
