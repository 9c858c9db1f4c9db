"""Files of keys: made once, kept, and refused when others can get at them."""

from __future__ import annotations

import os
import stat
import struct
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from hypothesis import given
from hypothesis import strategies as st

from coopenv.base.errors import CoopenvError
from coopenv.cars.link import zenoh
from coopenv.cars.link.keys import (
    DOMAIN,
    PUBLIC,
    KeyFileError,
    Signer,
    Verifier,
    check_known,
    load_signer,
    load_verifier,
    make_keys,
)
from coopenv.cli.app import main
from tests.helpers.processes import ROOT

pytestmark = pytest.mark.skipif(os.name != "posix", reason="modes of files")
NAMES = ("svea7", "svea8", "station")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    before = os.umask(0)  # on which no mode depends
    try:
        assert make_keys(tmp_path / "keys", NAMES) == (list(NAMES), [])
    finally:
        os.umask(before)
    return tmp_path / "keys"


def test_keys_sign_and_verify(folder: Path) -> None:
    verifier = load_verifier(folder)
    assert set(verifier.identities) == set(NAMES)
    for name in NAMES:
        for place in (folder, folder / f"{name}.pem"):
            assert verifier.signer("t", b"p", load_signer(place, name).sign("t", b"p")) == name
    assert load_verifier(folder / PUBLIC).signer("t", b"p", load_signer(folder, "svea7").sign("t", b"p")) == "svea7"
    check_known(verifier, "station", folder)
    with pytest.raises(KeyFileError, match="no public key of 'svea9'"):
        check_known(verifier, "svea9", folder)


def test_a_private_file_of_another_is_refused_by_the_names_of_both_files(folder: Path) -> None:
    (folder / "svea8.pem").replace(folder / "svea7.pem")
    with pytest.raises(KeyFileError) as refused:
        load_signer(folder, "svea7")
    for part in (str(folder / "svea7.pem"), str(folder / PUBLIC), "coopenv svea keys", "--force"):
        assert part in str(refused.value)
    load_signer(folder / "svea7.pem", "svea8")  # a file alone says nothing of whose it is
    (folder / PUBLIC).write_text("[keys]\n")
    with pytest.raises(KeyFileError, match=r"public\.toml: no public key of 'station'"):
        load_signer(folder, "station")


def test_private_files_are_readable_by_their_owner_alone(folder: Path) -> None:
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    for name in NAMES:
        assert stat.S_IMODE((folder / f"{name}.pem").stat().st_mode) == 0o600
    assert stat.S_IMODE((folder / PUBLIC).stat().st_mode) == 0o644
    assert sorted(path.name for path in folder.iterdir()) == sorted([*(f"{name}.pem" for name in NAMES), PUBLIC])


def test_existing_keys_are_kept_unless_forced(folder: Path) -> None:
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    (folder / "svea8.pem").unlink()  # it has been moved to its car
    assert make_keys(folder, [*NAMES, "svea9"]) == (["svea9"], list(NAMES))
    for name in ("svea7.pem", "station.pem"):
        assert (folder / name).read_bytes() == before[name]
    assert not (folder / "svea8.pem").exists()
    old = load_verifier(folder)
    assert set(old.identities) == {*NAMES, "svea9"}
    assert make_keys(folder, ["svea7"], force=True) == (["svea7"], [])
    attachment = load_signer(folder, "svea7").sign("t", b"p")
    assert old.signer("t", b"p", attachment) is None
    assert load_verifier(folder).signer("t", b"p", attachment) == "svea7"


def test_a_lost_public_file_is_made_again(folder: Path) -> None:
    before = (folder / PUBLIC).read_bytes()
    (folder / PUBLIC).unlink()
    make_keys(folder, NAMES)
    assert (folder / PUBLIC).read_bytes() == before


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660, 0o601])
def test_files_open_to_others_are_refused(folder: Path, mode: int) -> None:
    (folder / "svea7.pem").chmod(mode)
    with pytest.raises(KeyFileError, match=f"chmod 600 {folder / 'svea7.pem'}"):
        load_signer(folder, "svea7")
    (folder / PUBLIC).chmod(0o664)
    with pytest.raises(KeyFileError, match="chmod go-w"):
        load_verifier(folder)


def test_files_of_another_user_pipes_and_folders_are_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, make in (("pipe", os.mkfifo), ("folder", os.mkdir)):
        make(folder / f"{name}.pem", 0o600)
        with pytest.raises(KeyFileError, match="no plain file"):
            load_signer(folder, name)
    with pytest.raises(KeyFileError, match=r"nobody\.pem: cannot be read .*coopenv svea keys"):
        load_signer(folder, "nobody")
    stranger = os.geteuid() + 4711
    if os.geteuid() == 0:
        os.chown(folder / "svea7.pem", stranger, -1)
    else:
        monkeypatch.setattr(os, "geteuid", lambda: stranger)
    with pytest.raises(KeyFileError, match="belongs to another user"):
        load_signer(folder, "svea7")


MALFORMED_KEY = "-----BEGIN PRIVATE KEY-----\nsecret\n-----END PRIVATE KEY-----\n"


@pytest.mark.parametrize("text", ["", MALFORMED_KEY, "\0\xff"])
def test_a_malformed_key_is_refused_and_not_quoted(folder: Path, text: str) -> None:
    (folder / "svea7.pem").write_text(text)
    with pytest.raises(KeyFileError, match="no private key") as raised:
        load_signer(folder, "svea7")
    assert "secret" not in str(raised.value) and raised.value.__cause__ is None


@pytest.mark.parametrize("text", ["", "keys = 3", "[keys]\nsvea7 = 3", "[keys]\n'a/b' = 'x'", "[keys", "[keys]\na='!'"])
def test_a_malformed_public_file_is_refused(folder: Path, text: str) -> None:
    (folder / PUBLIC).write_text(text)
    with pytest.raises(KeyFileError, match=r"public\.toml: (expected|keys\.a: expected)"):
        load_verifier(folder)


@pytest.mark.parametrize("command", [["gate", "--car", "svea7"], ["fake", "--car", "svea7"], ["run"]])
def test_commands_with_the_key_of_another_do_not_connect(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zenoh, "open_zenoh", lambda *_, **__: pytest.fail("the network is touched"))
    shipped = ROOT / "examples" / "fleet" / "overtaking.toml"
    (tmp_path / "fleet.toml").write_text(shipped.read_text() + '[security]\nkeys = "keys"\n')
    make_keys(tmp_path / "keys", ["svea7", "svea1", "station", "other"])
    mixed = "station" if command == ["run"] else "svea7"
    (tmp_path / "keys" / "other.pem").replace(tmp_path / "keys" / f"{mixed}.pem")
    assert main(["svea", command[0], str(tmp_path / "fleet.toml"), *command[1:]]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{mixed}.pem: is not the key of {mixed} in {tmp_path / 'keys' / PUBLIC}; copy both anew" in line


DEPLOYMENT = """
environment = "busy_intersection"
cars = [{name = "svea7"}, {name = "svea8"}]
[security]
keys = "secrets"
identity = "desk"
"""


def test_the_command_makes_keys_of_a_deployment(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "fleet.toml").write_text(DEPLOYMENT)
    assert main(["svea", "keys", str(tmp_path / "fleet.toml")]) == 0
    assert set(load_verifier(tmp_path / "secrets").identities) == {"svea7", "svea8", "desk"}
    assert "desk.pem" in capsys.readouterr().out
    assert main(["svea", "keys", str(tmp_path / "fleet.toml")]) == 0
    assert capsys.readouterr().out.count("is kept") == 3


def test_the_command_takes_names_and_refuses_malformed_ones(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ["--out", str(tmp_path / "k")]
    assert main(["svea", "keys", "--names", "svea7, station", *out]) == 0
    assert set(load_verifier(tmp_path / "k").identities) == {"svea7", "station"}
    for wrong in (["--names", "../x"], ["--names", ""], [], ["x.toml", "--names", "a"]):
        assert main(["svea", "keys", *wrong, *out]) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1


KEYS = {name: Ed25519PrivateKey.from_private_bytes(bytes([i]) * 32) for i, name in enumerate(("station", "svea7"))}
VERIFIER = Verifier({name: key.public_key() for name, key in KEYS.items()})
STATION = Signer("station", KEYS["station"])
TOPICS = st.text(st.characters(codec="utf-8"), max_size=30)


@given(TOPICS, st.binary(max_size=60), TOPICS, st.binary(max_size=60))
def test_a_signature_is_for_one_topic_and_one_payload(topic: str, payload: bytes, other: str, more: bytes) -> None:
    attachment = STATION.sign(topic, payload)
    assert VERIFIER.signer(topic, payload, attachment) == "station"
    if (other, more) != (topic, payload):
        assert VERIFIER.signer(other, more, attachment) is None
    if other:
        assert VERIFIER.signer(topic + other, payload, attachment) is None
        assert VERIFIER.signer(topic, other.encode() + payload, attachment) is None


def test_signed_bytes_are_the_documented_ones() -> None:
    attachment = STATION.sign("a/b", b"xyz")
    assert attachment[:8] == b"\x07station" and len(attachment) == 8 + 64
    text = DOMAIN + struct.pack("<BIQ", 7, 3, 3) + b"station" + b"a/b" + b"xyz"
    KEYS["station"].public_key().verify(attachment[8:], text)  # raises if it is none


@given(st.binary(max_size=120) | st.sampled_from([None, 3, "text", [300], object(), b""]))
def test_malformed_attachments_have_no_signer(attachment: Any) -> None:
    assert VERIFIER.signer("a", b"b", attachment) is None
    assert VERIFIER.signer("\ud800", b"b", STATION.sign("a", b"b")) is None


def test_changed_and_cut_attachments_have_no_signer() -> None:
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


@pytest.mark.parametrize("identity", ["", "a/b", "..", "ä", "a" * 65, "a b"])
def test_an_identity_is_a_plain_name(identity: str) -> None:
    with pytest.raises(CoopenvError, match="identity"):
        Signer(identity, KEYS["station"])
