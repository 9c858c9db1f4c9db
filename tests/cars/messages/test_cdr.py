"""CDR of the gate's messages beside that of rosbags, and bytes that are no message."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coopenv.base.errors import CoopenvError
from coopenv.cars.gate.gate import ARM, BOOL, COMMAND, STATUS
from coopenv.cars.gate.wheel_command import MotionCommand, write_drive
from coopenv.cars.messages import cdr
from coopenv.cars.messages.cdr import Malformed, read, write
from coopenv.cars.messages.codec import decode, encode, header, make, stamp_of
from coopenv.cars.settings.profile import SVEA, Role
from tests.cars.gate.messages import arm, framed_command, stop

MESSAGES = {Role.COMMAND: COMMAND, Role.ARM: ARM, Role.STOP: BOOL, Role.GATE: STATUS}
STAMP, USUAL = st.integers(0, 2**31 * 10**9 - 1), st.floats(-1e6, 1e6, width=32)
VALUES: dict[str, st.SearchStrategy[Any]] = {
    cdr.STAMP: STAMP,
    cdr.TEXT: st.text(st.characters(codec="utf-8"), max_size=12),
    "f": st.floats(width=32, allow_nan=False),
    "?": st.booleans(),
    "Q": st.integers(0, 2**64 - 1),
}
"""Values by kind of a field."""


def leaves(message: Any) -> Iterator[Any]:
    """Yield the values of a message as the gate has them."""
    for name, value in vars(message).items():
        if name == "header":
            yield from (stamp_of(message), value.frame_id)
        elif name != "__msgtype__":
            yield from leaves(value) if hasattr(value, "__msgtype__") else [np.asarray(value).tolist()]


@given(st.data(), st.sampled_from(list(MESSAGES)))
def test_messages_have_the_bytes_and_values_of_rosbags(data: st.DataObject, role: Role) -> None:
    lists = {kind + cdr.LIST: st.lists(values, max_size=5) for kind, values in VALUES.items()}
    fields, values = MESSAGES[role], [data.draw((VALUES | lists)[field]) for field in MESSAGES[role]]
    payload = write(fields, *values)
    message = decode(payload, SVEA.topics[role].type)
    assert encode(message) == payload and read(payload, fields) == [*leaves(message)] == values


@given(STAMP, st.lists(USUAL, min_size=12, max_size=12), st.integers(0, 2**16 - 1), st.integers(0, 255))
def test_manual_control_is_that_of_rosbags(stamp: int, numbers: list[float], buttons: int, extensions: int) -> None:
    given = iter([*numbers[:4], buttons, buttons // 2, extensions, *numbers[4:]])
    neutral = {name: (kind, next(given)) for name, (kind, _) in SVEA.command.neutral.items()}
    message, drive = SVEA.command.model_copy(update={"neutral": neutral}), MotionCommand(0.1, -0.2)
    fields = message.values(drive)
    payload = write_drive(stamp, message, drive)
    assert payload == encode(make(SVEA.topics[Role.MANUAL].type, header=header(stamp), **fields))
    found = decode(payload, SVEA.topics[Role.MANUAL].type)
    assert all(getattr(found, k) == pytest.approx(v, rel=1e-6) for k, v in fields.items())


WHOLE = [
    (COMMAND, Role.COMMAND, framed_command(5, "abc:1", (0.1, 0.2, 0.3, 0.4, 0.5))),
    (ARM, Role.ARM, arm(7, "abc", "nonce")),
    (BOOL, Role.STOP, stop()),
]


@pytest.mark.parametrize(("fields", "role", "payload"), WHOLE)
def test_every_other_length_is_refused(fields: tuple[str, ...], role: Role, payload: bytes) -> None:
    for length in range(len(payload)):
        with pytest.raises(Malformed):
            read(payload[:length], fields)
        with pytest.raises(CoopenvError):
            decode(payload[:length], SVEA.topics[role].type)
    for more in range(1, 4):  # padding that some writers add
        assert read(payload + bytes(more), fields) == read(payload, fields)
    with pytest.raises(Malformed, match="too long"):
        read(payload + bytes(4), fields)


@given(st.sampled_from(WHOLE), st.binary(max_size=80), st.booleans())
def test_bytes_are_read_as_rosbags_reads_them_or_refused(what: Any, raw: bytes, plausible: bool) -> None:
    fields, role, _ = what
    payload = b"\0\1\0\0" + raw if plausible else raw
    try:
        found = read(payload, fields)
    except Malformed:
        return
    other = decode(payload, SVEA.topics[role].type)
    if role is Role.STOP:
        assert found == [bool(other.data)]
    else:
        assert found[1] == other.header.frame_id


def test_stamps_and_texts_that_make_no_sense_are_refused() -> None:
    good = framed_command(5, "abc:1", (0.0,) * 5)
    for place, byte in ((11, 0xFF), (12, 0xFF), (15, 0x7F), (16, 0xC3), (21, 0x31), (1, 0)):
        with pytest.raises(Malformed):
            read(good[:place] + bytes([byte]) + good[place + 1 :], COMMAND)
