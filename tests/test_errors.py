"""Errors are one line that can be read, whatever was wrong."""

from __future__ import annotations

import pickle

import pytest

from coopenv.base.errors import MAX_MESSAGE, CoopenvError, DataError, check_memory, shown


class Unspeakable:
    def __repr__(self) -> str:
        raise RuntimeError


def test_one_line_without_control_characters() -> None:
    error = DataError("file\n  \t'\x1b]0;owned\x07\u202e\udc80' is\nwrong: größer ≥ 1 µm")
    assert str(error) == r"file '\x1b]0;owned\x07\u202e\udc80' is wrong: größer ≥ 1 µm"
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_long_messages_keep_both_ends() -> None:
    message = str(CoopenvError("begin " + "a" * 5000 + " end"))
    assert len(message) <= MAX_MESSAGE and message.startswith("begin a") and message.endswith("a end")


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("a", "'a'"),
        (1.5, "1.5"),
        ("x" * 100, "'" + "x" * 27 + "..." + "x" * 27 + "'"),
        (10**5000, "a int"),
        (Unspeakable(), "a Unspeakable"),
    ],
    ids=["text", "number", "long", "huge", "unspeakable"],
)
def test_values_as_errors_quote_them(value: object, expected: str) -> None:
    assert shown(value) == expected


def test_memory() -> None:
    check_memory(2**20, "this")
    with pytest.raises(CoopenvError, match=r"^this would need 3 GiB of memory, there are 2$"):
        check_memory(3 * 2**30, "this", 2**31)
    with pytest.raises(CoopenvError, match=r"^that would need 9.31e\+08 GiB"):
        check_memory(1e18, "that")
