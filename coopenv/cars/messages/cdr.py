"""CDR of the few messages of a gate, read and written in pure Python; `codec.py` does all others by rosbags.

A gate has to start quickly on a car, where NumPy, which rosbags needs, may be absent. Tests compare both byte by byte.
"""

import struct
from collections.abc import Iterable
from typing import Any

from coopenv.base.errors import CoopenvError

ENCAPSULATION = b"\0\1\0\0"
LONGEST_PADDING = 3  # bytes after the last field, which some writers add
STAMP, TEXT = "S", "T"  # ns; UTF-8
LIST = "[]"  # after a kind: any number of it
KINDS = {
    **{"bool": "?", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H"},
    **{"int32": "i", "uint32": "I", "float32": "f", "float64": "d"},
}
"""Kinds of the module struct by type of ROS."""


class Malformed(CoopenvError):  # noqa: N818
    """Bytes are not the message that they should be."""


def read(payload: bytes, fields: Iterable[str]) -> list[Any]:
    """Return the fields of CDR bytes: kinds of the module struct, `STAMP` or `TEXT`, or a `LIST` of one.

    Raises Malformed: the bytes are no such fields.
    """
    if payload[:2] != ENCAPSULATION[:2] or len(payload) < len(ENCAPSULATION):
        raise Malformed("no little-endian CDR")
    body, place = payload[len(ENCAPSULATION) :], 0

    def number(kind: str) -> Any:
        nonlocal place
        size = struct.calcsize(kind)
        start = -(-place // size) * size
        place = start + size
        if place > len(body):
            raise Malformed("too short")
        return struct.unpack_from(f"<{kind}", body, start)[0]

    def value(field: str) -> Any:
        nonlocal place
        if field == STAMP:
            seconds, nanoseconds = number("i"), number("I")
            if nanoseconds >= 10**9:
                raise Malformed("a stamp has more than a second of nanoseconds")
            return seconds * 10**9 + nanoseconds
        if field != TEXT:
            return number(field)
        length = number("I")  # with the zero byte at its end
        raw = body[place : place + length]
        place += length
        if len(raw) != length or raw[-1:] != b"\0":
            raise Malformed("a text has no end")
        try:
            return raw[:-1].decode()
        except UnicodeDecodeError:
            raise Malformed("a text is not UTF-8") from None

    found = list[Any]()
    for field in fields:
        kind = field.removesuffix(LIST)
        found.append(value(kind) if kind == field else [value(kind) for _ in range(number("I"))])
    if len(body) - place > LONGEST_PADDING:
        raise Malformed("too long")
    return found


def write(fields: Iterable[str], *values: Any) -> bytes:
    """Return the CDR bytes of values; fields as for `read`."""
    body = bytearray()

    def put(kind: str, value: float) -> None:
        body.extend(bytes(-len(body) % struct.calcsize(kind)) + struct.pack(f"<{kind}", value))

    def add(field: str, value: Any) -> None:
        if field == STAMP:
            for kind, part in zip("iI", divmod(value, 10**9), strict=True):
                put(kind, part)
        elif field == TEXT:
            raw = value.encode() + b"\0"
            put("I", len(raw))
            body.extend(raw)
        else:
            put(field, value)

    for field, value in zip(fields, values, strict=True):
        kind = field.removesuffix(LIST)
        if kind != field:
            put("I", len(value))
        for each in value if kind != field else (value,):
            add(kind, each)
    return ENCAPSULATION + bytes(body)
