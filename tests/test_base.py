"""The package's ground floor: errors in one line, numbers for people, results as JSON."""

from __future__ import annotations

import json
import math
import pickle
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coopenv.base.errors import MAX_MESSAGE, CoopenvError, DataError, check_memory, shown
from coopenv.base.format import (
    column,
    fixed,
    in_parentheses,
    json_text,
    jsonable,
    number,
    read_npz,
    seconds,
    with_error,
)
from coopenv.base.terminal import NumberTable, text_of


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


NAN = math.nan


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (0.0, 4, "0"),
        (-0.0, 4, "0"),
        (1 / 3, 4, "0.3333"),
        (12345.6, 4, "12346"),
        (12345.6, 3, "12346"),
        (2.5e6, 3, "2.5e+06"),
        (-0.5, 3, "-0.5"),
        (1e-5, 3, "1e-05"),
        (NAN, 3, "-"),
        (math.inf, 3, "inf"),
    ],
)
def test_numbers(value: float, digits: int, text: str) -> None:
    assert number(value, digits) == text


@pytest.mark.parametrize(
    ("values", "texts"),
    [
        ([11.5, 90.0, 7.25], ["11.5", "90.0", "7.2"]),
        ([0.0042, 0.0135, 0.1], ["0.0042", "0.0135", "0.1000"]),
        ([6.8e-4, 0.04, NAN], ["0.00068", "0.04000", "-"]),
        ([1e-12, 0.5, 0.0], ["1e-12", "0.500", "0.000"]),
        ([123.0, 4567.0], ["123", "4567"]),
        ([3.0, 2e7, math.inf], ["3.00", "2e+07", "inf"]),
        ([0.0, 0.0], ["0", "0"]),
        ([NAN], ["-"]),
        ([], []),
    ],
)
def test_a_column_has_equal_decimals(values: list[float], texts: list[str]) -> None:
    assert column(values) == texts


def test_lengths_align_below_ten() -> None:
    assert [fixed(value, 3) for value in (0.01, 9.5, 12.34, 54321.0, NAN)] == ["0.010", "9.500", "12.3", "5e+04", "-"]


def test_times() -> None:
    assert seconds([2.934, NAN]) == ["2.93", "never"]


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (0.01234, 0.00042, "0.0123(4)"),
        (0.01234, 0.00096, "0.012(1)"),
        (12.34, 3.2, "12(3)"),
        (123.4, 27.0, "123(27)"),
        (0.5, 2.0, "0.5(20)"),
        (1.0, 0.0, "1.000(0)"),
        (0.0, 0.0, "0(0)"),
        (0.01234, NAN, "0.0123"),
        (NAN, 0.1, "-"),
    ],
)
def test_standard_errors_in_parentheses(value: float, error: float, text: str) -> None:
    assert in_parentheses(value, error) == text


def test_a_number_and_its_error_have_the_same_decimals() -> None:
    assert with_error(0.01234, 0.00042) == ("0.0123", "0.0004")
    assert with_error(0.01234, NAN) == ("0.0123", "")


@dataclass
class Row:
    name: str
    value: float


@pytest.mark.parametrize(
    ("value", "plain"),
    [
        (np.float64("nan"), None),
        ([math.inf, np.int64(3), np.array([1.0, np.nan])], [None, 3, [1.0, None]]),
        ((True, "x", None, np.bool_(False)), [True, "x", None, False]),
        (Row("y", -math.inf), {"name": "y", "value": None}),
        (Path("out/run"), "out/run"),
        (np.float32(0.5), 0.5),
    ],
)
def test_numpy_and_nan_are_written_as_json_knows_them(value: Any, plain: Any) -> None:
    assert json.loads(json_text({"a": value})) == {"a": plain}
    assert json.loads(json.dumps(jsonable(value), allow_nan=False)) == plain
    assert json_text(value).endswith("\n")


def test_arrays_that_python_would_unpack_without_a_limit_are_refused(tmp_path: Path) -> None:
    path, wanted = tmp_path / "made.npz", {"nees": "f K"}
    np.savez_compressed(path, nees=np.ones(3))
    assert read_npz(path, "record", wanted)["nees"].tolist() == [1.0, 1.0, 1.0]
    with zipfile.ZipFile(path) as archive:
        content = archive.read("nees.npy")
    for kind in (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        with zipfile.ZipFile(path, "w", kind) as archive:
            archive.writestr("nees.npy", content)
        with pytest.raises(DataError, match=r"made\.npz: a part is in it twice, or packed by neither of: stored"):
            read_npz(path, "record", wanted)


def test_a_terminal_shows_control_characters_and_does_not_obey_them() -> None:
    table = NumberTable("a\x1b]0;b")
    table.add_row("c\x1b[2J\x9b\nd")
    shown = text_of(table, 80)
    assert r"a\x1b]0;b" in shown and r"c\x1b[2J\x9b" in shown and "\x1b" not in shown and "\x9b" not in shown
    assert text_of("one\n\ttwo \x07", 80) == "one\n        two \\x07\n"
